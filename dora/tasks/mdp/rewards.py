"""Named reward terms: pure functions of a task snapshot, weighted, summed and logged one by one.

The schema is R = w_a R_affordance + w_t R_task - w_p R_penalty (paper, section "Object Affordance-Aware Reward
Design"): every term belongs to one of the three parts, and its weight carries the part's sign.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from math import atanh, sqrt
from typing import Generic, Literal, TypeVar

import torch
from jaxtyping import Float
from torch import Tensor

from dora.errors import InputError
from dora.tasks.mdp.guidance_parts import REWARD, exists

S = TypeVar("S")
"""A task's snapshot type: a frozen dataclass of tensors whose first axis is the environment."""

Part = Literal["affordance", "task", "penalty"]
"""Parts of the schema; the weight of a penalty is negative, or 0 where a run does without it."""


@dataclass(frozen=True)
class Term(Generic[S]):
    """One addend of the reward.

    Attributes:
        value: snapshot -> dimensionless (n,) tensor in [0, 1].
        weight: share in the reward; not positive for a penalty, not negative for others.
        part: which part of the paper's schema the term belongs to.
        guided: True if the term exists only with guidance.
        region: True if it exists only with `guidance="affordance"`, because it knows the object's regions.
        doc: one sentence for the task's documentation table.
    """

    value: Callable[[S], Tensor]
    weight: float
    part: Part = "task"
    guided: bool = False
    doc: str = ""
    region: bool = False


class Terms(Generic[S]):
    """Weighted sum of named terms; knows its own bounds, so normalising needs no hand-typed maximum.

    Raises:
        ValueError: if there is no term.
        InputError: the sign of a weight contradicts the term's part.
    """

    def __init__(self, terms: Mapping[str, Term[S]]):
        if not terms:
            raise ValueError("a reward needs at least one term")
        for name, term in terms.items():
            if term.weight > 0 if term.part == "penalty" else term.weight < 0:
                wrong = "above" if term.part == "penalty" else "below"
                raise InputError(
                    f"the weight of the {term.part} term {name!r} is {term.weight}; it cannot be {wrong} 0."
                )
        self.terms = dict(terms)
        self.lower = sum(min(t.weight, 0.0) for t in self.terms.values())
        self.upper = sum(max(t.weight, 0.0) for t in self.terms.values())

    def in_force(self, parts: frozenset[str]) -> "Terms[S]":
        """The same reward with those terms alone that exist with these parts of guidance."""
        kept = {n: t for n, t in self.terms.items() if exists(REWARD if t.guided else None, t.region, parts)}
        return Terms(kept)

    def __call__(self, s: S) -> tuple[Float[Tensor, " n"], dict[str, Float[Tensor, " n"]]]:
        """Returns the sum over all terms and each term's weighted value by name."""
        parts = {name: t.weight * t.value(s) for name, t in self.terms.items()}
        return torch.stack(list(parts.values())).sum(0), parts


def tolerance(
    x: Tensor, bounds: tuple[float, float] = (0.0, 0.0), margin: float = 0.0, value_at_margin: float = 0.1
) -> Tensor:
    """Shaping primitive with the name and arguments of dm_control's, whose sigmoid is "tanh_squared".

    1 within `bounds`, falling smoothly to `value_at_margin` at `margin` outside of them; with `margin` 0 it is 0 there.
    Bounds and margin are in the unit of `x`.

    Raises:
        ValueError: for a lower bound above the upper one, a negative margin or a value at the margin outside (0, 1).
    """
    lower, upper = bounds
    if lower > upper or margin < 0 or not 0 < value_at_margin < 1:
        raise ValueError(f"need lower <= upper, margin >= 0 and 0 < value_at_margin < 1, got {bounds}, {margin}")
    outside = torch.maximum(lower - x, x - upper).clamp(min=0)
    if margin == 0:
        return (outside == 0).to(x.dtype)
    scale = atanh(sqrt(1 - value_at_margin)) / margin
    return 1 - torch.tanh(scale * outside) ** 2
