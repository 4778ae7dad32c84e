"""Tests pass where only Python, its packages and make are installed: what CI installs is hidden."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

# What every system has, and Debian's minimal image.
PROGRAMS = ("cat", "env", "false", "head", "kill", "ls", "mkdir", "rm", "sh", "sleep", "touch",
            "true")  # fmt: skip
# A module that every interpreter imports first; cffi opens the libraries of WeasyPrint.
HIDING = """
import cffi

_open = cffi.FFI.dlopen


def dlopen(self, name, *flags):
    if any(part in str(name) for part in {hidden!r}):
        raise OSError(f"cannot load library {{name}}: hidden")
    return _open(self, name, *flags)


cffi.FFI.dlopen = dlopen
"""
# A plugin that leaves the tests which ask for something that a machine may lack, or call programs.
SELECTING = """
NEEDS = {"needs", "postgres", "database", "store_url", "cluster"}


def pytest_collection_modifyitems(items):
    items[:] = [
        item for item in items
        if NEEDS & set(item.fixturenames) or item.path.name == "test_distribution.py"
    ]
"""
SUBSET, ALL = ("harfbuzz-subset",), ("gobject", "pango", "harfbuzz", "fontconfig")


def bare(folder: Path, hidden: tuple[str, ...], *words: str) -> subprocess.CompletedProcess[str]:
    """Call Python in an environment without settings, programs and some libraries."""
    (folder / "sitecustomize.py").write_text(HIDING.format(hidden=hidden))
    (folder / "bin").mkdir()
    for name in PROGRAMS:
        if found := shutil.which(name):
            (folder / "bin" / name).symlink_to(found)
    env = {"PATH": str(folder / "bin"), "PYTHONPATH": str(folder), "OPENBLAS_NUM_THREADS": "1"}
    return subprocess.run(
        [sys.executable, *words], cwd=Path(__file__).parents[1], env=env, capture_output=True,
        text=True, check=False, stdin=subprocess.DEVNULL,
    )  # fmt: skip


def called(folder: Path, hidden: tuple[str, ...], *words: str) -> tuple[int, list[str], str]:
    """Run tests in a bare environment; return exit status, reasons of skips, and output."""
    done = bare(folder, hidden, "-m", "pytest", "-q", "-n", "0", "-p", "no:cacheprovider", *words)
    reasons = re.findall(r"^SKIPPED \[\d+\] \S+ (.*)", done.stdout, re.M)
    return done.returncode, reasons, done.stdout[-5000:]


@pytest.mark.slow
def test_pdfs_are_written_without_harfbuzz_subset(
    needs: Callable[[str], None], tmp_path: Path
) -> None:
    """WeasyPrint warns of its absence, and warnings are errors."""
    needs("pdf")
    status, skipped, output = called(tmp_path, SUBSET, "tests/report/test_pdf.py")
    assert (status, skipped) == (0, []), output


@pytest.mark.slow
def test_what_lacks_is_a_reason_to_skip(tmp_path: Path) -> None:
    """Each fast test that needs something passes, or its skip names what to install."""
    (tmp_path / "needing.py").write_text(SELECTING)
    fast = "not slow and not study and not statistical"
    status, skipped, output = called(tmp_path, ALL, "-p", "needing", "-m", fast, "tests")
    assert status == 0, output
    known = r"Debian|LMSHEALTH_DATA|pip install"
    assert skipped and [reason for reason in skipped if not re.search(known, reason)] == []
    assert any("libpangoft2-1.0-0" in reason for reason in skipped)


def test_the_program_names_the_libraries_of_a_pdf(tmp_path: Path) -> None:
    """On standard error alone: what WeasyPrint prints on standard output is no result."""
    page = tmp_path / "page.html"
    page.write_text("<html><head><style></style></head></html>")
    code = (
        "from pathlib import Path; from lmshealth.report.rendering import PdfError, write_pdfs\n"
        f"try:\n    write_pdfs([Path({str(page)!r})])\n"
        "except PdfError as error:\n    raise SystemExit(str(error))"
    )
    done = bare(tmp_path, ALL, "-W", "error", "-c", code)
    assert (done.returncode, done.stdout) == (1, "")
    assert "libpangoft2-1.0-0 and libharfbuzz-subset0 (Debian" in done.stderr
    assert len(done.stderr.splitlines()) == 1 and not os.path.exists(tmp_path / "page.pdf")
