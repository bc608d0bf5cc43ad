"""Steps tasks with extreme actions, and looks for numbers that are not finite and for memory that grows.

    python -m dora.tools.adversary --steps 500000
    python -m dora.tools.adversary --envs PickCube-v1 --steps 20000 --num-envs 64

Steps are environment steps, summed over all environments. One line per task; exit status 1 if an observation, reward or
value of the info is not finite, or if memory grows.
"""

import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import torch
import tyro
from jaxtyping import Float
from mani_skill.utils.registration import REGISTERED_ENVS
from torch import Tensor

from dora.errors import InputError, command, suggestion
from dora.progress import ProgressDisplay
from dora.sim import BACKEND
from dora.tasks import task_ids

CONSTANT = (1.0, -1.0, 1e30, -1e30, 1e-45, 3.4e38)
"""Actions that stay as they are; 1e-45 is no normal number [1]."""
ALTERNATING = (1.0, 1e30)
"""Sizes of actions whose sign changes from step to step [1]."""
WARM_UP = 0.3
"""Share of the steps after which memory is measured first [1]."""
GROWTH = 16.0
"""Growth of memory that is none [MiB]."""
PAGES_PER_MIB = 256
"""Pages of 4 KiB in a mebibyte [1]."""


@dataclass(frozen=True)
class Report:
    """What happened: environment steps, episodes, episodes that were not finite, steps of which a number that was
    returned is not finite, memory after the warm-up and at the end [MiB], seconds."""

    steps: int
    episodes: int
    nonfinite_episodes: int
    bad_steps: int
    memory: tuple[float, float]
    seconds: float

    @property
    def good(self) -> bool:
        """Whether all numbers were finite and memory did not grow."""
        return not self.bad_steps and self.memory[1] - self.memory[0] < GROWTH

    def __str__(self) -> str:
        return (
            f"{self.steps:,} steps, {self.episodes:,} episodes, {self.nonfinite_episodes} of them not finite, "
            f"{self.bad_steps} steps with bad numbers, memory {self.memory[0]:.0f} -> {self.memory[1]:.0f} MiB, "
            f"{self.steps / self.seconds:.0f} steps/s: {'good' if self.good else 'BAD'}"
        )


def extreme_actions(step: int, shape: tuple[int, int], generator: torch.Generator) -> Float[Tensor, "n a"]:
    """Each row has an attack of its own: constant, alternating from step to step or from joint to joint, random signs,
    random numbers."""
    rows, size = shape
    signs = 1.0 - 2.0 * torch.randint(0, 2, shape, generator=generator)
    joints = 1.0 - 2.0 * (torch.arange(size) % 2)
    turn = -1.0 if step % 2 else 1.0
    attacks = [torch.full((size,), value) for value in CONSTANT]
    attacks += [torch.full((size,), turn * value) for value in ALTERNATING] + [turn * joints]
    kinds = len(attacks) + 2
    action = torch.stack([attacks[row % kinds] if row % kinds < len(attacks) else signs[row] for row in range(rows)])
    action[kinds - 1 :: kinds] *= torch.rand(action[kinds - 1 :: kinds].shape, generator=generator)
    return action


def extreme_action(space: Any, rows: int, step: int, generator: torch.Generator) -> Any:
    """`extreme_actions` for the space of one action: by robot where there are several, None where there is none."""
    if isinstance(space, gym.spaces.Dict):
        return {name: extreme_action(part, rows, step, generator) for name, part in space.spaces.items()}
    return None if space is None else extreme_actions(step, (rows, space.shape[0]), generator)


def attack(
    env: Any, steps: int, seed: int = 0, progress: Callable[[int, int], None] = lambda done, total: None
) -> Report:
    """Step an unwrapped batched environment with `extreme_actions`, restarting episodes that end.

    Args:
        env: of any id, on the batched back end, with `obs_mode="state"`.
        steps: environment steps in all.
        seed: of the first episodes and of the random actions.
        progress: called with the environment steps done, and all of them.
    """
    generator = torch.Generator().manual_seed(seed)
    env.reset(seed=seed)
    rounds = max(steps // env.num_envs, 1)
    limit = getattr(env, "max_steps", None) or gym.spec(env.spec.id).max_episode_steps or rounds
    episodes = nonfinite = bad = 0
    first, start = memory(), time.monotonic()
    for step in range(rounds):
        action = extreme_action(getattr(env, "single_action_space", None), env.num_envs, step, generator)
        observation, reward, terminated, _, info = env.step(action)
        values = [observation, reward, *(v for v in info.values() if torch.is_tensor(v) and v.is_floating_point())]
        finite = torch.stack([v.reshape(env.num_envs, -1).isfinite().all(1) for v in values]).all(0)
        bad += int((~finite).sum())
        nonfinite += int(info["nonfinite"].sum())
        ended = (terminated | (env.elapsed_steps >= limit)).nonzero()[:, 0]
        if len(ended):
            episodes += len(ended)
            bad += int((~env.reset(options={"env_idx": ended})[0].isfinite().all(1)).sum())
        if step == int(WARM_UP * rounds):
            first = memory()
        progress((step + 1) * env.num_envs, rounds * env.num_envs)
    return Report(rounds * env.num_envs, episodes, nonfinite, bad, (first, memory()), time.monotonic() - start)


def memory() -> float:
    """Memory of this process that is in use [MiB]; 0 where the system does not tell."""
    path = Path("/proc/self/statm")
    return int(path.read_text().split()[1]) / PAGES_PER_MIB if path.exists() else 0.0


@dataclass(frozen=True)
class Args:
    """Step tasks with extreme actions."""

    envs: tuple[str, ...] = tuple(task_ids())
    """Ids of the tasks; ManiSkill's own ones, too."""
    steps: int = 500_000
    """Environment steps of each task."""
    num_envs: int = 32
    """Environments that are stepped together."""
    seed: int = 0
    """Seed of episodes and random actions."""


@command
def main() -> int:
    """Run the command; returns the exit status."""
    args, good = tyro.cli(Args, description=__doc__), True
    for name in args.envs:
        if name not in REGISTERED_ENVS:
            hint = suggestion(name, REGISTERED_ENVS, "name one of Dora or ManiSkill.")
            raise InputError(f"There is no task {name!r}: {hint}")
    for name in args.envs:
        options: Any = {"num_envs": args.num_envs, "sim_backend": BACKEND, "render_backend": "none"}
        env: Any = gym.make(name, obs_mode="state", **options).unwrapped
        with ProgressDisplay() as display:
            report = attack(env, args.steps, args.seed, display.phase(name, "steps"))
        print(f"{name}: {report}", flush=True)
        good &= report.good
        env.close()
    return int(not good)


if __name__ == "__main__":
    sys.exit(main())
