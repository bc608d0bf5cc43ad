"""Imports go one way, and no learner knows the simulator."""

import ast
from pathlib import Path

import pytest

LEVELS = {"digests": 0, "errors": 0, "files": 0, "progress": 0, "robot": 1, "affordance": 2, "sim": 3, "tasks": 4}
"""A package may import packages of its own level or below."""
FORBIDDEN = {
    "robot": ("sapien", "mani_skill", "torchrl"),
    "affordance": ("sapien", "mani_skill", "torchrl"),
    "agents": ("sapien", "mani_skill"),
    "tasks": ("torchrl", "tensordict"),
    "sim": ("torchrl", "tensordict"),
}


def imported(path: Path) -> list[str]:
    """Full names of the modules that a file imports anywhere."""
    names = []
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names += [a.name for a in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module and node.level == 0:
            names.append(node.module)
    return names


def files(root: Path) -> list[Path]:
    return sorted((root / "dora").rglob("*.py"))


def room(path: Path, root: Path) -> str:
    return path.relative_to(root / "dora").with_suffix("").parts[0]


def test_imports_go_one_way(project_root: Path):
    wrong = []
    for path in files(project_root):
        here = room(path, project_root)
        for name in imported(path):
            parts = name.split(".")
            if parts[0] != "dora" or len(parts) < 2 or here == "__init__":
                continue
            there = parts[1]
            if here == "agents" or there == "agents":
                ok = here == there or LEVELS.get(there) == 0
            else:
                ok = LEVELS[there] <= LEVELS[here]
            if not ok:
                wrong.append(f"{path.relative_to(project_root)} imports {name}")
    assert not wrong


@pytest.mark.parametrize("package", sorted(FORBIDDEN))
def test_packages_stay_free_of_what_they_need_not_know(project_root: Path, package: str):
    wrong = [
        f"{path.relative_to(project_root)} imports {name}"
        for path in files(project_root)
        if room(path, project_root) == package
        for name in imported(path)
        if name.split(".")[0] in FORBIDDEN[package]
    ]
    assert not wrong
