"""DoraCube-v1: its geometry on invented states, and what its scripted grasp is worth."""

from math import pi, sin

import pytest
import torch
from invented import TIP_RADIUS, invented
from torch import Tensor

import dora.tasks as tasks
from dora.affordance.bundled_sets import load_candidates
from dora.tasks import cube
from dora.tasks.cube import CubeConfig
from dora.tasks.mdp.snapshot import Snapshot, derived

STARTS = 40
"""Random starts of the scripted grasp."""
TERMS = cube.terms(CubeConfig()).terms
"""Terms of the reward with the task's own numbers."""
DEEPEST_MM = 2.0
"""Largest penetration of a clean scripted grasp [mm]."""
STILL = 0.002
"""Speed of a cube that is held still, by finite differences [m/s]."""
SHAKE_STEPS = 48
SHAKE_PERIOD = 8
"""Period of the shake [control steps]."""


def test_surface_distance_is_that_of_a_box():
    tips = torch.zeros(1, 5, 3)
    tips[0, :, 0] = torch.tensor([0.0, 0.02, 0.03, 0.08, 0.03])
    tips[0, 4, 1] = 0.07  # diagonal: 4 cm beside an edge
    expected = torch.tensor([[-0.03, -0.01, 0.0, 0.05, 0.04]]) - TIP_RADIUS
    torch.testing.assert_close(cube.box_distance(invented(1, tip_p=tips)), expected)


@pytest.mark.parametrize(
    ("optimised", "region", "by_hand"),
    [(False, True, True), (True, True, False), (False, False, False), (True, False, False)],
)
def test_the_grasp_that_is_made_by_hand_is_for_affordance_alone(optimised: bool, region: bool, by_hand: bool):
    found = cube.CubeTask(CubeConfig(optimised=optimised)).candidates("", region)
    assert (found.ranking_steps is None) == by_hand
    if not by_hand:
        searched = load_candidates("cube", region=region).position.tolist()
        assert all(position in searched for position in found.position.tolist())


@pytest.mark.parametrize(
    ("touching", "rise", "expected"),
    [((0, 2), 0.11, True), ((0, 4), 0.11, True), ((0, 2), 0.09, False), ((1, 2), 0.11, False), ((0, 5), 0.11, False)],
)
def test_an_object_is_held_between_thumb_and_finger_off_the_table(
    touching: tuple[int, ...], rise: float, expected: bool
):
    """5 is the palm."""
    touch = torch.zeros(1, 6, dtype=torch.bool)
    touch[0, list(touching)] = True
    s = invented(1, touch=touch, object_p=torch.tensor([[0.0, 0.0, rise]]))
    assert cube.CubeTask(CubeConfig()).held(s, "arm").tolist() == [expected]


def test_lifting_pays_until_the_target_height_and_more_with_an_opposed_grasp():
    rise = torch.tensor([0.0, 0.05, 0.10, 0.40])
    p = torch.zeros(4, 3)
    p[:, 2] = rise
    touch = torch.zeros(4, 6, dtype=torch.bool)
    lifting = torch.full((4,), cube.LIFT)
    loose = TERMS["lift"].value(invented(4, object_p=p, stage=lifting))
    touch[:, :2] = True
    firm = TERMS["lift"].value(invented(4, object_p=p, touch=touch, stage=lifting))
    torch.testing.assert_close(firm, torch.tensor([0.0, 0.5, 1.0, 1.0]))
    assert (firm[1:] > loose[1:]).all()


def test_penetration_costs_more_the_deeper_it_is():
    depth = torch.tensor([0.0, 0.0005, 0.002, 0.1])
    cost = TERMS["penetration"].value(invented(4, penetration=depth))
    assert cost[0] == cost[1] == 0
    assert 0 < cost[2] < cost[3] == 1


def test_every_term_stays_in_bounds_on_random_states():
    torch.manual_seed(0)
    n = 256
    s = invented(
        n,
        tip_p=torch.randn(n, 5, 3), object_p=torch.randn(n, 3), wrist_p=torch.randn(n, 3), goal_p=torch.randn(n, 3),
        touch=torch.rand(n, 6) > 0.5, action=3 * torch.randn(n, 26), penetration=torch.rand(n) * 0.05,
        stage=torch.randint(0, 4, (n,)),
    )  # fmt: skip
    for terms in (cube.terms(CubeConfig()), cube.paper_terms(CubeConfig())):
        for name, term in terms.terms.items():
            value = term.value(s)
            assert ((value >= 0) & (value <= 1)).all(), name


def test_derived_quantities_are_computed_once():
    calls = []

    @derived
    def count(s: Snapshot) -> Tensor:
        calls.append(1)
        return s.time

    s = invented(2)
    assert count(s) is count(s)
    assert len(calls) == 1


def test_quantities_are_kept_for_each_configuration():
    near, far = CubeConfig(lift=0.05), CubeConfig(lift=0.2)
    touch = torch.ones(1, 6, dtype=torch.bool)
    s = invented(1, object_p=torch.tensor([[0.0, 0.0, 0.1]]), touch=touch)
    assert bool(cube.held(s, near))
    assert not bool(cube.held(s, far))


@pytest.fixture(scope="module")
def held() -> tasks.DoraEnv:
    """A batch after its scripted episode, with the history of the cube in the last half second."""
    task = tasks.make_task("DoraCube-v1", STARTS, preset="none")
    task.reset(seed=0)
    history = []
    for t in range(task.max_steps):
        task.step(task.scripted_action())
        if t >= task.max_steps - 10:
            history.append(task.snapshot.object.p)
    task.history = torch.stack(history)  # type: ignore[attr-defined]
    return task


def test_the_script_lifts_and_holds_from_random_starts(held: tasks.DoraEnv):
    info = held.evaluate()
    clean = info["success"] & (info["penetration_max_mm"] <= DEEPEST_MM)
    speed = (held.history.diff(dim=0) * held.config.control_frequency).norm(dim=-1).amax(0)  # type: ignore[attr-defined]
    still = speed <= STILL
    print(f"clean {clean.float().mean():.2f}, still {still.float().mean():.2f}, fastest {speed.max() * 1000:.2f} mm/s,")
    print(f"deepest {info['penetration_max_mm'].max():.2f} mm")
    assert (clean & still).float().mean() >= 0.95


def test_the_cube_survives_a_shake(held: tasks.DoraEnv):
    ready = held.evaluate()["success"]
    action = torch.zeros(STARTS, held.action_size)
    lowest = torch.full((STARTS,), torch.inf)
    path = []
    for t in range(SHAKE_STEPS):
        action[:, :3] = sin(2 * pi * t / SHAKE_PERIOD)
        held.step(action)
        lowest = torch.minimum(lowest, held.snapshot.object.p[:, 2] - held.snapshot.object.start_p[:, 2])
        path.append(held.snapshot.hand.wrist_p)
    travel = torch.stack(path).std(0).norm(dim=-1)
    print(f"wrist moved {travel.mean() * 1000:.1f} mm rms; held {(lowest > 0.08).float().mean():.2f}")
    assert travel.min() > 0.003  # it was a shake
    assert (lowest[ready] > 0.08).float().mean() >= 0.95


def test_size_and_place_are_drawn_apart():
    task = tasks.make_task("DoraCube-v1", 48)
    task.reset(seed=list(range(48)))
    drawn = torch.cat([task.scale, task.target_object.pose.p[:, :2], task.memory.object.mass[:, None]], 1)
    correlation = torch.corrcoef(drawn.T)[0, 1:3]
    assert correlation.abs().max() < 0.5
    task.close()
