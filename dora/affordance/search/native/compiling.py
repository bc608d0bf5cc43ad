"""Decorators that compile functions by Numba, kept on disk."""

import inspect
from collections.abc import Callable

from numba import njit

RELAXED = {"contract", "reassoc", "nsz", "arcp"}
"""Numba's fast-math flags: operations may be reordered and fused; infinities and NaN keep their meaning."""


def native(function: Callable) -> Callable:
    """A function compiled by Numba and cached on disk; decorators that check types are removed first."""
    return njit(cache=True, error_model="numpy", fastmath=RELAXED)(inspect.unwrap(function))


def inlined(function: Callable) -> Callable:
    """As `native`, for small functions in inner loops: inlined into their callers."""
    return njit(cache=True, error_model="numpy", fastmath=RELAXED, forceinline=True)(inspect.unwrap(function))
