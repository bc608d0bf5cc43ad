"""Rotations agree with scipy everywhere, near the identity and near half a turn too."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from dora.geometry import rotations as rot

EXACT = 1e-9
"""Largest accepted difference in double precision (rad or unitless)."""

angles = st.one_of(
    st.floats(0.0, np.pi),
    st.sampled_from([0.0, 1e-12, 1e-8, 1e-5, 0.99e-4, 1.01e-4, np.pi - 1e-4, np.pi - 1e-8, np.pi]),
)
directions = st.tuples(*[st.floats(-1.0, 1.0)] * 3).filter(lambda v: np.linalg.norm(v) > 1e-2)


@st.composite
def rotation_vectors(draw):
    direction = np.array(draw(directions))
    return draw(angles) * direction / np.linalg.norm(direction)


def tensor(array) -> torch.Tensor:
    return torch.as_tensor(np.array(array), dtype=torch.float64)


def scipy_quaternion(rotation: Rotation) -> np.ndarray:
    return rotation.as_quat(scalar_first=True)


def same_rotation(q: torch.Tensor, rotation: Rotation) -> bool:
    return abs(abs(float(q.numpy() @ scipy_quaternion(rotation))) - 1) < EXACT


@given(rotation_vectors())
@settings(max_examples=200, deadline=None)
def test_exponential_and_logarithm_agree_with_scipy(v):
    reference = Rotation.from_rotvec(v)
    q, matrix = rot.quaternion_from_rotation_vector(tensor(v)), rot.matrix_from_rotation_vector(tensor(v))
    assert same_rotation(q, reference)
    np.testing.assert_allclose(matrix, reference.as_matrix(), atol=EXACT)
    assert same_rotation(rot.quaternion_from_matrix(matrix), reference)
    for back in (rot.rotation_vector_from_quaternion(x) for x in (-q, rot.quaternion_from_matrix(matrix))):
        assert float(back.norm()) <= np.pi + EXACT
        np.testing.assert_allclose(Rotation.from_rotvec(back.numpy()).as_matrix(), matrix, atol=1e-7)


@given(rotation_vectors())
@settings(max_examples=200, deadline=None)
def test_small_angles_survive_single_precision(v):
    back = rot.rotation_vector_from_quaternion(rot.quaternion_from_rotation_vector(tensor(v * 1e-3).to(torch.float32)))
    np.testing.assert_allclose(back, v * 1e-3, rtol=2e-6, atol=1e-12)


@given(rotation_vectors(), rotation_vectors(), directions)
@settings(max_examples=100, deadline=None)
def test_products_agree_with_scipy(a, b, point):
    ra, rb = Rotation.from_rotvec(a), Rotation.from_rotvec(b)
    qa, qb = tensor(scipy_quaternion(ra)), tensor(scipy_quaternion(rb))
    assert same_rotation(rot.quaternion_multiply(qa, qb), ra * rb)
    assert same_rotation(rot.quaternion_inverse(qa), ra.inv())
    np.testing.assert_allclose(rot.quaternion_apply(qa, tensor(point)), ra.apply(point), atol=EXACT)
    assert float(rot.rotation_angle(qa, qb)) == pytest.approx((ra.inv() * rb).magnitude(), abs=1e-7)


@given(*[st.floats(-np.pi, np.pi)] * 3)
@settings(max_examples=100, deadline=None)
def test_rpy_is_that_of_urdf(roll, pitch, yaw):
    assert same_rotation(
        tensor(rot.quaternion_from_rpy(roll, pitch, yaw)), Rotation.from_euler("xyz", [roll, pitch, yaw])
    )


@given(directions)
def test_rpy_from_z_axis_points_along_the_direction(direction):
    rotation = Rotation.from_euler("xyz", rot.rpy_from_z_axis(direction))
    np.testing.assert_allclose(rotation.apply([0, 0, 1]), direction / np.linalg.norm(direction), atol=EXACT)


@pytest.mark.parametrize("yaw", [0.0, 1e-8, 1.2, -2.0, np.pi - 1e-6, 3.5, 2 * np.pi - 0.1, -7.0])
def test_a_yaw_is_a_turn_about_the_vertical(yaw: float):
    q = rot.quaternion_from_yaw(tensor(yaw))
    assert same_rotation(q, Rotation.from_euler("z", yaw))
    wrapped = (yaw + np.pi) % (2 * np.pi) - np.pi
    np.testing.assert_allclose([rot.yaw_of(q), rot.yaw_of(-q)], wrapped, atol=EXACT)


@pytest.mark.parametrize("tilt", [0.0, 0.3, 2.0])
def test_a_tilt_does_not_change_the_yaw(tilt: float):
    yaw = tensor([[0.4, -2.9, 1.0]])
    turn = rot.quaternion_from_yaw(yaw)
    lean = rot.quaternion_from_rotation_vector(tensor([tilt * np.cos(2.0), tilt * np.sin(2.0), 0.0])).expand(1, 3, 4)
    for q in (rot.quaternion_multiply(turn, lean), rot.quaternion_multiply(lean, turn)):
        np.testing.assert_allclose(rot.yaw_of(q), yaw, atol=EXACT)


def test_batches_broadcast():
    q = rot.quaternion_from_rotation_vector(torch.randn(5, 1, 3))
    assert rot.quaternion_multiply(q, q[:1, 0]).shape == (5, 1, 4)
    assert rot.quaternion_apply(q, torch.randn(1, 7, 3)).shape == (5, 7, 3)
    assert rot.quaternion_from_matrix(rot.matrix_from_quaternion(q)).shape == (5, 1, 4)


@pytest.mark.parametrize("angle", [0.0, 1e-6, 1.0, np.pi])
def test_gradients_are_finite_everywhere(angle):
    v = tensor([angle, 0.0, 0.0]).requires_grad_()
    q = rot.quaternion_from_rotation_vector(v)
    outputs = (
        q,
        rot.rotation_vector_from_quaternion(q),
        rot.rotation_vector_from_quaternion(rot.quaternion_from_matrix(rot.matrix_from_quaternion(q))),
    )
    for output in (*outputs, rot.rotation_angle(q, q), rot.yaw_of(q), rot.quaternion_from_yaw(v)):
        (gradient,) = torch.autograd.grad(output.sum(), v, retain_graph=True)
        assert gradient.isfinite().all()


def test_logarithm_has_the_right_gradient_near_the_identity():
    v = torch.tensor([[3e-5, -2e-5, 1e-5], [0.4, 0.2, -1.0]], dtype=torch.float64, requires_grad=True)
    round_trip = rot.rotation_vector_from_quaternion(rot.quaternion_from_rotation_vector(v))
    jacobian = torch.autograd.functional.jacobian(
        lambda x: rot.rotation_vector_from_quaternion(rot.quaternion_from_rotation_vector(x)), v[0]
    )
    np.testing.assert_allclose(jacobian, np.eye(3), atol=1e-8)
    np.testing.assert_allclose(round_trip.detach(), v.detach(), atol=1e-12)
