"""Store of results: one table of values, each sealed by a digest (SQLite, PostgreSQL).

The key of a value is a fingerprint of everything that it depends on. A change of any of it gives
another key, so that only stale values are computed again. A value that is damaged is removed and
counts as absent, and so does one that this version cannot decode. Every write may be repeated, and
may be made by two runs at once: runs may be killed, and may share a store. `cached` functions are
computed where the store lacks their values; the runs on a store divide that work.
"""

import hashlib
import logging
import time
from collections import Counter
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self, TypeVar

import sqlalchemy as sql
from sqlalchemy.dialects import postgresql
from sqlalchemy.engine import URL, Connection
from sqlalchemy.exc import DBAPIError, SQLAlchemyError

from lmshealth._private.serialize import fingerprint, pack, unpack
from lmshealth.batch import constants, database
from lmshealth.batch.database import VALUES, StoreError
from lmshealth.batch.workers import OnCrash, Pool, Progress, Task
from lmshealth.io.log import Refusal
from lmshealth.machine.status import Change, Status
from lmshealth.machine.summary import Summary
from lmshealth.modal.log_estimates import LogEstimates

Outcome = LogEstimates | tuple[Refusal, ...]
"""Result of a log: its modal estimates, or why it was refused."""

LogKey = tuple[str, str]
"""Name of a log, and the key of its estimates."""

PackedLogs = tuple[tuple[str, bytes], ...]
"""Names of logs, and their packed estimates."""

Record = TypeVar("Record")

_SEAL_BYTES = 16  # digest of a value and its keys, before the value
_ALONE = "alone"  # the lock of `Store.alone`

_logger = logging.getLogger(__name__)


# Records


@dataclass(frozen=True, slots=True, eq=False)
class Identified:
    """Outcome of a log, and what it depends on.

    ``description`` is the digest of the stage description that was used, empty if none was;
    ``stage`` and ``asked`` are the identity of the machine and the name of the description in the
    metadata of the log. Another attempt at a ``lasting`` outcome would give the same.
    """

    outcome: Outcome
    description: str = ""
    stage: str | None = None
    asked: str | None = None
    lasting: bool = True

    def renamed(self, log: str) -> Self:
        """Replace the name of the log, which may have been moved since."""
        if not isinstance(self.outcome, LogEstimates):
            return replace(self, outcome=_renamed(self.outcome, log))
        if self.outcome.log == log:
            return self
        modes = replace(self.outcome.modes, refused=_renamed(self.outcome.modes.refused, log))
        return replace(self, outcome=replace(self.outcome, log=log, modes=modes))


def _renamed(refused: tuple[Refusal, ...], log: str) -> tuple[Refusal, ...]:
    return tuple(replace(refusal, log=log) for refusal in refused)


@dataclass(frozen=True, slots=True)
class PackedAssessment:
    """An assessment as bytes: as a whole, and its evidence for a fleet prior.

    ``parts`` are those of its results that the next assessment may use, by key; None if all that
    are stored stay.
    """

    content: bytes
    evidence: bytes
    parts: dict[str, bytes] | None = None


@dataclass(frozen=True, slots=True)
class Published:
    """Key of the assessment of a machine that was published last, and of its refused logs.

    Machines of one folder of logs have one list of refused logs, that of the last run over it.
    ``kept`` are the keys of all assessments of the machine that were stored then.
    """

    machine: str
    key: str
    refused: str
    kept: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class _Report:
    """Summary of a published assessment, its key, and its number for the machine."""

    key: str
    number: int
    summary: Summary


@dataclass(frozen=True, slots=True)
class Announced:
    """Status of a machine that was compared last, and the state of its alerts.

    ``folder`` is that of its logs, ``channels`` are the ways of delivery that a run over it has
    had; ``number`` is that of the comparison.
    """

    status: Status
    folder: str
    channels: tuple[str, ...]
    number: int


@dataclass(frozen=True, slots=True)
class Unsent:
    """A change that is to be delivered in a way, and the number of the comparison that found it."""

    change: Change
    channel: str
    number: int

    @property
    def key(self) -> str:
        """Key of the change in its way of delivery."""
        return fingerprint(self.change, self.channel)


def unpack_or_none(content: bytes | None, kind: Any) -> Any:
    """Decode a packed record of a store; None where there is none or this version cannot."""
    if content is None:
        return None
    try:
        return unpack(content, kind)
    except ValueError as error:
        _logger.debug("%s", error)
        return None


