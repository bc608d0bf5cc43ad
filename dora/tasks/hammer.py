"""DoraHammer-v1: catch a falling hammer, bring it over a nail, and drive the nail in."""

from collections.abc import Sequence
from dataclasses import replace
from math import pi
from typing import Any, ClassVar, cast

import numpy as np
import sapien
import torch
from jaxtyping import Bool, Float
from mani_skill.sensors.camera import CameraConfig
from mani_skill.utils import sapien_utils
from mani_skill.utils.registration import register_env
from mani_skill.utils.structs import Actor, Link, Pose
from torch import Tensor

from dora.affordance.candidates import GraspCandidates
from dora.affordance.objects import load_object
from dora.robot.rotations import (
    quaternion_from_matrix,
    quaternion_from_rotation_vector,
    quaternion_multiply,
    rotation_angle,
)
from dora.sim.objects import build_object
from dora.tasks.base import DoraEnv
from dora.tasks.catching import CatchReference
from dora.tasks.hammer_snapshot import (
    GRIP,
    IN_HAND,
    HammerSnapshot,
    face_to_nail,
    fingers_on,
    grip_distance,
    handle_axis,
    misalignment,
    nail_in_hand,
    relative_speed,
    striking_axis,
    tip_distance,
)
from dora.tasks.hammering import Strike, relative
from dora.tasks.nail import DRIVEN, Nail
from dora.tasks.observations import Entry
from dora.tasks.reference import Reference
from dora.tasks.rewards import Term, Terms, closeness
from dora.tasks.snapshot import Snapshot, goal_error, turned_in_wrist
from dora.tasks.stages import Stage

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
TILT = 0.15
"""Largest tilt of the handle at the release about each horizontal axis [rad]."""
ROLL = 0.3
"""Largest turn about the handle at the release [rad]."""
SPIN = 0.8
"""Largest angular velocity at the release about each axis [rad/s]."""

CAUGHT_SPEED = 0.5
"""Speed of the hammer in the hand below which it has been caught [m/s]."""
WINDOW = 10
"""Control steps over which the hammer's motion in the hand is measured."""
STILL = (0.008, 0.15)
"""Motion within the window up to which the hammer is held still [m], [rad]."""
ALIGNED = pi / 12
"""Angle between striking axis and nail axis up to which the hammer is oriented [rad]."""
ABOVE = 0.015
"""Horizontal distance of the striking face from the nail up to which it is above the nail [m]."""
HEIGHT = (-0.005, 0.15)
"""Height of the face above the nail between which it counts as above [m]."""
HOLD = 10
"""Control steps the hammer must be held over the nail."""
DROPPED = 0.12
"""Distance of the handle from the middle of the grip at which the hammer is lost [m]."""
FALLEN = 0.15
"""Height of the hammer's centre below which it has fallen [m]."""
UNKNOWN = 1e3
"""In-hand motion before the window is full [m]."""
ALPHA = 4.0
"""Spatial sensitivity of the affordance reward [1/m]."""


def _in_hand(s: HammerSnapshot) -> Tensor:
    return (grip_distance(s) < IN_HAND) & (fingers_on(s) >= 2)


def _caught(s: HammerSnapshot) -> Tensor:
    return _in_hand(s) & (relative_speed(s) < CAUGHT_SPEED)


def _still(s: HammerSnapshot) -> Tensor:
    return _in_hand(s) & (s.drift_p < STILL[0]) & (s.drift_r < STILL[1])


def _above(s: HammerSnapshot) -> Tensor:
    away = face_to_nail(s)
    return (away[:, :2].norm(dim=-1) < ABOVE) & (-away[:, 2] > HEIGHT[0]) & (-away[:, 2] < HEIGHT[1])


def _oriented(s: HammerSnapshot) -> Tensor:
    return _in_hand(s) & (misalignment(s) < ALIGNED) & _above(s)


def _lost(s: HammerSnapshot) -> Tensor:
    return grip_distance(s) > DROPPED


def _depth(s: HammerSnapshot) -> Tensor:
    return (s.nail_driven / DRIVEN).clamp(0, 1)


def _steadiness(s: HammerSnapshot) -> Tensor:
    return _in_hand(s) * closeness(s.drift_p, STILL[0], 0.05) * closeness(s.drift_r, STILL[1], 0.5)


def _poise(s: HammerSnapshot) -> Tensor:
    turn = closeness(misalignment(s), 0.0, pi)
    return turn * closeness(face_to_nail(s).norm(dim=-1), 0.05, 0.6)


