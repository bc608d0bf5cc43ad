"""The scripts in `experiments/` as modules, so that tests can call them with arguments of their own."""

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import pytest

EXPERIMENTS = Path(__file__).parent.parent / "experiments"


def load_command(name: str) -> ModuleType:
    """The module of `experiments/<name>.py`."""
    spec = importlib.util.spec_from_file_location(f"{name}_script", EXPERIMENTS / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[f"{name}_script"] = module
    spec.loader.exec_module(module)
    return module


def call(script: ModuleType, monkeypatch: pytest.MonkeyPatch, *arguments: str) -> int:
    """Exit status of a command called with these arguments."""
    monkeypatch.setattr(sys, "argv", [script.__name__, *arguments])
    return script.main()
