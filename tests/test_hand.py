"""The batched hand model against pytorch_kinematics, finite differences and its own geometry."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import pytorch_kinematics
import torch
from other_robots import changed, unchanged
from refusals import refused

from dora.affordance.hand.capsules import Capsule, capsules_of, farthest_points
from dora.affordance.hand.hand_model import PALM, HandModel
from dora.errors import InputError
from dora.geometry.rotations import matrix_from_rotation_vector
from dora.robot import RobotDescription, Shape

POSITION_TOLERANCE = 1e-5
"""Largest accepted difference of two libraries' frames (m, and unitless for rotation entries)."""


@pytest.fixture(scope="module")
def hand(robot) -> HandModel:
    return HandModel(robot, dtype=torch.float64)


def random_wrist(count: int, seed: int = 0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    wrist = torch.eye(4, dtype=torch.float64).repeat(count, 1, 1)
    wrist[:, :3, :3] = matrix_from_rotation_vector(torch.randn(count, 3, generator=generator, dtype=torch.float64))
    wrist[:, :3, 3] = 0.1 * torch.randn(count, 3, generator=generator, dtype=torch.float64)
    return wrist


def random_joints(hand: HandModel, count: int, seed: int = 0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    share = torch.rand(count, len(hand.lower), generator=generator, dtype=torch.float64)
    return hand.lower + (hand.upper - hand.lower) * share


def test_agrees_with_pytorch_kinematics(robot, hand):
    chain = pytorch_kinematics.build_chain_from_urdf(robot.urdf.read_bytes()).to(dtype=torch.float64)
    joints = random_joints(hand, 16)
    full = robot.expand_hand(joints)
    angles = {name: full[:, index] for index, name in enumerate(robot.hand.names)}
    angles |= {name: torch.zeros(16, dtype=torch.float64) for name in robot.arm.names}
    theirs = {name: frame.get_matrix() for name, frame in chain.forward_kinematics(angles).items()}
    wrist = theirs[robot.wrist_link]
    ours = hand.forward(wrist, joints)
    expected = torch.stack([theirs[link] for link in hand.links], 1)
    assert (ours - expected).abs().max() < POSITION_TOLERANCE


def test_coupled_joints_follow(robot, hand):
    joints = random_joints(hand, 3)
    order = [robot.hand.names.index(name) for finger in robot.fingers.values() for name in finger.joints]
    assert torch.allclose(hand.all_joints(joints), robot.expand_hand(joints)[:, order])
    np.testing.assert_allclose(hand.upper.numpy(), robot.hand.upper[robot.hand_actuated])


def test_points_move_with_their_bodies(hand):
    poses = hand.forward(random_wrist(4), random_joints(hand, 4))
    for points in (hand.spheres, hand.contacts, hand.ends):
        frames = poses[:, points.body]
        expected = (frames[..., :3, :3] @ points.local[..., None]).squeeze(-1) + frames[..., :3, 3]
        assert torch.allclose(hand.place(poses, points), expected, atol=1e-12)


def test_fingers_with_different_numbers_of_points(hand):
    keep = torch.arange(0, len(hand.contacts.body), 7)
    points = hand._points(hand.contacts.body[keep].numpy(), hand.contacts.local[keep].numpy())
    poses = hand.forward(random_wrist(2), random_joints(hand, 2))
    assert points.columns is not None
    assert torch.allclose(hand.place(poses, points), hand.place(poses, hand.contacts)[:, keep], atol=1e-12)


def test_pull_back_is_the_transposed_jacobian(hand):
    wrist, joints = random_wrist(3), random_joints(hand, 3)
    force = torch.randn(3, len(hand.spheres.body), 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    poses = hand.forward(wrist, joints)
    points = hand.place(poses, hand.spheres)
    wrench = torch.zeros(3, len(hand.links), 6, dtype=torch.float64)
    wrench.index_add_(1, hand.spheres.body, torch.cat((force, torch.linalg.cross(points, force)), -1))
    on_wrist, on_joints = hand.pull_back(poses, wrench)

    def work(move: torch.Tensor) -> torch.Tensor:
        moved = wrist.clone()
        moved[:, :3, 3] += move[:, :3]
        moved[:, :3, :3] = matrix_from_rotation_vector(move[:, 3:6]) @ wrist[:, :3, :3]
        return (force * hand.place(hand.forward(moved, joints + move[:, 6:]), hand.spheres)).sum()

    move = torch.zeros(3, 6 + joints.shape[1], dtype=torch.float64, requires_grad=True)
    work(move).backward()
    assert move.grad is not None
    assert torch.allclose(torch.cat((on_wrist, on_joints), 1), move.grad, atol=1e-9)


def test_contact_points_are_on_the_surface_and_face_inwards(hand):
    bodies = set(hand.contacts.body.tolist())
    assert bodies == {capsule.body for capsule in hand.capsules}
    for body in bodies:
        points = hand.contacts.local[hand.contacts.body == body].numpy()
        gap = np.min([c.distance(points) for c in hand.capsules if c.body == body], axis=0)
        assert np.abs(gap).max() < 3e-4
    closed = torch.clamp(torch.full_like(hand.lower, 0.4), hand.lower, hand.upper)[None] * (hand.lower > -0.1)
    poses = hand.forward(torch.eye(4, dtype=torch.float64)[None], closed)
    normal = (poses[0, hand.contacts.body, :3, :3] @ hand.contact_normal[..., None]).squeeze(-1)
    palm, fingers = hand.contact_part == PALM, hand.contact_part > PALM + 1
    assert (normal[palm] @ torch.tensor(hand.palm_frame.normal)).min() > 0.5
    assert (normal[fingers] @ torch.tensor(hand.palm_frame.normal)).mean() > 0.4


def test_grip_frame_of_this_hand(hand):
    assert hand.palm_frame.normal @ [1, 0, 0] > 0.99
    assert hand.palm_frame.along @ [0, 0, 1] > 0.99
    assert hand.palm_frame.across @ [0, 1, 0] > 0.99


def test_spheres_lie_in_the_capsules_and_cover_their_axes(hand):
    for capsule in hand.capsules:
        centers = capsule.spheres()
        assert np.abs(capsule.nearest(centers) - centers).max() < 1e-12
        assert np.linalg.norm(np.diff(centers, axis=0), axis=1).max(initial=0) < 2 * capsule.radius


def test_only_pairs_that_may_collide_are_watched(robot, hand):
    links = {tuple(sorted((hand.capsules[i].link, hand.capsules[j].link))) for i, j in hand.pairs.tolist()}
    assert links
    assert not links & robot.ignored_pairs


@pytest.mark.parametrize(
    ("shape", "inside"),
    [
        (Shape("box", (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), (0.03, 0.01, 0.02)), 8),
        (Shape("cylinder", (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), (0.01, 0.03)), 1),
        (Shape("cylinder", (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), (0.045, 0.005)), 9),
        (Shape("cylinder", (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), (0.01, 0.01)), 1),
        (Shape("sphere", (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), (0.01,)), 1),
        (Shape("capsule", (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), (0.01, 0.03)), 1),
    ],
)
def test_capsules_of_every_kind_of_shape_stay_inside_it(shape, inside):
    capsules = capsules_of(shape, 0, "link", np.eye(4))
    assert 1 <= len(capsules) <= inside
    reach = np.max([np.abs(np.stack((c.start, c.end))).max(0) + c.radius for c in capsules], axis=0)
    half = np.array(shape.size) if shape.kind == "box" else np.array([shape.size[-1], shape.size[0], shape.size[0]])
    if shape.kind == "capsule":
        half[0] += shape.size[0]
    np.testing.assert_allclose(reach, half)


def test_a_disc_becomes_capsules_that_lie_in_it_and_cover_it():
    disc = Shape("cylinder", (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), (0.04, 0.005))
    capsules = capsules_of(disc, 0, "link", np.eye(4))
    ends = np.concatenate([(c.start, c.end) for c in capsules])
    assert np.hypot(ends[:, 1], ends[:, 2]).max() + 0.005 <= 0.04 + 1e-12
    assert np.abs(ends[:, 0]).max() < 1e-12
    middle = np.random.default_rng(0).uniform(-0.024, 0.024, (200, 3)) * [0, 1, 1]
    assert np.min([c.distance(middle) for c in capsules], axis=0).max() < 0
    foil = Shape("cylinder", (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), (0.04, 0.00005))
    with pytest.raises(InputError, match=r"cylinder of the link 'link' is 0\.0001 m thin"):
        capsules_of(foil, 0, "link", np.eye(4))


def test_the_last_link_of_a_shorter_finger_leans_to_its_tip(tmp_path, hand):
    """Its contact points reach round the end; those of a link that another one follows face the palm alone."""
    short = HandModel(changed(tmp_path / "short", unchanged, short=True))
    least = []
    for model in (short, hand):
        rows = model.contacts.body == model.links.index("Right_Little_Phamed")
        least.append(float(model.contact_normal[rows][:, 1].min()))  # the palmar side of the link is y
    assert least[0] < 0.4
    assert least[1] > 0.59


def test_farthest_points_spread():
    points = np.random.default_rng(0).normal(size=(100, 3))
    chosen = farthest_points(points, 10)
    assert len(set(chosen.tolist())) == 10
    assert len(farthest_points(points[:4], 10)) == 4


def test_capsule_without_length_is_a_sphere():
    capsule = Capsule(0, "link", np.zeros(3), np.zeros(3), 0.01)
    assert capsule.spheres().shape == (1, 3)
    np.testing.assert_allclose(capsule.distance(np.array([[0.03, 0.0, 0.0]])), 0.02)


def with_shape(robot: RobotDescription, link: str, *shapes: Any) -> Any:
    """The robot with other shapes on a link, or without them."""
    made = tuple(Shape(kind, (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), size) for kind, size in shapes)
    return replace(robot, shapes=robot.shapes | {link: made})


@pytest.mark.parametrize(
    ("shape", "words"),
    [
        (("box", (0.5, 0.5, 5e-10)), "is 1e-09 m thin, so that it needs [0-9]+ capsules"),
        (("box", (0.05, 0.05, 1e-4)), "is 0.0002 m thin, so that it needs 500 capsules"),
        (("cylinder", (0.0765, 5e7)), "become more than 300 capsules or 1 m.2"),
        (("cylinder", (5.0, 5.0)), "become more than 300 capsules or 1 m.2"),
        (("sphere", (1e6,)), "become more than 300 capsules or 1 m.2"),
        (("cylinder", (1e-6, 5.0)), "more than 20000 spheres"),
    ],
)
def test_shapes_that_need_too_much_are_refused(robot: RobotDescription, shape: Any, words: str):
    with refused(words):
        HandModel(with_shape(robot, robot.palm_link, shape))


def test_many_thin_shapes_are_refused(robot: RobotDescription):
    with refused("up to 'base_link_hithand' become more than 300 capsules"):
        HandModel(with_shape(robot, robot.palm_link, *[("box", (0.02, 0.02, 2e-4))] * 4))


@pytest.mark.parametrize("radius", [1e-9, 1e-4, 3e-4, 5e-4])
def test_thin_capsules_have_spheres_that_touch(radius: float):
    capsule = Capsule(0, "a", np.zeros(3), np.array([20.5 * radius, 0.0, 0.0]), radius)
    assert np.diff(capsule.spheres()[:, 0]).max() <= 2 * radius
    assert len(capsule.spheres()) == capsule.sphere_count() <= 13
    assert len(Capsule(0, "a", np.zeros(3), np.zeros(3), radius).spheres()) == 1


def test_a_hand_of_thin_shapes_is_modelled(robot: RobotDescription):
    link = robot.fingers["thumb"].distal
    for shape in (("sphere", (1e-4,)), ("cylinder", (1e-4, 1e-3)), ("box", (1e-3, 1e-3, 1e-4))):
        assert HandModel(with_shape(robot, link, shape)).palm_frame.normal.shape == (3,)


def test_a_hand_without_shapes_is_refused(robot: RobotDescription):
    with refused("the finger 'thumb' of 'diana7_hit' has no collision shape"):
        HandModel(replace(robot, shapes={}))
    thumb = robot.fingers["thumb"]
    with refused("the finger 'thumb' of 'diana7_hit' has no collision shape"):
        HandModel(replace(robot, shapes={k: v for k, v in robot.shapes.items() if k not in thumb.links}))
    bare = HandModel(replace(robot, shapes={k: v for k, v in robot.shapes.items() if k != robot.palm_link}))
    assert np.isfinite(bare.palm_frame.center).all()
    assert PALM not in bare.contact_part


def test_a_palm_that_faces_nowhere_is_refused(robot: RobotDescription):
    joints = {name: replace(joint, lower=-1.0, upper=1.0) for name, joint in robot.model.joints.items()}
    with refused("the palm of 'diana7_hit' faces nowhere"):
        HandModel(replace(robot, model=replace(robot.model, joints=robot.model.joints | joints)))


def test_a_tip_on_the_last_joint_is_refused(robot: RobotDescription):
    joints = dict(robot.model.joints)
    (name,) = [name for name, joint in joints.items() if joint.child == "thumb_tip"]
    joints[name] = replace(joints[name], origin=np.eye(4))
    with refused("the tip 'thumb_tip' lies on the last joint"):
        HandModel(replace(robot, model=replace(robot.model, joints=joints)))
