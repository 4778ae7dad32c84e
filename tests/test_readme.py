"""The READMEs: their links lead somewhere, and what they tell a newcomer to write is understood."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from lmshealth.io.column_map import load_columns
from lmshealth.stage.description import load_stage

ROOT = Path(__file__).parents[1]
_LINK = re.compile(r"\[[^]]*\]\(([^)#:\s]+)(?:#[^)]*)?\)")
_PAGES = sorted(
    path.relative_to(ROOT).as_posix()
    for top in ("lmshealth", "models", "studies")
    for path in (ROOT / top).rglob("README.md")
)


def test_files_of_the_first_five_minutes_are_understood(root: Path, tmp_path: Path) -> None:
    """The column map reads the columns that it names, the description follows a mode."""
    text = (root / "README.md").read_text(encoding="utf-8")
    columns, stage = re.findall(r"^```toml\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)
    (tmp_path / "map.toml").write_text(columns, encoding="utf-8")
    (tmp_path / "stage.toml").write_text(stage, encoding="utf-8")
    known = load_columns(tmp_path / "map.toml")
    assert known.target("PE(0)") == "delta_e_um"
    assert known.csv.skip_rows is None
    described = load_stage(str(tmp_path / "stage.toml"))
    assert [mode.name for mode in described.modes] == ["pitch"]
    assert described.parameters == ()


def test_the_first_page_stays_short(root: Path) -> None:
    """The README of the project has at most 150 lines."""
    assert len((root / "README.md").read_text(encoding="utf-8").splitlines()) <= 150


@pytest.mark.parametrize("page", ["README.md", *_PAGES])
def test_links_lead_somewhere(root: Path, page: str) -> None:
    """Every link of a page to a file leads to one."""
    text = (root / page).read_text(encoding="utf-8")
    links = set(_LINK.findall(re.sub(r"```.*?```", "", text, flags=re.S)))
    assert not [link for link in links if not ((root / page).parent / link).exists()]


def test_every_folder_has_a_page(root: Path) -> None:
    """Every folder of the package, and the simulated stages and the studies, open with a README."""
    folders = {path.parent for path in (root / "lmshealth").rglob("__init__.py")}
    folders |= {root / "models", root / "studies"}
    assert not [folder for folder in sorted(folders) if not (folder / "README.md").is_file()]
