"""Ways of the two arms of DoraMicrowave-v1 and what they can reach, in numbers that are worked out by hand."""

from math import cos, pi, sin
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from invented_microwave import in_world, invented, turned
from scipy.spatial.transform import Rotation
from test_guidance import along_x
from torch import Tensor

from dora.geometry.rotations import quaternion_from_yaw
from dora.tasks.env.arm import Arm
from dora.tasks.guidance.waypoints import Kept
from dora.tasks.microwave import reach
from dora.tasks.microwave.reach import OvenReach, opening_way, oven_reach, placing_way
from dora.tasks.microwave.reference import OpenSettings, PlaceSettings, opening, placing, with_door
from dora.tasks.microwave.snapshot import LEFT, RIGHT

IDENTITY = torch.tensor([1.0, 0.0, 0.0, 0.0])
OPEN, PLACE = OpenSettings(), PlaceSettings()


def near(*expected: float) -> Any:
    return pytest.approx(list(expected), abs=1e-5)


# ------------------------------------------------------------------------ f_reach


def test_a_microwave_counts_as_the_nearest_node():
    """Differences of 4 cm and of .2 rad are equally far."""
    nodes = torch.tensor([[0.7, 0.0, 0.0], [0.74, 0.0, 0.0], [0.7, 0.0, 0.2]])
    known = OvenReach(nodes, torch.tensor([0.04, 0.04, 0.2]), torch.eye(3, dtype=torch.bool))
    places = torch.tensor([[0.71, 0.01, 0.1], [0.73, 0.0, 0.1], [0.71, 0.0, 0.12]])
    found = known.mask(places, quaternion_from_yaw(torch.tensor([0.05, 0.05, 0.12])))
    assert found.int().argmax(-1).tolist() == [0, 1, 2]


class Following:
    """Kinematics that solve what is before x = .5 in the arm's frame."""

    def __init__(self, *_: Any):
        pass

    def follow(self, start: Tensor, position: Tensor, quaternion: Tensor, most: int) -> tuple[None, Tensor]:
        self.asked = position
        return None, position[..., 0] < 0.5


@pytest.mark.parametrize(("spread", "turn", "count"), [(0.04, 0.2, 45), (0.0, 0.0, 1), (0.04, 0.0, 9)])
def test_the_way_is_followed_from_every_node(spread: float, turn: float, count: int, monkeypatch: pytest.MonkeyPatch):
    """Every pose of the way has to be solved, in the frame of an arm that stands 20 cm to the right."""
    monkeypatch.setattr(reach, "InverseKinematics", Following)
    arm: Any = Arm.__new__(Arm)
    arm.spec = SimpleNamespace(position=(0.2, 0.0, 0.0), quaternion=(1.0, 0.0, 0.0, 0.0))
    arm.posture = SimpleNamespace(arm=[0.0] * 7)
    arm.agent = SimpleNamespace(description=None, device=torch.device("cpu"))

    def way(candidates: Any, p: Tensor, q: Tensor) -> list[tuple[Tensor, Tensor]]:
        assert (p[:, 2] == 0.1).all()
        there = p[:, None] + candidates.position
        return [(there, q[:, None].expand(-1, 2, 4)), (there - 0.3, q[:, None].expand(-1, 2, 4))]

    found = oven_reach(arm, along_x(0.0, 0.2), way, (0.6, 0.3, 0.1), spread, turn)
    assert found.scale.tolist() == near(*[max(spread, 1e-3)] * 2, max(turn, 1e-3))
    assert found.nodes.shape == (count, 3)
    assert found.nodes.amin(0).tolist() == near(0.6 - spread, 0.3 - spread, -turn)
    assert found.nodes.amax(0).tolist() == near(0.6 + spread, 0.3 + spread, turn)
    assert found.followed.tolist() == [[True, False]] * count


