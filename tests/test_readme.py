"""What the README tells a newcomer to write is understood as it stands."""

from __future__ import annotations

import re
from pathlib import Path

from lmshealth.io.column_map import load_columns
from lmshealth.stage.description import load_stage


def test_files_of_the_first_five_minutes_are_understood(root: Path, tmp_path: Path) -> None:
    """The column map reads the columns that it names, the description follows a mode."""
    text = (root / "README.md").read_text(encoding="utf-8")
    columns, stage = re.findall(r"^```toml\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)
    (tmp_path / "map.toml").write_text(columns, encoding="utf-8")
    (tmp_path / "stage.toml").write_text(stage, encoding="utf-8")
    known = load_columns(tmp_path / "map.toml")
    assert known.target("PE(0)") == "delta_e_um"
    assert known.csv.skip_rows == 3
    described = load_stage(str(tmp_path / "stage.toml"))
    assert [mode.name for mode in described.modes] == ["pitch"]
    assert described.parameters == ()
