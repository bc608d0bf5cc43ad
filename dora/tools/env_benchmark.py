"""Environment steps per second: ours against ManiSkill's own way of using several cores, on the same task."""

import multiprocessing
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import gymnasium as gym
import mani_skill.envs  # noqa: F401  (registers the tasks)
import numpy as np
import torch
from gymnasium.vector import AsyncVectorEnv, AutoresetMode
from mani_skill.utils.registration import REGISTERED_ENVS
from mani_skill.utils.wrappers.gymnasium import CPUGymWrapper

import dora  # noqa: F401  (registers Dora's tasks)
from dora.errors import InputError, suggestion
from dora.parallel import PATIENCE_OF_CASES, run_cases
from dora.sim import BACKEND, StepProfile, can_render
from dora.sim.batch.rendering import refuse_pictures, replace_materials, wants_pictures

MOST: dict[str, float] = {"num_envs": 100_000, "workers": 512, "seconds": 86_400}
"""Largest value of each number of a measurement."""
REFERENCE_PROCESSES = (2, 4, 8)
"""Process counts that the reference may choose from."""
_ACTIONS_DRAWN = 64
"""Random actions that are drawn once and used in turn [1]."""
_WARM_UP_STEPS = 10
"""Control steps before a measurement [1]."""
_START_TIMEOUT = 300.0
"""Longest time to build all environments [s]."""


@dataclass(frozen=True)
class EnvReport:
    """Result of `measure`.

    ``ratio`` is ``env_steps_per_second`` over ``reference_env_steps_per_second``; ``physics_share`` the
    part of our step that is PhysX; ``shares`` all parts (``other`` is torch, ManiSkill and resets);
    ``cpu_microseconds`` the processor time of one environment step; ``seconds`` the length of each
    measurement; ``pictures_per_second`` those of all cameras of ours, resets included, 0 without pictures.
    """

    env: str
    num_envs: int
    workers: int
    env_steps_per_second: float
    reference_env_steps_per_second: float
    ratio: float
    physics_share: float
    seconds: float
    reference_processes: int
    cpu_microseconds: float
    obs_mode: str = "state"
    pictures_per_second: float = 0.0
    shares: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class _Measured:
    steps: int
    seconds: float
    cpu_seconds: float
    pictures: int
    shares: dict[str, float]


def measure(env_id: str, num_envs: int, workers: int, seconds: float, obs_mode: str = "state") -> EnvReport:
    """Measure ours, then the reference with each of ``REFERENCE_PROCESSES``.

    Args:
        env_id: any ManiSkill task.
        num_envs: environments in each of our processes.
        workers: our processes.
        seconds: length of each measurement.
        obs_mode: what is observed, in ours and in the reference; any of ManiSkill's.

    Raises:
        InputError: if a number is not positive, there is no such task or observation, or no driver for pictures.
    """
    for name, value in (("num_envs", num_envs), ("workers", workers), ("seconds", seconds)):
        if not 0 < value <= MOST[name]:
            option = name.replace("_", "-")
            raise InputError(f"--{option} is {value}: it must be positive, and at most {MOST[name]}.")
    if env_id not in REGISTERED_ENVS:
        hint = suggestion(env_id, REGISTERED_ENVS, "see mani_skill.utils.registration.REGISTERED_ENVS for the ids.")
        raise InputError(f"there is no task {env_id!r}: {hint}")
    if wants_pictures(obs_mode) and not can_render():
        refuse_pictures(obs_mode, None)
    together = multiprocessing.get_context("spawn").Barrier(workers)
    arguments = (env_id, obs_mode, num_envs, seconds, together)
    patience = PATIENCE_OF_CASES + seconds
    ours = run_cases(  # the barrier gives each process one
        _Measurement, arguments, range(workers), workers, chunk=1, patience=patience
    )
    rate = sum(part.steps / part.seconds for part in ours)
    shares = {name: float(np.mean([part.shares[name] for part in ours])) for name in ours[0].shares}
    references = {count: _reference_rate(env_id, obs_mode, count, seconds) for count in REFERENCE_PROCESSES}
    best = max(references, key=lambda count: references[count])
    return EnvReport(
        env=env_id,
        num_envs=num_envs,
        workers=workers,
        env_steps_per_second=rate,
        reference_env_steps_per_second=references[best],
        ratio=rate / references[best],
        physics_share=shares["physics"],
        seconds=seconds,
        reference_processes=best,
        cpu_microseconds=1e6 * sum(part.cpu_seconds for part in ours) / sum(part.steps for part in ours),
        obs_mode=obs_mode,
        pictures_per_second=sum(part.pictures / part.seconds for part in ours),
        shares=shares,
    )


