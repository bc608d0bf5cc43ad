"""Inverse kinematics, the feasibility filter and its table."""

import functools
import math

import numpy as np
import pytest
import torch

from dora.affordance.candidates import GraspCandidates
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
from dora.affordance.reach.feasibility_table import Grid, ReachTable, table_digest
from dora.errors import InputError
from dora.geometry.rotations import (
    quaternion_apply,
    quaternion_from_matrix,
    quaternion_multiply,
    rotation_angle,
)
from dora.robot import SerialChain, load_robot
from dora.robot.motion import controller_rollout, inverse_kinematics
from dora.robot.motion.collision import CollisionModel
from dora.robot.motion.height_bounds import ArmHeightBounds, HandHeightBounds
from dora.robot.motion.inverse_kinematics import ANGLE_TOLERANCE, POSITION_TOLERANCE, InverseKinematics
from dora.robot.motion.planning import densified
from dora.sim import controllers
from dora.tasks.guidance.grasp_and_lift import GraspSettings
from dora.tasks.mdp.config import TaskConfig

GRASPED = (0.06, 0.006, 0.12)
"""Middle of what a hand holds, in the wrist frame [m]."""


@pytest.fixture(scope="module")
def robot():
    return load_robot("diana7_hit")


@pytest.fixture(scope="module")
def kinematics(robot):
    return InverseKinematics(robot)


def yaws(angles):
    half = torch.as_tensor(angles, dtype=torch.float32) / 2
    return torch.stack([half.cos(), 0 * half, 0 * half, half.sin()], -1)


def grasps(robot, obj, count, seed=0):
    """Wrists all around the part to hold, with a half open hand that moves in between palm and fingers."""
    generator = torch.Generator().manual_seed(seed)
    turn = torch.nn.functional.normalize(torch.randn(count, 4, generator=generator), dim=-1)
    grasped = torch.tensor(GRASPED) + 0.02 * torch.randn(count, 3, generator=generator)
    forward = torch.tensor([math.sqrt(0.5), 0.0, math.sqrt(0.5)])
    hand = torch.tensor(robot.postures["home"].hand, dtype=torch.float32).expand(count, -1)
    held = torch.tensor(obj.centroid(obj.target), dtype=torch.float32)
    return GraspCandidates(
        obj.name, held - quaternion_apply(turn, grasped), turn, quaternion_apply(turn, forward.expand(count, 3)),
        hand, hand + 0.2, ("BodyGrasp",) * count,
    )  # fmt: skip


@functools.cache
def clear_grasps(robot, obj, count):
    """Those that neither hit the table nor the object."""
    reach, every = Reach(robot, obj), grasps(robot, obj, 1200)
    here = reach.filter(every, torch.tensor([[0.45, 0.0, obj.support]]), torch.tensor([obj.rest]), exact=False)
    every = every.select(here.reason[0] != HAND_TABLE)
    return every.select(~reach.hits_object(every)).select(slice(0, count))


def standing(obj, places, angles):
    p = torch.tensor([[x, y, obj.support] for x, y in places])
    return p, quaternion_multiply(yaws(angles), torch.tensor(obj.rest).expand(len(p), 4))


def scattered(obj, count, seed=1, half=0.08):
    generator = torch.Generator().manual_seed(seed)
    xy = torch.tensor([0.45, 0.0]) + half * (2 * torch.rand(count, 2, generator=generator) - 1)
    return standing(obj, xy.tolist(), 2 * math.pi * torch.rand(count, generator=generator))


# ------------------------------------------------------------ inverse kinematics


def reachable_poses(kinematics, count):
    """Wrist poses of random postures above the table."""
    generator = torch.Generator().manual_seed(5)
    share = torch.rand(2 * count, 7, generator=generator)
    q = kinematics.lower + share * (kinematics.upper - kinematics.lower)
    position, rotation = kinematics.chain.tip_pose(q)
    above = (position[:, 2] > 0.05).nonzero()[:count, 0]
    return position[above], quaternion_from_matrix(rotation[above])


