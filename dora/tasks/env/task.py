"""What a task is: its numbers, its arms, how its scene is built and started, and its MDP."""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from mani_skill.utils.structs import Actor, Link
from torch import Tensor

from dora.affordance.bundled_sets import load_candidates
from dora.affordance.candidates import GraspCandidates
from dora.affordance.reach.feasibility_table import Grid
from dora.robot import RobotDescription
from dora.sim.cameras import CameraSpec
from dora.sim.shapes import DrawnShape
from dora.tasks.env.arm import Arm, ArmSpec
from dora.tasks.env.starts import STANDING_DRAWS, ChosenStarts, standing_starts
from dora.tasks.env.table import TableTop, table_shapes
from dora.tasks.guidance.grasp_and_lift import GraspReference, GraspSettings
from dora.tasks.guidance.reference import Reference
from dora.tasks.mdp.config import TaskConfig
from dora.tasks.mdp.mdp import Mdp
from dora.tasks.mdp.quantities import off_table, opposed
from dora.tasks.mdp.snapshot import Snapshot

if TYPE_CHECKING:
    from dora.tasks.env.scene import TaskScene

HELD_RISE = 0.1
"""Rise of an object that is held up [m]."""
HAND_CAMERA = CameraSpec(eye=(0.10, 0.0, -0.06), target=(0.06, 0.0, 0.16), up=(1.0, 0.0, 0.0), on_hand=True)
"""Camera above the palm near the wrist, which looks along the fingers at what they grasp."""
FRONT_CAMERA = CameraSpec(eye=(1.0, -0.65, 0.42), target=(0.5, 0.0, 0.2), fov=0.85)
"""Camera in front of the arm, to the side of the little finger: from straight ahead the hand hides what it holds."""


