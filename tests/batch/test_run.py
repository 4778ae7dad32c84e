"""The main job: everything is written, nothing is done twice, and nothing but the logs matters."""

from __future__ import annotations

import csv
import json
import os
import shutil
import sqlite3
import subprocess
import sys
import threading
from collections import Counter
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import dataclass, replace
from datetime import date, datetime
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import h5py
import numpy as np
import pytest
from click.testing import CliRunner
from msgspec import structs
from sqlalchemy import text

from lmshealth import examples
from lmshealth._private.serialize import pack, unpack
from lmshealth._private.tables import RUN_TABLES
from lmshealth.batch import assess as assessing
from lmshealth.batch import constants, workers
from lmshealth.batch import ingest as ingesting
from lmshealth.batch import run as running
from lmshealth.batch.alerts import Alerts
from lmshealth.batch.assess import Machine
from lmshealth.batch.ingest import Settings
from lmshealth.batch.run import RunResult, report, run
from lmshealth.batch.store import PackedAssessment, Store, default_url, unpack_or_none
from lmshealth.cli.main import main
from lmshealth.errors import LmshealthError, NotConverged, NothingUsable
from lmshealth.io.column_map import ColumnMap
from lmshealth.io.constants import LAST_MOMENT
from lmshealth.io.log import Log
from lmshealth.io.reading import content_digest
from lmshealth.life.fleet_prior import EndedLife, FleetPrior, LawPrior
from lmshealth.life.health import epochs_to_publish, infer
from lmshealth.life.posterior import fit as life_posterior
from lmshealth.life.posterior.fit import fit_life
from lmshealth.life.posterior.likelihood import scatter_prior
from lmshealth.life.prognosis import prognose
from lmshealth.machine import assessment as machine_assessment
from lmshealth.machine.assessment import Assessment, LifeState, assess_from
from lmshealth.machine.summary import Summary, summarise
from lmshealth.modal import identification
from lmshealth.modal.identification import ModalReading, read_modes
from lmshealth.modal.log_estimates import LogEstimates
from lmshealth.report.pages import make_page
from lmshealth.stage.description import LifeSpec, Stage, load_stage
from lmshealth.stage.priors import Lognormal
from lmshealth.tracking.maintenance import NO_MAINTENANCE
from lmshealth.tracking.read_tables import read_estimates
from lmshealth.tracking.track import accepted_estimates, track
from studies.cost.new_log.life import apart
from studies.harness import servers
from studies.modes.frf import hammer
from tests.assessments import Maker, make, tables_of
from tests.signals import ARCHIVE_MODES, sine, write_archive, write_archive_stage, write_log
from tests.stops import Ring, stop

__all__ = ["make"]

N_LOGS = 6

COUNT = f"SELECT count(*) FROM values_{constants.SCHEMA} WHERE kind = '{{}}'"
UPDATE = f"UPDATE values_{constants.SCHEMA} SET content = x'00' WHERE kind = 'assessed'"


def rows(path: Path) -> list[dict[str, str]]:
    """Read a table."""
    with path.open(encoding="utf-8", newline="") as stream:
        return list(csv.DictReader(stream))


def pages(out: Path) -> dict[str, bytes]:
    """Read all pages of an output folder as bytes."""
    return {path.name: path.read_bytes() for path in sorted(out.glob("*.html"))}


def tables(out: Path) -> dict[str, bytes]:
    """Read all tables of an output folder as bytes, but for what is new since the run before."""
    # Logs of another year are a silence, which is announced once, whatever options a run has.
    return {
        path.name: path.read_bytes() for path in sorted(out.glob("*.csv")) if path.stem != "changes"
    }


def assessments(out: Path) -> list[Assessment]:
    """Fetch what a run kept of its machines."""
    with closing(Store(default_url(out), create=False)) as store:
        packed = [store.get("assessed", one.key, one.machine) for one in store.published()]
    return [unpack_or_none(content, Assessment) for content in packed if content is not None]


@dataclass(frozen=True)
class Done:
    """A full run over an archive with three bad logs, what it wrote, and where."""

    logs: Path
    out: Path
    stage: Stage
    result: RunResult
    written: dict[str, bytes]
    pages: dict[str, bytes]


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory) -> Done:
    """Run the main job once on good logs, a copy, a broken file and a foreign machine."""
    folder = tmp_path_factory.mktemp("archive")
    stage = load_stage(str(write_archive_stage(folder / "stage")))
    logs = write_archive(folder / "logs", N_LOGS)
    (logs / "later").mkdir()
    shutil.copy(logs / "log-00.h5", logs / "later" / "copy.h5")
    (logs / "broken.h5").write_bytes(b"no signal at all" * 100)
    write_log(logs / "foreign.h5", 1.0, 40, stage="other-Z")
    out = folder / "out"
    result = run(logs, [stage], out, Settings(epochs=2))
    return Done(logs, out, stage, result, tables(out), pages(out))


@pytest.fixture
def modes_only(tmp_path: Path) -> Stage:
    """Load a description without health parameters: quick to run."""
    return load_stage(str(write_archive_stage(tmp_path / "stage", health=False)))


