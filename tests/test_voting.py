"""The three equations of the vote, its ties and empty contacts, and the contact semantic map."""

import time
from collections import Counter
from collections.abc import Mapping

import pytest
import torch
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from dora.affordance.hand.hand_model import HandModel
from dora.affordance.maps import contact_semantic_map as maps
from dora.affordance.maps.affordance_map import AffordanceMap
from dora.affordance.maps.contact_semantic_map import (
    contact_semantic_map,
    pressed_contacts,
    wrist_matrix,
)
from dora.affordance.maps.voting import HAND_PARTS, NO_CONTACT, VotingSettings, vote, vote_over_map
from dora.affordance.objects.catalogue import load_object
from dora.affordance.objects.signed_distance import SignedDistanceField
from dora.errors import InputError
from dora.geometry.segments import distance_to_segment
from dora.robot import load_robot

ENVIRONMENTS, CONTACTS = 128, 6


@pytest.fixture(scope="module")
def jug() -> AffordanceMap:
    return AffordanceMap.from_object(load_object("jug"))


def plain_vote(map: AffordanceMap, contacts, finger, settings: VotingSettings) -> int:
    """The equations of the paper, read aloud, for one environment."""
    neighbours = {}
    for point, part in zip(contacts, finger.tolist(), strict=True):
        if part > 0:
            order = (map.points - point).norm(dim=-1).argsort()[: settings.neighbours]
            neighbours.setdefault(part, []).extend(map.labels[order].tolist())
    if not neighbours:
        return NO_CONTACT
    overall = Counter(label for labels in neighbours.values() for label in labels)

    def best(score: Mapping[int, float]) -> int:
        return max(score, key=lambda label: (score[label], overall[label], -label))

    sums: dict[int, float] = {}
    for part, labels in neighbours.items():
        choice = best(Counter(labels))
        sums[choice] = sums.get(choice, 0.0) + settings.weights[part - 1]
    return best(sums)


@given(st.integers(0, 10_000), st.integers(1, 12), st.integers(1, 9))
@settings(max_examples=40, deadline=None)
def test_vote_is_the_three_equations(jug, seed, neighbours, contacts):
    generator = torch.Generator().manual_seed(seed)
    at = jug.points[torch.randint(len(jug), (8, contacts), generator=generator)]
    at = at + 4e-3 * torch.randn(8, contacts, 3, generator=generator)
    finger = torch.randint(0, 7, (8, contacts), generator=generator)
    chosen = VotingSettings(neighbours=neighbours)
    found = vote(jug, at, finger, chosen)
    assert found.tolist() == [plain_vote(jug, *row, chosen) for row in zip(at, finger, strict=True)]


def box_map(labels: list[int]) -> AffordanceMap:
    """A map whose points are on a line 1 cm apart and have the given labels."""
    count = len(labels)
    points = torch.zeros(count, 3)
    points[:, 0] = 0.01 * torch.arange(count)
    normals = torch.tensor([[0.0, 0.0, 1.0]]).repeat(count, 1)
    mesh = trimesh.creation.box((0.1, 0.1, 0.1))
    return AffordanceMap(
        name="line",
        points=points,
        normals=normals,
        areas=torch.full((count,), 1e-4),
        labels=torch.tensor(labels),
        names=("a", "b", "c"),
        mesh=mesh,
        face_labels=torch.zeros(len(mesh.faces), dtype=torch.long).numpy(),
        digest="",
    )


@pytest.mark.parametrize(
    ("where", "finger", "expected"),
    [
        ([0.0, 0.05], [0, 0], NO_CONTACT),  # nothing touches
        ([0.0, 0.05], [3, 0], 0),  # one finger on a
        ([0.0, 0.05], [3, 2], 2),  # index on a, thumb on c: the thumb weighs more
        ([0.0, 0.05, 0.0], [3, 2, 4], 0),  # 2 : 2, and more neighbours are a
        ([0.0, 0.028], [3, 4], 0),  # 1 : 1, as many neighbours each: first name
        ([0.0, 0.028, 0.028], [3, 4, 4], 1),  # 1 : 1, and more neighbours are b
        ([0.0, 0.0, 0.028], [2, 2, 2], 0),  # mode within the thumb
        ([0.016, 0.028], [2, 3], 1),  # a and b equally near the thumb, and more neighbours of all are b
    ],
)
def test_ties_and_empty_contacts(where, finger, expected):
    line = box_map([0, 0, 1, 1, 2, 2])
    contacts = torch.zeros(1, len(where), 3)
    contacts[0, :, 0] = torch.tensor(where)
    assert vote(line, contacts, torch.tensor([finger]), VotingSettings(neighbours=2)).item() == expected


