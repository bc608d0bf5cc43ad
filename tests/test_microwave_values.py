"""Values of the reward of DoraMicrowave-v1 on invented states, and the edges of what counts, worked out by hand."""

from math import cos, exp, sin
from typing import Any

import pytest
import torch
from invented import memory
from invented_microwave import YAW, in_world, invented, out
from test_reward_values import HALFWAY, above, along, close, touching
from torch import Tensor

from dora.tasks.microwave import mdp
from dora.tasks.microwave.mdp import MicrowaveConfig
from dora.tasks.microwave.snapshot import LEFT, RIGHT, MicrowaveSnapshot, hands_out, inside

CONFIG = MicrowaveConfig()
"""The task's own numbers."""
TERMS, PRINTED, STAGES = mdp.terms(CONFIG).terms, mdp.paper_terms(CONFIG).terms, mdp.stages(CONFIG)
WAITS, DEPTH = CONFIG.placing.front, CONFIG.placing.depth


def at(*stages: int, arm: str = RIGHT) -> dict[str, Tensor]:
    """Active stages of one arm; the other one is in its first."""
    other = LEFT if arm == RIGHT else RIGHT
    return {arm: torch.tensor(stages), other: torch.zeros(len(stages), dtype=torch.long)}


def cubes(*places: tuple[float, float, float]) -> Tensor:
    """Places of cubes in the microwave's frame, in the world."""
    return torch.cat([in_world(*place, n=1) for place in places])


def value(name: str, s: MicrowaveSnapshot) -> list[float]:
    return TERMS[name].value(s).tolist()


def test_the_door_pays_by_its_angle_from_the_stage_in_which_it_is_opened():
    door = CONFIG.open * torch.tensor([0.25, 0.25, 2.0, -0.1])
    s = invented(n=4, door=door, stages=at(1, 2, 3, 2, arm=LEFT))
    assert value("open", s) == close(0.0, 0.25, 1.0, 0.0)
    assert PRINTED["open"].value(s).tolist() == close(0.25, 0.25, 1.0, 0.0)


def test_carrying_pays_by_height_place_and_grasp():
    """On the spot where it waits, 3 + 20 cm beside it; low, risen half way; held, and not; before, and afterwards."""
    wait = (-WAITS, 0.0, 0.085)
    beside = (-WAITS, 0.23, 0.085)
    p = cubes(wait, wait, beside, beside, wait, wait)
    start = p.clone()
    start[:, 2] -= CONFIG.lift * torch.tensor([1.0, 0.5, 0.0, 0.5, 1.0, 0.0])
    touch = torch.cat([touching(0, 1)] * 3 + [touching(1, 2)] + [touching(0, 1)] * 2)
    s = invented(
        n=6, cube={"p": p, "start_p": start}, right={"touch": touch}, stages=at(2, 2, 2, 2, 1, 3),
        max_penetration=torch.zeros(6),
    )  # fmt: skip
    expected = (1.0, 0.85, 0.7 * HALFWAY, (0.15 + 0.7 * HALFWAY) * 0.3, 0.0, 1.0)
    assert value("carry", s) == close(*expected)


def test_putting_in_pays_by_the_way_and_whole_inside():
    middle = (DEPTH - WAITS) / 2
    p = cubes((middle, 0.0, 0.4), (-WAITS - 0.1, 0.0, 0.1), (DEPTH + 0.1, 0.0, 0.4), (0.12, 0.0, 0.1), (0.12, 0.0, 0.1))
    s = invented(n=5, cube={"p": p}, stages=at(3, 3, 4, 3, 2))
    assert value("put", s) == close(0.4, 0.0, 0.8, 1.0, 0.0)
    shares = [0.5, 0.0, 1.0, 1.0]
    assert PRINTED["place"].value(s).tolist() == close(*(exp(share - 1) for share in shares), 0.0)


def test_an_overlap_above_the_limit_leaves_a_share():
    limit = torch.tensor([CONFIG.penetration_limit, CONFIG.penetration_limit + 1e-4])
    s = invented(cube={"p": cubes(*[(0.12, 0.0, 0.1)] * 2)}, stages=at(3, 3), max_penetration=limit)
    assert value("put", s) == close(1.0, CONFIG.after_overlap)


@pytest.mark.parametrize("arm", [LEFT, RIGHT])
def test_reaching_pays_by_the_distance_of_thumb_and_finger(arm: str):
    """12.5 cm from the cube, and from the handle, which is a bar of 8 mm; at them; and afterwards."""
    if arm == RIGHT:
        tips = above(0.125, 0.0, 0.3)
    else:
        tips = (torch.tensor([[0.03, 0.0, 0.0]]) + along(0, *(d + 0.008 + 0.011 for d in (0.125, 0.0, 0.3))))[:, None]
        tips = tips.repeat(1, 5, 1)
    s = invented(**{arm: {"tip_p": tips}}, n=3, stages=at(0, 0, 1, arm=arm))  # pyright: ignore[reportArgumentType]
    assert value(f"reach_{arm}", s) == close(HALFWAY, 1.0, 1.0)
    assert value(f"affordance_{arm}", s) == close(exp(-4 * 5 * 0.125), 1.0, exp(-4 * 5 * 0.3))
    printed = PRINTED[f"affordance_{arm}"].value(s).tolist()
    assert printed == close(*tips.norm(dim=-1).sum(-1).mul(-4).exp().tolist())


