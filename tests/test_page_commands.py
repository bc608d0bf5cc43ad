"""The commands that README and docs show are understood: names of tasks, options and stored runs."""

import re
import shlex
from pathlib import Path

import pytest

from dora.commands import run
from dora.errors import InputError
from dora.tasks import task_ids

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
COMMAND = re.compile(
    r"^ *(?:dora run|python experiments/run\.py) ([^\n#`|]*)|`(?:dora run|python experiments/run\.py) ([^`\n]*)`", re.M
)
"""A line of a block, or words between back quotes; what follows a # or a | is no part of it."""
PLACEHOLDER = re.compile(r"\b[A-Z][A-Z_]+\b|\.\.\.|…|<|\[|\bruns/|&&|--help|\\$")
"""What stands for something that the reader has and this checkout has not, and lines that go on."""


def commands(page: Path) -> list[str]:
    """The words after `dora run` of each command on a page that can be run as it stands; one that names options alone
    is of any task."""
    found = ["".join(match).strip() for match in COMMAND.findall(page.read_text())]
    whole = [words for words in found if words and not PLACEHOLDER.search(words)]
    return [words if set(words.split()) & set(run.ENTRANCES) else f"--env DoraCube-v1 {words}" for words in whole]


SHOWN = [(page, words) for page in PAGES for words in dict.fromkeys(commands(page))]


@pytest.mark.parametrize(("page", "words"), SHOWN, ids=[f"{page.name}: {words}" for page, words in SHOWN])
def test_a_command_of_a_page_is_understood(page: Path, words: str, monkeypatch: pytest.MonkeyPatch):
    """Its options arrive: task, learner and seed are those that it names."""
    monkeypatch.chdir(ROOT)
    given = shlex.split(words)
    args = run.parse(given)
    named = {name: given[given.index(f"--{name}") + 1] for name in ("env", "agent", "seed") if f"--{name}" in given}
    assert {name: str(getattr(args.run, name)) for name in named} == named
    assert args.eval_only == ("--eval-only" in given)
    assert args.run.env in task_ids()


def test_most_commands_are_looked_at():
    assert len(SHOWN) > 35
    assert {"README.md", "learning.md", "agents.md"} <= {page.name for page, _ in SHOWN}


def test_a_command_with_a_misspelt_option_is_noticed(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    page = tmp_path / "page.md"
    page.write_text("See `dora run --env DoraCube-v1 --sed 3`, or\n\n```\ndora run --env DoraCub-v1  # a cube\n```\n")
    assert commands(page) == ["--env DoraCube-v1 --sed 3", "--env DoraCub-v1"]
    monkeypatch.chdir(ROOT)
    for words in commands(page):
        with pytest.raises((SystemExit, InputError)):
            run.parse(shlex.split(words))
