"""What the randomisation does to an episode while it runs: noise in what is observed, delayed actions, pushes.

All random numbers of an episode follow from one key, which is drawn from the environment's own stream at reset, and
from the number of the control step. So they neither depend on the other environments nor on when they are asked for,
and a restored state sees the same noise as the one that was saved.
"""

from collections.abc import Mapping
from dataclasses import replace
from math import pi

import torch
from jaxtyping import Float, Int
from torch import Tensor

from dora.geometry.poses import Pose, blend
from dora.geometry.rotations import quaternion_from_rotation_vector, quaternion_multiply
from dora.tasks.guidance.candidate_choice import CandidateChoice
from dora.tasks.mdp.buffers import Buffers
from dora.tasks.mdp.randomisation import Randomisation
from dora.tasks.mdp.snapshot import S, Snapshot, observed

KEYS = 2**24
"""Number of different keys [1]; each is exact in a float, as which states are stored."""
WORD = 2**32 - 1
"""Mask of 32 bits."""
GOLDEN = 0x9E3779B9
"""2^32 over the golden ratio: multiples of it are spread evenly."""
OBJECT_DRAWS, PUSH_DRAWS = 6, 2
"""Random numbers of a control step: position and rotation of each object; whether and where to push it."""
MOVED = 0.03
"""Distance of a measured position from the estimate from which the object counts as moved [m]."""
ESTIMATE: dict[str, tuple[int, ...]] = {"count": (), "p": (3,), "q": (4,)}
"""What is kept of an estimate: measurements in it, position [m], wxyz."""
STILL = 2**20
"""Number of the control step, larger than that of any, from which errors are drawn that stay for an episode."""


def _mixed(word: Tensor) -> Tensor:
    """The finaliser of MurmurHash3 on 32-bit words that are stored in 64 bits."""
    word = ((word ^ (word >> 16)) * 0x85EBCA6B) & WORD
    word = ((word ^ (word >> 13)) * 0xC2B2AE35) & WORD
    return word ^ (word >> 16)


def uniform(key: Int[Tensor, " n"], step: Int[Tensor, " n"], size: int) -> Float[Tensor, "n {size}"]:
    """Random numbers in [0, 1) that are a pure function of key, step and column."""
    column = GOLDEN * torch.arange(1, size + 1, device=key.device)
    rows = _mixed(_mixed((key + GOLDEN) & WORD) + step)
    return (_mixed((rows[:, None] + column) & WORD) >> 8).float() / 2**24


