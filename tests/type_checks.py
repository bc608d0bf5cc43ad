"""Checks of types and shapes at run time, in the first calls of each function in each test.

Later calls, and the import of what no test calls, cost what they cost a user. (Checks of every call, which are prepared
when a module is imported, take two fifths of the time of all tests.)
"""

import dataclasses
import functools
import inspect
from collections.abc import Callable
from typing import Any

import jaxtyping

CALLS = 3
"""Of each function that are checked in each test, and before the first one."""
checked_by_jaxtyping: Any = jaxtyping.jaxtyped
"""Checks every call, and prepares that when a module is imported."""
tests = 0
"""How many have begun."""


def next_test() -> None:
    """Check the first calls again."""
    global tests
    tests += 1


def install() -> None:
    """Take the place of the decorator that is put on all functions and classes that are imported from now on."""
    jaxtyping.jaxtyped = decorator  # pyright: ignore


def decorator(*, typechecker: Callable[..., Any]) -> Callable[[Any], Any]:
    """What `jaxtyping.jaxtyped` is called with, and gives."""
    return functools.partial(of, typechecker=typechecker)


def of(what: Any, typechecker: Callable[..., Any]) -> Any:
    """A function, method or property whose first calls are checked, or a class whose fields are (a dataclass)."""
    if inspect.isclass(what):
        made = what.__init__
        if dataclasses.is_dataclass(what) and not hasattr(made, "first_calls"):
            what.__init__ = _function(made, typechecker)
        return what
    if isinstance(what, classmethod | staticmethod):
        return type(what)(_function(what.__func__, typechecker))
    if isinstance(what, property):
        return property(*(f and _function(f, typechecker) for f in (what.fget, what.fset, what.fdel)))
    return _function(what, typechecker)


def _function(function: Callable[..., Any], typechecker: Callable[..., Any]) -> Any:
    checked: Any = None
    seen, left = -1, 0

    @functools.wraps(function)
    def first_calls(*args: Any, **kwargs: Any) -> Any:
        nonlocal checked, seen, left
        if seen != tests:
            seen, left = tests, CALLS
        if not left:
            return function(*args, **kwargs)
        left -= 1
        if checked is None:
            checked = checked_by_jaxtyping(function, typechecker=typechecker)
        return checked(*args, **kwargs)

    made: Any = first_calls
    made.first_calls = True
    return made
