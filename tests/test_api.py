"""What `import lmshealth` gives: few names, typed, each fetched when it is asked for."""

from __future__ import annotations

import importlib
import inspect
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

import lmshealth

# `save` and `load` came with the types of results, which need no example of their own;
# `check_calibration` is a question that each description raises.
MOST_NAMES = 25
CLASSES = "LmshealthError", "LogEstimates", "Settings"
FUNCTIONS = sorted(name for name in lmshealth.__all__ if name.islower() or name in CLASSES)
# Of these nothing is needed to import the package or to show help, and all take their time.
HEAVY = (
    *(
        "pandas",
        "scipy",
        "matplotlib",
        "sqlalchemy",
        "loky",
        "h5py",
        "pyarrow",
        "arviz_base",
        "emcee",
    ),
    *("filterpy", "control", "jinja2", "dask", "distributed", "weasyprint", "xarray"),
)
# What a user's own program may look like: every name is used, and every result has its type.
CLIENT = """
from pathlib import Path

import lmshealth
from lmshealth.tracking.read_tables import Drifts


def assessed(folder: Path) -> str:
    stage = lmshealth.load_stage("lms-y")
    readings = []
    for path in folder.glob("*.h5"):
        try:
            log = lmshealth.read_log(path)
        except lmshealth.LmshealthError:
            continue
        modes = lmshealth.identify(log, stage)
        rung = lmshealth.identify_decays(log, stage)
        response = lmshealth.read_frf(log, "current_excitation", "acc_pitch", band=(95.0, 175.0))
        for one in (modes, rung, response.modes):
            readings.append(lmshealth.LogEstimates(log.name, log.digest, log.metadata, one))
    readings.append(lmshealth.merge_setups(readings[:2]))
    history, refused = lmshealth.build_history(readings, stage)
    track = lmshealth.track(history, stage)
    history = lmshealth.accepted_estimates(history, track, doubtful=True)
    health = lmshealth.infer(history, stage, seed=0)
    shown = Drifts("AX", track.recorded_at, track.travel, track.modes, track.drift, track.drift_cov)
    alone = lmshealth.infer_drifts(shown, stage, seed=0)
    laws = lmshealth.fit_life(history, stage, seed=0, chains=False)
    prognosis = lmshealth.prognose(history, stage, seed=0)
    day = lmshealth.decide(prognosis, stage.description.decision).by
    told: str = lmshealth.judge(stage, history, health, track).why
    assessment = lmshealth.assess(readings, stage, epochs=5)
    lmshealth.save(assessment, str(folder / "one"))
    again: lmshealth.Health = lmshealth.load(folder / "two", lmshealth.Health)
    given: lmshealth.Track = track
    told = lmshealth.analyse(folder, stage).judgement.why
    plan = lmshealth.plan(stage, "guide_preload", 0.05)
    checked: dict[str, bool] = lmshealth.check_calibration(stage, lives=5, workers=2).passed
    result = lmshealth.run(folder, [stage], folder / "out", lmshealth.Settings(workers=2))
    assert checked
    reveal_type(  # noqa: F821
        (refused, alone, laws, day, assessment.judgement.verdict, plan.duration_of_one, result)
    )
    return told
"""


