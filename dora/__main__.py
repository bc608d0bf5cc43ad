"""The command `dora`, also `python -m dora`: one word selects what to do, the rest are its options.

What does the work is imported only when it is needed, so that help and version come at once.
"""

import importlib
import operator
import sys
from collections.abc import Callable, Sequence

from dora import quiet_start
from dora.errors import BAD_INPUT, LibraryMissingError, ManiSkillMissingError, naming_libraries, suggestion
from dora.version import version_line

COMMANDS = {
    "run": "train or evaluate a learner on a task",
    "play": "watch a policy live on a web page, and disturb it",
    "demos": "record demonstrations, or episodes of a policy, as a dataset",
    "grasps": "search for grasps of an object, judge them, and store them",
    "view": "show an object, its regions and its grasps on a web page",
    "bench": "measure how fast the parts of Dora are",
    "sweep": "train all runs of a table, and go on where an earlier call stopped",
    "report": "make tables and figures of finished runs",
}
"""What `dora NAME` does; the body of each is the module `dora.commands.NAME`."""
SHELLS = ("bash", "zsh", "fish")
"""Shells for which --completion prints a script."""


def usage() -> str:
    """The text of `dora --help`."""
    width = max(map(len, COMMANDS))
    rows = "\n".join(f"  {name:<{width}}  {what}" for name, what in COMMANDS.items())
    return f"""usage: dora COMMAND [OPTIONS]

Affordance-guided dexterous manipulation on ManiSkill, with TorchRL agents.

{rows}

  dora COMMAND --help                options of a command
  dora --version                     version and commit
  dora --completion {{{",".join(SHELLS)}}}    script that completes commands and options

Examples: dora play DoraHammer-v1
          dora run --env DoraHammer-v1
"""


def start(words: Sequence[str] | None = None) -> int:
    """As `main` in a process of its own, which Ctrl-C and SIGTERM end with a line, also while it imports.

    Nor is there a traceback where nobody reads what it prints.
    """
    quiet_start.begin()
    return quiet_start.printing(lambda: main(words, quiet_start.call))


def main(words: Sequence[str] | None = None, around: Callable[[Callable[[], int]], int] = operator.call) -> int:
    """Run the command; returns the exit status.

    Args:
        words: of the command line, without the name of the program; those of the process by default.
        around: calls what does the work of the command.
    """
    first, *rest = list(sys.argv[1:] if words is None else words) or [""]
    if first in ("", "-h", "--help"):
        print(usage(), end="")
        return 0 if first else BAD_INPUT
    if first == "--version":
        print(version_line())
        return 0
    if first == "--completion":
        return _complete(rest)
    if first not in COMMANDS:
        print(f"dora has no command {first!r}: {suggestion(first, COMMANDS)}", file=sys.stderr)
        return BAD_INPUT
    sys.argv = [f"dora {first}", *rest]
    try:
        body = _body(first)
    except (LibraryMissingError, ManiSkillMissingError) as error:
        print(error, file=sys.stderr)
        return BAD_INPUT
    return around(body)


def _body(name: str) -> Callable[[], int]:
    """What does the work of a command; importing it takes seconds."""
    with naming_libraries():
        importlib.import_module("dora.registration")
        return importlib.import_module(f"dora.commands.{name}").main


def _complete(rest: Sequence[str]) -> int:
    if len(rest) != 1 or rest[0] not in SHELLS:
        print(f"--completion needs the name of a shell: {', '.join(SHELLS)}.", file=sys.stderr)
        return BAD_INPUT
    importlib.import_module("dora.registration")
    print(importlib.import_module("dora.commands.completion").script(COMMANDS, rest[0]))
    return 0


if __name__ == "__main__":
    sys.exit(start())
