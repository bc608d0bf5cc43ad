"""The benchmark of the grasp search: its numbers make sense, and the parts that it times are those of the energy."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose

from dora.affordance.hand.hand_model import HandModel
from dora.affordance.objects.catalogue import load_object
from dora.affordance.objects.signed_distance import SignedDistanceField
from dora.affordance.search.compiled import CompiledDescent, CompiledEnergy
from dora.affordance.search.descent import Rows
from dora.affordance.search.energies import TERMS, Weights
from dora.affordance.search.initial_poses import InitialPoses, Spread
from dora.affordance.search.native.parts import PARTS, repeat
from dora.affordance.search.optimise import table_of
from dora.affordance.search.search import Search, Settings
from dora.errors import InputError
from dora.robot import load_robot
from dora.tools import grasp_benchmark as benchmark
from dora.tools.grasp_benchmark import GraspBenchmark, measure

ROBOT = load_robot("diana7_hit")
COUNT = 16
SMALL = {
    "NUM": 4, "BATCHES": (2, 4), "ROWS": (1, 4), "SUBDIVISIONS": (0, 1), "PART_REPEATS": 20, "PART_ROWS": 4,
    "REFERENCE_ROWS": 1, "REFERENCE_REPEATS": 1,
}  # fmt: skip
"""Constants of a short benchmark; of each piece the fastest of as many measurements counts as ever."""
MADE = {
    "distance_region": ("distance", "region"),
    "closure": ("closure",),
    "closing": ("closing",),
    "penetration_table": ("penetration", "table"),
    "self_penetration": ("self_penetration",),
    "limits": ("limits",),
}
"""Terms that a part makes; the others make none."""


@pytest.fixture(scope="module")
def measured() -> GraspBenchmark:
    """Of a short search."""
    with pytest.MonkeyPatch.context() as patch:
        for name, value in SMALL.items():
            patch.setattr(benchmark, name, value)
        return measure("cube", ROBOT, Settings(iterations=10, batch=8, starts=2, polish=5))


def test_what_was_asked_for_is_measured(measured: GraspBenchmark):
    assert (measured.object, measured.region, measured.num) == ("cube", "body", SMALL["NUM"])
    assert tuple(measured.by_batch) == SMALL["BATCHES"]
    assert tuple(measured.evaluation_microseconds) == SMALL["ROWS"]
    faces = len(load_object("cube").solid.faces)
    assert list(measured.by_faces) == [faces, 4 * faces]
    assert all(found.keys() == {"fill_seconds", "evaluation_microseconds"} for found in measured.by_faces.values())
    assert list(measured.stages) == ["search", "seating", "polish", "judging"]


def test_all_rates_and_times_are_positive_and_fit_together(measured: GraspBenchmark):
    tables = (measured.by_batch, measured.stages, measured.evaluation_microseconds, *measured.by_faces.values())
    single = [value for value in vars(measured).values() if isinstance(value, float)]
    assert all(
        np.isfinite(value) and value > 0 for value in (*single, *(v for table in tables for v in table.values()))
    )
    assert measured.first_candidates_per_second < measured.candidates_per_second
    assert measured.candidates_per_second < measured.search_candidates_per_second
    slow = measured.search_candidates_per_second / measured.ratio
    assert measured.reference_candidates_per_second == pytest.approx(slow)


def test_shares_of_a_step_are_shares(measured: GraspBenchmark):
    assert measured.shares.keys() == {*PARTS, "rest"}
    assert all(0 <= share < 1 for share in measured.shares.values())
    assert sum(measured.shares.values()) == pytest.approx(1, abs=0.3)  # other programs disturb so short a measurement


def test_the_reference_is_slower_by_far(measured: GraspBenchmark):
    """Hundreds of times at the usual sizes; with one or eight rows at once less is left."""
    assert measured.ratio > 20


def test_the_threads_are_as_before():
    threads = torch.get_num_threads()
    with pytest.raises(InputError, match="spoon"):
        measure("spoon", ROBOT)
    assert torch.get_num_threads() == threads


@pytest.fixture(scope="module")
def jug() -> tuple[CompiledEnergy, Rows]:
    """The energy of the jug's handle, and candidates on it in which every term counts."""
    obj, hand = load_object("jug"), HandModel(ROBOT)
    energy = CompiledEnergy(hand, SignedDistanceField(obj.solid, obj.region("handle")), table=table_of(obj))
    search = Search(energy, InitialPoses(obj, hand, "handle", Spread()), Settings())
    generator = torch.Generator().manual_seed(0)
    rows = search.start(COUNT, generator)
    rows.joints += 0.5 * torch.randn(rows.joints.shape, generator=generator)
    rows.wrist[:, 2, 3] -= 0.08
    return energy, rows


def done(part: str, energy: CompiledEnergy, rows: Rows, times: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """Terms and gradient that a part makes, with Adam at half of its largest steps."""
    adam = CompiledDescent(energy, torch.linspace(0.1, 2, rows.mean.shape[1])).adam([0.5])
    places = rows.wrist.numpy(), rows.joints.numpy(), rows.contacts.numpy()
    weights = energy.factors(1.0)
    return repeat(PARTS.index(part), times, energy.arrays, energy.field_arrays, weights, energy.plane(), adam, *places)


@pytest.mark.parametrize("part", PARTS)
def test_a_part_makes_its_terms_as_the_whole_energy_does(jug: tuple[CompiledEnergy, Rows], part: str):
    energy, rows = jug
    if part == "closing":  # timed without the kinematics of the closed hand
        still = energy.arrays._replace(close=np.zeros_like(energy.arrays.close))
        energy = CompiledEnergy(energy.hand, energy.field, energy.weights, energy.table)
        energy.arrays = still
    whole, before = energy(rows.wrist, rows.joints, rows.contacts).terms, rows.wrist.clone()
    found, _ = done(part, energy, rows)
    for index, name in enumerate(TERMS):
        if name in MADE.get(part, ()):
            assert (whole[name] > 0).any()
            assert_allclose(found[:, index], whole[name].numpy(), rtol=1e-5, atol=1e-6, err_msg=name)
        else:
            assert not found[:, index].any(), name
    assert torch.equal(rows.wrist, before)


@pytest.mark.parametrize(("part", "weighted"), [("gradient", {"distance", "region"}), ("limits", {"limits"})])
def test_a_gradient_is_that_of_the_terms_behind_it(jug: tuple[CompiledEnergy, Rows], part: str, weighted: set[str]):
    energy, rows = jug
    usual = replace(energy.weights, limits=1.0)
    weights = Weights(**{name: getattr(usual, name) * (name in weighted) for name in TERMS})
    whole = energy.weighted(weights)(rows.wrist, rows.joints, rows.contacts)
    expected = torch.cat((whole.wrist, whole.joints), 1).numpy()
    _, found = done(part, energy, rows)
    assert_allclose(found, expected, rtol=1e-4, atol=1e-4 * np.abs(expected).max())


def test_adam_steps_against_the_gradient(jug: tuple[CompiledEnergy, Rows]):
    """Its first step is the largest one along every coordinate, here half of it."""
    energy, rows = jug
    _, step = done("adam", energy, rows)
    assert_allclose(step, np.tile(-0.5 * np.linspace(0.1, 2, step.shape[1]), (COUNT, 1)), rtol=1e-5)
