"""Tools that count successes find the same ones on machines with any number of cores."""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch

from dora.datasets import record
from dora.datasets.episodes import Plan
from dora.datasets.sources import find_source
from dora.tools import filter_benchmark, oracle, physics_benchmark

TOOLS: dict[str, tuple[Any, Callable[[], Any]]] = {
    "oracle": (
        oracle,
        lambda: oracle.outcome(oracle.Args("DoraCube-v1", 1), oracle.no_action, 1.0, lambda done, total: None),
    ),
    "filter": (filter_benchmark, lambda: filter_benchmark.outcomes("DoraCube-v1", 1, "none", "nearest")),
    "physics": (
        physics_benchmark,
        lambda: physics_benchmark.measure_physics("DoraCube-v1", [physics_benchmark.parse_physics("100:5:8")], 1),
    ),
}
"""Module that plays episodes out, and a call of the function that makes it do so."""


class ReachedError(Exception):
    """Raised where the episodes would be played."""


def threads_of(run: Callable[[], Any], monkeypatch: pytest.MonkeyPatch, module: Any, name: str) -> list[int]:
    """Numbers of threads with which a function of a module is called, which then does nothing; before and after, torch
    has three."""
    threads = []

    def noted(*args: Any) -> None:
        threads.append(torch.get_num_threads())
        raise ReachedError

    monkeypatch.setattr(module, name, noted)
    before = torch.get_num_threads()
    torch.set_num_threads(3)
    try:
        with pytest.raises(ReachedError):
            run()
        assert torch.get_num_threads() == 3
    finally:
        torch.set_num_threads(before)
    return threads


@pytest.mark.parametrize("name", TOOLS)
def test_episodes_are_played_on_one_thread(name: str, monkeypatch: pytest.MonkeyPatch):
    """A policy's products are rounded otherwise on many threads, and chaos makes of that other episodes."""
    module, run = TOOLS[name]
    monkeypatch.setattr(module, "BATCH", 2, raising=False)
    assert threads_of(run, monkeypatch, module, "play_out") == [1]


def test_episodes_are_recorded_on_one_thread(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Of a policy other starts would end in a success otherwise."""
    source, plan = find_source("DoraCube-v1", "scripted"), Plan(episodes=1, num_envs=1)
    run = partial(record.record_dataset, "minari", source, plan, tmp_path / "made")
    assert threads_of(run, monkeypatch, record, "roll_out") == [1]
    assert not (tmp_path / "made").exists()
