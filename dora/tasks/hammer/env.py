"""DoraHammer-v1: catch a falling hammer, bring it over a nail, and drive the nail in."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import sapien
import torch
from jaxtyping import Bool, Float
from mani_skill.sensors.camera import CameraConfig
from mani_skill.utils import sapien_utils
from mani_skill.utils.registration import register_env
from mani_skill.utils.structs import Actor, Link, Pose
from torch import Tensor

from dora.affordance.bundled_sets import best_candidates
from dora.affordance.candidates import GraspCandidates
from dora.affordance.objects.catalogue import load_object
from dora.geometry.rotations import (
    quaternion_from_rotation_vector,
    quaternion_multiply,
    rotation_angle,
)
from dora.sim.actors import build_object
from dora.tasks.env.base import DoraEnv
from dora.tasks.guidance.reference import Reference
from dora.tasks.hammer.ballistics import Strike, relative
from dora.tasks.hammer.nail import Nail
from dora.tasks.hammer.reach import with_waiting_hand, within_reach
from dora.tasks.hammer.reference import CatchReference
from dora.tasks.hammer.rewards import PAPER_TERMS, PENETRATION_LIMIT, STAGES, TERMS
from dora.tasks.hammer.snapshot import (
    HammerSnapshot,
    face_to_nail,
    handle_axis,
    nail_in_hand,
    striking_axis,
    tip_distance,
)
from dora.tasks.mdp.observations import Entry
from dora.tasks.mdp.snapshot import Snapshot, turned_in_wrist

NAIL_TOP = (0.65, -0.14, 0.30)
"""Top of the undriven nail [m]."""
SWING_RADIUS = 0.36
"""Distance of the swing's axis from the nail [m]."""
FRICTION = 0.9
"""Nominal friction of the hammer; every episode sets its own."""
RELEASE = (0.50, -0.15, 0.60)
"""Middle of the open hand's grip, over which the hammer is released [m]."""
SPREAD = 0.04
"""Half width of the release's horizontal place [m]."""
FALL = (0.10, 0.25)
"""Height of the handle's lower end above the grip at the release [m]."""
TILT = 0.10
"""Largest tilt of the handle at the release about each horizontal axis [rad]."""
ROLL = 0.3
"""Largest turn about the handle at the release [rad]."""
SPIN = 0.5
"""Largest angular velocity at the release about each axis [rad/s]."""

WINDOW = 10
"""Control steps over which the hammer's motion in the hand is measured."""
FALLEN = 0.15
"""Height of the hammer's centre below which it has fallen [m]."""
UNKNOWN = 1e3
"""In-hand motion before the window is full [m]."""

CLASS = "HandleGrasp"
"""The grasp class that the task asks for."""
MOST = 24
"""Stored candidates that the task works with."""
FEWEST_CATCHES = 0.5
"""Share of executed episodes that a ranked candidate must have survived to be one of them."""


def _nail_axis(s: HammerSnapshot) -> Tensor:
    return turned_in_wrist(s, torch.tensor([0.0, 0.0, -1.0], device=s.wrist_p.device).expand_as(s.wrist_p))


def _axes(s: HammerSnapshot) -> Tensor:
    return torch.cat([striking_axis(s), handle_axis(s)], -1)


def _nail_depths(s: HammerSnapshot) -> Tensor:
    return torch.stack([s.nail_depth, s.nail_driven], -1) * 100


def _drifts(s: HammerSnapshot) -> Tensor:
    return torch.stack([s.drift_p.clamp(max=0.1) * 10, s.drift_r.clamp(max=1)], -1)


OBSERVATIONS: dict[str, Entry] = {
    "length": Entry(lambda s: s.object_half[:, 2:], "m", "half length of the hammer"),
    "nail": Entry(nail_in_hand, "m", "the nail's head in the hand frame"),
    "nail_depth": Entry(_nail_depths, "cm", "depth of the nail, and what of it was driven by blows"),
    "drift": Entry(_drifts, "dm, rad", "motion of the hammer in the hand within 10 steps"),
    "handle": Entry(tip_distance, "m", "distance of each fingertip's surface from the handle's", True),
    "face": Entry(face_to_nail, "m", "striking face to the nail's head, world frame", True),
    "axes": Entry(_axes, "1", "striking and handle axis, world frame", True),
    "nail_axis": Entry(_nail_axis, "1", "nail axis in the hand frame", True),
}
"""What the hammer task observes beyond the common entries; the guided ones are the affordance frame."""


