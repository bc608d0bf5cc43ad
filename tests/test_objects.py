"""Objects of our own, the tools that make them, and convex decomposition."""

import dataclasses
import itertools

import igl
import numpy as np
import pytest
import trimesh

from dora.affordance.objects import decomposition
from dora.affordance.objects.affordance_object import mass_properties, moved, surface_digest
from dora.affordance.objects.catalogue import AffordanceObject, load_object
from dora.affordance.objects.decomposition import decompose, deviation
from dora.affordance.objects.solids import capsule_between, fitted, hull_of, lathe, loft, shape_mesh, simplified, unite
from dora.errors import InputError
from dora.robot.shapes import Shape

NAMES = ("cube", "hammer", "jug", "microwave")
SIZES = {
    "cube": (0.060, 0.060, 0.060),
    "jug": (0.158, 0.095, 0.183),
    "hammer": (0.096, 0.022, 0.276),
    "microwave": (0.070, 0.070, 0.250),
}
MASSES = {"cube": 0.12, "jug": 0.30, "hammer": 0.28, "microwave": 0.34}
REGIONS = {
    "cube": {"body": "BodyGrasp"},
    "jug": {"body": "BodyGrasp", "handle": "HandleGrasp", "rim": "RimGrasp"},
    "hammer": {"handle": "HandleGrasp", "head": "HeadGrasp", "face": "FaceGrasp"},
    "microwave": {"handle": "HandleGrasp", "door": "BodyGrasp"},
}
FINGER_RADIUS = 0.012
"""Of a finger of the hand with room to spare (m)."""
ROOM_RADIUS = 0.015
"""Fingers need 30 mm."""
DENSITIES = {"jug": (1000.0, 1500.0), "microwave": (900.0, 2700.0)}


def distance(mesh: trimesh.Trimesh, points: np.ndarray) -> np.ndarray:
    """Signed distance (m), negative inside."""
    vertices, faces = np.array(mesh.vertices, np.float64), np.array(mesh.faces, np.int64)
    signed = igl.signed_distance(np.array(points), vertices, faces, igl.SIGNED_DISTANCE_TYPE_PSEUDONORMAL)
    return np.asarray(signed[0])


def piece_meshes(obj: AffordanceObject) -> list[trimesh.Trimesh]:
    return [shape_mesh(p.shape) if isinstance(p.shape, Shape) else p.shape for p in obj.pieces]


def through_the_handle(obj: AffordanceObject, offset: float) -> np.ndarray:
    """Points of a line across the handle's hole, at a distance (m) from the handle's middle towards the body."""
    x, _, z = obj.centroid("handle")
    return np.stack([np.full(41, x + offset), np.linspace(-0.03, 0.03, 41), np.full(41, z)], -1)


HOLES = {"jug": -0.0135, "microwave": -0.0210}
"""Distance (m) from the middle of the handle's surface to the middle of its hole."""


@pytest.mark.parametrize("name", NAMES)
def test_surface_is_closed_outward_and_of_moderate_size(name: str):
    obj = load_object(name)
    for mesh in (obj.mesh, obj.solid):
        assert mesh.is_watertight
        assert mesh.is_winding_consistent
        assert mesh.volume > 0
        assert mesh.body_count == 1
        assert 500 <= len(mesh.faces) <= 10_000
    assert obj.solid.volume >= obj.mesh.volume


@pytest.mark.parametrize("name", NAMES)
def test_true_to_size_and_mass(name: str):
    obj = load_object(name)
    np.testing.assert_allclose(obj.mesh.extents, SIZES[name], atol=5e-4)
    assert obj.mass == pytest.approx(MASSES[name])
    low, high = DENSITIES.get(name, (100.0, 8000.0))
    assert low < obj.mass / obj.mesh.volume < high


@pytest.mark.parametrize("name", NAMES)
def test_regions_and_classes(name: str):
    obj = load_object(name)
    assert dict(zip(obj.labels, obj.classes, strict=True)) == REGIONS[name]
    assert obj.target in obj.labels
    assert obj.face_labels.shape == (len(obj.mesh.faces),)
    assert set(obj.face_labels) == set(range(len(obj.labels)))
    assert sum(obj.region(label).area for label in obj.labels) == pytest.approx(obj.mesh.area)
    assert {piece.label for piece in obj.pieces} <= set(obj.labels)
    with pytest.raises(InputError, match="no region 'lid'"):
        obj.region("lid")


