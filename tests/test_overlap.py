"""Overlap is looked for in every physics step, between everything that an arm or an object may touch."""

from importlib import import_module
from typing import Any

import numpy as np
import pytest
import sapien
import torch
from sapien import physx

import dora.tasks as tasks
from dora.sim.substeps import watch_physics
from dora.tasks.env.env import DoraEnv

coal: Any = import_module("coal")
Z_TO_X = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
"""Turns z, the axis of Coal's capsules, into x, that of PhysX's."""


def solid(shape: Any) -> Any:
    """Coal's geometry of a capsule or box of PhysX."""
    if isinstance(shape, physx.PhysxCollisionShapeCapsule):
        return coal.Capsule(float(shape.radius), 2 * float(shape.half_length))
    return coal.Box(*(2 * float(x) for x in shape.half_size))


def placed(pose: sapien.Pose, shape: Any) -> Any:
    m = (pose * shape.local_pose).to_transformation_matrix().astype(float)
    turn = m[:3, :3] @ Z_TO_X if isinstance(shape, physx.PhysxCollisionShapeCapsule) else m[:3, :3]
    return coal.Transform3s(turn, m[:3, 3])


def depth_by_geometry(task: DoraEnv, row: int) -> float:
    """Largest overlap of the hand with the object, from their shapes and poses alone [m]."""
    target = task.target_object._bodies[row]
    deepest = 0.0
    for link in task.agent.robot.links:
        body = link._bodies[row]
        if np.linalg.norm(body.entity.pose.p - target.entity.pose.p) > 0.25:
            continue
        for shape in body.collision_shapes:
            for other in target.collision_shapes:
                found = coal.distance(
                    solid(shape), placed(body.entity.pose, shape), solid(other), placed(target.entity.pose, other),
                    coal.DistanceRequest(), coal.DistanceResult(),
                )  # fmt: skip
                deepest = max(deepest, -found)
    return deepest


def reported_and_true(persistent: bool) -> tuple[np.ndarray, np.ndarray]:
    """Largest overlap of scripted episodes [mm], as the task reports it and from geometry."""
    n = 12
    config = {"persistent_contacts": persistent}
    task = tasks.make_task("DoraCube-v1", n, config=config)
    task.reset(seed=100)
    true = np.zeros(n)

    def look(row: int) -> None:
        true[row] = max(true[row], 1000 * depth_by_geometry(task, row))

    watch_physics(task.scene, look)
    for _ in range(task.max_steps):
        info = task.step(torch.zeros(n, task.action_size))[-1]
    task.close()
    return info["penetration_max_mm"].numpy(), true


def test_nothing_deeper_than_what_is_reported_happens():
    reported, true = reported_and_true(persistent=False)
    print(f"reported {np.round(reported, 2)} mm, true {np.round(true, 2)} mm")
    assert (true < reported + 0.5).all()
    assert true.max() > 1.0  # the test sees something


@pytest.mark.slow
def test_persistent_contacts_let_fingers_into_the_cube():
    """Why the cube does without them: a finger that slides over an edge sinks in, and no contact is reported."""
    assert reported_and_true(persistent=True)[1].max() > 4.0


@pytest.fixture
def task() -> Any:
    made = tasks.make_task("DoraCube-v1", 2, preset="none")
    made.reset(seed=0)
    yield made
    made.close()


def shifted(pose: sapien.Pose, up: float) -> sapien.Pose:
    return sapien.Pose([pose.p[0], pose.p[1], pose.p[2] + up], pose.q)


def test_an_overlap_that_is_over_before_the_control_step_ends_is_seen(task: DoraEnv):
    """The cube is put into the table for the first physics step only; the solver has pushed it out by the last."""
    body, steps = task.target_object._bodies[0], [0]
    start = body.entity.pose

    def lift_again(row: int) -> None:
        if row == 0:
            steps[0] += 1
            body.entity.set_pose(shifted(start, 0.01))
            body.set_linear_velocity([0.0, 0.0, 0.0])

    body.entity.set_pose(shifted(start, -0.008))
    watch_physics(task.scene, lift_again)
    info = task.step(torch.zeros(2, task.action_size))[-1]
    assert steps[0] == 5
    assert info["penetration_mm"][0] == pytest.approx(8.0, abs=0.5)
    assert info["penetration_mm"][1] < 1
    assert task.task_scene.reader.overlap.deepest_pair(0) is not None
    again = task.step(torch.zeros(2, task.action_size))[-1]
    assert again["penetration_mm"][0] < 1
    assert again["penetration_max_mm"][0] == pytest.approx(8.0, abs=0.5)
    assert task.observed.max_penetration[0] > 0.007


def test_the_arm_and_the_hand_themselves_are_watched(task: DoraEnv):
    """A fist closed by force of will: fingers in the palm, and the elbow in the table."""
    robot = task.agent.robot
    q = robot.get_qpos().clone()
    names = [joint.name for joint in robot.active_joints]
    for finger in ("Index", "Thumb"):
        for k in range(1, 4):
            q[0, names.index(f"Right_{finger}_{k}")] = 1.4
    robot.set_qpos(q)
    info = task.step(None)[-1]
    assert info["penetration_mm"][0] > 1.0
    pair = task.task_scene.reader.overlap.deepest_pair(0)
    assert pair is not None
    assert all(name in {link.name for link in robot.links} for name in pair)
    assert info["penetration_mm"][1] < 1.0


def test_one_environment_reports_the_same_as_a_batch():
    depths = []
    for backend, n in (("physx_cpu", 1), ("physx_cpu_batch", 1)):
        task = tasks.make_task("DoraCube-v1", n, sim_backend=backend, preset="none")
        task.reset(seed=3)
        for _ in range(70):
            info = task.step(task.scripted_action())[-1]
        depths.append(info["penetration_max_mm"].item())
        task.close()
    assert depths[0] > 0
    assert depths[0] == pytest.approx(depths[1], abs=1e-4)
