"""The store: what goes in comes out bit for bit, and what is wrong with it is said."""

from __future__ import annotations

import sqlite3
from contextlib import closing
from dataclasses import replace
from datetime import datetime, timedelta, timezone
from pathlib import Path

import numpy as np
import pytest

from lmshealth.history import Reading
from lmshealth.logs import Metadata, Refusal
from lmshealth.packing import pack
from lmshealth.report import write_report
from lmshealth.results import Line, Modes
from lmshealth.store import SCHEMA, Store, StoreError, beside
from lmshealth.waterfall import Levels
from tests.assessments import leaves, worn


def reading(n: int = 2, log: str = "a.h5") -> Reading:
    """Give a reading whose numbers use all bits of a float."""
    rng = np.random.default_rng(n)
    cov = rng.normal(size=(2 * n, 2 * n)) * 10.0 ** rng.integers(-12, 3, (2 * n, 2 * n))
    names = tuple(f"mode_{k}" for k in range(n))
    modes = Modes(
        names=names,
        sources=("acc",) * n,
        channels=("acc_x",) * n,
        ln_frequency=np.log(rng.uniform(1, 300, n)),
        ln_damping=np.log(rng.uniform(1e-3, 0.1, n)),
        cov=cov @ cov.T,
        snr=np.exp(rng.normal(5, 3, n)),
        dispersion=np.ones(n),
        flags=("",) * n,
        shape_channels=("acc_x", "acc_y", "delta_e"),
        shapes=rng.choice([np.nan, 1 / 3, -0.1], (n, 3)),
        lines=(Line(50.0 + 1e-13, 1 / 3, "m/s²", "mains", "acc_x"),),
        refused=(Refusal(log, "not-excited", "näher 126.4 Hz", mode="yaw"),),
    )
    metadata = Metadata(
        stage="test-A",
        recorded_at=datetime(2026, 3, 1, 8, 30, 0, 125, tzinfo=timezone(timedelta(hours=1))),
        travel=123_456.7,
        covariates={"temperature_c": 21.4},
        servo_id="new",
        baseline=True,
        description="small",
    )
    levels = Levels(100 / 3, 200 / 3, rng.choice([np.nan, 1 / 3], 5))
    return Reading(log, "d" * 64, metadata, modes, 1e-6 / 3, levels)


@pytest.fixture
def url(tmp_path: Path) -> str:
    """Name a store that does not exist yet."""
    return f"sqlite:///{(tmp_path / 'store.sqlite').as_posix()}"


@pytest.mark.parametrize("n", [0, 1, 3])
def test_a_reading_comes_back_bit_for_bit(url: str, n: int) -> None:
    """Every float, name, line, refusal and metadatum is the same after a round trip."""
    put = reading(n)
    writer = Store(url)
    assert isinstance(writer.put("k", put), Reading)
    writer.close()
    reader = Store(url)
    got = reader.get("k", put.log)
    reader.close()
    assert isinstance(got, Reading)
    assert list(leaves(got)) == list(leaves(put))


def test_missing_metadata_stay_missing(url: str) -> None:
    """What a log did not say is None again, not a text or a zero."""
    put = Reading("a.h5", "d" * 64, Metadata(), reading(0).modes)
    store = Store(url)
    store.put("k", put)
    got = store.get("k", "a.h5")
    store.close()
    assert isinstance(got, Reading)
    assert got.metadata == Metadata()
    assert got.loop_error is None
    assert got.levels is None


def test_refusals_come_back_under_the_present_name(url: str) -> None:
    """A refused log is remembered too; renamed, it is refused under its new name."""
    refused = (Refusal("old.h5", "too-short", "0.3 s", channel="acc_x", source="acc"),)
    store = Store(url)
    store.put("k", refused)
    assert store.get("k", "old.h5") == refused
    moved = store.get("k", "new.h5")
    store.close()
    assert moved == (Refusal("new.h5", "too-short", "0.3 s", channel="acc_x", source="acc"),)


def test_a_renamed_log_is_known_under_its_new_name(url: str) -> None:
    """The reading and the refusals inside it carry the name asked for."""
    store = Store(url)
    store.put("k", reading())
    got = store.get("k", "b.h5")
    store.close()
    assert isinstance(got, Reading)
    assert got.log == "b.h5"
    assert [refusal.log for refusal in got.modes.refused] == ["b.h5"]


def test_what_is_not_there_is_none(url: str) -> None:
    """An unknown key is no error."""
    store = Store(url)
    assert store.get("nothing", "a.h5") is None
    store.close()


def test_what_an_older_version_kept_is_not_read(url: str, tmp_path: Path) -> None:
    """Rows of an older layout stay where they are, and their logs are done again."""
    with sqlite3.connect(tmp_path / "store.sqlite") as older:
        older.execute(f"CREATE TABLE identified_{SCHEMA - 1} (key TEXT, log TEXT, outcome TEXT)")
        older.execute(f"INSERT INTO identified_{SCHEMA - 1} VALUES ('k', 'a.h5', '{{}}')")
    store = Store(url)
    assert store.get("k", "a.h5") is None
    store.put("k", reading())
    assert isinstance(store.get("k", "a.h5"), Reading)
    store.close()


