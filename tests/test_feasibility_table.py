"""The table of the feasibility filter."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from placements import clear_grasps, grasps, scattered, standing

from dora.affordance.objects.affordance_object import Piece
from dora.affordance.objects.catalogue import load_object
from dora.affordance.reach.approach_paths import ReachSettings
from dora.affordance.reach.feasibility import Reach
from dora.affordance.reach.feasibility_table import Grid, ReachTable, table_digest
from dora.errors import InputError
from dora.geometry.rotations import quaternion_multiply
from dora.robot.motion import controller_rollout, inverse_kinematics
from dora.sim import controllers
from dora.tasks.guidance.grasp_and_lift import GraspSettings
from dora.tasks.mdp.config import TaskConfig


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
    assert reference.settled == ours.settled


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


@pytest.mark.parametrize("name", ["cube", "jug"])
def test_a_table_is_made_anew_when_a_collision_shape_changes(robot, name: str):
    """A primitive (cube) and a hull (jug), of the same surface: by a tenth of a millimetre, and not by rounding."""
    obj, grid = load_object(name), Grid((0.45, 0.0), (0.05, 0.05), spacing=0.05, yaws=24)
    candidates = grasps(robot, obj, 4)

    def digest(*pieces: Piece) -> str:
        return table_digest(Reach(robot, replace(obj, pieces=pieces)), candidates, grid, obj.support, obj.rest)

    first, *rest = obj.pieces
    same = digest(first, *rest)
    assert digest(first.moved(np.array([1e-12, 0.0, 0.0])), *rest) == same
    assert digest(first.moved(np.array([1e-4, 0.0, 0.0])), *rest) != same
    assert digest(first, first, *rest) != same
