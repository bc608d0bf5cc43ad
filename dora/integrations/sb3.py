"""Stable-Baselines3: a batch of environments as its `VecEnv`.

from dora.integrations.sb3 import make
from stable_baselines3 import PPO

PPO("MlpPolicy", make("DoraCube-v1", num_envs=64, ignore_terminations=True)).learn(300_000)
"""

from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from stable_baselines3.common.vec_env import VecEnv, VecMonitor
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvStepReturn

from dora.arguments import as_array
from dora.integrations.batches import make_batch


def make(env_id: str, num_envs: int = 16, ignore_terminations: bool = False, **options: Any) -> VecEnv:
    """A batch as a `VecEnv` that reports returns, lengths and successes of its episodes to Stable-Baselines3.

    Args:
        env_id: id of Dora or ManiSkill.
        num_envs: environments in the batch.
        ignore_terminations: let an episode last until its time is over. Otherwise a success ends it, and as nothing is
            counted after that, a learner with a dense reward would rather not succeed.
        options: further arguments of `gym.make`, such as `guidance="none"` or `max_episode_steps=50`.

    Raises:
        InputError: if observations or actions are no array.
    """
    return VecMonitor(BatchVecEnv(make_batch(env_id, num_envs, options), ignore_terminations))


class BatchVecEnv(VecEnv):
    """A batch of environments that are stepped together; each begins a new episode when one has ended.

    In the step that ends an episode the observation is the first one of the next, and the info of its row has
    `terminal_observation`, `TimeLimit.truncated` and, for tasks with success, `is_success`.

    Args:
        env: a batched environment with arrays as observations and actions, see `make_batch`.
        ignore_terminations: episodes end when their time is over, and not by success or failure.
    """

    def __init__(self, env: gym.Env, ignore_terminations: bool = False):
        self.env, self._actions, self._ignore = env, np.zeros(0), ignore_terminations
        spaces = (env.get_wrapper_attr(f"single_{what}_space") for what in ("observation", "action"))
        super().__init__(env.get_wrapper_attr("num_envs"), *spaces)
        self.metadata = env.metadata

    def reset(self) -> np.ndarray:
        """Begin new episodes everywhere, with the seed of `seed` and the options of `set_options`, if they were called
        since the last reset; (n, o).

        Raises:
            ValueError: environments were given different options.
        """
        first, options = self._seeds[0], self._options[0]
        if any(own != options for own in self._options):
            raise ValueError("The environments of a batch share the options of a reset: give all of them the same.")
        seeds: Any = None if first is None else self._seeds
        obs, _ = self.env.reset(seed=seeds, options=options or None)
        self._reset_seeds()
        self._reset_options()
        return as_array(obs)

    def step_async(self, actions: np.ndarray) -> None:
        """Take the actions (n, a) of the next step."""
        self._actions = actions

    def step_wait(self) -> VecEnvStepReturn:
        """One control step: observations (n, o), rewards (n,), which episodes ended (n,), and infos."""
        obs, reward, terminated, truncated, info = self.env.step(self._actions)
        over = as_array(terminated) & (not self._ignore)
        obs, ended = as_array(obs), over | as_array(truncated)
        infos: list[dict[str, Any]] = [{"TimeLimit.truncated": False} for _ in range(self.num_envs)]
        rows = np.flatnonzero(ended)
        if len(rows):
            success = info.get("success")
            for row in rows.tolist():
                infos[row] = {"terminal_observation": obs[row].copy(), "TimeLimit.truncated": not over[row]}
                infos[row] |= {} if success is None else {"is_success": bool(success[row])}
            obs = np.where(ended[:, None], as_array(self.env.reset(options={"env_idx": rows})[0]), obs)
        return obs, as_array(reward), ended, infos

    def close(self) -> None:
        """Free the simulation."""
        self.env.close()

    def get_images(self) -> Sequence[np.ndarray | None]:
        """A picture of each environment, of `render_mode="rgb_array"`."""
        return list(as_array(self.env.render()))

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """An attribute of the batch, which its environments share, once for each of `indices`."""
        return [self.env.get_wrapper_attr(attr_name)] * len(self._rows(indices))

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Set an attribute of the batch, hence of all its environments.

        Raises:
            ValueError: `indices` names some of them only.
        """
        self._check_all(indices, f"attribute {attr_name!r}")
        setattr(self.env.unwrapped, attr_name, value)

    def env_method(self, method_name: str, *args: Any, indices: VecEnvIndices = None, **kwargs: Any) -> list[Any]:
        """Call a method of the batch once; its result stands for each environment.

        Raises:
            ValueError: `indices` names some of them only.
        """
        self._check_all(indices, f"method {method_name!r}")
        return [self.env.get_wrapper_attr(method_name)(*args, **kwargs)] * self.num_envs

    def env_is_wrapped(self, wrapper_class: type[gym.Wrapper], indices: VecEnvIndices = None) -> list[bool]:
        """Whether the batch has a wrapper of this class."""
        env, found = self.env, False
        while isinstance(env, gym.Wrapper):
            found, env = found or isinstance(env, wrapper_class), env.env
        return [found] * len(self._rows(indices))

    def _rows(self, indices: VecEnvIndices) -> list[int]:
        return list(self._get_indices(indices))

    def _check_all(self, indices: VecEnvIndices, what: str) -> None:
        if sorted(self._rows(indices)) != list(range(self.num_envs)):
            raise ValueError(f"The environments of a batch share the {what}: leave indices out.")