def _options(obs_mode: str) -> dict[str, Any]:
    """Options of every environment that is measured."""
    drawn = "gpu" if torch.cuda.is_available() else "cpu"
    return {"obs_mode": obs_mode, "render_backend": drawn if wants_pictures(obs_mode) else "none"}


class _Measurement:
    """Builds environments, and steps them as long as all processes of a barrier do."""

    def __init__(self, env_id: str, obs_mode: str, num_envs: int, seconds: float, together: Any):
        torch.set_num_threads(1)
        try:
            self.env: Any = gym.make(env_id, num_envs=num_envs, sim_backend=BACKEND, **_options(obs_mode))
        except EOFError:  # ManiSkill asks whether to download them, and there is nobody to answer
            raise InputError(
                f"{env_id} needs files that are not there: fetch them by "
                f"python -m mani_skill.utils.download_asset {env_id}"
            ) from None
        self.num_envs, self.seconds, self.together = num_envs, seconds, together

    def __call__(self, seed: int) -> _Measured:
        step = _random_stepper(self.env, self.num_envs, seed)
        self.env.unwrapped.scene.px.profile = profile = StepProfile()
        for _ in range(_WARM_UP_STEPS):
            step()
        used = _uses_of_cameras(self.env.unwrapped)
        self.together.wait(_START_TIMEOUT)
        profile.clear()
        cpu = time.process_time()
        rounds, elapsed = _repeat(step, self.seconds)
        cpu = time.process_time() - cpu
        n = self.num_envs
        return _Measured(rounds * n, elapsed, cpu, used.total() * n, profile.shares())


def _uses_of_cameras(env: Any) -> Counter[str]:
    """How often each camera of observations takes pictures from now on, of all environments at once."""
    used, capture = Counter(), env.capture_sensor_data

    def counted() -> None:
        used.update(env._sensors.keys())
        capture()

    env.capture_sensor_data = counted
    return used


def _random_stepper(env: Any, num_envs: int, seed: int) -> Callable[[], None]:
    """A function that makes one random step and resets the environments whose episode ended."""
    env.action_space.seed(seed)
    actions = [env.action_space.sample() for _ in range(_ACTIONS_DRAWN)]
    env.reset(seed=[seed * num_envs + i for i in range(num_envs)])
    made = 0

    def step() -> None:
        nonlocal made
        _, _, terminated, truncated, _ = env.step(actions[made % _ACTIONS_DRAWN])
        made += 1
        ended = torch.as_tensor(terminated) | torch.as_tensor(truncated)
        if ended.any():
            env.reset(options={"env_idx": ended.nonzero().flatten()})

    return step


def _repeat(step: Callable[[], None], seconds: float) -> tuple[int, float]:
    rounds, start = 0, time.perf_counter()
    while (elapsed := time.perf_counter() - start) < seconds:
        step()
        rounds += 1
    return rounds, elapsed


def _single_env(env_id: str, obs_mode: str) -> gym.Env:
    torch.set_num_threads(1)
    if not can_render():
        replace_materials()  # of tasks that make some, which need a driver otherwise
    return CPUGymWrapper(gym.make(env_id, num_envs=1, sim_backend="physx_cpu", **_options(obs_mode)))


def _reference_rate(env_id: str, obs_mode: str, processes: int, seconds: float) -> float:
    """Environment steps per second of an `AsyncVectorEnv`, which resets ended episodes within the step as ours."""
    makers = [lambda: _single_env(env_id, obs_mode)] * processes
    env = AsyncVectorEnv(makers, context="spawn", autoreset_mode=AutoresetMode.SAME_STEP)
    try:
        env.action_space.seed(0)
        actions = [env.action_space.sample() for _ in range(_ACTIONS_DRAWN)]
        env.reset(seed=list(range(processes)))
        made = 0

        def step() -> None:
            nonlocal made
            env.step(actions[made % _ACTIONS_DRAWN])
            made += 1

        for _ in range(_WARM_UP_STEPS):
            step()
        rounds, elapsed = _repeat(step, seconds)
    finally:
        env.close()
    return rounds * processes / elapsed
