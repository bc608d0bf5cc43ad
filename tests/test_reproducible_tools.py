"""Tools that count successes find the same ones on machines with any number of cores."""

from collections.abc import Callable
from typing import Any

import pytest
import torch

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


@pytest.mark.parametrize("name", TOOLS)
def test_episodes_are_played_on_one_thread(name: str, monkeypatch: pytest.MonkeyPatch):
    """Products of matrices are rounded by the number of threads: of 200 episodes of the jug .950 succeeded on two
    threads and .960 on one."""
    module, run = TOOLS[name]
    threads = []

    def noted(*args: Any) -> None:
        threads.append(torch.get_num_threads())
        raise ReachedError

    monkeypatch.setattr(module, "play_out", noted)
    monkeypatch.setattr(module, "BATCH", 2, raising=False)
    before = torch.get_num_threads()
    torch.set_num_threads(3)
    try:
        with pytest.raises(ReachedError):
            run()
        assert threads == [1]
        assert torch.get_num_threads() == 3
    finally:
        torch.set_num_threads(before)