STAGES: list[Stage[HammerSnapshot]] = [
    Stage("catch", lambda s: closeness(grip_distance(s), 0.02, 0.3), _caught, hold=3),
    Stage("stabilise", _steadiness, _still, lost=_lost, back_to="catch"),
    Stage("orient", _poise, _oriented, hold=HOLD, lost=_lost, back_to="catch"),
    Stage("strike", _depth, lambda s: s.nail_driven >= DRIVEN, lost=_lost, back_to="catch"),
]
ORIENT, STRIKE = 2, 3


def _affordance(s: HammerSnapshot) -> Tensor:
    return torch.exp(-ALPHA * tip_distance(s).clamp(min=0).sum(-1))


def _candidate(s: HammerSnapshot) -> Tensor:
    shift, turn = goal_error(s)
    near = closeness(shift.norm(dim=-1) + 0.1 * turn.norm(dim=-1), 0.01, 0.2)
    return torch.where(s.stage >= ORIENT, torch.ones_like(near), near)


def _catch(s: HammerSnapshot) -> Tensor:
    return closeness(grip_distance(s), 0.02, 0.3) * (0.5 + 0.1 * fingers_on(s))


def _orient(s: HammerSnapshot) -> Tensor:
    held = _in_hand(s) & (s.stage >= ORIENT)
    return torch.where(s.stage > STRIKE, 1.0, held * _poise(s))


def _kept(s: HammerSnapshot) -> Tensor:
    return torch.where(s.stage > STRIKE, 1.0, _steadiness(s))


def _clean(s: HammerSnapshot) -> Tensor:
    return ((s.nail_driven >= DRIVEN) & (s.stage > STRIKE) & (s.deepest <= DoraEnv.DEEPEST)).float()


def _deep(s: Snapshot) -> Tensor:
    return ((s.penetration - 0.001) / DoraEnv.DEEPEST).clamp(0, 1)


def _effort(s: Snapshot) -> Tensor:
    return s.action.square().mean(-1).clamp(max=1)


def _change(s: Snapshot) -> Tensor:
    return ((s.action - s.previous_action).square().mean(-1) / 4).clamp(max=1)


TERMS: Terms[HammerSnapshot] = Terms(
    {
        "affordance": Term(_affordance, 0.2, "affordance", True, "exp(-alpha * sum of fingertip distances to the handle)"),
        "candidate": Term(_candidate, 0.3, "task", True, "closeness of the wrist to the candidate until the hammer is held"),
        "catch": Term(_catch, 0.4, doc="handle near the middle of the grip, and fingers on it"),
        "still": Term(_kept, 0.4, doc="the hammer does not move in the hand"),
        "orient": Term(_orient, 1.0, doc="closeness of theta, the angle from striking axis to nail axis, and of the face to the nail"),
        "strike": Term(_depth, 2.0, doc="depth driven by blows, saturating at the target depth"),
        "driven": Term(_clean, 1.5, doc="all stages done, and no overlap above 5 mm so far"),
        "effort": Term(_effort, -0.05, "penalty", doc="mean square of the action"),
        "change": Term(_change, -0.4, "penalty", doc="mean square of the action's change"),
        "penetration": Term(_deep, -1.0, "penalty", doc="overlap beyond 1 mm"),
    }
)


def _paper_affordance(s: HammerSnapshot) -> Tensor:
    centre = s.object_p + (s.butt + s.neck) / 2
    return torch.exp(-ALPHA * (s.tip_p - centre[:, None]).norm(dim=-1).sum(-1))


PAPER_TERMS: Terms[HammerSnapshot] = Terms(
    {
        "affordance": Term(_paper_affordance, 1.0, "affordance", True, "exp(-alpha sum ||p_tip - p_afford||)"),
        "grasp": Term(
            lambda s: torch.exp((s.wrist_p - s.goal_p)[:, 2].clamp(max=0)) * (s.stage < ORIENT),
            1.0,
            guided=True,
            doc="exp(z_current - z_candidate), z clipped at the candidate",
        ),
        "orient": Term(
            lambda s: (1 - misalignment(s) / pi) * (s.stage >= ORIENT),
            1.0,
            doc="-theta with theta = arccos(2 <r, r*>^2 - 1), the rotation left, over pi and plus one",
        ),
        "strike": Term(_depth, 1.0, doc="depth driven by blows"),
        "penalty": Term(_effort, -0.1, "penalty", doc="sum of action^2"),
    }
)

