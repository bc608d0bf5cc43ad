"""How functions are compiled."""

import inspect
from collections.abc import Callable

from numba import njit

RELAXED = {"contract", "reassoc", "nsz", "arcp"}
"""Liberties with rounding; infinities keep their meaning."""


def native(function: Callable) -> Callable:
    """A function compiled by Numba, kept on disk; type checks that were put around it are left out."""
    return njit(cache=True, error_model="numpy", fastmath=RELAXED)(inspect.unwrap(function))


def inlined(function: Callable) -> Callable:
    """As `native`, for small functions in inner loops: compiled into those that call them."""
    return njit(cache=True, error_model="numpy", fastmath=RELAXED, forceinline=True)(inspect.unwrap(function))
