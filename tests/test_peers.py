"""The tables of peers are computed from the records, and say where a peer is better."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from studies.harness.peers import PEER, STUDIES, lines

PEERS = (
    "pyOMA2", "pyoma-toolbox", "koma", "simdkalman", "statsmodels", "progpy",
    "plain particle filter",
)  # fmt: skip


def rows(text: list[str]) -> list[list[str]]:
    """Return the cells of all rows but the headings."""
    cells = [line.strip("| ").split(" | ") for line in text if line.startswith("| ")]
    return [row for row in cells if row[0] not in ("peer", "---")]


def test_every_peer_has_a_row_and_some_are_better() -> None:
    """All seven peers have rows, and what is recorded has rows in which a peer is better."""
    found = rows(lines())
    for name in PEERS:
        assert any(row[0].startswith(name) for row in found), name
    recorded = [row for row in found if row[1] != "not recorded"]
    assert not recorded or any(PEER in row[-1] for row in recorded)
    # Of sets of others no time is taken.
    koma = [row for row in recorded if row[0].startswith("koma")]
    assert all(("time" in row[-1]) == (" by others" not in row[1]) for row in koma)


def test_peers_without_records_are_named(tmp_path: Path) -> None:
    """Peers whose studies are not recorded are named, without figures."""
    found = rows(lines(tmp_path))
    assert {row[0] for row in found} >= set(PEERS)
    assert {row[1] for row in found} == {"not recorded"}


def test_the_page_has_marks_for_the_tables() -> None:
    """The page of the peers has marks for the tables."""
    page = (STUDIES / "PEERS.md").read_text(encoding="utf-8")
    assert page.count("<!-- claims -->") == page.count("<!-- end of claims -->") == 1


def write(path: Path, record: dict[str, Any]) -> None:
    """Write a record."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(record), encoding="utf-8")


def test_modes_are_compared_on_the_records_of_the_peer(tmp_path: Path) -> None:
    """Of ours only the records count that a peer searched; small differences are equal."""
    peer = {
        "records": 2, "there": 40, "found": 20, "false": 0, "time_over_ours": 0.1,
        "errors": {"f": {"n": 0}, "zeta": {"n": 0}}, "coverage": {},
    }  # fmt: skip
    family = {
        "coverage": {"f": {"hits": 99, "n": 100}},
        "imperfect": [
            {"seed": 1, "missed_hz": [3.0], "false_hz": [1.0] * 9},
            {"seed": 2, "missed_hz": [3.0] * 9, "false_hz": []},
        ],
        "others": {
            "koma SSI": peer,
            "pyOMA2 SSI, Neu": peer
            | {
                "found": 38,
                "false": 8,
                "time_over_ours": 1.1,
                "errors": {
                    "f": {"n": 38, "ours": 0.001, "theirs": 0.0008, "worse_by": [-3.6e-7, 1e-7]},
                    "zeta": {"n": 38, "ours": 0.1, "theirs": 0.11, "worse_by": [0.0021, 0.0011]},
                },
                "coverage": {"f": {"hits": 30, "n": 38}},
            },
            "peaks of single channels": peer,
        },
    }
    path = tmp_path / "modes" / "without_description" / "result.json"
    write(path, {"families": {"a family": family}})
    koma, pyoma2, *_ = rows(lines(tmp_path))
    assert koma[:4] == ["koma SSI", "a family, 2 records", "39 of 40, 9", "20 of 40, 0"]
    assert koma[4:] == [
        "99 of 100; states none", "0.1", f"found: lmshealth; others: {PEER}; time: {PEER}",
    ]  # fmt: skip
    assert pyoma2[2:5] == ["39 of 40, 9; 0.1 %, 10 %", "38 of 40, 8; 0.08 %, 11 %",
                           "99 of 100; 30 of 38"]  # fmt: skip
    who = f"found: equal; others: equal; f: {PEER}; ζ: equal; intervals: lmshealth; time: equal"
    assert pyoma2[-1] == who


@pytest.mark.parametrize(("shift", "better"), [(-60.0, PEER), (60.0, "lmshealth"), (0.0, "equal")])
def test_lives_are_compared_in_pairs(tmp_path: Path, shift: float, better: str) -> None:
    """Lives differ more than programs: their difference on the same lives decides."""
    rng = np.random.default_rng(3)
    score = rng.uniform(0, 1000, 24)
    none = {"held": [0, 0], "width": None, "crps": [None] * 24, "square": [None] * 24}

    def program(values: list[float | None]) -> dict[str, Any]:
        left = {"held": [22, 24], "width": 1.0, "crps": values, "square": values}
        return {"preload": {"n": 24, "cpu_s": 1.0, "health": none, "left": left}}

    theirs: list[float | None] = (score + shift + rng.normal(0, 30, 24)).tolist()
    theirs[5] = None  # a life without a prediction
    programs = {"lmshealth": program(score.tolist()), "progpy": program(theirs)}
    write(tmp_path / "life" / "peers.json", {"programs": programs})
    (row,) = (row for row in rows(lines(tmp_path)) if row[0] == "progpy")
    assert row[-1] == f"life: {better}; life, intervals: equal; time: equal"
