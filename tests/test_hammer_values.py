"""Falls, turns and blows of DoraHammer-v1 in numbers that are worked out by hand."""

from math import pi
from typing import Any

import pytest
import torch
from invented import memory
from test_hammer import PHASES, invented
from torch import Tensor

from dora.errors import InputError
from dora.geometry.rotations import quaternion_from_rotation_vector, rotation_angle
from dora.tasks.cube import CubeTask
from dora.tasks.hammer.ballistics import LATEST, STEEP, Strike, after_fall, fall_time, slid
from dora.tasks.hammer.mdp import failed
from dora.tasks.hammer.reach import REACH, TURN
from dora.tasks.hammer.reference import CLOSE, TURNED_TIME, CatchReference, CatchSettings, Timing, phases
from dora.tasks.hammer.task import HammerConfig, HammerTask
from dora.tasks.hammer.turning import TurnSettings, number_of_roll, roll_at_release

C, DT = CatchSettings(), 0.025
"""Numbers of the reference, and duration of a control step [s]."""
IDENTITY = torch.tensor([[1.0, 0.0, 0.0, 0.0]])
TOP = torch.tensor([0.6, -0.1, 0.3])


def near(*expected: float) -> Any:
    return pytest.approx(list(expected), abs=1e-5)


# ------------------------------------------------------------------------ what is held


@pytest.mark.parametrize(
    ("touching", "height", "expected"),
    [((0, 3), 1e-3, True), ((1, 2), 1e-3, True), ((1, 2, 3), 1e-3, True), ((0, 3), -1e-3, False), ((2,), 1e-3, False),
     ((2, 5), 1e-3, False), ((), 1e-3, False)],
)  # fmt: skip
def test_a_hammer_is_held_by_two_fingers_above_the_ground(touching: tuple[int, ...], height: float, expected: bool):
    """Whichever fingers they are; 5 is the palm."""
    touch = torch.zeros(1, 6, dtype=torch.bool)
    touch[0, list(touching)] = True
    config = HammerConfig()
    s = invented(1, touch=touch, object_p=torch.tensor([[0.0, 0.0, config.fallen + height]]))
    assert HammerTask(config).held(s, "arm").tolist() == [expected]


def test_contacts_of_a_hammer_are_collected_in_every_physics_step():
    assert HammerTask.CONTACT_EVERY_STEP
    assert not CubeTask.CONTACT_EVERY_STEP


# ------------------------------------------------------------------------ falls


def test_a_body_falls_and_turns_as_it_was_moving():
    p, q = after_fall(
        (torch.tensor([[0.1, 0.2, 0.9]]), IDENTITY), torch.tensor([[1.0, -2.0, 0.5]]), torch.tensor([[0.0, 0.0, 3.0]]),
        torch.tensor([0.2]),
    )  # fmt: skip
    assert p[0].tolist() == near(0.3, -0.2, 0.9 + 0.1 - 9.81 * 0.04 / 2)
    torch.testing.assert_close(q, quaternion_from_rotation_vector(torch.tensor([[0.0, 0.0, 0.6]])))


def test_a_fall_is_predicted_for_a_second_at_most():
    """From rest 10 m up, thrown up with 10 m/s, and down to a place that is above the body and is never reached."""
    time = fall_time(torch.tensor([10.0, 0.0, -1.0, -1.0]), torch.tensor([0.0, 10.0, 4.0, -5.0]))
    assert time.tolist() == near(LATEST, LATEST, 0.0, 0.0)


@pytest.mark.parametrize(
    ("axis", "expected"),
    [
        ((0.6, 0.0, 0.8), (0.1 - 0.3 * 0.75, 0.2, 0.6)), ((-0.6, 0.0, -0.8), (0.1 - 0.3 * 0.75, 0.2, 0.6)),
        ((0.0, 0.98, 0.2), (0.1, 0.2 - 0.98 * 0.3 / STEEP, 0.9 - 0.2 * 0.3 / STEEP)),
        ((0.0, 0.98, -0.2), (0.1, 0.2 + 0.98 * 0.3 / STEEP, 0.9 - 0.2 * 0.3 / STEEP)),
    ],
)  # fmt: skip
def test_a_pose_slides_along_an_axis_that_is_steep_enough(axis: tuple[float, ...], expected: tuple[float, ...]):
    goal = torch.tensor([[0.1, 0.2, 0.9]]), IDENTITY
    assert slid(goal, torch.tensor([axis]), torch.tensor([0.6]))[0][0].tolist() == near(*expected)


@pytest.mark.parametrize(("height", "expected"), [(-1e-3, True), (1e-3, False)])
def test_a_hammer_has_fallen_below_its_height(height: float, expected: bool):
    config = HammerConfig()
    s = invented(1, object_p=torch.tensor([[0.0, 0.0, config.fallen + height]]))
    assert failed(s, memory(1), config).tolist() == [expected]


# ------------------------------------------------------------------------ turns


