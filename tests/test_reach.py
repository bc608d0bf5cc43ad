"""The feasibility filter."""

import math

import numpy as np
import pytest
import torch
from placements import clear_grasps, grasps, scattered, standing, yaws

from dora.affordance.objects.catalogue import load_object
from dora.affordance.reach.approach_paths import (
    HAND_OBJECT,
    HAND_TABLE,
    NO_MOTION,
    OK,
    OUT_OF_REACH,
    REASONS,
    ReachSettings,
)
from dora.affordance.reach.feasibility import Reach
from dora.errors import InputError
from dora.geometry.rotations import quaternion_apply, quaternion_multiply
from dora.robot.motion.collision import CollisionModel
from dora.robot.motion.height_bounds import ArmHeightBounds, HandHeightBounds
from dora.robot.motion.inverse_kinematics import POSITION_TOLERANCE
from dora.robot.motion.planning import densified

ROUNDING = 1e-5
"""What float32 adds to an error of a pose [m]."""


def test_heights_are_where_coal_touches_the_table(robot, kinematics):
    """Lowest points of hand and arm by formula against Coal's plane, for random postures."""
    generator, up = np.random.default_rng(2), torch.tensor([0.0, 0.0, 1.0])
    extents = HandHeightBounds(robot), ArmHeightBounds(robot, kinematics.chain)
    for _ in range(12):
        arm = 0.5 * (generator.uniform(robot.arm.lower, robot.arm.upper) + robot.postures["home"].arm)
        hand = generator.uniform(robot.hand.lower, robot.hand.upper)
        q = torch.tensor(arm[None], dtype=torch.float32)
        pose = kinematics.chain.forward(q).tip[0]
        spheres = extents[0].spheres(torch.tensor(hand[None], dtype=torch.float32))[0] @ pose[:3, :3].T + pose[:3, 3]
        lowest = min(float((spheres[:, 2] - extents[0].radii).min()), float(extents[1].height(q, up, 0.0)))
        for shift, hit in ((1e-3, True), (-1e-3, False)):
            model = CollisionModel(robot, table=(0.0, 0.0, 1.0, lowest + shift), clearance={"table": 0.0})
            assert (model.touching(arm, hand) is not None) == hit


def test_a_grasp_below_the_table_is_rejected_for_that_reason(robot):
    cube = load_object("cube")
    reach, candidates = Reach(robot, cube), clear_grasps(robot, cube, 12)
    p, q = scattered(cube, 3)
    assert not (reach.filter(candidates, p, q).reason == HAND_TABLE).any()
    sunk = p - torch.tensor([0.0, 0.0, 0.3])
    assert (reach.filter(candidates, sunk, q).reason == HAND_TABLE).all()


def test_a_hand_through_the_object_is_rejected_for_that_reason(robot):
    cube = load_object("cube")
    reach, good = Reach(robot, cube), clear_grasps(robot, cube, 12)
    palm = quaternion_apply(good.quaternion, torch.tensor([1.0, 0.0, 0.0]).expand(len(good), 3))
    deeper = good.with_tensors(good.tensors() | {"position": good.position + 0.06 * palm}, good.grasp_class)
    p, q = scattered(cube, 2)
    assert not (reach.filter(good, p, q).reason == HAND_OBJECT).any()
    lifted = p + torch.tensor([0.0, 0.0, 0.2])
    assert (reach.filter(deeper, lifted, q).reason == HAND_OBJECT).float().mean() > 0.6


def test_nothing_is_left_far_away(robot):
    cube = load_object("cube")
    result = Reach(robot, cube).filter(
        clear_grasps(robot, cube, 12), *standing(cube, [(2.0, 0.0), (0.45, 0.0)], [0, 0])
    )
    assert result.empty.tolist() == [True, False]
    assert (result.reason[0] == OUT_OF_REACH).all()
    assert sum(result.counts().values()) == result.reason.numel()
    assert tuple(result.counts()) == REASONS


@pytest.mark.parametrize(
    ("name", "motion"), [("jug", "none"), ("jug", "controller"), ("hammer", "controller"), ("hammer", "plan")]
)
def test_what_passes_stands_up_to_brute_force(robot, kinematics, name, motion):
    """Every accepted candidate is reached, and free of collisions at the standoff and at the grasp."""
    obj = load_object(name)
    settings = ReachSettings(motion=motion)
    reach, candidates = Reach(robot, obj, settings=settings), clear_grasps(robot, obj, 10)
    p, q = standing(obj, [(0.45, -0.05), (0.5, 0.05), (0.45, 0.0)], [0.0, 2.0, 4.0])
    result = reach.filter(candidates, p, q)
    assert result.reachable.any()
    assert torch.equal(result.reachable, result.reason == OK)
    # Inverse kinematics is exact; a motion of the controller goes on as soon as it is near enough.
    controller = settings.controller
    exact = (POSITION_TOLERANCE, POSITION_TOLERANCE)
    reached, arrived = (controller.settled[0], controller.arrived[0]) if motion == "controller" else exact
    model = CollisionModel(
        robot, reach.pieces,
        clearance={"arm": -0.001, "table": 0.0, "arm object": 0.0, "hand object": -settings.overlap - 0.001},
    )  # fmt: skip
    for pose, index in result.reachable.nonzero()[:12].tolist():
        goal = p[pose] + quaternion_apply(q[pose], candidates.position[index])
        place, _ = kinematics.chain.tip_pose(result.arm_q[pose, index][None])
        assert (place[0] - goal).norm() < reached + ROUNDING
        back, _ = kinematics.chain.tip_pose(result.standoff_q[pose, index][None])
        away = goal - quaternion_apply(q[pose], candidates.approach[index]) * settings.standoff
        assert (back[0] - away).norm() < arrived + ROUNDING
        model.place_object(p[pose].double().numpy(), q[pose].double().numpy())
        ends = torch.stack([result.standoff_q[pose, index], result.arm_q[pose, index]]).double().numpy()
        hand = candidates.pregrasp[index].double().numpy()
        assert model.free(ends, hand)


