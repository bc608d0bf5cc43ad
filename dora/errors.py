"""The exceptions that Dora raises for what people can correct, and for runs that fail; values as messages show them."""

import reprlib

RECORDS = "DORA_NONFINITE"
"""Environment variable with the folder for the last states of simulations that were not finite."""
LONGEST = 1200
"""Characters of a message above which its middle is left out."""
LONGEST_VALUE, DEEPEST_VALUE = 80, 3
"""Characters and levels of a value in a message, beyond which it is cut."""


class InputError(ValueError):
    """Bad input: the message is one sentence that says what is wrong and how to mend it.

    Scripts print it without a traceback and end with exit status 2. Line breaks and other characters that a terminal
    does not show, which names of files and texts in them may have, are written as escapes.
    """

    def __init__(self, message: str) -> None:
        shown = "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in message)
        half = LONGEST // 2
        super().__init__(shown if len(shown) <= LONGEST else f"{shown[:half]} ... {shown[-half:]}")


def shown(value: object) -> str:
    """A value as a message shows it: its `repr`, cut to a few dozen characters and a few levels."""
    short = reprlib.Repr()
    short.maxstring = short.maxother = LONGEST_VALUE
    short.maxlevel = DEEPEST_VALUE
    return short.repr(value)


class RunFailure(RuntimeError):
    """A run cannot go on, but can be resumed: the message is one sentence that says why.

    Scripts print it without a traceback, with the command that resumes, and end with exit status 1.
    """


class WorkerFailure(RunFailure):
    """A worker process died, hangs, or raised something; this process is well."""
