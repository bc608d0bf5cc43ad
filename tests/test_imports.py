"""Which room may import which: arrows go one way, and no learner knows the simulator."""

import ast
from pathlib import Path

import pytest

LEVELS = {
    "errors": 0, "version": 0, "quiet_start": 0, "reading": 0.4, "digests": 0.45, "arguments": 0.5, "configs": 0.5,
    "containers": 0.5, "files": 0.5, "parallel": 0.5, "progress": 0.5, "tables": 0.5,
    "geometry": 1, "robot": 2, "robot.motion": 3,
    "affordance.objects": 4, "affordance.hand": 5, "affordance.maps": 6, "affordance": 7, "affordance.search": 8,
    "affordance.reach": 8, "affordance.views": 9,
    "sim.batch": 10, "sim": 11, "sim.grasp_tests": 12,
    "tasks.mdp": 13, "tasks.guidance": 14, "tasks.env": 15, "tasks.hammer": 16, "tasks.microwave": 16,
    "tasks": 17,
    "registration": 18, "tools": 18, "live": 18, "policies": 18.5, "integrations": 18.5,
    "datasets": 18.7, "sweeps": 18.7,
    "commands": 19, "__main__": 20,
}  # fmt: skip
"""A room may import itself and rooms of a lower level; a room inside one that is not listed belongs to it."""
LEARNERS = {
    "agents": 0, "agents.learners": 1, "agents.collecting": 2, "agents.evaluation": 3, "agents.runs": 4,
    "agents.reports": 5,
}  # fmt: skip
"""The same for learners, who know of the rest only what stands below level 1; policies and commands know them."""
KNOW_LEARNERS = ("policies", "sweeps", "commands")
"""Rooms that know tasks and learners."""
FORBIDDEN = {
    "robot": ("sapien", "mani_skill", "torchrl"),
    "geometry": ("sapien", "mani_skill", "torchrl"),
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
            names += [f"{node.module}.{a.name}" for a in node.names]
    return names


def files(root: Path) -> list[Path]:
    """Modules of the package; what a package itself says in its `__init__` is the room's."""
    return [path for path in sorted((root / "dora").rglob("*.py")) if path != root / "dora" / "__init__.py"]


def room(name: str) -> str | None:
    """The room of a module of the package, such as "tasks.mdp"; None for what is not of it."""
    parts = name.split(".")
    if parts[0] != "dora":
        return None
    known = LEVELS | LEARNERS
    return next((r for n in range(len(parts), 1, -1) if (r := ".".join(parts[1:n])) in known), None)


def module(path: Path, root: Path) -> str:
    """Dotted name of a file."""
    return ".".join(path.relative_to(root).with_suffix("").parts).removesuffix(".__init__")


def allowed(here: str, there: str) -> bool:
    """Whether room `here` may import room `there`."""
    if here in LEARNERS and there in LEARNERS:
        return LEARNERS[there] <= LEARNERS[here]
    if here in LEARNERS:
        return LEVELS[there] < 1
    if there in LEARNERS:
        return here in KNOW_LEARNERS
    return LEVELS[there] < LEVELS[here] or here == there


def test_imports_go_one_way(project_root: Path):
    wrong = []
    for path in files(project_root):
        here = room(module(path, project_root))
        assert here is not None, f"{path} is in no room"
        for name in imported(path):
            there = room(name)
            if there is not None and not allowed(here, there):
                wrong.append(f"{path.relative_to(project_root)} imports {name}")
    assert not wrong


@pytest.mark.parametrize("package", sorted(FORBIDDEN))
def test_packages_stay_free_of_what_they_need_not_know(project_root: Path, package: str):
    wrong = [
        f"{path.relative_to(project_root)} imports {name}"
        for path in files(project_root)
        if module(path, project_root).split(".")[1] == package
        for name in imported(path)
        if name.split(".")[0] in FORBIDDEN[package]
    ]
    assert not wrong