def test_the_door_is_followed_before_the_handle_and_along_its_arc():
    """Hinge and handle 30 cm apart; the wrist is in the handle. The door opens against +z."""
    hinge, handle = (torch.tensor([0.0, 0.2, 0.1]), IDENTITY), (torch.tensor([0.0, -0.3, 0.0]), IDENTITY)
    grasp = along_x(0.0)
    poses = opening_way(hinge, handle, 0.1, 0.4)(grasp, torch.tensor([[0.7, 0.0, 0.1]]), IDENTITY[None])
    places = [p[0, 0].tolist() for p, _ in poses]
    assert places[:2] == [near(0.7, -0.1, 0.3), near(0.7, -0.1, 0.25)]  # the approach is downwards
    arc = [0.4 * k / 3 for k in range(4)]
    assert places[2:] == [near(0.7 - 0.3 * sin(a), 0.2 - 0.3 * cos(a), 0.2) for a in arc]
    for (_, q), angle in zip(poses[2:], arc, strict=True):
        assert q[0, 0].tolist() == near(*quaternion_from_yaw(torch.tensor([-angle]))[0].tolist())


def test_the_cube_is_followed_straight_into_the_cavity():
    """A hand whose fingers point along +y of the world is turned by a right angle, and the microwave by .3 rad."""
    grasp = along_x(0.1)
    fingers = torch.tensor([[cos(pi / 4), -sin(pi / 4), 0.0, 0.0]])
    grasp = grasp.with_tensors(grasp.tensors() | {"quaternion": fingers}, grasp.grasp_class)
    q = quaternion_from_yaw(torch.tensor([0.3]))
    poses = placing_way(0.17, 0.10, 0.2)(grasp, torch.tensor([[0.7, 0.0, 0.1]]), q)
    assert len(poses) == 6
    for (p, turn), share in zip(poses, [1, 0.8, 0.6, 0.4, 0.2, 0], strict=True):
        x, y = 0.10 - 0.27 * share, -0.1  # the wrist is beside the cube then
        assert p[0, 0].tolist() == near(0.7 + x * cos(0.3) - y * sin(0.3), x * sin(0.3) + y * cos(0.3), 0.3)
        ahead = Rotation.from_quat(turn[0, 0].numpy(), scalar_first=True).apply([0.0, 0.0, 1.0])
        assert ahead.tolist() == near(cos(0.3), sin(0.3), 0.0)


# ------------------------------------------------------------------------ references


def test_the_wrist_turns_about_the_hinge_with_the_door():
    """A quarter turn against +z takes what is at -y of the hinge to -x of it."""
    hinge = torch.tensor([0.0, 0.2, 0.0])
    s = invented(goals={LEFT: {"p": in_world(0.0, -0.1, 0.15)}}).of(LEFT)
    p, q = with_door(s, hinge, torch.full((2,), pi / 2))
    torch.testing.assert_close(p, in_world(-0.3, 0.2, 0.15))
    torch.testing.assert_close(q, turned(-pi / 2))


@pytest.mark.parametrize(
    ("door", "ahead"), [(0.0, OPEN.lead), (OPEN.target - 0.05, 0.05), (OPEN.target + 0.5, -OPEN.lead)]
)
def test_the_wrist_is_at_most_a_little_ahead_of_the_door(door: float, ahead: float):
    hinge = torch.tensor([0.0, 0.2, 0.0])
    way = {w.name: w for w in opening(OPEN, hinge)}
    s = invented(goals={LEFT: {"p": in_world(0.0, -0.1, 0.15)}}, door=torch.full((2,), door)).of(LEFT)
    zero = torch.zeros(2, 3), turned(0.0)
    expected = with_door(s, hinge, torch.full((2,), ahead))
    torch.testing.assert_close(way["pull"].goal(s, Kept(zero, zero, zero)), expected)


