"""Re-orientation of the hammer in the hand: the turned release, the turned grasps, stage and reward."""

from typing import Any

import numpy as np
import pytest
import torch
from test_stage_clauses import hammer_state, is_done

import dora.tasks as tasks
from dora.affordance.bundled_sets import bundled_path
from dora.affordance.candidates import GraspCandidates
from dora.agents.config import RunConfig, _digested
from dora.configs import plain
from dora.errors import InputError
from dora.geometry.poses import compose
from dora.geometry.rotations import quaternion_apply, quaternion_from_rotation_vector, quaternion_multiply
from dora.tasks.hammer import mdp
from dora.tasks.hammer.reference import CatchSettings, phases
from dora.tasks.hammer.task import HammerConfig, HammerTask, handle_place
from dora.tasks.hammer.turning import (
    COPIES,
    TurnSettings,
    number_of_roll,
    roll_at_release,
    turn_about_handle,
    turned_copies,
)

CONFIG = HammerConfig(reorient="in_hand")
TURN = CONFIG.turn


def about_z(angle: float) -> torch.Tensor:
    return quaternion_from_rotation_vector(torch.tensor([[0.0, 0.0, angle]]))


# ---------------------------------------------------------------------- the turn


@pytest.mark.parametrize("angle", [-3.0, -0.7, 0.0, 0.7, 3.0])
def test_the_turn_about_the_handle_is_the_twist_about_its_axis(angle: float):
    before = quaternion_from_rotation_vector(torch.tensor([[0.3, -0.8, 0.5]]))
    now = quaternion_multiply(before, about_z(angle))
    torch.testing.assert_close(turn_about_handle(before, now), torch.tensor([angle]), atol=1e-5, rtol=0)
    torch.testing.assert_close(turn_about_handle(before, -now), torch.tensor([angle]), atol=1e-5, rtol=0)
    tilted = quaternion_multiply(before, quaternion_from_rotation_vector(torch.tensor([[0.4, 0.0, 0.0]])))
    torch.testing.assert_close(turn_about_handle(before, tilted), torch.zeros(1), atol=1e-5, rtol=0)


def test_the_hammer_arrives_turned_to_either_side_and_never_a_little():
    roll = roll_at_release(torch.linspace(-1, 1, 401), TURN)
    low, high = TURN.arrives
    assert ((roll.abs() >= low - 1e-6) & (roll.abs() <= high + 1e-6)).all()
    assert (roll < 0).sum() == 200
    for number in (-1.0, -0.3, 0.2, 1.0):
        found = float(roll_at_release(torch.tensor([number]), TURN))
        assert number_of_roll(found, TURN) == pytest.approx(number, abs=1e-6)
    assert number_of_roll(0.1, TURN) == 0
    assert number_of_roll(4.0, TURN) == 1


def test_a_start_that_is_chosen_is_the_start_that_is_told():
    starts = HammerTask(CONFIG).starts()
    assert starts is not None
    place = [number.name for number in starts.numbers].index("roll")
    assert (starts.numbers[place].low, starts.numbers[place].high) == (-TURN.arrives[1], TURN.arrives[1])
    pose = torch.zeros(3), torch.tensor([1.0, 0.0, 0.0, 0.0])
    for u in torch.rand(20, 9):
        torch.testing.assert_close(starts.draws(starts.shares(u, pose)), u, atol=1e-5, rtol=0)


def test_a_turned_grasp_holds_the_turned_hammer_as_the_grasp_holds_the_other():
    grasps = GraspCandidates.load(bundled_path("hammer")).select(slice(5))
    axis = handle_place()
    copies = turned_copies(grasps, axis, TURN)
    assert len(copies) == 2 * COPIES * len(grasps)
    on_axis = torch.tensor([[*axis, 0.0]])
    for k, angle in enumerate([*torch.linspace(*TURN.arrives, COPIES).tolist()] * 2):
        side = -1 if k < COPIES else 1
        turned = about_z(side * angle)
        hammer = on_axis - quaternion_apply(turned, on_axis), turned
        copy = copies.select(slice(k * len(grasps), (k + 1) * len(grasps)))
        pose = (x.expand(len(grasps), -1) for x in hammer)
        p, q = compose((next(pose), next(pose)), (copy.position, copy.quaternion))
        torch.testing.assert_close(p, grasps.position, atol=1e-5, rtol=0)
        torch.testing.assert_close(q.abs(), grasps.quaternion.abs(), atol=1e-5, rtol=0)
        approach = quaternion_apply(turned.expand(len(grasps), 4), copy.approach)
        torch.testing.assert_close(approach, grasps.approach, atol=1e-5, rtol=0)
        torch.testing.assert_close(copy.grasp, grasps.grasp)


@pytest.mark.parametrize(
    ("turn", "told"),
    [
        ({"arrives": [0.0, 0.0]}, "turn.arrives is 0, 0"),
        ({"arrives": [1.0, 0.5]}, "turn.arrives is 1, 0.5"),
        ({"arrives": [0.5, 3.5]}, "turn.arrives is 0.5, 3.5"),
        ({"least": 0.0}, "turn.least is 0"),
    ],
)
def test_turns_that_make_no_sense_are_refused(turn: dict[str, Any], told: str):
    with pytest.raises(InputError, match=told):
        tasks.make_task("DoraHammer-v1", 1, config={"reorient": "in_hand", "turn": turn})


# ------------------------------------------------------------ stages and the reward


