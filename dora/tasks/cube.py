"""DoraCube-v1: grasp a cube on a table and lift it."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache, partial
from math import cos, pi, sin
from typing import Any, ClassVar

import numpy as np
import sapien
import torch
from jaxtyping import Bool, Float
from mani_skill.utils.structs import Actor, Pose
from torch import Tensor

from dora.affordance.bundled_sets import ROBOT, best_candidates
from dora.affordance.candidates import GraspCandidates, hand_digest
from dora.affordance.objects.affordance_object import AffordanceObject
from dora.affordance.objects.catalogue import load_object
from dora.affordance.reach.feasibility_table import Grid
from dora.geometry.rotations import quaternion_apply, quaternion_multiply
from dora.robot import load_robot
from dora.sim.actors import build_box
from dora.sim.cameras import CameraSpec
from dora.tasks.env.arm import ArmSpec
from dora.tasks.env.registration import register_task
from dora.tasks.env.scene import TaskScene
from dora.tasks.env.starts import STANDING_DRAWS, standing
from dora.tasks.env.task import HAND_CAMERA, Task
from dora.tasks.mdp.config import PenaltyWeights, TaskConfig
from dora.tasks.mdp.mdp import Mdp
from dora.tasks.mdp.observations import Entry
from dora.tasks.mdp.quantities import box_distance, lifted, off_table, opposed, rise, thumb_and_finger
from dora.tasks.mdp.rewards import Term, Terms, tolerance
from dora.tasks.mdp.snapshot import Snapshot, derived
from dora.tasks.mdp.stages import Stage
from dora.tasks.mdp.terms import (
    at_candidate,
    beyond_the_limit,
    finger_contacts,
    near_region,
    paper_affordance,
    paper_grasp,
    paper_lift,
    paper_penalty,
    penalties,
    while_active,
    without_overlap,
)


@dataclass(frozen=True, kw_only=True)
class CubeWeights(PenaltyWeights):
    """Weights of the reward terms."""

    affordance: float = 0.3
    """Fingertips near the cube [1]."""
    candidate: float = 0.3
    """Wrist at the candidate [1]."""
    reach: float = 0.3
    """Thumb and one finger near the cube [1]."""
    grasp: float = 0.4
    """Contacts of thumb and fingers [1]."""
    lift: float = 3.0
    """Rise [1]."""
    held: float = 1.5
    """Lifted and held without overlap [1]."""


@dataclass(frozen=True, kw_only=True)
class CubeConfig(TaskConfig):
    """Numbers of the task."""

    persistent_contacts: bool = False
    """PhysX keeps contact points from step to step (PCM); it misses fingers that slide over the cube's edges."""
    centre: tuple[float, float] = (0.55, 0.0)
    """Middle of the area where the cube starts [m]."""
    spread: float = 0.08
    """Half width of that area [m]."""
    lift: float = 0.10
    """Rise that counts as lifted [m]."""
    reach: float = 0.03
    """Distance of thumb and one more fingertip from the cube's surface that ends the reach [m]."""
    lost: float = 0.12
    """The same distance at which the cube has been lost again [m]."""
    touch_time: float = 0.15
    """Time for which thumb and finger must touch the cube [s]."""
    hold_time: float = 0.5
    """Time for which the lifted cube must be held [s]."""
    free_overlap: float = 0.0005
    """Overlap that costs no reward [m]."""
    penetration_limit: float = 0.003
    """Largest overlap in an episode that counts as a success [m]."""
    optimised: bool = False
    """Use the candidates that the optimiser found in place of one made by hand; `guidance="grasps"` always does."""
    fewest_lifts: float = 0.3
    """Smallest share of its executions that a ranked candidate must have survived to be used, as a share of the best
    candidate's [1]."""
    most_candidates: int = 12
    """Stored candidates that the task works with [1]."""
    weights: CubeWeights = field(default_factory=CubeWeights)
    """Weights of the reward terms."""


