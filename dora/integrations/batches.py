"""A batch of environments of any ManiSkill id as other libraries take it: observations are one array."""

from collections.abc import Mapping
from typing import Any

import gymnasium as gym
from gymnasium.spaces import Box

from dora import registration as registration
from dora.errors import InputError, shown
from dora.sim import BACKEND


def make_batch(env_id: str, num_envs: int, options: Mapping[str, Any]) -> gym.Env:
    """What `gym.make` makes, with batched physics and states as observations unless options say otherwise.

    Args:
        env_id: id of Dora or ManiSkill.
        num_envs: environments in the batch.
        options: further arguments of `gym.make`.

    Raises:
        InputError: if observations are no array, or actions no Box; `gym.make` says what else is wrong.
    """
    usual: dict[str, Any] = {"sim_backend": BACKEND, "obs_mode": "state"}
    env = gym.make(env_id, num_envs=num_envs, **(usual | dict(options)))
    for what, needed in (("observation", 'obs_mode="state"'), ("action", "a control mode with a single controller")):
        space = env.get_wrapper_attr(f"single_{what}_space")
        if not isinstance(space, Box):
            env.close()
            raise InputError(f"The {what}s of {env_id} have to be one array, not {shown(space)}: choose {needed}.")
    return env
