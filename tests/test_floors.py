"""The floors: a module imports only from lower floors, and models and lmshealth never meet."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

FLOORS = [
    {"errors", "addresses"},
    {"arrays", "toml", "packing", "files", "workers", "database", "progress", "svg"},
    {"samples", "pdf"},
    {"logs"},
    {"results", "tracks"},
    {
        "readers",
        "segments",
        "harmonics",
        "priors",
        "modalmap",
        "tones",
        "layout",
        "components",
        "wording",
        "rowfile",
        "filterbank",
        "metrics",
        "condense",
    },
    {
        "laws",
        "maintenance",
        "spectra",
        "following",
        "transient",
        "periods",
        "rational",
        "noise",
        "hypotheses",
        "tracktable",
        "estimates",
        "markup",
    },
    {
        "stage",
        "kernel",
        "starts",
        "linetest",
        "restricted",
        "responses",
        "responsefit",
        "newcomers",
    },
    {"blocks", "targets", "identities", "statespace", "courses", "decision"},
    {
        "peaks",
        "band",
        "whittle",
        "lines",
        "magnitudes",
        "waterfall",
        "decayfit",
        "bounds",
        "naming",
        "association",
        "bank",
    },
    {"posterior", "events", "laplace"},
    {"bandfit"},
    {"separation"},
    {"modal", "frf", "history", "ringing", "sampling", "importance", "passage"},
    {"tracking", "smoothing", "decay", "survey", "sight", "modetable", "epoch"},
    {"inference", "planning", "examination", "life", "influences", "examples"},
    {"findings", "density"},
    {"lifefit"},
    {"prognosis"},
    {"verdict", "fleet"},
    {"summary", "plots", "fleetfacts"},
    {"changes", "tables", "trackplots"},
    {"store", "trackfacts", "healthfacts", "brief"},
    {"index", "assessing"},
    {"report", "intake"},
    {"telling"},
    {"batch"},
    {"pipeline", "terminal", "options", "looks"},
    {"stageview", "lifeview", "logview", "machineview", "planview"},
    {"lifecommands", "batchcommands"},
    {"commands"},
    {"cli"},
    {"__main__"},
]
MODEL_FLOORS = [
    {"errors"},
    {"structure", "servo", "profile"},
    {"stages"},
    {"plant", "equations", "machines"},
    {"calibration", "mapping", "modal", "disturbance", "margins", "shapes"},
    {"recording"},
    {"formats", "degradation", "sweep", "strokes", "faults"},
    {"lives", "velocities"},
    {"__main__"},
]


def _imports(path: Path) -> set[str]:
    """Dotted names of all modules that a file imports, at any depth of its code."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names |= {node.module} | {f"{node.module}.{alias.name}" for alias in node.names}
    return names


def _room(path: Path, package: Path) -> str:
    inner = path.relative_to(package)
    return inner.parts[0] if len(inner.parts) > 1 else inner.stem


@pytest.mark.parametrize(("name", "floors"), [("lmshealth", FLOORS), ("models", MODEL_FLOORS)])
def test_modules_import_only_from_lower_floors(
    root: Path, name: str, floors: list[set[str]]
) -> None:
    """Every import inside a package goes down, never sideways and never up."""
    level = {room: k for k, rooms in enumerate(floors) for room in rooms}
    package = root / name
    wrong = []
    for path in sorted(package.rglob("*.py")):
        room = _room(path, package)
        if room == "__init__":
            continue
        assert room in level, f"{path.name} stands on no floor: add it to the test"
        for imported in _imports(path):
            parts = imported.split(".")
            if parts[0] != name or len(parts) < 2 or parts[1] in (room, "__init__"):
                continue
            target = parts[1]
            if target in level and level[target] >= level[room]:
                wrong.append(f"{room} imports {target}")
            elif target not in level and (package / f"{target}.py").exists():
                wrong.append(f"{room} imports {target}, which stands on no floor")
    assert not wrong


@pytest.mark.parametrize(("package", "other"), [("lmshealth", "models"), ("models", "lmshealth")])
def test_models_and_lmshealth_never_import_each_other(root: Path, package: str, other: str) -> None:
    """Truth and estimator share no code, so that no mistake can cancel itself."""
    for path in sorted((root / package).rglob("*.py")):
        assert not [name for name in _imports(path) if name.split(".")[0] == other], path


def test_floors_notice_an_import_that_goes_up(tmp_path: Path) -> None:
    """The reader of imports sees imports at the top, inside functions, and of names."""
    file = tmp_path / "room.py"
    file.write_text("def f():\n    from lmshealth.cli import main\nimport models.plant as p\n")
    assert {"lmshealth.cli", "lmshealth.cli.main", "models.plant"} <= _imports(file)
