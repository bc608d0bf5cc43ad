"""Postures of the grasp test, objects as bodies, and the validation of grasps by simulation."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import sapien
import torch
from mani_skill.envs.utils.system.backend import BackendInfo
from sapien import physx

from dora.affordance.candidates import GraspCandidates
from dora.affordance.hand.grasp_test_settings import STANDARD, GraspTestSettings
from dora.affordance.hand.postures import flexion, pregrasp, squeeze
from dora.affordance.objects.catalogue import load_object
from dora.errors import InputError
from dora.parallel import run_cases
from dora.robot import load_robot
from dora.sim import BACKEND
from dora.sim.actors import build_object, object_entity
from dora.sim.batch.scene import BatchScene
from dora.sim.grasp_tests.shake_test import Reason, validate
from dora.sim.grasp_tests.test_scene import GraspTestScene, Physics

ROBOT = load_robot("diana7_hit")
CUBE = load_object("cube")
JUG = load_object("jug")
JOINTS = torch.tensor([
    0.258, 0.034, 0.703, 0.703, -0.060, 0.316, 0.718, 0.718, -0.068, 0.359, 0.739, 0.739,
    0.261, 0.633, 0.026, 0.026, 0.258, 1.096, 0.002, 0.002,
])  # fmt: skip
"""A firm grasp of the cube, found by the optimiser."""


def cube_grasps(shift: torch.Tensor | None = None) -> GraspCandidates:
    """The firm grasp, once per row of `shift` (c, 3) of the wrist [m]."""
    shift = torch.zeros(1, 3) if shift is None else shift
    count = len(shift)
    turn = torch.nn.functional.normalize(torch.tensor([0.4154, 0.5414, 0.4232, -0.5960]), dim=0)
    joints = JOINTS.repeat(count, 1)
    return GraspCandidates(
        object="cube",
        position=torch.tensor([0.0345, 0.1325, 0.0610]) + shift,
        quaternion=turn.repeat(count, 1),
        approach=torch.tensor([0.0, 0.0, -1.0]).repeat(count, 1),
        pregrasp=pregrasp(ROBOT, joints),
        grasp=squeeze(ROBOT, joints),
        grasp_class=("BodyGrasp",) * count,
        joints=joints,
        penetration=torch.full((count,), 0.001),
        self_penetration=torch.zeros(count),
    )


def body_of(entity: sapien.Entity) -> physx.PhysxRigidDynamicComponent:
    found = entity.find_component_by_type(physx.PhysxRigidDynamicComponent)
    assert isinstance(found, physx.PhysxRigidDynamicComponent)
    return found


def test_squeezing_moves_flexing_joints_only_and_keeps_couplings_and_limits():
    joints = torch.rand(50, 20) * torch.tensor(ROBOT.hand.upper - ROBOT.hand.lower) + torch.tensor(ROBOT.hand.lower)
    joints = ROBOT.expand_hand(ROBOT.reduce_hand(joints)).float()
    spread = flexion(ROBOT) == 0
    assert spread.sum() == 5
    for posture, sense in ((pregrasp(ROBOT, joints), -1), (squeeze(ROBOT, joints), 1)):
        torch.testing.assert_close(posture[:, spread], joints[:, spread])
        torch.testing.assert_close(ROBOT.expand_hand(ROBOT.reduce_hand(posture)), posture)
        assert (posture >= torch.tensor(ROBOT.hand.lower) - 1e-6).all()
        assert (posture <= torch.tensor(ROBOT.hand.upper) + 1e-6).all()
        assert (sense * (posture - joints) >= -1e-6).all()
    middle = torch.full((1, 20), 0.25)
    assert float((squeeze(ROBOT, middle) - middle).max()) == pytest.approx(STANDARD.squeeze)
    assert float((middle - pregrasp(ROBOT, middle)).max()) == pytest.approx(STANDARD.opening)


@pytest.mark.parametrize("change", [{"friction": 0.0}, {"duration": -1.0}, {"ramp": 1.5}, {"squeeze": float("nan")}])
def test_a_senseless_setting_is_refused(change: dict[str, float]):
    with pytest.raises(InputError, match=next(iter(change))):
        GraspTestSettings(**change)


def test_a_body_has_mass_inertia_and_materials_of_its_own():
    one, two = (body_of(object_entity(JUG, scale=1.1, friction=0.4, mass=0.5)) for _ in range(2))
    assert one.mass == pytest.approx(0.5)
    assert len(one.collision_shapes) == len(JUG.pieces)
    turn = one.cmass_local_pose.to_transformation_matrix()[:3, :3]
    inertia = turn @ np.diag(one.inertia) @ turn.T
    np.testing.assert_allclose(inertia, JUG.inertia * 0.5 / JUG.mass * 1.1**2, rtol=1e-4, atol=1e-9)
    np.testing.assert_allclose(one.cmass_local_pose.p, 0.0, atol=1e-9)
    materials = [shape.physical_material for body in (one, two) for shape in body.collision_shapes]
    assert len({id(material) for material in materials}) == 2 * len(JUG.pieces)
    assert {round(shape.physical_material.dynamic_friction, 5) for shape in one.collision_shapes} == {0.4}


@pytest.mark.parametrize("name", ["cube", "jug", "hammer", "microwave"])
def test_every_object_rests_on_a_table_as_described(name: str):
    obj = load_object(name)
    scene = GraspTestScene(obj, ROBOT, 0.7, Physics(), gravity=(0.0, 0.0, -9.81), carriage=True, table=True)
    scene.hand.reset(np.zeros(20), sapien.Pose([0.0, 0.0, 1.0]))
    start, turn = np.array([0.0, 0.0, obj.support]), np.array(obj.rest)
    scene.place(start, turn)
    scene.run(100)
    assert np.linalg.norm(scene.position - start) < 2e-3
    assert abs(float(scene.pose.q @ turn)) > 1 - 1e-3


def test_a_body_that_cannot_be_is_refused():
    with pytest.raises(InputError, match="mass"):
        object_entity(CUBE, mass=0.0)


def test_maniskill_builds_an_object_per_environment():
    sub_scenes = [sapien.Scene([physx.PhysxCpuSystem()]) for _ in range(2)]
    cpu = torch.device("cpu")
    backend = BackendInfo(cpu, sapien.Device("cpu"), BACKEND, None, "none")
    scene = BatchScene(sub_scenes, device=cpu, backend=backend)
    shared = build_object(scene, JUG, friction=0.3)
    sized = build_object(scene, CUBE, "box", sapien.Pose([1.0, 0.0, 0.5]), scale=[1.0, 1.5])
    boxes: list[Any] = [body_of(entity).collision_shapes[0] for entity in sized._objs]
    np.testing.assert_allclose([box.half_size[0] for box in boxes], [0.03, 0.045], rtol=1e-5)
    assert [len(body_of(entity).collision_shapes) for entity in shared._objs] == [len(JUG.pieces)] * 2
    assert shared._objs[0].pose.p[2] == pytest.approx(JUG.support)
    assert "jug" in scene.state_dict_registry.actors
    assert list(scene.state_dict_registry.actors) == ["jug", "box"]
    with pytest.raises(InputError, match="scales"):
        build_object(scene, CUBE, "wrong", scale=[1.0, 1.0, 1.0])


def test_the_hand_is_where_its_description_says():
    scene = GraspTestScene(CUBE, ROBOT, 0.7, Physics(), carriage=True)
    scene.hand.reset(JOINTS.numpy(), sapien.Pose([1.0, 0.0, 0.0]), np.array([0.1, 0.2, 0.3]))
    palm = next(link for link in scene.hand.articulation.links if link.name == ROBOT.wrist_link)
    np.testing.assert_allclose(palm.entity_pose.p, [1.1, 0.2, 0.3], atol=1e-5)
    np.testing.assert_allclose(np.abs(palm.entity_pose.q), [1.0, 0.0, 0.0, 0.0], atol=1e-5)
    assert scene.hand.lag < 1e-5


def test_good_and_bad_grasps_end_as_they_must():
    shift = torch.tensor([[0.0, 0.0, 0.0], [0.0, 0.0, 0.3], [0.0, 0.0, 0.0]])
    candidates = cube_grasps(shift)
    grasp = candidates.grasp.clone()
    grasp[2] = candidates.pregrasp[2]  # never closes
    found = validate(replace(candidates, grasp=grasp), CUBE, ROBOT, processes=1)
    assert found.passed.tolist() == [True, False, False]
    assert Reason(int(found.reason[1])) is Reason.SLIPPED
    assert float(found.displacement[0]) < 2e-3 < 0.02 < float(found.displacement[1])
    assert float(found.closing_shift[0]) < 0.01
    assert 0 < float(found.penetration[0]) < 1e-3
    assert found.touched[0].sum() >= 4
    assert found.dominant_region.tolist()[:2] == [0, -1]
    torch.testing.assert_close(found.label_force.sum(1), found.part_force.sum(1))
    pressing = found.contact_finger > 0
    assert [set(row[row > 0].tolist()) for row in found.contact_finger] == [
        {part + 1 for part, touches in enumerate(row) if touches} for row in found.touched.tolist()
    ]
    beyond = found.contacts[pressing].abs().amax(1) - 0.03
    assert float(beyond.abs().max()) < 2e-3  # on the cube's surface, in its frame, wherever closing moved it
    assert not found.contacts[~pressing].any()


def test_gravity_of_a_heavier_world_is_too_much():
    found = validate(cube_grasps(), CUBE, ROBOT, replace(STANDARD, gravity=1000.0), processes=1)
    assert not found.passed.any()


def test_penetration_and_tidiness_decide_validity():
    candidates = cube_grasps(torch.zeros(3, 3))
    candidates = replace(
        candidates,
        penetration=torch.tensor([0.001, 0.003, 0.001]),
        self_penetration=torch.tensor([0.0, 0.0, 0.004]),
    )
    found = validate(candidates, CUBE, ROBOT, replace(STANDARD, duration=0.1), processes=1)
    assert found.passed.tolist() == [True, True, True]
    assert found.valid.tolist() == [True, False, True]
    assert found.strict.tolist() == [True, False, False]


def test_order_and_number_of_processes_do_not_matter():
    shift = torch.linspace(0.0, 0.03, 6)[:, None] * torch.tensor([0.0, 0.0, 1.0])
    test_settings, seen = replace(STANDARD, duration=0.1), []
    one = validate(cube_grasps(shift), CUBE, ROBOT, test_settings, processes=1)
    two = validate(
        cube_grasps(shift.flip(0)), CUBE, ROBOT, test_settings, processes=2, progress=lambda done, _: seen.append(done)
    )
    assert one.passed.tolist() == two.passed.flip(0).tolist()
    torch.testing.assert_close(one.closing_shift, two.closing_shift.flip(0), atol=1e-3, rtol=0.0)
    assert seen[-1] == 6


def test_candidates_of_another_object_are_refused():
    with pytest.raises(InputError, match="the set holds grasps of 'cube', not of 'jug': give those of that one"):
        validate(cube_grasps(), JUG, ROBOT)


def test_candidates_of_an_object_that_has_changed_are_refused():
    changed = replace(cube_grasps(), digest="0" * 64)
    with pytest.raises(InputError, match="made for another shape or labelling of 'cube': make it again"):
        validate(changed, CUBE, ROBOT)


def _failing(_: int) -> int:
    raise InputError("this case cannot be done.")


def make_failing() -> Callable[[int], int]:
    """A task that fails."""
    return _failing


def test_an_error_in_a_process_reaches_the_caller():
    with pytest.raises(InputError, match="cannot be done"):
        run_cases(make_failing, (), list(range(9)), processes=2)


def test_the_scene_settings_of_others_stay():
    before = physx.get_scene_config().gravity.copy()
    GraspTestScene(CUBE, ROBOT, 0.7, Physics(), gravity=(1.0, 2.0, 3.0))
    np.testing.assert_array_equal(physx.get_scene_config().gravity, before)
