"""DoraMicrowave-v1: stages and reward on invented states."""

import dataclasses
from math import radians
from typing import Any

import pytest
import torch
from invented_microwave import in_world, invented, out

from dora.tasks.mdp.stages import StageMachine
from dora.tasks.microwave import mdp
from dora.tasks.microwave.mdp import MicrowaveConfig
from dora.tasks.microwave.snapshot import LEFT, RIGHT
from dora.tasks.microwave.task import MicrowaveTask

CONFIG = MicrowaveConfig()
"""The task's own numbers."""
STAGES, TERMS = mdp.stages(CONFIG), mdp.terms(CONFIG).terms


def test_each_arm_has_stages_of_its_own():
    assert [stage.name for stage in STAGES[LEFT]] == ["reach_handle", "grasp_handle", "open"]
    assert [stage.name for stage in STAGES[RIGHT]] == ["reach_cube", "grasp_cube", "carry", "put_in", "leave"]


def test_the_door_is_open_from_sixty_degrees():
    s = invented(door=torch.tensor([radians(59.0), radians(61.0)])).of(LEFT)
    assert STAGES[LEFT][2].done(s).tolist() == [False, True]


@pytest.mark.parametrize(("touching", "near"), [(True, True), (False, True), (True, False)])
def test_the_door_is_opened_by_a_finger_on_the_handle_alone(touching: bool, near: bool):
    """A door that anything else has opened sends the arm back to its handle."""
    machine = StageMachine(STAGES[LEFT], 2, 0.025)
    machine.index.fill_(2)
    tips = torch.tensor([0.03 if near else 0.5, 0.0, 0.0]).repeat(2, 5, 1)
    left = {"tip_p": tips, "touch": torch.zeros(2, 6, dtype=torch.bool).index_fill_(1, torch.tensor([2]), touching)}
    machine.advance(invented(left=left, door=torch.full((2,), radians(61.0))).of(LEFT))
    assert machine.index.tolist() == [3 if touching and near else 0] * 2


@pytest.mark.parametrize(
    ("place", "expected"), [((-0.1, 0.0, 0.1), True), ((0.1, 0.0, 0.1), False), ((-0.1, 0.0, 0.35), False)]
)
def test_a_cube_above_or_in_the_microwave_is_not_in_front_of_it(place: tuple[float, ...], expected: bool):
    cube = {"p": in_world(*place), "start_p": torch.full((2, 3), -1.0)}
    assert STAGES[RIGHT][2].done(invented(cube=cube).of(RIGHT)).tolist() == [expected] * 2


@pytest.mark.parametrize(
    ("place", "start", "expected"),
    [
        ((-0.29, 0.0, 0.1), -1.0, True), ((-0.31, 0.0, 0.1), -1.0, False),  # before it, too far before it
        ((-0.1, 0.14, 0.1), -1.0, True), ((-0.1, 0.16, 0.1), -1.0, False), ((-0.1, -0.16, 0.1), -1.0, False),  # beside
        ((-0.1, 0.0, 0.1), 0.11, True), ((-0.1, 0.0, 0.1), 0.13, False),  # raised by 9 or 7 cm
    ],
)  # fmt: skip
def test_a_cube_is_carried_once_it_is_raised_and_before_the_cavity(
    place: tuple[float, ...], start: float, expected: bool
):
    cube = {"p": in_world(*place), "start_p": torch.full((2, 3), start)}
    assert STAGES[RIGHT][2].done(invented(cube=cube).of(RIGHT)).tolist() == [expected] * 2


@pytest.mark.parametrize("at", [1, 2, 3])
def test_a_cube_that_the_hand_has_lost_has_to_be_reached_again(at: int):
    """Unless it lies inside, where it may be let go."""
    stage, outside, within = STAGES[RIGHT][at], in_world(-0.1, 0.0, 0.1), in_world(0.12, 0.0, 0.05)
    assert stage.back_to == "reach_cube"
    assert stage.lost is not None
    for cube, kept in ((outside, False), (within, stage.name == "put_in")):
        near = cube[:, None].repeat(1, 5, 1)
        for tips, away in ((near, False), (near + 0.2, True)):
            s = invented(right={"tip_p": tips}, cube={"p": cube}).of(RIGHT)
            assert stage.lost(s).tolist() == [away and not kept] * 2


