"""What is said of a task in a dataset: rates, names of the numbers of its observation and action, what it is about."""

from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.spaces import Box
from jaxtyping import Bool

from dora.sim.robot_agent import CONTROL_MODES
from dora.tasks.env.env import DoraEnv

WRIST = ("wrist_x", "wrist_y", "wrist_z", "wrist_turn_x", "wrist_turn_y", "wrist_turn_z")
"""Names of an action's first numbers: step of the wrist, or the correction of it."""


@dataclass(frozen=True)
class Facts:
    """What holds for all episodes of a dataset.

    Attributes:
        env_id: a Dora id.
        task: what is to be done, a sentence.
        robot: name of the robot's folder; of several, joined by "+".
        rate: control steps per second [Hz].
        observation_names: a name for each number of the observation, such as "hand_q.3".
        sensed: which of them a robot knows without looking.
        action_names: a name for each number of the action.
        observation_space: of one environment.
        action_space: of one environment.
    """

    env_id: str
    task: str
    robot: str
    rate: int
    observation_names: tuple[str, ...]
    sensed: Bool[np.ndarray, " o"]
    action_names: tuple[str, ...]
    observation_space: Box
    action_space: Box


def facts_of(env: gym.Env) -> Facts:
    """The facts of a batch that has been reset."""
    task: Any = env.unwrapped
    assert isinstance(task, DoraEnv)
    assert task.spec is not None
    entries = {name: (entry.value(task.observed).shape[-1], entry) for name, entry in task.observation_entries.items()}
    names = tuple(f"{name}.{k}" for name, (size, _) in entries.items() for k in range(size))
    sensed = np.array([entry.sensed for size, entry in entries.values() for _ in range(size)])
    agents = getattr(task.agent, "agents", [task.agent])
    return Facts(
        env_id=task.spec.id,
        task=(type(task).__doc__ or task.spec.id).strip().splitlines()[0],
        robot="+".join(agent.uid for agent in agents),
        rate=int(task.control_freq),
        observation_names=names,
        sensed=sensed,
        action_names=_action_names(task),
        observation_space=Box(-np.inf, np.inf, (len(names),), np.float32),
        action_space=Box(-1.0, 1.0, (task.action_size,), np.float32),
    )


def _action_names(task: DoraEnv) -> tuple[str, ...]:
    """Wrist and hand joints of each arm where the action has just these, numbers otherwise."""
    names = [
        name if len(task.arms) == 1 else f"{arm_name}/{name}"
        for arm_name, arm in task.arms.items()
        for name in (*WRIST, *(arm.agent.joint_names[k] for k in arm.agent.hand_index))
    ]
    if task.control_mode != CONTROL_MODES[0] or len(names) != task.action_size:
        return tuple(f"action.{k}" for k in range(task.action_size))
    return tuple(names)
