"""What is earned without too much overlap, at once above the limit or falling over some more of it."""

import dataclasses
from math import nan
from typing import Any

import pytest
import torch
from invented import invented
from invented_microwave import in_world, out
from invented_microwave import invented as in_the_oven
from test_reward_values import along, by_handle, close, jugs, paid
from test_stage_clauses import hammer_state, touching

from dora.tasks import cube, jug
from dora.tasks.hammer import mdp as hammer
from dora.tasks.hammer.task import HammerConfig
from dora.tasks.mdp.terms import beyond_the_limit, without_overlap
from dora.tasks.microwave import mdp as microwave
from dora.tasks.microwave.mdp import MicrowaveConfig
from dora.tasks.microwave.snapshot import LEFT, RIGHT

LIMITS = torch.tensor([0.0, 1.0, 1.001, 2.0, 3.0, 9.0])
"""Largest overlaps of six episodes, in units of the limit."""


@pytest.mark.parametrize(
    ("grace", "left", "expected"),
    [
        (0.0, 0.0, (1, 1, 0, 0, 0, 0)), (0.0, 0.3, (1, 1, 0.3, 0.3, 0.3, 0.3)),
        (2.0, 0.0, (1, 1, 0.9995, 0.5, 0, 0)), (2.0, 0.3, (1, 1, 0.99965, 0.65, 0.3, 0.3)),
    ],
)  # fmt: skip
def test_what_is_left_after_an_overlap(grace: float, left: float, expected: tuple[float, ...]):
    c = cube.CubeConfig(penetration_limit=0.004, overlap_grace=grace)
    s = invented(6, max_penetration=0.004 * LIMITS)
    assert without_overlap(s, c, left).tolist() == close(*expected)
    assert without_overlap(invented(1, max_penetration=torch.tensor([nan])), c, left).tolist() == close(left)


def test_a_term_says_up_to_where_it_falls():
    c = cube.CubeConfig(overlap_grace=2.0)
    assert (beyond_the_limit(cube.CubeConfig()), beyond_the_limit(c)) == ("", ", falling up to 9 mm")


def _cube(deepest: float) -> Any:
    return invented(
        2, object_p=along(2, 0.2, 0.2), touch=touching(0, 1).repeat(2, 1), max_penetration=torch.full((2,), deepest)
    )


def _jug(deepest: float) -> Any:
    return jugs(2, object_p=along(2, 0.2, 0.2), max_penetration=torch.full((2,), deepest), **by_handle(2))


def _hammer(deepest: float) -> Any:
    s = hammer_state(driven=HammerConfig().nail.driven)
    s.stage.fill_(4)
    s.max_penetration.fill_(deepest)
    return s


def _microwave(deepest: float) -> Any:
    left, stages = {"wrist_p": in_world(-0.3, 0.2, 0.1)}, {LEFT: torch.full((2,), 3), RIGHT: torch.full((2,), 3)}
    cubes = {"p": in_world(0.12, 0.0, 0.05)}
    return in_the_oven(
        right=out(),
        left=left,
        cube=cubes,
        door=torch.full((2,), 1.2),
        stages=stages,
        max_penetration=torch.full((2,), deepest),
    )


TASKS: dict[str, tuple[Any, Any, Any, dict[str, float]]] = {
    "cube": (cube.terms, cube.CubeConfig(), _cube, {"held": 0.0}),
    "jug": (jug.terms, jug.JugConfig(), _jug, {"held": 0.0}),
    "hammer": (hammer.terms, HammerConfig(), _hammer, {"strike": HammerConfig().after_overlap, "driven": 0.0}),
    "microwave": (
        microwave.terms, MicrowaveConfig(), _microwave,
        {"carry": MicrowaveConfig().after_overlap, "put": MicrowaveConfig().after_overlap, "placed": 0.0},
    ),
}  # fmt: skip
"""By task: its reward, its numbers, states in which the object is where it should be, and terms with what is left."""


@pytest.mark.parametrize("task", TASKS)
def test_in_every_task_the_reward_falls_over_the_grace_and_at_once_without(task: str):
    terms, config, state, left = TASKS[task]
    within, above = (state(share * config.penetration_limit) for share in (1.0, 3.0))
    usual, graced = terms(config).terms, terms(dataclasses.replace(config, overlap_grace=4.0)).terms
    for name, rest in left.items():
        most = paid(usual[name], within)[0]
        assert most > 0
        assert paid(usual[name], above)[0] == pytest.approx(rest * most)
        assert paid(graced[name], within)[0] == most
        assert paid(graced[name], above)[0] == pytest.approx((rest + (1 - rest) / 2) * most)
        assert name == "put" or "falling up to" in graced[name].doc
        assert "falling" not in usual[name].doc
