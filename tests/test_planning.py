"""Collisions by Pinocchio and Coal, and planned motions."""

import importlib

import numpy as np
import pytest
import trimesh

from dora.errors import InputError
from dora.robot import Shape
from dora.robot.motion import collision
from dora.robot.motion.collision import KINDS, CollisionModel
from dora.robot.motion.planning import EDGE_LIMIT, PlanSettings, densified, plan

WALL = Shape("box", (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), (0.02, 0.25, 0.3))
WALL_PLACE = np.array([0.55, 0.25, 0.3]), np.array([np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)])
CLEARANCE = {"arm": 0.002, "table": 0.005, "arm object": 0.005, "hand object": 0.005}
RAMP = 0.3
"""Time from rest to full speed [s]."""
CHECK_SPACING = 0.002
"""Distance of postures at which a plan is checked [rad]; finer than what the planner looks at."""


@pytest.fixture(scope="module")
def walled(robot):
    model = CollisionModel(robot, [WALL], clearance=CLEARANCE)
    model.place_object(*WALL_PLACE)
    return model


def postures(robot, count, spread=0.6, seed=0):
    home = robot.postures["home"].arm
    noise = np.random.default_rng(seed).normal(size=(count, len(home))) * spread
    return np.clip(home + noise, robot.arm.lower, robot.arm.upper)


def test_home_is_free_and_stretching_down_hits_the_table(robot):
    model, home = CollisionModel(robot), robot.postures["home"]
    assert model.touching(home.arm, home.hand) is None
    low = home.arm.copy()
    low[1] = 1.5
    assert "table" in (model.touching(low, home.hand) or ())


def test_bending_the_wrist_hits_the_arm_with_the_hand(robot):
    home = robot.postures["home"]
    bent = home.arm.copy()
    bent[5] = 2.34
    pair = CollisionModel(robot, clearance={"arm": 0.0}).touching(bent, home.hand)
    assert pair == ("link5", "base_link_hithand")


def test_the_object_is_where_it_was_placed(robot):
    home = robot.postures["home"]
    model = CollisionModel(robot, [Shape("sphere", (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), (0.03,))])
    for place, hit in (((0.49, 0.0, 0.28), True), ((0.9, 0.4, 0.5), False), ((0.49, 0.0, 0.28), True)):
        model.place_object(np.array(place), np.array([1.0, 0.0, 0.0, 0.0]))
        assert (model.touching(home.arm, home.hand) is not None) == hit


@pytest.mark.parametrize("margin", [0.02, 0.0, -0.003])
def test_clearance_is_a_distance(robot, margin):
    """A ball sinking onto the outstretched hand touches it exactly `margin` before (or after) the surfaces meet."""
    home, radius = robot.postures["home"], 0.03
    ball = trimesh.creation.icosphere(subdivisions=4, radius=radius)
    places = np.array([0.49, 0.0, 0.6]) - np.linspace(0.0, 0.3, 3001)[:, None] * np.array([0.0, 0.0, 1.0])

    def first(model):
        for index, place in enumerate(places):
            model.place_object(place, np.array([1.0, 0.0, 0.0, 0.0]))
            if not model.free(home.arm[None], home.hand):
                return index
        raise AssertionError("the ball never touches")

    solid = Shape("sphere", (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), (radius + margin,))
    grown = first(CollisionModel(robot, [solid], clearance={"hand object": 0.0}))
    margined = first(CollisionModel(robot, [ball], clearance={"hand object": margin}))
    assert abs(grown - margined) <= 3


def test_broad_phase_agrees_with_all_pairs(robot):
    """The fast test finds what testing every pair finds, with margins of either sign."""
    hand = robot.postures["home"].hand
    for margin in (0.02, -0.003):
        model = CollisionModel(robot, [WALL], clearance=dict.fromkeys(KINDS, margin))
        model.place_object(*WALL_PLACE)
        pin = model._pin
        for q in postures(robot, 150, 0.5):
            free = model.free(q[None], hand)
            every = pin.computeCollisions(model._model, model._data, model._geometry, model._results, model._q, True)
            assert free != every


def test_unknown_kinds_of_pairs_are_refused(robot):
    with pytest.raises(InputError, match="hand floor"):
        CollisionModel(robot, clearance={"hand floor": 0.0})


@pytest.mark.parametrize("module", ["pinocchio", "coal"])
def test_a_missing_package_is_named(robot, monkeypatch, module):
    real = importlib.import_module

    def refuse(name):
        if name == module:
            raise ImportError(name)
        return real(name)

    monkeypatch.setattr(collision, "import_module", refuse)
    with pytest.raises(InputError, match="pip install"):
        CollisionModel(robot)


def test_plans_are_free_within_limits_and_repeatable(robot, walled):
    home = robot.postures["home"]
    goals = [q for q in postures(robot, 25) if walled.free(q[None], home.hand)][:8]
    searched = 0
    for goal in goals:
        path = plan(walled, home.arm, goal, home.hand)
        assert path is not None
        np.testing.assert_allclose(path[[0, -1]], [home.arm, goal], atol=1e-12)
        assert np.linalg.norm(np.diff(path, axis=0), axis=1).max() <= EDGE_LIMIT + 1e-9
        assert ((path >= robot.arm.lower) & (path <= robot.arm.upper)).all()
        assert walled.free(densified(path, CHECK_SPACING), home.hand)
        np.testing.assert_array_equal(path, plan(walled, home.arm, goal, home.hand))
        length = np.linalg.norm(np.diff(path, axis=0), axis=1).sum()
        searched += length > np.linalg.norm(goal - home.arm) + 1e-6
    assert searched >= 2  # of the motions some are blocked by the wall


def test_another_seed_gives_another_path(robot, walled):
    home = robot.postures["home"]
    goals = [q for q in postures(robot, 25) if walled.free(q[None], home.hand)][:8]
    paths = [[plan(walled, home.arm, goal, home.hand, PlanSettings(seed=seed)) for goal in goals] for seed in (0, 7)]
    assert any(a is not None and b is not None and a.shape != b.shape for a, b in zip(*paths, strict=True))


def test_there_is_no_plan_to_a_posture_that_touches(robot, walled):
    home = robot.postures["home"]
    blocked = next(q for q in postures(robot, 50) if not walled.free(q[None], home.hand))
    assert plan(walled, home.arm, blocked, home.hand) is None


def test_a_goal_outside_the_limits_is_refused(robot, walled):
    home = robot.postures["home"]
    with pytest.raises(InputError, match="goal"):
        plan(walled, home.arm, robot.arm.upper + 0.1, home.hand)
