"""Surface points with labels, and fast queries against them."""

import time

import igl
import imageio.v3 as imageio
import numpy as np
import pytest
import torch
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from dora.affordance.maps.affordance_map import COUNT, AffordanceMap
from dora.affordance.maps.nearest_points import NearestTable, nearest_by_comparison
from dora.affordance.maps.poisson_disk import sample_evenly
from dora.affordance.objects.catalogue import load_object
from dora.affordance.objects.palette import PALETTE
from dora.affordance.views.map_pictures import export_glb, picture_map
from dora.errors import InputError

NAMES = ("cube", "jug", "hammer", "microwave")
CONTACTS = (128, 6, 3)
"""Queries of one control step: environments, contacts, coordinates."""


@pytest.fixture(scope="module")
def maps() -> dict[str, AffordanceMap]:
    return {name: AffordanceMap.from_object(load_object(name)) for name in NAMES}


def exact_distance(mesh: trimesh.Trimesh, points: torch.Tensor) -> torch.Tensor:
    """Unsigned distance (m) to a mesh."""
    vertices, faces = np.array(mesh.vertices, np.float64), np.array(mesh.faces, np.int64)
    return torch.from_numpy(igl.point_mesh_squared_distance(points.double().numpy(), vertices, faces)[0]).sqrt()


def near(map: AffordanceMap, count: int, spread: float, seed: int = 0) -> torch.Tensor:
    """Points (count, 3) about `spread` (m) from the surface."""
    generator = torch.Generator().manual_seed(seed)
    rows = torch.randint(len(map), (count,), generator=generator)
    return map.points[rows] + spread * torch.randn(count, 3, generator=generator)


@pytest.mark.parametrize("name", NAMES)
def test_points_lie_on_the_surface_with_its_normals_areas_and_labels(name: str, maps: dict[str, AffordanceMap]):
    obj, map = load_object(name), maps[name]
    assert len(map) == COUNT
    assert map.names == obj.labels
    assert exact_distance(obj.mesh, map.points).max() < 1e-6
    torch.testing.assert_close(map.normals.norm(dim=-1), torch.ones(COUNT))
    outside = (map.points + 5e-4 * map.normals).double().numpy()
    vertices, faces = np.array(obj.mesh.vertices, np.float64), np.array(obj.mesh.faces, np.int64)
    winding = np.asarray(igl.winding_number(vertices, faces, outside))
    assert (winding < 0.5).mean() > 0.995
    assert float(map.areas.sum()) == pytest.approx(obj.mesh.area, rel=1e-5)
    for index, label in enumerate(map.names):
        own = map.labels == index
        assert exact_distance(obj.region(label), map.points[own]).max() < 1e-6
        share = obj.region(label).area / obj.mesh.area
        assert float(own.float().mean()) == pytest.approx(share, abs=0.02)
        assert float(map.areas[own].sum()) == pytest.approx(obj.region(label).area, rel=0.05, abs=1e-5)


def test_points_are_even_and_seeded(maps: dict[str, AffordanceMap]):
    mesh = load_object("cube").mesh
    points, faces, _ = sample_evenly(mesh, 1000, seed=3)
    again = sample_evenly(mesh, 1000, seed=3)
    np.testing.assert_array_equal(points, again[0])
    np.testing.assert_array_equal(faces, again[1])
    assert not np.array_equal(points, sample_evenly(mesh, 1000, seed=4)[0])
    gap = torch.cdist(maps["cube"].points, maps["cube"].points).fill_diagonal_(1.0).amin(1)
    assert float(gap.min()) > 0.5 * maps["cube"].spacing  # random points come as near as .01
    middle = maps["cube"].points.double().numpy()
    queries = trimesh.sample.sample_surface(mesh, 5000, seed=1)[0]
    farthest = torch.cdist(torch.from_numpy(queries), torch.from_numpy(middle)).amin(1).max()
    assert float(farthest) < 1.0 * maps["cube"].spacing  # random points leave gaps of 2


