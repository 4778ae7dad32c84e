"""Skeleton of a description."""

from __future__ import annotations

from pathlib import Path

import pytest

from lmshealth.stage.description import ModeSpec, load_stage
from lmshealth.stage.skeleton import searches, write_skeleton


def test_searches_are_narrower_near_a_neighbour() -> None:
    """The default, twice the distance of the nearest mode, or the least."""
    assert searches([100.0]) == [0.15]
    assert searches([100.0, 104.0, 200.0]) == pytest.approx([0.0784, 0.0784, 0.15], abs=1e-3)
    assert searches([100.0, 100.2]) == [0.02, 0.02]


def test_any_name_is_quoted(tmp_path: Path) -> None:
    """Quotes, backslashes and wildcards in names mean themselves."""
    path = tmp_path / "my stage.toml"
    mode = ModeSpec("mode_1", 62.0, 0.02, snr=50.0)
    write_skeleton(path, 'in C:\\logs\\"a".csv\n\x7f', 'M[1]*"', [(mode, "± 0.1")])
    stage = load_stage(str(path))
    assert (stage.name, stage.modes) == ("my stage", (mode,))
    assert stage.description.source == 'in C:\\logs\\"a".csv\n\x7f'
    assert stage.description.match.stage == 'M[[]1][*]"'
