"""What a page says of an episode, stages of each arm by themselves, and who may act."""

import re
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import pytest
import torch
from live import Watched

from dora.agents.runs.recommended import recommended
from dora.commands import play
from dora.errors import InputError
from dora.live.players import ZERO, Player
from dora.live.reading import verdict
from dora.live.status import ACTIVE, GOOD, QUIET, status
from dora.policies.policy import TaskPolicy
from dora.tasks import find_task


@pytest.fixture(scope="module")
def hammer() -> Iterator[Watched]:
    watched = Watched("DoraHammer-v1", preset="none")
    yield watched
    watched.session.stop()


def info(**given: float | bool) -> dict[str, torch.Tensor]:
    base = {"success": False, "raw_success": False, "fail": False, "unreachable": False, "penetration_max_mm": 1.0}
    return {name: torch.tensor([value]) for name, value in {**base, **given}.items()}


@pytest.mark.parametrize(
    ("given", "over", "words"),
    [
        ({}, False, "under way"),
        ({}, True, "failed: the time was over in the stage 'stabilise'"),
        ({"fail": True}, True, "failed: it burst"),
        ({"fail": True, "unreachable": True}, True, "failed: no candidate can be reached from this start"),
        ({"success": True}, True, "success: all stages done, largest overlap 1.0 mm"),
        (
            {"raw_success": True, "penetration_max_mm": 7.25},
            True,
            "failed: an overlap of 7.2 mm, above the limit of 5 mm",
        ),
        ({"penetration_max_mm": 7.25}, False, "cannot succeed any more: an overlap of 7.2 mm, above the limit of 5 mm"),
    ],
)
def test_the_verdict_names_the_cause(hammer: Watched, given: dict[str, Any], over: bool, words: str):
    assert verdict(hammer.state.setup, (1,), "it burst", info(**given), over) == words


@pytest.mark.parametrize(
    ("stages", "words"),
    [((0, 2), "'open'"), ((2, 1), "'put_in'"), ((1, 0), "'leave' and 'carry'"), ((2, 2), "'leave' and 'put_in'")],
)
def test_each_arm_has_a_ladder_of_its_own(hammer: Watched, stages: tuple[int, int], words: str):
    """An arm that is ahead says nothing about the other; last, both were done, but not at the same time."""
    ladders = ("open", "leave"), ("carry", "put_in")
    setup = replace(hammer.state.setup, ladders=ladders)
    assert verdict(setup, stages, "", info(), True) == f"failed: the time was over in the stage {words}"
    shown = status(replace(hammer.state, setup=setup, episode=replace(hammer.state.episode, stages=stages)))
    for ladder, active in zip(ladders, stages, strict=True):
        for k, name in enumerate(ladder):
            (box,) = re.findall(rf"background: (#\w+);[^>]*>{name}</span>", shown)
            assert box == (GOOD if k < active else ACTIVE if k == active else QUIET), name


def busy(observation: torch.Tensor) -> torch.Tensor:
    return torch.full((1, 26), 0.8)


def test_a_policy_keeps_its_numbers_of_the_task_under_another_preset():
    player = Player("policy", {"preset": "standard", "config": {"lift": 0.12, "randomisation": {"size": 0.5}}}, busy)
    options = player.options_with("DoraCube-v1", "none")
    assert options["preset"] == "none"
    assert options["config"]["lift"] == 0.12
    assert options["config"]["randomisation"]["size"] == 0.0


@pytest.mark.parametrize(
    ("guidance", "parts", "offered"),
    [
        ("affordance", None, True), ("grasps", None, True), ("none", None, False),
        ("affordance", ("observation", "reward"), False),
    ],
)  # fmt: skip
def test_zero_correction_is_offered_where_there_is_a_reference_to_correct(
    guidance: Any, parts: Any, offered: bool, monkeypatch: pytest.MonkeyPatch
):
    config = recommended("DoraCube-v1", "ppo", find_task("DoraCube-v1").LEARNERS, guidance=guidance)
    config = replace(config, guidance_parts=parts)
    policy = object.__new__(TaskPolicy)
    policy.config = config
    monkeypatch.setattr(play, "load_policy", lambda _: policy)
    assert [player.name for player in play.find_players(play.Args("DoraCube-v1"))] == ["policy", ZERO][: 1 + offered]
    if not offered:
        with pytest.raises(InputError, match="without any"):
            play.find_players(play.Args("DoraCube-v1", zero_correction=True))