def test_both_sides_of_a_thin_wall_are_sampled(maps: dict[str, AffordanceMap]):
    map = maps["jug"]
    middle = map.points[:, 2].abs() < 0.04
    body = middle & (map.labels == map.label_index("body"))
    outward = (map.normals[:, :2] * map.points[:, :2]).sum(-1)[body] > 0
    assert 0.45 < float(outward.float().mean()) < 0.6


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("k", [1, 8, 40])
def test_nearest_is_exact_near_and_far(name: str, k: int, maps: dict[str, AffordanceMap]):
    map = maps[name]
    queries = torch.cat([near(map, 500, 0.002), near(map, 200, 0.02), 2 * torch.rand(50, 3) - 1, map.points[:9]])
    distance, labels = map.nearest(queries, k)
    expected = nearest_by_comparison(map.points, queries, k)
    torch.testing.assert_close(distance, expected[0], atol=2e-6, rtol=0)
    assert (labels == map.labels[expected[1]]).float().mean() > 0.999  # ties may be ordered differently
    batched, _ = map.nearest(queries[:60].view(3, 4, 5, 3), k)
    torch.testing.assert_close(batched.view(60, k), distance[:60])


@settings(max_examples=25, deadline=None)
@given(count=st.integers(1, 60), k=st.integers(1, 10), spread=st.floats(1e-3, 1.0), seed=st.integers(0, 10_000))
def test_nearest_is_exact_for_any_points(count: int, k: int, spread: float, seed: int):
    generator = torch.Generator().manual_seed(seed)
    points = spread * torch.randn(count, 3, generator=generator)
    queries = 1.5 * spread * torch.randn(40, 3, generator=generator)
    k = min(k, count)
    table = NearestTable(points, spacing=spread / count**0.5, candidates=k + 2)
    distance, index = table.query(queries, k)
    torch.testing.assert_close(distance, nearest_by_comparison(points, queries, k)[0], atol=1e-5 * spread, rtol=1e-4)
    torch.testing.assert_close((points[index] - queries[:, None]).norm(dim=-1), distance, atol=1e-5 * spread, rtol=1e-4)


def test_nearest_is_much_faster_than_comparing_all(maps: dict[str, AffordanceMap]):
    map = maps["jug"]
    queries = near(map, CONTACTS[0] * CONTACTS[1], 0.002)

    def seconds(call) -> float:
        times = []
        for _ in range(9):
            start = time.process_time()
            call()
            times.append(time.process_time() - start)
        return sorted(times)[4]

    map.nearest(queries, 8)
    assert seconds(lambda: map.nearest(queries, 8)) < 0.6 * seconds(
        lambda: nearest_by_comparison(map.points, queries, 8)
    )


def test_nearest_labels_at_the_handle_are_the_handle(maps: dict[str, AffordanceMap]):
    map = maps["hammer"]
    grip = map.points[(map.labels == map.label_index("handle")) & (map.points[:, 2] < -0.03)]
    assert (map.nearest(grip, 5)[1] == map.label_index("handle")).all()


@pytest.mark.parametrize(
    ("name", "label"), [("cube", "body"), ("jug", "handle"), ("hammer", "head"), ("hammer", "face")]
)
def test_region_distance_follows_the_mesh(name: str, label: str, maps: dict[str, AffordanceMap]):
    map, region = maps[name], load_object(name).region(label)
    generator = torch.Generator().manual_seed(1)
    far = 0.4 * (torch.rand(1000, 3, generator=generator) - 0.5)
    for queries, mean, worst in ((near(map, 1000, 0.004), 4e-4, 3e-3), (far, 1e-3, 4e-3)):
        error = (map.region_distance(queries, label) - exact_distance(region, queries)).abs()
        assert float(error.mean()) < mean
        assert float(error.quantile(0.99)) < worst
    on_surface = map.points[map.labels == map.label_index(label)]
    assert float(map.region_distance(on_surface, label).median()) < 5e-4
    assert float(map.region_distance(on_surface, label).quantile(0.95)) < 2e-3


