"""The site of the documentation: mkdocs.yml names what is there and nothing else; what docs/site_hooks.py does."""

import ast
import re
import runpy
from pathlib import Path
from typing import Any

import pytest
import yaml

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
NOTEBOOK = "tour.md"
"""The page that docs/site_hooks.py makes of the notebook of examples/."""
API = sorted(
    name for page in (DOCS / "api").glob("*.md") for name in re.findall(r"^::: ([\w.]+)$", page.read_text(), re.M)
)
"""Names on the pages of the API."""
METHOD = sorted(set(re.findall(r"`(dora(?:\.\w+)+)`", (DOCS / "method.md").read_text())))
"""Names on the page of the equations."""


class Loader(yaml.SafeLoader):
    """Reads mkdocs.yml without making the Python objects that it names."""


Loader.add_multi_constructor("tag:yaml.org,2002:python/", lambda loader, tag, node: tag)


def settings() -> dict[str, Any]:
    """What mkdocs.yml says."""
    return yaml.load((ROOT / "mkdocs.yml").read_text(), Loader)


def pages(entry: Any) -> list[str]:
    """All pages of an entry of the navigation."""
    if isinstance(entry, str):
        return [entry]
    return [page for part in (entry.values() if isinstance(entry, dict) else entry) for page in pages(part)]


def five_lines(page: Path) -> str:
    """The first block of Python of a page."""
    found = re.search(r"```python\n(.*?)```", page.read_text(), re.S)
    assert found is not None
    return found[1]


def test_each_page_of_the_docs_stands_once_in_the_navigation() -> None:
    named = pages(settings()["nav"])
    there = {str(path.relative_to(DOCS)) for path in DOCS.rglob("*.md")}
    assert sorted(named) == sorted(there | {NOTEBOOK})
    assert (ROOT / "examples" / NOTEBOOK).with_suffix(".ipynb").is_file()


def test_files_that_the_site_is_made_with_are_there() -> None:
    for path in settings()["hooks"]:
        assert (ROOT / path).is_file()
    for path in settings()["extra_css"]:
        assert (DOCS / path).is_file()


def test_the_first_page_has_the_lines_of_the_readme() -> None:
    assert five_lines(DOCS / "index.md") == five_lines(ROOT / "README.md")
    install = re.search(r"pip install torch\S* --index-url \S+", (ROOT / "README.md").read_text())
    assert install is not None
    assert install[0] in (DOCS / "index.md").read_text()


def source_of(name: str) -> Path:
    """The module that holds a dotted name."""
    base = ROOT.joinpath(*name.split(".")).parent
    return base / "__init__.py" if base.is_dir() else base.with_suffix(".py")


def defined(name: str) -> bool:
    """Whether a dotted name is a module, or is defined in one and not only imported there; of a method, its class."""
    if re.search(r"\.[A-Z]\w*[a-z]\w*\.\w+$", name):
        owner, _, method = name.rpartition(".")
        return defined(owner) and f"def {method}(" in source_of(owner).read_text()
    base = ROOT.joinpath(*name.split("."))
    if (base / "__init__.py").is_file() or base.with_suffix(".py").is_file():
        return True
    found = set()
    for node in ast.parse(source_of(name).read_text()).body:
        if isinstance(node, ast.ClassDef | ast.FunctionDef):
            found.add(node.name)
        elif isinstance(node, ast.Assign):
            found |= {target.id for target in node.targets if isinstance(target, ast.Name)}
    return base.name in found


@pytest.mark.parametrize("name", [*API, *METHOD])
def test_a_name_of_the_pages_of_api_and_equations_is_defined_where_they_say(name: str) -> None:
    assert defined(name)


def test_the_api_pages_name_each_thing_once() -> None:
    assert len(API) == len(set(API)) > 50


def hooks() -> dict[str, Any]:
    """What docs/site_hooks.py defines."""
    for needed in ("mkdocs", "latex2mathml"):
        pytest.importorskip(needed, reason="the site needs the extra docs: pip install -e '.[docs]'")
    return runpy.run_path(str(DOCS / "site_hooks.py"))


def test_results_at_a_glance_are_those_of_the_table() -> None:
    table = (DOCS / "results" / "tables.md").read_text()
    rows = hooks()["at_a_glance"](table).splitlines()
    assert rows[0] == "| task | preset | agent | guidance | seeds | success % | scripted % | minutes |"
    assert "\n".join(rows) in (ROOT / "README.md").read_text()
    lines = [line for line in table.splitlines() if line.startswith("|") and "paper's reward" not in line]
    assert len(rows) == len(lines) > 2
    for row, line in zip(rows[2:], lines[2:], strict=True):
        cells = [cell.strip() for cell in line.strip("| ").split("|")]
        assert row.strip("| ").split(" | ") == [*cells[:6], cells[7], cells[10]]


def test_equations_become_mathml() -> None:
    page = '<p>with <span class="arithmatex">\\(a &lt; b\\)</span></p><div class="arithmatex">\\[\nE = x^2\n\\]</div>'
    drawn = hooks()["in_mathml"](page)
    assert "arithmatex" not in drawn
    assert drawn.count("<math ") == 2
    assert 'display="inline"' in drawn.partition("<div")[0]
    assert "<msup>" in drawn


def test_a_notebook_becomes_a_page_with_pictures() -> None:
    outputs = [
        {"output_type": "stream", "name": "stderr", "text": ["a warning\n"]},
        {"output_type": "stream", "name": "stdout", "text": ["one\n", "two\n"]},
        {"output_type": "display_data", "data": {"image/png": "AAEC\n", "text/plain": ["<Figure>"]}},
    ]
    cells = [
        {"cell_type": "markdown", "source": ["# Title\n", "[grasps](../docs/grasps.md)"]},
        {"cell_type": "code", "source": ["print()"], "outputs": outputs},
    ]
    page, pictures = hooks()["notebook_page"](cells)
    assert "[grasps](grasps.md)" in page
    assert page.index("```python\nprint()\n```") < page.index("```text\none\ntwo\n```") < page.index("![](tour/0.png)")
    assert "warning" not in page
    assert pictures == {"tour/0.png": b"\x00\x01\x02"}


def after_a_gap(page: str) -> list[int]:
    """Numbers of the lines that follow an empty one and are indented by one to three spaces, outside of fences."""
    found, fenced, before = [], False, ""
    for number, line in enumerate(page.splitlines(), 1):
        if not fenced and not before.strip() and re.match(r" {1,3}\S", line):
            found.append(number)
        fenced ^= line.lstrip().startswith("```")
        before = line
    return found


@pytest.mark.parametrize("page", sorted(DOCS.rglob("*.md")), ids=lambda page: str(page.relative_to(DOCS)))
def test_what_belongs_to_an_item_of_a_list_is_indented_by_four_spaces(page: Path) -> None:
    """GitHub needs fewer, but mkdocs ends the list there."""
    assert not after_a_gap(page.read_text())
