"""Environments whose simulation is not finite or blows up: they are found, recorded and put back to a good state."""

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import sapien
import torch
from jaxtyping import Bool
from torch import Tensor

from dora.sim.batch.layout import Layout, StateIndex
from dora.sim.batch.records import Record, StateRecorder, action_rows
from dora.sim.batch.stepping import Stepper

SPEED = 1e3
"""Largest speed of a body along an axis that is no blow-up [m/s]."""
SPIN = 1e4
"""Largest angular velocity of a body, and velocity of a joint, that is no blow-up [rad/s]."""
DISTANCE = 1e4
"""Largest coordinate of a body that is no blow-up [m]; kinematic bodies may be anywhere, for example hidden."""
FORCE = 1e6
"""Largest force [N] or torque [N m] on a joint that an environment keeps when it is put back; a task may hold a joint
by one, such as a nail's resistance."""
HISTORY = 16
"""Control steps whose states are kept for the record [1]."""
PICTURES = ("sensor_data", "sensor_param", "pointcloud")
"""Parts of an observation that hold pictures, in which infinity may mean a distance."""
Step = tuple[Any, Tensor, Tensor, Tensor, dict[str, Any]]
"""Observation, reward, terminated, truncated and info of a step."""


@dataclass(frozen=True, eq=False)
class Moment:
    """Packed states and poses of all environments before a control step, which of them are good, and its action as of
    `action_rows`."""

    state: list[bytes]
    poses: list[bytes]
    good: np.ndarray
    action: np.ndarray | None = None


class StateGuard:
    """Watches the states of all environments, once per control step.

    A state is bad if it holds NaN or infinity, or exceeds `SPEED`, `SPIN` or `DISTANCE`. A bad environment gets its
    last good state back, which PhysX goes on from as if nothing had happened; contacts since then are dropped. States
    of good environments are only read.

    Attributes:
        found: (environments,) bool, which were bad since the last `clear`.
    """

    def __init__(self, scenes: Sequence[sapien.Scene], stepper: Stepper):
        self.found = np.zeros(len(scenes), bool)
        self.recorder = StateRecorder()
        self._scenes = list(scenes)
        self._systems: list[Any] = [scene.physx_system for scene in scenes]
        self._stepper = stepper
        self._history: deque[Moment] = deque(maxlen=HISTORY)
        self._next: tuple[Moment, Any] | None = None
        self._layout = Layout({}, {})
        self._limited: list[tuple[Callable[[], np.ndarray], np.ndarray, np.ndarray, float]] = []

    def locate(self, layout: Layout, poses: np.ndarray, index: StateIndex) -> None:
        """Where the values are that have limits; states of another layout are forgotten.

        Args:
            layout: bodies and articulations.
            poses: (bodies, 7) indices of their poses in the packed poses.
            index: indices in the packed state.
        """
        self._history.clear()
        self._next = None
        self._layout = layout
        free = np.array([row.is_link or not row.body.kinematic for row in layout.bodies], bool)
        moving = free[: layout.actor_rows]
        actors = layout.body_environment[: layout.actor_rows][moving]
        velocity = index.velocity[moving]
        state, places = self._stepper.state.flat, self._stepper.poses.flat
        self._limited = [
            (state, velocity[:, :3], actors, SPEED),
            (state, velocity[:, 3:], actors, SPIN),
            (state, index.qvel, layout.articulation_environment, SPIN),
            (places, poses[free, :3], layout.body_environment[free], DISTANCE),
        ]

    def begin(self, action: Any) -> None:
        """Look at the states before a control step, after putting back those that are bad already.

        Args:
            action: of the step, for the record; it is looked at by `accept`.
        """
        bad = self.check()
        good = ~self._bad() if bad.any() else ~bad  # an environment that was never good stays bad
        self._next = Moment(self._stepper.state.chunks(), self._stepper.poses.chunks(), good), action

    def accept(self) -> None:
        """Take note of the states and the action of the step that has begun: the action is a good one."""
        if self._next is not None:
            moment, action = self._next
            self._history.append(replace(moment, action=action_rows(action, len(self._systems))))
            self._next = None

    def check(self) -> Bool[np.ndarray, " n"]:
        """Put back the environments whose state is bad now, and return which they are."""
        self._stepper.flush()
        self._stepper.refresh()
        if self._all_good():
            return np.zeros_like(self.found)
        bad = self._bad()
        self.found |= bad
        for environment in np.flatnonzero(bad).tolist():
            self._put_back(environment)
        for environment in np.flatnonzero(bad).tolist():
            self._record(environment)
        self._stepper.refresh()
        return bad

    def clear(self, rows: Any = slice(None)) -> None:
        """Forget which environments were bad, all or those of `rows`."""
        self.found[rows] = False

    def _all_good(self) -> bool:
        finite = np.isfinite(self._stepper.state.flat()).all() and np.isfinite(self._stepper.poses.flat()).all()
        return bool(finite) and all(
            np.abs(values().take(where)).max(initial=0.0) <= most for values, where, _, most in self._limited
        )

    def _bad(self) -> np.ndarray:
        chunks = zip(self._stepper.state.chunks(), self._stepper.poses.chunks(), strict=True)
        bad = np.array([not all(np.isfinite(np.frombuffer(c, np.float32)).all() for c in pair) for pair in chunks])
        for values, where, environments, most in self._limited:
            beyond = ~(np.abs(values().take(where)) <= most).all(axis=1)
            bad[environments[beyond]] = True
        return bad

    def _put_back(self, environment: int) -> None:
        """Give an environment its last good state, if it had one."""
        moment = next((m for m in reversed(self._history) if m.good[environment]), None)
        if moment is not None:
            self._systems[environment].unpack(moment.state[environment])
            self._scenes[environment].unpack_poses(moment.poses[environment])
        for row in self._layout.articulations:
            if row.environment == environment:
                force = np.asarray(row.articulation.qf)  # not part of the packed state
                row.articulation.set_qf(np.where(np.abs(force) <= FORCE, force, 0.0).astype(np.float32))
        self._stepper.discard(environment)

    def _record(self, environment: int) -> None:
        """Write the last states of an environment, the bad one as it was read before it was put back."""
        if self.recorder.full:
            return
        now = self._stepper.state.chunks(), self._stepper.poses.chunks()
        states = [m.state[environment] for m in self._history] + [now[0][environment]]
        poses = [m.poses[environment] for m in self._history] + [now[1][environment]]
        actions = [None if m.action is None else m.action[environment] for m in self._history]
        entities = [entity.name for entity in self._scenes[environment].entities]
        self.recorder.write(Record(environment, states, poses, actions, entities))


