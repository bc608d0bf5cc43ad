"""Each reward term grows in the direction that it is there for; each clause of success is needed; the sum has them all.

A table of pairs of invented states: the second is better in the sense of the term and in nothing else.
"""

from collections.abc import Callable
from math import asin, cos, pi
from typing import Any

import pytest
import torch
from invented import extension, invented, memory
from torch import Tensor

from dora.geometry.rotations import quaternion_from_rotation_vector
from dora.tasks import cube, jug
from dora.tasks.hammer import mdp as hammer
from dora.tasks.hammer.snapshot import HammerSnapshot
from dora.tasks.hammer.task import HammerConfig
from dora.tasks.mdp.mdp import Mdp
from dora.tasks.mdp.rewards import Term, Terms
from dora.tasks.mdp.snapshot import Snapshot

TERMS: dict[str, dict[str, Term[Any]]] = {
    "cube": cube.terms(cube.CubeConfig()).terms,
    "jug": jug.terms(jug.JugConfig()).terms,
    "hammer": hammer.terms(HammerConfig()).terms,
}
HANDLE, BODY = (0.08, 0.0, 0.0), (-0.06, 0.0, 0.0)
"""A point on the jug's handle and one on its body, jug frame [m]."""


def jug_state(**given: Tensor) -> Snapshot:
    return invented(
        2, object_half=torch.as_tensor(jug.jug().mesh.extents / 2, dtype=torch.float32).repeat(2, 1), **given
    )


def hammer_state(**given: Tensor) -> HammerSnapshot:
    fixed = {
        "nail_p": torch.zeros(2, 3), "nail_depth": torch.zeros(2), "nail_driven": torch.zeros(2),
        "drift_p": torch.zeros(2), "drift_r": torch.zeros(2), "turned": torch.zeros(2), "way": torch.zeros(2),
        "face": torch.tensor([[0.04, 0.0, 0.04]]).repeat(2, 1),
        "butt": torch.tensor([[0.0, 0.0, -0.2]]).repeat(2, 1), "neck": torch.zeros(2, 3),
    }  # fmt: skip
    return extension(HammerSnapshot, 2, **(fixed | given))


STATES: dict[str, Callable[..., Any]] = {
    "cube": lambda **given: invented(2, **given), "jug": jug_state, "hammer": hammer_state,
}  # fmt: skip


def pair(worse: Any, better: Any) -> Tensor:
    return torch.stack([torch.as_tensor(worse), torch.as_tensor(better)])


def rows(*values: float) -> Tensor:
    return torch.tensor(values).repeat(2, 1)


def along_z(worse: float, better: float) -> Tensor:
    """Two positions (2, 3) at these heights."""
    return torch.tensor([[0.0, 0.0, worse], [0.0, 0.0, better]])


def tips(worse: float, better: float) -> Tensor:
    """Fingertips (2, 5, 3) at these heights over the origin."""
    return along_z(worse, better)[:, None].repeat(1, 5, 1)


def touching(*parts: int) -> Tensor:
    return torch.zeros(6, dtype=torch.bool).index_fill_(0, torch.tensor(parts, dtype=torch.long), True)


def voted(*points: tuple[float, float, float]) -> dict[str, Tensor]:
    """Contacts of thumb and index (2, 2, 3) at a point of the jug each."""
    return {
        "contact_p": torch.tensor(points)[:, None].repeat(1, 2, 1),
        "contact_finger": torch.tensor([[1, 2], [1, 2]]),
    }


OPPOSED, AT_HANDLE = {"touch": pair(touching(0, 1), touching(0, 1))}, voted(HANDLE, HANDLE)
UP = {"object_p": along_z(0.11, 0.11)}
TIPPED = quaternion_from_rotation_vector(torch.tensor([[0.45, 0.0, 0.0], [0.0, 0.0, 0.0]]))
"""Tilted by .45 rad, then upright."""
ACTIVE, LIFTING = (lambda k: {"stage": torch.tensor([k, k])}), {"stage": torch.tensor([2, 2])}
ORIENTING = {"stage": torch.tensor([2, 2])}
IN_HAND = {"wrist_p": rows(-0.045, 0.0, -0.25), "touch": pair(touching(0, 1, 2), touching(0, 1, 2))}
"""The middle of the hand is on the hammer's handle, three fingers touch."""
SHARED = {
    "candidate": {"goal_p": along_z(0.3, 0.1)},
    "effort": {"action": pair(torch.full((26,), 0.1), torch.full((26,), 0.5))},
    "change": {"action": pair(torch.zeros(26), torch.ones(26))},
    "penetration": {"penetration": torch.tensor([0.002, 0.004])},
}
"""The value of a penalty grows with what it punishes; its weight is negative."""
BETTER: dict[str, dict[str, dict[str, Any]]] = {
    "cube": SHARED
    | {
        "affordance": {"tip_p": tips(0.2, 0.05)},
        "reach": {"tip_p": tips(0.2, 0.05)} | ACTIVE(0),
        "grasp": {"touch": pair(touching(1, 2), touching(0, 1))} | ACTIVE(1),
        "lift": {"object_p": along_z(0.02, 0.08)} | OPPOSED | LIFTING,
        "held": {"object_p": along_z(0.09, 0.11)} | OPPOSED | LIFTING,
    },
    "jug": SHARED
    | {
        "affordance": {"tip_p": tips(0.4, 0.2)},
        "class": voted(BODY, HANDLE),
        "reach": {"tip_p": tips(0.4, 0.2)} | ACTIVE(0),
        "grasp": {"touch": pair(touching(1, 2), touching(0, 1))} | ACTIVE(1),
        "lift": UP | OPPOSED | LIFTING | voted(BODY, HANDLE),
        "held": UP | OPPOSED | LIFTING | voted(BODY, HANDLE),
        "tilt": {"object_q": TIPPED.flip(0)},
    },
    "hammer": SHARED
    | {
        "affordance": {"tip_p": tips(0.3, 0.1)},
        "catch": {"wrist_p": pair([0.5, 0.0, -0.2], [-0.045, 0.0, -0.2])},
        "still": IN_HAND | {"drift_p": torch.tensor([0.05, 0.001])},
        "orient": IN_HAND | ORIENTING | {"nail_p": along_z(0.5, 0.05)},
        "strike": {"nail_driven": torch.tensor([0.002, 0.006])},
        "driven": {"nail_driven": torch.tensor([0.009, 0.010]), "stage": torch.tensor([4, 4])},
    },
}


