"""Arm kinematics against the DH table, two other libraries and finite differences; damped steps."""

# Pinocchio and Coal are compiled modules without type stubs.
# pyright: reportAttributeAccessIssue=false

import logging
import math
from pathlib import Path

import numpy as np
import pinocchio
import pytest
import pytorch_kinematics
import sapien
import torch

from dora.errors import InputError
from dora.geometry import rotations as rot
from dora.robot import RobotDescription, SerialChain

CONFIGURATIONS = 24
POSITION_TOLERANCE = 1e-5
"""Largest accepted distance between two libraries' frames (m, and unitless for matrix entries)."""

DIANA_DH = (
    (math.pi, 0.0, -0.2856, 0.0),
    (math.pi / 2, 0.0, 0.0, 0.0),
    (-math.pi / 2, 0.0, -0.4586, 0.0),
    (math.pi / 2, 0.065, 0.0, 0.0),
    (-math.pi / 2, -0.0528, -0.4554, 0.0),
    (-math.pi / 2, -0.0122, 0.0, math.pi),
    (-math.pi / 2, 0.087, -0.1169, 0.0),
)
"""Modified DH rows of the arm: alpha (rad), a (m), d (m), offset of theta (rad)."""


@pytest.fixture(scope="module")
def chain(robot) -> SerialChain:
    return SerialChain.of(robot, dtype=torch.float64)


