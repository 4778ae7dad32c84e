"""The public contract of an output folder, checked by a reader of its own."""

from __future__ import annotations

import csv
import math
import re
import shutil
from collections.abc import Callable
from datetime import date, datetime
from html.parser import HTMLParser
from pathlib import Path

import pytest
from click.testing import CliRunner

from lmshealth._private.tables import TABLES
from lmshealth.cli.main import main
from tests.signals import write_archive, write_archive_stage

QUANTILES = ("q05", "q10", "q25", "q50", "q75", "q90", "q95")
COLUMNS = {
    "modes": "log stage recorded_at travel_km temperature_c mode source frequency_hz "
    "frequency_std_hz damping_ratio damping_ratio_std correlation_f_zeta snr",
    "modes_cov": "log source_a mode_a source_b mode_b cov_ln_f",
    "track": "stage recorded_at travel_km mode frequency_hz frequency_std_hz damping_ratio "
    "damping_ratio_std drift drift_std",
    "track_cov": "stage recorded_at mode_a mode_b cov_drift",
    "effects": "stage mode covariate coefficient std",
    "events": "stage recorded_at travel_km kind mode source size std evidence",
    "health": "stage recorded_at travel_km parameter median q05 q25 q75 q95 ess r_hat converged "
    "sampler",
    "prognosis": "stage parameter limit censored_from probability_beyond_horizon service_by "
    + " ".join(f"rul_{unit}_{q}" for unit in ("km", "hours", "days") for q in QUANTILES),
    "verdict": "stage recorded_at verdict probability",
    "refused": "log channel mode source reason detail",
}
VERDICTS = {"healthy", "preload", "mount", "both", "step", "outside-map", "not-enough-data"}
SOURCES = {"acc", "delta_e", "frf", "joint"}
NOT_NUMBERS = re.compile(r"^[+-]?(nan|inf|infinity|none|null)$", re.IGNORECASE)
Row = dict[str, str]


