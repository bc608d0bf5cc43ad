"""The exceptions that Dora raises for what people can correct, and for runs that fail; values and hints in messages."""

import contextlib
import difflib
import functools
import reprlib
import sys
from collections.abc import Callable, Iterable, Iterator
from typing import Any, ParamSpec

RECORDS = "DORA_NONFINITE"
"""Environment variable with the folder for the last states of simulations that were not finite."""
LONGEST = 1200
"""Characters of a message above which its middle is left out."""
BAD_INPUT, FAILED = 2, 1
"""Exit status of a command after an `InputError`, and after a `RunFailure`."""
LONGEST_VALUE, DEEPEST_VALUE = 80, 3
"""Characters and levels of a value in a message, beyond which it is cut."""

P = ParamSpec("P")
"""Arguments of a command."""


def one_line(message: str) -> str:
    """A message as a terminal shows it in one line: line breaks and other characters that it does not show are written
    as escapes, and the middle of a long one is left out."""
    shown = "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in message)
    half = LONGEST // 2
    return shown if len(shown) <= LONGEST else f"{shown[:half]} ... {shown[-half:]}"


class InputError(ValueError):
    """Bad input: the message is one sentence that says what is wrong and how to mend it.

    Commands (`command`) print it without a traceback and end with exit status 2. Line breaks and other characters that
    a terminal does not show, which names of files and texts in them may have, are written as escapes.
    """

    def __init__(self, message: str) -> None:
        super().__init__(one_line(message))


class ManiSkillMissingError(ModuleNotFoundError):
    """ManiSkill is not installed: the message says how to add it. Commands print it without a traceback."""

    def __init__(self) -> None:
        super().__init__(
            "ManiSkill is not installed: add it by `pip install --no-deps mani-skill==3.0.1` (pip leaves it out on "
            "Python 3.13, where mplib 0.1.1, which it asks for and Dora does not use, has no wheel).",
            name="mani_skill",
        )


class LibraryMissingError(ImportError):
    """A library of the system is missing: the message says how to add it. Commands print it without a traceback."""

    def __init__(self, reason: str) -> None:
        super().__init__(
            f"A library of the system is missing ({one_line(reason)}): SAPIEN and OpenCV load some that a bare machine "
            "lacks; on Debian and Ubuntu `apt-get install libgl1 libx11-6 libglib2.0-0` adds them."
        )


@contextlib.contextmanager
def naming_libraries() -> Iterator[None]:
    """Imports whose errors are `LibraryMissingError` where a library of the system is missing."""
    try:
        yield
    except ImportError as error:
        if "cannot open shared object file" in str(error) and not isinstance(error, LibraryMissingError):
            raise LibraryMissingError(str(error)) from error
        raise


class RunFailure(RuntimeError):
    """A run or its workers cannot go on, though the input is good: the message is one sentence that says why.

    Commands print it without a traceback, those that train with the command that resumes, and end with exit status 1.
    Line breaks are written as escapes, as in an `InputError`.
    """

    def __init__(self, message: str) -> None:
        super().__init__(one_line(message))


class WorkerFailure(RunFailure):
    """A worker process died, hangs, or raised something; this process is well."""


class _Short(reprlib.Repr):
    """Short texts of values, of those too that have no `repr`."""

    def repr1(self, x: Any, level: int) -> str:
        """The text of a value in a value; its type in place of a `repr` that fails, as that of a huge integer does."""
        try:
            return super().repr1(x, level)
        except Exception:  # whatever the class of the value raises
            return f"<{type(x).__name__}>"


def shown(value: object) -> str:
    """A value as a message shows it: its `repr`, cut to a few dozen characters and a few levels; its type if it has
    none."""
    short = _Short()
    short.maxstring = short.maxother = LONGEST_VALUE
    short.maxlevel = DEEPEST_VALUE
    return short.repr(value)


def suggestion(name: Any, known: Iterable[str], otherwise: str = "") -> str:
    """What a message about an unknown name ends with: the nearest known name, or all of them.

    Args:
        name: what was asked for.
        known: the names there are.
        otherwise: said in place of all names where none is near, because there are too many to list.
    """
    names = list(known)
    near = difflib.get_close_matches(str(name), names, 1)
    return f"did you mean {near[0]!r}?" if near else otherwise or f"choose one of {', '.join(names)}."


def said(kind: str, message: object) -> str:
    """The end of a sentence that tells of an exception: its kind and what it said, if anything, with one full stop."""
    text = str(message).strip().rstrip(".")
    return f"{kind}: {text}." if text else f"{kind}."


def command(body: Callable[P, int | None]) -> Callable[P, int]:
    """Decorates what a command does: returns its exit status, 0 for None; bad input is printed, and ends with 2, what
    cannot go on is printed, and ends with 1."""

    @functools.wraps(body)
    def run(*args: P.args, **kwargs: P.kwargs) -> int:
        """What `body` does, as an exit status."""
        try:
            return body(*args, **kwargs) or 0
        except InputError as error:
            print(error, file=sys.stderr)
            return BAD_INPUT
        except RunFailure as error:
            print(error, file=sys.stderr)
            return FAILED
        except BrokenPipeError:
            raise  # of the reader of what is printed
        except OSError as error:
            if error.filename is None:
                raise
            print(one_line(f"{error.filename!r} cannot be used: {error.strerror}."), file=sys.stderr)
            return BAD_INPUT

    return run
