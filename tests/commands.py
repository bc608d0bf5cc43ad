"""Commands called with arguments of a test's own, and the scripts that stand before them."""

import importlib
import sys
from pathlib import Path
from types import ModuleType

import pytest

EXPERIMENTS = Path(__file__).parent.parent / "experiments"


def load_command(name: str) -> ModuleType:
    """The body of `experiments/<name>.py`."""
    return importlib.import_module(f"dora.commands.{name}")


def call(command: ModuleType, monkeypatch: pytest.MonkeyPatch, *arguments: str) -> int:
    """Exit status of a command called with these arguments."""
    monkeypatch.setattr(sys, "argv", [command.__name__, *arguments])
    return command.main()