def test_solves_random_reachable_poses(robot, kinematics):
    position, quaternion = reachable_poses(kinematics, 1000)
    found = kinematics.solve(position, quaternion, seeds=4)
    assert found.solved.any(1).float().mean() >= 0.97
    best, solved = found.q[:, 0].double(), found.solved[:, 0]
    place, turn = SerialChain.of(robot, dtype=torch.float64).tip_pose(best)
    away = (place - position).norm(dim=1)[solved]
    angle = rotation_angle(quaternion.double(), quaternion_from_matrix(turn))[solved]
    assert away.max() < POSITION_TOLERANCE + 1e-6
    assert angle.max() < ANGLE_TOLERANCE + 1e-5
    assert ((found.q >= kinematics.lower) & (found.q <= kinematics.upper)).all()


def test_more_seeds_solve_more_and_cheaper(kinematics):
    position, quaternion = reachable_poses(kinematics, 400)
    few, many = (kinematics.solve(position, quaternion, seeds=n) for n in (1, 8))
    assert many.solved[:, 0].sum() > few.solved[:, 0].sum()
    assert many.solved[:, 0].float().mean() >= 0.985
    both = many.solved[:, 0] & few.solved[:, 0]
    assert many.cost[both, 0].mean() < few.cost[both, 0].mean() - 0.2


def test_seeds_are_near_their_targets(kinematics):
    found = kinematics.solve(*reachable_poses(kinematics, 200), seeds=4, iterations=0)
    assert found.position_error.median() < 0.2
    assert found.angle_error.median() < 0.6


def test_solutions_are_sorted_and_repeatable(robot, kinematics):
    position, quaternion = reachable_poses(kinematics, 100)
    a, b = (k.solve(position, quaternion) for k in (kinematics, InverseKinematics(robot)))
    assert torch.equal(a.q, b.q)
    solved = a.solved.int()
    assert (solved[:, 1:] <= solved[:, :-1]).all()
    both = a.solved[:, 1:]
    assert (a.cost[:, 1:] >= a.cost[:, :-1])[both].all()


def test_out_of_reach_is_finite_and_not_solved(kinematics):
    position = torch.tensor([[3.0, 0.0, 0.5], [0.0, 0.0, 5.0], [0.0, 0.0, 0.2856], [0.0, 0.0, 0.0]])
    found = kinematics.solve(position, yaws([0.0, 1.0, 2.0, 3.0]))
    assert found.q.isfinite().all()
    assert found.position_error.isfinite().all()
    assert not found.solved[:2].any()
    assert found.position_error[0].min() > 1.5


def test_tracking_keeps_to_a_line(kinematics):
    start = kinematics.start[None]
    position, rotation = kinematics.chain.tip_pose(start)
    line = position[:, None] - torch.linspace(0, 0.1, 6)[:, None] * torch.tensor([0.0, 0.0, 1.0])
    path, tracked = kinematics.follow(start, line, quaternion_from_matrix(rotation)[:, None].expand(-1, 6, 4))
    assert tracked.all()
    places, _ = kinematics.chain.tip_pose(path[0])
    assert (places - line[0]).norm(dim=1).max() < POSITION_TOLERANCE
    assert (path[0, 1:] - path[0, :-1]).abs().max() < 0.3


def test_a_start_posture_of_another_arm_is_refused(robot):
    with pytest.raises(InputError, match="6 joints"):
        InverseKinematics(robot, np.zeros(6))


# --------------------------------------------------------------------- filter


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
    """Every accepted candidate is reached exactly, and free along a finely sampled approach."""
    obj = load_object(name)
    settings = ReachSettings(motion=motion)
    reach, candidates = Reach(robot, obj, settings=settings), clear_grasps(robot, obj, 10)
    p, q = standing(obj, [(0.45, -0.05), (0.5, 0.05), (0.45, 0.0)], [0.0, 2.0, 4.0])
    result = reach.filter(candidates, p, q)
    assert result.reachable.any()
    assert torch.equal(result.reachable, result.reason == OK)
    model = CollisionModel(
        robot, reach.pieces,
        clearance={"arm": -0.001, "table": 0.0, "arm object": 0.0, "hand object": -settings.overlap - 0.001},
    )  # fmt: skip
    for pose, index in result.reachable.nonzero()[:12].tolist():
        goal = p[pose] + quaternion_apply(q[pose], candidates.position[index])
        place, _ = kinematics.chain.tip_pose(result.arm_q[pose, index][None])
        assert (place[0] - goal).norm() < 0.005
        back, _ = kinematics.chain.tip_pose(result.standoff_q[pose, index][None])
        away = goal - quaternion_apply(q[pose], candidates.approach[index]) * settings.standoff
        assert (back[0] - away).norm() < 0.021
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


