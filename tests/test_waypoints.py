"""The reference made of waypoints, on invented states that a made-up wrist follows."""

from typing import Any

import pytest
import torch
from invented import invented
from torch import Tensor

from dora.tasks.guidance.waypoints import Kept, Waypoint, WaypointReference
from dora.tasks.mdp.snapshot import Snapshot

DT = 0.05
"""Duration of a control step [s]."""


def at(x: float) -> Any:
    """A goal on the x axis."""
    return lambda s, kept: (torch.tensor([[x, 0.0, 0.0]]).expand_as(s.hand.wrist_p), s.hand.wrist_q)


def reference(*waypoints: Waypoint, n: int = 2) -> WaypointReference:
    made = WaypointReference(waypoints, n, DT, "cpu", closing_time=0.5)
    made.begin(torch.arange(n), torch.zeros(n, 3), torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(n, 1))
    return made


def state(**given: Tensor) -> Snapshot:
    """A state of two environments."""
    fields = {"goal_pregrasp": torch.zeros(2, 20), "goal_grasp": torch.ones(2, 20)}
    return invented(2, **(fields | given))


def follow(made: WaypointReference, steps: int, blocked: bool = False, **given: Tensor) -> list[int]:
    """Phases of the first environment while the wrist is wherever it is sent, or does not move."""
    phases = []
    for _ in range(steps):
        target = made.target(state(**given))
        made.aim(target)
        p = torch.zeros(2, 3) if blocked else target.wrist_p
        made.advance(state(**{"wrist_p": p} | given))
        phases.append(int(made.phase.index[0]))
    return phases


def test_the_point_runs_ahead_at_the_speed_of_the_waypoint():
    made = reference(Waypoint("go", at(1.0), speed=0.4))
    follow(made, 10)
    torch.testing.assert_close(made.target(state()).wrist_p[:, 0], torch.full((2,), 10 * DT * 0.4))


def test_waypoints_follow_each_other_and_the_last_is_held():
    made = reference(Waypoint("go", at(0.2), speed=0.4), Waypoint("back", at(0.0), speed=0.4))
    phases = follow(made, 30)
    assert phases == sorted(phases)
    assert phases[0] == 0
    assert phases[-1] == 1
    torch.testing.assert_close(made.target(state()).wrist_p, torch.zeros(2, 3))


def test_the_hand_closes_in_the_closing_time_and_the_next_waypoint_waits_for_it():
    made = reference(Waypoint("close", at(0.0), closed=1.0), Waypoint("go", at(1.0), closed=1.0))
    phases = follow(made, 9)
    assert set(phases) == {0}
    torch.testing.assert_close(made.target(state()).hand, torch.full((2, 20), 0.9))
    assert follow(made, 4)[-1] == 1


def test_a_waypoint_that_is_not_ready_does_not_set_out():
    ready = torch.tensor([False, True])
    made = reference(Waypoint("wait", at(0.2), speed=0.4, ready=lambda s: ready), Waypoint("end", at(0.2)))
    follow(made, 20)
    assert made.phase.index.tolist() == [0, 1]
    assert made.target(state()).wrist_p[0, 0] == 0


def test_a_waypoint_waits_for_what_it_is_done_with():
    done = torch.tensor([False, True])
    made = reference(Waypoint("pull", at(0.1), done=lambda s: done), Waypoint("end", at(0.1)))
    follow(made, 20)
    assert made.phase.index.tolist() == [0, 1]


def test_patience_ends_the_wait_for_a_wrist_that_does_not_come():
    made = reference(Waypoint("go", at(0.5), speed=1.0, patience=0.5), Waypoint("end", at(0.5)))
    phases = follow(made, 25, blocked=True)
    first = phases.index(1)
    assert 9 + 9 <= first <= 9 + 12  # nine steps of the way until one is left, ten of patience


def test_what_is_lost_begins_again_at_the_wrist_with_an_open_hand():
    lost = torch.tensor([False, False])
    pull = Waypoint("pull", at(1.0), closed=1.0, lost=lambda s: lost)
    made = reference(Waypoint("approach", at(0.0)), Waypoint("close", at(0.0), closed=1.0), pull)
    follow(made, 20)
    assert made.phase.index.tolist() == [2, 2]
    lost[0] = True
    made.advance(state(wrist_p=torch.tensor([[0.3, 0.0, 0.0]]).repeat(2, 1)))
    assert made.phase.index.tolist() == [0, 2]
    assert float(made.target(state()).wrist_p[0, 0]) == pytest.approx(0.3 - 0.4 * DT)  # a first step towards its goal
    lost[0] = False
    phases = follow(made, 40)
    assert phases[-1] == 2
    assert 1 in phases


def test_a_waypoint_keeps_what_it_began_with():
    goals = []

    def kept(s: Snapshot, k: Kept) -> Any:
        goals.append(k.goal[0].clone())
        return k.goal

    made = reference(Waypoint("go", at(0.0)), Waypoint("close", kept, closed=1.0, keep=True))
    follow(made, 3, goal_p=torch.tensor([[0.1, 0.0, 0.0]]).repeat(2, 1))
    assert made.phase.index.tolist() == [1, 1]
    follow(made, 3, goal_p=torch.tensor([[0.7, 0.0, 0.0]]).repeat(2, 1))
    torch.testing.assert_close(goals[-1][:, 0], torch.full((2,), 0.1))


def test_its_state_is_what_it_goes_on_from():
    def made() -> WaypointReference:
        return reference(Waypoint("go", at(0.2), speed=0.4), Waypoint("close", at(0.2), closed=1.0))

    one, other = made(), made()
    follow(one, 14)
    other.set_state(one.get_state(), slice(None))
    assert follow(one, 12) == follow(other, 12)
    torch.testing.assert_close(one.target(state()).hand, other.target(state()).hand)


def test_rows_begin_on_their_own():
    made = reference(Waypoint("go", at(1.0), speed=0.4))
    follow(made, 5)
    made.begin(torch.tensor([1]), torch.zeros(1, 3), torch.tensor([[1.0, 0.0, 0.0, 0.0]]))
    assert made.target(state()).wrist_p[:, 0].tolist() == pytest.approx([0.1, 0.0])