def test_the_candidate_of_the_left_arm_counts_until_the_door_has_moved():
    far = {LEFT: {"p": along(0, 0.11, 0.11)}}
    s = invented(goals=far, door=CONFIG.open / 4 + torch.tensor([-1e-3, 1e-3]))
    assert value(f"candidate_{LEFT}", s) == pytest.approx([HALFWAY, 1.0], abs=1e-3)


def test_the_candidate_of_the_right_arm_counts_until_the_cube_is_raised_and_not_when_it_lies_inside():
    p = cubes((-0.3, 0.0, 0.1), (-0.3, 0.0, 0.1), (0.12, 0.0, 0.1))
    cube = {"p": p, "start_p": p - along(2, 0.019, 0.021, 0.0)}
    s = invented(n=3, cube=cube, goals={RIGHT: {"p": along(0, 0.11, 0.11, 0.11)}})
    assert value(f"candidate_{RIGHT}", s) == pytest.approx([HALFWAY, 1.0, 1.0], abs=1e-3)


EDGES = {
    (0.02 + 0.03, 0.0, 0.1): (1.0, 0.0, 0.0), (0.32, 0.0, 0.1): (-1.0, 0.0, 0.0), (0.12, 0.18, 0.1): (0.0, -1.0, 0.0),
    (0.12, -0.18, 0.1): (0.0, 1.0, 0.0), (0.12, 0.0, 0.02): (0.0, 0.0, 1.0), (0.12, 0.0, 0.28): (0.0, 0.0, -1.0),
}  # fmt: skip
"""Places at which a cube of 6 cm begins to be inside, and the way that leads inside."""


@pytest.mark.parametrize("place", EDGES)
def test_a_cube_is_inside_from_half_an_edge_behind_the_front_and_between_the_walls(place: tuple[float, float, float]):
    near, far = ([x + side * 1e-3 * way for x, way in zip(place, EDGES[place], strict=True)] for side in (1, -1))
    p = cubes((near[0], near[1], near[2]), (far[0], far[1], far[2]))
    assert inside(invented(cube={"p": p}).of(RIGHT)).tolist() == [True, False]


def test_hands_are_out_in_front_of_the_front_plane():
    """By a millimetre, with each wrist and with one fingertip."""
    beyond, before = in_world(0.001, 0.3, 0.1, n=1), in_world(-0.001, 0.3, 0.1, n=1)
    far = in_world(-0.4, 0.0, 0.1, n=1)
    for place, expected in ((beyond, False), (before, True)):
        tips = out(1)["tip_p"].clone()
        tips[:, 3] = place
        for right, left in (({"wrist_p": place}, {}), ({}, {"wrist_p": place}), ({"tip_p": tips}, {})):
            s = invented(n=1, right=out(1) | right, left={"wrist_p": far} | left)
            assert hands_out(s).tolist() == [expected]


@pytest.mark.parametrize(("speed", "expected"), [(0.9, True), (1.1, False)])
@pytest.mark.parametrize("angle", [-1e-3, 1e-3])
def test_the_cube_lies_inside_at_rest_with_the_door_open(speed: float, expected: bool, angle: float):
    cube = {"p": cubes((0.12, 0.0, 0.05)), "v": along(0, speed * CONFIG.rest_speed)}
    left = {"wrist_p": in_world(-0.3, 0.2, 0.1, n=1)}
    s = invented(n=1, right=out(1), left=left, cube=cube, door=torch.tensor([CONFIG.open + angle]))
    assert STAGES[RIGHT][-1].done(s.of(RIGHT)).tolist() == [expected and angle > 0]


def test_a_cube_that_slips_out_of_the_hand_inside_is_not_lost():
    """And one that slips out of it before the cavity is; one that is held is not."""
    p = cubes((0.12, 0.0, 0.05), (-0.1, 0.0, 0.1), (-0.1, 0.0, 0.1))
    tips = p[:, None].repeat(1, 5, 1) + torch.tensor([0.5, 0.5, 0.0])[:, None, None]
    put_in = STAGES[RIGHT][3]
    assert put_in.lost is not None
    assert put_in.lost(invented(n=3, cube={"p": p}, right={"tip_p": tips}).of(RIGHT)).tolist() == [False, True, False]


@pytest.mark.parametrize(("away", "expected"), [(1.19, False), (1.21, True)])
def test_a_cube_may_be_carried_twice_as_far_as_others_before_it_counts_as_knocked_away(away: float, expected: bool):
    cube: dict[str, Any] = {"p": torch.tensor([[away * cos(YAW), away * sin(YAW), 0.1]])}
    assert mdp.failed(invented(n=1, cube=cube), memory(1)).tolist() == [expected]
    fallen = {"p": along(2, -0.051)}
    assert mdp.failed(invented(n=1, cube=fallen), memory(1)).tolist() == [True]