@pytest.mark.parametrize(
    ("parts", "expected"),
    [
        ([0, 0, 0, 0, 0, 0], NO_CONTACT),  # nothing touches
        ([3, 0, 0, 0, 0, 0], 0),  # one finger on a
        ([3, 0, 0, 0, 0, 2], 2),  # index on a, thumb on c: the thumb weighs more
        ([3, 4, 0, 0, 0, 2], 0),  # 2 : 2, and more neighbours are a
        ([3, 0, 4, 0, 0, 0], 0),  # 1 : 1, as many neighbours each: first name
        ([3, 0, 4, 4, 0, 0], 1),  # 1 : 1, and more neighbours are b
        ([2, 2, 2, 0, 3, 3], 0),  # mode within the thumb, which weighs more than the index
        ([3, 3, 4, 5, 6, 6], 1),  # middle and ring on b, one finger each on a and c
        ([1, 1, 0, 0, 4, 4], 0),  # palm and finger weigh the same, as many neighbours each: first name
        ([6, 0, 5, 0, 4, 2], 2),  # thumb and middle outweigh the other fingers
    ],
)
def test_the_printed_vote_takes_every_point_of_the_map_that_is_touched(parts, expected):
    """On a line of points a a b b c c, whose two nearest neighbours are themselves and one of their own label."""
    line = box_map([0, 0, 1, 1, 2, 2])
    line.points[:, 0] = torch.tensor([0.0, 0.01, 0.03, 0.04, 0.06, 0.07])
    found = vote_over_map(line, torch.tensor([parts], dtype=torch.uint8), VotingSettings(neighbours=2))
    assert found.item() == expected


@given(st.integers(0, 10_000), st.integers(1, 9))
@settings(max_examples=20, deadline=None)
def test_the_printed_vote_is_the_vote_of_the_touched_points(jug, seed, neighbours):
    generator = torch.Generator().manual_seed(seed)
    maps = torch.randint(1, HAND_PARTS + 1, (4, len(jug)), generator=generator)
    maps *= torch.rand(4, len(jug), generator=generator) < 0.004
    chosen = VotingSettings(neighbours=neighbours)
    points = jug.points.expand(4, -1, -1)
    assert vote_over_map(jug, maps.byte(), chosen).tolist() == vote(jug, points, maps, chosen).tolist()


def test_the_printed_vote_needs_the_points_of_the_map(jug):
    with pytest.raises(InputError, match="the contact maps have 7 points and the affordance map of jug 4096"):
        vote_over_map(jug, torch.zeros(2, 7, dtype=torch.uint8))
    assert vote_over_map(jug, torch.zeros(2, len(jug), dtype=torch.uint8)).tolist() == [NO_CONTACT] * 2


def test_points_without_contact_are_not_looked_at(jug):
    contacts = torch.full((2, 3, 3), torch.nan)
    contacts[0, 0] = jug.points[0]
    found = vote(jug, contacts, torch.tensor([[2, 0, 0], [0, 0, 0]]))
    assert found.tolist() == [int(jug.labels[0]), NO_CONTACT]


def test_no_contact_point_at_all(jug):
    assert vote(jug, torch.zeros(2, 0, 3), torch.zeros(2, 0, dtype=torch.long)).tolist() == [NO_CONTACT] * 2


def test_vote_is_cheap_enough_for_every_step(jug):
    generator = torch.Generator().manual_seed(0)
    at = jug.points[torch.randint(len(jug), (ENVIRONMENTS, CONTACTS), generator=generator)]
    finger = torch.arange(1, CONTACTS + 1).repeat(ENVIRONMENTS, 1)
    vote(jug, at, finger)
    fastest = min(_seconds(jug, at, finger) for _ in range(20))
    assert fastest < 2e-2  # 2 ms without the type checks of the tests; ten times that catches a wrong algorithm


def _seconds(*arguments) -> float:
    start = time.process_time()
    vote(*arguments)
    return time.process_time() - start


@pytest.mark.parametrize(
    ("weights", "where", "finger", "expected"),
    [
        ((1e-3, 2e-3, 1e-3, 1e-3, 1e-3, 1e-3), [0.0, 0.0, 0.0, 0.05], [3, 3, 3, 2], 2),  # many neighbours are a
        ((1.0, 1.5, 1.0, 1.0, 1.0, 2000.0), [0.0, 0.0, 0.0, 0.05], [3, 3, 3, 2], 2),
        ((0.2, 0.2, 0.1, 0.1, 0.1, 0.1), [0.0, 0.05, 0.028], [1, 2, 3], 0),  # .2 : .2 for a and c, first name
        ((0.2, 0.2, 0.1, 0.1, 0.1, 0.1), [0.0, 0.05, 0.05], [1, 2, 2], 2),  # and more neighbours are c
    ],
)
def test_neighbours_decide_ties_only_whatever_the_weights(weights, where, finger, expected):
    line = box_map([0, 0, 1, 1, 2, 2])
    contacts = torch.zeros(1, len(where), 3)
    contacts[0, :, 0] = torch.tensor(where)
    assert vote(line, contacts, torch.tensor([finger]), VotingSettings(2, weights)).item() == expected


