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

S = TypeVar("S")
"""A task's snapshot type: a frozen dataclass of tensors whose first axis is the environment."""

Part = Literal["affordance", "task", "penalty"]


@dataclass(frozen=True)
class Term(Generic[S]):
    """One addend of the reward.

    Attributes:
        value: snapshot -> dimensionless (n,) tensor in [0, 1].
        weight: share in the reward; negative for a penalty.
        part: which part of the paper's schema the term belongs to.
        guided: True if the term exists only with `guidance="affordance"`.
        doc: one sentence for the task's documentation table.
    """

    value: Callable[[S], Tensor]
    weight: float
    part: Part = "task"
    guided: bool = False
    doc: str = ""


class Terms(Generic[S]):
    """Weighted sum of named terms; knows its own bounds, so normalising needs no hand-typed maximum.

    Raises:
        ValueError: if there is no term, or the sign of a weight contradicts the term's part.
    """

    def __init__(self, terms: Mapping[str, Term[S]]):
        if not terms:
            raise ValueError("a reward needs at least one term")
        for name, term in terms.items():
            if (term.part == "penalty") != (term.weight < 0):
                raise ValueError(f"term {name!r} of part {term.part!r} cannot have the weight {term.weight}")
        self.terms = dict(terms)
        self.lower = sum(min(t.weight, 0.0) for t in self.terms.values())
        self.upper = sum(max(t.weight, 0.0) for t in self.terms.values())

    def without_guidance(self) -> "Terms[S]":
        """The same reward without the terms that affordance guidance adds."""
        return Terms({name: t for name, t in self.terms.items() if not t.guided})

    def __call__(self, s: S) -> tuple[Float[Tensor, " n"], dict[str, Float[Tensor, " n"]]]:
        """Returns the sum over all terms and each term's weighted value by name."""
        parts = {name: t.weight * t.value(s) for name, t in self.terms.items()}
        return torch.stack(list(parts.values())).sum(0), parts


def closeness(distance: Tensor, tolerance: float, reach: float) -> Tensor:
    """Shaping primitive: 1 within `tolerance`, falling smoothly to 0.1 at `tolerance + reach`.

    Both anchors are in the unit of `distance`. Raises ValueError for a negative tolerance or a reach <= 0.
    """
    if tolerance < 0 or reach <= 0:
        raise ValueError(f"need tolerance >= 0 and reach > 0, got {tolerance} and {reach}")
    scale = atanh(sqrt(0.9)) / reach
    return 1 - torch.tanh(scale * (distance - tolerance).clamp(min=0)) ** 2
