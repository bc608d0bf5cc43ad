"""What a live page says and draws of an episode, word for word, and its log of rewards, without a simulator."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from invented_live import DT, SETUP, episode, poses, state

from dora.live.reading import EpisodeLog, verdict
from dora.live.status import ACTIVE, BAD, GOOD, QUIET, status


def info(**given: float) -> dict[str, torch.Tensor]:
    return {name: torch.tensor([value]) for name, value in given.items()}


def box(colour: str, name: str) -> str:
    style = f"background: {colour}; color: white; border-radius: 3px; padding: 0 0.5em; margin-right: 0.3em"
    return f'<span style="{style}">{name}</span>'


def test_the_words_about_a_running_episode():
    setup = replace(SETUP, max_steps=160)
    assert status(state(3, setup=setup, seed=7)) == (
        '<div style="padding: 0.3em 1em; line-height: 1.6; font-size: 0.9em">'
        f'<div style="color: {ACTIVE}; font-weight: 700">under way</div>'
        f"<div>{box(ACTIVE, 'reach')}{box(QUIET, 'lift')}</div>"
        "<div>0.19 s of 10 s, seed 7, 0.50 of real time</div>"
        "<div>2 of 3 episodes succeeded; candidate 1: body; 2 of 3 can be reached</div></div>"
    )


@pytest.mark.parametrize(
    ("success", "over", "colour"), [(True, True, GOOD), (True, False, GOOD), (False, True, BAD), (False, False, ACTIVE)]
)
def test_the_colour_of_the_verdict(success: bool, over: bool, colour: str):
    assert f'"color: {colour}; font-weight: 700"' in status(state(success=success, over=over))


@pytest.mark.parametrize(("done", "colours"), [(0, (ACTIVE, QUIET)), (1, (GOOD, ACTIVE)), (2, (GOOD, GOOD))])
def test_stages_that_are_done_active_and_ahead(done: int, colours: tuple[str, str]):
    assert box(colours[0], "reach") + box(colours[1], "lift") in status(state(stages=(done,)))


def test_what_could_not_be_done_is_said_last_and_in_red():
    assert status(state(message="a < b")).endswith(f'<div style="color: {BAD}">a &lt; b</div></div>')
    assert BAD not in status(state())
    assert "stands still" in status(state(rate=0.0))


def test_candidates_of_several_arms_have_numbers_only():
    several = state(setup=replace(SETUP, candidates=()), chosen={"left": 4, "right": 2})
    assert "candidates 4, 2<" in status(several)


@pytest.mark.parametrize(("overlap", "words"), [(5.0, "under way"), (5.1, "cannot succeed any more")])
def test_an_overlap_up_to_the_limit_may_still_succeed(overlap: float, words: str):
    flags = info(success=False, raw_success=False, fail=False, unreachable=False, penetration_max_mm=overlap)
    assert verdict(SETUP, (0,), "", flags, False).startswith(words)


def test_a_log_grows_with_a_recording_that_is_longer_than_an_episode():
    log = EpisodeLog(SETUP)
    first = log.history
    for k in range(1, 14):
        values = {"reward/near": k, "reward/high": 10 * k} if k != 3 else {"reward/near": k}  # one that is missing
        log.add(k * DT, info(penetration_mm=k / 2, penetration_max_mm=k, **values))
    found, k = log.history, np.arange(1, 14)
    assert len(first.time) == 0
    assert found.time.tolist() == (k * DT).tolist()
    assert found.terms.tolist() == np.stack([k, np.where(k == 3, 0, 10 * k)], 1).tolist()
    assert found.overlap.tolist() == np.stack([k / 2, k], 1).tolist()


@pytest.mark.parametrize(
    ("later", "speed", "index"),
    [(-1.0, 1.0, 0), (0.3, 1.0, 0), (0.4, 1.0, 1), (0.7, 1.0, 2), (9.0, 1.0, 2), (0.7, 0.5, 1), (0.2, 2.0, 1)],
)
def test_each_third_of_a_control_step_shows_its_physics_step(later: float, speed: float, index: int):
    """Times in control steps, at a speed; the last of three physics steps is the state itself."""
    passed = poses(1.0), poses(2.0)
    found = state(at=2.0, speed=speed, passed=passed)
    shown = found.poses_at(2.0 + later * DT)
    assert shown == (index, (*passed, found)[index])
    assert episode().step == 0
