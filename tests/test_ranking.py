"""Ranking of grasps by executed lifts."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from dora.affordance.bundled_sets import load_candidates
from dora.affordance.objects.catalogue import load_object
from dora.errors import InputError
from dora.robot import load_robot
from dora.sim.grasp_tests.lift_test import Execution, Purpose, lifts_of, rank

ROBOT = load_robot("diana7_hit")
CUBE = load_object("cube")
EXACT = Execution(draws=2, position=0.0, rotation=0.0, friction=(0.85, 1.0), mass=(0.9, 1.1))


def test_a_good_grasp_lifts_and_bad_ones_do_not():
    good = load_candidates("cube").select([0])
    away = replace(good, position=good.position + torch.tensor([0.0, 0.0, 0.15]))
    below = replace(good, position=good.position - torch.tensor([0.0, 0.0, 0.08]))
    limp = replace(good, grasp=good.pregrasp)
    scores = [float(rank(candidates, CUBE, ROBOT, EXACT, processes=1)) for candidates in (good, away, below, limp)]
    assert scores == [1.0, 0.0, 0.0, 0.0]


def test_a_mass_beyond_its_strength_is_not_lifted():
    good = load_candidates("cube").select([0])
    heavy = replace(EXACT, mass=(100.0, 100.0))
    assert float(rank(good, CUBE, ROBOT, heavy, processes=1)) == 0.0


def test_draws_are_within_range_shared_by_candidates_and_new_for_reporting():
    candidates, execution = load_candidates("cube").select(slice(4)), Execution(draws=50)
    lifts = lifts_of(candidates, CUBE, execution, np.random.default_rng(0))
    assert len(lifts) == 50 * len(candidates)
    mass = np.array([lift.mass for lift in lifts]).reshape(-1, 50)
    assert (mass >= 0.75 * CUBE.mass).all()
    assert (mass <= 1.5 * CUBE.mass).all()
    assert (mass == mass[0]).all()
    assert np.ptp(mass[0]) > 0.5 * CUBE.mass
    assert all(0.6 <= lift.friction <= 1.0 for lift in lifts)
    nominal = CUBE.support + candidates.position[0, 2].item()
    assert all(abs(lift.position[2] - nominal) <= 0.005 + 1e-6 for lift in lifts[:50])


def test_ranking_and_reporting_draw_differently_and_repeatably(monkeypatch: pytest.MonkeyPatch):
    seen = []
    monkeypatch.setattr(
        "dora.sim.grasp_tests.lift_test.run_cases",
        lambda _, __, cases, *___: seen.append(cases[0].mass) or [True] * len(cases),
    )
    calls: list[tuple[Purpose, int]] = [("ranking", 0), ("reporting", 0), ("ranking", 0), ("ranking", 1)]
    for purpose, seed in calls:
        rank(load_candidates("cube").select(slice(4)), CUBE, ROBOT, purpose=purpose, seed=seed)
    assert seen[0] == seen[2]
    assert len(set(seen)) == 3


@pytest.mark.parametrize("change", [{"draws": 0}, {"mass": (2.0, 1.0)}, {"friction": (0.0, 1.0)}])
def test_a_senseless_execution_is_refused(change: dict[str, object]):
    with pytest.raises(InputError):
        Execution(**change)  # pyright: ignore[reportArgumentType]
