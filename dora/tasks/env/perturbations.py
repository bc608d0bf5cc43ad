"""What a preset does to an episode while it runs: noise in what is observed, delayed actions, pushes.

All random numbers of an episode follow from one key, which is drawn from the environment's own stream at reset, and
from the number of the control step. So they neither depend on the other environments nor on when they are asked for,
and a restored state sees the same noise as the one that was saved.
"""

from math import pi

import torch
from jaxtyping import Float, Int
from torch import Tensor

from dora.geometry.rotations import quaternion_from_rotation_vector, quaternion_multiply
from dora.tasks.guidance.candidate_choice import Choice
from dora.tasks.mdp.randomisation import Randomisation
from dora.tasks.mdp.snapshot import S, observed

KEYS = 2**24
"""Number of different keys; each is exact in a float, as which states are stored."""
WORD = 2**32 - 1
"""Mask of 32 bits."""
GOLDEN = 0x9E3779B9
"""2^32 over the golden ratio: multiples of it are spread evenly."""
SENSOR_DRAWS, PUSH_DRAWS = 26, 2
"""Random numbers of a control step: object position 3, rotation 3, hand joints 20; whether and where to push."""


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
        preset: how strong they are.
        num_envs: n.
        action_size: components of an action.
        frequency: control steps in a second [Hz].
        device: where the tensors are.
    """

    def __init__(self, preset: Randomisation, num_envs: int, action_size: int, frequency: int, device: torch.device):
        self.preset, self._frequency = preset, frequency
        self.buffers = {
            "key": torch.zeros(num_envs, device=device),
            "waiting": torch.zeros(num_envs, max(preset.delay, 1), action_size, device=device),
        }

    def begin(self, rows: Int[Tensor, " b"], share: Float[Tensor, " b"]) -> None:
        """Starts new episodes in the environments `rows`; `share` in [0, 1) chooses their keys."""
        self.buffers["key"][rows] = (share * KEYS).floor()

    def _draws(self, step: Tensor, start: int, size: int) -> Tensor:
        return uniform(self.buffers["key"].long(), step.long(), start + size)[:, start:]

    def delayed(self, action: Float[Tensor, "n a"], step: Int[Tensor, " n"]) -> Float[Tensor, "n a"]:
        """Takes in the action of a control step; the one that takes effect now. The first acts at once."""
        if self.preset.delay == 0:
            return action
        waiting = self.buffers["waiting"]
        waiting.copy_(torch.where((step == 0)[:, None, None], action[:, None], waiting))
        now = waiting[:, 0].clone()
        waiting.copy_(torch.cat([waiting[:, 1:], action[:, None]], 1))
        return now

    def pushes(self, step: Int[Tensor, " n"]) -> Float[Tensor, "n 3"]:
        """Impulse on each object in this control step [N s], world frame; zero in most."""
        if self.preset.push == 0:
            return torch.zeros(len(step), 3, device=step.device)
        chance, where = self._draws(step, SENSOR_DRAWS, PUSH_DRAWS).unbind(-1)
        size = self.preset.push * (chance < self.preset.push_rate / self._frequency)
        angle = 2 * pi * where
        return torch.stack([size * angle.cos(), size * angle.sin(), torch.zeros_like(size)], -1)

    def observed(self, s: S, choice: Choice, step: Int[Tensor, " n"]) -> S:
        """The state as it is observed: object pose, all that follows from it, and hand joints are noisy."""
        preset = self.preset
        if not preset.noisy:
            return s
        error = 2 * self._draws(step, 0, SENSOR_DRAWS) - 1
        position = s.object_p + preset.observed_position * error[:, :3]
        tilt = quaternion_from_rotation_vector(preset.observed_rotation * error[:, 3:6])
        quaternion = quaternion_multiply(s.object_q, tilt)
        near_p, near_q, approach = choice.goals(position, quaternion)
        return observed(
            s,
            object_p=position, object_q=quaternion, hand_q=s.hand_q + preset.observed_joint * error[:, 6:],
            near_p=near_p, near_q=near_q, goal_p=near_p[:, 0], goal_q=near_q[:, 0], goal_approach=approach,
        )  # fmt: skip

    def get_state(self) -> dict[str, Tensor]:
        """Copies of all buffers by name."""
        return {name: buffer.clone() for name, buffer in self.buffers.items()}

    def set_state(self, state: dict[str, Tensor], rows: Tensor | slice) -> None:
        """Inverse of `get_state` for the given rows."""
        for name, buffer in self.buffers.items():
            buffer[rows] = state[name].reshape(buffer[rows].shape)
