"""Quantities of a snapshot against SciPy's rotations and by hand."""

from typing import Any

import numpy as np
import pytest
import torch
from invented import FINGERS, NEAR, TIP_RADIUS, invented
from scipy.spatial.transform import Rotation
from torch import Tensor

from dora.tasks.mdp import quantities as q

N = 4
"""Snapshots in a batch."""
CLOSE: dict[str, Any] = {"atol": 1e-5, "rtol": 0}


def rotations(seed: int, *shape: int) -> tuple[Rotation, Tensor]:
    """Random rotations, flattened, and their quaternions (*shape, 4), wxyz."""
    found = Rotation.from_quat(np.random.default_rng(seed).normal(size=(int(np.prod(shape)), 4)))
    return found, torch.tensor(np.roll(found.as_quat(), 1, -1), dtype=torch.float32).reshape(*shape, 4)


def points(seed: int, *shape: int) -> Tensor:
    return torch.tensor(np.random.default_rng(seed).normal(size=shape), dtype=torch.float32)


def test_points_and_directions_in_the_wrist():
    turn, quaternion = rotations(0, N)
    place, point = points(1, N, 3), points(2, N, 3)
    s = invented(N, wrist_p=place, wrist_q=quaternion)
    expected = turn.inv().apply((point - place).numpy())
    torch.testing.assert_close(q.in_wrist(s, point), torch.tensor(expected, dtype=torch.float32), **CLOSE)
    expected = turn.inv().apply(point.numpy())
    torch.testing.assert_close(q.turned_in_wrist(s, point), torch.tensor(expected, dtype=torch.float32), **CLOSE)


def test_fingertips_in_the_frame_of_the_object():
    turn, quaternion = rotations(3, N)
    place, tips = points(4, N, 3), points(5, N, FINGERS, 3)
    s = invented(N, object_p=place, object_q=quaternion, tip_p=tips)
    for k in range(FINGERS):
        expected = turn.inv().apply((tips[:, k] - place).numpy())
        torch.testing.assert_close(q.tips_in_object(s)[:, k], torch.tensor(expected, dtype=torch.float32), **CLOSE)


@pytest.mark.parametrize(
    ("tip", "distance"),
    [
        ((0.05, 0.0, 0.0), 0.02), ((0.0, -0.05, 0.0), 0.02), ((0.0, 0.0, 0.05), 0.02),  # before a face of the box
        ((0.06, -0.07, 0.0), 0.05), ((0.04, 0.05, 0.05), 0.03),  # beside an edge, beside a corner
        ((0.01, 0.02, 0.0), -0.01), ((0.0, 0.0, -0.025), -0.005),  # inside, below the nearest face
    ],
)  # fmt: skip
def test_distance_of_fingertips_from_a_box(tip: tuple[float, ...], distance: float):
    s = invented(1, tip_p=torch.tensor(tip).repeat(1, FINGERS, 1))
    torch.testing.assert_close(q.box_distance(s), torch.full((1, FINGERS), distance - TIP_RADIUS), **CLOSE)


def test_errors_are_from_the_wrist_to_the_goal_and_to_the_near_candidates():
    wrist, wrist_q = rotations(6, N)
    goal, goal_q = rotations(7, N)
    near, near_q = rotations(8, N, NEAR)
    place, goal_p, near_p = points(9, N, 3), points(10, N, 3), points(11, N, NEAR, 3)
    s = invented(
        N, wrist_p=place, wrist_q=wrist_q, goal_p=goal_p, goal_q=goal_q, goal_nearest_p=near_p, goal_nearest_q=near_q
    )
    shift, turn = q.goal_error(s)
    torch.testing.assert_close(shift, q.in_wrist(s, goal_p), **CLOSE)
    expected = (wrist.inv() * goal).as_rotvec()
    torch.testing.assert_close(turn, torch.tensor(expected, dtype=torch.float32), atol=1e-3, rtol=0)
    errors = q.nearest_errors(s)
    for k in range(NEAR):
        torch.testing.assert_close(errors[:, k, :3], q.in_wrist(s, near_p[:, k]), **CLOSE)
        expected = (wrist.inv() * near[k::NEAR]).as_rotvec()
        torch.testing.assert_close(errors[:, k, 3:], torch.tensor(expected, dtype=torch.float32), atol=1e-3, rtol=0)


def test_heights_count_from_the_start():
    heights = torch.tensor([-0.02, 0.0, 0.019, 0.021, 0.05, 0.2])
    start = torch.zeros(6, 3).index_fill_(1, torch.tensor([2]), 0.3)
    s = invented(6, object_p=start + torch.stack([heights * 0, heights * 0, heights], -1), start_p=start)
    torch.testing.assert_close(q.lifted(s), heights, **CLOSE)
    torch.testing.assert_close(q.rise(s, 0.1), torch.tensor([0.0, 0.0, 0.19, 0.21, 0.5, 1.0]), **CLOSE)
    assert q.off_table(s).tolist() == [False, False, False, True, True, True]
    assert q.off_table(s, 0.1).tolist() == [False] * 5 + [True]


@pytest.mark.parametrize(
    ("touching", "expected"),
    [((0, 1), True), ((0, 4), True), ((0,), False), ((0, 5), False), ((1, 2, 3, 4), False), ((1, 5), False)],
)
def test_a_hand_opposes_with_the_thumb_and_a_finger_not_with_the_palm(touching: tuple[int, ...], expected: bool):
    touch = torch.zeros(1, FINGERS + 1, dtype=torch.bool).index_fill_(1, torch.tensor(touching), True)
    assert q.opposed(invented(1, touch=touch)).item() == expected


def test_thumb_and_nearest_finger():
    """The farther one counts, a fingertip inside as one at the surface."""
    distance = torch.tensor([[0.03, 0.2, 0.01, 0.2, 0.2], [0.01, 0.2, 0.2, 0.2, 0.05], [-0.01, 0.3, -0.02, 0.3, 0.3]])
    torch.testing.assert_close(q.thumb_and_finger(distance), torch.tensor([0.03, 0.05, 0.0]), **CLOSE)
