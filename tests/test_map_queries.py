"""Samples, tables and grids of affordance maps, compared with plain ways to compute the same."""

from typing import Any

import igl
import numpy as np
import pytest
import torch
import trimesh

from dora.affordance.maps import nearest_points
from dora.affordance.maps.affordance_map import AffordanceMap
from dora.affordance.maps.nearest_points import NearestTable, RegionField, nearest_by_comparison
from dora.affordance.maps.poisson_disk import sample_evenly

PLATE = trimesh.creation.box((0.1, 0.08, 0.002))
"""A plate whose sides are nearer to each other than the points on them [m]."""
TRIANGLE = trimesh.Trimesh([[0, 0, 0], [0.03, 0, 0], [0, 0.02, 0.01]], [[0, 1, 2]])
"""An open mesh [m]."""


def map_of(mesh: trimesh.Trimesh, count: int) -> AffordanceMap:
    """A map of even points with two regions, of the faces before and after the half."""
    points, faces, areas = sample_evenly(mesh, count, 0)
    second = (np.arange(len(mesh.faces)) >= len(mesh.faces) // 2).astype(np.int64)
    return AffordanceMap(
        name="invented", points=torch.from_numpy(points).float(), areas=torch.from_numpy(areas).float(),
        normals=torch.from_numpy(np.array(mesh.face_normals[faces])).float(), labels=torch.from_numpy(second[faces]),
        names=("one", "two"), mesh=mesh, face_labels=second, digest="d",
    )  # fmt: skip


@pytest.fixture(scope="module")
def ball() -> AffordanceMap:
    return map_of(trimesh.creation.icosphere(subdivisions=3, radius=0.05), 500)


@pytest.mark.parametrize("seed", [0, 1])
def test_samples_are_those_that_plain_elimination_leaves(seed: int):
    """Yuksel's equations: the point with the largest sum of weights goes, until few are left; r of a hexagonal grid."""
    count, rng = 40, np.random.default_rng(seed)
    points, faces = trimesh.sample.sample_surface(PLATE, 5 * count, seed=rng)[:2]
    normals = PLATE.face_normals[faces]
    radius = (PLATE.area / (2 * 3**0.5 * count)) ** 0.5
    apart = np.linalg.norm(points[:, None] - points, axis=-1)
    weight = np.where((apart < 2 * radius) & (normals @ normals.T > -0.3), (1 - apart / (2 * radius)), 0) ** 8
    np.fill_diagonal(weight, 0)
    left = list(range(5 * count))
    while len(left) > count:
        del left[int(weight[np.ix_(left, left)].sum(1).argmax())]
    found = sample_evenly(PLATE, count, seed)
    np.testing.assert_array_equal(found[0], points[left])
    np.testing.assert_array_equal(found[1], faces[left])
    others, sides = trimesh.sample.sample_surface(PLATE, 32 * count, seed=rng)[:2]
    turned = np.linalg.norm(PLATE.face_normals[sides][:, None] - normals[left], axis=-1)
    gap = (np.linalg.norm(others[:, None] - points[left], axis=-1) ** 2 + (radius * turned) ** 2).argmin(1)
    np.testing.assert_allclose(found[2], [(gap == k).sum() * PLATE.area / (32 * count) for k in range(count)])


def test_the_spacing_is_that_of_a_hexagonal_grid():
    points = torch.tensor([[0.1 * a + 0.05 * b, 0.1 * 0.75**0.5 * b, 0.0] for a in range(3) for b in range(3)])
    cell = 0.1**2 * 0.75**0.5  # area of a grid point, of a rhombus with sides of 0.1 m
    map = AffordanceMap(
        name="grid", points=points, normals=points, areas=torch.full((9,), cell), names=("a",), mesh=PLATE, digest="",
        labels=torch.zeros(9, dtype=torch.long), face_labels=np.zeros(12, np.int64),
    )  # fmt: skip
    assert map.spacing == pytest.approx(0.1)


@pytest.mark.parametrize("k", [1, 8])
def test_points_near_the_surface_are_found_without_comparing_all(
    ball: AffordanceMap, monkeypatch: pytest.MonkeyPatch, k: int
):
    queries = ball.points + 0.7 * ball.spacing * torch.randn(len(ball), 3, generator=torch.Generator().manual_seed(0))
    expected = nearest_by_comparison(ball.points, queries, k)[0]
    compared: list[int] = []

    def compare(points: Any, queries: Any, k: int) -> Any:
        compared.append(len(queries))
        return nearest_by_comparison(points, queries, k)

    monkeypatch.setattr(nearest_points, "nearest_by_comparison", compare)
    found = ball.nearest_points(queries, k)[0]
    torch.testing.assert_close(found, expected, atol=2e-6, rtol=0)
    assert sum(compared) <= 2
    ball.nearest_points(torch.full((5, 3), 1.0), k)
    assert sum(compared) >= 5


@pytest.mark.parametrize("k", [100, 500])
def test_as_many_points_as_there_are_can_be_asked_for(ball: AffordanceMap, k: int):
    found = ball.nearest_points(ball.points[:3], k)
    assert found[0].shape == (3, k)
    torch.testing.assert_close(found[0], nearest_by_comparison(ball.points, ball.points[:3], k)[0], atol=2e-6, rtol=0)
    assert found[1][:, 0].tolist() == [0, 1, 2]


@pytest.mark.parametrize(
    ("size", "spacing", "edge"),
    [
        ((1.0, 1.0, 1.0), 1e-4, 1.001 / 1000 ** (1 / 3)),
        ((1.0, 1.0, 0.0), 1e-4, (1.001**2 * 0.001 / 1000) ** (1 / 3)),
        ((1.0, 1.0, 1.0), 0.2, 0.3),
    ],
)
def test_cells_grow_where_there_would_be_too_many(
    monkeypatch: pytest.MonkeyPatch, size: tuple[float, float, float], spacing: float, edge: float
):
    monkeypatch.setattr(NearestTable, "MOST_CELLS", 1000)
    points = torch.tensor(size) * torch.tensor([[0.0, 0, 0], [1, 1, 1], [0, 1, 0]])
    table = NearestTable(points, spacing, 2)
    assert table.edge == pytest.approx(edge, rel=1e-4)
    assert table.query(points, 1)[1][:, 0].tolist() == [0, 1, 2]


def test_the_three_words_about_a_point_agree(ball: AffordanceMap):
    assert len(ball) == len(ball.points)
    assert (ball.label_index("one"), ball.label_index("two")) == (0, 1)
    assert ball.nearest(ball.points[:7], 1)[1][:, 0].tolist() == ball.labels[:7].tolist()


def exact(mesh: trimesh.Trimesh, queries: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distances (q,) to a mesh, and its nearest points (q, 3) [m]."""
    vertices, faces = np.array(mesh.vertices, np.float64), np.array(mesh.faces, np.int64)
    square, _, nearest = igl.point_mesh_squared_distance(queries, vertices, faces)[:3]
    return np.sqrt(square), np.asarray(nearest)


def test_a_grid_interpolates_nearest_points_near_the_mesh_and_distances_elsewhere():
    """Trilinear between the eight nodes around a query; outside, the nearest point is that of the nearest node."""
    field, node = RegionField(TRIANGLE), 0.004
    low, high = TRIANGLE.bounds[0] - 0.05, TRIANGLE.bounds[1] + 0.05
    last = np.ceil((high - low) / node)
    random = np.random.default_rng(0)
    inner = np.concatenate([
        random.uniform(low, low + last * node, (300, 3)),
        TRIANGLE.triangles_center + 0.003 * random.normal(size=(100, 3)),
    ])  # fmt: skip
    expected = []
    for query in inner:
        place = (query - low) / node
        corner = np.minimum(np.floor(place), last - 1)
        steps = np.stack(np.meshgrid(*[[0, 1]] * 3, indexing="ij"), -1).reshape(8, 3)
        share = np.abs(1 - steps - (place - corner)).prod(1)
        length, nearest = exact(TRIANGLE, low + node * (corner + steps))
        near = share @ length < node
        expected.append(np.linalg.norm(share @ nearest - query) if near else share @ length)
    found = field(torch.from_numpy(inner).float())
    np.testing.assert_allclose(found.numpy(), expected, atol=2e-5)
    outer = np.array([[0.3, 0.01, 0.0], [-0.2, -0.2, -0.2], [0.01, 0.15, 0.02], [0.0, 0.0, -0.09]])
    nodes = low + node * np.clip(np.round((outer - low) / node), 0, last)
    expected = np.linalg.norm(exact(TRIANGLE, nodes)[1] - outer, axis=1)
    np.testing.assert_allclose(field(torch.from_numpy(outer).float()).numpy(), expected, rtol=1e-5)


def test_nodes_grow_apart_where_there_would_be_too_many(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(RegionField, "MOST_NODES", 500)
    field, size = RegionField(TRIANGLE), np.array([0.13, 0.12, 0.11])
    assert field.node == pytest.approx((size.prod() / 500) ** (1 / 3))
    assert len(field.nearest) == int((np.ceil(size / field.node) + 1).prod())


def test_a_region_is_that_of_its_faces(ball: AffordanceMap):
    queries = torch.tensor([[0.0, 0.0, 0.06], [0.07, 0.0, 0.0], [0.0, -0.02, -0.05]])
    for index, name in enumerate(ball.names):
        region = trimesh.Trimesh(ball.mesh.vertices, ball.mesh.faces[ball.face_labels == index])
        expected = exact(region, queries.double().numpy())[0]
        np.testing.assert_allclose(ball.region_distance(queries, name).numpy(), expected, atol=1.5e-3)
