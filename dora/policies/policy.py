"""A trained policy as a function of observations, for one environment or many; greedy."""

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from gymnasium.spaces import Dict
from torch import Tensor

from dora import registration as registration
from dora.agents.checkpoint import Checkpoint, read_checkpoint
from dora.agents.evaluation.play import checkpoint_path
from dora.agents.evaluation.play import load_policy as networks_of
from dora.configs import flat, plain
from dora.errors import InputError, shown
from dora.policies.card import Card
from dora.sim.robot_agent import CONTROL_MODES, FINGERS
from dora.tasks import check_task_id, find_task, options_under_preset, task_ids
from dora.tasks.env.env import DoraEnv
from dora.tasks.env.options import task_config
from dora.tasks.mdp.guidance_parts import GUIDANCE, OBSERVATION, PRIOR, REGION, guidance_in_force

BUNDLED = Path(__file__).parent / "bundled"
"""Folder of the policies that come with Dora: a checkpoint and a card for each task."""
FEWEST_ROWS = 8
"""Rows that are computed at least [1]: products of very few are rounded in another order, and chaos makes of that
another episode."""
COMPARED = ("control_frequency", "residual", "wrist_speed", "hand_speed", "reference.held_freedom")
"""Numbers of a task that say how far an action moves the hand; switches, which are true, false or a word, are compared
as well."""


class TaskPolicy:
    """A greedy policy: `action = policy(obs)`.

    Args:
        checkpoint: settings of its run, and its weights.
        path: of the checkpoint, for messages.
        card: what was measured of it, if that is known.
    """

    def __init__(self, checkpoint: Checkpoint, path: Path, card: Card | None = None):
        self.config, self.card = checkpoint.config, card
        self.observation_size, self.action_size = checkpoint.sizes
        self.env_steps: int = checkpoint.progress["env_steps"]
        """Environment steps of the training until then."""
        self._networks = networks_of(checkpoint, path)
        self._device = torch.device("cpu")

    @property
    def env_id(self) -> str:
        """Id of the task that it was trained for."""
        return self.config.env

    @property
    def env_kwargs(self) -> dict[str, Any]:
        """Arguments of `gym.make` for the environment that it was trained in: guidance, preset, numbers of the task."""
        return {"obs_mode": "state", **self.config.task_options}

    def make(self, num_envs: int = 1, **options: Any) -> gym.Env:
        """The environment that it was trained in, as `gym.make` makes it.

        Args:
            num_envs: environments in the batch.
            options: further arguments of `gym.make`; they stand in the place of `env_kwargs`. A `preset` without a
                `config` brings its own numbers.

        Raises:
            InputError: for any option that the task refuses.
        """
        own = self.env_kwargs
        if "preset" in options and "config" not in options:
            own = options_under_preset(self.env_id, own, options["preset"])
        return gym.make(self.env_id, num_envs=num_envs, **(own | options))

    def __call__(self, obs: Any) -> Any:
        """The action in [-1, 1] for an observation of `obs_mode="state"`.

        Args:
            obs: (o,) or (n, o), a NumPy array, a list or a tensor. Numbers that are not finite count as 0, as in
                training.

        Returns:
            (a,) or (n, a): a tensor on the same device for a tensor, a NumPy array otherwise; float32.

        Raises:
            InputError: if it has another shape, or is no array.
        """
        values = self._checked(obs)
        if values.device != self._device:
            self._networks.to(values.device)
            self._device = values.device
        rows = values.reshape(-1, self.observation_size).nan_to_num(0.0, 0.0, 0.0)
        enough = torch.cat([rows, rows.new_zeros(max(FEWEST_ROWS - len(rows), 0), self.observation_size)])
        action = self._networks.greedy(enough)[: len(rows)].clamp(-1.0, 1.0)
        action = action.reshape(*values.shape[:-1], self.action_size)
        return action if isinstance(obs, Tensor) else action.numpy(force=True)

    def check(self, env: gym.Env) -> None:
        """Refuse an environment that the policy was not trained for.

        Randomisation, weights and thresholds may differ: with them observations and actions mean the same.

        Raises:
            InputError: naming the first difference: task, guidance, numbers that say what an action means, switches of
                the task, observation or action size.
        """
        task = env.unwrapped
        name = env.spec.id if env.spec else type(task).__name__
        if not isinstance(task, DoraEnv) or not isinstance(task.task, find_task(self.env_id)):
            raise InputError(f"this policy is of {self.env_id}, not of {name}: load that of the task in hand.")
        if "state" not in task.obs_mode.split("+"):
            raise InputError(f"observations of obs_mode {task.obs_mode!r} hold no plain state: {self._remedy()}")
        ours, theirs = self._traits(), traits(task)
        for what, value in ours.items():
            if theirs[what] != value:
                raise InputError(
                    f"this policy of {self.env_id} was trained with {what} {shown(value)}, and the environment has "
                    f"{shown(theirs[what])}: {self._remedy()}"
                )

    def _traits(self) -> dict[str, Any]:
        """`traits` of the environment that it was trained in."""
        config, cls = self.config, find_task(self.env_id).CONFIG
        numbers = task_config(cls, config.preset, config.task)
        return {
            "guidance": _words(guidance_in_force(config.guidance, config.guidance_parts)),
            "control mode": CONTROL_MODES[0] + (FINGERS if numbers.hand_action == "fingers" else ""),
            "observation size": self.observation_size,
            "action size": self.action_size,
            **_meaning(plain(numbers)),
        }

    def _checked(self, obs: Any) -> Tensor:
        """An observation as a float32 tensor with a last axis of the right size."""
        if isinstance(obs, Mapping | tuple):
            kind = type(obs).__name__
            raise InputError(
                f"this policy of {self.env_id} takes the plain state, not a {kind}: pass what step or reset returns "
                f'first, of an environment made with obs_mode="state"; {self._remedy()}'
            )
        try:
            values = obs if isinstance(obs, Tensor) else torch.from_numpy(np.array(obs, np.float32, order="C"))
        except (TypeError, ValueError) as error:
            raise InputError(
                f"the observation of a policy has to be an array of numbers, not {shown(obs)}; {self._remedy()}"
            ) from error
        if values.ndim not in (1, 2) or values.shape[-1] != self.observation_size:
            raise InputError(
                f"the observation has the shape {tuple(values.shape)}, and this policy of {self.env_id} takes "
                f"({self.observation_size},) or (n, {self.observation_size}), as with guidance "
                f"{self.config.guidance!r}: {self._remedy()}"
            )
        return values.float()

    def _remedy(self) -> str:
        return "make the environment with policy.make(num_envs=1), or by gym.make with **policy.env_kwargs."

    def __repr__(self) -> str:
        """Such as "TaskPolicy(DoraCube-v1, ppo, 211 -> 26)"."""
        return f"TaskPolicy({self.env_id}, {self.config.agent}, {self.observation_size} -> {self.action_size})"


