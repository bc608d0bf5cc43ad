"""Every term of the grasp energy: its gradient, its symmetry, and the order of good and bad grasps."""

from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from random_hands import DOUBLE, draw

from dora.affordance.hand.hand_model import HandModel
from dora.affordance.objects.signed_distance import SignedDistanceField
from dora.affordance.search.compiled import CompiledEnergy
from dora.affordance.search.energies import (
    LENGTH,
    TERMS,
    GraspEnergy,
    Table,
    Weights,
    net_wrench,
    segment_points,
)
from dora.geometry.rotations import matrix_from_rotation_vector
from dora.robot import load_robot

CONTACTS = 8
STEP = 1e-6
"""Step of the finite differences (m or rad)."""
STEADY = ("closure", "distance", "region", "closing", "limits")
"""Terms whose weight does not grow."""


@pytest.fixture(scope="module")
def hand() -> HandModel:
    return HandModel(load_robot("diana7_hit"), dtype=DOUBLE)


@pytest.fixture(scope="module")
def energy(hand) -> GraspEnergy:
    box = trimesh.creation.box((0.05, 0.06, 0.07))
    region = trimesh.Trimesh(box.vertices, box.faces[:2])
    field = SignedDistanceField(box, region, dtype=DOUBLE)
    return GraspEnergy(hand, field, table=Table((0.0, 0.6, 0.8), 0.01))


def moved(wrist: torch.Tensor, move: torch.Tensor) -> torch.Tensor:
    result = wrist.clone()
    result[:, :3, 3] += move[:, :3]
    result[:, :3, :3] = matrix_from_rotation_vector(move[:, 3:6]) @ wrist[:, :3, :3]
    return result


@pytest.mark.parametrize("term", TERMS)
def test_gradient_of_every_term(hand, energy, term, monkeypatch):
    monkeypatch.setattr(energy, "weights", Weights(**{name: float(name == term) for name in TERMS}))
    wrist, joints, contacts = draw(hand)
    found = energy(wrist, joints, contacts)
    gradient = torch.cat((found.wrist, found.joints), 1)
    difference = torch.zeros_like(gradient)
    for column in range(gradient.shape[1]):
        move = torch.zeros_like(gradient)
        move[:, column] = STEP
        forward, backward = (
            energy(moved(wrist, sign * move), joints + sign * move[:, 6:], contacts).total for sign in (1.0, -1.0)
        )
        difference[:, column] = (forward - backward) / (2 * STEP)
    error = (difference - gradient).abs().amax(1) / (1 + gradient.abs().amax(1))
    assert gradient.abs().sum() > 0
    assert error.median() < 1e-7
    assert (error < 1e-5).double().mean() > 0.9  # elsewhere a point sits within STEP of a kink


def test_total_is_the_weighted_sum_of_the_terms(hand, energy):
    ramp = 3.0
    found = energy(*draw(hand), ramp)
    weights = energy.weights
    growing = ramp * (
        weights.penetration * found.terms["penetration"]
        + weights.table * found.terms["table"]
        + weights.self_penetration * found.terms["self_penetration"]
    )
    steady = sum(getattr(weights, name) * found.terms[name] for name in STEADY)
    assert torch.allclose(found.total, steady + growing)
    assert set(found.terms) == set(TERMS)


def test_free_object_without_region_has_neither_term(hand):
    field = SignedDistanceField(trimesh.creation.box((0.05, 0.06, 0.07)), dtype=DOUBLE)
    assert set(GraspEnergy(hand, field)(*draw(hand)).terms) == set(TERMS) - {"table", "region"}


def test_moving_object_and_hand_together_changes_nothing(hand):
    body = trimesh.creation.icosphere(subdivisions=3, radius=0.03)
    body.apply_scale([1.0, 1.3, 0.8])
    turn = matrix_from_rotation_vector(torch.tensor([[0.3, -0.5, 0.8]], dtype=DOUBLE))[0]
    pose = np.eye(4)
    pose[:3, :3] = turn.numpy()
    wrist, joints, contacts = draw(hand)
    here = GraspEnergy(hand, SignedDistanceField(body, dtype=DOUBLE, spacing=1.5e-3))(wrist, joints, contacts)
    there_body = body.copy().apply_transform(pose)
    there = GraspEnergy(hand, SignedDistanceField(there_body, dtype=DOUBLE, spacing=1.5e-3))(
        torch.as_tensor(pose) @ wrist, joints, contacts
    )
    for name, value in here.terms.items():
        scale = value.abs().mean() + 1e-3
        assert (there.terms[name] - value).abs().mean() < 0.03 * scale, name


