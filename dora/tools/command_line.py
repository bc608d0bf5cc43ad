"""What must be read from a command line before the rest, because the defaults of the rest depend on it."""

from collections.abc import Sequence
from typing import Any, TypeVar

import tyro

HELP = frozenset({"-h", "--help"})
"""Words that ask for help."""
OF_TYRO = "--tyro-"
"""Beginning of the options that tyro has by itself, which are about the whole line."""
Form = TypeVar("Form")
"""A dataclass of options."""


def read_some(form: type[Form], words: Sequence[str]) -> Form:
    """The options that a form has, read from a command line that holds others as well.

    Tyro reads them, as it will read the whole line: `--a-b 1`, `--a_b 1` and `--a-b=1` are the same, and of several the
    last one counts.

    Args:
        form: a dataclass whose fields all have defaults.
        words: of the command line; a wish for help is left to the reading of the whole.
    """
    if any(word.startswith(OF_TYRO) for word in words):
        return form()
    read: Any = tyro.cli(form, args=[word for word in words if word not in HELP], return_unknown_args=True)
    return read[0]