def test_putting_twice_changes_nothing(url: str) -> None:
    """The same key again keeps one row with the same content."""
    store = Store(url)
    for _ in range(2):
        store.put("k", reading())
    got = store.get("k", "a.h5")
    store.close()
    assert isinstance(got, Reading)
    assert got.modes.cov.tobytes() == reading().modes.cov.tobytes()


@pytest.mark.parametrize(
    "bad",
    [
        "no url at all",
        "nosuchdatabase://user:hunter2@host/db",
        "postgresql+nosuchdriver://user:hunter2@host/db",
        "postgresql://user:hunter2@host:port/db",
        "sqlite:////no/such/folder/store.sqlite",
    ],
)
def test_a_url_that_cannot_be_opened_is_named_without_its_password(bad: str) -> None:
    """Each bad URL is a StoreError of one message that does not show the password."""
    with pytest.raises(StoreError) as caught:
        Store(bad)
    assert "hunter2" not in str(caught.value)
    assert "cannot open the store" in str(caught.value)


def test_a_file_that_is_no_store_is_named(tmp_path: Path) -> None:
    """A file of other content is a StoreError that names it, and stays as it was."""
    path = tmp_path / "notes.sqlite"
    path.write_text("these are my notes, not a database\n" * 100)
    before = path.read_bytes()
    with pytest.raises(StoreError, match=r"notes\.sqlite"):
        Store(f"sqlite:///{path.as_posix()}")
    assert path.read_bytes() == before


def test_a_damaged_store_is_named(url: str, tmp_path: Path) -> None:
    """A store damaged after its first page fails with a StoreError when it is read."""
    store = Store(url)
    for number in range(40):
        store.put(f"k{number}", reading(3))
    store.close()
    path = tmp_path / "store.sqlite"
    data = bytearray(path.read_bytes())
    data[4096:] = b"\xff" * (len(data) - 4096)
    path.write_bytes(bytes(data))
    with pytest.raises(StoreError, match=r"store\.sqlite"):
        damaged = Store(url)
        try:
            damaged.get("k7", "a.h5")
        finally:
            damaged.close()


# Assessments


def test_an_assessment_comes_back_bit_for_bit(url: str, tmp_path: Path) -> None:
    """Description, map, history, track, chains, draws, verdict: every leaf is the same."""
    put = worn(tmp_path)
    store = Store(url)
    kept = store.keep("M7-Y", "k1", put)
    got = store.recall("M7-Y", "k1")
    store.close()
    assert got is not None
    expected = list(leaves(put))
    assert sum(isinstance(leaf, tuple) and len(leaf) == 3 for _, leaf in expected) > 40
    assert list(leaves(kept)) == expected
    assert list(leaves(got)) == expected
    assert got.stage.takes(reading().metadata) == put.stage.takes(reading().metadata)
    assert got.service() == put.service()


def test_what_an_assessment_lacks_it_lacks_again(url: str, tmp_path: Path) -> None:
    """No track, health and prognosis, and a probability that is NaN, stay so."""
    put = worn(tmp_path)
    judgement = replace(put.judgement, verdict="not-enough-data", probability=np.nan)
    put = replace(put, track=None, health=None, prognosis=None, judgement=judgement)
    store = Store(url)
    assert list(leaves(store.keep("M7-Y", "k1", put))) == list(leaves(put))
    store.close()


def test_pages_from_the_store_are_those_of_what_was_kept(url: str, tmp_path: Path) -> None:
    """Pages of all machines are the same bytes, and so is the list of logs without a machine."""
    refused = (Refusal("x.h5", "no-stage", "näher"),)
    store = Store(url)
    kept = [store.keep(name, "k1", worn(tmp_path, name)) for name in ("M8-Y", "M7-Y")]
    store.keep_refused(("M7-Y", "M8-Y"), refused)
    fleet = store.fleet()
    store.close()
    assert (fleet.refused, fleet.earlier, fleet.unread) == (refused, {}, ())
    first = write_report(tmp_path / "one", kept, refused)
    again = write_report(tmp_path / "two", fleet.assessments, fleet.refused)
    assert [page.name for page in again] == [page.name for page in first]
    assert [page.read_bytes() for page in again] == [page.read_bytes() for page in first]


def test_only_the_present_assessment_is_kept_whole(url: str, tmp_path: Path) -> None:
    """Another key takes the place of the one before, of the same machine only."""
    store = Store(url)
    one = worn(tmp_path)
    for machine, key in (("A", "k1"), ("B", "k1"), ("A", "k2")):
        store.keep(machine, key, one)
    assert store.recall("A", "k1") is None
    assert store.recall("A", "k2") is not None
    assert store.recall("B", "k1") is not None
    assert store.recall("C", "k1") is None
    assert len(store.fleet().assessments) == 2
    store.close()