@pytest.mark.parametrize(("task", "name"), [(task, name) for task, terms in TERMS.items() for name in terms])
def test_a_term_grows_in_its_direction(task: str, name: str):
    worse, better = TERMS[task][name].value(STATES[task](**BETTER[task][name])).tolist()
    assert worse < better - 1e-3


@pytest.mark.parametrize("task", TERMS)
def test_what_is_better_raises_the_reward_and_what_is_punished_lowers_it(task: str):
    for name, given in BETTER[task].items():
        s, term = STATES[task](**given), TERMS[task][name]
        worse, better = (term.weight * term.value(s)).tolist()
        assert (better < worse) == (term.part == "penalty"), name
        total, parts = Terms({name: term})(s)
        torch.testing.assert_close(total, parts[name])


@pytest.mark.parametrize("task", TERMS)
def test_penalties_and_the_affordance_belong_to_their_parts_of_the_reward(task: str):
    part = {name: term.part for name, term in TERMS[task].items()}
    assert part["affordance"] == "affordance"
    assert {name for name, kind in part.items() if kind == "penalty"} >= {"effort", "change", "penetration"}


def test_holding_the_body_of_the_jug_pays_little():
    """A jug that is lifted by its body can never be a success."""
    s = jug_state(**UP, **OPPOSED, **LIFTING, **voted(BODY, HANDLE))
    body, handle = Terms(TERMS["jug"])(s)[0].tolist()
    assert body < 0.65 * handle


def test_the_reward_follows_the_active_stage():
    for task in ("cube", "jug"):
        stage = torch.tensor([0, 1])
        s = STATES[task](stage=stage, tip_p=tips(0.3, 0.3), **OPPOSED, **(AT_HANDLE if task == "jug" else {}))
        assert TERMS[task]["reach"].value(s)[1] == 1 > TERMS[task]["reach"].value(s)[0]
        assert TERMS[task]["grasp"].value(s)[0] == 0 < TERMS[task]["grasp"].value(s)[1]
        assert (TERMS[task]["lift"].value(STATES[task](object_p=along_z(0.1, 0.1), stage=stage)) == 0).all()


def test_the_penalty_is_the_printed_sum_of_squares():
    action = torch.rand(2, 26) * 2 - 1
    value = TERMS["cube"]["effort"].value(invented(2, action=action))
    torch.testing.assert_close(26 * value, action.square().sum(-1))


def test_the_printed_orientation_reward_falls_towards_alignment_and_ours_rises():
    """R_orient = -2 arcsin(2 <r, r*>^2 - 1) is smallest, -pi, where r = r*; theta = arccos(2 <r, r*>^2 - 1) is 0."""
    angles = [3.0, 2.0, 1.0, 0.5, 0.0]
    printed = [-2 * asin(2 * cos(a / 2) ** 2 - 1) for a in angles]
    assert printed == sorted(printed, reverse=True)
    assert printed[-1] == pytest.approx(-pi)
    ours = []
    for a in angles:
        turn = quaternion_from_rotation_vector(torch.tensor([[0.0, a + pi / 2, 0.0]] * 2))
        s = hammer_state(object_q=turn, stage=torch.tensor([2, 2]))
        ours.append(hammer.paper_terms(HammerConfig()).terms["orient"].value(s)[0].item())
    assert ours == sorted(ours)
    assert ours[-1] == pytest.approx(1.0, abs=1e-3)


CLAUSES: dict[str, dict[str, Any]] = {
    "stages": {"finished": False},
    "overlap": {"max_penetration": 0.0051},
    "failure": {"object_p": (0.0, 0.0, -0.2)},
    "reach": {"unreachable": True},
}


@pytest.mark.parametrize("clause", [None, *CLAUSES])
def test_every_clause_of_success_is_needed(clause: str | None):
    given = {"finished": True, "max_penetration": 0.0049, "object_p": (0.0, 0.0, 0.2), "unreachable": False}
    given |= CLAUSES.get(clause or "", {})
    c = cube.CubeConfig()
    mdp = Mdp(cube.stages(c), cube.terms(c), cube.paper_terms(c), 0.005)
    finished, unreachable = (torch.tensor([given[name]]) for name in ("finished", "unreachable"))
    s = invented(1, object_p=torch.tensor([given["object_p"]]))
    verdict = mdp.verdict(finished, unreachable, s, memory(1, max_penetration=torch.tensor([given["max_penetration"]])))
    assert verdict["success"].item() == (clause is None)
    assert verdict["raw_success"].item() == (clause in (None, "overlap"))
    assert verdict["fail"].item() == (clause in ("failure", "reach"))
