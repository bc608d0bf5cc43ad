"""PettingZoo: a task of several arms as its `ParallelEnv`, with an agent for each arm.

from dora.integrations.pettingzoo import make

env = make("DoraMicrowave-v1")  # agents "left" and "right"
observations, infos = env.reset(seed=0)
"""

from collections.abc import Mapping
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.spaces import Box
from pettingzoo import ParallelEnv
from torch import Tensor

from dora.arguments import as_array, as_tensor
from dora.errors import InputError, shown
from dora.integrations.batches import make_batch

Observations = dict[str, np.ndarray]
"""What each agent observes, by name."""


def make(env_id: str, ignore_terminations: bool = False, **options: Any) -> "ArmsEnv":
    """One environment of an id, in which each arm is an agent.

    Args:
        env_id: id of Dora.
        ignore_terminations: let an episode last until its time is over. Otherwise a success ends it, and as nothing is
            counted after that, a learner with a dense reward would rather not succeed.
        options: further arguments of `gym.make`, such as `guidance="none"` or `max_episode_steps=50`.

    Raises:
        InputError: the id names no agents, or observations or actions are no array.
    """
    env = make_batch(env_id, 1, options)
    if not hasattr(env.unwrapped, "agent_columns"):
        env.close()
        raise InputError(f"{env_id} does not say which arm observes and commands what: choose an id of Dora.")
    return ArmsEnv(env, ignore_terminations)


class ArmsEnv(ParallelEnv):
    """An environment whose arms are agents; the reward is common, and an episode begins and ends for all at once.

    Each agent observes its own entries and those that are the same for all, and commands its own arm. `state` is the
    observation of all together. Infos hold `success`, where the task knows it, as a bool.

    Args:
        env: a batch of one environment whose task has `agent_columns`, see `make_batch`.
        ignore_terminations: episodes end when their time is over, and not by success or failure.
    """

    def __init__(self, env: gym.Env, ignore_terminations: bool = False):
        self.env, self._ignore = env, ignore_terminations
        self._columns = dict(env.get_wrapper_attr("agent_columns"))
        self.possible_agents, self.agents = list(self._columns), []
        seen, commanded = (env.get_wrapper_attr(f"single_{what}_space") for what in ("observation", "action"))
        self._size, self._state = commanded.shape[0], np.zeros(seen.shape, np.float32)
        self.state_space = seen
        observed = {name: _part(seen, columns) for name, (columns, _) in self._columns.items()}
        acting = {name: _part(commanded, columns) for name, (_, columns) in self._columns.items()}
        self.observation_spaces: dict[str, Any] = observed
        self.action_spaces: dict[str, Any] = acting
        self.metadata = {**env.metadata, "name": env.spec.id if env.spec else type(env.unwrapped).__name__}
        self.render_mode = env.render_mode

    def observation_space(self, agent: str) -> Box:
        """What an agent observes: always the same object."""
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> Box:
        """What an agent may do, in [-1, 1]: always the same object."""
        return self.action_spaces[agent]

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observations, dict[str, dict[str, Any]]]:
        """Begin an episode; observations and infos of each agent."""
        obs, info = self.env.reset(seed=seed, options=options)
        self.agents = list(self.possible_agents)
        return self._observed(obs), self._each(_info(info))

    def step(
        self, actions: Any
    ) -> tuple[Observations, dict[str, float], dict[str, bool], dict[str, bool], dict[str, dict[str, Any]]]:
        """One control step with the action of each agent.

        Args:
            actions: numbers by agent, in any form that `dora.arguments.as_tensor` takes.

        Returns:
            Observations, rewards, terminations, truncations and infos by agent.

        Raises:
            InputError: the actions are not those of the agents, or have another shape, or hold NaN or infinity.
        """
        if not isinstance(actions, Mapping):
            raise InputError(f"The actions must be a dictionary by agent, {self.agents} here, not {shown(actions)}.")
        if set(actions) != set(self.agents):
            raise InputError(f"There are actions for {shown(list(actions))}, and the agents are {self.agents}.")
        joint = np.zeros(self._size, np.float32)
        for name in self.agents:
            own, columns = as_array(as_tensor(actions[name], f"The action of {name}")), self._columns[name][1]
            if own.shape != (len(columns),):
                raise InputError(f"The action of {name} has the shape {own.shape} and needs ({len(columns)},).")
            joint[columns] = own
        obs, reward, terminated, truncated, info = self.env.step(joint)
        over = bool(terminated) and not self._ignore
        found = (
            self._observed(obs), self._each(float(reward)), self._each(over), self._each(bool(truncated)),
            self._each(_info(info)),
        )  # fmt: skip
        if over or bool(truncated):
            self.agents = []
        return found

    def state(self) -> np.ndarray:
        """The observation of all agents together (o,), such as a centralised critic sees."""
        return self._state.copy()

    def render(self) -> Any:
        """What `render_mode` asks for."""
        picture = self.env.render()
        return picture.numpy(force=True)[0] if isinstance(picture, Tensor) else picture

    def close(self) -> None:
        """Free the simulation."""
        self.env.close()

    def _observed(self, obs: Any) -> Observations:
        values = obs.numpy(force=True) if isinstance(obs, Tensor) else np.asarray(obs)
        self._state = values.reshape(-1).astype(np.float32)
        return {name: self._state[self._columns[name][0]] for name in self.agents}

    def _each(self, value: Any) -> dict[str, Any]:
        """The same for every agent; a mapping as a copy for each."""
        return {name: dict(value) if isinstance(value, dict) else value for name in self.agents}


def _part(space: Box, columns: list[int]) -> Box:
    return Box(space.low[columns], space.high[columns], dtype=np.float32)


def _info(info: dict[str, Any]) -> dict[str, Any]:
    return {"success": bool(info["success"])} if "success" in info else {}
