"""Which grasps of a search get into a bundled set."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import Tensor

from dora.affordance.bundled_sets import load_candidates
from dora.affordance.candidates import GraspCandidates
from dora.affordance.objects.catalogue import load_object
from dora.progress import ProgressDisplay
from dora.robot import load_robot
from dora.sim.grasp_tests import bundle_maker
from dora.sim.grasp_tests.bundle_maker import SetMaker


def test_a_task_judges_grasps_with_the_approach_that_is_stored(monkeypatch: pytest.MonkeyPatch):
    """The hammer's: it stands on no table, so that only the task says what is within reach."""
    hammer, count = load_object("hammer"), 8
    found = load_candidates("hammer").select(slice(count))
    found = replace(found, valid=torch.ones(count, dtype=torch.bool), self_penetration=torch.zeros(count))
    free = torch.tensor([[0.0, 0.0, 1.0]]).repeat(count, 1)
    seen: list[Tensor] = []

    def usable(candidates: GraspCandidates) -> Tensor:
        seen.append(candidates.approach)
        return torch.arange(len(candidates)) % 2 == 0

    def freed(candidates: GraspCandidates, _: Any) -> tuple[GraspCandidates, Tensor]:
        return replace(candidates, approach=free[: len(candidates)]), torch.ones(len(candidates), dtype=torch.bool)

    def passed(candidates: GraspCandidates, *_: Any, **__: Any) -> Any:
        return SimpleNamespace(strict=torch.ones(len(candidates), dtype=torch.bool))

    monkeypatch.setattr(bundle_maker, "optimise", lambda *_, **__: found)
    monkeypatch.setattr(bundle_maker, "free_approaches", freed)
    monkeypatch.setattr(bundle_maker, "validate", passed)
    maker = SetMaker(hammer, load_robot("diana7_hit"), ProgressDisplay(), usable)
    good = maker.valid(count, 0, None, usable)
    assert good is not None
    assert [torch.equal(each, free) for each in seen] == [True]
    assert len(good) == count / 2
    assert torch.equal(good.position, found.position[::2])
    assert maker.valid(count, 0, None, lambda c: torch.zeros(len(c), dtype=torch.bool)) is None
