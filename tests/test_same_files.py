"""Comparison of files with those of an earlier revision (`tests.tools.same_files`)."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.tools.same_files import differences

PAGE = "<table>\n  <tr><td>1.5 µm</td></tr>\n</table>"


def folder(path: Path, **files: str) -> Path:
    """Write files with their endings behind a double underscore."""
    path.mkdir()
    for name, text in files.items():
        (path / name.replace("__", ".")).write_text(text, encoding="utf-8", newline="\n")
    return path


def test_equal_files_and_indented_pages_do_not_differ(tmp_path: Path) -> None:
    """White space between tags, and the store, are no difference."""
    before = folder(tmp_path / "a", x__csv="f\n1.5\n", page__html=PAGE, store__sqlite="1")
    after = folder(
        tmp_path / "b", x__csv="f\n1.5\n", page__html=PAGE.replace("\n", "\n   "), store__sqlite="2"
    )
    assert differences(before, after) == []


@pytest.mark.parametrize(
    "changed",
    [{"x__csv": "f\n1.50\n"}, {"x__csv": "f\n1.5"}, {"page__html": PAGE.replace(" µm", "µm")}],
)
def test_a_changed_byte_is_a_difference(tmp_path: Path, changed: dict[str, str]) -> None:
    """Negative control: a digit, the end of a line, or a blank inside of a cell."""
    files = {"x__csv": "f\n1.5\n", "page__html": PAGE}
    found = differences(folder(tmp_path / "a", **files), folder(tmp_path / "b", **files | changed))
    assert found == [name.replace("__", ".") for name in changed]


def test_a_missing_file_is_a_difference(tmp_path: Path) -> None:
    """A file that only one of both has is named, whichever it is."""
    with_it, without = folder(tmp_path / "a", x__csv="f\n"), folder(tmp_path / "b")
    assert differences(with_it, without) == differences(without, with_it) == ["x.csv"]