def unpack_logs(logs: PackedLogs) -> list[LogEstimates]:
    """Decode estimates, under the present names of their logs."""
    found = [(log, unpack_or_none(content, Identified)) for log, content in logs]
    outcomes = [own.renamed(log).outcome for log, own in found if own is not None]
    return [outcome for outcome in outcomes if isinstance(outcome, LogEstimates)]


def default_url(folder: Path) -> URL:
    """Return the URL of the default store: a SQLite file in the folder of the output, no link."""
    path = folder / "lmshealth.sqlite"
    if path.is_symlink():
        raise StoreError(f"the store {path} is a link; remove it, or name its target by --store")
    return URL.create("sqlite", database=str(path))


_ASSESSMENT = "assessed", "evidence"
"""Kinds of the values of an assessment: as a whole, and its evidence for a fleet."""


class Store:
    """Values behind an SQLAlchemy URL, such as ``postgresql://me@host/fleet``.

    `StoreError` if it cannot be opened, or does not exist and is not to be created.
    """

    def __init__(self, url: str | URL, *, create: bool = True) -> None:
        self._engine, self._address, self._made_anew = database.connect(url, create=create)
        self._shown, self._writes = database.shown_address(self._address), create
        self._claims: Connection | None = None
        self._open: Connection | None = None  # transaction
        self.damaged: Counter[str] = Counter()  # values that were damaged, by their kind
        with self._faults():
            tables = sql.inspect(self._engine).get_table_names()
        if VALUES.name not in tables:
            found = "no results"
            if database.is_older(tables):
                found = "only results of another version of lmshealth"
            self.close()
            raise self.unfilled(f"{found} (no table {VALUES.name})")

    def unfilled(self, found: str) -> StoreError:
        """Return the error of a store without the results that are needed."""
        step = "; ".join(["`lmshealth run LOGS --store URL` fills it", *self.notes])
        return StoreError(f"the store {self._shown} holds {found}; {step}")

    def close(self) -> None:
        """Close all connections."""
        self._drop_claims()
        self._engine.dispose()

    @property
    def notes(self) -> list[str]:
        """Describe an older format, and the damaged values found since the store was opened."""
        notes = list[str]()
        if self._made_anew:
            notes.append(
                f"the store {self._shown} had results of another version of lmshealth: all logs "
                "are identified and all machines assessed again; alerts that were not sent are "
                "lost, and changes are those since status.json was written"
            )
        if n := self.damaged.total():
            kinds = ", ".join(f"{n} of {name}" for name, n in sorted(self.damaged.items()))
            notes.append(
                f"the store {self._shown} had {n} damaged rows ({kinds}): they were left out, and "
                "what a run computes is computed again; check the disk"
            )
        return notes

    # Division of work among runs

    @property
    def is_divided(self) -> bool:
        """Whether runs divide their work: on PostgreSQL; those on one SQLite file do not."""
        return bool(self._engine.dialect.name == "postgresql")

    def claim(self, keys: Sequence[str]) -> set[str]:
        """Claim pieces of work; return the keys of those that no other run has claimed.

        A claim ends by `release`, or with the connection of this run, for instance by a crash.
        """
        return set(keys) if not self.is_divided else self._lock(sql.func.pg_try_advisory_lock, keys)

    def release(self, keys: Sequence[str]) -> None:
        """End claims, once for each time that a piece of work was claimed."""
        if self.is_divided and keys:
            self._lock(sql.func.pg_advisory_unlock, keys)

    def _lock(self, function: Any, keys: Sequence[str]) -> set[str]:
        """Apply a function of the server to the locks of its session that stand for keys."""
        numbers = {key: _lock_number(key) for key in keys}
        given = sql.cast([*numbers.values()], postgresql.ARRAY(sql.BigInteger))
        number = sql.func.unnest(given).column_valued("number")
        query = sql.select(number, function(number))
        with self._faults():
            try:
                rows = self._claiming().execute(query).all()
            except DBAPIError as error:
                if not error.connection_invalidated:
                    raise
                # A server that was started again has lost the claims: work may be done twice.
                self._drop_claims()
                rows = self._claiming().execute(query).all()
        done = {number for number, is_done in rows if is_done}
        return {key for key, number in numbers.items() if number in done}

    def _claiming(self) -> Connection:
        """Return the connection whose session holds the claims."""
        if self._claims is None:
            connection = self._engine.connect().execution_options(isolation_level="AUTOCOMMIT")
            for name, value in constants.KEEPALIVE.items():
                connection.execute(sql.text(f"SET tcp_keepalives_{name} = {value}"))
            self._claims = connection
        return self._claims

    def _drop_claims(self) -> None:
        if self._claims is not None:
            self._claims.invalidate()
            self._claims.close()
            self._claims = None

    @contextmanager
    def alone(self) -> Iterator[None]:
        """Do all that follows in one transaction; one run on the store at a time does so.

        It ends with the process: another run goes on where the transaction began.
        """
        with self.transaction() as connection:
            if self.is_divided:
                number = sql.cast(_lock_number(_ALONE), sql.BigInteger)
                lock = sql.func.pg_try_advisory_xact_lock(number)
                while not connection.scalar(sql.select(lock)):
                    time.sleep(constants.OTHERS_POLL_S)
            else:
                connection.exec_driver_sql("BEGIN IMMEDIATE")
            yield

    # Machines

    def has_assessment(self, machine: str, key: str) -> bool:
        """Return whether a machine has an undamaged assessment under a key."""
        return all(self.get(kind, key, machine) is not None for kind in _ASSESSMENT)

    def put_assessment(self, machine: str, key: str, made: PackedAssessment) -> None:
        """Store an assessment of a machine, and its parts in place of those stored before."""
        with self.transaction():
            for kind, content in zip(_ASSESSMENT, (made.content, made.evidence), strict=True):
                self.put(kind, {key: content}, machine)
            if made.parts is not None:
                self.put_only("parts", made.parts, machine)

    def part(self, machine: str, key: str, *, after: str = "") -> bytes | None:
        """Fetch a part of the last assessment of a machine; None where it is not stored.

        There is none for the assessment under the key ``after`` if that was the last and is lost:
        from its own parts it would have other draws.
        """
        present = self._decoded("present", Published, machine) if after else []
        is_lost = any(after in one.kept for one in present)
        return None if is_lost else self.get("parts", key, machine)

    def put_refused(self, refused: tuple[Refusal, ...], folder: str = "") -> str:
        """Store the logs of a folder that were refused as a whole, and return the key of the list.

        It takes the place of the list that an earlier run over the folder has stored.
        """
        key = fingerprint("refused logs", folder)
        self.put("refused", {key: pack(refused)})
        return key

    def publish(self, machine: str, keys: Sequence[str], summary: Summary, refused: str) -> None:
        """Make an assessment the present one of a machine, and delete its other assessments.

        Of its summaries the two newest under other keys stay, the second for where the first is
        damaged. The keys are that of the assessment, and those of others of the machine that stay;
        ``refused`` is that of the list of logs that were refused as a whole.
        """
        key = keys[0]
        reports = self._reports(machine)
        number = 1 + max((one.number for one in reports), default=0)
        before = [one.key for one in reports if one.key != key][-2:]
        with self.transaction():
            present = Published(machine, key, refused, tuple(keys))
            self.put("present", {"": pack(present)}, machine)
            self.put("reports", {key: pack(_Report(key, number, summary))}, machine)
            self._keep("reports", machine, [key, *before])
            for kind in _ASSESSMENT:
                self._keep(kind, machine, keys)

    def previous_summary(self, machine: str, key: str) -> Summary | None:
        """Fetch the summary of the newest published assessment under another key; None if none."""
        others = [one.summary for one in self._reports(machine) if one.key != key]
        return others[-1] if others else None

    def _reports(self, machine: str) -> list[_Report]:
        return sorted(self._decoded("reports", _Report, machine), key=lambda one: one.number)

    def published(self) -> tuple[Published, ...]:
        """List the published assessments of all machines by name; `StoreError` if none is."""
        present = self._decoded("present", Published)
        if not present:
            raise self.unfilled("no assessment")
        return tuple(sorted(present, key=lambda one: one.machine))

    def refused(self, keys: Iterable[str]) -> tuple[Refusal, ...]:
        """Fetch lists of logs that were refused as a whole, each refusal once."""
        asked = dict.fromkeys(keys)
        found = {
            key: unpack_or_none(content, tuple[Refusal, ...]) or ()
            for key, content in self.of_keys("refused", asked)
        }
        return tuple(dict.fromkeys(one for key in asked for one in found.get(key, ())))

    # Alerts

    def announced(self) -> dict[str, Announced]:
        """Fetch what was announced of each machine last."""
        return {one.status.stage: one for one in self._decoded("announced", Announced)}

    def unsent(self) -> list[Unsent]:
        """Fetch the changes that are to be delivered, the oldest first."""
        found = self._decoded("unsent", Unsent)
        return sorted(found, key=lambda one: (one.number, one.change.stage))

    # Values

    def get(self, kind: str, key: str, machine: str) -> bytes | None:
        """Fetch a value of a machine; None where there is none, or it is damaged."""
        found = self._intact(kind, VALUES.c.owner == machine_key(machine), VALUES.c.key == key)
        return dict(found).get(key)

    def of_keys(self, kind: str, keys: Iterable[str]) -> Iterator[tuple[str, bytes]]:
        """Fetch the values of no machine that are there under keys, some rows in each query."""
        asked = list(dict.fromkeys(keys))
        for first in range(0, len(asked), constants.ROWS_PER_QUERY):
            part = asked[first : first + constants.ROWS_PER_QUERY]
            yield from self._intact(kind, VALUES.c.owner == "", VALUES.c.key.in_(part))

    def packed_logs(self, logs: Sequence[LogKey]) -> PackedLogs:
        """Fetch the names and the packed estimates of logs."""
        contents = dict(self.of_keys("identified", (key for _, key in logs)))
        return tuple((log, contents[key]) for log, key in logs if key in contents)

    def _decoded(self, kind: str, of: type[Record], machine: str | None = None) -> list[Record]:
        """Fetch those values of a machine, or of all, that this version can decode."""
        own = () if machine is None else (VALUES.c.owner == machine_key(machine),)
        found = (unpack_or_none(content, of) for _, content in self._intact(kind, *own))
        return [one for one in found if one is not None]

    def _intact(self, kind: str, *where: sql.ColumnElement[bool]) -> list[tuple[str, bytes]]:
        """Fetch keys and values of rows; those that are damaged are removed and counted."""
        columns = VALUES.c.owner, VALUES.c.key, VALUES.c.content
        query = sql.select(*columns).where(VALUES.c.kind == kind, *where)
        with self.transaction() as connection:
            rows = connection.execute(query).all()
        found = list[tuple[str, bytes]]()
        for owner, key, stored in rows:
            content = _unsealed(stored, kind, owner, key)
            if content is not None:
                found.append((key, content))
                continue
            self.damaged[kind] += 1
            _logger.info("damaged row of %s in the store %s", kind, self._shown)
            if self._writes:
                self.remove(kind, owner, key)
        return found

    def put(self, kind: str, values: Mapping[str, bytes], machine: str | None = None) -> None:
        """Write values of a machine, or of none, sealed in one statement; later ones replace."""
        if not values:
            return
        owner = "" if machine is None else machine_key(machine)
        rows = [
            {"kind": kind, "owner": owner, "key": key, "name": machine or "", "content": sealed}
            for key, content in values.items()
            for sealed in [_seal(content, kind, owner, key) + content]
        ]
        insert = database.INSERT[self._engine.dialect.name](VALUES).values(rows[0])
        keys = [column.name for column in VALUES.primary_key]
        rest = {name: insert.excluded[name] for name in rows[0] if name not in keys}
        with self.transaction() as connection:
            statement = insert.on_conflict_do_update(index_elements=keys, set_=rest)
            connection.execute(statement, rows)

    def put_only(self, kind: str, values: Mapping[str, bytes], machine: str) -> None:
        """Write values of a machine in place of all others of the kind that it has."""
        with self.transaction():
            self._keep(kind, machine, values)
            self.put(kind, values, machine)

    def _keep(self, kind: str, machine: str, keys: Iterable[str]) -> None:
        """Delete the values of a machine under other keys."""
        where = VALUES.c.kind == kind, VALUES.c.owner == machine_key(machine)
        with self.transaction() as connection:
            connection.execute(sql.delete(VALUES).where(*where, VALUES.c.key.not_in([*keys])))

    def remove(self, kind: str, owner: str, key: str) -> None:
        """Delete a value of an owner (`machine_key`)."""
        with self.transaction() as connection:
            connection.execute(sql.delete(VALUES).filter_by(kind=kind, owner=owner, key=key))

    # Statements

    @contextmanager
    def transaction(self) -> Iterator[Connection]:
        """Open a transaction, or go on with the one that is open."""
        with self._faults():
            if self._open is not None:
                yield self._open
                return
            with self._engine.begin() as connection:
                self._open = connection
                try:
                    yield connection
                finally:
                    self._open = None

    @contextmanager
    def _faults(self) -> Iterator[None]:
        """Replace the errors of the database by a `StoreError`."""
        try:
            yield
        except SQLAlchemyError as error:
            why = database.reason(error, self._address)
            step = database.next_step(error, self._address)
            step = step or "its results are kept, run again to continue"
            # The cause would quote the row.
            raise StoreError(f"the store {self._shown} failed: {why}; {step}") from None