@pytest.mark.parametrize(
    ("away", "door", "expected"),
    [(0.079, 0.0, False), (0.081, 0.0, True), (0.081, OPEN.target - 0.24, False), (0.081, OPEN.target - 0.26, True)],
)
def test_a_lost_handle_is_grasped_again_unless_the_door_is_nearly_open(away: float, door: float, expected: bool):
    way = {w.name: w for w in opening(OPEN, torch.zeros(3))}
    left = {"wrist_p": torch.tensor([[away, 0.0, 0.0]] * 2)}
    s = invented(left=left, door=torch.full((2,), door)).of(LEFT)
    for name in ("close", "pull"):
        assert way[name].lost is not None
        assert way[name].lost(s).tolist() == [expected] * 2  # pyright: ignore[reportOptionalCall]


def test_the_hand_comes_to_the_handle_in_three_steps():
    goal = {"p": torch.tensor([[0.5, 0.2, 0.3]] * 2), "approach": torch.tensor([[1.0, 0.0, 0.0]] * 2)}
    s, zero = invented(goals={LEFT: goal, RIGHT: goal}), (torch.zeros(2, 3), turned(0.0))
    kept = Kept(zero, zero, zero)
    ahead = [w.goal(s.of(LEFT), kept)[0][0].tolist() for w in opening(OPEN, torch.zeros(3))[:3]]
    assert ahead == [near(0.5 - 0.2, 0.2, 0.3), near(0.4, 0.2, 0.3), near(0.5, 0.2, 0.3)]
    ahead = [w.goal(s.of(RIGHT), kept)[0][0].tolist() for w in placing(PLACE, 0.02)[:2]]
    assert ahead == [near(0.4, 0.2, 0.3), near(0.5, 0.2, 0.3)]


def test_the_cube_is_carried_in_put_down_and_left_straight_out():
    """The wrist holds the cube from 10 cm behind it, with the fingers along the way in; the approach was along x."""
    floor, half = 0.02, 0.03
    cube = torch.tensor([[0.4, -0.4, 0.03]] * 2)
    ahead = torch.tensor([[cos(pi / 4), 0.0, sin(pi / 4), 0.0]] * 2)  # z of the hand along x of the world
    kept = Kept((cube - torch.tensor([0.1, 0.0, 0.0]), ahead), (cube, turned(0.0)), (cube, turned(0.0)))
    goal = {"approach": torch.tensor([[1.0, 0.0, 0.0]] * 2), "p": torch.full((2, 3), 0.2)}
    s = invented(goals={RIGHT: goal}, cube={"p": cube}).of(RIGHT)
    way = {w.name: w.goal(s, kept)[0] for w in placing(PLACE, floor)}
    low, high = floor + half + PLACE.above_floor, floor + half + PLACE.raised
    raised = kept.goal[0].clone()
    raised[:, 2] += 0.1 + high - 0.03
    torch.testing.assert_close(way["close"], kept.goal[0])
    torch.testing.assert_close(way["raise"], raised)
    torch.testing.assert_close(way["carry"], in_world(-PLACE.front - 0.1, 0.0, high))
    torch.testing.assert_close(way["insert"], in_world(PLACE.depth - 0.1, 0.0, high))
    for name in ("lower", "release"):
        torch.testing.assert_close(way[name], in_world(PLACE.depth - 0.1, 0.0, low))
    torch.testing.assert_close(way["back off"], in_world(PLACE.depth - 0.1 - PLACE.back_off, 0.0, low))
    torch.testing.assert_close(way["leave"], in_world(-0.1 - PLACE.back_off - PLACE.front, 0.0, low))


@pytest.mark.parametrize(("name", "angle"), [("carry", PLACE.carry_at), ("insert", PLACE.open_at)])
def test_the_cube_waits_for_the_door(name: str, angle: float):
    way = {w.name: w for w in placing(PLACE, 0.02)}
    ready = way[name].ready
    assert ready is not None
    assert ready(invented(door=torch.tensor([angle - 0.01, angle + 0.01])).of(RIGHT)).tolist() == [False, True]
    lost = way[name].lost
    assert lost is not None
    wrists = {"wrist_p": torch.tensor([[PLACE.lost - 1e-3, 0.0, 0.0], [PLACE.lost + 1e-3, 0.0, 0.0]])}
    assert lost(invented(right=wrists).of(RIGHT)).tolist() == [False, True]
