"""The notebooks run from their first to their last cell, and are all listed."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import pytest

NOTEBOOKS = sorted((Path(__file__).parents[1] / "studies" / "notebooks").glob("*.py"))
LONGEST_S = 1200  # of a cell, on a busy machine


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_has_a_question_and_its_limits(path: Path) -> None:
    """It begins with a question, ends with what it does not show, and is listed."""
    cells = re.split(r"^# %%", path.read_text(encoding="utf-8"), flags=re.MULTILINE)[1:]
    assert "**Question.**" in cells[0] and "**What this does not show.**" in cells[-1]
    assert f"[{path.stem}]({path.name})" in path.with_name("README.md").read_text(encoding="utf-8")


# Chains of full length are those of the README and of the examples, see `test_examples`; pictures
# of the pages beside a notebook, of which no cell shows one, are those of `tests.report`.
QUICK = (
    "from contextlib import ExitStack\n"
    "from studies.harness.command_line import no_pictures, quick_posteriors\n"
    "quick = ExitStack()\n"
    "for one in (quick_posteriors(), no_pictures()):\n"
    "    quick.enter_context(one)"
)


def executed(path: Path, root: Path) -> list[tuple[str, list[str]]]:
    """Execute a notebook with quick posteriors; return its cells and the types of what they show.

    The cells are given by their sources.
    """
    import jupytext
    import nbclient
    from nbformat.v4 import new_code_cell

    notebook = jupytext.read(path)
    notebook.cells.insert(0, new_code_cell(QUICK))
    metadata = {"metadata": {"path": str(root)}}
    nbclient.NotebookClient(
        notebook, timeout=LONGEST_S, kernel_name="python3", resources=metadata
    ).execute()
    return [
        (cell.source, [kind for one in cell.get("outputs", ()) for kind in one.get("data", {})])
        for cell in notebook.cells
    ]


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::DeprecationWarning")
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_runs(path: Path, root: Path, needs: Callable[[str], None]) -> None:
    """All cells run, its own comparisons with the truth hold, and cells that plot show it."""
    if path.stem == "own_machine":
        needs("data")  # else it would be downloaded
    cells = executed(path, root)
    plots = [kinds for source, kinds in cells if "plot(" in source or "subplots(" in source]
    assert plots and all("image/png" in kinds for kinds in plots)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_a_cell_that_fails_is_seen(tmp_path: Path, root: Path) -> None:
    """Control: a notebook with a false statement does not pass."""
    path = tmp_path / "wrong.py"
    path.write_text("# %%\nassert 1 + 1 == 3\n", encoding="utf-8")
    with pytest.raises(Exception, match="AssertionError"):
        executed(path, root)
