"""Observations and actions of earlier control steps in the observation."""

import dataclasses
from typing import Any

import pytest
import torch
from invented import invented
from torch import Tensor

from dora import tasks
from dora.agents.runs.recommended import recommended
from dora.configs import plain
from dora.tasks.env.options import task_config
from dora.tasks.jug import JugConfig
from dora.tasks.mdp.history import History
from dora.tasks.mdp.observations import Entry

STEPS = 2
SEEDS = [4, 5, 6]


def pair(env_id: str) -> tuple[Any, Any]:
    """The same task with history and without."""
    return tasks.make_task(env_id, 3, config={"history": STEPS}), tasks.make_task(env_id, 3)


def frame(observation: Tensor, action: Tensor) -> Tensor:
    return torch.cat([observation, action], -1)


def test_frames_are_what_was_observed_and_done_newest_first():
    """Before an episode has had so many steps its first observation stands for those before; also after a reset of one
    row, which the others do not notice."""
    long, short = pair("DoraJug-v1")
    seen, now = long.reset(seed=SEEDS)[0], short.reset(seed=SEEDS)[0]
    size = now.shape[1]
    idle = torch.zeros(3, long.action_size)
    past = [frame(now, idle)] * STEPS
    generator = torch.Generator().manual_seed(0)
    for k in range(5):
        assert torch.equal(seen, torch.cat([now, *past], -1))
        if k == 3:
            options = {"env_idx": torch.tensor([1])}
            seen, now = long.reset(options=options)[0], short.reset(options=options)[0]
            fresh = frame(now, idle)
            past = [torch.where(torch.tensor([[False], [True], [False]]), fresh, old) for old in past]
            assert torch.equal(seen, torch.cat([now, *past], -1))
        action = 2 * torch.rand(3, long.action_size, generator=generator) - 1
        past = [frame(now, action), *past[:-1]]
        seen, now = long.step(action)[0], short.step(action)[0]
    assert seen.shape[1] == size + STEPS * (size + long.action_size)
    long.step(None)
    assert torch.equal(long.get_obs()[:, size : size + size + long.action_size], frame(now, idle))
    long.close()
    short.close()


def test_an_arm_remembers_what_it_saw_and_did_itself():
    long, short = pair("DoraMicrowave-v1")
    first = short.reset(seed=SEEDS)[0]
    long.reset(seed=SEEDS)
    action = torch.linspace(-1, 1, 3 * long.action_size).reshape(3, -1)
    seen = long.step(action)[0]
    columns, own = long.agent_columns, short.agent_columns
    for arm, (observed, acted) in columns.items():
        assert acted == own[arm][1]
        past = frame(first[:, own[arm][0]], action[:, acted])
        start = frame(first[:, own[arm][0]], torch.zeros_like(action[:, acted]))
        assert len(observed) == len(own[arm][0]) + STEPS * past.shape[1]
        kept = [name for name in long.observation_entries if name.endswith("history")]
        assert kept == [f"{name}/history" for name in columns]
        history = long.observation_entries[f"{arm}/history"].value(long.observed)
        assert torch.equal(history, torch.cat([past, start], -1))
        assert set(history[0].tolist()) <= set(seen[0, observed].tolist())
    long.close()
    short.close()


@pytest.mark.parametrize("env_id", ["DoraJug-v1", "DoraHammer-v1"])
def test_a_restored_episode_goes_on_with_its_history(env_id: str):
    """The hammer's task has a memory of its own, which is called history, too."""
    task = tasks.make_task(env_id, 3, config={"history": STEPS})
    task.reset(seed=SEEDS)
    for k in range(3):
        task.step(torch.full((3, task.action_size), 0.1 * k))
    entry = task.observation_entries["history"]
    state, history = task.get_state_dict(), entry.value(task.observed).clone()
    assert state["past"]["frames"].shape == (3, history.shape[1])
    task.step(torch.ones(3, task.action_size))
    assert not torch.equal(entry.value(task.observed), history)
    other = tasks.make_task(env_id, 3, config={"history": STEPS})
    other.reset(seed=1)
    for made in (task, other):
        made.set_state_dict(state)
        assert torch.equal(made.observation_entries["history"].value(made.observed), history)
        made.close()


def test_without_history_nothing_is_kept():
    task = tasks.make_task("DoraJug-v1", 2)
    task.reset(seed=0)
    assert "history" not in task.observation_entries
    assert "past" not in task.get_state_dict()
    task.close()
    none = History(0, {"x": Entry(lambda s: s.time[:, None], "1", "time")}, {"arm": 2}, 1, "cpu")
    none.push(invented(1), torch.zeros(1, 2))
    assert none.entries == {}
    assert none.buffers.names == ()


@pytest.mark.parametrize("steps", [0, 3])
def test_settings_of_runs_before_have_no_history(steps: int):
    config = recommended("DoraJug-v1", "sac", task=plain(task_config(JugConfig, "standard", {"history": steps})))
    before = {name: value for name, value in config.task.items() if name != "history"}
    assert (dataclasses.replace(config, task=before).digest() == config.digest()) == (steps == 0)