@pytest.mark.parametrize("missing", ["nothing", "inside", "still", "untouched", "out", "other hand out", "open"])
def test_the_cube_is_put_down_when_it_lies_inside_alone(missing: str):
    touch = torch.zeros(2, 6, dtype=torch.bool)
    cube = {"p": in_world(0.12, 0.0, 0.05)}
    right = out() | {"touch": touch}
    if missing == "inside":
        cube = {"p": in_world(-0.05, 0.0, 0.05)}
    elif missing == "still":
        cube |= {"v": torch.full((2, 3), 0.05)}
    elif missing == "untouched":
        right |= {"touch": ~touch}
    elif missing == "out":
        right |= {"wrist_p": in_world(0.05, 0.0, 0.1)}
    left = {"wrist_p": in_world(0.05 if missing == "other hand out" else -0.3, 0.2, 0.1)}
    door = torch.full((2,), 0.5 if missing == "open" else 1.2)
    s = invented(right=right, left=left, cube=cube, door=door)
    assert STAGES[RIGHT][-1].done(s.of(RIGHT)).all() == (missing == "nothing")
    assert TERMS["placed"].value(s).tolist() == [float(missing == "nothing")] * 2


def test_grasps_of_a_search_without_regions_count_by_the_open_door_and_the_cube_inside():
    """Whatever held the door or the cube, and at whichever stage the arms are."""
    task = MicrowaveTask(CONFIG)
    for door, x, opened, placed in ((1.2, 0.12, True, True), (1.2, -0.1, True, False), (0.9, 0.12, False, False)):
        left = {"wrist_p": in_world(-0.3, 0.2, 0.1)}
        s = invented(right=out(), left=left, cube={"p": in_world(x, 0.0, 0.05)}, door=torch.full((2,), door))
        assert task.held(s.of(LEFT), LEFT).tolist() == [opened] * 2
        assert task.held(s.of(RIGHT), RIGHT).tolist() == [placed] * 2


def test_an_overlap_above_the_limit_pays_no_end():
    left = {"wrist_p": in_world(-0.3, 0.2, 0.1)}
    s = {"right": out(), "left": left, "cube": {"p": in_world(0.12, 0.0, 0.05)}, "door": torch.full((2,), 1.2)}
    paid = TERMS["placed"].value(invented(**s, max_penetration=torch.tensor([0.004, 0.006])))
    assert paid.tolist() == [1.0, 0.0]


def test_without_the_overlap_term_the_reward_does_not_depend_on_overlap():
    """`--task.weights.penetration 0 --task.after-overlap 1 --task.placed-after-overlap 1`."""
    weights = dataclasses.replace(CONFIG.weights, penetration=0.0)
    free = mdp.terms(dataclasses.replace(CONFIG, after_overlap=1.0, placed_after_overlap=1.0, weights=weights)).terms
    for stage, x in ((2, -0.1), (3, -0.1), (5, 0.12)):
        stages = {LEFT: torch.full((2,), 3), RIGHT: torch.full((2,), stage)}
        depth = torch.tensor([0.0, 0.006])
        s = invented(
            right=out(), cube={"p": in_world(x, 0.0, 0.05)}, door=torch.full((2,), 1.2), stages=stages,
            penetration=depth, max_penetration=depth,
        )  # fmt: skip
        for name, term in free.items():
            paid = term.weight * term.value(s)
            assert paid[0] == paid[1], name
    assert free["placed"].value(s).tolist() == [1.0, 1.0]


BETTER: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {
    "open": ({"door": torch.tensor([0.1, 0.6])}, {LEFT: 2}),
    "put": ({"cube": {"p": torch.stack([in_world(-0.1, 0.0, 0.1)[0], in_world(0.05, 0.0, 0.1)[0]])}}, {RIGHT: 3}),
    "carry": ({"cube": {"p": torch.stack([in_world(-0.4, -0.4, 0.0)[0], in_world(-0.2, 0.0, 0.085)[0]])}}, {RIGHT: 2}),
}
"""Two states of which the second is better, and the stages in which a term pays."""


