"""The quasi-static model of a squeezing hand: what it says of grasps whose outcome is known."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from other_robots import SHORT, changed, unchanged

from dora.affordance.bundled_sets import load_candidates
from dora.affordance.hand.grasp_test_settings import STANDARD, GraspTestSettings
from dora.affordance.hand.hand_model import HandModel
from dora.affordance.hand.postures import pregrasp, squeeze
from dora.affordance.maps.contact_semantic_map import wrist_matrix
from dora.affordance.objects.catalogue import load_object
from dora.affordance.objects.signed_distance import SignedDistanceField
from dora.affordance.search import quasi_static_closing
from dora.affordance.search.compiled import CompiledEnergy
from dora.affordance.search.quasi_static_closing import ClosedHand, close_hand
from dora.geometry.rotations import matrix_from_quaternion
from dora.robot import load_robot

ROBOT, CUBE = load_robot("diana7_hit"), load_object("cube")
HELD = 0.02
"""Displacement below which an object counts as held [m]."""


@pytest.fixture(scope="module")
def energy() -> CompiledEnergy:
    return CompiledEnergy(HandModel(ROBOT), SignedDistanceField(CUBE.solid))


def held(
    energy: CompiledEnergy,
    away: float = 0.0,
    mass: float = CUBE.mass,
    test_settings: GraspTestSettings = STANDARD,
    open_: bool = False,
) -> ClosedHand:
    """The best four stored grasps of the cube, moved up by `away` [m]."""
    grasps = load_candidates("cube").select(slice(4))
    wrist = torch.eye(4).repeat(4, 1, 1)
    wrist[:, :3, :3] = matrix_from_quaternion(grasps.quaternion)
    wrist[:, :3, 3] = grasps.position + torch.tensor([0.0, 0.0, away])
    opened = pregrasp(ROBOT, grasps.joints)
    return close_hand(energy, wrist, opened, opened if open_ else squeeze(ROBOT, grasps.joints), mass, test_settings)


def test_grasps_that_hold_in_simulation_hold_in_the_model(energy: CompiledEnergy):
    found = held(energy)
    assert (found.displacement.amax(-1) < HELD).sum() >= 3
    assert (found.force > 5).all()
    assert (found.shift < HELD).all()


def test_a_finger_with_fewer_joints_leaves_the_first_joint_of_the_hand_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """Chains are padded to the longest one, and what stands for no joint has the index of the first."""
    short = changed(tmp_path / "short", unchanged, short=True)
    ends: list[np.ndarray] = []

    def kept(*arguments: Any) -> Any:
        result = close_and_load(*arguments)
        ends.append(arguments[6].copy())  # the joints, which it changes in place
        return result

    close_and_load = quasi_static_closing.close_and_load
    monkeypatch.setattr(quasi_static_closing, "close_and_load", kept)
    energy = CompiledEnergy(HandModel(short), SignedDistanceField(CUBE.solid))
    grasps = load_candidates("cube").select(slice(12))
    joints = grasps.joints[:, [name != SHORT for name in ROBOT.hand.names]]
    wrist = wrist_matrix(grasps.position, grasps.quaternion)
    opened = pregrasp(short, joints)
    found = close_hand(energy, wrist, opened, squeeze(short, joints), CUBE.mass)
    first = (energy.hand.joint_index == 0).nonzero()[:, 0].tolist()
    assert len(first) == 2  # the joint itself, and what pads the little finger
    moved = np.abs(ends[0][:, first[0]] - ends[0][:, first[1]])
    assert moved.max() > 1e-3  # contacts have moved it
    np.testing.assert_allclose(found.joints[:, 0].numpy(), ends[0][:, first[0]], atol=1e-6)


def test_a_hand_in_the_air_or_left_open_holds_nothing(energy: CompiledEnergy):
    away = held(energy, away=0.3)
    assert (away.force == 0).all()
    assert (away.displacement.amax(-1) > HELD).all()
    assert (held(energy, open_=True).force < held(energy).force).all()


def test_weight_and_slipperiness_tell(energy: CompiledEnergy):
    found = held(energy)
    heavy, slippery = held(energy, mass=100 * CUBE.mass), held(energy, test_settings=replace(STANDARD, friction=0.02))
    assert (heavy.displacement.amax(-1) > found.displacement.amax(-1)).all()
    assert (slippery.displacement.amax(-1) > found.displacement.amax(-1)).all()
    assert (heavy.quality < found.quality).all()


def test_joints_stay_between_open_and_commanded_or_where_the_object_stops_them(energy: CompiledEnergy):
    grasps = load_candidates("cube").select(slice(4))
    found = held(energy)
    low = torch.minimum(pregrasp(ROBOT, grasps.joints), squeeze(ROBOT, grasps.joints))
    high = torch.maximum(pregrasp(ROBOT, grasps.joints), squeeze(ROBOT, grasps.joints))
    assert (found.joints > low - 0.2).all()
    assert (found.joints < high + 0.2).all()


def test_the_model_is_repeatable(energy: CompiledEnergy):
    first, second = held(energy), held(energy)
    for a, b in zip(first, second, strict=True):
        torch.testing.assert_close(a, b, rtol=0, atol=0)


def test_the_best_are_the_same_when_others_are_given_up(energy: CompiledEnergy):
    grasps = load_candidates("cube").select(slice(0, 96, 4))
    wrist = wrist_matrix(grasps.position + torch.linspace(-0.02, 0.02, len(grasps))[:, None], grasps.quaternion)
    postures = pregrasp(ROBOT, grasps.joints), squeeze(ROBOT, grasps.joints)
    every, some = (
        close_hand(energy, wrist, *postures, CUBE.mass),
        close_hand(energy, wrist, *postures, CUBE.mass, wanted=5),
    )
    best = every.quality.argsort(descending=True)[:5]
    assert torch.equal(some.quality.argsort(descending=True)[:5], best)
    torch.testing.assert_close(some.quality[best], every.quality[best], rtol=0, atol=0)
    assert (some.quality >= every.quality).all()
    assert (some.displacement < every.displacement - 1e-6).any()
