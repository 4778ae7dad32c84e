"""The store: records come back bit for bit, and every fault is named."""

from __future__ import annotations

import os
import signal
import socket
import sqlite3
import subprocess
import sys
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import replace
from datetime import datetime, timedelta, timezone
from pathlib import Path

import numpy as np
import pytest
from sqlalchemy import Engine, create_engine, event, text
from sqlalchemy.exc import OperationalError

from lmshealth._private.serialize import pack
from lmshealth.batch import constants
from lmshealth.batch.assess import pack_assessment
from lmshealth.batch.database import StoreError
from lmshealth.batch.store import (
    Announced,
    Identified,
    Outcome,
    Store,
    Unsent,
    default_url,
    unpack_or_none,
)
from lmshealth.io.log import Metadata, Refusal
from lmshealth.machine.assessment import Assessment
from lmshealth.machine.status import Change, make_status
from lmshealth.machine.summary import summarise
from lmshealth.modal.log_estimates import LogEstimates
from lmshealth.modal.modes import Modes
from lmshealth.modal.spectra_summary import SpectraSummary
from lmshealth.signal.spectral_lines import Line
from studies.harness.servers import Postgres, wait_until
from tests.assessments import leaves, worn

SCHEMA, VALUES = constants.SCHEMA, f"values_{constants.SCHEMA}"


def reading(n: int = 2, log: str = "a.h5") -> LogEstimates:
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
    level = rng.choice([np.nan, 1 / 3], (1, 5)).astype(np.float16)
    spectra = SpectraSummary(
        ("acc_x",), (False,), 100 / 3, 200 / 3, level, level, level[:0], level[0]
    )
    return LogEstimates(log, "d" * 64, metadata, modes, 1e-6 / 3, spectra)


@pytest.fixture
def url(store_url: str) -> str:
    """Name a store that does not exist yet, of either kind."""
    return store_url


def put_in(store: Store, key: str, outcome: Outcome) -> None:
    """Keep what became of a log."""
    found = Identified(outcome, "e" * 64, "test-A")
    store.put("identified", {key: pack(found)})


def got_from(store: Store, key: str, log: str) -> Outcome | None:
    """Fetch what became of a log, under its present name."""
    found = (
        unpack_or_none(content, Identified) for _, content in store.of_keys("identified", [key])
    )
    return next((one.renamed(log).outcome for one in found if one is not None), None)


@pytest.fixture
def file_url(tmp_path: Path) -> str:
    """Name a store in a file that does not exist yet."""
    return f"sqlite:///{(tmp_path / 'store.sqlite').as_posix()}"


@pytest.mark.parametrize("n", [0, 1, 3])
def test_a_reading_comes_back_bit_for_bit(url: str, n: int) -> None:
    """Every float, name, line, refusal and metadatum is the same after a round trip."""
    put = reading(n)
    writer = Store(url)
    put_in(writer, "k", put)
    writer.close()
    reader = Store(url)
    got = got_from(reader, "k", put.log)
    reader.close()
    assert isinstance(got, LogEstimates)
    assert list(leaves(got)) == list(leaves(put))


def test_missing_metadata_stay_missing(url: str) -> None:
    """Metadata that a log lacks are None again, not a text or a zero."""
    put = LogEstimates("a.h5", "d" * 64, Metadata(), reading(0).modes)
    store = Store(url)
    put_in(store, "k", put)
    got = got_from(store, "k", "a.h5")
    store.close()
    assert isinstance(got, LogEstimates)
    assert got.metadata == Metadata()
    assert got.loop_error is None
    assert got.spectra is None


def test_refusals_come_back_under_the_present_name(url: str) -> None:
    """A refused log is remembered too; renamed, it is refused under its new name."""
    refused = (Refusal("old.h5", "too-short", "0.3 s", channel="acc_x", source="acc"),)
    store = Store(url)
    put_in(store, "k", refused)
    assert got_from(store, "k", "old.h5") == refused
    moved = got_from(store, "k", "new.h5")
    store.close()
    assert moved == (Refusal("new.h5", "too-short", "0.3 s", channel="acc_x", source="acc"),)


