"""How learning is stopped between two gradient steps, because one batch may take minutes."""

from collections.abc import Callable

Stop = Callable[[], bool]
"""Whether no further gradient step shall be taken; once it says yes, it always does."""


def never() -> bool:
    """No: a batch is learned from to its end."""
    return False