def _run(*words: str) -> str:
    done = subprocess.run([sys.executable, *words], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.mark.slow
def test_names_are_few_and_at_home() -> None:
    """There are few names beside results; each is what its home calls so, and all can be listed."""
    assert len(FUNCTIONS) <= MOST_NAMES
    assert set(lmshealth.__all__) <= set(dir(lmshealth))
    for name in lmshealth.__all__:
        found = getattr(lmshealth, name)
        assert found.__name__ == name
        home = importlib.import_module(found.__module__)
        assert getattr(home, name) is found


def test_no_other_name_is_found() -> None:
    """A name that is not there is an error, as in any module."""
    with pytest.raises(AttributeError, match="no attribute 'prognosis_of'"):
        lmshealth.prognosis_of  # type: ignore[attr-defined]  # noqa: B018


@pytest.mark.parametrize("name", lmshealth.__all__)
def test_every_name_is_typed_and_documented(name: str) -> None:
    """Every parameter and every result has a type, and every name says what it is for."""
    found = getattr(lmshealth, name)
    assert inspect.getdoc(found)
    if name == "LmshealthError":
        return
    signature = inspect.signature(found)
    untyped = [p.name for p in signature.parameters.values() if p.annotation is p.empty]
    assert not untyped
    assert inspect.isclass(found) or signature.return_annotation is not signature.empty


@pytest.mark.slow
def test_a_type_checker_knows_every_name(tmp_path: Path, root: Path) -> None:
    """A program that uses every name passes strict checks, and no result of it is of any type."""
    pytest.importorskip("mypy")
    assert all(f"lmshealth.{name}" in CLIENT for name in FUNCTIONS)
    program = tmp_path / "client.py"
    program.write_text(CLIENT)
    check = ["-m", "mypy", "--strict", "--config-file", str(root / "pyproject.toml")]
    cache = ["--cache-dir", str(root / ".mypy_cache")]
    told = _run(*check, *cache, str(program))
    (revealed,) = (line for line in told.splitlines() if "Revealed type" in line)
    assert "Any" not in revealed
    for expected in ("Refusal", "Health", "LifePosterior", "date", "str", "int", "RunResult"):
        assert expected in revealed, expected
    # And a slip is found: the names are not of a module in which anything may be.
    program.write_text("import lmshealth\n\nlmshealth.prognose_all\n")
    done = subprocess.run(
        [sys.executable, *check, *cache, str(program)], capture_output=True, text=True, check=False
    )
    assert 'no attribute "prognose_all"' in done.stdout


def test_the_wheel_says_that_it_is_typed(root: Path) -> None:
    """The marker that makes type checkers look inside is there, and is packed."""
    settings = tomllib.loads((root / "pyproject.toml").read_text())
    assert "py.typed" in settings["tool"]["setuptools"]["package-data"]["lmshealth"]
    assert (root / "lmshealth" / "py.typed").is_file()


@pytest.mark.parametrize("what", ["lmshealth", "lmshealth.cli.main"])
def test_import_leaves_heavy_libraries_alone(what: str) -> None:
    """What a name or a command needs comes with it, and not before."""
    told = _run("-c", f"import sys, {what}; print(*sys.modules)")
    assert not set(told.split()) & set(HEAVY)


@pytest.mark.parametrize("command", ["", "run", "watch", "report"])
def test_help_leaves_what_runs_alone(command: str) -> None:
    """The list of commands, and help of those on archives, need no store, workers or statistics."""
    code = (
        "import contextlib, io, sys\nfrom lmshealth.cli.main import main\n"
        "with contextlib.redirect_stdout(io.StringIO()) as text:\n"
        f"    main({[*filter(None, [command]), '--help']}, standalone_mode=False)\n"
        "assert 'Usage' in text.getvalue()\nprint(*sys.modules)"
    )
    assert not set(_run("-c", code).split()) & {"scipy.stats", "sqlalchemy", "loky", "matplotlib"}


def test_an_assessment_needs_no_store_and_no_workers() -> None:
    """Machines are assessed by a pure function, without database, processes and pages."""
    told = _run(
        "-c", "import sys, lmshealth; lmshealth.assess, lmshealth.decide; print(*sys.modules)"
    )
    assert not set(told.split()) & {"sqlalchemy", "loky", "jinja2", "matplotlib"}


@pytest.mark.slow
def test_what_is_asked_for_brings_no_database() -> None:
    """Who reads, identifies and infers pays for no store, no pages and no pictures."""
    names = "read_log, identify, load_stage, track, infer, prognose, judge"
    told = _run("-c", f"import sys; from lmshealth import {names}; print(*sys.modules)")
    assert not set(told.split()) & {"sqlalchemy", "jinja2", "matplotlib", "h5py", "arviz_base"}


def test_help_and_refusals_import_nothing_slow(tmp_path: Path) -> None:
    """Of all commands, and of a log that cannot be read: waiting for it helps nobody."""
    (tmp_path / "log.csv").write_text("no,log\n")
    calls = [[name, "--help"] for name in ("modes", "track", "stage", "run")]
    calls.append(["modes", str(tmp_path / "log.csv"), "--stage", "lms-y"])
    lines = (
        "import sys",
        "from lmshealth.cli.main import main",
        f"print([main(call, standalone_mode=False) for call in {calls}], file=sys.stderr)",
        "print(*sys.modules)",
    )
    found = set(_run("-c", "\n".join(lines)).split())
    assert "lmshealth.cli.log_commands" in found
    assert not found & {"scipy.stats", "scipy.signal", "pandas", "sqlalchemy", "matplotlib"}


def test_the_command_line_keeps_linear_algebra_to_one_thread() -> None:
    """It says so before numpy is loaded, which is too late for one that is loaded already."""
    lines = (
        "import os",
        "for name in ('OMP_NUM_THREADS', 'OPENBLAS_NUM_THREADS'): os.environ.pop(name, None)",
        "import lmshealth.cli.main, scipy.linalg, threadpoolctl",
        "print({pool['num_threads'] for pool in threadpoolctl.threadpool_info()})",
    )
    assert _run("-c", "\n".join(lines)).strip() == "{1}"