def test_out_of_reach_is_seldom_wrong(robot):
    """What the filter calls out of reach has no solution from many more seeds either, but for a few."""
    cube = load_object("cube")
    reach, candidates = Reach(robot, cube, settings=ReachSettings(motion="none")), grasps(robot, cube, 100)
    p, q = standing(cube, [(0.75, 0.2), (0.8, 0.0), (0.85, -0.2), (0.2, 0.15)], [0.0, 1.0, 2.0, 3.0])
    p = p + torch.tensor([0.0, 0.0, 0.3])
    result = reach.filter(candidates, p, q, exact=False)
    poses, rows = (result.reason == OUT_OF_REACH).nonzero().unbind(1)
    assert len(poses) >= 20
    goal = p[poses] + quaternion_apply(q[poses], candidates.position[rows])
    turn = quaternion_multiply(q[poses], candidates.quaternion[rows])
    assert reach.kinematics.solve(goal, turn, seeds=24).solved[:, 0].float().mean() < 0.1


def test_yaw_of_the_jug_decides_which_candidates_are_left(robot):
    jug = load_object("jug")
    reach, candidates = Reach(robot, jug, settings=ReachSettings(motion="none")), clear_grasps(robot, jug, 12)
    angles = torch.arange(0, 2 * math.pi, math.pi / 2)
    result = reach.filter(candidates, *standing(jug, [(0.5, 0.0)] * len(angles), angles))
    share = result.reachable.float().mean(1)
    assert share.max() > share.min()
    assert result.reachable.any(0).float().mean() > 0.5


def test_the_base_may_stand_anywhere(robot):
    """Moving base, table and object together changes nothing."""
    cube = load_object("cube")
    candidates, settings = clear_grasps(robot, cube, 12), ReachSettings(motion="none")
    p, q = scattered(cube, 3)
    here = Reach(robot, cube, settings=settings).filter(candidates, p, q)
    shift, turn = torch.tensor([0.3, -0.8, 0.25]), yaws([1.1])
    base = (tuple(shift.tolist()), tuple(turn[0].tolist()))
    there = Reach(robot, cube, base, ReachSettings(motion="none", table_height=0.25)).filter(
        candidates, shift + quaternion_apply(turn.expand(3, 4), p), quaternion_multiply(turn.expand(3, 4), q)
    )
    assert (here.reason == there.reason).float().mean() > 0.95
    assert here.reachable.any()


def test_exactness_only_removes(robot):
    jug = load_object("jug")
    reach, candidates = Reach(robot, jug), grasps(robot, jug, 100)
    poses = scattered(jug, 2)
    quick, exact = (reach.filter(candidates, *poses, exact=e).reachable for e in (False, True))
    assert (exact <= quick).all()
    assert exact.sum() < quick.sum()


def test_a_plan_leads_where_the_wrist_controller_does_not(robot):
    cube = load_object("cube")
    candidates, poses = clear_grasps(robot, cube, 12), scattered(cube, 3)
    driven, planned = (
        Reach(robot, cube, settings=ReachSettings(motion=m)).filter(candidates, *poses) for m in ("controller", "plan")
    )
    stuck = driven.reason == NO_MOTION
    assert stuck.any()
    assert planned.reachable[stuck].any()


def test_plan_of_the_filter(robot):
    jug = load_object("jug")
    reach, candidates = Reach(robot, jug, settings=ReachSettings(motion="none")), clear_grasps(robot, jug, 12)
    p, q = scattered(jug, 4)
    result = reach.filter(candidates, p, q)
    pose, index = result.reachable.nonzero()[0].tolist()
    goal = result.standoff_q[pose, index].double().numpy()
    hand = candidates.pregrasp[index].double().numpy()
    path = reach.plan(robot.postures["home"].arm, goal, hand, p[pose], q[pose])
    assert path is not None
    model = CollisionModel(robot, reach.pieces)
    model.place_object(p[pose].double().numpy(), q[pose].double().numpy())
    assert model.free(densified(path, 0.005), hand)


def test_motions_start_from_the_posture_asked_for(robot):
    cube = load_object("cube")
    reach = Reach(robot, cube, start="zero")
    assert torch.equal(reach.kinematics.start, torch.zeros(7))
    candidates, poses = clear_grasps(robot, cube, 12), scattered(cube, 2)
    zero, home = (r.filter(candidates, *poses).reason for r in (reach, Reach(robot, cube)))
    assert not torch.equal(zero, home)
    with pytest.raises(InputError, match="posture"):
        Reach(robot, cube, start="asleep")
