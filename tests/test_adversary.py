"""The tool that steps tasks with extreme actions: every kind of robot is attacked, and a bad number is not missed."""

from types import SimpleNamespace
from typing import Any

import gymnasium as gym
import pytest
import torch
from gymnasium import spaces

import dora.sim
from dora.tools import adversary


@pytest.mark.parametrize("env_id", ["TwoRobotPickCube-v1", "PushCube-v1", "DoraMicrowave-v1"])
def test_one_robot_and_several_are_attacked_and_end_well(env_id):
    options: Any = {"num_envs": 3, "sim_backend": dora.sim.BACKEND, "render_backend": "none"}
    env: Any = gym.make(env_id, obs_mode="state", **options).unwrapped
    sent = []
    step, env.step = env.step, lambda action: (sent.append(action), step(action))[1]
    report = adversary.attack(env, 30)
    assert report.good, report
    assert (report.steps, len(sent)) == (30, 10)
    parts = [p for action in sent for p in (action.values() if isinstance(action, dict) else [action])]
    assert all(part.shape[0] == 3 and part.abs().max() > 1e29 for part in parts)
    assert not isinstance(env.single_action_space, spaces.Dict) or all(len(action) == 2 for action in sent)
    env.close()


class Task:
    """Ten steps an episode; at step `when` the named place holds a number that is not finite."""

    num_envs, max_steps = 2, 10
    single_action_space = spaces.Box(-1, 1, (3,))

    def __init__(self, place: str, when: int = 4):
        self.place, self.when, self.elapsed_steps, self.restarted = place, when, torch.zeros(2), []

    def reset(self, seed=None, options=None):
        if options:
            self.restarted.append(options["env_idx"].tolist())
            self.elapsed_steps[options["env_idx"]] = 0
        return self._with("reset" if options else "", torch.ones(2, 4)), {}

    def step(self, action):
        self.elapsed_steps += 1
        info = {"nonfinite": torch.zeros(2, dtype=torch.bool), "reach": self._with("info", torch.ones(2))}
        reward = self._with("reward", torch.ones(2))
        return self._with("observation", torch.ones(2, 4)), reward, torch.zeros(2, dtype=torch.bool), False, info

    def _with(self, place: str, values: torch.Tensor) -> torch.Tensor:
        if place == self.place and (place == "reset" or self.elapsed_steps[1] == self.when):
            values[1] = torch.inf
        return values


@pytest.mark.parametrize("place", ["observation", "reward", "info", "reset"])
def test_a_number_that_is_not_finite_is_seen_wherever_it_is(place):
    report = adversary.attack(task := Task(place), 40)
    assert report.bad_steps == 2
    assert "BAD" in str(report)
    assert (report.episodes, task.restarted) == (4, [[0, 1]] * 2)
    assert adversary.attack(Task("nowhere"), 40).good


def test_memory_that_grows_after_the_warm_up_is_bad(monkeypatch):
    amounts = iter([900.0, 100.0, 100.0 + adversary.GROWTH])
    monkeypatch.setattr(adversary, "memory", lambda: next(amounts))
    assert not adversary.attack(Task("nowhere"), 40).good
    amounts = iter([900.0, 100.0, 99.0 + adversary.GROWTH])
    assert adversary.attack(Task("nowhere"), 40).good


def test_a_task_without_a_robot_gets_no_action():
    generator = torch.Generator().manual_seed(0)
    assert adversary.extreme_action(None, 2, 0, generator) is None
    several = adversary.extreme_action(spaces.Dict(one=Task.single_action_space), 2, 0, generator)
    assert SimpleNamespace(**several).one.shape == (2, 3)