def traits(env: DoraEnv) -> dict[str, Any]:
    """What decides what the observations and actions of an environment mean, by name."""
    space = env.single_observation_space
    plain_state = space["state"] if isinstance(space, Dict) else space
    return {
        "guidance": _words(env.parts),
        "control mode": " and ".join(sorted({arm.agent.control_mode for arm in env.arms.values()})),
        "observation size": plain_state.shape[0],  # pyright: ignore[reportOptionalSubscript]
        "action size": env.action_size,
        **_meaning(plain(env.config)),
    }


def _words(parts: frozenset[str]) -> str:
    """Guidance that a policy meets, by what it is called; with its parts, if they are not both there."""
    name = GUIDANCE[0] if REGION in parts else GUIDANCE[1] if parts else GUIDANCE[2]
    met = [part for part in (OBSERVATION, PRIOR) if part in parts]
    return name if len(met) != 1 else f"{name} ({met[0]} alone)"


def _meaning(numbers: dict[str, Any]) -> dict[str, Any]:
    """Of the numbers of a task those that say what an action means, and its switches."""
    named = {n: v for n, v in numbers.items() if n in COMPARED or isinstance(v, bool | str)}
    deeper = {n: v for n, v in flat(numbers) if n in COMPARED}
    return {f"config.{n}": v for n, v in (named | deeper).items()}


def bundled_files(env_id: str) -> tuple[Path, Path]:
    """Where checkpoint and card of a task's policy are, or would be; a policy may have no card."""
    return BUNDLED / f"{env_id}.safetensors", BUNDLED / f"{env_id}.json"


def bundled_ids() -> list[str]:
    """Ids of the tasks whose policies come with Dora, sorted."""
    return [env_id for env_id in task_ids() if bundled_files(env_id)[0].is_file()]


def load_policy(which: str | Path) -> TaskPolicy:
    """The policy that comes with Dora for a task, or that of a run or checkpoint of one's own.

    Args:
        which: a task id such as "DoraHammer-v1"; or the path of a run folder, for its best policy, or of a
            .safetensors file.

    Raises:
        InputError: for an unknown id, a task without a policy, or a file that is no checkpoint.
    """
    if isinstance(which, str) and which.removeprefix("dora:") in task_ids():
        env_id = which.removeprefix("dora:")
        path, card = bundled_files(env_id)
        if env_id not in bundled_ids():
            raise InputError(
                f"no policy of {env_id} comes with Dora (there are those of {', '.join(bundled_ids())}): "
                f"train one by dora run --env {env_id} and load its folder."
            )
        return TaskPolicy(read_checkpoint(path), path, Card.read(card) if card.is_file() else None)
    if isinstance(which, str) and not os.path.exists(which):
        check_task_id(which)
    path = checkpoint_path(Path(which))
    return TaskPolicy(read_checkpoint(path), path)
