"""References, choice of candidates and residual action, step by step in numbers that are worked out by hand."""

from dataclasses import replace
from typing import Any

import pytest
import torch
from invented import invented
from test_guidance import CPU, IDENTITY, along_x, nearest
from torch import Tensor

from dora.errors import InputError
from dora.geometry.rotations import quaternion_from_rotation_vector
from dora.tasks.guidance.candidate_choice import NEAREST, CandidateChoice
from dora.tasks.guidance.exact_correction import exact_correction
from dora.tasks.guidance.grasp_and_lift import APPROACH, CLOSE, DESCEND, LIFT, GraspReference, GraspSettings
from dora.tasks.guidance.guide import Guide
from dora.tasks.guidance.residual_action import SMOOTHING, ResidualAction, wrist_step
from dora.tasks.guidance.waypoints import Waypoint, WaypointReference
from dora.tasks.mdp.config import ResidualBounds
from dora.tasks.mdp.randomisation import Randomisation

DT = 0.05
"""Duration of a control step [s]."""
C = GraspSettings()
"""Numbers of the reference."""


def close(*expected: float) -> Any:
    return pytest.approx(list(expected), abs=1e-5)


def turned(*vector: float) -> Tensor:
    return quaternion_from_rotation_vector(torch.tensor([vector]))


# ------------------------------------------------------------------------ grasp and lift


def at_goal(**given: Tensor) -> Any:
    """A wrist at the goal of its candidate, which is approached downwards."""
    goal = torch.tensor([[0.4, 0.1, 0.2]])
    fields = {
        "wrist_p": goal, "goal_p": goal, "goal_approach": torch.tensor([[0.0, 0.0, -1.0]]),
        "goal_pregrasp": torch.full((1, 20), 0.2), "goal_grasp": torch.full((1, 20), 1.0),
    }  # fmt: skip
    return invented(1, **(fields | given))


def grasping(phase: int, **buffers: float) -> GraspReference:
    """A reference in a phase whose wrist is where it was sent."""
    made, s = GraspReference(1, DT, CPU), at_goal()
    made.begin(torch.arange(1), s.hand.wrist_p, s.hand.wrist_q)
    made.phase.index.fill_(phase)
    made.buffers.update(latched_p=s.goal.p, **{name: torch.full((1,), value) for name, value in buffers.items()})
    return made


def numbers(made: GraspReference) -> list[float]:
    """Standoff, closing, raised, waited."""
    return [made.buffers.get_state()[name].item() for name in ("standoff", "closing", "raised", "waited")]


BEGUN = {"closing": 0.5, "raised": 0.05, "waited": 0.3}
"""Ramps that are under way."""
STEPS: dict[str, tuple[int, dict[str, float], tuple[float, ...]]] = {
    "down": (DESCEND, {"standoff": 0.1, **BEGUN}, (0.1 - C.descent * DT, 0.5, 0.05, 0.0)),
    "down to the candidate": (DESCEND, {"standoff": 0.004, **BEGUN}, (0.0, 0.5, 0.05, 0.3 + DT)),
    "closing": (CLOSE, {"standoff": 0.0, **BEGUN}, (0.0, 0.5 + DT / C.closing_time, 0.05, 0.0)),
    "closed": (CLOSE, {"standoff": 0.0, **BEGUN, "closing": 0.99}, (0.0, 1.0, 0.05, 0.0)),
    "up": (LIFT, {"standoff": 0.0, **BEGUN, "closing": 1.0}, (0.0, 1.0, 0.05 + C.ascent * DT, 0.0)),
    "up there": (LIFT, {"standoff": 0.0, **BEGUN, "raised": C.rise - 1e-3}, (0.0, 0.5, C.rise, 0.0)),
}
"""Phase, ramps before a control step, and after it."""


@pytest.mark.parametrize(("phase", "above"), [(APPROACH, 0.06 * 0.5), (DESCEND, 0.0)])
def test_a_hand_that_has_to_turn_comes_higher(phase: int, above: float):
    """By 6 cm for each radian, and by nothing once it goes down; .1 m before the candidate, which is below."""
    made = GraspReference(1, DT, CPU, replace(C, hover=0.06))
    s = at_goal(wrist_q=quaternion_from_rotation_vector(torch.tensor([[0.0, 0.3, 0.4]])))
    made.begin(torch.arange(1), s.hand.wrist_p, s.hand.wrist_q)
    made.phase.index.fill_(phase)
    made.buffers.update(standoff=torch.tensor([0.1]))
    assert made.target(s).wrist_p[0].tolist() == pytest.approx([0.4, 0.1, 0.3 + above])