@pytest.mark.parametrize("name", ["cube", "jug"])
def test_origin_of_a_uniform_object_is_its_centroid(name: str):
    obj = load_object(name)
    np.testing.assert_allclose(obj.mesh.center_mass, 0, atol=1e-9)
    np.testing.assert_allclose(obj.inertia, obj.mesh.moment_inertia * obj.mass / obj.mesh.volume, atol=1e-12)


def test_hammer_balances_about_its_origin():
    """Points inside, 200 g spread over those in the head and 80 g over those below it."""
    obj = load_object("hammer")
    points = np.random.default_rng(0).uniform(obj.mesh.bounds[0], obj.mesh.bounds[1], (150_000, 3))
    vertices, faces = np.array(obj.mesh.vertices, np.float64), np.array(obj.mesh.faces, np.int64)
    points = points[np.asarray(igl.fast_winding_number(vertices, faces, points)) > 0.5]
    head_bottom = obj.region("head").bounds[0, 2]
    tip = obj.region("handle").bounds[0, 2]
    in_claw = (points[:, 0] < -0.015) & (points[:, 2] > head_bottom)
    in_head = in_claw | (points[:, 2] > obj.region("handle").bounds[1, 2])
    weight = np.where(in_head, 0.2 / in_head.sum(), 0.08 / (~in_head).sum())
    np.testing.assert_allclose(weight @ points, 0, atol=0.004)
    squares = np.einsum("n,ni,nj->ij", weight, points, points)
    np.testing.assert_allclose(np.diag(np.trace(squares) * np.eye(3) - squares), np.diag(obj.inertia), rtol=0.2)
    assert tip < -0.2
    assert abs(obj.mesh.center_mass[2]) > 0.04  # a uniform hammer would balance elsewhere


def test_hammer_points_as_documented():
    obj = load_object("hammer")
    face = obj.region("face")
    np.testing.assert_allclose(face.face_normals, np.tile([1.0, 0, 0], (len(face.faces), 1)), atol=1e-6)
    assert obj.centroid("face")[0] > 0.035
    assert obj.region("head").bounds[0, 0] < -0.05
    assert obj.centroid("handle")[2] < obj.centroid("head")[2]
    assert 0.240 < np.ptp(obj.region("handle").bounds[:, 2]) < 0.270


def test_jug_points_as_documented():
    obj = load_object("jug")
    assert obj.centroid("handle")[0] > 0.05
    assert obj.region("rim").bounds[0, 0] < -1.2 * obj.region("rim").bounds[1, 0]  # the lip
    assert obj.region("rim").bounds[1, 2] == pytest.approx(obj.mesh.bounds[1, 2])
    cavity = np.array([[0, 0, z] for z in np.linspace(-0.07, 0.09, 20)])
    assert (distance(obj.mesh, cavity) > 0.015).sum() > 15
    assert (distance(obj.solid, cavity) < -0.005).all()


@pytest.mark.parametrize("name", sorted(HOLES))
def test_handle_leaves_room_for_fingers(name: str):
    obj = load_object(name)
    line = through_the_handle(obj, HOLES[name])
    assert distance(obj.solid, line).min() > ROOM_RADIUS
    assert min(distance(piece, line).min() for piece in piece_meshes(obj)) > ROOM_RADIUS


@pytest.mark.parametrize("name", NAMES)
def test_rests_on_its_lowest_points(name: str):
    obj = load_object(name)
    turn = trimesh.transformations.quaternion_matrix(obj.rest)[:3, :3]
    points = obj.mesh.vertices @ turn.T
    assert points[:, 2].min() == pytest.approx(-obj.support)
    foot = points[points[:, 2] < -obj.support + 5e-4, :2]
    angle = np.linspace(0, 2 * np.pi, 60)
    assert (foot @ np.stack([np.cos(angle), np.sin(angle)])).max(0).min() > 0.005  # surrounds the centre of mass


@pytest.mark.parametrize("name", NAMES)
def test_pieces_are_few_convex_and_close(name: str):
    obj = load_object(name)
    assert len(obj.pieces) <= 12
    for piece in obj.pieces:
        if isinstance(piece.shape, trimesh.Trimesh):
            assert piece.shape.is_convex
            assert len(piece.shape.vertices) <= 255
    found = deviation(obj.solid, piece_meshes(obj))
    assert found.mean < 1e-3
    assert found.inward < 2.5e-3
    assert found.outward < (5e-3 if name == "hammer" else 2.5e-3)  # the slot between the claw's prongs is filled