# ---------------------------------------------------------------------- table


@pytest.fixture(scope="module")
def tabled(robot, tmp_path_factory):
    cube = load_object("cube")
    reach, candidates = Reach(robot, cube), clear_grasps(robot, cube, 8)
    folder = tmp_path_factory.mktemp("tables")
    calls = []
    grid = Grid((0.45, 0.0), (0.05, 0.05), spacing=0.05, yaws=24)
    table = ReachTable.of(
        reach, candidates, grid, cube.support, cube.rest, folder, lambda done, total: calls.append((done, total))
    )
    return cube, reach, candidates, folder, grid, table, calls


def test_the_table_repeats_the_filter_at_its_nodes(tabled):
    cube, reach, candidates, _, grid, table, calls = tabled
    nodes = grid.nodes()[::31]
    p, q = standing(cube, nodes[:, :2].tolist(), nodes[:, 2])
    assert torch.equal(table.mask(p, q), reach.filter(candidates, p, q).reachable)
    assert calls[-1] == (len(grid.nodes()), len(grid.nodes()))


def test_the_table_agrees_with_the_filter_in_between(tabled):
    cube, reach, candidates, _, _, table, _ = tabled
    poses = scattered(cube, 40, half=0.05)
    full, quick = reach.filter(candidates, *poses).reachable, table.mask(*poses)
    both = (full & quick).sum()
    assert both / quick.sum() > 0.85
    assert both / full.sum() > 0.85


def test_the_table_knows_where_it_ends(tabled):
    cube, _, _, _, _, table, _ = tabled
    inside, q = standing(cube, [(0.45, 0.0)], [0.3])
    assert table.mask(inside, q).any()
    assert torch.equal(table.mask(inside, -q), table.mask(inside, q))
    for shift in ((0.2, 0.0, 0.0), (0.0, -0.2, 0.0), (0.0, 0.0, 0.1)):
        assert not table.mask(inside + torch.tensor(shift), q).any()
    tipped = quaternion_multiply(torch.tensor([[math.cos(0.2), math.sin(0.2), 0.0, 0.0]]), q)
    assert not table.mask(inside, tipped).any()


def test_the_table_is_kept_and_guarded(tabled, robot, monkeypatch):
    cube, reach, candidates, folder, grid, table, _ = tabled
    monkeypatch.setattr(Reach, "filter", None)
    again = ReachTable.of(reach, candidates, grid, cube.support, cube.rest, folder)
    assert torch.equal(again.reason, table.reason)
    (path,) = folder.glob("*.safetensors")
    other = table_digest(reach, candidates.select(slice(1, None)), grid, cube.support, cube.rest)
    with pytest.raises(InputError, match="made for other candidates"):
        ReachTable.load(path, other, grid, cube.support, cube.rest)


def test_a_grid_without_places_is_refused():
    with pytest.raises(InputError, match="grid"):
        Grid((0.0, 0.0), (0.1, 0.1), spacing=0.0)


def test_the_filter_has_the_numbers_of_the_tasks():
    """`dora.affordance` may not import the tasks, so some numbers stand in both."""
    ours = controller_rollout.Controller()
    assert ours.period == TaskConfig().dt
    assert (ours.speed, ours.spin) == (controllers.WRIST_SPEED, controllers.WRIST_SPIN)
    assert controller_rollout.LIMIT_MARGIN == controllers.LIMIT_MARGIN
    reference = GraspSettings()
    assert (ours.descent, ours.arrived) == (reference.descent, reference.arrived)
    assert tuple(x / 2 for x in reference.settled) == ours.settled


@pytest.mark.parametrize("change", ["controller", "kinematics"])
def test_a_table_is_made_anew_when_a_number_changes_on_which_motions_depend(robot, monkeypatch, change):
    cube, candidates, grid = load_object("cube"), grasps(robot, load_object("cube"), 4), Grid((0.5, 0.0), (0.0, 0.0))

    def digest(**numbers):
        reach = Reach(robot, cube, settings=ReachSettings(controller=controller_rollout.Controller(**numbers)))
        return table_digest(reach, candidates, grid, cube.support, cube.rest)

    before, numbers = digest(), {}
    if change == "controller":
        numbers = {"speed": 0.5}
    else:
        monkeypatch.setitem(inverse_kinematics.NUMBERS, "largest_step", 0.5)
    assert digest(**numbers) != before
