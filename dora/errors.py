"""The exceptions that Dora raises for what people can correct, and for runs that fail; values as messages show them."""

import functools
import reprlib
import sys
from collections.abc import Callable
from typing import ParamSpec

RECORDS = "DORA_NONFINITE"
"""Environment variable with the folder for the last states of simulations that were not finite."""
LONGEST = 1200
"""Characters of a message above which its middle is left out."""
BAD_INPUT = 2
"""Exit status of a command after an `InputError`."""
LONGEST_VALUE, DEEPEST_VALUE = 80, 3
"""Characters and levels of a value in a message, beyond which it is cut."""

P = ParamSpec("P")
"""Arguments of a command."""


class InputError(ValueError):
    """Bad input: the message is one sentence that says what is wrong and how to mend it.

    Commands (`command`) print it without a traceback and end with exit status 2. Line breaks and other characters that
    a terminal does not show, which names of files and texts in them may have, are written as escapes.
    """

    def __init__(self, message: str) -> None:
        shown = "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in message)
        half = LONGEST // 2
        super().__init__(shown if len(shown) <= LONGEST else f"{shown[:half]} ... {shown[-half:]}")


class ManiSkillMissingError(ModuleNotFoundError):
    """ManiSkill is not installed: the message says how to add it. Commands print it without a traceback."""

    def __init__(self) -> None:
        super().__init__(
            "ManiSkill is not installed: add it by `pip install --no-deps mani-skill==3.0.1` (pip leaves it out on "
            "Python 3.13, where mplib 0.1.1, which it asks for and Dora does not use, has no wheel).",
            name="mani_skill",
        )


def shown(value: object) -> str:
    """A value as a message shows it: its `repr`, cut to a few dozen characters and a few levels."""
    short = reprlib.Repr()
    short.maxstring = short.maxother = LONGEST_VALUE
    short.maxlevel = DEEPEST_VALUE
    return short.repr(value)


def command(body: Callable[P, int | None]) -> Callable[P, int]:
    """Decorates what a command does: returns its exit status, 0 for None; bad input is printed, and ends with 2."""

    @functools.wraps(body)
    def run(*args: P.args, **kwargs: P.kwargs) -> int:
        try:
            return body(*args, **kwargs) or 0
        except InputError as error:
            print(error, file=sys.stderr)
            return BAD_INPUT

    return run


class RunFailure(RuntimeError):
    """A run cannot go on, but can be resumed: the message is one sentence that says why.

    Scripts print it without a traceback, with the command that resumes, and end with exit status 1.
    """


class WorkerFailure(RunFailure):
    """A worker process died, hangs, or raised something; this process is well."""
