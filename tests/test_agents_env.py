"""Task environment: TorchRL's contract, true last observations, statistics."""

import dataclasses
from pathlib import Path
from typing import Any

import pytest
import torch
from fake_task import PointMass
from refusals import refused
from short_runs import BASE, run
from tensordict import TensorDict
from torchrl.envs import EnvBase
from torchrl.envs.utils import check_env_specs

from dora.agents.collecting.task_env import Easing, EpisodeColumns, TaskEnv, TrainingRules, ended_episodes
from dora.agents.seeds import TRAINING_SEEDS


def rollout(env: TaskEnv, steps: int) -> TensorDict:
    torch.manual_seed(0)
    data = env.rollout(steps, break_when_any_done=False)
    assert isinstance(data, TensorDict)
    return data


def test_specs_hold():
    check_env_specs(TaskEnv(PointMass(), seed=0))


def test_the_true_last_observation_is_kept_and_only_ended_rows_restart():
    env = TaskEnv(PointMass(4, max_steps=5), seed=0, rules=TrainingRules(stagger=True))
    data = rollout(env, 12)
    done = data["next", "done"][..., 0]
    moved = (data["next", "observation"][..., :2] - data["observation"][..., :2]).abs()
    assert moved.max() <= 0.15 + 1e-6  # one step, also where an episode ends
    after = data["observation"][:, 1:] - data["next", "observation"][:, :-1]
    jumped = after.abs().sum(-1) > 1e-6
    assert torch.equal(jumped, done[:, :-1])
    assert done.sum(1).min() >= 1
    assert not data["next", "terminated"].any()


def test_the_short_path_equals_torchrl_own():
    ours, theirs = (
        TaskEnv(PointMass(4, max_steps=5, fail_at=4), seed=1, rules=TrainingRules(stagger=True)) for _ in range(2)
    )
    state, reference = ours.reset(), theirs.reset()
    for _ in range(15):
        action = torch.rand(4, 2) * 2 - 1
        state["action"], reference["action"] = action, action
        out, state = ours.step_and_maybe_reset(state)
        expected, reference = EnvBase.step_and_maybe_reset(theirs, reference)
        for key in expected["next"].keys():  # noqa: SIM118
            assert torch.equal(out["next", key], expected["next", key]), key
        for key in ("observation", "done", "terminated", "truncated", "statistics"):
            assert torch.equal(state[key], reference[key]), key


def test_failure_terminates_and_the_limit_truncates():
    data = rollout(TaskEnv(PointMass(2, max_steps=5, fail_at=3), seed=0), 3)
    assert data["next", "terminated"][:, 2].all()
    assert not data["next", "truncated"].any()
    data = rollout(TaskEnv(PointMass(2, max_steps=3), seed=0), 3)
    assert data["next", "truncated"][:, 2].all()
    assert not data["next", "terminated"].any()


def test_statistics_are_those_of_the_episode():
    task = PointMass(3, max_steps=6)
    env = TaskEnv(task, seed=0)
    data = rollout(env, 12)
    ended = data["next", "statistics"][:, 5]
    columns = env.columns
    away = data["next", "observation"][..., :2] - data["next", "observation"][..., 2:]
    for name, value in {
        "return": data["next", "reward"][:, :6, 0].sum(1),
        "length": torch.full((3,), 6.0),
        "reward/distance": -torch.linalg.vector_norm(away[:, :6], dim=-1).mean(1),
    }.items():
        torch.testing.assert_close(columns.column(ended, name), value)
    assert columns.column(ended, "stage/approach").max() <= 1
    assert (columns.column(data["next", "statistics"][:, 6], "length") == 1).all()


def test_staggered_first_episodes_are_spread_and_not_counted():
    env = TaskEnv(PointMass(64, max_steps=16), seed=3, rules=TrainingRules(stagger=True))
    data = rollout(env, 48)
    first = data["next", "done"][..., 0].float().argmax(1)
    assert len(first.unique()) > 8
    ended = ended_episodes(data["next", "done"], data["next", "statistics"], env.columns)
    assert (env.columns.column(ended, "length") == 16).all()
    assert len(ended) >= 64


