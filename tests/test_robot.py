"""The robot's files are reproducible and physical; its description is complete and refuses bad input."""

# Pinocchio and Coal are compiled modules without type stubs.
# pyright: reportAttributeAccessIssue=false

import re
import shutil
import tomllib
from dataclasses import replace
from itertools import combinations, pairwise
from pathlib import Path
from typing import Literal

import coal
import numpy as np
import pinocchio
import pytest
import torch
import trimesh
import yaml

from dora.errors import InputError
from dora.geometry.rotations import matrix_from_quaternion
from dora.robot import Coupling, RobotDescription, Shape, available_robots, load_robot
from dora.robot.build import build_urdf, write_urdf
from dora.robot.description import clique_cover
from dora.robot.loading import _Reader
from dora.robot.shapes import merge_capsules
from dora.robot.visuals import build_meshes

MAX_MESH_BYTES = 1_500_000
FINGERS = ("thumb", "index", "middle", "ring", "pinky")


@pytest.fixture
def folder(robot, tmp_path) -> Path:
    """A copy of the robot's folder that a test may spoil."""
    copy = tmp_path / "spoiled"
    shutil.copytree(robot.folder, copy, ignore=shutil.ignore_patterns("meshes"))
    return copy


def geometry(robot: RobotDescription) -> tuple[pinocchio.Model, pinocchio.GeometryModel]:
    """Pinocchio's model with the description's own shapes, capsules included, and no collision pairs."""
    model, shapes = pinocchio.buildModelFromUrdf(str(robot.urdf)), pinocchio.GeometryModel()
    x_to_z = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
    makers = {
        "capsule": lambda s: coal.Capsule(s.size[0], 2 * s.size[1]),
        "cylinder": lambda s: coal.Cylinder(s.size[0], 2 * s.size[1]),
        "box": lambda s: coal.Box(*(2 * np.array(s.size))),
        "sphere": lambda s: coal.Sphere(s.size[0]),
    }
    for link, parts in robot.shapes.items():
        frame_id = model.getFrameId(link, pinocchio.BODY)
        frame = model.frames[frame_id]
        for part in parts:
            turn = matrix_from_quaternion(torch.tensor(part.quaternion, dtype=torch.float64)).numpy()
            turn = turn @ x_to_z if part.kind in ("capsule", "cylinder") else turn
            place = frame.placement * pinocchio.SE3(turn, np.array(part.position))
            shapes.addGeometryObject(
                pinocchio.GeometryObject(link, frame.parentJoint, frame_id, place, makers[part.kind](part))
            )
    return model, shapes


def closest(robot: RobotDescription, pairs, configurations: np.ndarray) -> dict[tuple[str, str], float]:
    """Smallest distance (m) of each link pair over joint configurations (k, n_arm + n_hand)."""
    model, shapes = geometry(robot)
    names = [item.name for item in shapes.geometryObjects]
    for a, b in combinations(range(len(names)), 2):
        if (min(names[a], names[b]), max(names[a], names[b])) in pairs:
            shapes.addCollisionPair(pinocchio.CollisionPair(a, b))
    data, results = model.createData(), pinocchio.GeometryData(shapes)
    order = [model.joints[model.getJointId(name)].idx_q for name in robot.arm.names + robot.hand.names]
    found = dict.fromkeys(pairs, np.inf)
    for configuration in configurations:
        q = np.zeros(model.nq)
        q[order] = configuration
        pinocchio.computeDistances(model, data, shapes, results, q)
        for pair, result in zip(shapes.collisionPairs, results.distanceResults, strict=True):
            links = tuple(sorted((names[pair.first], names[pair.second])))
            found[links] = min(found[links], result.min_distance)
    return found


def colliding_pairs(robot: RobotDescription) -> set[tuple[str, str]]:
    return set(combinations(sorted(robot.shapes), 2)) - robot.ignored_pairs


def test_regenerating_gives_the_same_urdf(folder, robot):
    assert write_urdf(folder).read_bytes() == robot.urdf.read_bytes()