@pytest.mark.parametrize("name", STEPS)
def test_a_ramp_moves_on_by_its_speed_in_its_phase_alone(name: str):
    phase, before, after = STEPS[name]
    made = grasping(phase, **before)
    made.advance(at_goal())
    assert made.phase.index.item() == phase
    assert numbers(made) == close(*after)


@pytest.mark.parametrize(("phase", "limits"), [(APPROACH, C.arrived), (DESCEND, C.settled)])
@pytest.mark.parametrize(("away", "turn"), [(0.9, 0.9), (1.1, 0.9), (0.9, 1.1)])
def test_the_wrist_is_there_when_place_and_turn_are(phase: int, limits: tuple[float, float], away: float, turn: float):
    made = grasping(phase, standoff=0.0)
    made.advance(at_goal(wrist_p=at_goal().goal.p + torch.tensor([[away * limits[0], 0.0, 0.0]]),
                         wrist_q=turned(0.0, turn * limits[1], 0.0)))  # fmt: skip
    assert made.phase.index.item() == phase + (away < 1 and turn < 1)


def test_a_hand_that_something_keeps_away_closes_when_its_patience_is_over():
    made, away = grasping(DESCEND, standoff=0.0), at_goal().goal.p + 0.03
    steps = 0
    while made.phase.index.item() == DESCEND:
        made.advance(at_goal(wrist_p=away))
        steps += 1
    assert steps == round(C.patience / DT) + 1


def test_a_standoff_is_kept_before_the_hand_may_close():
    made = grasping(DESCEND, standoff=0.02)
    made.advance(at_goal())
    assert made.phase.index.item() == DESCEND


@pytest.mark.parametrize("phase", [CLOSE, LIFT])
@pytest.mark.parametrize("away", [-1e-3, 1e-3])
def test_a_grasp_that_is_lost_begins_again(phase: int, away: float):
    made = grasping(phase, standoff=0.0, closing=0.5, raised=0.05)
    made.advance(at_goal(wrist_p=at_goal().goal.p + torch.tensor([[C.lost + away, 0.0, 0.0]])))
    assert made.phase.index.item() == (APPROACH if away > 0 else phase)
    if away > 0:
        assert numbers(made) == close(C.standoff, 0.0, 0.0, 0.0)


def test_the_target_is_before_the_candidate_and_then_where_the_hand_closed():
    made = grasping(DESCEND, standoff=0.03, closing=0.25, raised=0.05)
    target = made.target(at_goal())
    assert target.wrist_p[0].tolist() == close(0.4, 0.1, 0.23)
    assert target.hand[0].tolist() == close(*[0.4] * 20)
    made = grasping(DESCEND, standoff=0.0)
    made.advance(at_goal())
    moved = at_goal(goal_p=torch.tensor([[0.45, 0.1, 0.2]]), goal_q=turned(0.0, 0.0, 0.5))
    assert made.phase.index.item() == CLOSE
    made.advance(moved)
    assert made.target(moved).wrist_p[0].tolist() == close(0.4, 0.1, 0.2)
    assert made.target(moved).wrist_q[0].tolist() == close(1.0, 0.0, 0.0, 0.0)
    made.buffers.update(raised=torch.tensor([0.05]))
    assert made.target(moved).wrist_p[0].tolist() == close(0.4, 0.1, 0.25)


# ------------------------------------------------------------------------ candidates


def test_a_radian_counts_as_ten_centimetres_between_candidates():
    """5 cm away and turned by 1 rad comes after 12 cm away, and before 18 cm away."""
    three = along_x(0.05, 0.12, 0.18)
    three = replace(three, quaternion=torch.cat([turned(0.0, 0.0, 1.0), IDENTITY, IDENTITY]))
    assert nearest(three, [True] * 3) == [1, 0, 2]