def test_the_stage_comes_between_holding_still_and_the_nail():
    names = [stage.name for stage in mdp.stages(CONFIG)]
    assert names == ["catch", "stabilise", "turn", "orient", "strike"]
    assert [stage.name for stage in mdp.stages(HammerConfig())] == ["catch", "stabilise", "orient", "strike"]
    assert names[mdp.strike_stage(CONFIG)] == names[-1]
    assert "turn" not in mdp.terms(HammerConfig()).terms
    with_turn = [phase.name for phase in phases(CatchSettings(), 1.4)]
    assert with_turn.index("turn") == with_turn.index("settle") + 1 == with_turn.index("align") - 1
    assert "turn" not in [phase.name for phase in phases(CatchSettings())]


def state(turned: float, **given: Any) -> Any:
    s = hammer_state(**given)
    s.turned.fill_(turned)
    return s


def test_the_turn_needs_its_angle_and_the_hand():
    stages, least = mdp.stages(CONFIG), TURN.least
    assert is_done(stages, "turn", state(least + 0.01))
    assert not is_done(stages, "turn", state(least - 0.01))
    assert not is_done(stages, "turn", state(-least - 0.01))
    assert not is_done(stages, "turn", state(least + 0.01, centre=CONFIG.in_hand + 1e-3))
    turn = next(stage for stage in stages if stage.name == "turn")
    assert turn.lost is not None
    assert turn.lost(state(least, centre=CONFIG.lost + 1e-3)).all()


def test_what_has_turned_back_is_not_oriented():
    over = {"tilt": 0.0, "face": (0.0, 0.05)}
    assert is_done(mdp.stages(CONFIG), "orient", state(TURN.least + 0.01, **over))
    assert not is_done(mdp.stages(CONFIG), "orient", state(TURN.least - 0.01, **over))
    assert is_done(mdp.stages(HammerConfig()), "orient", state(0.0, **over))


def test_turning_pays_until_it_is_enough():
    term = mdp.terms(CONFIG).terms["turn"].value
    values = []
    for turned in (-0.3, 0.0, TURN.least / 2, TURN.least, 2 * TURN.least):
        s = state(turned)
        s.stage.fill_(mdp.HELD)
        values.append(float(term(s)))
    assert values == pytest.approx([0.0, 0.0, 0.5, 1.0, 1.0])
    assert float(term(state(TURN.least))) == 0  # not held yet


# ------------------------------------------------------------------------ the task


def test_an_episode_starts_turned_and_counts_from_where_the_hammer_was_held():
    task = tasks.make_task("DoraHammer-v1", 6, config={"reorient": "in_hand"})
    plain_task = tasks.make_task("DoraHammer-v1", 1)
    copies = [len(one.guide.choice.candidates) for one in (task, plain_task)]
    assert copies[0] == 2 * COPIES * copies[1]
    assert "turning" not in plain_task.get_state_dict()
    sizes = [int(np.prod(one.single_observation_space.shape or ())) for one in (task, plain_task)]
    assert sizes[0] - sizes[1] == 2 + 1  # the turn and its way, and one more phase
    plain_task.close()
    task.reset(seed=3)
    s: Any = task.snapshot
    roll = turn_about_handle(about_z(0.0).expand(6, 4), s.object.q)
    low, high = TURN.arrives
    assert ((roll.abs() > low - 0.05) & (roll.abs() < high + 0.05)).all()
    assert s.way.tolist() == (-roll.sign()).tolist()
    zero = torch.zeros(6, task.action_size)
    while task.snapshot.time.max() < 0.35:
        task.step(zero)
    later: Any = task.snapshot
    assert (later.stage >= mdp.HELD).any()
    assert (later.turned[later.stage < mdp.HELD] == 0).all()
    stored, way = task.get_state_dict(), later.way.tolist()
    while task.snapshot.time.max() < 0.42:
        task.step(zero)
    still: Any = task.snapshot
    rows = (later.stage >= mdp.HELD) & (still.stage >= mdp.HELD)
    assert rows.any()
    frozen = task.get_state_dict()["turning"]["held"]
    assert torch.equal(frozen[rows], stored["turning"]["held"][rows])
    assert (still.turned[rows].abs() > 0.05).any()
    task.task.place(task.task_scene, torch.arange(6), torch.rand(6, 9))
    assert later.way.tolist() == way  # what a snapshot says does not change afterwards
    task.set_state_dict(stored)
    again: Any = task.get_state_dict()
    for name in ("held", "way"):
        torch.testing.assert_close(again["turning"][name], stored["turning"][name])
    task.close()


def digest_with(**task: Any) -> str:
    return RunConfig("DoraHammer-v1", "sac", task=HammerConfig(**task)).digest()


def test_settings_of_a_hammer_that_the_wrist_turns_have_the_digest_that_they_had():
    """So the numbers of the turn are left out of it, and of no other."""
    content = plain(RunConfig("DoraHammer-v1", "sac", task=HammerConfig()))
    old = {name: value for name, value in content["task"].items() if name not in ("reorient", "turn")}
    assert _digested(content | {"task": old}) == _digested(content)
    less = TurnSettings(least=0.5)
    assert digest_with() == digest_with(turn=less)
    assert len({digest_with(), digest_with(reorient="in_hand"), digest_with(reorient="in_hand", turn=less)}) == 3


@pytest.mark.slow
def test_the_fingers_turn_the_hammer_without_a_policy():
    """Zero correction, preset `none`: most hammers are turned by 40 degrees in the hand."""
    task = tasks.make_task("DoraHammer-v1", 64, preset="none", config={"reorient": "in_hand"})
    task.reset(seed=0)
    zero = torch.zeros(64, task.action_size)
    for _ in range(task.max_steps):
        info = task.step(zero)[-1]
    rates = {k: v.float().mean().item() for k, v in info.items() if k.startswith("stage/")}
    print(rates, f"success {info['success'].float().mean():.2f}")
    assert rates["stage/turn"] >= 0.5
    task.close()