@pytest.mark.parametrize("after", [0, 2, 9])
def test_an_episode_ends_some_steps_after_its_first_success(after: int):
    task = PointMass(64, max_steps=12)
    data = rollout(TaskEnv(task, seed=0, rules=TrainingRules(after_success=after)), 120)
    columns = TaskEnv(task).columns
    success = columns.column(data["next", "statistics"], "success") > 0
    done, terminated = data["next", "done"][..., 0], data["next", "terminated"]
    early = 0
    for row in range(64):
        first, length = None, 0
        for t in range(120):
            length += 1
            first = t if first is None and success[row, t] else first
            wanted = length == 12 or (first is not None and t == first + after)
            assert bool(done[row, t]) == wanted
            early += wanted and length < 12
            if wanted:
                first, length = None, 0
    assert early > 10
    assert not terminated.any()
    ended = ended_episodes(data["next", "done"], data["next", "statistics"], columns)
    assert len(ended) == int(done.sum())  # whole ones: they are counted


def test_actions_are_clipped():
    task = PointMass(2)
    env = TaskEnv(task, seed=0)
    data = env.reset()
    before = task.position.clone()
    env.step(data.set("action", torch.full((2, 2), 9.0)))
    torch.testing.assert_close(task.position - before, torch.full((2, 2), 0.15))


def test_penetration_counts_as_the_deepest_and_success_as_the_last():
    columns = EpisodeColumns.of(("penetration_mm", "success", "success_any_penetration", "reward/x"))
    assert columns.last == ("success", "whole", "success_any_penetration")
    assert columns.highest == ("penetration_mm",)
    assert columns.total == ("return", "length", "reward/x")


def test_the_rows_of_a_training_have_seeds_that_no_evaluation_has():
    given: list[Any] = []

    class Recording(PointMass):
        def reset(self, seed: Any = None, options: dict[str, Any] | None = None) -> tuple[torch.Tensor, dict[str, Any]]:
            given.append(seed)
            return super().reset(seed, options)

    TaskEnv(Recording(64), seed=7).reset()
    first, again = given
    assert first == again
    assert len(set(first)) == 64
    assert all(0 <= seed < TRAINING_SEEDS for seed in first)


class Pressing(PointMass):
    """Points that pay half a unit for overlap in every step."""

    logged = (*PointMass.logged, "reward/penetration")

    def step(self, action: Any) -> Any:
        obs, reward, *ends, info = super().step(action)
        cost = torch.full_like(reward, -0.5)
        return obs, reward + cost, *ends, info | {"reward/penetration": cost}


@pytest.mark.parametrize(("begun", "workers"), [(0, 1), (200, 2)])
def test_overlap_costs_more_and_more_in_the_course_of_a_training(begun: int, workers: int):
    """From a hundredth at the first step of the run to all of it after 800, wherever this part of it begins."""
    easing = Easing(0.01, 800, begun, workers)
    eased, whole = (
        TaskEnv(Pressing(8), seed=0, rules=rules) for rules in (TrainingRules(easing=easing), TrainingRules())
    )
    action = torch.zeros(8, 2)
    paid = []
    for env in (eased, whole):
        state, rewards = env.reset(), []
        for _ in range(120):
            step, state = env.step_and_maybe_reset(state.set("action", action))
            rewards.append(step["next", "reward"][:, 0])
        paid.append(torch.stack(rewards))
    share = 1 - (paid[0] - paid[1]) / 0.5
    done = begun + workers * 8 * torch.arange(120.0)
    expected = 0.01 ** (1 - done / 800).clamp(min=0)
    torch.testing.assert_close(share, expected[:, None].expand(120, 8), atol=1e-5, rtol=0)
    assert share[0, 0] == pytest.approx(0.01 ** (1 - begun / 800), abs=1e-5)
    assert share[-1].min() == 1.0


def test_a_penalty_that_a_reward_lacks_cannot_be_eased():
    with refused("this reward has none"):
        TaskEnv(PointMass(2), rules=TrainingRules(easing=Easing(0.5, 10)))
    TaskEnv(PointMass(2), rules=TrainingRules(easing=Easing(1.0, 10)))


def test_the_settings_of_a_run_reach_its_environments(tmp_path: Path):
    with refused("this reward has none", seconds=60):
        run(tmp_path / "run", dataclasses.replace(BASE, overlap_share=0.5, overlap_steps=100, workers=0))