def test_a_renamed_log_is_known_under_its_new_name(url: str) -> None:
    """The reading and the refusals inside it carry the name asked for."""
    store = Store(url)
    put_in(store, "k", reading())
    got = got_from(store, "k", "b.h5")
    store.close()
    assert isinstance(got, LogEstimates)
    assert got.log == "b.h5"
    assert [refusal.log for refusal in got.modes.refused] == ["b.h5"]


def test_what_is_not_there_is_none(url: str) -> None:
    """An unknown key is no error."""
    store = Store(url)
    assert got_from(store, "nothing", "a.h5") is None
    store.close()


def test_what_an_older_version_kept_is_not_read(file_url: str, tmp_path: Path) -> None:
    """Rows of an older layout stay where they are, and their logs are done again."""
    with sqlite3.connect(tmp_path / "store.sqlite") as older:
        older.execute(f"CREATE TABLE identified_{SCHEMA - 1} (key TEXT, log TEXT, outcome TEXT)")
        older.execute(f"INSERT INTO identified_{SCHEMA - 1} VALUES ('k', 'a.h5', '{{}}')")
    store = Store(file_url)
    assert got_from(store, "k", "a.h5") is None
    put_in(store, "k", reading())
    assert isinstance(got_from(store, "k", "a.h5"), LogEstimates)
    store.close()


def test_putting_twice_changes_nothing(url: str) -> None:
    """The same key again keeps one row with the same content."""
    store = Store(url)
    for _ in range(2):
        put_in(store, "k", reading())
    got = got_from(store, "k", "a.h5")
    store.close()
    assert isinstance(got, LogEstimates)
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


