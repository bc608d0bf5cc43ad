"""The search by automatic differentiation: the compiled one's values, gradients and steps, and energies of users."""

import json
import runpy
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import torch
import trimesh
from commands import call, load_command
from random_hands import DOUBLE, draw
from torch import Tensor

from dora.affordance.bundled_sets import bundled_path
from dora.affordance.candidates import GraspCandidates
from dora.affordance.hand.chain_hand import ChainHand
from dora.affordance.hand.hand_model import HandModel
from dora.affordance.objects.catalogue import load_object
from dora.affordance.objects.signed_distance import MARGIN, SignedDistanceField
from dora.affordance.search.compiled import CompiledEnergy
from dora.affordance.search.descent import Descent, Rows, Schedule
from dora.affordance.search.differentiable import DifferentiableDescent, DifferentiableEnergy
from dora.affordance.search.energies import TERMS, Evaluation, GraspEnergy, Table, Weights
from dora.affordance.search.grasp_state import sample
from dora.affordance.search.optimise import Settings, optimise
from dora.errors import InputError
from dora.robot import Coupling, load_robot
from dora.sim.grasp_tests import generation

ROWS, CONTACTS = 500, 9
TOLERANCE = 1e-4
"""Largest relative difference of values and gradients (of 1); found are 1e-10."""
ROBOT = load_robot("diana7_hit")
CUBE = load_object("cube")
QUICK = Settings(iterations=10, starts=2, polish=10, oversampling=1.0)
POINTING = runpy.run_path(str(Path(__file__).parents[1] / "examples" / "own_energy.py"))["pointing"]
"""The energy of the example."""
TABLE = Table((0.0, 0.6, 0.8), 0.01)


@pytest.fixture(scope="module")
def field() -> SignedDistanceField:
    box = trimesh.creation.box((0.05, 0.06, 0.07))
    return SignedDistanceField(box, trimesh.Trimesh(box.vertices, box.faces[:2]), dtype=DOUBLE)


@pytest.fixture(scope="module")
def compiled(field) -> CompiledEnergy:
    return CompiledEnergy(HandModel(ROBOT, dtype=DOUBLE), field, table=TABLE)


@pytest.fixture(scope="module")
def torched(field) -> DifferentiableEnergy:
    return DifferentiableEnergy(ChainHand(ROBOT, dtype=DOUBLE), field, table=TABLE)


def gradient(found: Evaluation) -> Tensor:
    return torch.cat((found.wrist, found.joints), 1)


@pytest.mark.parametrize("term", TERMS)
def test_every_term_and_its_gradient_are_those_of_the_compiled_energy(compiled, torched, term):
    """Row by row, in float64: the value, and the difference of the gradients as vectors."""
    alone = Weights(**{name: float(name == term) for name in TERMS})
    rows = draw(compiled.hand, 0, ROWS, CONTACTS)
    expected, found = compiled.weighted(alone)(*rows), torched.weighted(alone)(*rows)
    assert set(found.terms) == set(expected.terms) == set(TERMS)
    value, slope = expected.terms[term], gradient(expected)
    assert (value > 0).double().mean() > 0.7
    assert ((found.terms[term] - value).abs() <= TOLERANCE * value).all()
    assert ((gradient(found) - slope).norm(dim=1) <= TOLERANCE * slope.norm(dim=1)).all()


def test_the_weighted_sum_is_that_of_the_compiled_energy(compiled, torched):
    rows = draw(compiled.hand, 1, ROWS, CONTACTS)
    expected, found = compiled(*rows, 7.0), torched(*rows, 7.0)
    torch.testing.assert_close(found.total, expected.total, rtol=TOLERANCE, atol=0)
    torch.testing.assert_close(gradient(found), gradient(expected), rtol=TOLERANCE, atol=TOLERANCE)


def test_a_free_object_without_region_has_neither_term():
    energy = DifferentiableEnergy(ChainHand(ROBOT, dtype=DOUBLE), SignedDistanceField(CUBE.solid, dtype=DOUBLE))
    assert set(energy(*draw(energy.hand)).terms) == set(TERMS) - {"table", "region"}


@pytest.mark.parametrize(
    "robot",
    [
        ROBOT,
        replace(ROBOT, couplings=(Coupling(3, 2, 0.5, 0.1), Coupling(6, 5, -0.7, 0.0))),
        replace(ROBOT, fingers={name: ROBOT.fingers[name] for name in ("thumb", "ring")}),
    ],
    ids=["as it is", "other couplings", "two fingers"],
)
def test_hands_of_any_couplings_have_the_poses_and_gradients_of_the_hand_model(robot, field):
    """An actuated joint moves what is coupled to it, too, which pytorch_kinematics itself would not do."""
    chain, hand = ChainHand(robot, dtype=DOUBLE), HandModel(robot, dtype=DOUBLE)
    wrist, joints, contacts = draw(hand)
    joints = joints.nan_to_num(0.0)  # those of fingers that are left out have no limits
    torch.testing.assert_close(chain.forward(wrist, joints), hand.forward(wrist, joints), rtol=0, atol=1e-12)
    energies = GraspEnergy(hand, field), DifferentiableEnergy(chain, field)
    expected, found = (energy(wrist, joints, contacts) for energy in energies)
    torch.testing.assert_close(gradient(found), gradient(expected), rtol=TOLERANCE, atol=TOLERANCE)


