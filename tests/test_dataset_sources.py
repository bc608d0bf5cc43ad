"""What acts in a dataset, from which starts, and what is recorded of it, without a simulator."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch

from dora.datasets import sources
from dora.datasets.episodes import Plan, Source, make_batch, roll_out
from dora.datasets.sources import find_source
from dora.errors import InputError
from dora.sim import BACKEND

ENV = "DoraCube-v1"
USUAL = {"obs_mode": "state", "reward_mode": "dense"}


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """What policies are loaded from; they are invented."""
    asked: list[Any] = []
    policy = SimpleNamespace(
        env_id=ENV, env_kwargs={"preset": "hard", "guidance": "grasps"}, env_steps=12_345,
        config=SimpleNamespace(agent="ppo"),
    )  # fmt: skip
    monkeypatch.setattr(sources, "load_policy", lambda place: asked.append(place) or policy)
    return asked


@pytest.mark.parametrize(
    ("which", "place", "name"),
    [
        ("policy", ENV, "policy"),
        ("runs/a.b/best.safetensors", Path("runs/a.b/best.safetensors"), "a.b"),
        ("runs/lift0.12/checkpoints/best.safetensors", Path("runs/lift0.12/checkpoints/best.safetensors"), "lift0.12"),
        ("results/sac-s10/policy.safetensors", Path("results/sac-s10/policy.safetensors"), "sac-s10"),
        ("policy/policy.safetensors", Path("policy/policy.safetensors"), "own-policy"),
        ("lift0.15.safetensors", Path("lift0.15.safetensors"), "lift0.15"),
        ("runs/new", Path("runs/new"), "new"),
    ],
)
def test_a_policy_is_found_by_its_task_or_its_path(asked: list[Any], which: str, place: Any, name: str):
    found = find_source(ENV, which)
    assert asked == [place]
    assert (found.name, found.description) == (name, "A policy trained with PPO for 12,345 steps.")
    assert found.options == {**USUAL, "preset": "hard", "guidance": "grasps"}
    assert find_source(ENV, which, "none").options["preset"] == "none"
    with pytest.raises(InputError, match=f"{which} is a policy of {ENV}, not of DoraJug-v1"):
        find_source("DoraJug-v1", which)


def test_a_run_folder_gives_its_name_with_all_its_dots(asked: list[Any], tmp_path: Path):
    for name in ("lift0.12", "lift0.15"):
        (tmp_path / name).mkdir()
        assert find_source(ENV, str(tmp_path / name)).name == name


@pytest.mark.parametrize(("preset", "kept"), [(None, "standard"), ("hard", "hard")])
def test_the_scripted_solution_acts_without_guidance(asked: list[Any], preset: str | None, kept: str):
    found = find_source(ENV, "scripted", preset)
    assert (found.name, found.env_id) == ("scripted", ENV)
    assert found.options == {**USUAL, "guidance": "none", "preset": kept}
    assert asked == []
    with pytest.raises(InputError, match="did you mean 'standard'"):
        find_source(ENV, "scripted", "standart")


@pytest.mark.parametrize(("pictures", "mode"), [(False, "state"), (True, "state+rgb")])
def test_cameras_are_on_only_for_pictures(monkeypatch: pytest.MonkeyPatch, pictures: bool, mode: str):
    made: list[Any] = []
    monkeypatch.setattr(gym, "make", lambda *words, **options: made.append((words, options)) or gym.Env())
    make_batch(Source("a", "b", ENV, {**USUAL, "preset": "none"}, lambda env, obs: obs), 5, pictures)
    assert made == [((ENV,), {**USUAL, "obs_mode": mode, "preset": "none", "num_envs": 5, "sim_backend": BACKEND})]


class Timed(gym.Env):
    """Three rows, which end after 2, 3 and 4 steps; even seeds succeed, of others the time is over."""

    num_envs = 3

    def __init__(self, pictures: bool):
        self.pictures, self.seeds = pictures, list[list[int]]()

    def seen(self) -> Any:
        state = torch.tensor(self.seeds[-1])[:, None] + 0.1 * self.count
        if not self.pictures:
            return state
        rgb = torch.full((3, 2, 4, 3), 10 * self.count, dtype=torch.uint8)
        return {"state": state, "sensor_data": {"front_camera": {"rgb": rgb}, "hand": {"rgb": rgb + 1}}}

    def reset(self, *, seed: Any = None, options: Any = None) -> Any:
        self.seeds.append(seed)
        self.count, self.actions = 0, list[Any]()
        return self.seen(), {}

    def step(self, action: Any) -> Any:
        self.count += 1
        assert self.count < 5
        ended, even = self.count == torch.arange(2, 5), torch.tensor(self.seeds[-1]) % 2 == 0
        return self.seen(), torch.full((3,), 0.5), ended & even, ended & ~even, {"success": ended & even}


@pytest.mark.parametrize("pictures", [False, True])
def test_a_round_takes_as_many_starts_as_are_missing(pictures: bool):
    env, told = Timed(pictures), list[tuple[int, int]]()

    def act(env: gym.Env, obs: torch.Tensor) -> Any:
        return np.array([[3.0, -3.0, 0.25]] * 3) * (1 + 0 * obs[:, :1].numpy())

    rows, episodes = zip(*roll_out(env, act, Plan(5, seed=4, num_envs=3), lambda *now: told.append(now)), strict=True)
    assert env.seeds == [[4, 5, 6], [7, 8, 9]]
    assert rows == (0, 1, 2, 0, 1)
    assert told == [(1, 5), (2, 5), (3, 5), (4, 5), (5, 5)]
    assert [(e.seed, len(e), e.success) for e in episodes] == [
        (4, 2, True), (5, 3, False), (6, 4, True), (7, 2, False), (8, 3, True),
    ]  # fmt: skip
    for e in episodes:
        np.testing.assert_allclose(e.observations[:, 0], e.seed + 0.1 * np.arange(len(e) + 1), rtol=1e-6)
        assert e.actions.tolist() == [[1.0, -1.0, 0.25]] * len(e)
        assert e.rewards.tolist() == [0.5] * len(e)
        ends = [False] * (len(e) - 1) + [True]
        assert (e.terminated if e.success else e.truncated).tolist() == ends
        assert not (e.truncated if e.success else e.terminated).any()
        assert list(e.pictures) == (["front", "hand"] if pictures else [])
        for more, values in enumerate(e.pictures.values()):
            assert values[:, 1, 3, 2].tolist() == [10 * k + more for k in range(len(e) + 1)]


def test_failures_are_left_out_where_successes_alone_are_wanted():
    found = [e.seed for _, e in roll_out(Timed(False), lambda env, obs: obs, Plan(3, 1, True, 3))]
    assert found == [2, 4, 6]
