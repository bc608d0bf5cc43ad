"""Episodes as records: what acts is executed in a batch of environments, and every episode that ends is handed on."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from jaxtyping import Bool, Float32, UInt8
from torch import Tensor

from dora.arguments import as_array
from dora.errors import InputError
from dora.sim import BACKEND

Act = Callable[[gym.Env, Tensor], Any]
"""Environment and its observation (n, o) of `obs_mode="state"` -> action (n, a) in [-1, 1]."""
Pictures = dict[str, UInt8[np.ndarray, "t1 h w 3"]]
"""Pictures of an episode by the name of the camera."""
FEW = 20
"""Starts for each episode that is wanted, after which no further ones are tried."""
PATIENCE = 100
"""Starts that are tried besides."""
CAMERA = "_camera"
"""End of a camera's name, which datasets leave out."""


@dataclass(frozen=True)
class Source:
    """What acts, and in which task.

    Attributes:
        name: one word, such as "scripted".
        description: a sentence about it.
        env_id: a Dora id.
        options: arguments of `gym.make` with which its task is made.
        act: gives the actions.
    """

    name: str
    description: str
    env_id: str
    options: Mapping[str, Any]
    act: Act


@dataclass(frozen=True)
class Plan:
    """How many episodes are recorded, and from which starts.

    Attributes:
        episodes: number of episodes.
        seed: of the first start; those of further ones follow.
        only_successes: leave out episodes that fail, and go on to further starts until there are enough.
        num_envs: environments that are stepped together; the episodes do not depend on it (a policy takes care that
            actions are rounded alike in batches of any size).
    """

    episodes: int
    seed: int = 0
    only_successes: bool = False
    num_envs: int = 16

    def check(self, recorded: int, tried: int) -> None:
        """Gives up if too few starts end in a success.

        Raises:
            InputError: after `FEW` starts for each episode, and `PATIENCE` besides.
        """
        if recorded < self.episodes and tried >= FEW * self.episodes + PATIENCE:
            what = "starts ended in a success" if self.only_successes else "simulations stayed finite"
            raise InputError(
                f"only {recorded} of {tried} {what}, and {self.episodes} are wanted: ask for fewer "
                "episodes, another policy or an easier preset, or keep failed ones, too."
            )


@dataclass(frozen=True)
class Episode:
    """One episode of t control steps; it ends where the environment says so, by success, failure or time.

    Attributes:
        seed: of its start; a reset of the same task with it begins as the episode did.
        observations: of `obs_mode="state"`, before each step and after the last.
        actions: in [-1, 1].
        rewards: of the steps.
        terminated: whether success or failure ended the episode; True in the last step only.
        truncated: whether its time was over; True in the last step only.
        successes: whether the episode counted as a success after each step.
        pictures: of the cameras, before each step and after the last.
    """

    seed: int
    observations: Float32[np.ndarray, "t1 o"]
    actions: Float32[np.ndarray, "t a"]
    rewards: Float32[np.ndarray, " t"]
    terminated: Bool[np.ndarray, " t"]
    truncated: Bool[np.ndarray, " t"]
    successes: Bool[np.ndarray, " t"]
    pictures: Pictures = field(default_factory=dict)

    @property
    def success(self) -> bool:
        """Whether it counts as a success when it ends."""
        return bool(self.successes[-1])

    def __len__(self) -> int:
        """Number of its control steps."""
        return len(self.actions)


def make_batch(source: Source, num_envs: int, pictures: bool) -> gym.Env:
    """The environments in which a source acts.

    Raises:
        InputError: for any option that the task refuses, and pictures without a Vulkan driver.
    """
    mode = {"obs_mode": "state+rgb"} if pictures else {}
    return gym.make(source.env_id, num_envs=num_envs, sim_backend=BACKEND, **{**source.options, **mode})


def roll_out(
    env: gym.Env, act: Act, plan: Plan, progress: Callable[[int, int], None] = lambda done, total: None
) -> Iterator[tuple[int, Episode]]:
    """Yields the row and the record of each episode in the step that ends it, in the order in which they end.

    A round takes at most as many starts as episodes are missing, so which starts are recorded does not depend on the
    size of the batch: all from the first on, or the first that end in a success. Starts whose simulation comes to be
    not finite are left out.

    Args:
        env: a batch as of `make_batch`, perhaps with a recorder around it.
        act: gives the actions.
        plan: what is wanted.
        progress: called with the number of episodes recorded and wanted.

    Raises:
        InputError: too few starts end in a success.
    """
    rows, done, seed = env.get_wrapper_attr("num_envs"), 0, plan.seed
    while done < plan.episodes:
        starts = min(rows, plan.episodes - done)
        for row, episode in _round(env, act, [seed + k for k in range(rows)], starts):
            if episode.success or not plan.only_successes:
                done += 1
                yield row, episode
                progress(done, plan.episodes)
        seed += starts
        plan.check(done, seed - plan.seed)


def _round(env: gym.Env, act: Act, seeds: list[int], starts: int) -> Iterator[tuple[int, Episode]]:
    """The episodes of the first `starts` rows, each when it ends; the other rows are moved and not recorded, nor are
    episodes that end because their simulation is not finite."""
    obs, _ = env.reset(seed=seeds)  # pyright: ignore[reportArgumentType]
    trace = _Trace(obs)
    going = np.arange(len(seeds)) < starts
    while going.any():
        with torch.no_grad():
            action = torch.as_tensor(act(env, _state(obs)), dtype=torch.float32).clamp(-1.0, 1.0)
        obs, reward, terminated, truncated, info = env.step(action)
        trace.add(obs, action, reward, terminated, truncated, info["success"])
        ended = going & (trace.last("terminated") | trace.last("truncated"))
        sound = ~as_array(info.get("nonfinite", np.zeros(len(seeds), bool)))
        for row in np.flatnonzero(ended & sound).tolist():
            yield row, trace.episode(row, seeds[row])
        going &= ~ended


class _Trace:
    """What all rows did since they were reset."""

    def __init__(self, obs: Any):
        self._observations, self._pictures = [as_array(_state(obs))], [_pictures(obs)]
        self._steps: dict[str, list[np.ndarray]] = {}

    def add(self, obs: Any, action: Any, reward: Any, terminated: Any, truncated: Any, success: Any) -> None:
        self._observations.append(as_array(_state(obs)))
        self._pictures.append(_pictures(obs))
        values = {"actions": action, "rewards": reward, "terminated": terminated, "truncated": truncated}
        for name, value in {**values, "successes": success}.items():
            self._steps.setdefault(name, []).append(as_array(value))

    def last(self, name: str) -> Bool[np.ndarray, " n"]:
        return self._steps[name][-1]

    def episode(self, row: int, seed: int) -> Episode:
        steps = {name: np.stack([value[row] for value in values]) for name, values in self._steps.items()}
        pictures = {name: np.stack([part[name][row] for part in self._pictures]) for name in self._pictures[0]}
        return Episode(seed, np.stack([o[row] for o in self._observations]), **steps, pictures=pictures)


def _state(obs: Any) -> Tensor:
    return obs["state"] if isinstance(obs, Mapping) else obs


def _pictures(obs: Any) -> dict[str, np.ndarray]:
    """Pictures (n, h, w, 3) by the name of the camera, if there are any."""
    if not isinstance(obs, Mapping):
        return {}
    return {name.removesuffix(CAMERA): as_array(part["rgb"]) for name, part in obs["sensor_data"].items()}
