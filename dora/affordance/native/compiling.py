"""How functions are compiled."""

import inspect
from collections.abc import Callable

from numba import njit


def native(function: Callable) -> Callable:
    """A function compiled by Numba, kept on disk; type checks that were put around it are left out."""
    return njit(cache=True, error_model="numpy")(inspect.unwrap(function))
