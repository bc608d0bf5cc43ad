"""Commands called with arguments of a test's own, and the scripts that stand before them."""

import importlib
import sys
from pathlib import Path
from types import ModuleType

import pytest

from dora.errors import BAD_INPUT

EXPERIMENTS = Path(__file__).parent.parent / "experiments"


def load_command(name: str) -> ModuleType:
    """The body of `experiments/<name>.py`."""
    return importlib.import_module(f"dora.commands.{name}")


def call(command: ModuleType, monkeypatch: pytest.MonkeyPatch, *arguments: str) -> int:
    """Exit status of a command called with these arguments."""
    monkeypatch.setattr(sys, "argv", [command.__name__, *arguments])
    return command.main()


def refusal(
    command: ModuleType, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], arguments: str
) -> str:
    """What a command prints about arguments that it refuses: one line, and nothing else."""
    assert call(command, monkeypatch, *arguments.split()) == BAD_INPUT
    captured = capsys.readouterr()
    assert captured.err.count("\n") == 1
    assert captured.out == ""
    return captured.err