def test_candidates_within_a_tenth_of_the_best_score_are_well_ranked():
    assert nearest(along_x(0.1, 0.2, 0.3, score=(0.89, 0.91, 1.0)), [True] * 3) == [1, 2, 0]
    assert nearest(along_x(0.1, 0.2, 0.3, score=(float("nan"), 0.05, 0.2)), [True] * 3) == [2, 0, 1]
    assert nearest(along_x(0.1, 0.2, 0.3, score=(0.5, 0.45, 1.0)), [True, True, False]) == [0, 1, 0]


def test_where_none_can_be_reached_the_first_stands_for_all():
    assert nearest(along_x(0.3, 0.1, 0.2), [False] * 3) == [1, 1, 1]


ERRORS = [(0, "position"), (2, "position"), (3, "quaternion"), (5, "quaternion"), (6, "joints"), (25, "joints")]


@pytest.mark.parametrize(("column", "what"), ERRORS)
def test_each_number_of_an_error_moves_one_thing(column: int, what: str):
    found, r = (
        along_x(0.1, 0.2, 0.3),
        Randomisation(candidate_position=0.02, candidate_rotation=0.1, candidate_joint=0.3),
    )
    choice = CandidateChoice(found, 2, CPU)
    error = torch.zeros(1, choice.error_draws)
    error[0, column] = 0.5
    choice.choose(torch.tensor([1]), torch.tensor([[2, 0, 1]]), torch.tensor([True]), error, r)
    b, order = choice.buffers, [2, 0, 1]
    shift, tilt, bend = torch.zeros(3), torch.zeros(3), torch.zeros(20)
    if what == "position":
        shift[column] = 0.01
    elif what == "quaternion":
        tilt[column - 3] = 0.05
    else:
        bend[column - 6] = 0.15
    torch.testing.assert_close(b.position[1], found.position[order] + shift)
    torch.testing.assert_close(b.quaternion[1], turned(*tilt.tolist()).repeat(NEAREST, 1))
    torch.testing.assert_close(b.pregrasp[1], bend)
    torch.testing.assert_close(b.grasp[1], 1 + bend)
    assert (b.chosen.tolist(), b.reachable.tolist()) == ([0.0, 2.0], [0.0, 1.0])
    assert b.quaternion[0, :, 0].tolist() == [1.0] * NEAREST


def test_the_exact_correction_undoes_the_error_in_the_frame_of_the_hand():
    """The hand is turned by a right angle about z, so that x of the object is -y of the hand; a joint is beyond."""
    found = along_x(0.1, 0.2, 0.3)
    quarter = turned(0.0, 0.0, torch.pi / 2)
    found = replace(found, quaternion=quarter.repeat(3, 1))
    r = Randomisation(candidate_position=0.01, candidate_rotation=0.1, candidate_joint=0.3)
    choice, bounds = CandidateChoice(found, 1, CPU), ResidualBounds(position=0.02, rotation=0.2, joint=0.1)
    error = torch.zeros(1, choice.error_draws)
    error[0, 0], error[0, 5], error[0, 6], error[0, 7] = 1.0, 0.8, 0.2, 1.0
    choice.choose(torch.arange(1), torch.tensor([[1, 0, 2]]), torch.tensor([True]), error, r)
    action = exact_correction(choice, bounds, lambda hand: hand, 20)
    wrong = torch.tensor([-0.01, 0.0, 0.0])
    angle = torch.tensor(torch.pi / 2 + 0.08)
    in_hand = torch.stack([wrong[0] * angle.cos(), -wrong[0] * angle.sin(), torch.zeros(())]) / 0.02
    torch.testing.assert_close(action[0, :3], in_hand, atol=1e-5, rtol=0)
    torch.testing.assert_close(action[0, 3:6], torch.tensor([0.0, 0.0, -0.4]), atol=1e-4, rtol=0)
    assert action[0, 6:].tolist() == close(-0.6, -1.0, *[0.0] * 18)


# ------------------------------------------------------------------------ residual


def test_a_step_is_in_shares_of_its_limits_and_no_longer_than_they_are():
    p, zero = torch.tensor([[0.03, 0.0, 0.04], [0.01, 0.0, 0.0]]), torch.zeros(2, 3)
    q = torch.cat([turned(0.0, 0.1, 0.0), turned(0.0, 0.0, 0.6)])
    step = wrist_step(p, q, zero, IDENTITY.repeat(2, 1), (0.02, 0.2))
    torch.testing.assert_close(
        step, torch.tensor([[0.6, 0, 0.8, 0, 0.5, 0], [0.5, 0, 0, 0, 0, 1.0]]), atol=1e-5, rtol=0
    )