@pytest.mark.parametrize("name", BETTER)
def test_terms_grow_with_what_they_are_there_for_in_their_stage(name: str):
    state, stage = BETTER[name]
    stages = {arm: torch.full((2,), stage.get(arm, 0)) for arm in (LEFT, RIGHT)}
    worse, better = TERMS[name].value(invented(**state, stages=stages)).tolist()
    assert worse < better <= 1
    assert TERMS[name].value(invented(**state)).tolist() == [0.0, 0.0]  # nothing before its stage


@pytest.mark.parametrize("name", ["carry", "put"])
def test_after_an_overlap_above_the_limit_the_cube_earns_less(name: str):
    stage = {RIGHT: 2 if name == "carry" else 3}
    stages = {arm: torch.full((2,), stage.get(arm, 0)) for arm in (LEFT, RIGHT)}
    cube = {"p": in_world(-0.1, 0.0, 0.1)}
    clean, deep = (
        TERMS[name].value(invented(cube=cube, stages=stages, max_penetration=torch.tensor([0.004, 0.006]))).tolist()
    )
    assert deep == pytest.approx(CONFIG.after_overlap * clean)
    assert clean > 0


def test_no_term_leaves_its_bounds():
    generator = torch.Generator().manual_seed(0)
    for _ in range(20):
        spread = {"p": torch.randn(8, 3, generator=generator)}
        s = invented(
            n=8, cube=spread, handle=spread, door=2 * torch.rand(8, generator=generator),
            stages={arm: torch.randint(0, 6, (8,), generator=generator) for arm in (LEFT, RIGHT)},
            action=2 * torch.rand(8, 26, generator=generator) - 1,
        )  # fmt: skip
        for name, term in TERMS.items():
            value = term.value(s)
            assert ((value >= 0) & (value <= 1)).all(), name


THUMB_AND_INDEX, TWO_FINGERS = torch.tensor([0, 1]), torch.tensor([1, 2])
FAR_AND_NEAR = torch.tensor([[0.0, 0.0, 0.4], [0.0, 0.0, 0.2]])
OF_EACH_ARM: dict[str, tuple[dict[str, Any], dict[str, Any], int]] = {
    "affordance": ({"tip_p": FAR_AND_NEAR[:, None].repeat(1, 5, 1)}, {}, 0),
    "candidate": ({}, {"p": FAR_AND_NEAR}, 0),
    "reach": ({"tip_p": FAR_AND_NEAR[:, None].repeat(1, 5, 1)}, {}, 0),
    "grasp": ({"touch": torch.zeros(2, 6, dtype=torch.bool)}, {}, 1),
}
"""Two states of a hand and of its goal of which the second is better, and the stage in which the term pays."""
OF_EACH_ARM["grasp"][0]["touch"][0, TWO_FINGERS] = True
OF_EACH_ARM["grasp"][0]["touch"][1, THUMB_AND_INDEX] = True


@pytest.mark.parametrize("arm", [LEFT, RIGHT])
@pytest.mark.parametrize("name", OF_EACH_ARM)
def test_reaching_and_grasping_pay_the_arm_that_does_it(arm: str, name: str):
    hand, goal, stage = OF_EACH_ARM[name]
    stages = {each: torch.full((2,), stage) for each in (LEFT, RIGHT)}
    s = invented(**{arm: hand}, goals={arm: goal}, stages=stages)  # pyright: ignore[reportArgumentType]
    other = LEFT if arm == RIGHT else RIGHT
    term = TERMS[f"{name}_{arm}"]
    worse, better = term.value(s).tolist()
    assert worse < better - 1e-4
    assert term.weight > 0
    unmoved = TERMS[f"{name}_{other}"].value(s)
    assert unmoved[0] == unmoved[1]


def test_overlap_costs_in_every_stage():
    """`penetration` is a penalty of every task; the first state overlaps less."""
    less, more = TERMS["penetration"].value(invented(penetration=torch.tensor([0.002, 0.004]))).tolist()
    assert less < more
    assert TERMS["penetration"].weight < 0
