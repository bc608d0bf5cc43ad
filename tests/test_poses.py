"""Poses form a group: closure, identity, inverse, associativity, and agreement with 4 x 4 matrices."""

import math

import hypothesis.strategies as st
import pytest
import torch
from hypothesis import given, settings

from dora.geometry.poses import Pose, compose, inverse, relative
from dora.geometry.rotations import matrix_from_quaternion, quaternion_from_rotation_vector, rotation_angle

TOLERANCE = 1e-12
"""Allowed error in float64 of positions up to 10 m and of quaternions."""


@st.composite
def poses(draw: st.DrawFn) -> Pose:
    """A batch of two poses within 10 m and with rotation vectors of up to half a turn per axis."""
    numbers = st.lists(st.floats(-1, 1), min_size=12, max_size=12)
    u = torch.tensor(draw(numbers), dtype=torch.float64).reshape(2, 6)
    return 10 * u[:, :3], quaternion_from_rotation_vector(math.pi * u[:, 3:])


IDENTITY: Pose = (torch.zeros(1, 3, dtype=torch.float64), torch.tensor([[1.0, 0.0, 0.0, 0.0]], dtype=torch.float64))


def matrix(pose: Pose) -> torch.Tensor:
    """The (n, 4, 4) matrix of a pose."""
    out = torch.eye(4, dtype=torch.float64).repeat(len(pose[0]), 1, 1)
    out[:, :3, :3], out[:, :3, 3] = matrix_from_quaternion(pose[1]), pose[0]
    return out


def assert_same(a: Pose, b: Pose) -> None:
    """Equal positions, and equal rotations whatever the quaternions' signs."""
    torch.testing.assert_close(a[0], b[0].expand_as(a[0]), atol=100 * TOLERANCE, rtol=0)
    assert rotation_angle(a[1], b[1]).max() < 1e4 * TOLERANCE


@given(poses(), poses())
@settings(max_examples=100, deadline=None)
def test_a_composition_is_a_pose_and_multiplies_matrices(a, b):
    c = compose(a, b)
    torch.testing.assert_close(c[1].norm(dim=-1), torch.ones(2, dtype=torch.float64), atol=TOLERANCE, rtol=0)
    torch.testing.assert_close(matrix(c), matrix(a) @ matrix(b), atol=100 * TOLERANCE, rtol=0)


@given(poses())
@settings(max_examples=50, deadline=None)
def test_the_identity_changes_nothing(a):
    assert_same(compose(a, IDENTITY), a)
    assert_same(compose(IDENTITY, a), a)


@given(poses())
@settings(max_examples=50, deadline=None)
def test_a_pose_and_its_inverse_cancel_on_both_sides(a):
    assert_same(compose(a, inverse(a)), IDENTITY)
    assert_same(compose(inverse(a), a), IDENTITY)
    assert_same(inverse(inverse(a)), a)


@given(poses(), poses(), poses())
@settings(max_examples=100, deadline=None)
def test_composition_is_associative(a, b, c):
    assert_same(compose(compose(a, b), c), compose(a, compose(b, c)))


@given(poses(), poses())
@settings(max_examples=100, deadline=None)
def test_a_relative_pose_leads_back(a, b):
    assert_same(compose(a, relative(a, b)), b)
    assert_same(relative(a, b), compose(inverse(a), b))
    assert_same(relative(a, a), IDENTITY)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_dtype_is_kept_and_batches_broadcast(dtype):
    base = (torch.tensor([[1.0, 2.0, 3.0]], dtype=dtype), torch.tensor([[0.0, 0.0, 0.0, 1.0]], dtype=dtype))
    many = (torch.ones(5, 3, dtype=dtype), torch.tensor([[1.0, 0.0, 0.0, 0.0]], dtype=dtype).expand(5, 4))
    position, quaternion = compose(base, many)
    assert position.dtype == quaternion.dtype == dtype
    # Half a turn about z: (1, 1, 1) becomes (-1, -1, 1).
    torch.testing.assert_close(position, torch.tensor([[0.0, 1.0, 4.0]], dtype=dtype).expand(5, 3))
    torch.testing.assert_close(quaternion, base[1].expand(5, 4))
