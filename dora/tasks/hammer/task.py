"""DoraHammer-v1: its numbers, its scene with the nail, how hammers are released, and what it observes."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from math import pi
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
import sapien
import torch
import tyro
from jaxtyping import Bool, Float, Int
from mani_skill.utils.structs import Actor, Link, Pose
from torch import Tensor

from dora.affordance.bundled_sets import best_candidates
from dora.affordance.candidates import GraspCandidates
from dora.affordance.objects.catalogue import load_object
from dora.geometry.poses import Pose as HandPose
from dora.geometry.poses import relative
from dora.geometry.rotations import quaternion_from_rotation_vector, quaternion_multiply, rotation_angle
from dora.robot import RobotDescription
from dora.sim.cameras import CameraSpec
from dora.sim.shapes import DrawnShape
from dora.tasks.env.arm import Arm, ArmSpec, start_posture
from dora.tasks.env.registration import register_task
from dora.tasks.env.scene import TaskScene
from dora.tasks.env.starts import ChosenStarts, StartNumber
from dora.tasks.env.task import HAND_CAMERA, Task
from dora.tasks.guidance.reference import Reference
from dora.tasks.hammer.ballistics import Strike
from dora.tasks.hammer.finger_motion import load_motion
from dora.tasks.hammer.mdp import HELD, failed, in_hand, paper_terms, stages, strike_stage, terms
from dora.tasks.hammer.nail import Nail, NailSettings, drawn_links
from dora.tasks.hammer.observations import OBSERVATIONS, TURN_OBSERVATIONS
from dora.tasks.hammer.reach import with_waiting_hand, within_reach
from dora.tasks.hammer.reference import CatchReference, CatchSettings
from dora.tasks.hammer.snapshot import HammerSnapshot, fingers_on
from dora.tasks.hammer.turning import (
    TurnSettings,
    number_of_roll,
    roll_at_release,
    turn_about_handle,
    turned_copies,
)
from dora.tasks.mdp.buffers import Buffers
from dora.tasks.mdp.config import PenaltyWeights, TaskConfig
from dora.tasks.mdp.mdp import Mdp
from dora.tasks.mdp.snapshot import Snapshot, extended

CLASS = "HandleGrasp"
"""The grasp class that the task asks for."""
UNKNOWN = 1e3
"""Motion in the hand before the window is full [m]."""
ROLL = 5
"""Which of the random numbers of a start is the turn about the handle."""


@dataclass(frozen=True, kw_only=True)
class HammerWeights(PenaltyWeights):
    """Weights of the reward terms."""

    affordance: float = 0.2
    """Fingertips near the handle [1]."""
    candidate: float = 0.3
    """Wrist at the candidate [1]."""
    catch: float = 0.4
    """Handle in the hand [1]."""
    still: float = 0.4
    """No motion of the hammer in the hand [1]."""
    orient: float = 1.0
    """Hammer over the nail, face down [1]."""
    strike: float = 2.0
    """Depth driven by blows [1]."""
    driven: float = 1.5
    """The nail is driven in [1]."""


@dataclass(frozen=True, kw_only=True)
class HammerConfig(TaskConfig):
    """Numbers of the task."""

    definition: Annotated[int, tyro.conf.Suppress] = 2
    """2: a blow counts as far as momentum would drive, and a hammer that is not held strikes none (November 2026)."""
    control_frequency: int = 40
    """Control steps per second [Hz]."""
    physics_frequency: int = 240
    """Physics steps per second [Hz]; a multiple of the control frequency."""
    solver_iterations: int = 8
    """PhysX position iterations [1]."""
    persistent_contacts: bool = False
    """PhysX keeps contact points from step to step (PCM); the fast fingers and hammer pass through each other."""
    contact_offset: float = 0.010
    """PhysX's contact offset of the objects, and of every body without its own [m]."""
    release: tuple[float, float, float] = (0.50, -0.15, 0.60)
    """Middle of the open hand, over which the hammer is released [m]."""
    spread: float = 0.04
    """Half width of the release's horizontal place [m]."""
    fall: tuple[float, float] = (0.10, 0.25)
    """Height of the handle's lower end above that point at the release [m]."""
    tilt: float = 0.10
    """Largest tilt of the handle at the release about each horizontal axis [rad]."""
    roll: float = 0.3
    """Largest turn about the handle at the release [rad]."""
    spin: float = 0.5
    """Largest angular velocity at the release about each axis [rad/s]."""
    window: float = 0.25
    """Time over which the hammer's motion in the hand is measured [s]."""
    in_hand: float = 0.07
    """Distance of the handle's axis from the middle of the hand up to which the hammer is in the hand [m]."""
    caught_speed: float = 0.5
    """Speed of the hammer in the hand below which it has been caught [m/s]."""
    caught_time: float = 0.075
    """Time for which it must be so [s]."""
    still: tuple[float, float] = (0.008, 0.15)
    """Motion within the window up to which the hammer is held still [m], [rad]."""
    aligned: float = pi / 12
    """Angle between striking axis and nail axis up to which the hammer is oriented [rad]."""
    beside: float = 0.015
    """Horizontal distance of the striking face from the nail up to which it is over the nail [m]."""
    height: tuple[float, float] = (-0.005, 0.15)
    """Height of the face above the nail between which it counts as over the nail [m]."""
    hold_time: float = 0.25
    """Time for which the hammer must be held over the nail [s]."""
    lost: float = 0.12
    """Distance of the handle from the middle of the hand at which the hammer is lost [m]."""
    fallen: float = 0.15
    """Height of the hammer's centre below which it has fallen [m]."""
    free_overlap: float = 0.001
    """Overlap that costs no reward [m]."""
    after_overlap: float = 0.3
    """Share of what blows earn that is left once an overlap was above the limit [1]."""
    reorient: Literal["wrist", "in_hand"] = "wrist"
    """What re-orients the caught hammer: the wrist alone, or first the fingers, for which it arrives turned about its
    handle."""
    turn: TurnSettings = field(default_factory=TurnSettings)
    """Numbers of the re-orientation in the hand."""
    swing_radius: float = 0.36
    """Distance of the swing's axis from the nail [m]."""
    fewest_catches: float = 0.55
    """Smallest share of its executions that a ranked candidate must have survived to be used, as a share of the best
    candidate's [1]."""
    most_candidates: int = 24
    """Stored candidates that the task works with [1]."""
    nail: NailSettings = field(default_factory=NailSettings)
    """Numbers of the nail."""
    reference: CatchSettings = field(default_factory=CatchSettings)
    """Numbers of the reference."""
    weights: HammerWeights = field(default_factory=HammerWeights)
    """Weights of the reward terms."""

    @property
    def in_hand_turn(self) -> bool:
        """Whether the fingers re-orient the hammer."""
        return self.reorient == "in_hand"