@pytest.mark.parametrize("taken", [{"arrives": (0.0, pi)}, {"arrives": (0.7, 0.7)}, {"least": pi}, {"least": 1e-3}])
def test_turns_at_their_limits_are_taken(taken: dict[str, Any]):
    made = TurnSettings(**taken)
    assert {name: getattr(made, name) for name in taken} == taken


@pytest.mark.parametrize(
    ("wrong", "words"),
    [({"arrives": (-0.1, 1.0)}, "arrives"), ({"arrives": (1.0, 3.15)}, "arrives"), ({"least": 3.15}, "least")],
)
def test_turns_beyond_their_limits_are_refused(wrong: dict[str, Any], words: str):
    with pytest.raises(InputError, match=words):
        TurnSettings(**wrong)


def test_the_turn_at_the_release_is_between_its_ends_on_the_side_of_its_sign():
    c = TurnSettings(arrives=(0.5, 1.5))
    u = torch.tensor([-1.0, -0.25, 0.0, 0.25, 1.0])
    assert roll_at_release(u, c).tolist() == near(-1.5, -0.75, 0.5, 0.75, 1.5)
    assert [number_of_roll(x, c) for x in (-1.5, -0.75, 0.75, 2.0, 0.1)] == near(-1.0, -0.25, 0.25, 1.0, 0.0)
    same = TurnSettings(arrives=(0.7, 0.7))
    assert [abs(number_of_roll(x, same)) for x in (-0.7, 0.7)] == [0.0, 0.0]


# ------------------------------------------------------------------------ phases

FAR = {"arrival": 1.0, "spent": 0.0, "position": 1.0, "angle": 1.0}
THERE = {"position": 0.9 * C.arrived[0], "angle": 0.9 * C.arrived[1]}
ENDS: list[tuple[str, dict[str, float], bool]] = [
    ("wait", {"arrival": C.lead + 1e-3}, False), ("wait", {"arrival": C.lead - 1e-3}, True),
    ("close", {"spent": C.close_time - 1e-3}, False), ("close", {"spent": C.close_time + 1e-3}, True),
    ("settle", {"spent": C.settle_time - 1e-3}, False), ("settle", {"spent": C.settle_time + 1e-3}, True),
    ("turn", {"spent": 0.5 + TURNED_TIME - 1e-3}, False), ("turn", {"spent": 0.5 + TURNED_TIME + 1e-3}, True),
    ("align", {**THERE, "spent": C.align_time - 1e-3}, False), ("align", {**THERE, "spent": C.align_time + 1e-3}, True),
    ("align", {"spent": C.patience - 1e-3}, False), ("align", {"spent": C.patience + 1e-3}, True),
    ("raise", THERE, True), ("raise", {**THERE, "angle": 1.1 * C.arrived[1]}, False),
    ("raise", {**THERE, "position": 1.1 * C.arrived[0]}, False), ("raise", {"spent": C.patience + 1e-3}, True),
    ("rest", {"spent": 100.0, **THERE}, False), ("rest", {"spent": 0.0}, False),
]  # fmt: skip


@pytest.mark.parametrize(("name", "state", "expected"), ENDS)
def test_a_phase_ends_when_its_time_is_over_or_the_wrist_is_there(name: str, state: dict[str, float], expected: bool):
    phase = next(phase for phase in phases(C, 0.5) if phase.name == name)
    numbers = {key: torch.tensor([value]) for key, value in (FAR | state).items()}
    assert phase.done(Timing(**numbers, driven=torch.tensor([False]))).tolist() == [expected]


def test_holds_of_the_phases_are_those_of_the_settings():
    assert {phase.name: phase.hold for phase in phases(C, 0.5) if phase.hold} == {
        "align": C.aligned_time, "raise": C.raised_time,
    }  # fmt: skip
    assert C.swing_time == pytest.approx(2 * 0.7 / 4.5)


def reference(phase: str, **buffers: float) -> CatchReference:
    made = CatchReference(1, Strike(TOP, torch.tensor([[0.04, 0.0, 0.04]]), 0.36), 0.01, DT, "cpu", C)
    made.begin(torch.arange(1), torch.tensor([[0.5, -0.1, 0.6]]), IDENTITY)
    made.phase.index.fill_(PHASES.index(phase))
    made.buffers.update(**{name: torch.tensor([value]) for name, value in buffers.items()})
    return made


def moved(made: CatchReference, s: Any) -> Tensor:
    """How far the lead moves in a control step [m]."""
    before = made.buffers.lead_p.clone()
    made.advance(s)
    return (made.buffers.lead_p - before)[0]