def test_jug_body_has_few_hulls_and_its_handle_capsules():
    shapes = {label: [p.shape for p in load_object("jug").pieces if p.label == label] for label in ("body", "handle")}
    assert 1 <= len(shapes["body"]) <= 4
    assert all(isinstance(s, Shape) and s.kind == "capsule" for s in shapes["handle"])


def test_digest_follows_geometry_and_labels_alone():
    obj = load_object("hammer")
    order = np.random.default_rng(0).permutation(len(obj.mesh.faces))
    shuffled = trimesh.Trimesh(obj.mesh.vertices + 1e-13, obj.mesh.faces[order], process=False)
    assert surface_digest(shuffled, obj.face_labels[order], obj.labels) == obj.digest
    relabelled = obj.face_labels.copy()
    relabelled[0] = 1 - relabelled[0]
    grown = trimesh.Trimesh(obj.mesh.vertices * 1.001, obj.mesh.faces, process=False)
    others = [
        surface_digest(obj.mesh, relabelled, obj.labels),
        surface_digest(obj.mesh, obj.face_labels, ("handle", "head", "other")),
        surface_digest(grown, obj.face_labels, obj.labels),
        surface_digest(moved(obj.mesh, np.array([0, 0, 1e-5])), obj.face_labels, obj.labels),
    ]
    assert obj.digest not in others
    assert len(set(others)) == 4


def test_mass_properties_of_two_balls():
    """Dumbbell: 1 kg at x = 0 and 3 kg at x = .4, radius .1."""
    ball = trimesh.creation.icosphere(subdivisions=4, radius=0.1)
    mass, center, inertia = mass_properties([(ball, 1.0), (moved(ball, np.array([0.4, 0, 0])), 3.0)])
    assert mass == 4.0
    np.testing.assert_allclose(center, [0.3, 0, 0], atol=1e-9)
    own = 0.4 * 4 * 0.01
    np.testing.assert_allclose(np.diag(inertia), [own, own + 0.09 + 0.03, own + 0.09 + 0.03], rtol=5e-3)


def test_capsule_between_points():
    start, end = np.array([0.01, 0.02, -0.03]), np.array([-0.05, 0.04, 0.06])
    capsule = capsule_between(start, end, 0.007)
    np.testing.assert_allclose(capsule.segment, [start, end], atol=1e-12)
    mesh = shape_mesh(capsule)
    assert distance(mesh, np.array([start, end])).max() == pytest.approx(-0.007, abs=2e-4)


@pytest.mark.parametrize(
    ("shape", "volume"),
    [
        (Shape("box", (0.1, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), (0.01, 0.02, 0.03)), 8 * 6e-6),
        (Shape("sphere", (0.1, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), (0.02,)), 4 / 3 * np.pi * 8e-6),
        (Shape("cylinder", (0.1, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), (0.02, 0.03)), np.pi * 4e-4 * 0.06),
        (
            Shape("capsule", (0.1, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), (0.02, 0.03)),
            np.pi * 4e-4 * 0.06 + 4 / 3 * np.pi * 8e-6,
        ),
    ],
)
def test_shape_meshes_have_the_volume_and_place_of_the_shape(shape: Shape, volume: float):
    mesh = shape_mesh(shape)
    assert mesh.is_watertight
    assert mesh.volume == pytest.approx(volume, rel=0.02)
    np.testing.assert_allclose(mesh.center_mass, [0.1, 0, 0], atol=1e-6)
    if len(shape.size) == 2:
        assert mesh.extents[0] == pytest.approx(0.06 + (0.04 if shape.kind == "capsule" else 0.0), abs=1e-6)


def test_turned_and_lofted_cylinders():
    angle = np.linspace(0, 2 * np.pi, 64, endpoint=False)
    ring = np.stack([0.02 * np.cos(angle), 0.02 * np.sin(angle), 0 * angle], -1)
    solids = [
        lathe(np.array([[0, 0], [0.02, 0], [0.02, 0.1], [0, 0.1]]), 64),
        loft(np.stack([ring, ring + np.array([0, 0, 0.1])])),
        loft(np.stack([ring + np.array([0, 0, 0.1]), ring])),
    ]
    for solid in solids:
        assert solid.is_watertight
        assert solid.volume == pytest.approx(np.pi * 4e-4 * 0.1, rel=2e-3)


