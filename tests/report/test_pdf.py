"""PDFs: content, reproducibility, and errors."""

from __future__ import annotations

import re
import subprocess
import sys
import zlib
from collections.abc import Callable
from pathlib import Path

import pytest

from lmshealth.report.figures import GREEN, RED
from lmshealth.report.rendering import PdfError, write_pdfs
from tests.assessments import worn, write_report


@pytest.fixture(autouse=True, scope="module")
def _library(needs: Callable[[str], None]) -> None:
    """Skip all where the library is not there."""
    needs("pdf")


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write the page of a worn machine."""
    folder = tmp_path_factory.mktemp("pdf")
    return write_report(folder / "out", [worn(folder)], ())[0]


@pytest.fixture
def small(tmp_path: Path) -> Path:
    """Write a page of one word."""
    path = tmp_path / "small.html"
    path.write_text("<html><head><style></style></head><body><h1>Word</h1></body></html>")
    return path


def colours(content: bytes) -> set[tuple[float, ...]]:
    """Collect the colours that areas and lines of a PDF are drawn in."""
    found: set[tuple[float, ...]] = set()
    for stream in re.findall(rb"stream\r?\n(.*?)\r?\nendstream", content, re.S):
        try:
            text = zlib.decompress(stream)
        except zlib.error:
            continue
        for numbers in re.findall(rb"([\d.]+ [\d.]+ [\d.]+) (?:rg|RG|scn?|SCN?)\b", text):
            found.add(tuple(round(float(number), 2) for number in numbers.split()))
    return found


@pytest.mark.slow
def test_a_pdf_is_written_next_to_its_page_with_coloured_figures(page: Path) -> None:
    """Red and green of the pictures are there: names of colours are not looked up inside them."""
    before = page.read_bytes()
    assert write_pdfs([page]) == [page.with_suffix(".pdf")]
    content = page.with_suffix(".pdf").read_bytes()
    assert content.startswith(b"%PDF-")
    assert page.read_bytes() == before
    drawn = colours(content)
    for colour in (RED, GREEN):
        rgb = tuple(round(int(colour[k : k + 2], 16) / 255, 2) for k in (1, 3, 5))
        assert rgb in drawn, colour


@pytest.mark.slow
def test_the_same_page_gives_the_same_bytes(small: Path) -> None:
    """Made again, by another process too, a PDF is the same."""
    (target,) = write_pdfs([small])
    content = target.read_bytes()
    modules = (
        "import sys; from pathlib import Path; from lmshealth.report.rendering import write_pdfs"
    )
    code = f"{modules}; write_pdfs([Path(sys.argv[1])])"
    subprocess.run([sys.executable, "-c", code, str(small)], check=True)
    assert target.read_bytes() == content


@pytest.mark.slow
def test_nothing_is_loaded_from_outside(tmp_path: Path) -> None:
    """A page that names a file or an address gets nothing of it."""
    secret = tmp_path / "secret.css"
    secret.write_text("p { color: #123456; }")
    page = tmp_path / "page.html"
    link = f'<link rel="stylesheet" href="{secret.as_uri()}">'
    page.write_text(f"<html><head>{link}<style></style></head><body><p>text</p></body></html>")
    (target,) = write_pdfs([page])
    wanted = tuple(round(value / 255, 2) for value in (0x12, 0x34, 0x56))
    assert wanted not in colours(target.read_bytes())
    inside = page.read_text().replace(link, "<style>p { color: #123456; }</style>")
    page.write_text(inside)
    (target,) = write_pdfs([page])
    assert wanted in colours(target.read_bytes())


def test_a_missing_library_is_named(small: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The error names the package to install, and no PDF is written."""
    monkeypatch.setitem(sys.modules, "weasyprint", None)
    with pytest.raises(PdfError, match=r'pip install "lmshealth\[pdf\]"'):
        write_pdfs([small])
    assert not small.with_suffix(".pdf").exists()


def test_missing_libraries_of_the_library_are_named(
    small: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without Pango the error names its Debian packages."""
    (tmp_path / "weasyprint.py").write_text("raise OSError('cannot load library pango')")
    monkeypatch.delitem(sys.modules, "weasyprint", raising=False)
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(PdfError, match="libpangoft2") as caught:
        write_pdfs([small])
    assert "cannot load library pango" in str(caught.value)


def test_a_page_that_cannot_be_laid_out_is_named(
    small: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Any error of the library is reported with the name of the page."""
    import weasyprint

    def stumble(self: object) -> bytes:
        raise AssertionError("no page")

    monkeypatch.setattr(weasyprint.HTML, "write_pdf", stumble)
    with pytest.raises(PdfError, match=r"small\.html"):
        write_pdfs([small])


def test_the_library_is_loaded_only_when_it_is_needed() -> None:
    """The command line starts without it."""
    code = "import sys, lmshealth.cli.main; sys.exit('weasyprint' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