class _Loads(HTMLParser):
    """Collect what a page loads: sources, style sheets, frames; links to click are no loading."""

    def __init__(self) -> None:
        super().__init__()
        self.found: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Keep the addresses that a browser fetches by itself."""
        given = {name: value or "" for name, value in attrs}
        self.found += [given[name] for name in ("src", "srcset", "poster", "data") if name in given]
        if tag in ("link", "use", "image"):
            self.found += [given[name] for name in ("href", "xlink:href") if name in given]


def read(path: Path) -> tuple[list[str], list[Row]]:
    """Read a table: its columns and rows."""
    with path.open(encoding="utf-8", newline="") as stream:
        reader = csv.DictReader(stream)
        rows = list(reader)
        return list(reader.fieldnames or ()), rows


def complaints(folder: Path) -> list[str]:
    """List everything in which an output folder breaks the contract."""
    found: list[str] = []
    tables: dict[str, list[Row]] = {}
    for name, columns in COLUMNS.items():
        path = folder / f"{name}.csv"
        if not path.is_file():
            found.append(f"{name}.csv is not there")
            tables[name] = []
            continue
        there, tables[name] = read(path)
        if missing := set(columns.split()) - set(there):
            found.append(f"{name}.csv lacks {sorted(missing)}")
        cells = [cell for row in tables[name] for cell in row.values()]
        if any(NOT_NUMBERS.match(cell or "") for cell in cells):
            found.append(f"{name}.csv has a cell that is no number")
    if found:
        return found
    checks = (_moments, _modes, _track, _health, _prognosis, _verdicts)
    return [c for check in checks for c in check(tables)] + _pages(folder, tables)


def _moments(tables: dict[str, list[Row]]) -> list[str]:
    moments = [
        row["recorded_at"] for rows in tables.values() for row in rows if "recorded_at" in row
    ]
    return [
        f"{moment!r} is no moment with a zone"
        for moment in moments
        if moment and datetime.fromisoformat(moment).tzinfo is None
    ]


def _modes(tables: dict[str, list[Row]]) -> list[str]:
    found = []
    for row in tables["modes"]:
        if row["source"] not in SOURCES:
            found.append(f"source {row['source']!r}")
        numbers = [float(row[k]) for k in ("frequency_hz", "frequency_std_hz", "snr")]
        numbers += [float(row[k]) for k in ("damping_ratio", "damping_ratio_std")]
        if min(numbers) <= 0 or abs(float(row["correlation_f_zeta"])) >= 1:
            found.append(f"mode {row['mode']} of {row['log']} has impossible numbers")
    keys = [(row["log"], row["mode"], row["source"]) for row in tables["modes"]]
    if len(set(keys)) != len(keys):
        found.append("a mode stands twice in modes.csv")
    known = {(row["log"], row["source"], row["mode"]) for row in tables["modes"]}
    found += [
        f"modes_cov.csv names {row['mode_a']}, which modes.csv does not have"
        for row in tables["modes_cov"]
        if (row["log"], row["source_a"], row["mode_a"]) not in known
    ]
    return found


def _track(tables: dict[str, list[Row]]) -> list[str]:
    std = {(r["recorded_at"], r["mode"]): float(r["drift_std"] or 0) for r in tables["track"]}
    found = []
    for row in tables["track_cov"]:
        bound = std[row["recorded_at"], row["mode_a"]] * std[row["recorded_at"], row["mode_b"]]
        if abs(float(row["cov_drift"] or 0)) > bound * (1 + 1e-9):
            found.append(f"track_cov.csv at {row['recorded_at']} is no covariance")
    return found


def _health(tables: dict[str, list[Row]]) -> list[str]:
    found = []
    for row in tables["health"]:
        values = [float(row[key]) for key in ("q05", "q25", "median", "q75", "q95")]
        if values != sorted(values):
            found.append(f"health quantiles of {row['parameter']} are out of order")
        if row["converged"] != "True":
            found.append(f"converged is {row['converged']!r}")
        if row["sampler"] not in ("emcee", "importance"):
            found.append(f"sampler is {row['sampler']!r}")
    return found


def _prognosis(tables: dict[str, list[Row]]) -> list[str]:
    found = []
    for row in tables["prognosis"]:
        name = row["parameter"]
        if not 0 <= float(row["probability_beyond_horizon"]) <= 1:
            found.append(f"probability_beyond_horizon of {name}")
        if row["service_by"]:
            date.fromisoformat(row["service_by"])
        for unit in ("km", "hours", "days"):
            cells = [row[f"rul_{unit}_{q}"] for q in QUANTILES]
            filled = [float(cell) for cell in cells if cell]
            n = len(filled)
            if filled != sorted(filled) or min(filled, default=0.0) < 0:
                found.append(f"rul_{unit} quantiles of {name} are out of order")
            if any(cells[n:]):
                found.append(f"rul_{unit} of {name} has a gap before a number")
            level = int(QUANTILES[n][1:]) / 100 if n < len(QUANTILES) else math.nan
            told = float(row["censored_from"] or "nan")
            if not (math.isnan(level) and math.isnan(told)) and not math.isclose(level, told):
                found.append(f"censored_from of {name} is {told}, quantiles end at {level}")
    rows = {(row["stage"], row["parameter"]) for row in tables["prognosis"]}
    found += [f"prognosis of {stage} lacks any" for stage, _ in rows if (stage, "any") not in rows]
    return found


def _verdicts(tables: dict[str, list[Row]]) -> list[str]:
    found = [f"verdict {r['verdict']!r}" for r in tables["verdict"] if r["verdict"] not in VERDICTS]
    for row in tables["verdict"]:
        known = row["verdict"] != "not-enough-data"
        if known and not 0 <= float(row["probability"]) <= 1:
            found.append(f"probability of {row['stage']}")
    stages = {row["stage"] for row in tables["modes"]}
    if {row["stage"] for row in tables["verdict"]} != stages:
        found.append("verdict.csv does not have one row per stage")
    if any(not row["reason"] or not row["log"] for row in tables["refused"]):
        found.append("a refusal without its log or reason")
    return found


def _pages(folder: Path, tables: dict[str, list[Row]]) -> list[str]:
    index = folder / "index.html"
    if not index.is_file():
        return ["index.html is not there"]
    pages = [folder / f"{row['stage']}.html" for row in tables["verdict"]]
    found = [f"{page.name} is not there" for page in pages if not page.is_file()]
    text = index.read_text(encoding="utf-8")
    found += [f"index.html does not link {p.name}" for p in pages if f'href="{p.name}"' not in text]
    for page in [index, *(page for page in pages if page.is_file())]:
        text = page.read_text(encoding="utf-8")
        reader = _Loads()
        reader.feed(text)
        loaded = reader.found + re.findall(r"url\(\s*['\"]?([^'\")]+)", text)
        loaded += re.findall(r"@import\s+['\"]([^'\"]+)", text)
        found += [
            f"{page.name} loads {address[:60]}"
            for address in loaded
            if not address.startswith(("data:", "#"))
        ]
        if re.search(r"\b(fetch|XMLHttpRequest|WebSocket|sendBeacon)\b", text):
            found.append(f"{page.name} reaches out by script")
    return found


@pytest.fixture(scope="module")
def output(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Run the command on a small archive, one log of which is broken."""
    folder = tmp_path_factory.mktemp("contract")
    stage = write_archive_stage(folder / "stage")
    logs = write_archive(folder / "logs", 6)
    (logs / "broken.h5").write_bytes(b"nothing")
    out = folder / "out"
    done = CliRunner().invoke(
        main,
        ["run", str(logs), "--stage", str(stage), "--out", str(out), "--workers", "1",
         "--epochs", "2", "--today", "2024-02-21"],
    )  # fmt: skip
    assert done.exit_code == 3, done.output
    # On the day after the last log: years later the machine is unknown.
    assert "test-A: healthy" in done.stdout
    return out


