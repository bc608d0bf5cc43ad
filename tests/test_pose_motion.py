"""Moving from pose to pose: bounded steps and blends."""

import torch
from torch import Tensor

from dora.geometry.poses import blend, slew
from dora.geometry.rotations import quaternion_from_rotation_vector, rotation_angle


def random_pose(n: int) -> tuple[Tensor, Tensor]:
    return torch.randn(n, 3), quaternion_from_rotation_vector(torch.randn(n, 3))


def test_slewing_is_bounded_and_arrives():
    torch.manual_seed(0)
    (p, q), goal = random_pose(16), random_pose(16)
    here = 0.1 * p + goal[0], q
    for _ in range(400):
        new = slew(here, goal, 0.01, 0.05)
        assert ((new[0] - here[0]).norm(dim=-1) <= 0.0101).all()
        assert (rotation_angle(new[1], here[1]) <= 0.051).all()
        here = new
    torch.testing.assert_close(here[0], goal[0], atol=1e-4, rtol=0)
    assert rotation_angle(here[1], goal[1]).max() < 2e-3


def test_blending_halfway_is_the_middle_for_either_sign():
    a = torch.zeros(1, 3), torch.tensor([[1.0, 0, 0, 0]])
    b = torch.ones(1, 3), -quaternion_from_rotation_vector(torch.tensor([[0.0, 0.0, 0.4]]))
    p, q = blend(a, b, 0.5)
    torch.testing.assert_close(p, torch.full((1, 3), 0.5))
    assert abs(rotation_angle(q, a[1]) - 0.2) < 1e-3