def random_arm(chain: SerialChain, count: int = CONFIGURATIONS, seed: int = 0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    share = torch.rand(count, len(chain.names), generator=generator, dtype=torch.float64)
    return (chain.lower + (chain.upper - chain.lower) * share).to(chain.lower.dtype)


def home(robot: RobotDescription) -> torch.Tensor:
    return torch.tensor(robot.postures["home"].arm.copy())[None]


def dh_pose(q: np.ndarray) -> np.ndarray:
    """Product of RotX(alpha) TransX(a) RotZ(offset + q) TransZ(d) over the rows."""
    pose = np.eye(4)
    for (alpha, a, d, offset), angle in zip(DIANA_DH, q, strict=True):
        ca, sa, ct, s = math.cos(alpha), math.sin(alpha), math.cos(offset + angle), math.sin(offset + angle)
        along_x = np.array([[1, 0, 0, a], [0, ca, -sa, 0], [0, sa, ca, 0], [0, 0, 0, 1]])
        pose = pose @ along_x @ np.array([[ct, -s, 0, 0], [s, ct, 0, 0], [0, 0, 1, d], [0, 0, 0, 1]])
    return pose


def error_twist(target: torch.Tensor, pose: torch.Tensor) -> torch.Tensor:
    """Displacement (n, 6) from `pose` to `target`, both (n, 4, 4)."""
    turn = rot.quaternion_from_matrix(target[:, :3, :3] @ pose[:, :3, :3].transpose(1, 2))
    return torch.cat((target[:, :3, 3] - pose[:, :3, 3], rot.rotation_vector_from_quaternion(turn)), 1)


def test_arm_agrees_with_the_dh_table(chain):
    q = random_arm(chain)
    flange = chain.forward(q).joints[:, -1].numpy()
    np.testing.assert_allclose(flange, np.stack([dh_pose(row) for row in q.numpy()]), atol=POSITION_TOLERANCE)


def test_all_links_agree_between_three_libraries_and_ours(robot, chain, tmp_path):
    logging.disable(logging.WARNING)
    other = pytorch_kinematics.build_chain_from_urdf(robot.urdf.read_bytes()).to(dtype=torch.float64)
    logging.disable(logging.NOTSET)
    model = pinocchio.buildModelFromUrdf(str(robot.urdf))
    data = model.createData()
    _scene, articulation = sapien_articulation(robot, tmp_path)
    names = robot.arm.names + robot.hand.names
    lower, upper = (np.r_[getattr(robot.arm, k), getattr(robot.hand, k)] for k in ("lower", "upper"))
    rng = np.random.default_rng(1)
    for _ in range(CONFIGURATIONS):
        angles = dict(zip(names, rng.uniform(lower, upper), strict=True))
        order = other.get_joint_parameter_names()
        poses = other.forward_kinematics(torch.tensor([[angles[name] for name in order]], dtype=torch.float64))
        pinocchio.framesForwardKinematics(model, data, np.array([angles[str(name)] for name in list(model.names)[1:]]))
        articulation.set_qpos(np.array([angles[joint.name] for joint in articulation.active_joints]))
        for link in articulation.links:
            pose = poses[link.name].get_matrix()[0].numpy()
            simulated = link.entity_pose.to_transformation_matrix()
            np.testing.assert_allclose(simulated, pose, atol=POSITION_TOLERANCE, err_msg=link.name)
            frame = data.oMf[model.getFrameId(link.name, pinocchio.BODY)].homogeneous
            np.testing.assert_allclose(frame, pose, atol=POSITION_TOLERANCE, err_msg=link.name)
        ours = chain.forward(torch.tensor([[angles[name] for name in chain.names]], dtype=torch.float64))
        wrist = data.oMf[model.getFrameId(robot.wrist_link, pinocchio.BODY)].homogeneous
        np.testing.assert_allclose(ours.tip[0], wrist, atol=1e-9)


def sapien_articulation(robot: RobotDescription, folder: Path):
    """Scene (to be kept alive) and robot without its visual meshes, so that no driver is needed."""
    bare = folder / "bare.urdf"
    bare.write_text("\n".join(row for row in robot.urdf.read_text().splitlines() if "<visual>" not in row))
    scene = sapien.Scene([sapien.physx.PhysxCpuSystem()])
    loader = scene.create_urdf_loader()
    loader.fix_root_link = True
    return scene, loader.load(str(bare))


def test_jacobian_is_the_derivative_of_the_pose(chain):
    q, step = random_arm(chain, 8), 1e-6
    analytic = chain.jacobian(q)
    for joint in range(q.shape[1]):
        change = torch.zeros_like(q)
        change[:, joint] = step
        numeric = error_twist(chain.forward(q + change).tip, chain.forward(q - change).tip) / (2 * step)
        np.testing.assert_allclose(analytic[:, :, joint], numeric, atol=1e-7)


def test_linear_jacobian_agrees_with_autograd(chain):
    q = random_arm(chain, 1)
    auto = torch.autograd.functional.jacobian(lambda x: chain.tip_pose(x[None])[0][0], q[0])
    np.testing.assert_allclose(chain.jacobian(q)[0, :3], auto, atol=1e-12)


def test_damped_steps_reach_targets_near_home(robot, chain):
    start = home(robot).repeat(CONFIGURATIONS, 1)
    noise = 0.2 * torch.randn(start.shape, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    target = chain.forward((start + noise).clamp(chain.lower, chain.upper)).tip
    q = start
    for _ in range(60):
        q = q + chain.damped_step(q, error_twist(target, chain.forward(q).tip), rest=start[:1], rest_gain=0.01)
    error = error_twist(target, chain.forward(q).tip).norm(dim=1)
    assert error.max() < 1e-3
    assert ((q >= chain.lower) & (q <= chain.upper)).all()


def test_null_space_pull_moves_towards_rest_without_moving_the_wrist(robot, chain):
    start = home(robot)
    rest = start + torch.tensor([[0.3, -0.2, -0.3, 0.0, 0.2, 0.0, 0.1]], dtype=torch.float64)
    step = chain.damped_step(start, torch.zeros(1, 6, dtype=torch.float64), rest=rest, rest_gain=0.05)
    moved = error_twist(chain.forward(start + step).tip, chain.forward(start).tip).norm()
    assert step.norm() > 1e-3
    assert moved < 0.2 * step.norm()
    assert (start + step - rest).norm() < (start - rest).norm()


def test_velocity_limits_scale_the_whole_step(robot, chain):
    q, duration = home(robot), 0.05
    twist = torch.tensor([[0.5, 0.3, -0.2, 1.0, 0.5, 0.2]], dtype=torch.float64)
    free, limited = chain.damped_step(q, twist), chain.damped_step(q, twist, duration=duration)
    share = limited.abs() / (chain.velocity * duration)
    assert share.max() == pytest.approx(1.0)
    assert torch.nn.functional.cosine_similarity(free, limited) == pytest.approx(1.0)
    small = 1e-4 * twist
    np.testing.assert_allclose(chain.damped_step(q, small, duration=duration), chain.damped_step(q, small))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_steps_and_gradients_are_finite_at_singular_and_unreachable_poses(robot, dtype):
    chain = SerialChain.of(robot, dtype=dtype)
    q = torch.cat((torch.zeros(1, 7, dtype=dtype), chain.lower[None], chain.upper[None], random_arm(chain, 64)))
    q = q.detach().requires_grad_()
    for size in (0.0, 1e-3, 10.0):
        twist = size * torch.ones(len(q), 6, dtype=dtype)
        step = chain.damped_step(q, twist, duration=0.05)
        (gradient,) = torch.autograd.grad(step.square().sum(), q)
        assert step.isfinite().all()
        assert gradient.isfinite().all()
        assert ((q + step >= chain.lower) & (q + step <= chain.upper)).all()


def test_a_chain_without_moving_joints_is_refused(robot):
    with pytest.raises(InputError, match="revolute"):
        SerialChain.of(robot, tip=robot.model.root)