@register_env("DoraHammer-v1", max_episode_steps=320)
class HammerEnv(DoraEnv):
    """Catch a falling hammer with the five-fingered hand, bring it over a nail, and drive the nail into its post.

    **Randomisations:** place (+-4 cm), height (10 to 30 cm above the grip), tilt, roll and spin of the hammer when it
    is released; size, mass, friction and candidate error by preset.

    **Stages:** catch (the handle is in the hand, touched by two fingers, slower than 0.5 m/s in it, for 3 steps),
    stabilise (moves less than 8 mm and 0.15 rad in the hand within 10 steps), orient (striking axis within 15 degrees
    of the nail axis and face within 15 mm above the nail, for 10 steps), strike (blows drive the nail 10 mm; what it
    sinks counts within 50 ms after an impact above 0.5 m/s).

    **Success:** all stages done, and no overlap above 5 mm in the whole episode.

    **Failure:** the hammer has fallen.
    """

    STAGES = STAGES
    TERMS = TERMS
    PAPER_TERMS = PAPER_TERMS
    EXTRA_OBSERVATIONS = OBSERVATIONS
    DRAWS = 9
    MAX_STEPS = 320
    PENETRATION_LIMIT = PENETRATION_LIMIT
    CONTROL_FREQUENCY = 40
    PHYSICS_FREQUENCY = 240
    SOLVER_ITERATIONS = 8
    CONTACT_OFFSET = 0.010
    CONTACT_EVERY_STEP = True
    HOME = "catch"
    OBJECT = "hammer"
    WRIST_SPEED = 1.5
    """Linear wrist speed of a full action [m/s]."""
    WRIST_SPIN = 6.0
    """Angular wrist speed of a full action [rad/s]."""

    @property
    def _default_human_render_camera_configs(self) -> CameraConfig:
        pose = sapien_utils.look_at(eye=[1.15, 0.65, 0.75], target=[0.48, -0.12, 0.42])
        return CameraConfig("render_camera", pose, width=640, height=640, fov=0.8, near=0.01, far=10)

    # ------------------------------------------------------------------ scene

    def _load_agent(self, options: dict, *args: Any, **kwargs: Any) -> None:
        super()._load_agent(options, *args, **kwargs)
        if self.agent.commands_wrist:
            self.agent.wrist_controller.set_motion(self.WRIST_SPEED, self.WRIST_SPIN, feed_forward=True)

    def candidates(self) -> GraspCandidates:
        return best_candidates("hammer", CLASS, FEWEST_CATCHES, MOST)

    def prepared(self, candidates: GraspCandidates) -> GraspCandidates:
        """The hand waits wide open, in the posture in which the arm starts."""
        return with_waiting_hand(candidates, self.agent.description, self.HOME)

    def reachable(self, object_p: Float[Tensor, "b 3"], object_q: Float[Tensor, "b 4"]) -> Bool[Tensor, "b c"]:
        """f_reach: which candidates the hand can wait with below a hammer that is released like this."""
        return within_reach(self.guide.choice.candidates, object_p, object_q, *self._home)

    def make_reference(self) -> Reference:
        points = torch.tensor(NAIL_TOP, device=self.device), self._points["face"]
        return CatchReference(self.num_envs, Strike(*points, SWING_RADIUS), 1 / self.CONTROL_FREQUENCY, self.device)

    def load_object(self, scale: np.ndarray) -> Actor:
        """Hammer and nail."""
        hammer = load_object("hammer")
        handle = hammer.region("handle").bounds
        x, y = handle.mean(0)[:2]
        factor = torch.tensor(scale, dtype=torch.float32, device=self.device)[:, None]
        points = {"face": hammer.centroid("face"), "butt": (x, y, handle[0, 2]), "neck": (x, y, handle[1, 2])}
        self._points = {
            name: factor * torch.tensor(np.asarray(p), dtype=torch.float32, device=self.device)
            for name, p in points.items()
        }
        self.object_half = factor * torch.tensor(hammer.mesh.extents / 2, dtype=torch.float32, device=self.device)
        offset = self.sim_config.scene_config.contact_offset
        actor = build_object(
            self.scene, hammer, scale=scale, friction=FRICTION, contact_offset=offset,
            pose=sapien.Pose([*RELEASE[:2], RELEASE[2] + 0.5]),
        )  # fmt: skip
        self.nail = Nail(self.scene, NAIL_TOP, 1 / self.sim_freq)
        self.nail.strike_with(actor, self._points["face"].cpu().numpy())
        self._history = torch.zeros(self.num_envs, WINDOW + 1, 7, device=self.device)
        return actor

    def world(self) -> Sequence[Actor | Link]:
        return [self.table, *self.nail.links]

    def place(self, env_idx: Tensor, u: Tensor) -> None:
        """Releases hammers (b,) over the grip and puts the nail back.

        `u` (b, 9) in [0, 1): x, y and height of the handle's lower end [m], tilt about x and y and roll [rad], spin
        [rad/s], world frame.
        """
        u = 2 * u - 1
        height = (FALL[0] + FALL[1]) / 2 + u[:, 2] * (FALL[1] - FALL[0]) / 2
        middle = torch.tensor(RELEASE, device=self.device).repeat(len(env_idx), 1)
        middle[:, :2] += SPREAD * u[:, :2]
        middle[:, 2] += height - self._points["butt"][env_idx, 2]
        zero = torch.zeros_like(height)
        tilt = quaternion_from_rotation_vector(TILT * torch.stack([u[:, 3], u[:, 4], zero], -1))
        roll = quaternion_from_rotation_vector(ROLL * torch.stack([zero, zero, u[:, 5]], -1))
        self.target_object.set_pose(Pose.create_from_pq(middle, quaternion_multiply(tilt, roll)))
        self.target_object.set_linear_velocity(torch.zeros_like(middle))
        self.target_object.set_angular_velocity(SPIN * u[:, 6:9])
        self.nail.begin(env_idx)
        self._history[env_idx] = UNKNOWN

    # ---------------------------------------------------------------- reading

    def extended(self, s: Snapshot) -> HammerSnapshot:
        """The snapshot with the nail (top in the world, depth [m]), points of the hammer, its motion in the hand."""
        depth = self.nail.depth
        nail_p = torch.tensor(NAIL_TOP, device=self.device).repeat(self.num_envs, 1)
        nail_p[:, 2] -= depth
        drift_p, drift_r = self._drift(s)
        known = {k: v for k, v in vars(s).items() if not k.startswith("_")}
        return HammerSnapshot(
            **known, nail_p=nail_p, nail_depth=depth, nail_driven=self.nail.driven, drift_p=drift_p, drift_r=drift_r,
            **self._points,
        )  # fmt: skip

    def _drift(self, s: Snapshot) -> tuple[Float[Tensor, " n"], Float[Tensor, " n"]]:
        """Motion of the hammer in the hand within the window; notes the pose of this control step."""
        rows, step = torch.arange(self.num_envs, device=self.device), (s.time * self.MAX_STEPS).round().long()
        p, q = relative((s.wrist_p, s.wrist_q), (s.object_p, s.object_q))
        self._history[rows, step % (WINDOW + 1)] = torch.cat([p, q], -1)
        old_p, old_q = self._history[rows, (step + 1) % (WINDOW + 1)].split([3, 4], -1)
        known = old_p[:, 0] < UNKNOWN
        drift_r = rotation_angle(torch.where(known[:, None], old_q, q), q)
        return (p - old_p).norm(dim=-1), torch.where(known, drift_r, UNKNOWN)

    def failed(self, s: Snapshot) -> Tensor:
        """(n,) bool: the hammer has fallen."""
        return s.object_p[:, 2] < FALLEN

    # ------------------------------------------------------------------ state

    def get_state_dict(self) -> dict:
        return super().get_state_dict() | {
            "nail": self.nail.get_state() | {"history": self._history.flatten(1).clone()}
        }

    def set_state_dict(self, state: dict, env_idx: Tensor | None = None) -> None:
        super().set_state_dict(state, env_idx)
        if "nail" in state:
            rows = torch.arange(self.num_envs, device=self.device) if env_idx is None else env_idx
            self.nail.set_state(state["nail"], rows)
            self._history[rows] = state["nail"]["history"].reshape(-1, WINDOW + 1, 7)
