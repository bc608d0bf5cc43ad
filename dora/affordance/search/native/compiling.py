"""Decorators that compile functions by Numba, kept on disk where that can be written."""

import inspect
from collections.abc import Callable
from typing import Any

from numba import njit

RELAXED = {"contract", "reassoc", "nsz", "arcp"}
"""Numba's fast-math flags: operations may be reordered and fused; infinities and NaN keep their meaning."""


def native(function: Callable) -> Callable:
    """A function compiled by Numba and cached on disk; decorators that check types are removed first."""
    return _compiled(function)


def inlined(function: Callable) -> Callable:
    """As `native`, for small functions in inner loops: inlined into their callers."""
    return _compiled(function, forceinline=True)


def _compiled(function: Callable, **options: Any) -> Callable:
    plain, options = inspect.unwrap(function), {"error_model": "numpy", "fastmath": RELAXED, **options}
    try:
        return njit(cache=True, **options)(plain)
    except RuntimeError:  # neither the folder of the code nor that of the user can be written: each process compiles
        return njit(**options)(plain)
