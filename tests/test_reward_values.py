"""Values of reward terms on invented states, worked out by hand."""

import dataclasses
from collections.abc import Callable
from math import cos, exp, pi
from typing import Any

import pytest
import torch
from invented import ACTION, invented
from test_stage_clauses import HANDLE, hammer_state, touching, voted
from torch import Tensor

from dora.geometry.rotations import quaternion_from_rotation_vector
from dora.tasks import cube, jug
from dora.tasks.hammer import mdp as hammer
from dora.tasks.hammer.task import HammerConfig
from dora.tasks.mdp import terms
from dora.tasks.mdp.snapshot import Snapshot
from dora.tasks.microwave import mdp as microwave
from dora.tasks.microwave.mdp import MicrowaveConfig

HALFWAY = 2 / (1 + 10**0.5)
"""What `tolerance` is at half its margin: 1 / cosh(a / 2)^2, where 1 / cosh(a)^2 = 0.1."""
CUBE, JUG, HAMMER = cube.CubeConfig(), jug.JugConfig(), HammerConfig()
OF_CUBE, OF_JUG, OF_HAMMER = cube.terms(CUBE).terms, jug.terms(JUG).terms, hammer.terms(HAMMER).terms


def paid(term: Any, s: Snapshot) -> list[float]:
    """Value of a term."""
    return term.value(s).tolist()


def close(*expected: float) -> Any:
    return pytest.approx(list(expected), abs=2e-5)


def along(axis: int, *places: float) -> Tensor:
    """Points on an axis [m]."""
    out = torch.zeros(len(places), 3)
    out[:, axis] = torch.tensor(places)
    return out


def turned(axis: int, *angles: float) -> Tensor:
    """Turns about an axis [rad]."""
    return quaternion_from_rotation_vector(along(axis, *angles))


# ------------------------------------------------------------------------ of every task


def test_the_distances_of_all_fingertips_count_together():
    distance = torch.tensor([[0.05, -0.02, 0.1, 0.0, 0.0], [0.0] * 5])
    assert terms.near_region(distance).tolist() == close(exp(-4 * 0.15), 1.0)
    tips = along(0, 0.1, 0.0, 0.0, 0.0, 0.2)[None]
    assert terms.near_point(invented(1, tip_p=tips), torch.zeros(1, 3)).tolist() == close(exp(-4 * 0.3))
    assert paid(terms.paper_affordance(lambda s: s.object.p)["affordance"], invented(1, tip_p=tips)) == close(exp(-1.2))


def test_closeness_to_the_candidate_counts_a_radian_as_ten_centimetres():
    """All within a centimetre; half the margin beyond it by place, by turn, and by both."""
    s = invented(5, goal_p=along(0, 0.01, 0.11, 0.0, 0.05, 0.5), goal_q=turned(2, 0.0, 0.0, 1.1, 0.6, 0.0))
    reached = torch.arange(5) == 4
    assert terms.at_candidate(s, reached).tolist() == pytest.approx([1.0, HALFWAY, HALFWAY, HALFWAY, 1.0], abs=1e-3)


def test_the_thumb_against_a_finger_pays_most_and_each_finger_a_little():
    touch = torch.cat([touching(0, 1), touching(0, 5), touching(1, 2, 5), touching(0, 1, 2, 3, 4, 5), touching(5)])
    assert terms.finger_contacts(invented(5, touch=touch)).tolist() == close(0.7, 0.0, 0.2, 1.0, 0.0)


def test_a_term_of_a_stage_is_nothing_before_it_and_whole_after_it():
    s = invented(4, stage=torch.arange(4), time=torch.full((4,), 0.25))
    assert terms.while_active(1, lambda s: s.time)(s).tolist() == [0.0, 0.25, 1.0, 1.0]