@register_task("DoraHammer-v1")
class HammerTask(Task):
    """Catch a falling hammer with the five-fingered hand, bring it over a nail, and drive the nail into its post.

    **Randomisations:** place (+-4 cm), height (10 to 25 cm above the hand), tilt, roll and spin of the hammer when it
    is released; size, mass, friction and candidate error by preset.

    **Stages:** catch (the handle is in the hand, touched by two fingers, slower than 0.5 m/s in it, for 0.075 s),
    stabilise (moves less than 8 mm and 0.15 rad in the hand within 0.25 s), orient (striking axis within 15 degrees
    of the nail axis, face within 15 mm of that axis and 5 mm below to 15 cm above the head, for 0.25 s), strike
    (blows drive the nail 10 mm: its motion within 50 ms after an impact of the striking face on its head above 0.5
    m/s counts, as far as the momentum of hammer and hand would drive it, while nothing else touches the nail and two
    fingers hold the hammer).

    With `reorient="in_hand"` the hammer arrives turned about its handle by 45 to 90 degrees, and a stage turn comes
    before orient: the fingers have turned it by 40 degrees in the hand, towards the blow.

    **Success:** all stages done, and no overlap above 5 mm in the whole episode.

    **Failure:** the hammer has fallen.
    """

    CONFIG = HammerConfig
    ARMS: ClassVar[Mapping[str, ArmSpec]] = {"arm": ArmSpec("hammer", home="catch")}
    DRAWS = 9
    MAX_STEPS = 320
    CONTACT_EVERY_STEP = True
    WRIST_MOTION = (1.5, 6.0)
    CAMERA = ((1.15, 0.65, 0.75), (0.48, -0.12, 0.42))
    CAMERAS: ClassVar[Mapping[str, CameraSpec]] = {
        "hand_camera": HAND_CAMERA,
        "front_camera": CameraSpec(eye=(1.25, 0.5, 0.7), target=(0.48, -0.1, 0.5), fov=0.95),
    }
    LEARNERS: ClassVar[Mapping[str, Mapping[str, Any]]] = {
        "sac": {
            "total_steps": 300_000, "stop_success": 0.97, "num_envs": 32, "eval_every": 75_000, "eval_episodes": 100,
            "eval_envs": 50, "after_success": 20,
        },
        "ppo": {
            "total_steps": 600_000, "stop_success": 0.97, "num_envs": 64, "eval_every": 150_000, "eval_episodes": 100,
            "eval_envs": 50, "after_success": 20, "learner": {"rollout": 32, "log_std": -1.8},
        },
    }  # fmt: skip

    nail: Nail
    points: dict[str, Float[Tensor, "n 3"]]
    """Centre of the striking face, and ends of the handle's axis, in the hammer's frame [m]."""
    history: Buffers
    """Poses of the hammer in the hand within the window."""
    turning: Buffers
    """Orientation of the hammer in the hand when it was held still (`held`), and which way the fingers turn it
    (`way`)."""

    def make_mdp(self, scene: TaskScene) -> Mdp[HammerSnapshot]:
        c: HammerConfig = self.config
        entries = OBSERVATIONS | (TURN_OBSERVATIONS if c.in_hand_turn else {})
        judged = stages(c), terms(c), paper_terms(c), c.penetration_limit, entries, partial(failed, c=c)
        return Mdp(*judged, "the hammer has fallen")

    def candidates(self, arm: str, region: bool = True) -> GraspCandidates:
        return best_candidates("hammer", CLASS, self.config.fewest_catches, self.config.most_candidates, region)

    def held(self, s: HammerSnapshot, arm: str) -> Bool[Tensor, " n"]:
        """Two fingers touch the hammer, which has not fallen."""
        return (fingers_on(s) >= 2) & (s.object.p[:, 2] > self.config.fallen)

    def adapted(self, candidates: GraspCandidates, arm: str, robot: RobotDescription) -> GraspCandidates:
        """The hand waits wide open, in the posture in which the arm starts; for a hammer that arrives turned also with
        grasps that are turned against that."""
        c: HammerConfig = self.config
        wanted = turned_copies(candidates, handle_place(), c.turn) if c.in_hand_turn else candidates
        return with_waiting_hand(wanted, robot, start_posture(self.ARMS[arm]))

    def reachable(
        self, arm: Arm, rows: Int[Tensor, " b"], object_p: Float[Tensor, "b 3"], object_q: Float[Tensor, "b 4"]
    ) -> Bool[Tensor, "b c"]:
        """f_reach: which candidates the hand can wait with below a hammer that is released like this."""
        return within_reach(arm.guide.choice.candidates, object_p, object_q, *arm.home)

    def make_reference(self, scene: TaskScene, arm: str) -> Reference:
        c: HammerConfig = self.config
        strike = Strike(torch.tensor(c.nail.top, device=scene.device), self.points["face"], c.swing_radius)
        motion = load_motion(self.ARMS[arm].object, scene.robots[arm]) if c.in_hand_turn else None
        return CatchReference(scene.num_envs, strike, c.nail.driven, c.dt, scene.device, c.reference, motion)

    def build(self, scene: TaskScene, name: str, scale: Float[np.ndarray, " n"]) -> Actor:
        """Hammer and nail."""
        c, hammer = self.config, load_object(name)
        handle, (x, y) = hammer.region("handle").bounds, handle_place()
        factor = torch.tensor(scale, dtype=torch.float32, device=scene.device)[:, None]
        points = {"face": hammer.centroid("face"), "butt": (x, y, handle[0, 2]), "neck": (x, y, handle[1, 2])}
        self.points = {
            key: factor * torch.tensor(np.asarray(p), dtype=torch.float32, device=scene.device)
            for key, p in points.items()
        }
        above = sapien.Pose([*c.release[:2], c.release[2] + 0.5])
        actor = scene.build(name, scale, pose=above)
        self.nail = Nail(scene.scene, c.nail, 1 / c.physics_frequency)
        radii = np.ptp(hammer.region("face").vertices, axis=0)[2] / 2 * scale
        self.nail.strike_with(actor, self.points["face"].cpu().numpy(), radii)
        self.history = Buffers(scene.num_envs, scene.device, history=(1 + round(c.window / c.dt), 7))
        self.turning = Buffers(scene.num_envs, scene.device, held=(4,), way=())
        self.turning.held[:, 0] = 1.0
        return actor

    def world(self, scene: TaskScene) -> Sequence[Actor | Link]:
        return [scene.table, *self.nail.links]

    def place(self, scene: TaskScene, rows: Tensor, u: Tensor) -> None:
        """Releases hammers (b,) over the hand and puts the nail back.

        `u` (b, 9) in [0, 1): x, y and height of the handle's lower end [m], tilt about x and y and roll [rad], spin
        [rad/s], world frame.
        """
        c, u = self.config, 2 * u - 1
        height = (c.fall[0] + c.fall[1]) / 2 + u[:, 2] * (c.fall[1] - c.fall[0]) / 2
        middle = torch.tensor(c.release, device=scene.device).repeat(len(rows), 1)
        middle[:, :2] += c.spread * u[:, :2]
        middle[:, 2] += height - self.points["butt"][rows, 2]
        zero = torch.zeros_like(height)
        tilt = quaternion_from_rotation_vector(c.tilt * torch.stack([u[:, 3], u[:, 4], zero], -1))
        angle = roll_at_release(u[:, ROLL], c.turn) if c.in_hand_turn else c.roll * u[:, ROLL]
        roll = quaternion_from_rotation_vector(torch.stack([zero, zero, angle], -1))
        scene.object.set_pose(Pose.create_from_pq(middle, quaternion_multiply(tilt, roll)))
        scene.object.set_linear_velocity(torch.zeros_like(middle))
        scene.object.set_angular_velocity(c.spin * u[:, 6:9])
        self.nail.begin(rows)
        self._forget(rows)
        self.turning.write(rows, way=-angle.sign() if c.in_hand_turn else 0.0)

    def begin_in_place(self, scene: TaskScene, rows: Tensor) -> None:
        """The nail is as deep as it is, and no blow has driven it."""
        self.nail.begin(rows, pulled=False)
        self._forget(rows)

    def _forget(self, rows: Tensor) -> None:
        """Nothing is known yet of where the hammers were, and how they lie in the hand."""
        self.history.write(rows, history=UNKNOWN)
        self.turning.write(rows, held=torch.tensor([1.0, 0.0, 0.0, 0.0], device=rows.device))

    def starts(self) -> ChosenStarts:
        """Place, height, tilt, roll and spin of the hammer when it is released: the random numbers themselves."""
        c: HammerConfig = self.config
        middles = zip("xy", c.release[:2], strict=True)
        place = [StartNumber(f"release {n}", "m", x - c.spread, x + c.spread) for n, x in middles]
        roll = c.turn.arrives[1] if c.in_hand_turn else c.roll
        turns = [StartNumber(n, "rad", -w, w) for n, w in (("tilt x", c.tilt), ("tilt y", c.tilt), ("roll", roll))]
        spins = [StartNumber(f"spin {n}", "rad/s", -c.spin, c.spin) for n in "xyz"]
        numbers = (*place, StartNumber("fall", "m", *c.fall), *turns, *spins)
        if not c.in_hand_turn:
            return ChosenStarts(numbers, lambda shares: shares, lambda u, pose: u)

        def draws(shares: Tensor) -> Tensor:
            number = number_of_roll(float(2 * shares[ROLL] - 1) * roll, c.turn)
            return torch.cat([shares[:ROLL], shares.new_tensor([(number + 1) / 2]), shares[ROLL + 1 :]])

        def shares(u: Tensor, pose: Any) -> Tensor:
            angle = roll_at_release(2 * u[ROLL : ROLL + 1] - 1, c.turn)
            return torch.cat([u[:ROLL], (angle / roll + 1) / 2, u[ROLL + 1 :]])

        return ChosenStarts(numbers, draws, shares)

    def drawn(self, scene: TaskScene) -> Mapping[str, tuple[Actor | Link, tuple[DrawnShape, ...]]]:
        """The table, the post and the nail."""
        links = zip(("post", "nail"), self.nail.links, drawn_links(self.config.nail), strict=True)
        return {**super().drawn(scene), **{name: (link, shapes) for name, link, shapes in links}}

    # ------------------------------------------------------------------ reading

    def extended(self, s: Snapshot) -> HammerSnapshot:
        """The snapshot with the nail (top in the world, depth [m]), points of the hammer, its motion in the hand."""
        depth = self.nail.depth
        nail_p = torch.tensor(self.config.nail.top, device=depth.device).repeat(len(depth), 1)
        nail_p[:, 2] -= depth
        pose = in_the_hand(s)
        drift_p, drift_r = self._drift(s, pose)
        turned = self._turned(s, pose[1]) if self.config.in_hand_turn else torch.zeros_like(depth)
        return extended(
            s, HammerSnapshot, nail_p=nail_p, nail_depth=depth, nail_driven=self.nail.driven,
            drift_p=drift_p, drift_r=drift_r, turned=turned, way=self.turning.way.clone(), **self.points,
        )  # fmt: skip

    def _turned(self, s: Snapshot, now: Float[Tensor, "n 4"]) -> Float[Tensor, " n"]:
        """How far the fingers have turned the hammer the right way since it was held [rad]; `now`: its orientation in
        the hand."""
        return torch.where(s.stage >= HELD, self.turning.way * turn_about_handle(self.turning.held, now), 0.0)

    def _drift(self, s: Snapshot, pose: HandPose) -> tuple[Float[Tensor, " n"], Float[Tensor, " n"]]:
        """Motion of the hammer in the hand, where its pose is now `pose`, since the beginning of the window [m], [rad];
        UNKNOWN before it is full."""
        history = self.history.history
        rows, oldest = torch.arange(len(history), device=history.device), (self._step(s) + 1) % history.shape[1]
        p, q = pose
        old_p, old_q = history[rows, oldest].split([3, 4], -1)
        known = old_p[:, 0] < UNKNOWN
        drift_r = rotation_angle(torch.where(known[:, None], old_q, q), q)
        return (p - old_p).norm(dim=-1), torch.where(known, drift_r, UNKNOWN)

    def remember(self, s: Snapshot) -> None:
        """Notes the pose of the hammer in the hand in the present control step, and whether it is held to strike."""
        assert isinstance(s, HammerSnapshot)
        self.nail.let_strike((s.stage >= strike_stage(self.config)) & in_hand(s, self.config))
        history = self.history.history
        rows, now = torch.arange(len(history), device=history.device), self._step(s) % history.shape[1]
        position, quaternion = in_the_hand(s)
        history[rows, now] = torch.cat([position, quaternion], -1)
        if self.config.in_hand_turn:
            self.turning.update(held=torch.where((s.stage < HELD)[:, None], quaternion, self.turning.held))

    def _step(self, s: Snapshot) -> Tensor:
        """Number of the control step in its episode (n,)."""
        return (s.time * self.MAX_STEPS).round().long()

    def stateful(self) -> dict[str, Any]:
        turning = {"turning": self.turning} if self.config.in_hand_turn else {}
        return {"nail": self.nail, "history": self.history, **turning}


def in_the_hand(s: Snapshot) -> HandPose:
    """Pose of the hammer relative to the hand: (n, 3) [m] and (n, 4)."""
    return relative((s.hand.wrist_p, s.hand.wrist_q), (s.object.p, s.object.q))


def handle_place() -> tuple[float, float]:
    """x and y of the handle's axis in the hammer's frame [m]."""
    x, y = load_object("hammer").region("handle").bounds.mean(0)[:2]
    return float(x), float(y)
