"""How the package is worded: units in brackets, first lines that say what lives there, names in docs that exist."""

import ast
import io
import re
import tokenize
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
MODULES = sorted((ROOT / "dora").rglob("*.py"))
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
FEWEST_WORDS = 4
"""Words of a first line that says what lives in a module."""
UNIT = r"(?:m|mm|cm|km|rad|deg|kg|g|s|ms|us|N|Hz|J|W|pixels|points|kg/m\^3)(?:\^\d)?"
PHRASE = re.compile(rf"(?:1/)?{UNIT}(?:[ /*]{UNIT})*|per {UNIT}")
PARENTHESIS = re.compile(r"(?<![\w\]`/])\(([^()]*)\)")
DOCUMENTED = [path for path in MODULES if not {"models"} & set(path.relative_to(ROOT).parts)]
"""Modules whose constants all have a string below them."""
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


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(ROOT)))
def test_the_first_line_of_a_module_says_what_lives_there(path: Path) -> None:
    """A sentence of a few words, of packages too."""
    words = ast.get_docstring(ast.parse(path.read_text())) or ""
    first = words.splitlines()[0] if words else ""
    assert len(first.split()) >= FEWEST_WORDS, f"{path.relative_to(ROOT)}:1: {first!r}"
    assert not first.startswith("Package"), f"{path.relative_to(ROOT)}:1: {first!r}"
    assert first.endswith((".", "`", ";", ",")) or len(words.splitlines()) == 1, (
        f"{path.relative_to(ROOT)}:1: {first!r}"
    )


@pytest.mark.parametrize("path", DOCUMENTED, ids=lambda path: str(path.relative_to(ROOT)))
def test_constants_are_documented_below_them(path: Path) -> None:
    """By a string literal, not by a comment at the end of the line."""
    found = undocumented(path.read_text())
    assert not found, "\n".join(f"{path.relative_to(ROOT)}:{name}" for name in found)


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(ROOT)))
def test_no_words_of_the_package_name_a_script_that_a_wheel_lacks(path: Path) -> None:
    """Help and messages say `dora run` and the like; experiments/ is in a checkout only."""
    found = [
        f"{path.relative_to(ROOT)}:{node.lineno}"
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and "experiments" in node.value
    ]
    assert not found, "\n".join(found)


def named(text: str) -> list[str]:
    """Dotted names below `dora` and paths below `dora/`, `tests/` and the like on a page, without placeholders."""
    dotted = re.findall(r"(?<![\w/.-])dora(?:\.\w+)+(?!\w*/)", text)
    files = re.findall(r"(?<![\w/.-])(?:dora|experiments|examples|tests)/[\w./-]*\w/?", text)
    return [name for name in dotted + files if not re.search(r"\b[A-Z]{3,}\b", name)]


def exists(name: str) -> bool:
    """Whether a path, or a dotted module or name within one, is there."""
    if "/" in name:
        return (ROOT / name).exists()
    parts = name.split(".")
    for count in range(len(parts), 0, -1):
        place = ROOT.joinpath(*parts[:count])
        source = place.with_suffix(".py") if place.with_suffix(".py").is_file() else place / "__init__.py"
        if source.is_file():
            words = source.read_text()
            return all(re.search(rf"\b{part}\b", words) for part in parts[count:])
    return False


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_modules_and_files_that_a_page_names_exist(page: Path) -> None:
    """So that moved modules do not leave dead names behind."""
    missing = [name for name in named(page.read_text()) if not exists(name)]
    assert not missing, f"{page.relative_to(ROOT)} names {', '.join(missing)}"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_of_a_page_lead_somewhere(page: Path) -> None:
    """Relative links only; the anchor has to be a heading of the page it leads to."""
    missing = []
    for target in re.findall(r"\]\(([^)#\s]*(?:#[^)\s]*)?)\)", page.read_text()):
        path, _, anchor = target.partition("#")
        if "://" in path:
            continue
        file = (page.parent / path).resolve() if path else page
        headings = re.findall(r"^#+ (.*)$", file.read_text(), re.M) if file.suffix == ".md" and file.is_file() else []
        anchors = {re.sub(r"[^\w\- ]", "", heading.lower()).strip().replace(" ", "-") for heading in headings}
        if not file.exists() or (anchor and anchor not in anchors):
            missing.append(target)
    assert not missing, f"{page.relative_to(ROOT)} links to {', '.join(missing)}"