def machine_key(name: str) -> str:
    """Return the digest of the name of a machine, which may be longer than an index allows."""
    return hashlib.sha256(name.encode("utf-8", "surrogatepass")).hexdigest()


def _lock_number(key: str) -> int:
    return int.from_bytes(bytes.fromhex(machine_key(key))[:8], signed=True)


def _unsealed(stored: Any, *place: Any) -> bytes | None:
    """Return the value that was stored under keys; None for a damaged one.

    A damaged index of SQLite leads to the value of another key, which is intact by itself.
    """
    if isinstance(stored, memoryview):  # of psycopg2
        stored = bytes(stored)
    if not isinstance(stored, bytes):
        return None
    seal, content = stored[:_SEAL_BYTES], stored[_SEAL_BYTES:]
    return content if seal == _seal(content, *place) else None


def _seal(content: bytes, *place: Any) -> bytes:
    subject = "\0".join(map(str, place)).encode("utf-8", "surrogatepass")
    return hashlib.blake2b(
        content, digest_size=_SEAL_BYTES, key=hashlib.sha256(subject).digest()
    ).digest()


# Cached functions

Piece = TypeVar("Piece")
Value = TypeVar("Value")
Pairs = list[tuple[Piece, Value]]


@dataclass(frozen=True, slots=True)
class Resources:
    """Store, workers and progress callback of a batch."""

    store: Store
    pool: Pool
    progress: Progress = lambda step, done, total: None


