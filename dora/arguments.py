"""Arguments as callers write them: environments, seeds, arrays and names, made plain or refused in one sentence."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from jaxtyping import Int
from torch import Tensor

from dora.errors import InputError, shown

SEEDS = 2**32
"""Number of seeds that numpy's generators take [1]: 0 and up."""
LARGEST_SEED = 2**31 - 1
"""Largest seed that commands take [1]."""


def as_tensor(value: Any, what: str, device: torch.device | str | None = None) -> Tensor:
    """Numbers in any form as a tensor without gradient; float64 becomes float32, as in ManiSkill.

    Args:
        value: a number, a tensor, an array, or lists and tuples of those, nested at will.
        what: how messages call it.
        device: where the tensor is wanted.

    Raises:
        InputError: what it holds are not numbers, or its rows have different lengths.
    """
    if isinstance(value, list | tuple) and _holds(value, Tensor):
        value = _stacked(value, what)
    value = _dense(value, what) if isinstance(value, Tensor) else torch.from_numpy(_array(value, what))
    value = value.detach().to(device)
    return _single(value) if value.dtype == torch.float64 else value


def as_array(value: Any) -> np.ndarray:
    """A tensor on any device, or what numpy takes, as an array of its own memory."""
    return value.numpy(force=True).copy() if isinstance(value, Tensor) else np.array(value)


def _single(value: Tensor) -> Tensor:
    """Doubles as float32; finite ones that are too large become the largest one, not infinity."""
    most = torch.finfo(torch.float32).max
    return torch.where(value.isfinite(), value.clamp(-most, most), value).to(torch.float32)


def _holds(value: Any, kind: type) -> bool:
    """Whether a value is of a type, or a list or tuple that holds such a value at any depth."""
    return isinstance(value, kind) or (isinstance(value, list | tuple) and any(_holds(part, kind) for part in value))


def _stacked(value: Any, what: str) -> Tensor:
    try:
        return torch.stack([as_tensor(part, what) for part in value])
    except RuntimeError as error:
        raise InputError(f"{what} has rows of different shapes: give all rows one shape.") from error


def _dense(value: Tensor, what: str) -> Tensor:
    """A tensor of real numbers that is neither sparse, nor quantised, nor nested, and has values."""
    if value.is_meta:
        raise InputError(f"{what} is a tensor on the device meta, which holds no numbers: pass one on cpu.")
    if value.is_complex():
        raise InputError(f"{what} must be real numbers, not complex ones.")
    if value.is_quantized:
        raise InputError(f"{what} is a quantised tensor: pass what its dequantize() returns.")
    if value.is_nested:
        raise InputError(f"{what} is a nested tensor, whose rows may have different lengths: stack its rows.")
    return value if value.layout == torch.strided else value.to_dense()


def _array(value: Any, what: str) -> np.ndarray:
    """A new array of a type that torch has: native byte order, at most 64 bits, whole numbers with a sign."""
    if _holds(value, np.ma.MaskedArray):
        raise InputError(f"{what} is a masked array, whose mask would be lost: pass what its filled(...) returns.")
    try:
        array = np.asarray(value)
    except ValueError as error:
        raise InputError(f"{what} has rows of different lengths: give all rows one length.") from error
    if array.dtype.kind not in "biuf":
        raise InputError(f"{what} must be numbers, not {type(value).__name__}: pass an array or a tensor.")
    if array.dtype.kind == "u":
        if array.size and array.max() > np.iinfo(np.int64).max:
            raise InputError(f"{what} has {array.max()}: whole numbers may be at most {np.iinfo(np.int64).max}.")
        return array.astype(np.int64)
    if array.dtype.itemsize > 8:  # of more digits than torch has
        most = np.finfo(np.float64).max
        array = np.where(np.isfinite(array), array.clip(-most, most), array)
    kind = min(array.dtype.newbyteorder("="), np.dtype(np.float64)) if array.dtype.kind == "f" else array.dtype
    return array.astype(kind.newbyteorder("="))