class Perturbations:
    """Noise, delay and pushes of n environments.

    Args:
        randomisation: how strong they are.
        num_envs: n.
        action_size: components of an action.
        hands: number of hand joints of each arm.
        dt: duration of a control step [s].
        device: where the tensors are.
        pose_filter: share of the newest measurement in the estimate of an object's pose; 1 is no filter.
        misplaced: whether measured poses are off by the error of candidates, which then have none of their own.
    """

    def __init__(
        self,
        randomisation: Randomisation,
        num_envs: int,
        action_size: int,
        hands: Mapping[str, int],
        dt: float,
        device: torch.device | str,
        pose_filter: float = 1.0,
        misplaced: bool = False,
    ):
        self.randomisation, self._dt = randomisation, dt
        self._sensors = {arm: OBJECT_DRAWS + size for arm, size in hands.items()}
        self._filtered = tuple(hands) if pose_filter < 1 and randomisation.noisy else ()
        self._share = pose_filter
        self._biased = tuple(hands) if misplaced else ()
        biases = {f"{arm}_bias": (OBJECT_DRAWS,) for arm in self._biased}
        estimates = {f"{arm}_{name}": size for arm in self._filtered for name, size in ESTIMATE.items()}
        waiting = (max(randomisation.delay, 1), action_size)
        self.buffers = Buffers(num_envs, device, key=(), waiting=waiting, **estimates, **biases)

    def begin(self, rows: Int[Tensor, " b"], share: Float[Tensor, " b"]) -> None:
        """Starts new episodes in the environments `rows`; `share` in [0, 1) chooses their keys."""
        counts = {f"{arm}_count": 0.0 for arm in self._filtered}
        self.buffers.write(rows, key=(share * KEYS).floor(), waiting=0.0, **counts)

    def misplace(
        self, arm: str, rows: Int[Tensor, " b"], error: Float[Tensor, "b e"], share: float = 1.0
    ) -> Float[Tensor, "b e"]:
        """Takes the error of an arm's candidates in new episodes as one of its object's measured pose, if objects are
        misplaced; returns what is left for the candidates.

        Args:
            arm: its name.
            rows: environments of the episodes.
            error: numbers in [-1, 1]: 3 for position, 3 for rotation, then the fingers' joints.
            share: of the randomisation's error in force.
        """
        if arm not in self._biased:
            return error
        r, pose = self.randomisation, error[:, :OBJECT_DRAWS]
        widths = pose.new_tensor([r.candidate_position] * 3 + [r.candidate_rotation] * 3)
        self.buffers.write(rows, **{f"{arm}_bias": share * widths * pose})
        return torch.cat([torch.zeros_like(pose), error[:, OBJECT_DRAWS:]], -1)

    def bias(self, arm: str) -> Float[Tensor, "n 6"]:
        """Error of the measured poses of an arm's object that stays for the episode: shift in the world [m], and
        rotation vector in the object's frame [rad]. Zero where candidates are misplaced instead."""
        zero = torch.zeros(len(self.buffers.key), OBJECT_DRAWS, device=self.buffers.key.device)
        return getattr(self.buffers, f"{arm}_bias") if arm in self._biased else zero

    def biased(self, arm: str, pose: Pose) -> Pose:
        """The pose of an arm's object with the error that stays."""
        if arm not in self._biased:
            return pose
        bias = self.bias(arm)
        return pose[0] + bias[:, :3], quaternion_multiply(pose[1], quaternion_from_rotation_vector(bias[:, 3:]))

    def _draws(self, step: Tensor, start: int, size: int) -> Tensor:
        return uniform(self.buffers.key.long(), step.long(), start + size)[:, start:]

    def delayed(self, action: Float[Tensor, "n a"], step: Int[Tensor, " n"]) -> Float[Tensor, "n a"]:
        """Takes in the action of a control step; the one that takes effect now. The action of an episode's first step
        acts at once; one that comes later, after steps without any, follows actions of zero."""
        if self.randomisation.delay == 0:
            return action
        waiting = self.buffers.waiting
        waiting.copy_(torch.where((step == 0)[:, None, None], action[:, None], waiting))
        now = waiting[:, 0].clone()
        waiting.copy_(torch.cat([waiting[:, 1:], action[:, None]], 1))
        return now

    def pushes(self, step: Int[Tensor, " n"], count: int = 1) -> Float[Tensor, "n {count} 3"]:
        """Impulses on `count` objects in this control step [N s], world frame; zero in most."""
        r = self.randomisation
        if r.push == 0:
            return torch.zeros(len(step), count, 3, device=step.device)
        draws = self._draws(step, sum(self._sensors.values()), PUSH_DRAWS * count)
        chance, where = draws.reshape(len(step), count, PUSH_DRAWS).unbind(-1)
        size = r.push * (chance < r.push_rate * self._dt)
        angle = 2 * pi * where
        return torch.stack([size * angle.cos(), size * angle.sin(), torch.zeros_like(size)], -1)

    def observed(self, s: S, choices: Mapping[str, CandidateChoice], step: Int[Tensor, " n"]) -> S:
        """The state as it is observed: poses of handled objects, all that follows from them, and hand joints are noisy.
        A misplaced object has its `bias` besides, also where it started. The pose of a body that stands still has as
        large an error, which stays the same in the whole episode.

        Args:
            s: the true state.
            choices: candidates of each arm.
            step: number of the control step in its episode.
        """
        r = self.randomisation
        if not (r.noisy or self._biased):
            return s
        errors = (2 * self._draws(step, 0, sum(self._sensors.values())) - 1).split(list(self._sensors.values()), -1)
        hands, objects, goals = dict(s.hands), dict(s.objects), dict(s.goals)
        for arm, error in zip(self._sensors, errors, strict=True):
            body, name = s.objects[s.handles[arm]], s.handles[arm]
            measured = self._displaced(self.biased(arm, (body.p, body.q)), error)
            position, quaternion = self._estimated(arm, measured)
            nearest_p, nearest_q, approach = choices[arm].goals(position, quaternion)
            start_p = body.start_p + self.bias(arm)[:, :3] if arm in self._biased else body.start_p
            objects[name] = replace(body, p=position, q=quaternion, start_p=start_p)
            hands[arm] = replace(s.hands[arm], q=s.hands[arm].q + r.observed_joint * error[:, OBJECT_DRAWS:])
            goals[arm] = replace(
                s.goals[arm],
                p=nearest_p[:, 0],
                q=nearest_q[:, 0],
                approach=approach,
                nearest_p=nearest_p,
                nearest_q=nearest_q,
            )
        still = 2 * self._draws(torch.full_like(step, STILL), 0, OBJECT_DRAWS) - 1
        return observed(s, hands, objects, goals, lambda pose: self._displaced(pose, still))

    def _estimated(self, arm: str, measured: Pose) -> Pose:
        """The running mean of the measured poses of what an arm handles, of all since the episode began at first, later
        with the newest one's share; the measurement itself where it is far from that, because the object moves."""
        if arm not in self._filtered:
            return measured
        count, p, q = (getattr(self.buffers, f"{arm}_{name}") for name in ESTIMATE)
        new = ((count == 0) | ((measured[0] - p).norm(dim=-1) > MOVED))[:, None]
        estimate = blend((p, q), measured, (1 / (count + 1)).clamp_min(self._share))
        return torch.where(new, measured[0], estimate[0]), torch.where(new, measured[1], estimate[1])

    def remember(self, observed: Snapshot) -> None:
        """Takes note of the estimated poses of a control step, from which the next ones go on."""
        for arm in self._filtered:
            count, p = (getattr(self.buffers, f"{arm}_{name}") for name in ("count", "p"))
            body = observed.objects[observed.handles[arm]]
            jumped = (count == 0) | ((body.p - p).norm(dim=-1) > MOVED)
            counted = torch.where(jumped, torch.ones_like(count), count + 1)
            self.buffers.update(**{f"{arm}_count": counted, f"{arm}_p": body.p, f"{arm}_q": body.q})

    def _displaced(self, pose: Pose, error: Float[Tensor, "n numbers"]) -> Pose:
        """The pose with an error; the first six numbers of `error` are in [-1, 1)."""
        r = self.randomisation
        tilt = quaternion_from_rotation_vector(r.observed_rotation * error[:, 3:OBJECT_DRAWS])
        return pose[0] + r.observed_position * error[:, :3], quaternion_multiply(pose[1], tilt)
