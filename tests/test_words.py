"""How the package is worded: units in brackets, first lines that say what lives there, names in docs that exist."""

import ast
import io
import re
import tokenize
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
MODULES = sorted((ROOT / "dora").rglob("*.py"))
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
FEWEST_WORDS = 4
"""Words of a first line that says what lives in a module."""
UNIT = r"(?:m|mm|cm|km|rad|deg|kg|g|s|ms|us|N|Hz|J|W|pixels|points|kg/m\^3)(?:\^\d)?"
PHRASE = re.compile(rf"(?:1/)?{UNIT}(?:[ /*]{UNIT})*|per {UNIT}")
PARENTHESIS = re.compile(r"(?<![\w\]`/])\(([^()]*)\)")
CONSTANT = re.compile(r"_?[A-Z][A-Z0-9_]*")


def units_in_parentheses(text: str) -> list[tuple[int, str]]:
    """Line (from 0) and text of every parenthesis that is a unit or names one beside words; shapes are none."""
    found = []
    for match in PARENTHESIS.finditer(text):
        parts = [part.strip() for part in match[1].split(",")]
        units = [part for part in parts if PHRASE.fullmatch(part)]
        words = [part for part in parts if re.search(r"[a-z]{4}| ", part) and part not in units]
        if units and (len(parts) == 1 or words):
            found.append((text[: match.start()].count("\n"), match[0]))
    return found


def prose(source: str) -> list[tuple[int, str]]:
    """First line and text of every docstring, string below a constant, and comment of a module."""
    strings = [
        (node.value.lineno, node.value.value)
        for node in ast.walk(ast.parse(source))
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)
    ]
    tokens = tokenize.generate_tokens(io.StringIO(source).readline)
    return strings + [(token.start[0], token.string) for token in tokens if token.type == tokenize.COMMENT]


def undocumented(source: str) -> list[str]:
    """Constants at the top level of a module without a string below them that says what they are."""
    body, found = ast.parse(source).body, []
    for node, after in zip(body, [*body[1:], None], strict=True):
        targets = (
            node.targets if isinstance(node, ast.Assign) else [node.target] if isinstance(node, ast.AnnAssign) else []
        )
        names = [name.id for target in targets for name in ast.walk(target) if isinstance(name, ast.Name)]
        told = (
            isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant) and isinstance(after.value.value, str)
        )
        found += [f"{node.lineno}: {name}" for name in names if CONSTANT.fullmatch(name) and not told]
    return found


def test_a_unit_in_parentheses_is_found_and_a_shape_is_not() -> None:
    """The finder itself."""
    bad = "Distance (m) of points\n(object frame, m), mass (kg m^2), poses (m, wxyz)."
    assert [line for line, _ in units_in_parentheses(bad)] == [0, 1, 1, 1]
    assert not units_in_parentheses("Points (m, 3) of (n, m) and f(s), `failed(s)`, [m], ([m], wxyz), (m, AROUND, 3).")


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(ROOT)))
def test_units_stand_in_square_brackets(path: Path) -> None:
    """In every docstring and comment."""
    found = [
        f"{path.relative_to(ROOT)}:{first + line}: {text}"
        for first, words in prose(path.read_text())
        for line, text in units_in_parentheses(words)
    ]
    assert not found, "\n".join(found)
