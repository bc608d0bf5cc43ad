"""A policy may observe the exact correction of its candidate's error, to tell the learner from what is observed."""

from typing import Any

import pytest
import torch
from refusals import refused

from dora.agents.config import RunConfig
from dora.configs import plain
from dora.tasks import find_task, make_task
from dora.tasks.env.options import task_config
from dora.tools.oracle import exact_action

SWITCH: dict[str, Any] = {"observe_correction": True}


def observed(task: Any) -> torch.Tensor:
    """The entries of that name, of all arms."""
    names = [name for name in task.observation_entries if name.rpartition("/")[2] == "correction"]
    return torch.cat([task.observation_entries[name].value(task.observed) for name in names], -1)


@pytest.mark.parametrize(
    ("env_id", "more"),
    [("DoraJug-v1", {}), ("DoraJug-v1", {"misplaced": "object"}), ("DoraMicrowave-v1", {})],
)
def test_it_is_the_action_of_the_oracle_and_stays_for_the_episode(env_id: str, more: dict[str, Any]):
    task, without = (make_task(env_id, 3, preset="hard", config=c) for c in (more | SWITCH, more))
    observation, others = (t.reset(seed=4)[0] for t in (task, without))
    assert observation.shape[1] == others.shape[1] + task.action_size
    assert not any("correction" in name for name in without.observation_entries)
    first = observed(task)
    torch.testing.assert_close(first, exact_action(without), atol=1e-5, rtol=0)
    assert 0.1 < first.square().mean().sqrt() < 0.6
    assert len(first.unique(dim=0)) == 3
    for _ in range(3):
        action = 0.3 * first
        stepped = task.step(action)[0], without.step(action)[0]
    torch.testing.assert_close(observed(task), first, atol=1e-3, rtol=0)
    kept = [k for k in range(observation.shape[1]) if k not in _columns(task)]
    assert torch.equal(stepped[0][:, kept], stepped[1])  # nothing else changes


def _columns(task: Any) -> set[int]:
    """Columns of the observation that hold the correction."""
    columns, start = set(), 0
    for name, entry in task.observation_entries.items():
        size = entry.value(task.observed).shape[-1]
        columns |= set(range(start, start + size)) if name.endswith("correction") else set()
        start += size
    return columns


@pytest.mark.parametrize("options", [{"guidance": "none"}, {"guidance_parts": ["observation"]}])
def test_where_nothing_is_corrected_there_is_none(options: dict[str, Any]):
    task, without = (make_task("DoraCube-v1", 2, config=config, **options) for config in (SWITCH, {}))
    assert torch.equal(task.reset(seed=1)[0], without.reset(seed=1)[0])


def test_actions_that_correct_no_reference_are_refused():
    with refused("A correction needs actions that correct a reference", seconds=30.0):
        make_task("DoraCube-v1", 2, control_mode="pd_joint_pos", config=SWITCH).reset(seed=0)


def test_settings_without_the_switch_keep_their_digest():
    numbers = plain(task_config(find_task("DoraJug-v1").CONFIG, "standard", None))
    with_it, off = RunConfig("DoraJug-v1", "sac", task=numbers | SWITCH), RunConfig("DoraJug-v1", "sac", task=numbers)
    earlier = RunConfig("DoraJug-v1", "sac", task={k: v for k, v in numbers.items() if k != "observe_correction"})
    assert off.digest() == earlier.digest() != with_it.digest()