@pytest.mark.parametrize(
    "wrong",
    [
        {"neighbours": 0},
        {"weights": (1.0, 1.0)},
        {"weights": (0.0,) * 6},
        {"weights": (1.0, 1.0, 1.0, 1.0, 1.0, 0.0)},
    ],
)
def test_wrong_settings_are_refused(wrong):
    with pytest.raises(InputError):
        VotingSettings(**wrong)


def test_contact_semantic_map_names_the_part_that_touches():
    robot = load_robot("diana7_hit")
    hand = HandModel(robot)
    joints = torch.tensor(robot.postures["home"].hand).float()[None]
    position, quaternion = torch.tensor([[0.1, 0.2, 0.3]]), torch.tensor([[0.5, 0.5, -0.5, 0.5]])
    poses = hand.forward(wrist_matrix(position, quaternion), robot.reduce_hand(joints))
    points = hand.place(poses, hand.contacts)[0]
    found = contact_semantic_map(points, position, quaternion, joints, hand)
    assert (found[0] == hand.contact_part).float().mean() > 0.97
    assert (contact_semantic_map(points + 0.5, position, quaternion, joints, hand) == 0).all()


@pytest.mark.parametrize(("together", "calls"), [(0, 3), (1, 3), (2, 2), (3, 1)])
def test_as_many_hands_are_looked_at_together_as_the_memory_allows(
    monkeypatch: pytest.MonkeyPatch, together: int, calls: int
):
    hand, seen = HandModel(load_robot("diana7_hit")), []
    points, joints = torch.rand(50, 3), torch.tensor(hand.robot.postures["home"].hand).float().repeat(3, 1)
    where = torch.zeros(3, 3), torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(3, 1)
    whole = contact_semantic_map(points, *where, joints, hand)
    monkeypatch.setattr(maps, "CHUNK", together * len(points) * len(hand.radius))
    monkeypatch.setattr(maps, "distance_to_segment", lambda *parts: seen.append(1) or distance_to_segment(*parts))
    assert torch.equal(contact_semantic_map(points, *where, joints, hand), whole)
    assert len(seen) == calls


def test_contact_semantic_map_is_the_nearest_of_all_capsules():
    """Compared with the distance to every capsule, for points everywhere around three hands."""
    robot, generator = load_robot("diana7_hit"), torch.Generator().manual_seed(0)
    hand = HandModel(robot, dtype=torch.float64)
    joints = torch.tensor(robot.postures["home"].hand).double().repeat(3, 1) + torch.tensor([[0.0], [0.1], [0.2]])
    position = 0.02 * torch.randn(3, 3, generator=generator, dtype=torch.float64)
    quaternion = torch.nn.functional.normalize(torch.randn(3, 4, generator=generator, dtype=torch.float64), dim=-1)
    points = 0.12 * torch.randn(4000, 3, generator=generator, dtype=torch.float64)
    ends = hand.place(hand.forward(wrist_matrix(position, quaternion), robot.reduce_hand(joints)), hand.ends)
    start, axis = ends[:, 0::2], ends[:, 1::2] - ends[:, 0::2]
    away = points[None, :, None] - start[:, None]
    share = ((away * axis[:, None]).sum(-1) / axis.square().sum(-1)[:, None].clamp_min(1e-30)).clamp(0, 1)
    gap, nearest = ((away - share[..., None] * axis[:, None]).norm(dim=-1) - hand.radius).min(-1)
    expected = torch.where(gap < 0.005, hand.part[hand.ends.body[0::2]][nearest], 0)
    assert len(expected.unique()) == 7
    assert torch.equal(contact_semantic_map(points, position, quaternion, joints, hand), expected)


def test_pressed_contacts_are_the_overlapping_parts_on_the_surface():
    """A ball between hand and nothing, deeper in the palm than in any finger; then far away."""
    hand, radius = HandModel(load_robot("diana7_hit"), dtype=torch.float64), 0.03
    field = SignedDistanceField(trimesh.creation.icosphere(subdivisions=3, radius=radius), dtype=torch.float64)
    wrist = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
    wrist[:, :3, 3] = -torch.tensor(hand.palm_frame.center + 0.028 * hand.palm_frame.normal)
    wrist[1, 0, 3] += 1.0
    poses = hand.forward(wrist, torch.zeros(2, len(hand.lower), dtype=torch.float64))
    points, part = pressed_contacts(hand, field, poses)
    gap = field.distance(hand.place(poses, hand.spheres)) - hand.sphere_radius
    expected = hand.part[hand.spheres.body][gap[0] < 0]
    assert len(expected) > 0
    assert part[0].tolist() == expected.tolist()
    assert not part[1].any()
    assert points.shape[1] == len(expected)
    assert (points[0].norm(dim=-1) - radius).abs().max() < 1e-3