class Task(ABC):
    """A task: what an environment builds, how episodes begin, and what they ask for. Each environment has its own
    instance.

    Args:
        config: the numbers in force, an instance of `CONFIG`.
    """

    CONFIG: ClassVar[type[TaskConfig]] = TaskConfig
    """The task's numbers."""
    ARMS: ClassVar[Mapping[str, ArmSpec]]
    """The arms by name, each with the object that it handles."""
    DRAWS: ClassVar[int]
    """How many uniform random numbers one initial state needs, besides mass, friction and errors."""
    MAX_STEPS: ClassVar[int]
    """Episode limit [control steps]."""
    LEARNERS: ClassVar[Mapping[str, Mapping[str, Any]]] = {"ppo": {}, "sac": {}}
    """The learners that can do the task with their recommended settings, as differences from the defaults; the first
    is the recommended one."""
    CONTACT_POINTS: ClassVar[int] = 0
    """Contact points of hand and object that the snapshot holds; 0 if the task asks for none."""
    CONTACT_EVERY_STEP: ClassVar[bool] = False
    """Whether contacts are collected from all physics steps of a control step: blows are shorter than that."""
    WRIST_MOTION: ClassVar[tuple[float, float] | None] = None
    """Wrist speed [m/s] and spin [rad/s] of a full action, told to the drives as well; the controller's own if None."""
    ONE_SIZE: ClassVar[frozenset[str]] = frozenset()
    """Names of the objects whose size is not drawn."""
    TABLE: ClassVar[TableTop] = TableTop()
    """The table."""
    CAMERA: ClassVar[tuple[tuple[float, float, float], tuple[float, float, float]]] = (
        (1.05, 0.62, 0.48),
        (0.42, 0.02, 0.2),
    )
    """Eye and target of the camera of films [m]."""
    CAMERAS: ClassVar[Mapping[str, CameraSpec]] = {"hand_camera": HAND_CAMERA, "front_camera": FRONT_CAMERA}
    """The cameras of observations by name: one on each hand, which moves with it, and one in front of the arm."""

    def __init__(self, config: Any):
        self.config = config

    @classmethod
    def robots(cls) -> list[str]:
        """Names of the robots of all arms, unless an environment is made with others."""
        return [arm.robot for arm in cls.ARMS.values()]

    @abstractmethod
    def make_mdp(self, scene: "TaskScene") -> Mdp[Any]:
        """Stages, reward terms, observations, failure; called once per scene, after its objects are built."""

    @abstractmethod
    def place(self, scene: "TaskScene", rows: Int[Tensor, " b"], u: Float[Tensor, "b d"]) -> None:
        """Puts the objects of the environments `rows` where `u` (b, DRAWS) in [0, 1) says."""

    def begin_in_place(self, scene: "TaskScene", rows: Int[Tensor, " b"]) -> None:  # noqa: B027 (most tasks need not)
        """Takes note that episodes begin with the objects of the environments `rows` where they are, since somebody has
        set the state of the simulator."""

    def candidates(self, arm: str, region: bool = True) -> GraspCandidates:
        """Grasps with which an arm may handle its object; all that come with the object by default.

        Args:
            arm: its name.
            region: those of a search for the target region, or of one that knows no region (`guidance="grasps"`).
        """
        return load_candidates(self.ARMS[arm].object, region=region)

    def held(self, s: Any, arm: str) -> Bool[Tensor, " n"]:
        """The object is in the hand and off the ground, whatever region of it is held: what grasps of a search that
        knows no region are ranked by.

        Args:
            s: what the arm sees, at the end of an episode of the scripted solution.
            arm: its name.
        """
        return opposed(s) & off_table(s, HELD_RISE)

    def adapted(self, candidates: GraspCandidates, arm: str, robot: RobotDescription) -> GraspCandidates:
        """The same grasps as an arm executes them in this task."""
        return candidates

    def build(self, scene: "TaskScene", name: str, scale: Float[np.ndarray, " n"]) -> Actor | Link:
        """Builds an object into every sub-scene, `scale` times its size; the folder of that name by default."""
        return scene.build(name, scale)

    def world(self, scene: "TaskScene") -> Sequence[Actor | Link]:
        """What objects and hands may touch besides each other; asked once per scene, after `build`."""
        return [scene.table]

    def make_reference(self, scene: "TaskScene", arm: str) -> Reference:
        """What leads the hand of an arm along its chosen candidate; called once per scene. By default a grasp, with the
        numbers of the configuration's `reference` if it has them."""
        given = getattr(self.config, "reference", None)
        settings = given if isinstance(given, GraspSettings) else GraspSettings()
        return GraspReference(scene.num_envs, self.config.dt, scene.device, settings)

    def start_grid(self, arm: str) -> Grid | None:
        """Where the object of an arm may stand at the start, for the table of f_reach; None where it does not stand."""
        return None

    def starts(self) -> ChosenStarts | None:
        """Numbers of a start that a person can choose; place and yaw of an object that stands, None elsewhere."""
        grids = [self.start_grid(arm) for arm in self.ARMS]
        alone = len(grids) == 1 and self.DRAWS == STANDING_DRAWS
        return standing_starts(grids[0]) if alone and grids[0] is not None else None

    def drawn(self, scene: "TaskScene") -> Mapping[str, tuple[Actor | Link, tuple[DrawnShape, ...]]]:
        """What a page draws besides robots and objects: bodies by name, with their shapes."""
        return {"table": (scene.table, table_shapes(self.TABLE))}

    def masses(self, name: str, nominal: Float[Tensor, " b"], u: Float[Tensor, " b"]) -> Float[Tensor, " b"]:
        """Masses of new episodes [kg] from an object's nominal ones and uniform random numbers."""
        return nominal * (1 + self.config.randomisation.mass * (2 * u - 1))

    def reachable(
        self, arm: Arm, rows: Int[Tensor, " b"], object_p: Float[Tensor, "b 3"], object_q: Float[Tensor, "b 4"]
    ) -> Bool[Tensor, "b c"]:
        """f_reach: which candidates an arm can carry out in the environments `rows`, when its object is like this."""
        return self.graspable(arm, object_p, object_q)

    def graspable(
        self, arm: Arm, object_p: Float[Tensor, "b 3"], object_q: Float[Tensor, "b 4"]
    ) -> Bool[Tensor, "b c"]:
        """Which candidates an arm can carry out when its object stands like this on the table."""
        if (table := arm.reach_table) is not None:
            return table.mask(object_p, object_q)
        count = len(arm.guide.choice.candidates)
        return torch.ones(len(object_p), count, dtype=torch.bool, device=object_p.device)

    def startable(
        self, arm: Arm, object_p: Float[Tensor, "b 3"], object_q: Float[Tensor, "b 4"]
    ) -> Bool[Tensor, "b c"]:
        """f_reach of the candidates that decide where objects start, which are the same with all guidance."""
        table = arm.start_table
        return self.graspable(arm, object_p, object_q) if table is None else table.mask(object_p, object_q)

    def extended(self, s: Snapshot) -> Snapshot:
        """The snapshot with what this task reads in addition: a subclass of `Snapshot`. Changes nothing."""
        return s

    def remember(self, s: Snapshot) -> None:  # noqa: B027 (most tasks need not)
        """Takes note of the present state before a control step moves it."""

    def stateful(self) -> dict[str, Any]:
        """What a task remembers of an episode by itself; each has get_state() and set_state(state, rows)."""
        return {}


def short_name(env_id: str) -> str:
    """What the files about a Dora id are called: DoraCube-v1 -> cube."""
    return env_id.removeprefix("Dora").split("-")[0].lower()
