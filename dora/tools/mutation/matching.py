"""Which tests belong to a module: by names, and by what they import, most specific first."""

import ast
from pathlib import Path

ROOM, PARENT, FAR = 4, 5, 6
"""How far tests are from a module: of its room, of the package around that, and unrelated; 0 is nearest."""
LOADER, COMMANDS = "load_command", "dora.commands"
"""Function with which tests import a module of this package by its name."""


def tests_of(root: Path, module: str) -> tuple[list[str], list[str]]:
    """Test modules that belong to a module, most specific first, and all others, nearest first; below the root.

    Those that are named after the module come first, then those that import it, those named after its room (its
    folder), and those that import another module of its room. The others begin with those that import from the package
    around the room. What a test imports from other files of tests/ counts as its own. A module that lies directly in
    the package is in no room.

    Args:
        root: of the repository.
        module: path of the module, below the root.
    """
    imported = _imported_by_tests(root)
    found = sorted(
        (_distance(path.stem, imported[path.stem], module), path.relative_to(root).as_posix())
        for path in (root / "tests").glob("test_*.py")
    )
    return [test for far, test in found if far <= ROOM], [test for far, test in found if far > ROOM]


def _distance(test: str, imported: set[str], module: str) -> int:
    """How far a test is from a module, by its name and by what it imports."""
    *folders, name = Path(module).with_suffix("").parts
    words = f"_{test.removeprefix('test_')}_"
    room, parent, inner = ".".join(folders), ".".join(folders[:-1]), len(folders) > 1
    direct, near = f"{room}.{name}" in imported, inner and f"_{folders[-1]}_" in words
    in_room = inner and any(each.startswith(f"{room}.") or each == room for each in imported)
    around = len(folders) > 2 and any(each.startswith(f"{parent}.") or each == parent for each in imported)
    if f"_{name}_" in words and (direct or in_room or not inner):
        return 0
    if direct:
        return 1 if near else 2
    return 3 if near else ROOM if in_room else PARENT if around else FAR


def _imported_by_tests(root: Path) -> dict[str, set[str]]:
    """Modules of the package that each file of tests/ imports, itself or through other files of tests/; by stem."""
    direct = {path.stem: _imports(path) for path in sorted((root / "tests").glob("*.py"))}
    everything = {}
    for test in direct:
        reached, waiting = {test}, [test]
        while waiting:
            for name in direct[waiting.pop()]:
                stem = name.removeprefix("tests.").partition(".")[0]
                if stem in direct and stem not in reached:
                    reached.add(stem)
                    waiting.append(stem)
        everything[test] = set().union(*(direct[name] for name in reached))
    return everything


def _imports(path: Path) -> set[str]:
    """Dotted names that a file imports anywhere; names that are taken from a module count as its submodules, too, and
    so do commands that are loaded by name."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            found |= {node.module} | {f"{node.module}.{alias.name}" for alias in node.names}
        elif isinstance(node, ast.Call) and getattr(node.func, "id", "") == LOADER:
            found |= {f"{COMMANDS}.{name.value}" for name in node.args if isinstance(name, ast.Constant)}
    return found