def write_other_log(path: Path, day: int, rate: float, signals: dict[str, np.ndarray]) -> None:
    """Write a log of the archive's machine with columns of other kinds."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with h5py.File(path, "w") as file:
        for column, values in signals.items():
            file[column] = values
        file.attrs.update(stage="test-A", recorded_at=f"2024-03-{day:02d}T08:00:00Z",
                          travel_km=f"{1000 + day}", sample_rate_hz=f"{rate:g}")  # fmt: skip


def test_blows_and_stops_are_rows_of_modes(tmp_path: Path, modes_only: Stage) -> None:
    """A folder of ambient vibration, of blows and of stops gives both modes of each log.

    Estimates are within four standard deviations of the truth. Those of one response are
    correlated, those of different bands of decays are not.
    """
    logs, rng = tmp_path / "logs", np.random.default_rng(5)
    write_log(logs / "ambient.h5", 1.0, 0)
    truth = {name: (f, zeta) for name, f, zeta, _ in ARCHIVE_MODES}
    for day in (1, 2):
        modes = tuple((f, zeta, 1.0) for f, zeta in truth.values())
        force, answer = hammer.strike(rng, hammer.Hammer(modes, blows=3, seconds=1.0))
        signals = {"current_force_a": force, "acc_feed_m_s2": answer}
        write_other_log(logs / f"blows-{day}.h5", day, hammer.RATE, signals)
    rings = [Ring(f, zeta, ambient=0.02) for f, zeta in truth.values()]
    parts = [
        (rng.standard_normal(150), stop(rng, rings, 500, 500.0, 0.02)[0])  # a move, and its stop
        for _ in range(4)
    ]
    still = np.concatenate([np.r_[np.full(150, 100.0), np.zeros(500)]] * 4)
    signals = {"acc_feed_m_s2": np.ravel([np.concatenate(part) for part in parts])}
    write_other_log(logs / "stops.h5", 3, 500.0, signals | {"reference_velocity_mm_s": still})
    result = run(logs, [modes_only], tmp_path / "out")
    assert result.n_refused == 0
    found = rows(tmp_path / "out" / "modes.csv")
    sources = [(row["log"], row["mode"], row["source"]) for row in found]
    assert sorted(sources) == [
        (f"{log}.h5", mode, source)
        for log, source in (("ambient", "acc"), ("blows-1", "frf"), ("blows-2", "frf"),
                            ("stops", "acc"))
        for mode in ("pitch", "roll")
    ]  # fmt: skip
    for row in found:
        f, zeta = truth[row["mode"]]
        off = (float(row["frequency_hz"]) - f) / float(row["frequency_std_hz"])
        off_zeta = (float(row["damping_ratio"]) - zeta) / float(row["damping_ratio_std"])
        assert max(abs(off), abs(off_zeta)) < 4, row
    joint = {row["log"] for row in rows(tmp_path / "out" / "modes_cov.csv")
             if row["mode_a"] != row["mode_b"] and float(row["cov_ln_f"])}  # fmt: skip
    assert {"blows-1.h5", "blows-2.h5"} <= joint


@pytest.mark.slow
def test_all_tables_and_pages_are_written(done: Done) -> None:
    """Every table of the contract, the index and a page per stage are there, no half files."""
    assert {path.stem for path in done.out.glob("*.csv")} == set(RUN_TABLES)
    assert done.result.index == done.out / "index.html"
    assert done.result.index.is_file()
    assert [page.name for page in done.result.pages] == ["test-A.html"]
    assert all("Spectrum of the last log" in page.read_text() for page in done.result.pages)
    assert not list(done.out.glob("*.part"))


@pytest.mark.slow
def test_the_truth_is_found_in_the_tables(done: Done) -> None:
    """Health at the last epoch is 0.90 within its 5 to 95 % interval widened by its own width."""
    last = rows(done.out / "health.csv")[-1]
    low, high = float(last["q05"]), float(last["q95"])
    assert low - (high - low) < 0.90 < high + (high - low)
    assert high - low < 0.05
    assert (last["converged"], last["sampler"]) == ("True", "emcee")
    assert {row["mode"] for row in rows(done.out / "modes.csv")} == {"roll", "pitch"}


@pytest.mark.slow
def test_the_only_epoch_asked_for_is_the_last(done: Done) -> None:
    """However few epochs are inferred, the last one, which the verdict is about, is among them."""
    (assessment,) = assessments(done.out)
    assert assessment.health is not None
    assert len(assessment.health.recorded_at) == 2
    assert assessment.health.recorded_at[-1] == assessment.history.recorded_at[-1]
    for most in (1, 2, 3):
        assert epochs_to_publish(assessment.history, done.stage, most)[-1] == N_LOGS - 1


@pytest.mark.slow
def test_one_question_has_one_answer_wherever_it_is_read(done: Done) -> None:
    """Health now, and the probability of a limit: tables, status, summary and Python agree."""
    (assessment,) = assessments(done.out)
    health, prognosis = assessment.health, assessment.prognosis
    assert health is not None and prognosis is not None
    levels = {"q05": 0.05, "median": 0.5, "q95": 0.95}
    (machine,) = json.loads((done.out / "status.json").read_text())["machines"]
    summary = summarise(assessment, assessment.service())
    last = rows(done.out / "health.csv")[-len(health.parameters) :]
    remaining = {row["parameter"]: row for row in rows(done.out / "prognosis.csv")}
    for k, (row, gauge) in enumerate(zip(last, summary.health, strict=True)):
        shown = next(one for one in machine["health"] if one["parameter"] == gauge.name)
        j = prognosis.parameters.index(gauge.name)
        assert row["parameter"] == gauge.name == health.parameters[k]
        assert row["recorded_at"] == prognosis.recorded_at.isoformat()
        for (name, level), own in zip(
            levels.items(), (gauge.low, gauge.median, gauge.high), strict=True
        ):
            known = health.latest(level)[k]
            assert float(row[name]) == pytest.approx(known, rel=1e-6)
            assert own * gauge.baseline == shown[name] * gauge.baseline == known
            assert np.quantile(prognosis.health[:, j], level) == known
        below = np.mean(health.samples[-1, :, k] < prognosis.limits[j])
        assert gauge.below_limit == shown["probability_below_limit"] == below
        assert prognosis.already_past()[j] == below
        assert float(remaining[gauge.name]["probability_already_past"]) == below
        # The curve of the life passes through it.
        at = np.searchsorted(prognosis.curve_travel, prognosis.travel)
        around = prognosis.curve_quantiles[2, at - 1 : at + 1, j]
        std = health.samples[-1, :, k].std()
        assert around.min() - 0.1 * std < gauge.median * gauge.baseline < around.max() + 0.1 * std


@pytest.mark.slow
def test_prognose_goes_on_from_the_table_to_the_same_numbers(done: Done, tmp_path: Path) -> None:
    """The command on the run's table of modes, with its seed, gives the run's remaining life."""
    toml, out = done.logs.parent / "stage" / "small.toml", tmp_path / "prognosis.csv"
    words = ["prognose", done.out / "modes.csv", "--stage", toml, "--out", out]
    result = CliRunner().invoke(main, [str(word) for word in words])
    assert result.exit_code == 0, result.output
    ours, theirs = rows(out), rows(done.out / "prognosis.csv")
    assert [row.keys() for row in ours] == [row.keys() for row in theirs]
    for own, other in zip(ours, theirs, strict=True):
        assert own["service_by"] == other["service_by"]
        for key in [key for key in own if key.startswith(("rul_", "probability_"))]:
            # A run without ended lives calibrates nothing.
            assert (own[key] == "") == (other[key] == "")
            if own[key]:
                assert float(own[key]) == pytest.approx(float(other[key]), rel=1e-6)


@pytest.mark.slow
def test_spectra_of_all_logs_reach_the_page(done: Done) -> None:
    """The spectra hold every used log in order, strongest where its modes are."""
    (assessment,) = assessments(done.out)
    waterfall, history = assessment.waterfall, assessment.history
    assert waterfall is not None
    assert waterfall.level.shape[0] == len(history.logs) == N_LOGS
    # Pitch, at 105 Hz when new, is the only mode in the upper half of the band.
    edges = waterfall.edges
    upper = np.sqrt(edges[1:] * edges[:-1])[edges[1:] > 85]
    strongest = upper[np.argmax(waterfall.level[:, edges[1:] > 85], axis=1)]
    pitch = np.exp(history.ln_frequency[:, history.columns("pitch")[0]])
    np.testing.assert_allclose(strongest, pitch, rtol=0.04)
    assert "Spectra over life" in done.result.pages[0].read_text(encoding="utf-8")


@pytest.mark.slow
def test_every_bad_log_is_listed_with_its_reason(done: Done) -> None:
    """The copy, the broken file and the foreign machine are refused by name; the rest is used."""
    refused = {row["log"]: row for row in rows(done.out / "refused.csv")}
    assert refused["later/copy.h5"]["reason"] == "duplicate"
    assert "log-00.h5" in refused["later/copy.h5"]["detail"]
    assert refused["broken.h5"]["reason"] in ("corrupt", "format")
    assert refused["foreign.h5"]["reason"] == "no-stage"
    assert "other-Z" in refused["foreign.h5"]["detail"]
    assert all(row["detail"] for row in refused.values())
    # The copy is no log of its own, and none is lost by it.
    assert (done.result.n_logs, done.result.n_refused) == (N_LOGS + 2, 2)
    assert len({row["log"] for row in rows(done.out / "modes.csv")}) == N_LOGS


@pytest.mark.slow
def test_a_second_run_takes_all_from_the_store_and_the_truth_does_not_matter(
    done: Done, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With truth.csv deleted a second run remembers every log and result: the same bytes."""
    (done.logs / "truth.csv").unlink()
    monkeypatch.setattr(assessing, "assess_from", None)  # nothing may be inferred again
    again = run(done.logs, [done.stage], done.out, Settings(epochs=2))
    # The broken file is identified by its content and tried no more than once.
    assert again.n_remembered == N_LOGS + 2
    assert tables(done.out) == done.written
    assert pages(done.out) == done.pages