def guide() -> Guide:
    choice = CandidateChoice(along_x(0.1, 0.2, 0.3), 1, CPU)
    return Guide(("prior",), choice, GraspReference(1, DT, CPU), ResidualAction(1, 26, ResidualBounds(), CPU))


def test_shares_are_between_nothing_and_all():
    made = guide()
    for share in (0.0, 1.0):
        made.anneal(bounds=share, error=share)
        assert (made.residual.scale, made.choice.error_scale) == (share, share)
    made.anneal()
    assert (made.residual.scale, made.choice.error_scale) == (1.0, 1.0)
    for wrong in (-0.01, 1.01):
        with pytest.raises(InputError, match="residual's bounds"):
            made.anneal(bounds=wrong)
        with pytest.raises(InputError, match="candidates' error"):
            made.anneal(error=wrong)


def test_an_action_beyond_its_bounds_counts_as_one_at_them_and_is_aimed_with():
    made, s = guide(), at_goal()
    made.begin(torch.arange(1), s.hand.wrist_p, s.hand.wrist_q)
    action = torch.zeros(1, 26)
    action[0, 0], action[0, 1] = 5.0, -5.0
    target = made.target(s, action, lambda hand: hand)
    step = SMOOTHING * ResidualBounds().position
    assert target.wrist_p[0].tolist() == close(0.4 + step, 0.1 - step, 0.2 + C.standoff)
    assert made.reference.buffers.target_p[0].tolist() == close(0.4 + step, 0.1 - step, 0.2 + C.standoff)
    assert made.state_ranges() == {
        "stage": (0.0, 4.0), "furthest": (0.0, 4.0), "hold_count": (0.0, C.closed_time / DT), "chosen": (0.0, 2.0),
    }  # fmt: skip


# ------------------------------------------------------------------------ waypoints


def followed(*waypoints: Waypoint, away: float = 0.0, turn: float = 0.0, steps: int = 1) -> WaypointReference:
    """A reference whose wrist stands at this distance from where it is sent, turned by this against it."""
    made = WaypointReference(waypoints, 1, DT, "cpu", closing_time=0.5)
    made.begin(torch.arange(1), torch.zeros(1, 3), IDENTITY)
    for _ in range(steps):
        p = torch.tensor([[0.0, away, 0.0]])
        made.advance(invented(1, wrist_p=p, wrist_q=turned(0.0, 0.0, turn)))
    return made


def stay(s: Any, kept: Any) -> Any:
    return torch.zeros(1, 3), IDENTITY


@pytest.mark.parametrize(("away", "turn", "there"), [(0.9, 0.9, True), (1.1, 0.9, False), (0.9, 1.1, False)])
def test_a_waypoint_is_reached_when_place_and_turn_are(away: float, turn: float, there: bool):
    first = Waypoint("first", stay, arrived=(0.02, 0.15), patience=10.0)
    made = followed(first, Waypoint("last", stay), away=away * 0.02, turn=turn * 0.15)
    assert made.phase.index.item() == there


def test_patience_counts_in_control_steps():
    first = Waypoint("first", stay, patience=0.2)
    reached = [followed(first, Waypoint("last", stay), away=1.0, steps=k).phase.index.item() for k in range(1, 8)]
    assert reached == [0, 0, 0, 0, 1, 1, 1]


def test_a_hand_opens_as_fast_as_it_closes_and_stops_at_what_is_asked():
    half = followed(Waypoint("half", stay, closed=0.25), steps=4)
    assert half.buffers.closing.item() == pytest.approx(0.25)
    opening = followed(Waypoint("open", stay), steps=1)
    opening.buffers.update(closing=torch.tensor([0.35]))
    opening.advance(invented(1))
    assert opening.buffers.closing.item() == pytest.approx(0.25)


def test_a_point_turns_at_its_spin():
    def quarter(s: Any, kept: Any) -> Any:
        return torch.zeros(1, 3), turned(0.0, 0.0, torch.pi / 2)

    made = followed(Waypoint("turn", quarter, spin=2.0), steps=3)
    torch.testing.assert_close(made.target(invented(1)).wrist_q, turned(0.0, 0.0, 0.3), atol=1e-5, rtol=0)