def test_regenerating_gives_the_same_meshes(robot):
    scenes = build_meshes(yaml.safe_load((robot.folder / "visuals.yaml").read_text()))
    files = sorted((robot.folder / "meshes").iterdir())
    assert {f"{name}.glb" for name in scenes} == {file.name for file in files}
    assert sum(file.stat().st_size for file in files) < MAX_MESH_BYTES
    for name, scene in scenes.items():
        stored = trimesh.load_scene(robot.folder / "meshes" / f"{name}.glb")
        np.testing.assert_allclose(stored.bounds, scene.bounds, atol=1e-6)


def test_every_visual_names_a_mesh(robot):
    named = set(re.findall(r'filename="([^"]+)"', robot.urdf.read_text()))
    assert len(named) == 13
    assert all((robot.folder / name).is_file() for name in named)


def test_visuals_lie_close_to_the_collision_shapes(robot):
    """Vertices are at most 2 cm outside the link's collision shapes (m)."""
    named = dict(re.findall(r'<link name="([^"]+)">(?:(?!</link>).)*filename="([^"]+)"', robot.urdf.read_text(), re.S))
    for link, shapes in robot.shapes.items():
        points = trimesh.load_scene(robot.folder / named[link]).to_geometry().vertices
        assert min_distance(shapes, points).max() < 0.02, link


def min_distance(shapes: tuple[Shape, ...], points: np.ndarray) -> np.ndarray:
    """Distance (k,) of points (k, 3) outside the union of shapes, 0 inside (m)."""
    best = np.full(len(points), np.inf)
    for shape in shapes:
        turn = matrix_from_quaternion(torch.tensor(shape.quaternion, dtype=torch.float64)).numpy()
        local = (points - shape.position) @ turn
        if shape.kind == "box":
            gap = np.linalg.norm(np.maximum(np.abs(local) - shape.size, 0), axis=1)
        else:
            radius, half = shape.size
            along = np.abs(local[:, 0]) - half
            across = np.linalg.norm(local[:, 1:], axis=1)
            if shape.kind == "capsule":
                gap = np.hypot(np.maximum(along, 0), across) - radius
            else:
                gap = np.hypot(np.maximum(along, 0), np.maximum(across - radius, 0))
        best = np.minimum(best, np.maximum(gap, 0))
    return best


def test_pinocchio_loads_the_model_and_its_shapes(robot):
    model = pinocchio.buildModelFromUrdf(str(robot.urdf))
    shapes = pinocchio.buildGeomFromUrdf(model, str(robot.urdf), pinocchio.COLLISION)
    capsules = [shape for parts in robot.shapes.values() for shape in parts if shape.kind == "capsule"]
    assert model.nq == 27
    assert len(shapes.geometryObjects) == sum(map(len, robot.shapes.values())) + 2 * len(capsules)
    assert "<mimic" not in robot.urdf.read_text()
    assert "<capsule" not in robot.urdf.read_text()


