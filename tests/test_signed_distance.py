"""The distance field against the exact distance, over random meshes; its exact derivatives."""

import numpy as np
import pytest
import torch
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from dora.affordance.objects.catalogue import load_object
from dora.affordance.objects.signed_distance import CHANNELS, ExactDistance, SignedDistanceField
from dora.errors import InputError

SIZES = st.floats(0.01, 0.08)
"""Sizes of random meshes (m)."""


@st.composite
def meshes(draw: st.DrawFn) -> trimesh.Trimesh:
    """Closed meshes of hand size: hulls of random points, boxes, capsules and tori."""
    kind = draw(st.sampled_from(["hull", "box", "capsule", "torus"]))
    a, b = draw(SIZES), draw(SIZES)
    if kind == "hull":
        points = np.random.default_rng(draw(st.integers(0, 1000))).normal(size=(16, 3)) * [a, b, 0.05]
        return trimesh.Trimesh(points).convex_hull
    if kind == "box":
        return trimesh.creation.box((a, b, 0.04))
    if kind == "capsule":
        return trimesh.creation.capsule(height=a, radius=b, count=[16, 16])
    return trimesh.creation.torus(major_radius=0.02 + a, minor_radius=0.012, major_sections=24, minor_sections=12)


@pytest.fixture(scope="module")
def field() -> SignedDistanceField:
    jug = load_object("jug")
    return SignedDistanceField(jug.solid, jug.region("handle"), dtype=torch.float64)


@given(meshes())
@settings(max_examples=12, deadline=None)
def test_field_is_close_to_the_mesh(mesh):
    error = SignedDistanceField(mesh, spacing=3e-3).error(count=2000)
    assert error.mean < 2e-4
    assert error.largest < 3e-3


@given(meshes(), st.integers(0, 1000))
@settings(max_examples=12, deadline=None)
def test_culling_never_loses_a_touching_point(mesh, seed):
    field = SignedDistanceField(mesh, spacing=4e-3)
    low, high = np.asarray(mesh.bounds)
    points = np.random.default_rng(seed).uniform(low - 0.1, high + 0.1, (1, 500, 3))
    points = torch.as_tensor(points, dtype=torch.float32)
    reach = torch.linspace(0.0, 0.04, 500)
    kept = set(field.may_touch(points, reach).tolist())
    touching = (field.distance(points) < reach).flatten().nonzero().flatten().tolist()
    assert kept >= set(touching)