# One power grasp around the handle, found by a cross-entropy search over catches, until the optimiser's candidates
# replace it: where the hand holds the handle, the hand's axes in the hammer frame, and finger postures (proximal, medial
# of the four fingers and of the thumb).
HELD_AT = (-0.0028, 0.0, -0.102)
"""Point of the handle's axis in the middle of the hand [m], hammer frame."""
HELD_IN = (0.043, 0.0, 0.115)
"""The same point in the hand frame [m]."""
OPEN = (0.521, 0.537, 0.146, 0.237)
CLOSED = (1.350, 1.025, 0.915, 0.747)
"""[rad]"""
THUMB_ABDUCTION = 0.119
"""[rad]"""
HAND_AXES = ((0.0, 0.0, 1.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0))
"""Rows of the rotation from the hand to the hammer: fingers along the strike, thumb towards the head."""


def _posture(fingers: tuple[float, float, float, float]) -> Tensor:
    proximal, medial, thumb_proximal, thumb_medial = fingers
    thumb = [THUMB_ABDUCTION, thumb_proximal, thumb_medial, thumb_medial]
    return torch.tensor(thumb + [0.0, proximal, medial, medial] * 4)[None]


def hand_made_candidates() -> GraspCandidates:
    """One grasp with the palm on the handle's side, so that the fingers point in the direction of the strike."""
    axes = torch.tensor(HAND_AXES)
    position = torch.tensor(HELD_AT) - axes @ torch.tensor(HELD_IN)
    return GraspCandidates(
        "hammer", position[None], quaternion_from_matrix(axes)[None], axes[None, :, 0],
        _posture(OPEN), _posture(CLOSED), ("HandleGrasp",),
    )  # fmt: skip


@register_env("DoraHammer-v1", max_episode_steps=400)
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
    EXTRA_OBSERVATIONS: ClassVar[dict[str, Entry]] = {
        "length": Entry(lambda s: s.object_half[:, 2:], "m", "half length of the hammer"),
        "nail": Entry(nail_in_hand, "m", "the nail's head in the hand frame"),
        "nail_depth": Entry(lambda s: torch.stack([s.nail_depth, s.nail_driven], -1) * 1000, "mm", "depth of the nail; by blows"),
        "drift": Entry(
            lambda s: torch.stack([s.drift_p.clamp(max=0.1) * 10, s.drift_r.clamp(max=1)], -1),
            "dm, rad",
            "motion of the hammer in the hand within 10 steps",
        ),
        "handle": Entry(tip_distance, "m", "distance of each fingertip's surface from the handle's", True),
        "face": Entry(face_to_nail, "m", "striking face to the nail's head, world frame", True),
        "strike": Entry(lambda s: torch.cat([striking_axis(s), handle_axis(s)], -1), "1", "striking and handle axis, world frame", True),
        "nail_axis": Entry(lambda s: turned_in_wrist(s, torch.tensor([0.0, 0.0, -1.0]).expand_as(s.wrist_p)), "1", "nail axis in the hand frame", True),
    }  # fmt: skip
    DRAWS = 9
    MAX_STEPS = 400
    CONTROL_FREQUENCY = 40
    PHYSICS_FREQUENCY = 240
    SOLVER_ITERATIONS = 8
    CONTACT_OFFSET = 0.010
    CONTACT_EVERY_STEP = True
    HOME = "catch"
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
        return hand_made_candidates()

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
            name: factor * torch.tensor(np.asarray(p), dtype=torch.float32, device=self.device) for name, p in points.items()
        }
        self.object_half = factor * torch.tensor(hammer.mesh.extents / 2, dtype=torch.float32, device=self.device)
        actor = build_object(
            self.scene, hammer, scale=scale, friction=FRICTION, contact_offset=self.CONTACT_OFFSET,
            pose=sapien.Pose([*RELEASE[:2], RELEASE[2] + 0.5]),
        )  # fmt: skip
        self.nail = Nail(self.scene, NAIL_TOP, 1 / self.PHYSICS_FREQUENCY)
        self.nail.strike_with(actor, self._points["face"].cpu().numpy())
        self._history = torch.zeros(self.num_envs, WINDOW + 1, 7, device=self.device)
        return actor

    def world(self) -> Sequence[Actor | Link]:
        return [self.table, *self.nail.links]

    def place(self, env_idx: Tensor, u: Tensor) -> None:
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
        return super().get_state_dict() | {"nail": self.nail.get_state() | {"history": self._history.flatten(1)}}

    def set_state_dict(self, state: dict, env_idx: Tensor | None = None) -> None:
        super().set_state_dict(state, env_idx)
        if "nail" in state:
            rows = torch.arange(self.num_envs, device=self.device) if env_idx is None else env_idx
            self.nail.set_state(state["nail"], rows)
            self._history[rows] = state["nail"]["history"].reshape(-1, WINDOW + 1, 7)
