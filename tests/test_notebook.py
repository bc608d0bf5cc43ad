"""The notebook of examples/: it runs, and what is stored in it is whole, small and free of errors."""

import json
import re
from pathlib import Path
from typing import Any

import pytest

NOTEBOOK = Path(__file__).parents[1] / "examples" / "tour.ipynb"
LARGEST = 1_000_000
"""Size of the notebook with its outputs [bytes]."""
LONGEST = 900
"""Time for a cell on a busy machine that compiles the search [s]."""
FEWEST = 5
"""Successes among eight episodes of a policy whose success is above .9."""


def cells(kind: str) -> list[dict[str, Any]]:
    """The stored cells of one kind, "code" or "markdown"."""
    return [cell for cell in json.loads(NOTEBOOK.read_text())["cells"] if cell["cell_type"] == kind]


def printed(outputs: list[Any]) -> str:
    return "".join("".join(output.get("text", "")) for output in outputs)


def test_the_notebook_is_stored_with_its_outputs() -> None:
    assert NOTEBOOK.stat().st_size < LARGEST
    outputs = [output for cell in cells("code") for output in cell["outputs"]]
    assert not [output for output in outputs if output["output_type"] == "error"]
    assert sum("image/png" in output.get("data", {}) for output in outputs) >= 6
    assert all(cell["outputs"] for cell in cells("code")[1:])
    assert "of 8 episodes succeed" in printed(outputs)


def test_links_of_the_notebook_lead_to_pages_of_the_docs() -> None:
    links = [link for cell in cells("markdown") for link in re.findall(r"\]\(([^)]+)\)", "".join(cell["source"]))]
    assert len(links) > 5
    for link in links:
        assert link.startswith("../docs/")
        assert (NOTEBOOK.parent / link).is_file(), link


@pytest.mark.slow
def test_the_notebook_runs() -> None:
    nbformat: Any = pytest.importorskip("nbformat")
    client: Any = pytest.importorskip("nbclient", reason="it runs notebooks: pip install -e '.[test]'")
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    place = {"metadata": {"path": str(NOTEBOOK.parent)}}
    client.NotebookClient(notebook, timeout=LONGEST, kernel_name="python3", resources=place).execute()
    outputs = [output for cell in notebook.cells if cell.cell_type == "code" for output in cell.outputs]
    found = re.search(r"(\d) of 8 episodes succeed", printed(outputs))
    assert found is not None
    assert int(found[1]) >= FEWEST
    assert sum("image/png" in output.get("data", {}) for output in outputs) == sum(
        "image/png" in output.get("data", {}) for cell in cells("code") for output in cell["outputs"]
    )
