"""What mkdocs does besides for the site: equations as MathML, results at a glance, the notebook of examples/."""

import base64
import html
import json
import re
from pathlib import Path
from typing import Any

from latex2mathml.converter import convert
from mkdocs.structure.files import File

EQUATION = re.compile(r'<(?P<tag>div|span) class="arithmatex">\\[(\[](?P<tex>.*?)\\[)\]]</(?P=tag)>', re.S)
"""An equation as pymdownx.arithmatex leaves it."""
GLANCE = "<!-- results at a glance -->"
"""Mark of the place for the table of results, in the pages that show one."""
COLUMNS = {
    "task": "task", "preset": "preset", "agent": "agent", "guidance": "guidance", "seeds": "seeds",
    "success %": "success %", "scripted (zero correction) %": "scripted %", "minutes": "minutes",
}  # fmt: skip
"""Columns that are shown there, and how they are called."""
OTHER_REWARD = "paper's reward"
"""What the column of the agent says of runs with another reward."""
NOTEBOOK = Path("examples/tour.ipynb")
"""The notebook that becomes a page."""
DOCS = "../docs/"
"""Folder of the other pages, as links in the notebook name it."""


def in_mathml(page: str) -> str:
    """A page whose equations browsers draw by themselves, without scripts."""

    def drawn(found: re.Match[str]) -> str:
        display = "block" if found["tag"] == "div" else "inline"
        return convert(html.unescape(found["tex"]).strip(), display=display)

    return EQUATION.sub(drawn, page)


def at_a_glance(table: str) -> str:
    """Those columns of the first table of a Markdown page that are shown at a glance, of runs with the usual reward."""
    rows = [[cell.strip() for cell in line.strip("| ").split("|")] for line in table.splitlines() if line[:1] == "|"]
    places = [rows[0].index(name) for name in COLUMNS]
    kept = [row for row in rows[1:] if OTHER_REWARD not in row[places[2]]]
    shown = [list(COLUMNS.values()), *([row[place] for place in places] for row in kept)]
    return "\n".join(f"| {' | '.join(row)} |" for row in shown)


def notebook_page(cells: list[dict[str, Any]]) -> tuple[str, dict[str, bytes]]:
    """A notebook as a page in Markdown, and its pictures by their paths; what went to stderr is left out."""
    parts, pictures = [], {}
    for cell in cells:
        source = "".join(cell["source"])
        parts.append(f"```python\n{source}\n```" if cell["cell_type"] == "code" else source.replace(DOCS, ""))
        for output in (one for one in cell.get("outputs", []) if one.get("name") != "stderr"):
            if "image/png" in (data := output.get("data", {})):
                path = f"{NOTEBOOK.stem}/{len(pictures)}.png"
                pictures[path] = base64.b64decode("".join(data["image/png"]))
                parts.append(f"![]({path})")
            else:
                text = "".join(output.get("text") or data["text/plain"])
                parts.append(f"```text\n{text.rstrip()}\n```")
    return "\n\n".join(parts), pictures


def on_files(files: Any, config: Any) -> Any:
    """Add the notebook, which is no page of docs/."""
    notebook = json.loads((Path(config.config_file_path).parent / NOTEBOOK).read_text())
    page, pictures = notebook_page(notebook["cells"])
    for path, content in {f"{NOTEBOOK.stem}.md": page, **pictures}.items():
        files.append(File.generated(config, path, content=content))
    return files


def on_page_markdown(markdown: str, page: Any, config: Any, files: Any) -> str:
    """Fill in the results at a glance."""
    if GLANCE not in markdown:
        return markdown
    return markdown.replace(GLANCE, at_a_glance((Path(config.docs_dir) / "results" / "tables.md").read_text()))


def on_page_content(content: str, page: Any, config: Any, files: Any) -> str:
    """Turn equations into MathML."""
    return in_mathml(content)
