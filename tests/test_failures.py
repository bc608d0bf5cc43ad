"""Why candidates fail: one cause each, the direction of slips, and what the hint says."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from rich.console import Console
from test_validation import cube_grasps

from dora.affordance.hand.grasp_test_settings import DIRECTIONS, STANDARD
from dora.affordance.objects.catalogue import load_object
from dora.robot import load_robot
from dora.sim.grasp_tests.failures import SIDES, failures, hint
from dora.sim.grasp_tests.report import print_report
from dora.sim.grasp_tests.shake_test import Reason, Validation, validate

CUBE, ROBOT = load_object("cube"), load_robot("diana7_hit")


def verdict(*ends: tuple[Reason, int, float, float]) -> Validation:
    """A grasp test that ended so: reason, direction, force on the palm [N], penetration at the candidate [m]."""
    count = len(ends)
    force = torch.zeros(count, 6)
    force[:, 0] = torch.tensor([end[2] for end in ends])
    zeros = torch.zeros(count)
    return Validation(
        reason=torch.tensor([int(end[0]) for end in ends]), displacement=zeros, closing_shift=zeros, penetration=zeros,
        part_force=force, label_force=torch.zeros(count, 1), contacts=torch.zeros(count, 0, 3),
        contact_finger=torch.zeros(count, 0, dtype=torch.long),
        candidate_penetration=torch.tensor([end[3] for end in ends]), self_penetration=zeros, test_settings=STANDARD,
        direction=torch.tensor([end[1] for end in ends]),
    )  # fmt: skip


ENDS = (
    (Reason.PASSED, -1, 5.0, 0.0),
    (Reason.PASSED, -1, 5.0, 0.003),
    (Reason.THROWN, -1, 0.0, 0.003),
    (Reason.SLIPPED, 0, 5.0, 0.003),
    (Reason.SLIPPED, 0, 5.0, 0.0),
    (Reason.SLIPPED, 5, 5.0, 0.0),
    (Reason.SLIPPED, 0, 0.0, 0.0),
    (Reason.RELEASED, 1, 5.0, 0.0),
)


def test_every_candidate_that_fails_has_one_cause():
    found = verdict(*ENDS)
    candidates = cube_grasps(torch.zeros(len(ENDS), 3))
    tangled = torch.zeros(len(ENDS))
    tangled[:3] = 0.004
    candidates = replace(candidates, valid=found.valid, self_penetration=tangled)
    counted = failures(candidates, found)
    assert counted == {
        "failed": 7,
        "causes": {
            "slipped down": 2,
            "lost while closing": 1,
            "touched nothing after closing": 1,
            "let go: no contact force left": 1,
            "slipped along -y": 1,
            "held, but overlaps with the object by more than 2 mm": 1,
        },
        "self_contact": 3,
    }
    assert next(iter(counted["causes"])) == "slipped down"
    unknown = failures(candidates, replace(found, direction=None))["causes"]
    assert unknown["slipped in some direction"] == 3


def test_without_a_simulation_overlap_and_missing_contact_count():
    candidates = cube_grasps(torch.zeros(3, 3))
    candidates = replace(
        candidates,
        contacts=torch.zeros(3, 1, 3),
        contact_finger=torch.tensor([[1], [0], [2]]),
        valid=torch.tensor([True, False, False]),
    )
    assert failures(candidates, None)["causes"] == {
        "touches nothing": 1,
        "overlaps with the object by more than 2 mm": 1,
    }


def test_the_words_for_directions_are_theirs():
    axes = {"down": (0, 0, -1), "up": (0, 0, 1)}
    axes |= {f"along {sign}{axis}": int(f"{sign}1") * np.eye(3)[k] for k, axis in enumerate("xy") for sign in "+-"}
    assert [tuple(axes[side]) for side in SIDES] == list(DIRECTIONS)


def test_the_simulation_tells_under_which_direction_a_grasp_fails():
    """A hand that never closes loses the cube at once, one with too heavy a cube as well, a firm one never."""
    candidates = cube_grasps(torch.zeros(2, 3))
    grasp = candidates.grasp.clone()
    grasp[1] = candidates.pregrasp[1]
    found = validate(replace(candidates, grasp=grasp), CUBE, ROBOT, processes=1)
    assert found.direction is not None
    assert found.direction.tolist() == [-1, 0]
    heavy = validate(cube_grasps(), CUBE, ROBOT, replace(STANDARD, gravity=1000.0), processes=1)
    assert heavy.direction is not None
    assert heavy.direction.tolist() == [0]


@pytest.mark.parametrize(
    ("causes", "mass", "assumed", "words"),
    [
        ({}, 1.0, True, ""),
        ({"slipped down": 5, "slipped up": 4, "lost while closing": 6}, 2.4, True,
         "most slip down: the object weighs 2.4 kg, which is an estimate; give its mass with --mass."),
        ({"slipped along +x": 5}, 2.4, False, "most slip along +x: the object weighs 2.4 kg; if that is right, ask"),
        ({"slipped up": 5}, 0.05, False, "most slip up, although the object weighs 0.05 kg only"),
        ({"lost while closing": 5, "slipped up": 1}, 1.0, True, "most are lost while the hand closes: the object"),
        ({"touches nothing": 5}, 1.0, True, "most touch nothing: the object measures 6.0 x 6.0 x 6.0 cm; check"),
        ({"let go: no contact force left": 5}, 1.0, True, "most let go"),
        ({"held, but overlaps with the object by more than 2 mm": 5}, 1.0, True, "most overlap with the object"),
    ],
)  # fmt: skip
def test_the_hint_is_about_the_most_frequent_kind(causes: dict[str, int], mass: float, assumed: bool, words: str):
    said = hint({"causes": causes}, replace(CUBE, mass=mass), assumed)
    assert said.startswith(words)
    assert said.count(".") == 0 or said.endswith(".")
    assert bool(said) == bool(causes)


@pytest.mark.parametrize(("valid", "shown"), [(0, True), (1, True), (2, False), (8, False)])
def test_causes_are_printed_where_few_are_valid(valid: int, shown: bool):
    spread = {"median": 0.0, "p90": 0.0, "max": 0.0}
    report = {
        "object": "thing", "region": None, "robot": "hand", "optimised": 8, "requested": 8, "optimise_seconds": 1.0,
        "validate_seconds": 1.0, "sim_success_rate": 0.0, "valid": valid, "valid_share": 0.0, "strict_share": 0.0,
        "valid_per_second": 0.0, "penetration_mm": spread, "self_penetration_mm": spread, "classes": {},
        "class_shares": {}, "energy": {},
        "failures": {"failed": 8, "causes": {"slipped down": 8}, "self_contact": 0, "hint": "most slip down."},
    }  # fmt: skip
    console = Console(record=True, width=100, markup=False)
    print_report(report, console)
    text = console.export_text()
    assert ("why 8 candidates are not valid" in text) == ("most slip down." in text) == shown