def test_closure_is_the_norm_of_the_papers_matrix():
    generator = torch.Generator().manual_seed(0)
    psi, normals = torch.randn(2, 5, CONTACTS, 3, generator=generator, dtype=DOUBLE)
    force, torque = net_wrench(psi, normals)
    for row in range(5):
        x, y, z = psi[row].T
        zero = torch.zeros_like(x)
        cross = torch.stack((zero, -z, y, z, zero, -x, -y, x, zero), -1).view(-1, 3, 3)
        matrix = torch.cat((torch.eye(3, dtype=DOUBLE).repeat(1, CONTACTS), torch.cat(tuple(cross), 1)))
        expected = (matrix @ normals[row].flatten()).square().sum()
        assert torch.isclose(force[row].square().sum() + torque[row].square().sum(), expected)


def test_closure_orders_known_grasps():
    """Opposed > three of four sides > one side; a couple of offset forces is worse than opposed ones."""

    def closure(points: list[list[float]], normals: list[list[float]]) -> float:
        force, torque = net_wrench(torch.tensor([points]) / LENGTH, torch.tensor([normals]))
        return float(force.square().sum() + torque.square().sum())

    left, right, front = [-0.03, 0.0, 0.0], [0.03, 0.0, 0.0], [0.0, -0.03, 0.0]
    opposed = closure([left, right], [[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]])
    offset = closure([[-0.03, 0.02, 0.0], [0.03, -0.02, 0.0]], [[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]])
    three = closure([left, right, front], [[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    same_side = closure([left, left], [[1.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    assert opposed < 1e-12 < offset < three < same_side


def test_closure_of_a_pinch_is_lower_than_of_a_push(hand, energy):
    """Thumb and fingers on opposite faces of a box against all contacts on one face."""
    contact = torch.tensor([[0, 1]])
    point = torch.tensor([[-0.025, 0.0, 0.0], [0.025, 0.0, 0.0]], dtype=DOUBLE)
    value, slope = energy.field.sample(point)
    pinch, _ = energy._closure(point, value, slope, *contact.shape)
    point = torch.tensor([[-0.025, 0.01, 0.0], [-0.025, -0.01, 0.0]], dtype=DOUBLE)
    value, slope = energy.field.sample(point)
    push, _ = energy._closure(point, value, slope, *contact.shape)
    assert pinch.item() < 1e-6
    assert push.item() == pytest.approx(4.0, rel=1e-3)


def test_table_keeps_the_hand_above_it(hand, energy):
    wrist, joints, contacts = draw(hand)
    lifted = wrist.clone()
    lifted[:, :3, 3] += 0.5 * torch.tensor(energy.table.normal, dtype=DOUBLE)
    assert energy(wrist, joints, contacts).terms["table"].max() > 0
    assert energy(lifted, joints, contacts).terms["table"].max() == 0


def test_crossed_fingers_penetrate_and_an_open_hand_does_not(hand, energy):
    joints = torch.zeros(2, len(hand.lower), dtype=DOUBLE)
    joints[1] = torch.where(hand.lower < 0, 0.0, hand.upper)
    joints[1, :3] = hand.upper[:3]
    poses = hand.forward(torch.eye(4, dtype=DOUBLE).repeat(2, 1, 1), joints)
    overlap, _ = energy.self_penetration(poses)
    assert overlap[0] == 0
    assert overlap[1] > 0


def test_nearest_points_of_segments():
    generator = torch.Generator().manual_seed(0)
    ends = torch.randn(4, 60, 3, generator=generator, dtype=DOUBLE)
    ends[1, :10] = ends[0, :10]  # no length
    ends[3, 5:20] = ends[2, 5:20]
    first, second = segment_points(*ends)
    share = torch.linspace(0, 1, 201, dtype=DOUBLE)[:, None, None]
    a, b = ends[0] + share * (ends[1] - ends[0]), ends[2] + share * (ends[3] - ends[2])
    sampled = (a[:, None] - b[None]).norm(dim=-1).amin((0, 1))
    found = (first - second).norm(dim=-1)
    assert (found <= sampled + 1e-9).all()
    assert (found >= sampled - 0.03).all()


def test_weights_can_be_changed_one_by_one():
    assert replace(Weights(), closure=0.0).closure == 0


@pytest.mark.parametrize("with_table", [True, False])
def test_compiled_energy_equals_the_definition(with_table):
    single = HandModel(load_robot("diana7_hit"))
    box = trimesh.creation.box((0.05, 0.06, 0.07))
    table = Table((0.0, 0.6, 0.8), 0.01) if with_table else None
    region = trimesh.Trimesh(box.vertices, box.faces[:2]) if with_table else None
    field = SignedDistanceField(box, region)
    wrist, joints, contacts = draw(single)
    arguments = wrist.float(), joints.float(), contacts, 3.0
    expected = GraspEnergy(single, field, table=table)(*arguments)
    found = CompiledEnergy(single, field, table=table)(*arguments)
    assert set(found.terms) == set(expected.terms)
    for name, value in expected.terms.items():
        torch.testing.assert_close(found.terms[name], value, rtol=1e-4, atol=1e-5, msg=name)
    for name in ("total", "wrist", "joints"):
        scale = float(getattr(expected, name).abs().max())
        torch.testing.assert_close(getattr(found, name), getattr(expected, name), rtol=1e-3, atol=1e-4 * scale)