@pytest.mark.slow
@pytest.mark.parametrize("query", ["", "?connect_timeout=2"])
def test_a_server_that_says_nothing_is_not_waited_for(
    query: str, needs: Callable[[str], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its port may be that of something else. Two seconds are the shortest time-out of libpq."""
    needs("postgres")
    monkeypatch.setattr(constants, "SERVER_TIMEOUT_S", 60 if query else 2)
    with socket.create_server(("127.0.0.1", 0)) as listener:
        port = listener.getsockname()[1]
        begun = time.monotonic()
        with pytest.raises(StoreError, match="timeout"):
            Store(f"postgresql://me@127.0.0.1:{port}/fleet{query}")
    assert time.monotonic() - begun < 30


@pytest.mark.slow
@pytest.mark.parametrize("whole", [False, True])
def test_a_frozen_server_is_not_waited_for(
    whole: bool, postgres: Postgres, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A process of the server that is stopped, or all, ends a statement by a StoreError."""
    monkeypatch.setattr(constants, "ANSWER_TIMEOUT_S", 1)
    with postgres.database() as url, closing(Store(f"{url}?connect_timeout=2")) as store:
        put_in(store, "before", reading())
        with pytest.raises(StoreError, match="has not answered for 1 s; its results are kept"):
            _ask(store, "SELECT pg_sleep(20)")
        [frozen] = [int(str(row[0])) for row in _ask(store, "SELECT pg_backend_pid()")]
        begun = time.monotonic()
        try:
            os.kill(frozen, signal.SIGSTOP)
            if whole:
                postgres.signal(signal.SIGSTOP)
                with pytest.raises(StoreError, match=r"timeout|not answered"):
                    put_in(store, "during", reading())
            else:
                # The connection is pinged first, and replaced.
                put_in(store, "during", reading())
        finally:
            postgres.signal(signal.SIGCONT)
            os.kill(frozen, signal.SIGCONT)
        assert time.monotonic() - begun < 30
        assert [key for key, _ in store.of_keys("identified", ["before"])] == ["before"]


def test_runs_on_a_server_divide_their_work(database: str) -> None:
    """A piece of work is claimed by one run, until that releases it or ends."""
    with closing(Store(database)) as second:
        with closing(Store(database)) as first:
            assert first.claim(["a", "b"]) == {"a", "b"}
            assert second.claim(["b", "c"]) == {"c"}
            first.release(["b"])
            assert second.claim(["a", "b"]) == {"b"}
        wait_until(lambda: second.claim(["a"]) == {"a"}, "the end of a session")


def test_runs_on_a_file_do_not_divide_their_work(file_url: str) -> None:
    """Each may do everything."""
    with closing(Store(file_url)) as first, closing(Store(file_url)) as second:
        assert first.claim(["a"]) == second.claim(["a"]) == {"a"}
        first.release(["a"])


def test_a_run_whose_claims_are_lost_goes_on(database: str) -> None:
    """A server that ends the session of the claims leaves them to others, and makes new ones."""
    with closing(Store(database)) as first, closing(Store(database)) as second:
        assert first.claim(["a"]) == {"a"}
        others = "pg_stat_activity WHERE pid != pg_backend_pid() AND datname = current_database()"
        _ask(second, f"SELECT pg_terminate_backend(pid, 10000) FROM {others}")
        assert second.claim(["a"]) == {"a"}
        assert first.claim(["a", "b"]) == {"b"}
        first.release(["a", "b"])


def test_digests_come_back_by_key(url: str) -> None:
    """Those that are there, and the last one of a key."""
    with closing(Store(url)) as store:
        store.put("hashed", {"k": b"0" * 64, "m": b"1" * 64})
        store.put("hashed", {"k": b"2" * 64})
        assert dict(store.of_keys("hashed", ["k", "none"])) == {"k": b"2" * 64}
        store.put("hashed", {})


def _ask(store: Store, statement: str) -> list[tuple[object, ...]]:
    with store.transaction() as connection:
        return [tuple(row) for row in connection.execute(text(statement))]


def test_a_file_that_is_no_store_is_named(tmp_path: Path) -> None:
    """A file of other content is a StoreError that names it, and stays as it was."""
    path = tmp_path / "notes.sqlite"
    path.write_text("these are my notes, not a database\n" * 100)
    before = path.read_bytes()
    with pytest.raises(StoreError, match=r"notes\.sqlite"):
        Store(f"sqlite:///{path.as_posix()}")
    assert path.read_bytes() == before


def test_a_damaged_store_is_named(file_url: str, tmp_path: Path) -> None:
    """A store damaged after its first page fails with a StoreError when it is read."""
    store = Store(file_url)
    for number in range(40):
        put_in(store, f"k{number}", reading(3))
    store.close()
    path = tmp_path / "store.sqlite"
    data = bytearray(path.read_bytes())
    data[4096:] = b"\xff" * (len(data) - 4096)
    path.write_bytes(bytes(data))
    with pytest.raises(StoreError, match=r"store\.sqlite") as refusal:
        damaged = Store(file_url)
        try:
            got_from(damaged, "k7", "a.h5")
        finally:
            damaged.close()
    assert f"delete {path}" in str(refusal.value)
    assert "all logs" in str(refusal.value) and "run again to continue" not in str(refusal.value)


def test_columns_that_a_damaged_file_lacks_are_damage(file_url: str, tmp_path: Path) -> None:
    """Any fault of the file is one that no further run heals; a full disk is none of the file."""
    Store(file_url).close()
    path = tmp_path / "store.sqlite"
    with closing(sqlite3.connect(path)) as file, file:
        file.execute(f"ALTER TABLE {VALUES} RENAME COLUMN content TO contens")
    with closing(Store(file_url)) as store, pytest.raises(StoreError, match="delete"):
        dict(store.of_keys("hashed", ["k"]))
    full = sqlite3.OperationalError("database or disk is full")
    full.sqlite_errorname = "SQLITE_FULL"
    store = Store(file_url)
    with closing(store), pytest.raises(StoreError) as refusal, store.transaction():
        raise OperationalError("", {}, full)
    assert "run again to continue" in str(refusal.value) and "delete" not in str(refusal.value)


def fill(store: Store, folder: Path) -> dict[str, Callable[[], bool]]:
    """Write a row of each kind; return by table whether the row can be fetched."""
    assessment = worn(folder)
    status = make_status(assessment, summarise(assessment, assessment.service()))
    change = Change("A", "alarm", "", "roll", status.recorded_at)
    put_in(store, "k", reading())
    store.put("hashed", {"k": b"0" * 64})
    keep(store, "A", "k1", assessment)
    store.put("parts", {"p": b"part"}, "A")
    store.put("pages", {"p": b"page"}, "A")
    store.put("announced", {"": pack(Announced(status, "/logs", (), 1))}, status.stage)
    unsent = Unsent(change, "--notify", 1)
    store.put("unsent", {unsent.key: pack(unsent)}, "A")
    key = store.put_refused((Refusal("a", "gap", ""),))
    return {
        "hashed": lambda: bool(dict(store.of_keys("hashed", ["k"]))),
        "identified": lambda: got_from(store, "k", "a.h5") is not None,
        "assessed": lambda: store.has_assessment("A", "k1"),
        "parts": lambda: store.part("A", "p") is not None,
        "pages": lambda: store.get("pages", "p", "A") is not None,
        "reports": lambda: store.previous_summary("A", "k2") is not None,
        "refused": lambda: bool(store.refused([key])),
        "announced": lambda: bool(store.announced()),
        "unsent": lambda: bool(store.unsent()),
    }


@pytest.mark.slow
@pytest.mark.parametrize("damage", ["content", "key", "kind"])
def test_a_damaged_row_is_removed_and_counted(url: str, tmp_path: Path, damage: str) -> None:
    """Of every kind: the record, a key, or (SQLite) a number in place of the record."""
    if damage == "kind" and url.startswith("postgres"):
        pytest.skip("PostgreSQL has no other type in a column")
    with closing(Store(url)) as store:
        found = fill(store, tmp_path)
        assert all(ask() for ask in found.values()) and store.notes == []
        for name, ask in found.items():
            of_machine = name in ("announced", "unsent")  # fetched for all machines
            column = "content" if damage != "key" else "owner" if of_machine else "key"
            select = f"SELECT {column} FROM {VALUES} WHERE kind = '{name}'"
            with store.transaction() as connection:
                rows = connection.execute(text(select)).scalars().all()
                for row in rows:  # a key that is another one, as a damaged index leads to it
                    other = (
                        f"{row[:-1]}{'0' if row[-1:] != '0' else '1'}" if damage == "key" else b"0"
                    )
                    value = 10**12 if damage == "kind" else other
                    where = f"kind = '{name}' AND {column} = :row"
                    update = text(f"UPDATE {VALUES} SET {column} = :value WHERE {where}")
                    connection.execute(update, {"value": value, "row": row})
            assert not ask(), name
        n = store.damaged.total()
        # Rows under another key are not fetched, except where all rows of a table are.
        assert set(store.damaged) >= ({"announced", "unsent"} if damage == "key" else set(found))
        assert f" {n} damaged rows" in store.notes[0]
        assert not any(ask() for ask in found.values())
        assert store.damaged.total() == n
        assert all(ask() for ask in fill(store, tmp_path).values())


def test_a_store_that_is_only_read_keeps_its_damage(file_url: str, tmp_path: Path) -> None:
    """A report leaves a damaged row out, notes it, and changes nothing."""
    with closing(Store(file_url)) as store:
        fill(store, tmp_path)
        with store.transaction() as connection:
            connection.execute(text(f"UPDATE {VALUES} SET content = x'00' WHERE kind = 'present'"))
    with closing(Store(file_url, create=False)) as store:
        with pytest.raises(StoreError, match="no assessment"):
            store.published()
        assert "1 of present" in store.notes[0]
        assert _ask(store, f"SELECT count(*) FROM {VALUES} WHERE kind = 'present'") == [(1,)]


def test_a_lost_assessment_is_made_from_nothing(file_url: str, tmp_path: Path) -> None:
    """Its own parts would give it other draws; the next assessment uses them."""
    with closing(Store(file_url)) as store:
        keep(store, "A", "k1", worn(tmp_path))
        store.put("parts", {"p": b"part"}, "A")
        assert store.part("A", "p", after="k2") == b"part"
        assert store.part("A", "p", after="k1") is None


def test_one_run_at_a_time_is_alone(url: str) -> None:
    """Another one waits until the first has ended; one that fails leaves nothing behind."""
    order = list[str]()
    with closing(Store(url)) as first, closing(Store(url)) as second:

        def wait() -> None:
            with second.alone():
                order.append("second")
                assert dict(second.of_keys("hashed", ["k", "l"])) == {"k": b"1"}

        with ThreadPoolExecutor(1) as threads:
            with first.alone():
                waiting = threads.submit(wait)
                first.put("hashed", {"k": b"1"})
                time.sleep(0.3)
                order.append("first")
            waiting.result()
        assert order == ["first", "second"]
        with pytest.raises(KeyboardInterrupt), first.alone():
            first.put("hashed", {"l": b"2"})
            raise KeyboardInterrupt
        assert dict(second.of_keys("hashed", ["k", "l"])) == {"k": b"1"}


def test_an_interrupt_as_a_connection_returns_prints_nothing(file_url: str) -> None:
    """The pool of connections logs the traceback of an interrupt, which nothing else handles."""
    code = (
        "import sys\n"
        "from sqlalchemy import event\n"
        "from sqlalchemy.pool import Pool\n"
        "from lmshealth.batch.store import Store\n"
        "def interrupt(*_): raise KeyboardInterrupt\n"
        "store = Store(sys.argv[1])\n"
        "event.listen(Pool, 'reset', interrupt)\n"
        "try:\n"
        "    store.put('hashed', {'k': b'1'})\n"
        "except KeyboardInterrupt:\n"
        "    print('interrupted')\n"
    )
    words = [sys.executable, "-c", code, file_url]
    done = subprocess.run(words, capture_output=True, text=True, check=True)
    assert (done.stdout, done.stderr) == ("interrupted\n", "")


def test_a_store_in_a_read_only_folder_is_read(
    file_url: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without files beside it; where a run has left results there, the message names them."""
    with closing(Store(file_url)) as store:
        store.put("hashed", {"k": b"1"})
    path = tmp_path / "store.sqlite"
    path.chmod(0o444)
    monkeypatch.setattr(os, "access", lambda *_: False)
    with closing(Store(file_url, create=False)) as store:
        assert dict(store.of_keys("hashed", ["k"])) == {"k": b"1"}
        assert [one.name for one in tmp_path.iterdir()] == ["store.sqlite"]
    with closing(Store(file_url, create=False)) as store, pytest.raises(StoreError) as refusal:
        store.put("hashed", {"l": b"2"})
    assert f"copy {path} and {path}-wal" in str(refusal.value)


# Assessments


def keep(store: Store, machine: str, key: str, assessment: Assessment) -> None:
    """Store an assessment as a run does, and publish it."""
    store.put_assessment(machine, key, pack_assessment(assessment))
    summary = summarise(assessment, assessment.service())
    store.publish(machine, [key], summary, store.put_refused(()))


def recall(store: Store, machine: str, key: str) -> Assessment | None:
    """Fetch an assessment, as far as it can be read."""
    content = store.get("assessed", key, machine)
    found: Assessment | None = None if content is None else unpack_or_none(content, Assessment)
    return found


def test_an_assessment_comes_back_bit_for_bit(url: str, tmp_path: Path) -> None:
    """Description, map, history, track, chains, draws, verdict: every leaf is the same."""
    put = worn(tmp_path)
    with closing(Store(url)) as store:
        keep(store, "M7-Y", "k1", put)
        got = recall(store, "M7-Y", "k1")
    assert got is not None
    expected = list(leaves(put))
    assert sum(isinstance(leaf, tuple) and len(leaf) == 3 for _, leaf in expected) > 40
    assert list(leaves(got)) == expected
    assert got.stage.matches(reading().metadata) == put.stage.matches(reading().metadata)
    assert got.service() == put.service()


def test_what_an_assessment_lacks_it_lacks_again(url: str, tmp_path: Path) -> None:
    """No track, health and prognosis, and a probability that is NaN, stay so."""
    put = worn(tmp_path)
    judgement = replace(put.judgement, verdict="not-enough-data", probability=np.nan)
    put = replace(put, track=None, health=None, prognosis=None, judgement=judgement)
    with closing(Store(url)) as store:
        keep(store, "M7-Y", "k1", put)
        got = recall(store, "M7-Y", "k1")
    assert list(leaves(got)) == list(leaves(put))


def test_only_the_published_assessment_and_its_source_are_kept(url: str, tmp_path: Path) -> None:
    """Publishing deletes the other assessments of the same machine, not of others."""
    made = worn(tmp_path)
    one, summary = pack_assessment(made), summarise(made, made.service())
    with closing(Store(url)) as store:
        for machine, key in (("A", "k1"), ("B", "k1"), ("A", "k2"), ("A", "k3")):
            store.put_assessment(machine, key, one)
        assert store.has_assessment("A", "k1")
        store.publish("A", ["k3", "k2"], summary, "")
        assert [store.has_assessment("A", key) for key in ("k1", "k2", "k3")] == [False, True, True]
        assert store.get("assessed", "k1", "A") is None
        assert store.has_assessment("B", "k1")
        assert not store.has_assessment("C", "k1")
        assert [(one.machine, one.key) for one in store.published()] == [("A", "k3")]


def test_the_earlier_report_is_the_newest_of_another_key(url: str, tmp_path: Path) -> None:
    """Publishing the same again changes nothing; a former state is new again."""
    one = worn(tmp_path)
    words = {"k1": "healthy", "k2": "preload", "k3": "mount"}
    with closing(Store(url)) as store:

        def publish(key: str) -> str | None:
            judgement = replace(one.judgement, verdict=words[key])
            keep(store, "A", key, replace(one, judgement=judgement))
            before = store.previous_summary("A", key)
            return before.verdict if before else None

        assert [publish(key) for key in ("k1", "k1", "k2", "k2", "k1", "k3")] == [
            *(None, None, "healthy", "healthy", "preload", "healthy")
        ]
        # As many as are of use, however often something is published.
        assert [publish(key) for key in ("k2", "k1", "k2", "k3")] == [
            *("mount", "preload", "healthy", "preload")
        ]
        words |= {f"k{n}": "both" for n in range(4, 9)}
        assert {publish(key) for key in list(words)[3:]} == {"mount", "both"}
        keys = _ask(store, f"SELECT key FROM {VALUES} WHERE kind = 'reports' ORDER BY key")
        assert [key for (key,) in keys] == ["k6", "k7", "k8"]
        assert store.previous_summary("B", "k1") is None


def test_refused_logs_are_those_of_the_last_run_of_each_machine(url: str, tmp_path: Path) -> None:
    """A later run replaces what an earlier one over the same folder refused, and no other."""
    one, two, three = ((Refusal(log, "gap", ""),) for log in ("one", "two", "three"))
    summary = summarise(worn(tmp_path), worn(tmp_path).service())
    with closing(Store(url)) as store:

        def publish(
            machines: str, refused: tuple[Refusal, ...], folder: str
        ) -> tuple[Refusal, ...]:
            for machine in machines:
                store.publish(machine, ["k1"], summary, store.put_refused(refused, folder))
            return store.refused(one.refused for one in store.published())

        assert publish("AB", one, "logs") == one
        assert publish("C", two, "others") == (*one, *two)
        assert publish("A", three, "logs") == (*three, *two)
        assert publish("B", (), "logs") == two


@pytest.mark.slow
@pytest.mark.parametrize(
    "evil", ["'; DROP TABLE assessed_4; --", '" OR 1=1', "%", "..\n\t<b>", "", "x" * 100_000]
)
def test_names_of_machines_are_data(url: str, tmp_path: Path, evil: str) -> None:
    """No name of a machine reaches another's rows, or the database itself, however long it is."""
    one = worn(tmp_path)
    with closing(Store(url)) as store:
        keep(store, "A", "k1", one)
        keep(store, evil, "k2", replace(one, seed=7))
        assert recall(store, evil, "k1") is None
        assert store.previous_summary(evil, "k2") is None
        got = recall(store, evil, "k2")
        assert got is not None and got.seed == 7
        assert recall(store, "A", "k1") is not None
        assert {one.machine for one in store.published()} == {"A", evil}


def test_a_row_that_cannot_be_read_counts_as_absent(file_url: str, tmp_path: Path) -> None:
    """Damaged or foreign rows count as absent, and may be written again."""
    with closing(Store(file_url)) as store:
        put_in(store, "k", reading())
        for machine, key in (("A", "k0"), ("A", "k1"), ("A", "k2"), ("B", "k1")):
            keep(store, machine, key, worn(tmp_path, machine))
        with closing(sqlite3.connect(tmp_path / "store.sqlite")) as file, file:
            update = f"UPDATE {VALUES} SET content = ? WHERE kind = ? AND key = ?"
            file.execute(update, (b"nonsense", "identified", "k"))
            file.execute(update, (pack({"stage": 3}), "assessed", "k1"))
            file.execute(update, (b"0", "reports", "k1"))
        assert got_from(store, "k", "a.h5") is None
        assert recall(store, "B", "k1") is None
        assert recall(store, "A", "k2") is not None
        # The newest that can be read, two reports ago: of the three there is no other.
        assert store.previous_summary("A", "k2") is not None
        assert store.previous_summary("B", "k2") is None
        put_in(store, "k", reading())
        assert isinstance(got_from(store, "k", "a.h5"), LogEstimates)


def test_an_intact_record_of_another_key_counts_as_absent(file_url: str, tmp_path: Path) -> None:
    """A damaged index of the database leads to records of other logs and machines."""
    with closing(Store(file_url)) as store:
        put_in(store, "k", reading())
        put_in(store, "l", reading())
        for machine in ("A", "B"):
            keep(store, machine, "k1", worn(tmp_path, machine))
            store.put("parts", {"p": pack(machine)}, machine)
        with closing(sqlite3.connect(tmp_path / "store.sqlite")) as file, file:
            for kind in ("identified", "assessed", "parts", "reports"):
                other = f"SELECT content FROM {VALUES} WHERE kind = ? ORDER BY rowid"
                (first,), *_ = file.execute(other, (kind,)).fetchall()
                file.execute(f"UPDATE {VALUES} SET content = ? WHERE kind = ?", (first, kind))
        assert got_from(store, "k", "a.h5") is not None
        assert got_from(store, "l", "a.h5") is None
        assert recall(store, "A", "k1") is not None
        assert recall(store, "B", "k1") is None
        assert store.part("A", "p") is not None
        assert store.part("B", "p") is None
        assert store.previous_summary("A", "k2") is not None
        assert store.previous_summary("B", "k2") is None


def test_a_store_that_another_run_makes_at_the_same_moment_is_opened(tmp_path: Path) -> None:
    """The other may be a moment quicker: both have the table."""
    path = tmp_path / "store.sqlite"
    made = []

    def be_quicker(_: object, __: object, statement: str, *___: object) -> None:
        if statement.strip().startswith("CREATE"):
            with closing(sqlite3.connect(path)) as other:
                other.execute(statement)
            made.append(statement)

    event.listen(Engine, "before_cursor_execute", be_quicker)
    try:
        Store(f"sqlite:///{path}").close()
    finally:
        event.remove(Engine, "before_cursor_execute", be_quicker)
    assert len(made) == 1


@pytest.mark.slow
def test_two_that_write_the_same_at_once_leave_one_row(url: str, tmp_path: Path) -> None:
    """Of many threads that write and publish the same, none fails and nothing is doubled."""
    one = worn(tmp_path)
    made, summary = pack_assessment(one), summarise(one, one.service())

    def write(_: int) -> None:
        with closing(Store(url)) as store:
            for number in range(5):
                put_in(store, f"k{number}", reading())
            store.put_assessment("A", "k1", made)
            store.publish("A", ["k1"], summary, store.put_refused(()))

    with ThreadPoolExecutor(6) as threads:
        list(threads.map(write, range(12)))
    with closing(Store(url)) as store:
        assert len(store.published()) == 1
        assert recall(store, "A", "k1") is not None
        assert len(dict(store.of_keys("identified", (f"k{number}" for number in range(9))))) == 5
        assert store.previous_summary("A", "k1") is None


# Stores that are only looked at


def test_a_store_that_is_not_there_is_not_made(file_url: str, tmp_path: Path) -> None:
    """Opened to be read, a missing file stays missing, also in SQLite's own notation."""
    for missing in (file_url, file_url.replace("///", "///file:") + "?uri=true"):
        with pytest.raises(StoreError, match=r"store\.sqlite"):
            Store(missing, create=False)
    assert list(tmp_path.iterdir()) == []


def test_a_store_without_results_is_distinguished_from_an_older_one(
    file_url: str, tmp_path: Path
) -> None:
    """An empty file, tables of another version, and tables without a row have an error each."""
    path = tmp_path / "store.sqlite"
    path.touch()
    with pytest.raises(StoreError, match="holds no results"):
        Store(file_url, create=False)
    assert path.read_bytes() == b""
    with closing(sqlite3.connect(path)) as older, older:
        older.execute(f"CREATE TABLE identified_{SCHEMA - 1} (key TEXT)")
    with pytest.raises(StoreError, match="another version"):
        Store(file_url, create=False)
    store = Store(file_url)
    put_in(store, "k", reading())
    with pytest.raises(StoreError, match="no assessment"):
        store.published()
    store.close()


def test_a_store_in_a_folder_of_any_name_is_opened_as_it_is(tmp_path: Path) -> None:
    """Signs that mean something in an address are parts of a name here."""
    folder = tmp_path / "a b?c#d%20ü"
    folder.mkdir()
    store = Store(default_url(folder))
    keep(store, "A", "k1", worn(tmp_path))
    store.close()
    again = Store(default_url(folder), create=False)
    assert len(again.published()) == 1
    again.close()


# Other formats


def test_a_store_of_another_format_is_made_anew(url: str, tmp_path: Path) -> None:
    """Its values are computed again, which is noted once.

    Earlier formats were copied where no run computes a value again; a format is now only a cache.
    """
    assessment = worn(tmp_path)
    with closing(Store(url)) as store:
        assert store.notes == []
        keep(store, "M7-Y", "k1", assessment)
    engine = create_engine(url)
    with engine.begin() as connection:
        connection.execute(text(f"ALTER TABLE {VALUES} RENAME TO values_{SCHEMA - 1}"))
    engine.dispose()
    with closing(Store(url)) as store:
        assert "results of another version" in store.notes[0] and len(store.notes) == 1
        assert not store.has_assessment("M7-Y", "k1")
    with closing(Store(url)) as store:
        assert store.notes == []


def test_a_missing_driver_names_the_extra_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    """A store in PostgreSQL without psycopg states the command that installs it."""
    monkeypatch.setitem(sys.modules, "psycopg", None)
    with pytest.raises(StoreError, match=r'pip install "lmshealth\[postgres\]"$') as caught:
        Store("postgresql://me:secret@host/fleet")
    assert "psycopg" in str(caught.value) and "secret" not in str(caught.value)