def cached(
    function: Task[Any, Sequence[Value]],
    pieces: Sequence[Piece],
    resources: Resources,
    *,
    key: Callable[[Piece], str],
    fetch: Callable[[Sequence[Piece]], Iterable[tuple[Piece, Value]]],
    job: Callable[[Sequence[Piece]], Any] = tuple,
    most: int = 1,
    on_crash: OnCrash[Any, Any] = lambda _, why: [why],
) -> Iterator[tuple[Pairs[Piece, Value], bool]]:
    """Yield pieces of work with their values by a pure function, and whether these are new.

    ``key`` is the fingerprint of all that the value of a piece depends on, and ``fetch`` yields
    those pieces whose value is in the store, with it. Of the others a run claims some, at most
    ``most`` at a time, and makes a ``job`` of those that it gets, of which a worker computes the
    function: a list of their values. ``on_crash`` makes that of a job that ends its worker; by
    default it is the reason. What other runs have claimed is looked at again in the end: they store
    its value, or end without. The caller stores new values before it asks for the next.
    """
    store = resources.store

    def compute(
        pieces: Sequence[Piece],
    ) -> Generator[tuple[Pairs[Piece, Value], bool], None, list[Piece]]:
        """Compute the values of unclaimed pieces; return the other pieces."""
        others, claimed = list[Piece](), dict[int, list[Piece]]()
        # A few are spread over the workers.
        size = min(most, max(1, len(pieces) // (4 * resources.pool.size)))

        def jobs() -> Iterator[Any]:
            for first in range(0, len(pieces), size):
                part = [(key(piece), piece) for piece in pieces[first : first + size]]
                own = store.claim([one for one, _ in part])
                if store.is_divided:  # another run may have done it since this one began
                    done = {key(piece) for piece, _ in fetch([p for k, p in part if k in own])}
                    store.release([*done])
                    own -= done
                others.extend(piece for one, piece in part if one not in own)
                if mine := [piece for one, piece in part if one in own]:
                    made = job(mine)
                    claimed[id(made)] = mine
                    yield made

        for made, values in resources.pool.map_unordered(function, jobs(), on_crash):
            mine = claimed.pop(id(made))
            yield list(zip(mine, values, strict=True)), True
            store.release([key(piece) for piece in mine])
        return others

    left, is_waiting = pieces, False
    while left:
        known = set[str]()
        for piece, value in fetch(left):
            known.add(key(piece))
            yield [(piece, value)], False
        if is_waiting and not known:
            time.sleep(constants.OTHERS_POLL_S)
        left = [piece for piece in left if key(piece) not in known]
        others = yield from compute(left)
        left, is_waiting = others, len(others) == len(left)