def test_the_earlier_report_is_the_newest_of_another_key(url: str, tmp_path: Path) -> None:
    """Keeping the same again changes nothing; going back to a former state is news again."""
    one = worn(tmp_path)
    states = {key: replace(one, digests=(), seed=k) for k, key in enumerate(("k1", "k2", "k3"))}
    words = dict(zip(states, ("healthy", "preload", "mount"), strict=True))
    store = Store(url)

    def keep(key: str) -> str | None:
        judgement = replace(one.judgement, verdict=words[key])
        store.keep("A", key, replace(states[key], judgement=judgement))
        before = store.earlier("A", key)
        return before and before.verdict

    assert [keep(key) for key in ("k1", "k1", "k2", "k2", "k1", "k3")] == [
        *(None, None, "healthy", "healthy", "preload", "healthy")
    ]
    assert store.earlier("B", "k1") is None
    assert store.fleet().earlier["A"].verdict == "healthy"
    store.close()


def test_refused_logs_are_those_of_the_last_run_of_each_machine(url: str, tmp_path: Path) -> None:
    """A later run replaces what an earlier one refused, where it reported the same machines."""
    one, two, three = ((Refusal(log, "gap", ""),) * 2 for log in ("one", "two", "three"))
    store = Store(url)
    for machine in ("A", "B", "C"):
        store.keep(machine, "k1", worn(tmp_path))
    assert store.fleet().refused == ()
    store.keep_refused(("A", "B"), one)
    store.keep_refused(("C",), two)
    assert store.fleet().refused == (*one, *two)
    store.keep_refused(("A", "B"), three)
    assert store.fleet().refused == (*three, *two)
    store.close()


@pytest.mark.parametrize("evil", ["'; DROP TABLE assessed_3; --", '" OR 1=1', "%", "..\n\t<b>", ""])
def test_names_of_machines_are_data(url: str, tmp_path: Path, evil: str) -> None:
    """No name of a machine reaches another's rows, or the database itself."""
    store = Store(url)
    one = worn(tmp_path)
    store.keep("A", "k1", one)
    store.keep(evil, "k2", replace(one, seed=7))
    assert store.recall(evil, "k1") is None
    assert store.earlier(evil, "k2") is None
    got = store.recall(evil, "k2")
    assert got is not None and got.seed == 7
    assert store.recall("A", "k1") is not None
    assert len(store.fleet().assessments) == 2
    store.close()


def test_a_row_that_cannot_be_read_counts_as_absent(url: str, tmp_path: Path) -> None:
    """Damaged or foreign rows are done again; the fleet names the machines it leaves out."""
    store = Store(url)
    store.put("k", reading())
    for machine, key in (("A", "k0"), ("A", "k1"), ("A", "k2"), ("B", "k1")):
        store.keep(machine, key, worn(tmp_path, machine))
    with closing(sqlite3.connect(tmp_path / "store.sqlite")) as file, file:
        file.execute(f"UPDATE identified_{SCHEMA} SET content = ?", (b"nonsense",))
        file.execute(
            f"UPDATE assessed_{SCHEMA} SET content = ? WHERE machine = 'B'", (pack({"stage": 3}),)
        )
        file.execute(f"UPDATE reported_{SCHEMA} SET content = x'00' WHERE key = 'k1'")
    assert store.get("k", "a.h5") is None
    assert store.recall("B", "k1") is None
    fleet = store.fleet()
    assert [one.judgement.stage for one in fleet.assessments] == ["A"]
    assert fleet.unread == ("B",)
    # The newest that can be read, two reports ago.
    assert set(fleet.earlier) == {"A"}
    store.put("k", reading())
    assert isinstance(store.get("k", "a.h5"), Reading)
    store.close()


# Stores that are only looked at


def test_a_store_that_is_not_there_is_not_made(url: str, tmp_path: Path) -> None:
    """Opened to be read, a missing file stays missing, also in SQLite's own notation."""
    for missing in (url, url.replace("///", "///file:") + "?uri=true"):
        with pytest.raises(StoreError, match=r"store\.sqlite"):
            Store(missing, create=False)
    assert list(tmp_path.iterdir()) == []


def test_a_store_without_results_is_told_from_an_older_one(url: str, tmp_path: Path) -> None:
    """An empty file, tables of another version, and tables without a row are said each."""
    path = tmp_path / "store.sqlite"
    path.touch()
    with pytest.raises(StoreError, match="holds no results"):
        Store(url, create=False)
    assert path.read_bytes() == b""
    with closing(sqlite3.connect(path)) as older, older:
        older.execute(f"CREATE TABLE identified_{SCHEMA - 1} (key TEXT)")
    with pytest.raises(StoreError, match="another version"):
        Store(url, create=False)
    store = Store(url)
    store.put("k", reading())
    with pytest.raises(StoreError, match="no assessment"):
        store.fleet()
    store.close()


def test_a_store_in_a_folder_of_any_name_is_opened_as_it_is(tmp_path: Path) -> None:
    """Signs that mean something in an address are parts of a name here."""
    folder = tmp_path / "a b?c#d%20ü"
    folder.mkdir()
    store = Store(beside(folder))
    store.keep("A", "k1", worn(tmp_path))
    store.close()
    again = Store(beside(folder), create=False)
    assert len(again.fleet().assessments) == 1
    again.close()