def tensors(state: Any, what: str, device: torch.device | str | None = None) -> Any:
    """Nested mappings of numbers as nested dicts of tensors; `as_tensor` of everything else."""
    if isinstance(state, Mapping):
        return {name: tensors(part, f"{what}[{name!r}]", device) for name, part in state.items()}
    return as_tensor(state, what, device)


def taken(state: Any, index: Tensor) -> Any:
    """Rows of all tensors in nested dicts."""
    return {name: taken(part, index) for name, part in state.items()} if isinstance(state, dict) else state[index]


def is_mask(rows: Any) -> bool:
    """Whether an index of environments is a mask: a boolean for each of them."""
    dtype = rows.dtype if isinstance(rows, Tensor) else np.asarray(rows).dtype
    return dtype in (torch.bool, np.dtype(bool))


def checked_rows(rows: Any, count: int, device: torch.device | str | None = None) -> Int[Tensor, " b"]:
    """Numbers of environments, in the order given; negative ones count from the end.

    Args:
        rows: a number, or a list, tuple, range, slice, array or tensor of them, perhaps empty; or a mask (count,).
        count: how many environments there are.
        device: where the tensor is wanted.

    Raises:
        InputError: for anything else, a number out of range, or one that occurs twice.
    """
    if isinstance(rows, slice):
        return torch.arange(count, device=device)[rows]
    index = as_tensor(list(rows) if isinstance(rows, range | set) else rows, "env_idx", device)
    if index.dtype == torch.bool:
        if index.shape != (count,):
            raise InputError(
                f"env_idx is a mask of shape {tuple(index.shape)}: a mask needs one entry for each of "
                f"{count} environments."
            )
        return index.nonzero().flatten()
    if index.numel() == 0:
        return torch.zeros(0, dtype=torch.int64, device=device)
    if index.is_floating_point() or index.ndim > 1:
        raise InputError(f"env_idx must be whole numbers in one list, not {index.tolist()}.")
    numbers = index.reshape(-1).tolist()
    wrong = [number for number in numbers if not -count <= number < count]
    if wrong:
        raise InputError(f"env_idx has {wrong[0]} but the environments are 0 to {count - 1}.")
    index = index.reshape(-1).long() % count
    if len(index.unique()) < len(index):
        raise InputError(f"env_idx has an environment twice: {numbers}.")
    return index


def checked_truth(value: Any, what: str) -> bool:
    """A truth value, or 0 or 1, of Python, numpy or torch as one of Python.

    Raises:
        InputError: for anything else.
    """
    scalar = value.item() if isinstance(value, np.generic | np.ndarray | Tensor) and not value.ndim else value
    if not isinstance(scalar, bool | int | float) or scalar not in (0, 1):
        raise InputError(f"{what} must be True or False, not {shown(value)}.")
    return bool(scalar)


def checked_seeds(seed: Any, count: int) -> int | list[int] | None:
    """A seed as a Python integer, or seeds as a list of them; None stays None.

    Args:
        seed: a whole number of Python, numpy or torch, or a list, tuple, range, array or tensor of 1 or `count`.
        count: how many environments are seeded.

    Raises:
        InputError: for anything else, another number of seeds, or one that is not in 0 .. 2^32 - 1.
    """
    if seed is None:
        return None
    if isinstance(seed, np.ndarray | Tensor):
        seed = seed.tolist()
    if not isinstance(seed, list | tuple | range):
        return _checked_seed(seed)
    if len(seed) not in (1, count):
        raise InputError(f"there are {len(seed)} seeds for {count} environments: give one, or one for each.")
    return [_checked_seed(one) for one in seed]


def _checked_seed(seed: Any) -> int:
    if isinstance(seed, Tensor | np.ndarray) and seed.ndim == 0:
        seed = seed.item()
    if isinstance(seed, bool | np.bool_) or not isinstance(seed, int | np.integer):
        raise InputError(f"a seed must be a whole number, not {seed!r}.")
    if not 0 <= seed < SEEDS:
        raise InputError(f"the seed {seed} is out of range: use 0 to {SEEDS - 1}.")
    return int(seed)