@pytest.mark.slow
def test_the_page_of_an_unchanged_machine_is_not_drawn_again(
    tmp_path: Path, modes_only: Stage, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A second run writes the same page and tables without drawing; after a new log it is drawn."""
    logs, out = write_archive(tmp_path / "logs", 2), tmp_path / "out"
    drawn: list[str] = []

    def counted(found: Assessment, summary: Summary, **options: Any) -> Any:
        drawn.append(summary.file)
        return make_page(found, summary, **options)

    monkeypatch.setattr(running, "make_page", counted)
    run(logs, [modes_only], out)
    before = tables(out), pages(out)
    (out / "test-A.html").unlink()
    run(logs, [modes_only], out)
    assert (tables(out), pages(out)) == before
    assert drawn == ["test-A.html"]
    (logs / "log-01.h5").unlink()
    run(logs, [modes_only], out)
    assert drawn == ["test-A.html"] * 2
    run(logs, [modes_only], out, Settings(language="de"))
    assert drawn == ["test-A.html"] * 3
    with closing(sqlite3.connect(out / "lmshealth.sqlite")) as file:  # one page, in the end
        count = f"SELECT count(*) FROM values_{constants.SCHEMA} WHERE kind = 'pages'"
        assert file.execute(count).fetchall() == [(1,)]


@pytest.mark.slow
def test_pages_come_from_the_store_alone(
    done: Done, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without logs and descriptions the same pages of machine and fleet; one needs no process."""
    shutil.copy(done.out / "lmshealth.sqlite", tmp_path)
    monkeypatch.setattr(workers, "_ProcessPool", None)
    with closing(Store(default_url(tmp_path), create=False)) as store:
        again = report(store, tmp_path, Settings(workers=8))
    assert pages(tmp_path) == done.pages
    assert repr(again.rows) == repr(done.result.rows)  # NaN stands for a missing limit


def test_retired_machines_and_repaired_logs_do_not_come_back(
    tmp_path: Path, modes_only: Stage
) -> None:
    """Pages of a store are those of the last run, which forgot a machine and refused no log."""
    logs, out, again = write_archive(tmp_path / "logs", 2), tmp_path / "out", tmp_path / "again"
    gone = write_log(logs / "b.h5", 1.0, 1, stage="other-A")
    listed = "log-00.h5,test-A\nlog-01.h5,test-A\nb.h5,other-A\n"
    (logs / "manifest.csv").write_text("file,stage\n" + listed)
    whole, settings = (logs / "log-01.h5").read_bytes(), Settings(today=date(2024, 1, 15))
    (logs / "log-01.h5").write_bytes(whole[:1000])
    assert run(logs, [modes_only], out, settings).n_refused == 1
    (logs / "log-01.h5").write_bytes(whole)
    gone.unlink()
    (logs / "manifest.csv").write_text("file,stage\n" + listed[: listed.index("b.h5")])
    with closing(sqlite3.connect(out / "lmshealth.sqlite")) as file, file:
        retire = "WHERE kind = 'announced' AND name = 'other-A'"
        file.execute(f"DELETE FROM values_{constants.SCHEMA} {retire}")
    result = run(logs, [modes_only], out, settings)
    assert (result.n_refused, result.notes) == (0, ())
    with closing(Store(default_url(out), create=False)) as store:
        report(store, again, settings)
    found = pages(again)
    assert set(found) == {"index.html", "how-to-read.html", "test-A.html"}
    assert found == {name: (out / name).read_bytes() for name in found}


@pytest.mark.slow
def test_results_do_not_depend_on_the_number_of_workers(done: Done, tmp_path: Path) -> None:
    """Two processes with a fresh store write the same bytes as one."""
    run(done.logs, [done.stage], tmp_path / "out", Settings(workers=2, epochs=2))
    assert tables(tmp_path / "out") == done.written


@pytest.mark.slow
def test_results_on_a_cluster_are_those_of_this_machine(
    done: Done, tmp_path: Path, cluster: servers.Cluster
) -> None:
    """Two workers of Dask with a fresh store write the same bytes, pages too."""
    run(done.logs, [done.stage], tmp_path / "out", Settings(scheduler=cluster.address, epochs=2))
    assert tables(tmp_path / "out") == done.written
    assert pages(tmp_path / "out") == done.pages


@pytest.mark.slow
@dataclass
class Shared:
    """Two runs at the same time: results, and how often each piece of work was done."""

    results: list[RunResult]
    done: dict[str, Counter[str]]


def run_twice(
    logs: Path, stage: Stage, outs: Sequence[Path], store: str | None, patch: pytest.MonkeyPatch
) -> Shared:
    """Start two runs at the same time, in threads; count files hashed and read, and machines."""
    done = {name: Counter[str]() for name in ("hashed", "read", "assessed", "drawn")}

    def count(module: Any, function: str, what: str, name: Callable[..., str]) -> None:
        original = getattr(module, function)

        def counted(*given: Any, **more: Any) -> Any:
            done[what][name(*given)] += 1
            return original(*given, **more)

        patch.setattr(module, function, counted)

    count(ingesting, "content_digest", "hashed", lambda path: path.name)
    count(ingesting, "read_log", "read", lambda path: path.name)
    count(assessing, "_assess_packed", "assessed", lambda job: job[0].name)
    count(running, "make_page", "drawn", lambda found, *_: found.history.stage)
    patch.setattr(constants, "OTHERS_POLL_S", 0.05)
    patch.setattr(constants, "SETTLED_S", -1)
    patch.setattr(constants, "FILES_PER_HASH_TASK", 2)
    both = threading.Barrier(2)

    def one(out: Path) -> RunResult:
        both.wait()
        return run(logs, [stage], out, Settings(store=store))

    with ThreadPoolExecutor(2) as threads:
        return Shared(list(threads.map(one, outs)), done)


def write_three_machines(logs: Path) -> None:
    """Write five logs of each of three machines."""
    for k in range(15):
        write_log(logs / f"{k}.h5", 1.0, k, stage=f"test-{k % 3}-A")


def test_two_runs_on_a_server_divide_logs_and_machines(
    tmp_path: Path, modes_only: Stage, database: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each log is hashed and read once, each machine assessed and drawn once; both have all."""
    logs, outs = tmp_path / "logs", [tmp_path / "one", tmp_path / "two"]
    write_three_machines(logs)
    alone = run(logs, [modes_only], tmp_path / "alone", Settings())
    shared = run_twice(logs, modes_only, outs, database, monkeypatch)
    for what, n in {"hashed": 15, "read": 15, "assessed": 3, "drawn": 3}.items():
        assert len(shared.done[what]) == n
        assert set(shared.done[what].values()) == {1}, what
    assert sum(result.n_logs - result.n_remembered for result in shared.results) == 15
    for out, result in zip(outs, shared.results, strict=True):
        assert [row.identity for row in result.rows] == [row.identity for row in alone.rows]
        assert tables(out) == tables(tmp_path / "alone")
        assert pages(out) == pages(tmp_path / "alone")


def test_two_runs_on_a_file_both_do_everything(
    tmp_path: Path, modes_only: Stage, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Control of the test before: without claims work is done twice."""
    logs, outs = tmp_path / "logs", [tmp_path / "one", tmp_path / "two"]
    write_three_machines(logs)
    shared = run_twice(logs, modes_only, outs, None, monkeypatch)
    assert set(shared.done["read"].values()) == {2}


@pytest.mark.slow
@pytest.mark.parametrize("killed", [False, True])
def test_two_processes_on_a_server_divide_an_archive(
    killed: bool, tmp_path: Path, database: str, root: Path
) -> None:
    """As two computers do; what a run that is killed has begun is left to the other."""
    logs, stage = tmp_path / "logs", write_archive_stage(tmp_path / "stage", health=False)
    for k in range(60):
        write_log(logs / f"{k:02d}.h5", 1.0, k, stage=f"test-{k % 4}-A")
    command = [sys.executable, "-m", "lmshealth", "run", str(logs), "--stage", str(stage)]
    command += ["--store", database, "--workers", "1", "--format", "json", "--out"]
    outs = [tmp_path / "one", tmp_path / "two"]
    started = [
        subprocess.Popen([*command, str(out)], stdout=subprocess.PIPE, cwd=root) for out in outs
    ]
    if killed:
        with closing(Store(database)) as store:
            servers.wait_until(lambda: bool(_ask_count(store)), "the first log")
        started[0].kill()
    found = [json.loads(one.communicate()[0] or "{}") for one in started]
    run(logs, [load_stage(str(stage))], tmp_path / "alone", Settings())
    assert tables(outs[1]) == tables(tmp_path / "alone")
    assert pages(outs[1]) == pages(tmp_path / "alone")
    new = [one["n_logs"] - one["n_remembered"] for one in found if one]
    if not killed:
        assert sum(new) == 60
        assert tables(outs[0]) == tables(outs[1])
    assert len(new) == (1 if killed else 2)


def _ask_count(store: Store) -> Any:
    with store.transaction() as connection:
        return connection.scalar(text(COUNT.format("identified")))


def test_work_that_another_run_leaves_is_done(
    tmp_path: Path, modes_only: Stage, database: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A run waits for logs that another one has claimed, and does them when that has ended."""
    write_archive(tmp_path / "logs", 3)
    monkeypatch.setattr(constants, "OTHERS_POLL_S", 0.05)
    claims, waiting = list[str](), threading.Event()
    original = Store.claim

    def claim(store: Store, keys: Sequence[str]) -> set[str]:
        if not claims:
            claims.extend(keys)
            original(other, keys)
        elif claims == list(keys) and not waiting.is_set():
            waiting.set()
            assert not original(store, keys)
            other.close()
            return set()
        return original(store, keys)

    with closing(Store(database)) as other:
        monkeypatch.setattr(Store, "claim", claim)
        settings = Settings(store=database)
        assert run(tmp_path / "logs", [modes_only], tmp_path / "out", settings).n_logs == 3
    assert waiting.is_set()


def test_unchanged_files_are_not_hashed_again(
    tmp_path: Path, modes_only: Stage, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A file is hashed after a change, also one that keeps size and time, or came just now."""
    logs = write_archive(tmp_path / "logs", 3)
    hashed = list[str]()

    def digest(path: Path) -> str:
        hashed.append(path.name)
        return content_digest(path)

    monkeypatch.setattr(ingesting, "content_digest", digest)

    def again() -> list[str]:
        hashed.clear()
        run(logs, [modes_only], tmp_path / "out", Settings())
        return sorted(hashed)

    assert again() == again() == ["log-00.h5", "log-01.h5", "log-02.h5"]  # written just now
    monkeypatch.setattr(constants, "SETTLED_S", -1)
    again()
    assert not again()
    changed, before = logs / "log-01.h5", (logs / "log-01.h5").stat()
    changed.write_bytes(changed.read_bytes()[:-1] + b"x")
    os.utime(changed, ns=(before.st_atime_ns, before.st_mtime_ns))
    assert changed.stat().st_size == before.st_size
    assert again() == ["log-01.h5"]


def test_another_seed_gives_other_draws(done: Done) -> None:
    """Negative control for the comparisons of bytes: a new seed changes the draws of health."""
    (assessment,) = assessments(done.out)
    one, other = (
        infer(assessment.history, done.stage, seed, epochs=(5,), chains=False) for seed in (1, 2)
    )
    assert one.samples.tobytes() != other.samples.tobytes()


@pytest.mark.slow
def test_output_inside_the_folder_of_logs_is_no_log(tmp_path: Path, modes_only: Stage) -> None:
    """Tables and store inside the archive are not read back by the next run."""
    logs = write_archive(tmp_path / "logs", 2)
    first = run(logs, [modes_only], logs / "result")
    again = run(logs, [modes_only], logs / "result")
    assert (first.n_logs, again.n_logs, again.n_refused) == (2, 2, 0)
    assert again.n_remembered == 2


@pytest.mark.slow
def test_descriptions_make_stale_what_is_theirs(tmp_path: Path) -> None:
    """A change of one, or another one before it, leaves what came by others as it is."""
    logs = write_archive(tmp_path / "logs", 2)
    write_log(logs / "b.h5", 1.0, 7, stage="test-B")
    paths = [write_archive_stage(tmp_path / name, health=False) for name in ("one", "two", "new")]
    for path, ending in zip(paths[1:], ("B", "C"), strict=True):
        path.write_text(path.read_text().replace("*-A", f"*-{ending}"))

    def remembered(*which: Path) -> int:
        stages = [load_stage(str(path)) for path in which]
        return run(logs, stages, tmp_path / "out").n_remembered

    one, two, new = paths
    assert remembered(one, two) == 0
    assert remembered(new, one, two) == 3
    two.write_text(two.read_text() + "# a remark\n")
    assert remembered(one, two) == 2
    # Who comes first takes all: what the other gave is not of these logs any more.
    new.write_text(new.read_text().replace("*-C", "*"))
    assert remembered(new, one, two) == 0
    assert remembered(one, two) == 3
    # What no description takes is tried again when there is another one.
    assert remembered(one) == 2
    assert remembered(one) == 3
    assert remembered(one, two) == 3


@pytest.mark.slow
def test_a_log_that_changes_while_it_is_read_is_done_again(
    tmp_path: Path, modes_only: Stage, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A log that is being written is refused, and not stored."""
    logs = write_archive(tmp_path / "logs", 2)
    with monkeypatch.context() as patch:
        patch.setattr(ingesting, "content_digest", lambda path: f"{path.name:0>64}")
        with pytest.raises(NothingUsable):
            run(logs, [modes_only], tmp_path / "out")
    assert {row["reason"] for row in rows(tmp_path / "out" / "refused.csv")} == {"changed"}
    again = run(logs, [modes_only], tmp_path / "out")
    assert (again.n_remembered, again.n_refused) == (0, 0)


@pytest.mark.slow
def test_a_log_of_the_future_is_refused_until_it_is_allowed(
    tmp_path: Path, modes_only: Stage
) -> None:
    """Neither the refusal nor the result of a run that allowed it outlives the question."""
    logs, out = write_archive(tmp_path / "logs", 3), tmp_path / "out"
    (logs / "manifest.csv").write_text("file,recorded_at\nlog-02.h5,2062-03-01T08:00:00Z\n")
    for settings, lost, remembered in (
        (Settings(), 1, 0),
        (Settings(latest=LAST_MOMENT), 0, 2),  # the refusal is not stored
        (Settings(latest=LAST_MOMENT), 0, 3),
        (Settings(), 1, 2),  # the stored result is not used
    ):
        done = run(logs, [modes_only], out, settings)
        assert (done.n_refused, done.n_remembered) == (lost, remembered)
        refused = [(row["log"], row["reason"]) for row in rows(out / "refused.csv")]
        assert refused == [("log-02.h5", "future")] * lost
        assert len({row["log"] for row in rows(out / "modes.csv")}) == 3 - lost


@pytest.mark.slow
@pytest.mark.parametrize("error", [OSError(28, "No space left on device"), MemoryError()])
def test_what_the_computer_failed_at_is_tried_again(
    tmp_path: Path, modes_only: Stage, monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    """A full disk or memory is no fault of a log: it is refused, and not stored."""
    logs = write_archive(tmp_path / "logs", 3)

    def fail(log: Log, stage: Stage, **options: Any) -> ModalReading:
        if log.name == "log-01.h5":
            raise error
        return read_modes(log, stage, **options)

    with monkeypatch.context() as patch:
        patch.setattr(identification, "read_modes", fail)
        first = run(logs, [modes_only], tmp_path / "out")
    assert (first.n_refused, first.n_remembered) == (1, 0)
    refused = rows(tmp_path / "out" / "refused.csv")
    assert [(row["log"], row["reason"]) for row in refused] == [("log-01.h5", "resources")]
    again = run(logs, [modes_only], tmp_path / "out")
    assert (again.n_refused, again.n_remembered) == (0, 2)


@pytest.mark.slow
def test_one_machine_has_one_description(tmp_path: Path) -> None:
    """Logs that a manifest gives to another description than most are refused by name."""
    logs = write_archive(tmp_path / "logs", 3)
    one, two = (write_archive_stage(tmp_path / name, health=False) for name in ("one", "two"))
    two.write_text(two.read_text().replace('name = "small"', 'name = "other"', 1))
    (logs / "manifest.csv").write_text("file,description\nlog-01.h5,other\n")
    result = run(logs, [load_stage(str(path)) for path in (one, two)], tmp_path / "out")
    assert result.n_refused == 1
    (row,) = rows(tmp_path / "out" / "refused.csv")
    assert (row["log"], row["reason"]) == ("log-01.h5", "no-stage")
    assert "2 logs of test-A" in row["detail"]


@pytest.mark.slow
def test_an_assessment_that_cannot_be_read_is_made_again(
    tmp_path: Path, modes_only: Stage, assessed: list[str]
) -> None:
    """Neither damage nor deletion by another run keeps a machine from being reported."""
    logs, out = write_archive(tmp_path / "logs", 2), tmp_path / "out"
    run(logs, [modes_only], out)
    before = tables(out), pages(out)
    with closing(sqlite3.connect(out / "lmshealth.sqlite")) as file, file:
        file.execute(UPDATE)
    run(logs, [modes_only], out)
    assert assessed == ["test-A"] * 2
    assert (tables(out), pages(out)) == before


def test_an_assessment_that_never_can_be_read_does_not_end_the_batch(
    tmp_path: Path, modes_only: Stage, monkeypatch: pytest.MonkeyPatch, assessed: list[str]
) -> None:
    """It is made once more, then its machine is named, and the run comes to its end."""
    logs = write_archive(tmp_path / "logs", 2)
    monkeypatch.setattr(running, "unpack_or_none", lambda content, kind: None)
    result = run(logs, [modes_only], tmp_path / "out")
    assert result.rows == ()
    assert result.failed == {"test-A": "its assessment cannot be read back from the store"}
    assert len(assessed) <= 3


@pytest.mark.slow
def test_a_fleet_update_that_cannot_be_read_is_repeated(
    tmp_path: Path, modes_only: Stage, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A damaged assessment after the fleet's evidence is recomputed like the one before."""
    logs = write_archive(tmp_path / "logs", 2)
    learned = FleetPrior(3, (), scatter_prior(modes_only))
    monkeypatch.setattr(
        assessing,
        "_machines_to_update",
        lambda machines, store: ((machine, learned, ()) for machine in machines),
    )
    # Without parameters there is nothing to fit.
    monkeypatch.setattr(machine_assessment, "fit_life", lambda *_, **__: None)
    monkeypatch.setattr(machine_assessment, "_with_life", lambda made, *_: made)
    run(logs, [modes_only], tmp_path / "out")
    before = pages(tmp_path / "out")
    with closing(sqlite3.connect(tmp_path / "out" / "lmshealth.sqlite")) as file, file:
        (n,) = file.execute(COUNT.format("assessed")).fetchone()
        file.execute(UPDATE)
    assert n == 2
    result = run(logs, [modes_only], tmp_path / "out")
    assert result.failed == {}
    assert pages(tmp_path / "out") == before
    (assessment,) = assessments(tmp_path / "out")
    assert assessment.fleet == learned


def test_a_folder_that_cannot_be_written_to_is_an_error(tmp_path: Path, modes_only: Stage) -> None:
    """Before anything is done, and by its name."""
    logs = write_archive(tmp_path / "logs", 2)
    (tmp_path / "file").write_text("no folder")
    for out in (tmp_path / "file", tmp_path / "file" / "below"):
        with pytest.raises(LmshealthError, match=f"{out}: cannot be written to"):
            run(logs, [modes_only], out)
    for out in (logs, tmp_path):
        there = sorted(out.iterdir())
        with pytest.raises(LmshealthError, match=f"{out}: contains the logs"):
            run(logs, [modes_only], out)
        assert sorted(out.iterdir()) == there


def test_settings_show_no_password() -> None:
    """A store's address may hold one, and settings may reach a log of somebody's program."""
    assert "hunter2" not in repr(Settings(store="postgresql://me:hunter2@host/db"))


@pytest.mark.slow
def test_a_machine_that_cannot_be_assessed_does_not_end_the_batch(
    tmp_path: Path, modes_only: Stage, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is named with the reason, and the others are reported."""
    logs = write_archive(tmp_path / "logs", 2)
    write_log(logs / "b.h5", 1.0, 7, stage="other-A")
    whole = assess_from

    def fail(readings: Sequence[LogEstimates], *given: Any, **options: Any) -> Any:
        if readings[0].metadata.stage == "other-A":
            raise ZeroDivisionError("a mistake of ours")
        return whole(readings, *given, **options)

    monkeypatch.setattr(assessing, "assess_from", fail)
    result = run(logs, [modes_only], tmp_path / "out")
    assert [row.identity for row in result.rows] == ["test-A"]
    assert set(result.failed) == {"other-A"}
    assert "a mistake of ours" in result.failed["other-A"]


@pytest.mark.slow
def test_a_changed_description_is_done_again(tmp_path: Path, modes_only: Stage) -> None:
    """Results of another description are stale: nothing is remembered."""
    logs = write_archive(tmp_path / "logs", 2)
    run(logs, [modes_only], tmp_path / "out")
    path = tmp_path / "stage" / "small.toml"
    path.write_text(path.read_text() + "# a remark\n")
    again = run(logs, [load_stage(str(path))], tmp_path / "out")
    assert again.n_remembered == 0


@pytest.fixture
def assessed(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """List the machines that are assessed and not remembered."""
    machines: list[str] = []
    whole = assess_from

    def listen(readings: Sequence[LogEstimates], *given: Any, **options: Any) -> Any:
        machines.append(str(readings[0].metadata.stage))
        return whole(readings, *given, **options)

    monkeypatch.setattr(assessing, "assess_from", listen)
    return machines


@pytest.mark.slow
def test_only_what_is_stale_is_assessed_again(
    tmp_path: Path, modes_only: Stage, assessed: list[str]
) -> None:
    """A log, maintenance, seed or number of epochs makes stale what depends on it, no more."""
    logs, out = write_archive(tmp_path / "logs", 2), tmp_path / "out"
    write_log(logs / "b.h5", 1.0, 7, stage="other-A")

    def again(**options: Any) -> list[str]:
        assessed.clear()
        run(logs, [modes_only], out, Settings(**options))
        return list(assessed)

    assert again() == ["other-A", "test-A"]
    assert again() == []
    write_log(logs / "c.h5", 1.0, 8, stage="other-A")
    assert again() == ["other-A"]
    text = "stage,recorded_at,travel_km,action\n"
    (logs / "maintenance.csv").write_text(text + "test-A,2026-01-01T00:00:00+00:00,0,regrease\n")
    assert again() == ["test-A"]
    assert again(seed=1) == ["other-A", "test-A"]
    assert again(seed=1, epochs=3) == ["other-A", "test-A"]
    (logs / "broken.h5").write_bytes(b"nothing")
    assert again(seed=1, epochs=3) == []


@pytest.mark.slow
def test_a_page_says_what_is_new_since_the_last_report(tmp_path: Path, modes_only: Stage) -> None:
    """The first page has no earlier one; the next compares, and repeats while nothing changes."""
    logs, out = write_archive(tmp_path / "logs", 2), tmp_path / "out"
    run(logs, [modes_only], out)
    assert "This is the first report on this stage" in (out / "test-A.html").read_text()
    shutil.copy(write_archive(tmp_path / "more", 3) / "log-02.h5", logs)
    run(logs, [modes_only], out)
    second = (out / "test-A.html").read_text()
    assert "Compared with the report on 2 logs" in second
    assert "<li>1 log more, " in second
    run(logs, [modes_only], out)
    assert (out / "test-A.html").read_text() == second


@pytest.mark.slow
def test_a_renamed_log_is_remembered(tmp_path: Path, modes_only: Stage) -> None:
    """A log is identified by its content; the tables have its new name."""
    logs = write_archive(tmp_path / "logs", 2)
    run(logs, [modes_only], tmp_path / "out")
    (logs / "log-01.h5").rename(logs / "zero.h5")
    again = run(logs, [modes_only], tmp_path / "out")
    assert again.n_remembered == 2
    assert {row["log"] for row in rows(tmp_path / "out" / "modes.csv")} == {"log-00.h5", "zero.h5"}


@pytest.mark.slow
def test_a_manifest_overrides_and_is_part_of_the_key(tmp_path: Path, modes_only: Stage) -> None:
    """A new odometer in the manifest is used, not the remembered one; its log is done again."""
    logs = write_archive(tmp_path / "logs", 2)
    run(logs, [modes_only], tmp_path / "out")
    (logs / "manifest.csv").write_text("file,travel_km,baseline\nlog-01.h5,777,true\n")
    again = run(logs, [modes_only], tmp_path / "out")
    assert again.n_remembered == 1
    table = tmp_path / "out" / "modes.csv"
    assert {row["travel_km"] for row in rows(table)} == {"0.0", "777.0"}
    # Who goes on from the table has the same baseline.
    assert [one.metadata.baseline for one in read_estimates(table)[0]] == [None, True]


@pytest.mark.slow
def test_foreign_columns_are_read_by_a_map_that_is_part_of_the_key(
    tmp_path: Path, modes_only: Stage
) -> None:
    """Without its map an export is refused, with it it is a log; another map makes it a new one."""
    logs, out = write_archive(tmp_path / "logs", 2), tmp_path / "out"
    for path in logs.glob("*.h5"):
        with h5py.File(path, "r+") as file:
            file.move("acc_feed_m_s2", "AI0")
    with pytest.raises(NothingUsable):
        run(logs, [modes_only], out, Settings())
    columns = ColumnMap(columns={"acc_feed_m_s2": "AI0"})
    result = run(logs, [modes_only], out, Settings(columns=columns))
    assert (result.n_refused, result.n_remembered) == (0, 0)
    assert run(logs, [modes_only], out, Settings(columns=columns)).n_remembered == 2
    other = ColumnMap(columns={"acc_feed_g": "AI0"})
    assert run(logs, [modes_only], out, Settings(columns=other)).n_remembered == 0


@pytest.mark.slow
def test_bad_rows_of_tables_are_listed_and_stop_nothing(tmp_path: Path, modes_only: Stage) -> None:
    """Logs are analysed, each bad row is listed, and the page shows the maintenance."""
    logs, out = write_archive(tmp_path / "logs", 2), tmp_path / "out"
    done = run(logs, [modes_only], out)
    assert (done.n_refused, done.n_unread) == (0, 0)
    (logs / "maintenance.csv").write_text(
        "stage,recorded_at,action\ntest-A,2026-01-05T00:00:00Z,repainted\n"
        "test-A,2026-01-01T00:00:00Z,servo\n"
    )
    (logs / "manifest.csv").write_text("file,travel_km\nlog-01.h5,1,2,3\n,5\n")
    again = run(logs, [modes_only], out)
    assert (again.n_logs, again.n_refused, again.n_unread) == (2, 1, 2)
    refused = [(row["log"], row["reason"]) for row in rows(out / "refused.csv")]
    tables = ["maintenance.csv", "manifest.csv"]
    assert sorted(refused) == [(name, "bad-row") for name in ("log-01.h5", *tables)]
    assert "action &#39;repainted&#39; is unknown" in (out / "test-A.html").read_text()
    (logs / "maintenance.csv").write_text(
        "stage,recorded_at,travel_km,action\ntest-a,2026-01-05T00:00:00Z,1,regrease\n"
    )
    (logs / "manifest.csv").unlink()
    (note,) = run(logs, [modes_only], out).notes
    assert note == (
        "maintenance.csv: work on test-a is not used: no usable log is of it; is it test-A?"
    )
    (logs / "maintenance.csv").unlink()
    (logs / "manifest.csv").write_text("file,temperatur_c,operator\nlog-01.h5,20,me\n")
    misspelt = run(logs, [modes_only], out)
    assert (misspelt.n_logs, misspelt.n_refused, misspelt.n_unread) == (2, 0, 0)
    (note,) = misspelt.notes
    assert note.startswith("manifest.csv: column temperatur_c is not read, unlike temperature_c")
    # Rows that contradict each other lose a log, though its content is analysed.
    shutil.copy(logs / "log-01.h5", logs / "log-02.h5")
    (logs / "manifest.csv").write_text("file,travel_km\nlog-01.h5,7\nlog-02.h5,8\n")
    copied = run(logs, [modes_only], out)
    assert (copied.n_logs, copied.n_refused) == (3, 1)


@pytest.mark.slow
def test_a_page_counts_the_logs_of_its_machine_that_were_refused(
    tmp_path: Path, modes_only: Stage
) -> None:
    """Whose log it is states the manifest where the log cannot be read; others are of no page.

    Each is one row of refused.csv, and a page without one states that no part was refused.
    """
    logs, out = write_archive(tmp_path / "logs", 4), tmp_path / "out"
    run(logs, [modes_only], out)
    assert "No part of them was refused" in (out / "test-A.html").read_text()
    (logs / "log-01.h5").write_bytes(b"nothing")
    (logs / "of-whom.h5").write_bytes(b"nothing")
    with h5py.File(logs / "log-02.h5", "r+") as file:
        file.attrs["recorded_at"] = "2999-01-01T00:00:00Z"
    rows_of = (("log-01", "true"), ("log-02", ""), ("gone", ""))
    listed = "".join(f"{name}.h5,test-A,{flag}\n" for name, flag in rows_of)
    (logs / "manifest.csv").write_text("file,stage,baseline\n" + listed)
    run(logs, [modes_only], out)
    (notice,) = (row for row in rows(out / "warnings.csv") if row["code"] == "logs-refused")
    assert notice["what"].startswith("Of 5 logs of this machine, refused as a whole: 3 (")
    assert notice["severity"] == "caution"
    (instead,) = (row for row in rows(out / "warnings.csv") if row["code"] == "baseline-refused")
    assert instead["where"] == "log-01.h5"
    assert "begins with log-00.h5" in instead["what"]
    assert "begins with log-00.h5" in (out / "test-A.html").read_text()
    assert "3 parts refused" in (out / "test-A.html").read_text()
    refused = sorted(row["log"] for row in rows(out / "refused.csv"))
    assert refused == ["gone.h5", "log-01.h5", "log-02.h5", "of-whom.h5"]


@pytest.mark.slow
def test_what_tracking_needs_of_each_log_is_in_the_table(tmp_path: Path, modes_only: Stage) -> None:
    """Loop error, tuning and shapes are there, also when the store remembers the log."""
    logs = tmp_path / "logs"
    with h5py.File(write_log(logs / "a.h5", 1.0, 0), "a") as file:
        n = file["acc_feed_m_s2"].size
        file["delta_e_um"] = sine(n, float(file.attrs["sample_rate_hz"]), 10.0, 2.0)
        file.attrs["servo_id"] = "stiff"
    write_log(logs / "b.h5", 1.0, 1)
    for n_remembered in (0, 2):
        assert run(logs, [modes_only], tmp_path / "out").n_remembered == n_remembered
        row, *_, without = rows(tmp_path / "out" / "modes.csv")
        assert float(row["delta_e_below_40hz_um"]) == pytest.approx(np.sqrt(2), rel=1e-3)
        assert (row["servo_id"], row["shape_acc_feed"], row["shape_delta_e"]) == (
            "stiff",
            "1.0",
            "",
        )
        assert without["delta_e_below_40hz_um"] == without["servo_id"] == ""


@pytest.mark.slow
def test_each_log_goes_to_the_first_description_that_takes_it(tmp_path: Path) -> None:
    """Two machines with two descriptions get one page each."""
    logs = write_archive(tmp_path / "logs", 2)
    write_log(logs / "b.h5", 1.0, 7, stage="test-B")
    one = write_archive_stage(tmp_path / "one", health=False)
    two = write_archive_stage(tmp_path / "two", health=False)
    two.write_text(two.read_text().replace("*-A", "*-B"))
    result = run(logs, [load_stage(str(one)), load_stage(str(two))], tmp_path / "out")
    assert [page.name for page in result.pages] == ["test-A.html", "test-B.html"]
    found = assessments(tmp_path / "out")
    assert {a.judgement.verdict for a in found} == {"not-enough-data"}


def test_an_archive_of_bad_logs_only_is_an_error_with_its_reasons_written(
    tmp_path: Path, modes_only: Stage
) -> None:
    """When every log is refused the run fails with their number and reason; refused.csv has all."""
    logs = tmp_path / "logs"
    logs.mkdir()
    (logs / "broken.h5").write_bytes(b"nothing")
    (logs / "empty.csv").write_bytes(b"")
    (logs / "hollow.csv").write_bytes(b"")
    with pytest.raises(NothingUsable, match="3 found, 3 refused: 2 as empty") as refusal:
        run(logs, [modes_only], tmp_path / "out")
    assert "such as empty.csv: 0 bytes; copy the file again; " in str(refusal.value)
    refused = {row["log"]: row["reason"] for row in rows(tmp_path / "out" / "refused.csv")}
    assert set(refused) == {"broken.h5", "empty.csv", "hollow.csv"}
    assert refused["empty.csv"] == "empty"


def test_without_a_usable_log_the_index_is_as_empty_as_the_tables(
    tmp_path: Path, modes_only: Stage
) -> None:
    """The index keeps of the machines of the run before a link to their last page."""
    logs, out = write_archive(tmp_path / "logs", 1), tmp_path / "out"
    run(logs, [modes_only], out)
    assert "test-A" in (out / "index.html").read_text()
    (logs / "log-00.h5").unlink()
    with pytest.raises(NothingUsable):
        run(logs, [modes_only], out)
    assert rows(out / "modes.csv") == []
    index = (out / "index.html").read_text()
    assert '<tr role="row" data-state' not in index and "No log belongs to a stage." in index
    _, gone = index.split("Without a usable log in this run")
    assert '<a href="test-A.html">test-A</a>.</p>' in gone


def test_a_table_that_cannot_be_read_is_named_before_the_logs(
    tmp_path: Path, modes_only: Stage
) -> None:
    """What its rows state of the logs is missing for that: the logs are not what to correct."""
    logs = tmp_path / "logs"
    logs.mkdir()
    (logs / "one.csv").write_text("# sample_rate_hz: 1000\nacc_pitch_m_s2\n0\n1\n0\n")
    (logs / "manifest.csv").write_text("file|stage|travel_km\none.csv|axis-7|0\n")
    with pytest.raises(NothingUsable, match=r"log: manifest\.csv: columns are file\|stage"):
        run(logs, [modes_only], tmp_path / "out")


def test_names_that_are_almost_the_same_are_noted() -> None:
    """Numbers tell machines apart, case and punctuation hardly; nor is one forgotten in silence."""
    names = ["axis-7", "axis-8", "Axis 7", "axis_7", "press/A", "axis-1.2", "axis-12", "X+", "X-"]
    alike, gone = running._of_names(names, [*names, "axis-9"])
    assert "only in case, spaces or punctuation: axis-7, Axis 7, axis_7; " in alike
    assert "without a usable log in this run: axis-9; " in gone
    assert list(running._of_names(["axis-7", "axis-8"], ["axis-8"])) == []


def test_an_empty_folder_is_an_error(tmp_path: Path, modes_only: Stage) -> None:
    """A folder without a log has its own error."""
    (tmp_path / "logs").mkdir()
    with pytest.raises(NothingUsable, match="0 found"):
        run(tmp_path / "logs", [modes_only], tmp_path / "out")


@pytest.mark.slow
def test_progress_reaches_its_end(tmp_path: Path, modes_only: Stage) -> None:
    """The callback is called for every step, each up to its total."""
    seen: dict[str, tuple[int, int]] = {}

    def record(what: str, finished: int, total: int) -> None:
        assert 0 <= finished <= total
        seen[what] = (finished, total)

    run(write_archive(tmp_path / "logs", 2), [modes_only], tmp_path / "out", progress=record)
    steps = {"reading": (2, 2), "identifying": (2, 2), "assessing": (1, 1), "reporting": (1, 1)}
    assert seen == steps


@pytest.mark.slow
def test_an_interrupted_run_loses_nothing_that_was_done(tmp_path: Path, modes_only: Stage) -> None:
    """Stopped after two logs, the next run remembers two and the tables are as ever."""
    logs = write_archive(tmp_path / "logs", 4)

    def stop(what: str, finished: int, total: int) -> None:
        if what == "identifying" and finished == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run(logs, [modes_only], tmp_path / "out", progress=stop)
    again = run(logs, [modes_only], tmp_path / "out")
    run(logs, [modes_only], tmp_path / "other")
    assert again.n_remembered == 2
    assert tables(tmp_path / "out") == tables(tmp_path / "other")


@pytest.mark.slow
def test_assess_without_parameters_tracks_and_claims_nothing(
    tmp_path: Path, modes_only: Stage
) -> None:
    """A description of modes alone gives a track, no health, and no verdict."""
    run(write_archive(tmp_path / "logs", 3), [modes_only], tmp_path / "out")
    (assessment,) = assessments(tmp_path / "out")
    assert assessment.track is not None
    assert assessment.health is None
    assert assessment.prognosis is None
    assert assessment.judgement.verdict == "not-enough-data"


@pytest.mark.slow
def test_a_fleet_prior_continues_from_the_draws_by_the_description(
    make: Maker, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Oracle: the life fitted from nothing under the prior; no chains are run for the update."""
    # Without a free change, the laws decide whose paces the prior is of.
    stage = load_stage("lms-y")
    described = structs.replace(stage.description, life=LifeSpec(free=0.0))
    stage = replace(stage, description=described)
    young = examples.history().first_logs(15)
    moments = [datetime.fromisoformat(when.isoformat()) for when in young.recorded_at]
    young = replace(young, recorded_at=tuple(moments))
    own = replace(make(), stage=stage, history=young, track=track(young, stage))
    assert own.track is not None
    history = accepted_estimates(own.history, own.track)
    laws = []
    for parameter in own.stage.parameters:
        for law in parameter.laws:
            before = getattr(law, "life_km", None)
            pace = (before, before.placed(-1.5, 0.4)) if isinstance(before, Lognormal) else None
            laws.append(LawPrior(parameter.name, law.kind, (1.0, 1.0), "life_km", pace))
    prior = FleetPrior(9, tuple(laws), scatter_prior(own.stage))
    start = fit_life(history, own.stage, seed=1, chains=False).start
    alone = prognose(history, own.stage, seed=1, chains=False)
    fresh = prognose(history, prior.apply_to(own.stage), seed=1, chains=False)
    chains = Mock(side_effect=NotConverged("not here", np.empty(0)))
    monkeypatch.setattr(life_posterior, "sample", chains)
    stored = LifeState(start, 15, "healthy", "", (), None)
    machine = Machine("M7-Y", (), own.stage, NO_MAINTENANCE, 40, 0)
    update = machine, "key", prior, ()
    [made] = assessing._update((update, pack(own), pack(stored)))
    assert isinstance(made, PackedAssessment)
    whole = unpack(made.content, Assessment)
    assert whole.health is not None and set(whole.health.sampler) == {"importance"}
    found = whole.prognosis
    assert apart(found, fresh) < 4 < apart(found, alone)
    assert not chains.called
    assessing._update((update, pack(own), None))
    assert chains.called


def test_machines_are_calibrated_by_the_ended_lives_of_their_fleet(make: Maker) -> None:
    """With enough ended lives page and table state the calibrated travel."""
    own = make()
    assert own.prognosis is not None
    lives = tuple(EndedLife(0.01, reached=True) for _ in range(9))
    machine = Machine("M7-Y", (), own.stage, NO_MAINTENANCE, 40, 0)
    [made] = assessing._update(((machine, "key", None, lives), pack(own), None))
    assert isinstance(made, PackedAssessment)
    found: Assessment = unpack(made.content, Assessment)
    tables = tables_of(found)
    row = tables["prognosis"][-1]
    travel = np.quantile(own.prognosis.remaining[:, -1], 0.01, method="inverted_cdf")
    assert row["rul_km_calibrated"] == pytest.approx(travel / 1000)
    assert (row["calibrated_coverage"], row["calibrated_lives"]) == (pytest.approx(0.9), 9)
    assert tables_of(own)["prognosis"][-1]["calibrated_lives"] is None
    [few] = assessing._update(((machine, "key", None, lives[:8]), pack(own), None))
    assert isinstance(few, PackedAssessment)
    assert unpack(few.content, Assessment).calibration is None


def test_a_run_as_on_a_day_repeats(tmp_path: Path, modes_only: Stage) -> None:
    """Status and silence are those of the end of that day, whenever the run is, on pages too."""
    logs = write_archive(tmp_path / "logs", 2)  # the last one of 11 January 2024
    days, found = {"a": date(2024, 1, 15), "b": date(2024, 1, 15), "c": date(2024, 2, 1)}, {}
    for name, today in days.items():
        settings = Settings(today=today, alerts=Alerts(silent_days=7))
        (found[name],) = run(logs, [modes_only], tmp_path / name, settings).statuses
    assert (found["a"].silent, found["c"].silent) == (False, True)
    status, other, later = ((tmp_path / name / "status.json").read_bytes() for name in "abc")
    assert status == other != later
    # Pages have the day since a machine without logs for long is unknown there.
    assert pages(tmp_path / "a") == pages(tmp_path / "b") != pages(tmp_path / "c")
    # Those of `report` too, which has the limit of the run: two logs of a day have no other.
    for name, today in days.items():
        with closing(Store(default_url(tmp_path / name), create=False)) as store:
            report(store, tmp_path / f"{name}-report", Settings(today=today))
        assert pages(tmp_path / f"{name}-report") == pages(tmp_path / name)
    late = pages(tmp_path / "c")
    for page in (late["index.html"].decode(), late["test-A.html"].decode()):
        assert "Written on 2024-02-01, last log 2024-01-11" in page and "no log for 21 days" in page