@pytest.mark.slow
def test_an_output_folder_keeps_the_contract(output: Path) -> None:
    """Tables, their numbers and words, and the pages are as written in the contract."""
    assert complaints(output) == []
    assert {"prognosis", "health", "track", "track_cov"} <= {
        path.stem for path in output.glob("*.csv") if len(read(path)[1])
    }


def _first_row(path: Path, **cells: str) -> None:
    """Change cells of the first row of a table."""
    columns, rows = read(path)
    rows[0].update(cells)
    with path.open("w", encoding="utf-8", newline="") as stream:
        writer = csv.DictWriter(stream, columns)
        writer.writeheader()
        writer.writerows(rows)


BREAKS: dict[str, Callable[[Path], object]] = {
    "health quantiles": lambda out: _first_row(out / "health.csv", q95="0.01"),
    "rul_days quantiles": lambda out: _first_row(out / "prognosis.csv", rul_days_q05="9e9"),
    "has a gap": lambda out: _first_row(out / "prognosis.csv", rul_km_q25=""),
    "censored_from": lambda out: _first_row(out / "prognosis.csv", censored_from="0.75"),
    "verdict 'fine'": lambda out: _first_row(out / "verdict.csv", verdict="fine"),
    "no number": lambda out: _first_row(out / "track.csv", drift="nan"),
    "no covariance": lambda out: _first_row(out / "track_cov.csv", cov_drift="1.0"),
    "refused.csv is not there": lambda out: (out / "refused.csv").unlink(),
    "test-A.html is not there": lambda out: (out / "test-A.html").unlink(),
    "loads https://": lambda out: _append(
        out / "index.html", '<script src="https://example.org/x.js"></script>'
    ),
    "loads font.woff": lambda out: _append(
        out / "test-A.html", "<style>@font-face { src: url(font.woff) }</style>"
    ),
}


def _append(path: Path, text: str) -> None:
    with path.open("a", encoding="utf-8") as stream:
        stream.write(text)


@pytest.mark.slow
@pytest.mark.parametrize("complaint", list(BREAKS))
def test_the_check_notices_a_broken_contract(output: Path, tmp_path: Path, complaint: str) -> None:
    """Negative control: each change that breaks the contract is complained about by name."""
    out = tmp_path / "out"
    shutil.copytree(output, out)
    BREAKS[complaint](out)
    assert any(complaint in item for item in complaints(out)), complaints(out)


def _moment(cell: str) -> None:
    if datetime.fromisoformat(cell).tzinfo is None:
        raise ValueError


# What reads a cell of a column with this type; all others are numbers with a unit.
READERS: dict[str, Callable[[str], object]] = {
    "text": str,
    "moment": _moment,
    "day": date.fromisoformat,
    "flag": {"True": True, "False": False}.__getitem__,
    "count": int,
}


def wrong_types(name: str, rows: list[Row]) -> list[str]:
    """List the cells of a table that are not of the type of their column."""
    units, found = TABLES[name].units, []
    for row in rows:
        for column, cell in row.items():
            unit = units.get(column, "1")
            try:
                if cell:
                    READERS.get(unit, float)(cell)
            except (KeyError, ValueError):
                found.append(f"{name}.{column} ({unit}): {cell!r}")
    return found


@pytest.mark.slow
def test_cells_have_the_types_of_their_columns(output: Path) -> None:
    """Every cell of every file is a number, a moment, a day or a flag as specified."""
    assert [one for name in TABLES for one in _wrong_of_file(output / f"{name}.csv")] == []


def _wrong_of_file(path: Path) -> list[str]:
    return wrong_types(path.stem, read(path)[1]) if path.is_file() else []


def test_a_cell_of_another_type_is_found() -> None:
    """The check reports a word in a column of numbers, and a moment without its zone."""
    right = {"recorded_at": "2026-01-02T03:04:05+00:00", "travel_km": "1.5", "declared": "True"}
    assert wrong_types("events", [right]) == []
    for column, cell in (("travel_km", "far"), ("recorded_at", "2026-01-02"), ("declared", "1")):
        (found,) = wrong_types("events", [right | {column: cell}])
        assert found.startswith(f"events.{column} ")