def test_the_field_is_differentiable_by_its_own_derivatives(field):
    """At points within and beyond the grid; finite differences of every channel."""
    generator = torch.Generator().manual_seed(0)
    points = (0.04 + 2 * MARGIN) * (torch.rand(40, 3, generator=generator, dtype=DOUBLE) - 0.5)
    points.requires_grad_()
    assert torch.equal(sample(field, points), field.sample(points.detach())[0])
    assert torch.autograd.gradcheck(lambda p: sample(field, p), (points,), eps=1e-8, atol=1e-5)


def test_torchs_adam_takes_the_steps_of_the_definition(torched):
    """In two stretches, of which the second begins with the moments of the first."""
    wrist, joints, contacts = draw(torched.hand)
    largest = torch.tensor([2e-3] * 3 + [0.02] * (3 + joints.shape[1]), dtype=DOUBLE)
    ends = []
    for kind in (Descent, DifferentiableDescent):
        rows = Rows.begin(wrist.clone(), joints.clone(), contacts, joints.new_zeros(len(joints)))
        for schedule in (Schedule(0, [1.0, 1.0, 2.0], [1.0, 0.9, 0.8]), Schedule(3, [3.0, 4.0], [0.6, 0.3])):
            kind(torched, largest)(rows, schedule)
        ends.append(rows)
    for name in ("wrist", "joints", "total", "overlap"):
        torch.testing.assert_close(getattr(ends[1], name), getattr(ends[0], name), rtol=1e-5, atol=1e-5, msg=name)
    assert (ends[1].joints - joints).abs().max() > 0.05


@pytest.fixture(scope="module")
def found() -> GraspCandidates:
    return optimise(CUBE, ROBOT, 8, 0, "body", QUICK, kinematics="pytorch_kinematics")


def test_candidates_go_through_what_all_searches_share(found):
    """Seating, ranking by the quasi-static closing, contacts and classes."""
    assert len(found) == 8
    assert found.grasp_class.count("BodyGrasp") >= 6
    assert found.energy["predicted_force"].nan_to_num().max() > 1
    assert set(found.energy) >= {"closure", "region", "table", "predicted_shift"}
    assert (found.contact_finger > 0).any()
    assert not found.position.requires_grad


@pytest.mark.slow
def test_equal_seeds_give_equal_candidates_and_other_kinematics_another_digest(found):
    again = optimise(CUBE, ROBOT, 8, 0, "body", QUICK, device="cpu", kinematics="pytorch_kinematics")
    assert torch.equal(again.position, found.position)
    assert torch.equal(again.grasp, found.grasp)
    usual = optimise(CUBE, ROBOT, 8, 0, "body", QUICK)
    assert usual.settings == repr(QUICK)  # as in files that exist
    assert found.settings == f"{QUICK!r} kinematics='pytorch_kinematics'"
    assert generation.origin_digest(found) != generation.origin_digest(usual)


def test_an_energy_of_a_user_acts_and_is_stored():
    without, acting = (
        optimise(
            CUBE, ROBOT, 8, 0, "body", replace(QUICK, starts=12), kinematics="pytorch_kinematics",
            extra_energies={"pointing": (weight, POINTING)},
        )
        for weight in (0.0, 200.0)
    )  # fmt: skip
    assert acting.energy["pointing"].mean() < 0.5 * without.energy["pointing"].mean()
    assert acting.energy["pointing"].shape == (8,)
    assert "pointing=200.0*" in acting.settings


@pytest.mark.parametrize(
    ("kinematics", "energies", "words"),
    [
        ("newton", {}, "unknown kinematics 'newton'; choose one of: compiled, pytorch_kinematics."),
        (
            "compiled",
            {"pointing": (1.0, POINTING)},
            'no energies of yours (pointing): add kinematics="pytorch_kinematics".',
        ),
        ("pytorch_kinematics", {"table": (1.0, POINTING)}, "the energy 'table' exists"),
        ("pytorch_kinematics", {"pointing": (float("nan"), POINTING)}, "the weight of the energy 'pointing' is nan"),
        ("pytorch_kinematics", {"all": (1.0, lambda s: s.joints)}, "the energy 'all' returned (16, 15), not"),
        ("pytorch_kinematics", {"one": (1.0, lambda s: 0.0)}, "the energy 'one' returned float, not a tensor"),
        ("pytorch_kinematics", {"log": (1.0, lambda s: s.joints.sum(1) / 0)}, "the energy 'log' returned a value that"),
        ("pytorch_kinematics", {"root": (1.0, lambda s: (s.joints.sum(1) * 0).sqrt())}, "energies root is not finite"),
    ],
)
def test_what_there_is_not_is_refused_in_one_sentence(kinematics: str, energies: dict, words: str):
    settings = replace(QUICK, starts=1)
    with pytest.raises(InputError) as refusal:
        optimise(CUBE, ROBOT, 8, 0, "body", settings, kinematics=kinematics, extra_energies=energies)
    assert words in str(refusal.value)
    assert "\n" not in str(refusal.value)


def test_the_command_passes_the_choice_on(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    chosen = []

    def search(*_: object, kinematics: str, progress: Callable[[int, int], None]) -> GraspCandidates:
        chosen.append(kinematics)
        return GraspCandidates.load(bundled_path("cube")).select(slice(4))

    monkeypatch.setattr(generation, "optimise", search)
    out = tmp_path / "cube.safetensors"
    options = ("--object", "cube", "--num", "4", "--baselines", "4", "--kinematics", "pytorch_kinematics")
    assert call(load_command("grasps"), monkeypatch, *options, "--out", str(out)) == 0
    assert chosen == ["pytorch_kinematics"] * 5
    assert json.loads(out.with_suffix(".json").read_text())["kinematics"] == "pytorch_kinematics"