@register_task("DoraCube-v1")
class CubeTask(Task):
    """Grasp a cube on a table with the five-fingered hand and lift it.

    **Randomisations:** position within +-8 cm and yaw, wherever the arm can carry out at least one stored candidate;
    size, mass, friction, candidate error, observation noise, delay and pushes by preset.

    **Stages:** reach (thumb and one fingertip within 3 cm of the cube), grasp (thumb and one more finger touch it for
    0.15 s), lift (>= 10 cm above its start, held by thumb and one more finger, off the table, for 0.5 s).

    **Success:** all stages done, and no overlap above 3 mm in the whole episode.

    **Failure:** the cube falls off the table or is knocked more than 60 cm away.
    """

    CONFIG = CubeConfig
    ARMS: ClassVar[Mapping[str, ArmSpec]] = {"arm": ArmSpec("cube")}
    DRAWS = STANDING_DRAWS
    MAX_STEPS = 100
    CAMERAS: ClassVar[Mapping[str, CameraSpec]] = {
        "hand_camera": HAND_CAMERA,
        "front_camera": CameraSpec(eye=(0.95, -0.6, 0.28), target=(0.53, 0.0, 0.18), fov=0.8),
    }
    LEARNERS: ClassVar[Mapping[str, Mapping[str, Any]]] = {
        "sac": {
            "total_steps": 300_000, "stop_success": 0.99, "num_envs": 32, "eval_every": 50_000, "eval_episodes": 50,
            "eval_envs": 50,
        },
        "ppo": {
            "total_steps": 300_000, "stop_success": 0.99, "num_envs": 64, "eval_every": 40_000, "eval_episodes": 50,
            "eval_envs": 50, "learner": {"rollout": 16, "log_std": -1.0},
        },
    }  # fmt: skip

    def make_mdp(self, scene: TaskScene) -> Mdp[Snapshot]:
        c: CubeConfig = self.config
        return Mdp(stages(c), terms(c), paper_terms(c), c.penetration_limit, OBSERVATIONS)

    def candidates(self, arm: str, region: bool = True) -> GraspCandidates:
        c: CubeConfig = self.config
        if region and not c.optimised:
            return hand_made_candidates()
        return best_candidates("cube", CLASS, c.fewest_lifts, c.most_candidates, region)

    def start_grid(self, arm: str) -> Grid:
        return Grid(self.config.centre, (self.config.spread,) * 2)

    def build(self, scene: TaskScene, name: str, scale: Float[np.ndarray, " n"]) -> Actor:
        """The cube as a box of uniform density."""
        return build_box(scene.scene, cube(), scale, RED, sapien.Pose([*self.config.centre, cube().support]))

    def place(self, scene: TaskScene, rows: Tensor, u: Tensor) -> None:
        """The cube stands on a face, somewhere in the area, at any yaw."""
        reachable = partial(self.startable, scene.arms["arm"])
        scene.object.set_pose(Pose.create_from_pq(*standing(u, scene.half[rows, 2], self.start_grid("arm"), reachable)))


OBSERVATIONS: dict[str, Entry] = {
    "half": Entry(lambda s: s.object.half[:, :1], "m", "half edge of the cube"),
    "surface": Entry(
        lambda s: box_distance(s), "m", "distance of each fingertip's surface from the cube's", True, region=True
    ),
}
"""What the task observes beyond the common entries."""


CLASS = "BodyGrasp"
"""The grasp class of all candidates: the cube has one region."""
REACH, GRASP, LIFT = range(3)
"""Indices of the stages."""
RED = (0.85, 0.25, 0.15, 1.0)
"""Colour of the cube, red, green, blue and opacity [1]."""


@cache
def cube() -> AffordanceObject:
    """The cube: mesh, mass, collision box."""
    return load_object("cube")


@derived
def _distance(s: Snapshot) -> Float[Tensor, " n"]:
    return thumb_and_finger(box_distance(s))


@derived
def held(s: Snapshot, c: CubeConfig) -> Bool[Tensor, " n"]:
    """Lifted, by thumb and finger, off the table."""
    return (lifted(s) > c.lift) & opposed(s) & ~s.object.supported


def stages(c: CubeConfig) -> list[Stage[Snapshot]]:
    """The sub-tasks, in order."""

    def lost(s: Snapshot) -> Tensor:
        return _distance(s) > c.lost

    return [
        Stage("reach", lambda s: _distance(s) < c.reach),
        Stage(
            "grasp",
            opposed,
            hold=c.touch_time,
            lost=lost,
            back_to="reach",
        ),
        Stage("lift", lambda s: held(s, c), hold=c.hold_time, lost=lost, back_to="reach"),
    ]