def test_fitted_polyline_is_nearer_than_its_chords():
    angle = np.linspace(0, np.pi, 200)
    path = np.stack([np.cos(angle), np.sin(angle)], -1)
    chords = simplified(path, 0.05)
    radius = [np.linalg.norm(np.linspace(a, b, 50), axis=1) for a, b in itertools.pairwise(chords)]
    assert 0.94 < np.min(radius) < 1
    assert len(chords) <= 9
    better = fitted(path, chords)
    assert np.sum(np.linalg.norm(better[1:-1], axis=1) > 1.0) == len(better) - 2  # chords lie inside, the fit astride
    np.testing.assert_array_equal(better[[0, -1]], chords[[0, -1]])


def test_union_knows_where_its_faces_come_from():
    parts = [trimesh.creation.box((2, 2, 2)), moved(trimesh.creation.box((2, 2, 2)), np.array([1.0, 1, 1]))]
    whole, part, face = unite(parts)
    assert whole.volume == pytest.approx(15)
    for index, origin in enumerate(parts):
        own = part == index
        np.testing.assert_allclose(whole.face_normals[own], origin.face_normals[face[own]], atol=1e-9)
    with pytest.raises(ValueError, match="not a closed surface"):
        unite([parts[0], trimesh.Trimesh(parts[0].vertices, parts[0].faces[1:], process=False)])


def test_hull_keeps_to_its_number_of_vertices():
    ball = trimesh.creation.icosphere(subdivisions=4)
    hull = hull_of(ball.vertices, 150)
    assert len(hull.vertices) <= 150
    assert hull.volume > 0.95 * ball.volume


def test_deviation_of_boxes():
    box = trimesh.creation.box((0.06, 0.06, 0.06))
    larger, smaller = (trimesh.creation.box((0.06, 0.06, z)) for z in (0.064, 0.056))
    out, inside = deviation(box, [larger]), deviation(box, [smaller])
    assert (out.outward, out.inward) == pytest.approx((0.002, 0.0), abs=1e-9)
    assert (inside.outward, inside.inward) == pytest.approx((0.0, 0.002), abs=1e-9)
    halves = [moved(trimesh.creation.box((0.03, 0.06, 0.06)), np.array([x, 0, 0])) for x in (-0.015, 0.015)]
    assert deviation(box, halves).mean == pytest.approx(0, abs=1e-9)  # the cut between hulls does not count


def test_hulls_keep_the_hole_open_and_are_kept_on_disk(tmp_path, monkeypatch: pytest.MonkeyPatch):
    obj = load_object("jug")
    hulls = decompose(obj.solid, cache_dir=tmp_path)
    line = through_the_handle(obj, HOLES["jug"])
    assert min(distance(hull, line).min() for hull in hulls) > FINGER_RADIUS
    closed = trimesh.convex.convex_hull(obj.solid)
    assert distance(closed, line).min() < -0.005  # a single hull fails the test above
    assert all(hull.is_convex and len(hull.vertices) <= 255 for hull in hulls)
    found = deviation(obj.solid, hulls)
    assert max(found.outward, found.inward) < 0.006

    monkeypatch.setattr(decomposition, "_run", lambda *_: pytest.fail("decomposed again"))
    for again, hull in zip(decompose(obj.solid, cache_dir=tmp_path), hulls, strict=True):
        np.testing.assert_array_equal(again.vertices, hull.vertices)
    monkeypatch.setenv("DORA_CACHE", str(tmp_path))
    assert len(decompose(obj.solid)) == len(hulls)
    with pytest.raises(pytest.fail.Exception):
        decompose(obj.solid, threshold=0.2, cache_dir=tmp_path)


def test_decomposition_refuses_what_it_cannot_do(tmp_path):
    box = trimesh.creation.box((0.1, 0.1, 0.1))
    with pytest.raises(InputError, match=r"must lie in \.01 to 1"):
        decompose(box, threshold=3.0, cache_dir=tmp_path)
    with pytest.raises(InputError, match="fill the holes"):
        decompose(trimesh.Trimesh(box.vertices, box.faces[1:], process=False), cache_dir=tmp_path)


def test_pieces_move_with_the_object():
    for piece in load_object("hammer").pieces:
        there = piece.moved(np.array([0.1, 0.2, 0.3]))
        a, b = (shape_mesh(p.shape) if isinstance(p.shape, Shape) else p.shape for p in (piece, there))
        np.testing.assert_allclose(b.vertices - a.vertices, np.tile([0.1, 0.2, 0.3], (len(a.vertices), 1)), atol=1e-12)
        assert dataclasses.asdict(there)["label"] == piece.label