def marked(step: Step, found: Bool[Tensor, " n"]) -> tuple[Step, Bool[Tensor, " n"]]:
    """The result of a step with the rows that are bad marked, and which those are.

    Bad are the rows that were `found`, and those whose observation or reward is not finite. They are terminated, no
    success, a failure if the task knows failures, earn 0, and their remaining NaN and infinities become 0;
    `info["nonfinite"]` says which they are. Other rows stay as they are.
    """
    observation, reward, terminated, truncated, info = step
    rows = found.clone()
    for value in _floats((observation, reward), len(rows)):
        rows |= ~_finite_rows(value)
    info["nonfinite"] = rows
    if not rows.any():
        return step, rows
    for value in (*_floats(observation, len(rows)), *_floats(info, len(rows))):
        value[rows] = value[rows].nan_to_num(0.0, 0.0, 0.0)
    if isinstance(reward, Tensor) and reward.shape[:1] == rows.shape:
        reward = reward.clone()
        reward[rows] = 0
    for name, says in (("success", False), ("fail", True)):
        if isinstance(info.get(name), Tensor):
            info[name] = torch.where(rows, torch.full_like(info[name], says), info[name])
    return (observation, reward, terminated | rows, truncated, info), rows


def _floats(value: Any, environments: int) -> list[Tensor]:
    """All tensors of floating point numbers in nested mappings that have a row per environment, without pictures."""
    if isinstance(value, Mapping):
        return [t for name, part in value.items() if name not in PICTURES for t in _floats(part, environments)]
    if isinstance(value, tuple):
        return [t for part in value for t in _floats(part, environments)]
    fits = isinstance(value, Tensor) and value.is_floating_point() and value.shape[:1] == (environments,)
    return [value] if fits else []


def _finite_rows(value: Tensor) -> Bool[Tensor, " n"]:
    """Which rows of a tensor (n, ...) are finite."""
    rows = value.detach().reshape(len(value), -1)
    if rows.device.type != "cpu" or rows.dtype == torch.bfloat16:  # which NumPy does not know
        return rows.isfinite().all(1)
    return torch.from_numpy(np.isfinite(rows.numpy()).all(1))  # torch would wake its threads for it, which wait long