def test_inertias_are_physical_and_masses_add_up(robot):
    parameters = yaml.safe_load((robot.folder / "parameters.yaml").read_text())
    links = {**parameters["links"], **parameters["fingers"]["links"]}
    for name, link in links.items():
        xx, xy, xz, yy, yz, zz = link["inertia"]
        moments = np.linalg.eigvalsh([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        assert moments[0] > 0, name
        assert moments[0] + moments[1] >= 0.999 * moments[2], name
    hand = links["base_link_hithand"]["mass"] + 5 * sum(
        link["mass"] for link in parameters["fingers"]["links"].values()
    )
    assert hand == pytest.approx(1.5, abs=1e-3)


def test_the_description_is_complete(robot):
    assert "diana7_hit" in available_robots()
    assert load_robot(robot.folder) is load_robot("diana7_hit")
    assert (len(robot.arm), len(robot.hand), len(robot.couplings)) == (7, 20, 5)
    assert tuple(robot.fingers) == FINGERS
    assert robot.hand.names == tuple(joint for finger in robot.fingers.values() for joint in finger.joints)
    assert {"zero", "home", "open", "fist"} <= set(robot.postures)
    np.testing.assert_allclose(robot.hand.effort.reshape(5, 4), [[1.15, 1.15, 0.6, 0.35]] * 5)
    assert robot.arm.velocity.max() < 3.2
    with pytest.raises(ValueError, match="read-only"):
        robot.arm.lower[0] = 0.0


def test_home_has_the_hand_in_front_and_pointing_down(robot):
    model = pinocchio.buildModelFromUrdf(str(robot.urdf))
    data = model.createData()
    q = np.zeros(model.nq)
    q[[model.joints[model.getJointId(name)].idx_q for name in robot.arm.names]] = robot.postures["home"].arm
    pinocchio.framesForwardKinematics(model, data, q)
    hand = data.oMf[model.getFrameId(robot.wrist_link, pinocchio.BODY)]
    np.testing.assert_allclose(hand.translation, [0.49, 0.0, 0.32], atol=1e-5)
    np.testing.assert_allclose(hand.rotation[:, 2], [np.cos(0.85), 0, -np.sin(0.85)], atol=1e-5)
    np.testing.assert_allclose(hand.rotation[:, 0], [-np.sin(0.85), 0, -np.cos(0.85)], atol=1e-5)
    margin = np.minimum(robot.postures["home"].arm - robot.arm.lower, robot.arm.upper - robot.postures["home"].arm)
    assert margin.min() > 0.5


def test_no_colliding_pair_overlaps_in_a_named_posture(robot):
    postures = np.stack([np.r_[posture.arm, posture.hand] for posture in robot.postures.values()])
    distances = closest(robot, colliding_pairs(robot), postures)
    assert min(distances.values()) > 0.0
    still = closest(robot, colliding_pairs(robot), postures[:2])
    offsets = {link: contact.contact_offset for link, contact in robot.contacts.items()}
    assert all(gap > 0 for gap in still.values())
    assert {pair for pair, gap in still.items() if gap < offsets[pair[0]] + offsets[pair[1]]} <= {
        pair for pair in still if all("Right" in link for link in pair)
    }


def test_ignored_pairs_no_collision_or_are_ignored_by_design(robot):
    adjacent = {tuple(sorted((j.parent, j.child))) for j in robot.model.joints.values()}
    fingers = [finger.links for finger in robot.fingers.values()]
    design = {tuple(sorted(pair)) for links in fingers for pair in combinations(links, 2)}
    design |= {tuple(sorted((robot.palm_link, finger.proximal))) for finger in robot.fingers.values()}
    nested = {("link1", "link3")}  # the shapes meet by .4 mm at every angle of joints 2 and 3
    # Neighbouring fingers meet with opposite links first, so that the other pairs of theirs are redundant.
    redundant = {
        tuple(sorted((a, b)))
        for first, second in pairwise(fingers[1:])
        for i, a in enumerate(first)
        for j, b in enumerate(second)
        if i != j
    }
    unreachable = robot.ignored_pairs - adjacent - design - nested - redundant
    groups = (robot.arm, robot.hand)
    lower, upper = (np.concatenate([getattr(group, key) for group in groups]) for key in ("lower", "upper"))
    configurations = np.random.default_rng(7).uniform(lower, upper, (2000, len(lower)))
    assert min(closest(robot, unreachable, configurations).values()) > 0.002


def test_fingers_collide_with_each_other_and_with_the_palm(robot):
    pairs = colliding_pairs(robot)
    links = [finger.links for finger in robot.fingers.values()]
    for first, second in pairwise(links[1:]):
        assert {tuple(sorted((a, b))) for a, b in zip(first, second, strict=True)} <= pairs
    for finger in robot.fingers.values():
        assert {tuple(sorted((robot.palm_link, link))) for link in (finger.medial, finger.distal)} <= pairs


def test_collision_bits_reproduce_exactly_the_ignored_pairs(robot):
    bits = robot.collision_bits()
    assert set(bits) == set(robot.shapes)
    assert max(bits.values()) < 1 << 30
    shared = {(a, b) for a, b in combinations(sorted(bits), 2) if bits[a] & bits[b]}
    assert shared == robot.ignored_pairs


@pytest.mark.parametrize("seed", range(5))
def test_clique_cover_covers_every_edge_and_no_other(seed):
    rng = np.random.default_rng(seed)
    names = [f"link{index:02d}" for index in range(14)]
    pairs = frozenset(pair for pair in combinations(names, 2) if rng.random() < 0.4)
    cover = clique_cover(pairs)
    assert {edge for clique in cover for edge in combinations(sorted(clique), 2)} == pairs


def test_too_many_ignored_pairs_are_refused(robot):
    left, right = [f"a{i}" for i in range(6)], [f"b{i}" for i in range(6)]
    bipartite = replace(robot, ignored_pairs=frozenset((a, b) for a in left for b in right))
    with pytest.raises(InputError, match="36 collision bits"):
        bipartite.collision_bits()


@pytest.mark.parametrize("make", [np.asarray, lambda x: torch.tensor(np.asarray(x))])
def test_hand_expansion_couples_the_distal_joints(robot, make):
    actuated = make(np.random.default_rng(0).random((4, 15)))
    hand = robot.expand_hand(actuated)
    assert hand.shape == (4, 20)
    assert (robot.reduce_hand(hand) == actuated).all()
    assert (hand[:, 3::4] == hand[:, 2::4]).all()
    assert list(robot.hand_actuated) == [i for i in range(20) if i % 4 != 3]
    geared = replace(robot, couplings=(Coupling(follower=3, leader=2, multiplier=0.5, offset=0.1),))
    actuated = make(np.random.default_rng(0).random((4, 19)))
    assert (geared.expand_hand(actuated)[:, 3] == 0.5 * actuated[:, 2] + 0.1).all()


def test_a_cylinder_with_two_equal_spheres_becomes_a_capsule():
    turn, identity = (0.5**0.5, 0.0, -(0.5**0.5), 0.0), (1.0, 0.0, 0.0, 0.0)
    bar = Shape("cylinder", (0.0, 0.0, 0.1), turn, (0.02, 0.05))
    balls = [Shape("sphere", (0.0, 0.0, z), identity, (r,)) for z, r in ((0.05, 0.02), (0.15, 0.02), (0.15, 0.03))]
    (capsule, rest) = merge_capsules([bar, *balls])
    assert (capsule.kind, capsule.size, rest) == ("capsule", (0.02, 0.05), balls[2])
    assert [shape.kind for shape in merge_capsules([bar, balls[0], balls[2]])] == [
        "cylinder",
        "sphere",
        "sphere",
    ]


@pytest.mark.parametrize(
    ("kind", "size", "volume"),
    [
        ("box", (0.1, 0.2, 0.3), 0.048),
        ("sphere", (0.1,), 4.18879e-3),
        ("cylinder", (0.1, 0.2), 1.256637e-2),
        ("capsule", (0.1, 0.2), 1.675516e-2),
    ],
)
def test_primitives_have_a_volume(kind: Literal["box", "sphere", "cylinder", "capsule"], size: tuple, volume: float):
    assert Shape(kind, (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), size).volume == pytest.approx(volume, rel=1e-5)


def test_robots_are_found_in_further_folders(folder, monkeypatch):
    monkeypatch.setenv("DORA_ROBOTS", str(folder.parent))
    assert "spoiled" in available_robots()
    assert load_robot("spoiled").folder == folder.resolve()


@pytest.mark.parametrize(
    ("name", "hint"), [("diana7_hti", "did you mean 'diana7_hit'[?]"), ("ur5", "choose one of .*diana7_hit")]
)
def test_an_unknown_robot_is_refused_with_a_suggestion(name: str, hint: str):
    with pytest.raises(InputError, match=f"unknown robot '{name}': {hint}"):
        load_robot(name)


TOML, URDF = "robot.toml", "robot.urdf"
SPOILED = {
    "missing URDF": (TOML, 'urdf = "robot.urdf"', 'urdf = "none.urdf"', "none.urdf does not exist"),
    "no TOML": (TOML, "[arm]", "[arm", "not valid TOML"),
    "unknown key": (TOML, "[arm]", "[arm]\nstiffnes = 1.0", "unknown key 'stiffnes'"),
    "missing key": (TOML, "armature = 5e-4", "", "lacks the key 'armature'"),
    "URDF without the joint": (URDF, '"Right_Ring_2"', '"Right_Ring_9"', "no moving joint 'Right_Ring_2'"),
    "unknown link": (TOML, 'palm_link = "base_link_hithand"', 'palm_link = "hand"', "no link 'hand'"),
    "wrong length": (
        TOML,
        "pad = [-0.007, 0.025, 0.0]",
        "pad = [0.025, 0.0]",
        "pad must be a list of 3 numbers",
    ),
    "not a number": (TOML, "armature = 5e-4", "armature = nan", "armature must be finite"),
    "a word": (TOML, "armature = 5e-4", 'armature = "big"', "armature must be numbers"),
    "negative gain": (TOML, "damping = 300.0", "damping = -1.0", "must not be negative"),
    "duplicate joint": (TOML, '"joint2"', '"joint1"', "every name occurs once"),
    "joint in both groups": (TOML, '"joint7"', '"Right_Ring_0"', "both in arm and hand"),
    "outside limits": (TOML, "arm = [0.0, 0.0, 0.0,", "arm = [0.0, 9.0, 0.0,", "'joint2' outside its limits"),
    "limits crossed": (URDF, 'lower="0" upper="3.054326"', 'lower="4" upper="3.054326"', "lower limit above"),
    "limit missing": (URDF, '<limit lower="0" upper="3.054326"', '<limited lower="0"', "has no <limit>"),
    "NaN limit": (URDF, 'upper="3.054326"', 'upper="nan"', "finite limits"),
    "duplicate link": (URDF, '<link name="link2">', '<link name="link1">', "two links named 'link1'"),
    "two roots": (URDF, '<child link="link3"/>', '<child link="link4"/>', "one tree"),
    "a loop": (URDF, '<parent link="link2"/>', '<parent link="link4"/>', "one tree"),
    "no shape": (URDF, '<cylinder radius="0.092" length="0.022"/>', "", "a <geometry> is empty"),
    "unknown shape": (URDF, "<box size", "<ball size", "<ball> is not"),
    "no XML": (URDF, "</robot>", "", "not valid XML"),
    "chained coupling": (
        TOML,
        'leader = "Right_Ring_2"',
        'leader = "Right_Index_3"',
        "follows another joint",
    ),
    "unknown leader": (TOML, 'leader = "Right_Ring_2"', 'leader = "joint1"', "not a joint of the hand"),
    "stray pair": (TOML, '["link4"]', '["thumb_tip"]', "no collision shapes"),
    "pair with itself": (TOML, 'link2 = ["link4"]', 'link2 = ["link2"]', "names the link itself"),
    "no contact group": (TOML, '"link6", "link7"]', '"link6"]', "'link7' has collision shapes"),
    "two contact groups": (
        TOML,
        '"link6", "link7"]',
        '"base_link_hithand", "link7"]',
        "in two contact groups",
    ),
}


@pytest.mark.parametrize("case", SPOILED)
def test_bad_files_are_refused_with_one_clear_sentence(folder, case):
    name, old, new, message = SPOILED[case]
    text = (folder / name).read_text()
    assert old in text
    (folder / name).write_text(text.replace(old, new, 1))
    with pytest.raises(InputError, match=re.escape(message)) as caught:
        load_robot(folder)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("key", ["arm", "hand", "coupling", "fingers", "postures", "contact", "no_collision"])
def test_a_number_in_place_of_a_table_is_refused(robot, key):
    path = robot.folder / TOML
    content = tomllib.loads(path.read_text()) | {key: 3}
    with pytest.raises(InputError, match=f"{key} must be a"):
        _Reader(path, robot.model).robot(content)


def test_an_incomplete_parameter_table_is_refused(robot):
    parameters = yaml.safe_load((robot.folder / "parameters.yaml").read_text())
    del parameters["links"]["link3"]["mass"]
    with pytest.raises(InputError, match="'mass'"):
        build_urdf(parameters)
