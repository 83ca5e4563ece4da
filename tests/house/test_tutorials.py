"""The notebooks of ``docs/tutorials/`` run; stored, they are small and name no machine."""

import json
import os
import re

import pytest
from conftest import REPOSITORY

FOLDER = REPOSITORY / "docs" / "tutorials"
NOTEBOOKS = sorted(path.name for path in FOLDER.glob("*.ipynb"))

MAX_FILE_BYTES = 500_000
MAX_MARKDOWN_WORDS = 350
MAX_CELL_S = 600  # on a slow machine with two workers

PYTHON_3 = {"display_name": "Python 3", "language": "python", "name": "python3"}

MACHINE_PATHS = r"/(?:tmp|home|root|Users|work|var|usr)/|[A-Z]:\\"

each_notebook = pytest.mark.parametrize("name", NOTEBOOKS)


def source_of(cells, kind) -> str:
    return "\n".join("".join(cell["source"]) for cell in cells if cell["cell_type"] == kind)


def printed_to_stderr(cells) -> str:
    outputs = [output for cell in cells for output in cell.get("outputs", [])]
    return "".join("".join(o["text"]) for o in outputs if o.get("name") == "stderr")


@pytest.mark.slow
@each_notebook
def test_notebook_runs_from_top_to_bottom(name):
    nbclient, nbformat = pytest.importorskip("nbclient"), pytest.importorskip("nbformat")
    pytest.importorskip("ipykernel")
    notebook = nbformat.read(FOLDER / name, as_version=4)
    client = nbclient.NotebookClient(
        notebook,
        timeout=MAX_CELL_S,
        kernel_name="python3",
        resources={"metadata": {"path": str(FOLDER)}},
    )
    client.execute(env={**os.environ, "PYTHONPATH": str(REPOSITORY)})
    assert printed_to_stderr(notebook.cells) == ""


@each_notebook
def test_stored_notebook_is_a_complete_run(name):
    cells = json.loads((FOLDER / name).read_text())["cells"]
    counts = [cell["execution_count"] for cell in cells if cell["cell_type"] == "code"]
    assert counts == list(range(1, len(counts) + 1))
    assert printed_to_stderr(cells) == ""


@each_notebook
def test_stored_notebook_is_small(name):
    cells = json.loads((FOLDER / name).read_text())["cells"]
    assert (FOLDER / name).stat().st_size <= MAX_FILE_BYTES
    assert len(source_of(cells, "markdown").split()) <= MAX_MARKDOWN_WORDS


@each_notebook
def test_stored_notebook_has_no_traces_of_a_machine(name):
    notebook = json.loads((FOLDER / name).read_text())
    assert notebook["metadata"] == {"kernelspec": PYTHON_3}
    for cell in notebook["cells"]:
        assert cell["metadata"] == {}
        for output in cell.get("outputs", []):
            text = output.get("text") or output.get("data", {}).get("text/plain", "")
            assert not re.search(MACHINE_PATHS, "".join(text))


def test_index_links_to_every_notebook_in_order():
    linked = re.findall(r"\]\((\w+\.ipynb)\)", (FOLDER / "index.md").read_text())
    assert linked == NOTEBOOKS