def test_effort_and_change_are_means_of_squares_and_at_most_one():
    some = torch.zeros(ACTION)
    some[: ACTION // 2] = 1.0
    action = torch.stack([torch.full((ACTION,), 0.5), some, torch.full((ACTION,), 3.0)])
    s = invented(3, action=action, previous_action=torch.stack([-action[0], -some, -action[2]]))
    assert terms.effort(s).tolist() == close(0.25, 0.5, 1.0)
    assert terms.change(s).tolist() == close(0.25, 0.5, 1.0)
    penalty = terms.paper_penalty()["penalty"]
    assert (paid(penalty, s), penalty.weight) == (close(0.25, 0.5, 1.0), -0.1)


def test_overlap_costs_from_what_is_free_to_a_limit_beyond_it():
    depth = torch.tensor([0.0, 0.001, 0.0035, 0.006, 0.1, float("nan")])
    value = terms.overlap(0.001, 0.005)(invented(6, penetration=depth))
    assert value.tolist() == close(0.0, 0.0, 0.5, 1.0, 1.0, 0.0)
    weights = CUBE.weights
    made = terms.penalties(weights, 0.0005, 0.003)
    assert {name: term.weight for name, term in made.items()} == {
        "effort": weights.effort, "change": weights.change, "penetration": weights.penetration,
    }  # fmt: skip
    assert made["penetration"].doc == "overlap beyond 0.5 mm"
    deeper = terms.penalties(weights, 0.001, 0.005, 4.0)["penetration"]
    assert deeper.weight == 4 * weights.penetration
    depth = torch.tensor([0.0, 0.006, 0.011, 0.021, 0.1])
    assert deeper.value(invented(5, penetration=depth)).tolist() == close(0.0, 0.25, 0.5, 1.0, 1.0)


@pytest.mark.parametrize(
    ("made", "config"),
    [(cube.terms, CUBE), (jug.terms, JUG), (hammer.terms, HAMMER), (microwave.terms, MicrowaveConfig())],
    ids=["cube", "jug", "hammer", "microwave"],
)
def test_a_task_says_up_to_which_overlap_its_penalty_grows(made: Callable[[Any], Any], config: Any):
    usual, wider = (
        made(c).terms["penetration"].weight for c in (config, dataclasses.replace(config, overlap_range=4.0))
    )
    assert usual == config.weights.penetration
    assert wider == 4 * usual


def test_printed_terms_of_grasping_and_lifting():
    """The wrist 20 cm below its goal, above it, and after the grasp; 3 of 10 cm high, too high, and before the lift."""
    stage = torch.tensor([0, 1, 2])
    s = invented(3, stage=stage, wrist_p=along(2, 0.0, 0.5, 0.0), goal_p=along(2, 0.2, 0.2, 0.2))
    assert paid(terms.paper_grasp(2)["grasp"], s) == close(exp(-0.2), 1.0, 0.0)
    s = invented(3, stage=torch.tensor([2, 3, 1]), object_p=along(2, 0.03, 0.5, 0.03))
    assert paid(terms.paper_lift(2, 0.1)["lift"], s) == close(exp(-0.07), 1.0, 0.0)


# ------------------------------------------------------------------------ cube


def above(*heights: float) -> Tensor:
    """All fingertips above the cube, their surfaces at these distances from its upper face [m]."""
    return (along(2, *heights) + torch.tensor([0.0, 0.0, 0.03 + 0.011]))[:, None].repeat(1, 5, 1)


def test_values_of_the_terms_of_the_cube():
    s = invented(3, tip_p=above(0.125, 0.0, 0.25), stage=torch.zeros(3, dtype=torch.long))
    assert paid(OF_CUBE["reach"], s) == close(HALFWAY, 1.0, 0.1)
    assert paid(OF_CUBE["affordance"], s) == close(exp(-4 * 5 * 0.125), 1.0, exp(-4 * 5 * 0.25))
    lifting = {"stage": torch.tensor([1, 2, 2, 3]), "object_p": along(2, 0.05, 0.05, 0.05, 0.2)}
    touch = torch.cat([touching(0, 1), touching(1), touching(0, 1), touching(0, 1)])
    assert paid(OF_CUBE["lift"], invented(4, touch=touch, **lifting)) == close(0.0, 0.15, 0.5, 1.0)
    assert paid(OF_CUBE["grasp"], invented(4, touch=touch, stage=torch.ones(4).long())) == close(0.7, 0.1, 0.7, 0.7)
    far = {"goal_p": along(0, 0.11, 0.11), "object_p": along(2, 0.019, 0.021)}
    assert paid(OF_CUBE["candidate"], invented(2, **far)) == pytest.approx([HALFWAY, 1.0], abs=1e-3)
    depth = torch.tensor([0.0005, 0.002, 0.0035])
    assert paid(OF_CUBE["penetration"], invented(3, penetration=depth)) == close(0.0, 0.5, 1.0)


def test_a_cube_that_is_held_pays_unless_it_overlapped_too_much():
    held = {"object_p": along(2, 0.101, 0.101, 0.099), "touch": touching(0, 1).repeat(3, 1)}
    s = invented(3, max_penetration=torch.tensor([0.003, 0.0031, 0.0]), **held)
    assert paid(OF_CUBE["held"], s) == [1.0, 0.0, 0.0]


# ------------------------------------------------------------------------ jug


def jugs(n: int, **given: Tensor) -> Snapshot:
    half = torch.as_tensor(jug.jug().mesh.extents / 2, dtype=torch.float32)
    return invented(n, object_half=half.repeat(n, 1), **given)


def by_handle(n: int) -> dict[str, Tensor]:
    return {"touch": touching(0, 1).repeat(n, 1)} | {
        k: v.repeat(n, *[1] * (v.ndim - 1)) for k, v in voted(HANDLE).items()
    }


def test_a_tilted_jug_costs_and_earns_less():
    """Level, by half the largest tilt, by the largest, beyond it, before the lift, not by the handle; upside down."""
    angle = JUG.upright
    angles = (0.0, angle / 2, angle, 2 * angle, 0.0, 0.0, pi)
    given = by_handle(7) | {"object_p": along(2, *[0.05] * 7), "object_q": turned(0, *angles)}
    given["contact_finger"] = given["contact_finger"].clone()
    given["contact_finger"][5] = 0
    s = jugs(7, stage=torch.tensor([2, 2, 2, 2, 1, 2, 2]), **given)
    assert paid(OF_JUG["tilt"], s) == pytest.approx([0.0, 0.5, 1.0, 1.0, 0.0, 0.0, 1.0], abs=2e-3)
    some = 1 - 0.5 * (1 - cos(angle / 2)) / (1 - cos(angle))
    low = max(1 - 0.5 * (1 - cos(2 * angle)) / (1 - cos(angle)), 0.0)
    assert paid(OF_JUG["lift"], s) == close(0.5, 0.5 * some, 0.25, 0.5 * low, 0.0, 0.15, 0.0)
    assert paid(OF_JUG["class"], s) == [1.0, 1.0, 1.0, 1.0, 1.0, 0.0, 1.0]


def test_values_of_the_terms_of_the_jug():
    """The fingertips' surfaces 12.5 cm above the jug, 12.5 cm beyond its handle, at its rim, and the palm on it."""
    highest, farthest = (float(jug.jug().mesh.bounds[1][axis]) for axis in (2, 0))
    rim = jug.jug().mesh.vertices[jug.jug().mesh.vertices[:, 2].argmax()]
    tips = torch.tensor([[*rim[:2], highest + 0.125 + 0.011], [*rim[:2], highest + 0.011]], dtype=torch.float32)
    s = jugs(2, tip_p=tips[:, None].repeat(1, 5, 1))
    assert paid(OF_JUG["reach"], s) == pytest.approx([HALFWAY, 1.0], abs=0.02)
    end = jug.jug().mesh.vertices[jug.jug().mesh.vertices[:, 0].argmax()]
    tips = torch.tensor([[farthest + 0.125 + 0.011, *end[1:]], [farthest + 0.011, *end[1:]]], dtype=torch.float32)
    s = jugs(2, tip_p=tips[:, None].repeat(1, 5, 1))
    assert paid(OF_JUG["affordance"], s) == pytest.approx([exp(-4 * 5 * 0.125), 1.0], abs=0.05)
    held = by_handle(4) | {"object_p": along(2, 0.101, 0.101, 0.099, 0.101)}
    held["supported"] = torch.arange(4) == 3
    s = jugs(4, max_penetration=torch.tensor([0.005, 0.0051, 0.0, 0.0]), **held)
    assert paid(OF_JUG["held"], s) == [1.0, 0.0, 0.0, 0.0]
    far = {"goal_p": along(0, 0.11, 0.11), "object_p": along(2, 0.019, 0.021)}
    assert paid(OF_JUG["candidate"], jugs(2, **far)) == pytest.approx([HALFWAY, 1.0], abs=1e-3)


# ------------------------------------------------------------------------ hammer


def at_stage(stage: int, s: Any) -> Any:
    s.stage.fill_(stage)
    return s


@pytest.mark.parametrize(
    ("centre", "fingers", "expected"),
    [(0.0, (0, 1), 0.7), (0.02, (1, 2, 5), 0.7), (0.17, (0, 1, 2, 3, 4), HALFWAY), (0.32, (), 0.05)],
)
def test_a_catch_pays_by_place_and_fingers(centre: float, fingers: tuple[int, ...], expected: float):
    assert paid(OF_HAMMER["catch"], hammer_state(centre, touch=touching(*fingers))) == close(expected)


@pytest.mark.parametrize(
    ("drift", "stage", "expected"),
    [
        ((0.0, 0.0), 0, 1.0), ((HAMMER.still[0] + 0.025, 0.0), 1, HALFWAY),
        ((0.0, HAMMER.still[1] + 0.25), 1, HALFWAY),
        ((HAMMER.still[0] + 0.05, HAMMER.still[1] + 0.25), 3, HALFWAY / 10), ((1.0, 1.0), 4, 1.0),
    ],
)  # fmt: skip
def test_a_hammer_that_is_still_in_the_hand_pays(drift: tuple[float, float], stage: int, expected: float):
    """And after the last blow everything does."""
    assert paid(OF_HAMMER["still"], at_stage(stage, hammer_state(drift=drift))) == close(expected)
    if stage < 4:
        out_of_hand = hammer_state(HAMMER.in_hand + 0.01, drift=drift)
        assert paid(OF_HAMMER["still"], at_stage(stage, out_of_hand)) == [0.0]


@pytest.mark.parametrize(
    ("stage", "tilt", "face", "expected"),
    [
        (2, 0.0, (0.0, 0.05), 1.0), (3, pi / 2, (0.0, 0.05), HALFWAY), (2, 0.0, (0.35, 0.0), HALFWAY),
        (2, pi / 2, (0.0, 0.35), HALFWAY**2), (1, 0.0, (0.0, 0.05), 0.0), (4, 1.0, (0.5, 0.5), 1.0),
    ],
)  # fmt: skip
def test_a_hammer_over_the_nail_pays(stage: int, tilt: float, face: tuple[float, float], expected: float):
    s = at_stage(stage, hammer_state(tilt=tilt, face=face))
    assert paid(OF_HAMMER["orient"], s) == pytest.approx([expected], abs=2e-3)


@pytest.mark.parametrize(
    ("depth", "stage", "overlap", "strike", "driven"),
    [
        (0.25, 3, 0.0, 0.25, 0.0), (1.0, 3, 0.005, 1.0, 0.0), (1.0, 4, 0.005, 1.0, 1.0),
        (2.0, 4, 0.0051, HAMMER.after_overlap, 0.0), (0.9, 4, 0.0, 0.9, 0.0),
    ],
)  # fmt: skip
def test_depth_pays_and_a_clean_end_pays_more(depth: float, stage: int, overlap: float, strike: float, driven: float):
    s = at_stage(stage, hammer_state(driven=depth * HAMMER.nail.driven))
    s.max_penetration.fill_(overlap)
    assert paid(OF_HAMMER["strike"], s) == close(strike)
    assert paid(OF_HAMMER["driven"], s) == [driven]


@pytest.mark.parametrize(("stage", "expected"), [(0, HALFWAY), (1, HALFWAY), (2, 1.0)])
def test_the_candidate_counts_until_the_hammer_is_held(stage: int, expected: float):
    s = at_stage(stage, hammer_state())
    s.goal.p.copy_(s.hand.wrist_p + torch.tensor([[0.11, 0.0, 0.0]]))
    assert paid(OF_HAMMER["candidate"], s) == pytest.approx([expected], abs=1e-3)


def test_printed_terms_of_the_hammer():
    printed = hammer.paper_terms(HAMMER).terms
    angles = (0.0, pi / 4, pi / 2, pi)
    for stage, share in ((1, 0.0), (2, 1.0)):
        for tilt in angles:
            s = at_stage(stage, hammer_state(tilt=tilt))
            assert paid(printed["orient"], s) == pytest.approx([share * (1 - tilt / pi)], abs=1e-3)
    s = hammer_state(driven=0.25 * HAMMER.nail.driven)
    assert paid(printed["strike"], s) == close(0.25)
    s.hand.tip_p.copy_((s.object.p + (s.butt + s.neck) / 2 + torch.tensor([[0.0, 0.1, 0.0]]))[:, None])
    assert paid(printed["affordance"], s) == close(exp(-4 * 5 * 0.1))


def test_the_turn_in_the_hand_stays_paid_after_the_last_blow():
    c = HammerConfig(reorient="in_hand")
    turn, last = hammer.terms(c).terms["turn"], hammer.strike_stage(c)
    assert last == len(hammer.stages(c)) - 1 == 4
    for stage, expected in ((last, 0.0), (last + 1, 1.0)):
        assert paid(turn, at_stage(stage, hammer_state())) == [expected]