def test_field_is_the_interpolation_of_grid_sample(field):
    points = 0.08 * torch.randn(500, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    inside = ((points > field.lower) & (points < field.upper)).all(1)
    place = 2 * (points - field.lower) / (field.upper - field.lower) - 1
    volume = field.table.T.reshape(1, CHANNELS + 1, *field.shape)
    expected = torch.nn.functional.grid_sample(volume, place.flip(-1)[None, None, None], align_corners=True)
    found, _ = field.sample(points)
    assert inside.sum() > 100
    assert torch.allclose(found[inside], expected[0, :, 0, 0].T[inside], atol=1e-12)


def test_derivatives_are_those_of_the_interpolant(field):
    points = 0.1 * torch.randn(400, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    _, jacobian = field.sample(points)
    step = 1e-7
    difference = torch.stack(
        [(field.sample(points + step * e)[0] - field.sample(points - step * e)[0]) / (2 * step)
         for e in torch.eye(3, dtype=torch.float64)], -1
    )  # fmt: skip
    error = (difference - jacobian).abs().amax((1, 2))
    assert (error < 1e-5).double().mean() > 0.99


def test_distance_grows_outside_the_grid(field):
    far = torch.tensor([[0.5, 0.0, 0.0], [0.0, -0.7, 0.6]], dtype=torch.float64)
    value, jacobian = field.sample(far)
    exact = torch.as_tensor(field.exact(far.numpy()))
    assert torch.allclose(value[:, 0], exact, atol=0.05)
    assert (jacobian[:, 0].norm(dim=-1) - 1).abs().max() < 0.2


def test_region_channel_is_the_distance_to_the_region(field):
    handle = load_object("jug").region("handle")
    points = np.random.default_rng(0).uniform(-0.08, 0.08, (300, 3))
    exact = ExactDistance(handle).unsigned(points)
    found = field.sample(torch.as_tensor(points))[0][:, CHANNELS].numpy()
    assert np.abs(found - exact).mean() < 1e-3


def test_sign_and_gradient_of_the_exact_distance():
    box = ExactDistance(trimesh.creation.box((0.02, 0.02, 0.02)))
    found = box.with_gradient(np.array([[0.0, 0.0, 0.03], [0.0, 0.009, 0.0], [0.01, 0.0, 0.001]]))
    np.testing.assert_allclose(found[:, 0], [0.02, -0.001, 0.0], atol=1e-9)
    np.testing.assert_allclose(found[:, 1:], [[0, 0, 1], [0, 1, 0], [1, 0, 0]], atol=1e-9)
    assert box.with_gradient(np.zeros((0, 3))).shape == (0, CHANNELS)


def test_hollow_jug_is_filled():
    jug = load_object("jug")
    rim = np.asarray(jug.mesh.bounds)[1, 2]
    inside = np.array([[0.0, 0.0, rim - 0.05]])
    assert ExactDistance(jug.solid)(inside)[0] < 0 < ExactDistance(jug.mesh)(inside)[0]


def test_an_absurdly_large_object_is_refused():
    with pytest.raises(InputError, match="too large for a hand"):
        SignedDistanceField(trimesh.creation.box((6.0, 6.0, 6.0)))


def with_flat_triangles(turn: np.ndarray, inward: bool) -> trimesh.Trimesh:
    """A box of 10 x 10 x 5 cm with points on one edge of each end, which is a fan from a corner, as in CAD."""
    along = np.linspace(0, 0.1, 9)
    outline = np.array([*((x, 0.0) for x in along), (0.1, 0.1), (0.0, 0.1)])
    n = len(outline)
    low, high = (np.column_stack([outline, np.full(n, z)]) for z in (0.0, 0.05))
    ends = [face for i in range(1, n - 1) for face in ((0, i + 1, i), (n, n + i, n + i + 1))]
    walls = [face for i in range(n) for j in [(i + 1) % n] for face in ((i, j, n + j), (i, n + j, n + i))]
    mesh = trimesh.Trimesh(np.concatenate([low, high]) @ turn.T, ends + walls, process=False)
    if inward:
        mesh.invert()
    return mesh


@pytest.mark.parametrize("inward", [False, True], ids=["outward", "inward"])
@pytest.mark.parametrize("seed", range(3))
def test_flat_triangles_turn_no_sign_and_no_normal(seed: int, inward: bool):
    """Turned, so that the area of a flat triangle is rounding instead of 0."""
    rng = np.random.default_rng(seed)
    turn = trimesh.transformations.random_rotation_matrix(rng.random(3))[:3, :3]
    mesh = with_flat_triangles(turn, inward)
    assert mesh.is_watertight
    size, around = np.array([0.1, 0.1, 0.05]), rng.uniform(-0.03, 0.13, (5000, 3))
    exact = ExactDistance(mesh)
    away = np.linalg.norm(np.maximum(np.maximum(-around, around - size), 0), axis=1)
    deep = np.minimum(around, size - around).min(1)
    wanted = np.where(deep > 0, -deep, away) * (-1 if inward else 1)
    np.testing.assert_allclose(exact(around @ turn.T), wanted, atol=1e-9)
    edge = np.column_stack([rng.uniform(0, 0.1, 500), np.zeros(500), rng.choice([0.0, 0.05], 500)])
    normals = exact.with_gradient(edge @ turn.T)[:, 1:] @ turn * (-1 if inward else 1)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1)
    assert (normals[:, 1] < 1e-6).all()  # of the walls or of the ends that meet there, or between them
    assert (normals[:, 2] * np.sign(edge[:, 2] - 0.02) > -1e-6).all()