@pytest.mark.parametrize(
    ("spent", "sinking", "speed"),
    [
        (0.1, 0.0, C.follow_up * DT), (0.1, 1.0, C.follow_speed), (C.follow_time, 1.0, 1.0 - C.follow_down * DT),
        (C.follow_time, 0.1, 0.0), (C.follow_time - DT - 1e-3, 0.2, 0.2 + C.follow_up * DT),
    ],
)  # fmt: skip
def test_the_closing_hand_sinks_with_the_hammer_and_slows_down(spent: float, sinking: float, speed: float):
    made = reference("close", spent=spent, sinking=sinking)
    assert moved(made, invented(1)).tolist() == near(0.0, 0.0, -speed * DT)
    assert made.phase.index.item() == CLOSE
    assert made.buffers.sinking.item() == pytest.approx(speed)


@pytest.mark.parametrize("steps", [0, 4, 9, 40])
def test_a_swing_gains_speed_evenly_until_the_face_meets_the_nail(steps: int):
    share = min((steps + 1) * DT / C.swing_time, 1.0)
    made = reference("swing", spent=steps * DT - DT)
    angle = made.settings.raised * (1 - share**2)
    made.buffers.update(spent=torch.tensor([steps * DT]))
    assert made._swung().tolist() == near(angle)


@pytest.mark.parametrize(("phase", "gap"), [("align", C.gap), ("rest", 2 * C.gap)])
def test_the_hammer_is_carried_over_the_nail_at_the_speed_of_the_wrist(phase: str, gap: float):
    """In the hand at its own origin; it is far away at first, and in its place in the end."""
    made = reference(phase)
    s = invented(1)
    expected, turn = made.strike.hammer(torch.zeros(1), torch.zeros(1), gap)
    away, angle = float((expected - made.buffers.lead_p).norm()), float(rotation_angle(turn, IDENTITY))
    steps = max(away / (C.carry_speed * DT), angle / (C.carry_spin * DT))
    assert float(moved(made, s).norm()) == pytest.approx(away / steps, rel=1e-3)
    for _ in range(200):
        made.phase.index.fill_(PHASES.index(phase))
        made.advance(s)
    torch.testing.assert_close(made.buffers.lead_p, expected, atol=1e-4, rtol=0)


def test_the_open_hand_waits_a_moment_after_it_begins_to_sink():
    pregrasp, grasp = torch.zeros(1, 20), torch.ones(1, 20)
    s = invented(1, goal_pregrasp=pregrasp, goal_grasp=grasp)
    asked = {}
    for phase, spent in (
        ("wait", 5.0),
        ("close", C.finger_lag - 1e-3),
        ("close", C.finger_lag + 1e-3),
        ("settle", 0.0),
    ):
        asked[phase, spent > C.finger_lag] = reference(phase, spent=spent).target(s).hand[0, 0].item()
    assert asked == {("wait", True): 0.0, ("close", False): 0.0, ("close", True): 1.0, ("settle", False): 1.0}


SWUNG = C.raised * (1 - (0.1 / C.swing_time) ** 2)
"""Angle of the hammer after .1 s of a swing [rad]."""


@pytest.mark.parametrize(("phase", "angle"), [("raise", C.raised), ("swing", SWUNG)])
def test_a_blow_is_aimed_a_little_below_the_head_of_the_nail(phase: str, angle: float):
    """The hammer is in the hand at its own origin; of a swing .1 s will be over in the next step."""
    made = reference(phase)
    for _ in range(200 if phase == "raise" else 1):
        made.phase.index.fill_(PHASES.index(phase))
        made.buffers.update(spent=torch.full((1,), 0.1 - 2 * DT))
        made.advance(invented(1))
    expected, turn = made.strike.hammer(torch.zeros(1), torch.tensor([angle]), -C.through)
    torch.testing.assert_close(made.buffers.lead_p, expected, atol=1e-4, rtol=0)
    assert float(rotation_angle(made.buffers.lead_q, turn)) < 1e-3


def test_the_waiting_hand_goes_and_turns_so_far_at_most():
    """Two candidates 10 and 50 cm beside the hand, turned by .3 and by 1 rad; the hand keeps its height."""
    made = CatchReference(2, Strike(TOP, torch.zeros(2, 3), 0.36), 0.01, DT, "cpu", C)
    home = torch.tensor([[0.5, -0.1, 0.6]] * 2)
    made.begin(torch.arange(2), home, IDENTITY.repeat(2, 1))
    turns = quaternion_from_rotation_vector(torch.tensor([[0.0, 0.0, 0.3], [0.0, 0.0, 1.0]]))
    goal = home + torch.tensor([[0.1, 0.0, -0.3], [0.5, -0.5, -0.3]])
    target = made.target(invented(2, goal_p=goal, goal_q=turns, object_p=goal))
    expected = home + torch.tensor([[0.1, 0.0, 0.0], [REACH[0], -REACH[1], 0.0]])
    torch.testing.assert_close(target.wrist_p, expected)
    limited = quaternion_from_rotation_vector(torch.tensor([[0.0, 0.0, 0.3], [0.0, 0.0, TURN]]))
    torch.testing.assert_close(target.wrist_q, limited, atol=1e-4, rtol=0)