def test_region_distance_has_unit_gradient_away_from_the_region(maps: dict[str, AffordanceMap]):
    map = maps["jug"]
    queries = torch.tensor([[0.15, 0.0, 0.01], [0.087, 0.03, 0.02], [0.3, 0.1, 0.0]], requires_grad=True)
    gradient = torch.autograd.grad(map.region_distance(queries, "handle").sum(), queries)[0]
    torch.testing.assert_close(gradient.norm(dim=-1), torch.ones(3), atol=0.05, rtol=0)
    assert gradient[0, 0] > 0.95
    assert map.region_distance(queries.detach().view(1, 3, 1, 3), "handle").shape == (1, 3, 1)


def test_refusals(maps: dict[str, AffordanceMap]):
    map = maps["jug"]
    with pytest.raises(InputError, match="ask for 1 to 4096"):
        map.nearest(map.points[:3], 0)
    with pytest.raises(InputError, match="choose one of: body, handle, rim"):
        map.region_distance(map.points[:3], "lid")
    with pytest.raises(InputError, match="cannot show 3 regions"):
        AffordanceMap.from_object(load_object("jug"), count=2)


def test_saved_map_is_the_same(tmp_path, maps: dict[str, AffordanceMap]):
    map, path = maps["hammer"], tmp_path / "hammer.safetensors"
    map.save(path)
    again = AffordanceMap.load(path, load_object("hammer"))
    for name in ("points", "normals", "areas", "labels"):
        assert torch.equal(getattr(again, name), getattr(map, name))
    assert (again.name, again.names, again.digest) == (map.name, map.names, map.digest)
    queries = near(map, 50, 0.01)
    torch.testing.assert_close(again.region_distance(queries, "face"), map.region_distance(queries, "face"))
    with pytest.raises(InputError, match="another shape or labelling than jug"):
        AffordanceMap.load(path, load_object("jug"))


def test_map_moves_to_a_device(maps: dict[str, AffordanceMap]):
    moved = maps["cube"].to("cpu")
    assert torch.equal(moved.points, maps["cube"].points)
    assert moved.nearest(moved.points[:4], 2)[1].shape == (4, 2)


def test_picture_shows_every_region(tmp_path, maps: dict[str, AffordanceMap]):
    path = tmp_path / "jug.png"
    picture_map(maps["jug"], path, size=160)
    picture = imageio.imread(path)[..., :3]
    assert picture.shape[1] == 480
    assert 160 < picture.shape[0] < 300  # titles and legend
    hue = picture.reshape(-1, 3).astype(float)
    hue /= np.maximum(hue.max(1, keepdims=True), 1)
    for color in PALETTE[:3]:
        wanted = np.array(color) / max(color)
        assert (np.abs(hue - wanted).max(1) < 0.1).sum() > 1500
    with pytest.raises(InputError, match="Cannot write"):
        picture_map(maps["jug"], tmp_path / "nowhere" / "jug.png", size=40)


def test_glb_has_the_coloured_surface(tmp_path, maps: dict[str, AffordanceMap]):
    path = tmp_path / "jug.glb"
    export_glb(maps["jug"], path)
    mesh = trimesh.load_mesh(path)
    assert len(mesh.faces) == len(maps["jug"].mesh.faces)
    np.testing.assert_allclose(mesh.extents, maps["jug"].mesh.extents, atol=1e-6)
    colors = getattr(mesh.visual, "vertex_colors", np.empty((0, 4)))
    shown = np.unique(np.asarray(colors)[:, :3], axis=0)
    assert {tuple(int(v) for v in c) for c in shown} >= set(PALETTE[:3])
