"""Decorators that compile functions by Numba, kept on disk where that can be written.

Numba looks at a function's own file alone, and compiled code holds the constants and functions of others that it uses.
So what is kept belongs to the text of all files that may go into it.
"""

import hashlib
import inspect
from collections.abc import Callable, Iterable
from functools import cache
from pathlib import Path
from typing import Any

from numba import njit
from numba.core import config

import dora.affordance.objects.signed_distance

SOURCES = (Path(__file__).parents[1], Path(dora.affordance.objects.signed_distance.__file__))
"""Folder and file whose text may go into compiled functions."""
SETTINGS: Any = config
"""Of Numba, which makes their names while it is imported."""
DIGITS = 16
"""Hexadecimal digits of the digest of these texts."""

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
    usual = SETTINGS.CACHE_DIR
    kept = Path(usual) if usual else Path(__file__).parent / "__pycache__"
    SETTINGS.CACHE_DIR = str(kept / f"numba-{_own_digest()}")  # read when a function is decorated
    try:
        return njit(cache=True, **options)(plain)
    except RuntimeError:  # neither the folder of the code nor that of the user can be written: each process compiles
        return njit(**options)(plain)
    finally:
        SETTINGS.CACHE_DIR = usual


@cache
def _own_digest() -> str:
    return digest_of_sources(SOURCES)


def digest_of_sources(places: Iterable[Path]) -> str:
    """Digest of the Python files at some places: files, or all below folders."""
    found = hashlib.sha256()
    for place in places:
        for path in [place] if place.is_file() else sorted(place.rglob("*.py")):
            found.update(f"{path.name} {path.stat().st_size}\n".encode() + path.read_bytes())
    return found.hexdigest()[:DIGITS]
