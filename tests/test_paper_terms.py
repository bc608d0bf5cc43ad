"""The printed reward of every task: each term grows in its direction, in its stages, and stays in bounds."""

from collections.abc import Callable
from typing import Any

import pytest
import torch
from invented import extension, invented
from invented_microwave import in_world
from invented_microwave import invented as two_arms
from torch import Tensor

from dora.geometry.rotations import quaternion_from_rotation_vector
from dora.tasks import cube, jug
from dora.tasks.hammer import mdp as hammer
from dora.tasks.hammer.snapshot import HammerSnapshot
from dora.tasks.hammer.task import HammerConfig
from dora.tasks.mdp.rewards import Term
from dora.tasks.microwave import mdp as microwave
from dora.tasks.microwave.snapshot import LEFT, RIGHT
from dora.tasks.microwave.task import MicrowaveConfig

TERMS: dict[str, dict[str, Term[Any]]] = {
    "cube": cube.paper_terms(cube.CubeConfig()).terms,
    "jug": jug.paper_terms(jug.JugConfig()).terms,
    "hammer": hammer.paper_terms(HammerConfig()).terms,
    "microwave": microwave.paper_terms(MicrowaveConfig()).terms,
}
Pair = dict[str, Any]
"""Fields of two states, the worse one first."""


def heights(worse: float, better: float) -> Tensor:
    return torch.tensor([[0.0, 0.0, worse], [0.0, 0.0, better]])


def tips(worse: float, better: float) -> Tensor:
    return heights(worse, better)[:, None].repeat(1, 5, 1)


def jug_state(**given: Tensor) -> Any:
    half = torch.as_tensor(jug.jug().mesh.extents / 2, dtype=torch.float32)
    return invented(2, object_half=half.repeat(2, 1), **given)


def hammer_state(**given: Tensor) -> Any:
    ends = {name: torch.tensor([[0.0, 0.0, z]]).repeat(2, 1) for name, z in (("butt", -0.2), ("neck", 0.0))}
    still = dict.fromkeys(("nail_depth", "nail_driven", "drift_p", "drift_r", "turned", "way"), torch.zeros(2))
    fixed = {"face": torch.tensor([[0.04, 0.0, 0.04]]).repeat(2, 1), "nail_p": torch.zeros(2, 3)}
    return extension(HammerSnapshot, 2, **(ends | still | fixed | given))


STATES: dict[str, Callable[..., Any]] = {
    "cube": lambda **given: invented(2, **given), "jug": jug_state, "hammer": hammer_state, "microwave": two_arms,
}  # fmt: skip


def on(stage: int) -> dict[str, Tensor]:
    return {"stage": torch.full((2,), stage)}


def of_arm(arm: str, stage: int) -> dict[str, Any]:
    stages = {each: torch.full((2,), stage if each == arm else 0) for each in (LEFT, RIGHT)}
    return {"stages": stages}


EFFORT: Pair = {"action": torch.stack([torch.full((26,), 0.1), torch.full((26,), 0.5)])}
GRASP: Pair = {"wrist_p": heights(0.0, 0.15), "goal_p": heights(0.2, 0.2)}
"""The wrist is below the candidate, and rises to it."""
LIFT: Pair = {"object_p": heights(0.02, 0.08)}
UPSIDE = quaternion_from_rotation_vector(torch.tensor([[0.0, 0.2, 0.0], [0.0, 1.5, 0.0]]))
"""The striking axis nearly level, then nearly down."""
BETTER: dict[str, dict[str, Any]] = {
    "cube": {
        "affordance": ({"tip_p": tips(0.3, 0.1)}, {}, None),
        "grasp": (GRASP, on(1), on(2)),
        "lift": (LIFT, on(2), on(1)),
        "penalty": (EFFORT, {}, None),
    },
    "jug": {
        "affordance": ({"tip_p": tips(0.4, 0.2)}, {}, None),
        "grasp": (GRASP, on(1), on(2)),
        "lift": (LIFT, on(2), on(1)),
        "penalty": (EFFORT, {}, None),
    },
    "hammer": {
        "affordance": ({"tip_p": tips(0.3, 0.0)}, {}, None),
        "grasp": (GRASP, on(1), on(2)),
        "orient": ({"object_q": UPSIDE}, on(2), on(1)),
        "strike": ({"nail_driven": torch.tensor([0.002, 0.006])}, {}, None),
        "penalty": (EFFORT, {}, None),
    },
    "microwave": {
        f"{name}_{arm}": pair
        for arm, side, body in ((LEFT, "left", "handle"), (RIGHT, "right", "cube"))
        for name, pair in (
            ("affordance", ({side: {"tip_p": tips(0.3, 0.1)}, body: {"p": torch.zeros(2, 3)}}, {}, None)),
            (
                "grasp",
                (
                    {side: {"wrist_p": heights(0.0, 0.15)}, "goals": {arm: {"p": heights(0.2, 0.2)}}},
                    of_arm(arm, 1),
                    of_arm(arm, 2),
                ),
            ),
        )
    }
    | {
        "open": ({"door": torch.tensor([0.1, 0.6])}, {}, None),
        "place": (
            {"cube": {"p": torch.stack([in_world(-0.1, 0.0, 0.1)[0], in_world(0.05, 0.0, 0.1)[0]])}},
            of_arm(RIGHT, 3),
            of_arm(RIGHT, 2),
        ),
        "penalty": (EFFORT, {}, None),
    },
}
"""By task and term: two states, the stages in which the term pays, and those in which it pays nothing."""
CASES = [(task, name) for task, terms in TERMS.items() for name in terms]


@pytest.mark.parametrize(("task", "name"), CASES)
def test_a_printed_term_grows_in_its_direction_and_in_its_stages(task: str, name: str):
    pair, paid, unpaid = BETTER[task][name]
    term = TERMS[task][name]
    worse, better = term.value(STATES[task](**pair, **paid)).tolist()
    assert 0 <= worse < better - 1e-3
    assert better <= 1
    assert term.weight == (-0.1 if term.part == "penalty" else 1.0)
    if unpaid is not None:
        assert term.value(STATES[task](**pair, **unpaid)).tolist() == [0.0, 0.0]


@pytest.mark.parametrize("task", ["cube", "jug", "hammer"])
def test_a_wrist_above_the_candidate_earns_no_more_than_one_at_it(task: str):
    at, above = TERMS[task]["grasp"].value(STATES[task](wrist_p=heights(0.2, 0.5), goal_p=heights(0.2, 0.2))).tolist()
    assert at == above == 1


@pytest.mark.parametrize("task", ["cube", "jug"])
def test_a_lift_beyond_the_target_earns_no_more(task: str):
    value = TERMS[task]["lift"].value(STATES[task](object_p=heights(0.1, 0.4), **on(2))).tolist()
    assert value == pytest.approx([1.0, 1.0], abs=1e-5)
