"""The documentation site: built strictly, complete, and read without a network."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

from lmshealth import __all__ as public
from lmshealth._private.tables import REFUSALS
from tests.tools.site import pages

ROOT = Path(__file__).parents[1]


def build(source: Path, out: Path) -> subprocess.CompletedProcess[str]:
    """Build a site as `make site` does."""
    command = [sys.executable, "-m", "sphinx", "-W", "--keep-going", "-q", "-b", "html"]
    command += ["-c", str(ROOT / "tests" / "tools" / "site"), str(source), str(out)]
    return subprocess.run(command, capture_output=True, text=True, check=False)


@pytest.mark.slow
def test_the_site_is_complete_and_needs_no_network(tmp_path: Path) -> None:
    """No warning; every public name, code and page of the contents; nothing from elsewhere."""
    for library in ("sphinx", "myst_parser", "furo", "latex2mathml", "jupytext", "nbconvert"):
        pytest.importorskip(library, reason="needs lmshealth[docs]")
    source, out = tmp_path / "source", tmp_path / "site"
    pages.main(source)
    built = build(source, out)
    assert (built.returncode, built.stderr) == (0, "")
    python = (out / "reference" / "python.html").read_text(encoding="utf-8")
    assert [name for name in public if f'.{name}"' not in python] == []
    refusals = (out / "lmshealth" / "report" / "REFUSALS.html").read_text(encoding="utf-8")
    assert [code for code in REFUSALS if f'id="{code}"' not in refusals] == []
    assert all((out / f"{page}.html").is_file() for page in pages.SHOWN)
    assert "<math" in (out / "lmshealth/modal/ambient/README.html").read_text(encoding="utf-8")
    for page in out.rglob("*.html"):
        loads = r'<(?:script|link|img|iframe)\b[^>]*(?:src|href)="(?:https?:)?//[^"]*"'
        assert re.findall(loads, page.read_text(encoding="utf-8")) == [], page
    assert "not-excited" in (out / "searchindex.js").read_text(encoding="utf-8")


@pytest.mark.slow
@pytest.mark.parametrize("link", ["../modal/MISSING.md", "../modal/README.md#no-such-heading"])
def test_a_broken_link_fails(tmp_path: Path, link: str) -> None:
    """Control: to a page, and to a heading, that is not there."""
    pytest.importorskip("myst_parser", reason="needs lmshealth[docs]")
    pytest.importorskip("furo", reason="needs lmshealth[docs]")
    for name, text in {
        "index.md": "# Home\n\n```{toctree}\nlmshealth/io/README\nlmshealth/modal/README\n```\n",
        "lmshealth/io/README.md": f"# io\n\n[a link]({link})\n",
        "lmshealth/modal/README.md": "# modal\n",
    }.items():
        pages.put(tmp_path / "source" / name, text.encode())
    built = build(tmp_path / "source", tmp_path / "site")
    assert built.returncode != 0 and link.rpartition("/")[2].partition("#")[0] in built.stderr


def test_the_contents_name_pages_of_the_repository() -> None:
    """Each is a README, another page or a notebook, or made from the package; none twice."""
    named = [page for group in pages.NAV.values() for page in group.values()]
    assert len(named) == len(set(named))
    for page in named:
        there = [ROOT / f"{page}{suffix}" for suffix in (".md", ".py")]
        assert page == "reference/python" or any(path.is_file() for path in there), page
