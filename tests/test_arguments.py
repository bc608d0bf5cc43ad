"""Environments, seeds, numbers and names as callers write them."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch

from dora.arguments import as_tensor, checked_rows, checked_seeds, tensors
from dora.errors import InputError, suggestion

COUNT = 4


@pytest.mark.parametrize(
    ("rows", "wanted"),
    [
        ([2, 0], [2, 0]),
        ((1,), [1]),
        (range(1, 3), [1, 2]),
        (3, [3]),
        (slice(None), [0, 1, 2, 3]),
        (np.array([0, 2], np.uint8), [0, 2]),
        (np.int64(1), [1]),
        (torch.tensor([-1], dtype=torch.int32), [3]),
        (np.array([True, False, False, True]), [0, 3]),
        ([False, True, False, False], [1]),
        (torch.zeros(COUNT, dtype=torch.bool), []),
        ([], []),
        (np.array([]), []),
        ([np.int64(1), torch.tensor(2)], [1, 2]),
    ],
)
def test_environments_are_named_in_any_form(rows: Any, wanted: list[int]):
    found = checked_rows(rows, COUNT)
    assert found.dtype == torch.int64
    assert found.tolist() == wanted


@pytest.mark.parametrize(
    ("rows", "words"),
    [
        ([4], "has 4 but the environments are 0 to 3"),
        ([-5], "has -5"),
        ([1, -3], "twice"),
        ([0.5], "whole numbers"),
        ("all", "must be numbers, not str"),
        ([[0, 1]], "in one list"),
        (np.ones(3, bool), "mask of shape"),
        ([[0], [1, 2]], "different lengths"),
    ],
)
def test_environments_that_are_not_there_are_refused_in_one_sentence(rows: Any, words: str):
    with pytest.raises(InputError, match=words) as error:
        checked_rows(rows, COUNT)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("seed", "wanted"),
    [
        (None, None),
        (7, 7),
        (np.uint32(2**32 - 1), 2**32 - 1),
        (np.array(3), 3),
        (torch.tensor(3), 3),
        (np.arange(COUNT, dtype=np.uint64), [0, 1, 2, 3]),
        (torch.arange(COUNT), [0, 1, 2, 3]),
        (range(COUNT), [0, 1, 2, 3]),
        ([np.int64(1), 2, torch.tensor(3), np.array(4)], [1, 2, 3, 4]),
        ((5,), [5]),
    ],
)
def test_seeds_become_numbers_of_python(seed: Any, wanted: Any):
    found = checked_seeds(seed, COUNT)
    assert found == wanted
    assert all(type(one) is int for one in (found if isinstance(found, list) else [found or 0]))


@pytest.mark.parametrize(
    ("seed", "words"),
    [
        (-1, "out of range"),
        (2**32, "out of range"),
        (1.5, "whole number"),
        (True, "whole number"),
        ("1", "whole number"),
        ([1, 2], "2 seeds for 4 environments"),
        ([1, 2, 3, None], "whole number"),
        (np.zeros((2, 2), int), "2 seeds for 4"),
    ],
)
def test_seeds_of_another_kind_are_refused_in_one_sentence(seed: Any, words: str):
    with pytest.raises(InputError, match=words) as error:
        checked_seeds(seed, COUNT)
    assert "\n" not in str(error.value)


def test_numbers_of_any_form_become_tensors_without_gradient():
    wanted = torch.tensor([[1.0, 2.0], [3.0, 4.0]])
    learned = wanted.clone().requires_grad_()
    forms = [
        [[1.0, 2.0], [3.0, 4.0]], np.array([[1.0, 2.0], [3.0, 4.0]]), wanted.double(), learned,
        [np.array([1.0, 2.0]), np.array([3.0, 4.0])], [*learned], [[*learned[0]], [*learned[1]]],
    ]  # fmt: skip
    for form in forms:
        found = as_tensor(form, "it")
        assert found.dtype == torch.float32
        assert not found.requires_grad
        assert torch.equal(found, wanted)
    assert as_tensor(np.array([1, 2], np.uint16), "it").tolist() == [1, 2]
    assert tensors({"a": {"b": [1]}}, "state")["a"]["b"].tolist() == [1]
    for wrong in ("x", [None], object(), torch.zeros(1, dtype=torch.complex64), [torch.zeros(1), torch.zeros(2)]):
        with pytest.raises(InputError, match="it "):
            as_tensor(wrong, "it")


@pytest.mark.parametrize(
    "form",
    [
        np.array([1, 2], ">f4"),
        np.array([1, 2], ">f8"),
        np.array([1, 2], np.longdouble),
        torch.tensor([1.0, 2.0]).to_sparse(),
        [torch.tensor(1.0).to_sparse(), torch.tensor(2.0)],
    ],
)
def test_numbers_of_any_type_become_tensors(form: Any):
    found = as_tensor(form, "it")
    assert torch.equal(found, torch.tensor([1.0, 2.0]))
    assert (found.dtype, found.layout) == (torch.float32, torch.strided)


def test_whole_numbers_of_any_byte_order_become_tensors():
    assert checked_rows(np.array([1, 0], ">i8"), COUNT).tolist() == [1, 0]
    assert as_tensor(np.array([1, 2], ">u2"), "it").dtype == torch.int64
    big = as_tensor(np.array([1, -1]) * np.longdouble("1e400"), "it")
    assert big.isfinite().all()  # as of a double that is too large
    assert big.sign().tolist() == [1, -1]


@pytest.mark.filterwarnings("ignore::UserWarning")
@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: np.ma.array([1.0, 2.0], mask=[False, True]), "masked array"),
        (lambda: [np.ma.array([1.0], mask=[True])], "masked array"),
        (lambda: torch.quantize_per_tensor(torch.zeros(2), 0.1, 0, torch.qint8), "quantised"),
        (lambda: torch.nested.nested_tensor([torch.zeros(2), torch.zeros(3)]), "nested"),
        (lambda: torch.zeros(2, device="meta"), "device meta"),
        (lambda: [torch.zeros(2, device="meta")], "device meta"),
        (lambda: np.array([2**63], np.uint64), "at most 9223372036854775807"),
        (lambda: (number for number in [1]), "must be numbers, not generator"),
    ],
)
def test_numbers_that_no_tensor_holds_are_refused_in_one_sentence(make: Callable[[], Any], words: str):
    with pytest.raises(InputError, match=words) as error:
        as_tensor(make(), "it")
    assert "\n" not in str(error.value)


def test_a_changed_array_does_not_change_the_tensor():
    array = np.zeros(2, np.float32)
    made = as_tensor(array, "it")
    array[0] = 1
    assert made.tolist() == [0, 0]


def test_the_nearest_name_is_suggested():
    assert suggestion("stat", ["state", "none"]) == "did you mean 'state'?"
    assert suggestion("xyz", ["state", "none"]) == "choose one of state, none."
    assert suggestion("xyz", ["state", "none"], "see the page.") == "see the page."
