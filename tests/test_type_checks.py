"""Types and shapes are checked at run time, in the first calls of each function in each test."""

from dataclasses import dataclass
from typing import Any

import beartype
import pytest
import torch
import type_checks
from jaxtyping import Float, TypeCheckError
from torch import Tensor

from dora.geometry.rotations import quaternion_apply


def checked(what: Any) -> Any:
    return type_checks.of(what, typechecker=beartype.beartype)


def doubled(x: int) -> int:
    return 2 * x


@dataclass
class Pair:
    """Two numbers for each row."""

    numbers: Float[Tensor, "rows 2"]

    @classmethod
    def zeros(cls, rows: int) -> "Pair":
        return cls(torch.zeros(rows, 2))

    @property
    def first(self) -> Float[Tensor, " rows"]:
        return self.numbers


def test_functions_of_dora_are_checked():
    """Of every module: the decorator is put there when it is imported."""
    with pytest.raises(TypeCheckError):
        quaternion_apply(torch.zeros(3, 4), torch.zeros(3, 2))


def test_the_first_calls_of_each_test_are_checked():
    found = checked(doubled)
    for _ in range(2):
        type_checks.next_test()
        for _ in range(type_checks.CALLS):
            with pytest.raises(TypeCheckError):
                found("ab")
        assert found("ab") == "abab"
    assert (found.__name__, found(3)) == ("doubled", 6)


def test_fields_methods_and_properties_are_checked():
    checked(Pair)
    with pytest.raises(TypeCheckError):
        Pair(torch.zeros(3, 1))
    made = Pair(torch.zeros(3, 2))
    for call in (
        lambda: checked(vars(Pair)["first"]).fget(made),
        lambda: checked(vars(Pair)["zeros"]).__func__(Pair, "a"),
    ):
        with pytest.raises(TypeCheckError):
            call()