def terms(c: CubeConfig) -> Terms[Snapshot]:
    """The reward."""
    w = c.weights

    def near(s: Snapshot) -> Tensor:
        return tolerance(_distance(s), margin=0.25)

    def lift(s: Snapshot) -> Tensor:
        return rise(s, c.lift) * (0.3 + 0.7 * opposed(s).float())

    def clean(s: Snapshot) -> Tensor:
        return held(s, c) * without_overlap(s, c)

    return Terms(
        {
            "affordance": Term(
                lambda s: near_region(box_distance(s)), w.affordance, "affordance", True,
                "exp(-alpha * sum of fingertip distances)", region=True,
            ),
            "candidate": Term(
                lambda s: at_candidate(s, off_table(s)), w.candidate, "task", True,
                "closeness of the wrist to the candidate",
            ),
            "reach": Term(while_active(REACH, near), w.reach, doc="thumb and one finger near the cube; 1 afterwards"),
            "grasp": Term(
                while_active(GRASP, finger_contacts), w.grasp,
                doc="contacts: thumb against a finger, and how many fingers; 1 afterwards",
            ),
            "lift": Term(
                lambda s: torch.where(s.stage >= LIFT, lift(s), 0.0), w.lift,
                doc="rise, saturating at the target height, once it is grasped; less without thumb and finger",
            ),
            "held": Term(
                clean, w.held,
                doc=f"lifted, opposed, off the table, and no overlap above the limit so far{beyond_the_limit(c)}",
            ),
            **penalties(w, c.free_overlap, c.penetration_limit, c.overlap_range),
        }
    )  # fmt: skip


def paper_terms(c: CubeConfig) -> Terms[Snapshot]:
    """The printed reward."""
    affordance = paper_affordance(lambda s: s.object.p)
    return Terms({**affordance, **paper_grasp(2), **paper_lift(2, c.lift), **paper_penalty()})


PITCH = 0.892
"""Pitch of the wrist in the hand-made grasp [rad]: with 0 the fingers point along +x and the palm faces down."""
CUBE_IN_HAND = (0.061, 0.005, 0.168)
"""Centre of the cube in the hand frame in that grasp [m]."""
OPEN, CLOSED = (0.091, 0.052, 0.0, 0.358), (0.887, 0.215, 0.354, 0.0)
"""Proximal and medial joints of the four fingers, then of the thumb, before and after closing [rad]."""
THUMB_ABDUCTION = -0.003
"""Abduction of the thumb in that grasp [rad]."""


def hand_made_candidates(name: str = "cube") -> GraspCandidates:
    """One top grasp made by hand, turned by quarter turns about the vertical: the cube looks the same after each.

    The learner does better with it than with the stored set (docs/tasks/cube.md).
    """
    position, quaternion = [], []
    level = torch.tensor([cos(pi / 4), 0.0, sin(pi / 4), 0.0])
    pitch = torch.tensor([cos(PITCH / 2), 0.0, sin(PITCH / 2), 0.0])
    for quarter in range(4):
        yaw = torch.tensor([cos(quarter * pi / 4), 0.0, 0.0, sin(quarter * pi / 4)])
        turn = quaternion_multiply(quaternion_multiply(yaw, pitch), level)
        quaternion.append(turn)
        position.append(-quaternion_apply(turn, torch.tensor(CUBE_IN_HAND)))
    down = torch.tensor([0.0, 0.0, -1.0]).repeat(4, 1)
    pregrasp, grasp = (torch.tensor(_posture(p)).repeat(4, 1) for p in (OPEN, CLOSED))
    return GraspCandidates(
        name, torch.stack(position), torch.stack(quaternion), down, pregrasp, grasp, ("BodyGrasp",) * 4, robot=ROBOT,
        robot_digest=hand_digest(load_robot(ROBOT)),
    )  # fmt: skip


def _posture(fingers: tuple[float, float, float, float]) -> list[float]:
    proximal, medial, thumb_proximal, thumb_medial = fingers
    thumb = [THUMB_ABDUCTION, thumb_proximal, thumb_medial, thumb_medial]
    return thumb + [0.0, proximal, medial, medial] * 4
