"""Store of results: a content-addressed cache and the published assessments (SQLite, PostgreSQL).

The key of a result is a fingerprint of everything that the result depends on. A change of any of it
gives another key, so that only stale results are computed again. Every row that a run reads is
sealed by a digest of it and of its keys: one that is damaged is removed and computed again, and
one that this version cannot decode counts as absent. Every write may be repeated, and may be made
by two runs at once: runs may be killed, and may share a store.
"""

import hashlib
import logging
import os
import re
import socket
import time
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from threading import Event, Timer
from typing import Any, NamedTuple, Self, TypeVar
from urllib.parse import quote

import sqlalchemy as sql
from sqlalchemy.dialects import postgresql, sqlite
from sqlalchemy.engine import URL, Connection, Engine, make_url
from sqlalchemy.exc import DBAPIError, SQLAlchemyError
from sqlalchemy.schema import CreateTable

from lmshealth._private.serialize import VERSION, fingerprint, pack, unpack
from lmshealth.batch import constants
from lmshealth.batch.addresses import shown_address, without_secrets
from lmshealth.errors import LmshealthError
from lmshealth.io.log import Refusal
from lmshealth.machine.status import Change, Status
from lmshealth.machine.summary import Summary
from lmshealth.modal.log_estimates import LogEstimates

Outcome = LogEstimates | tuple[Refusal, ...]
"""Result of a log: its modal estimates, or why it was refused."""

Condition = sql.ColumnElement[bool]

Record = TypeVar("Record")

_INSERT: dict[str, Any] = {"sqlite": sqlite.insert, "postgresql": postgresql.insert}

_logger = logging.getLogger(__name__)


class StoreError(LmshealthError):
    """A store that cannot be opened, read or written."""


# Tables: the key of a machine is a digest, because its name may be longer than an index allows


class _Bytes(sql.LargeBinary):
    """Bytes as the database returns them: a damaged row of SQLite may hold a number or a text."""

    def result_processor(self, dialect: Any, coltype: Any) -> None:
        """Convert nothing: `Store` checks what it reads."""


_METADATA = sql.MetaData()
_BYTES, _DIGEST = _Bytes, sql.String(64)
_KINDS: dict[str, Any] = {"content": _BYTES, "evidence": _BYTES, "summary": _BYTES}
_KINDS |= {"version": sql.Text, "machine": sql.Text, "name": sql.Text}
_KINDS |= dict.fromkeys(("low", "median", "high", "probability"), sql.Float)
_KINDS |= dict.fromkeys(("service_by", "inspect_by"), sql.Date)
_KINDS |= dict.fromkeys(("recorded_at", "noticed_at"), sql.DateTime(timezone=True))
_KINDS |= dict.fromkeys(("state", "verdict", "service", "alarms", "silent"), sql.Text)
_KINDS |= dict.fromkeys(("quantity", "subject", "what", "before", "now"), sql.Text)
_SEAL_BYTES = 16  # digest of a record and its keys, before the record
_ALONE = "alone"  # the lock of `Store.alone`
_OPTIONAL = {"machine", "low", "median", "high", "probability", "service_by", "inspect_by"}


def _table(table: str, keys: str, columns: str) -> sql.Table:
    """Declare a table; keys, and columns of no other kind, are digests."""
    primary = [sql.Column(name, _DIGEST, primary_key=True) for name in keys.split()]
    others = [
        sql.Column(name, _KINDS.get(name, _DIGEST), nullable=name in _OPTIONAL)
        for name in columns.split()
    ]
    return sql.Table(f"{table}_{constants.SCHEMA}", _METADATA, *primary, *others)


# Digest of the content of each file, by its name, size and times.
_HASHED = _table("hashed", "key", "content")
# Outcome of each log; the columns between key and content are for people.
_IDENTIFIED = _table("identified", "key", "digest description version machine content")
# The present assessment of each machine, and the one before the fleet prior was applied.
_ASSESSED = _table("assessed", "machine key", "content evidence summary")
# Parts of the last assessment of each machine, by the fingerprint of what they depend on.
_PARTS = _table("parts", "machine key", "content")
# Which assessment of each machine was published last, and the key of its list of refused logs.
_PRESENT = _table("present", "machine", "name content")
# Summaries of all published assessments, numbered in the order of publication.
_SUMMARIES = _table("summaries", "machine key", "content")
# Lists of logs that belong to no machine, by the fingerprint of the list.
_REFUSED = _table("refused", "key", "content")
# For dashboards: the present status of each machine, its values at logs, changes between runs.
_SHOWN = "recorded_at verdict probability service service_by inspect_by"
_STATUS = _table("status", "machine", f"name {_SHOWN} state alarms silent")
_POINTS = _table("points", "machine key", "name recorded_at quantity subject low median high")
_CHANGES = _table("changes", "machine key", "name recorded_at noticed_at what before now")
# Alerts: what was announced of each machine last, and changes that are to be delivered.
_ANNOUNCED = _table("announced", "machine", "name content")
_UNSENT = _table("unsent", "machine key channel", "content")
_CARRIED = (_SUMMARIES, _POINTS, _CHANGES, _ANNOUNCED, _UNSENT)  # no run computes these again
_CREATE_VIEW = {"sqlite": "CREATE VIEW IF NOT EXISTS", "postgresql": "CREATE OR REPLACE VIEW"}
_VIEWS = {f"lmshealth_{table.name.split('_')[0]}": table for table in (_STATUS, _POINTS, _CHANGES)}


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


class OutcomeRow(NamedTuple):
    """Packed outcome of a log under its key; digests of its content and of the description used."""

    key: str
    digest: str
    description: str
    machine: str | None
    content: bytes

    @classmethod
    def of(cls, key: str, digest: str, found: Identified) -> Self:
        """Pack an outcome."""
        machine = found.stage if isinstance(found.outcome, LogEstimates) else None
        return cls(key, digest, found.description, machine, pack(found))


def _renamed(refused: tuple[Refusal, ...], log: str) -> tuple[Refusal, ...]:
    return tuple(replace(refusal, log=log) for refusal in refused)


@dataclass(frozen=True, slots=True)
class PackedAssessment:
    """An assessment as bytes: as a whole, its evidence for a fleet prior, and its summary.

    ``parts`` are those of its results that the next assessment may use, by key; None if all that
    are stored stay.
    """

    content: bytes
    evidence: bytes
    summary: bytes
    parts: dict[str, bytes] | None = None


@dataclass(frozen=True, slots=True)
class Published:
    """Key of the assessment of a machine that was published last, and of its refused logs.

    ``kept`` are the keys of all its assessments that were stored then.
    """

    machine: str
    key: str
    refused: str
    kept: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class _Summarised:
    """Packed summary of a published assessment, and its number among those of the machine."""

    number: int
    summary: bytes


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


def unpack_or_none(content: bytes | None, kind: Any) -> Any:
    """Decode a packed record of a store; None where there is none or this version cannot."""
    if content is None:
        return None
    try:
        return unpack(content, kind)
    except ValueError as error:
        _logger.debug("%s", error)
        return None


def default_url(folder: Path) -> URL:
    """Return the URL of the default store: a SQLite file in the folder of the output, no link."""
    path = folder / "lmshealth.sqlite"
    if path.is_symlink():
        raise StoreError(f"the store {path} is a link; remove it, or name its target by --store")
    return URL.create("sqlite", database=str(path))


class Store:
    """Results behind an SQLAlchemy URL, such as ``postgresql://me@host/fleet``.

    `StoreError` if it cannot be opened, or does not exist and is not to be created.
    """

    def __init__(self, url: str | URL, *, create: bool = True) -> None:
        self._engine, self._address = _connect(url, create=create)
        self._shown, self._writes = shown_address(self._address), create
        self._claims: Connection | None = None
        self._open: Connection | None = None  # transaction
        self.damaged: Counter[str] = Counter()  # rows that were damaged, by the name of the table
        with self._faults():
            tables = sql.inspect(self._engine).get_table_names()
        if _ASSESSED.name not in tables:  # all are made together
            older = any(re.fullmatch(r"(identified|assessed)_\d+", table) for table in tables)
            found = "only results of another version of lmshealth" if older else "no results"
            self.close()
            raise self.unfilled(f"{found} (no table {_ASSESSED.name})")

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
        """Describe the damaged rows that were found since the store was opened."""
        if not (n := self.damaged.total()):
            return []
        tables = ", ".join(f"{n} of {name}" for name, n in sorted(self.damaged.items()))
        return [
            f"the store {self._shown} had {n} damaged rows ({tables}): they were left out, and "
            "what a run computes is computed again; check the disk"
        ]

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
        with self._begin() as connection:
            if self.is_divided:
                number = sql.cast(_lock_number(_ALONE), sql.BigInteger)
                lock = sql.func.pg_try_advisory_xact_lock(number)
                while not connection.scalar(sql.select(lock)):
                    time.sleep(constants.OTHERS_POLL_S)
            else:
                connection.exec_driver_sql("BEGIN IMMEDIATE")
            yield

    # Logs

    def digests(self, keys: Iterable[str]) -> dict[str, str]:
        """Fetch the digests of the content of those files that are known by their keys."""
        return {key: content.decode() for key, content in self._of_keys(_HASHED, keys)}

    def put_digests(self, digests: Mapping[str, str]) -> None:
        """Store digests of the content of files."""
        rows = [{"key": key, "content": digest.encode()} for key, digest in digests.items()]
        self._put(_HASHED, rows)

    def identified(self, keys: Iterable[str]) -> Iterator[tuple[str, Identified]]:
        """Fetch the outcomes of those logs that are stored, under their names of that time."""
        for key, content in self.packed_identified(keys):
            if (found := unpack_or_none(content, Identified)) is not None:
                yield key, found

    def packed_identified(self, keys: Iterable[str]) -> Iterator[tuple[str, bytes]]:
        """Fetch the same as bytes, for `unpack_or_none` in a worker."""
        yield from self._of_keys(_IDENTIFIED, keys)

    def put_identified(self, rows: Iterable[OutcomeRow]) -> None:
        """Store outcomes of logs in one transaction."""
        self._put(_IDENTIFIED, [row._asdict() | {"version": VERSION} for row in rows])

    # Machines

    def has_assessment(self, machine: str, key: str) -> bool:
        """Return whether a machine has an undamaged assessment under a key."""
        return bool(self._intact(_ASSESSED, machine=_id(machine), key=key))

    def assessment(self, machine: str, key: str) -> bytes | None:
        """Fetch a packed assessment; None where it is not stored."""
        return self._record(_ASSESSED, "content", machine=_id(machine), key=key)

    def evidence(self, machine: str, key: str) -> bytes | None:
        """Fetch the packed evidence of an assessment for a fleet prior; None as before."""
        return self._record(_ASSESSED, "evidence", machine=_id(machine), key=key)

    def put_assessment(self, machine: str, key: str, made: PackedAssessment) -> None:
        """Store an assessment of a machine, and its parts in place of those stored before."""
        own, parts = _id(machine), made.parts
        contents = {name: getattr(made, name) for name in ("content", "evidence", "summary")}
        with self._begin() as connection:
            self._put(_ASSESSED, [{"machine": own, "key": key} | contents])
            if parts is None:
                return
            of_this = _PARTS.c.machine == own
            connection.execute(sql.delete(_PARTS).where(of_this, _PARTS.c.key.not_in(list(parts))))
            rows = [{"machine": own, "key": k, "content": part} for k, part in parts.items()]
            self._put(_PARTS, rows)

    def put_part(self, machine: str, key: str, content: bytes) -> None:
        """Store one more part of the last assessment of a machine."""
        self._put(_PARTS, [{"machine": _id(machine), "key": key, "content": content}])

    def part(self, machine: str, key: str) -> bytes | None:
        """Fetch a part of the last assessment of a machine; None where it is not stored."""
        return self._record(_PARTS, "content", machine=_id(machine), key=key)

    def parts(self, machine: str, key: str = "") -> dict[str, bytes]:
        """Fetch the parts of the last assessment of a machine, for the next one, by their keys.

        There are none for one that was lost: from its own parts it would have other draws.
        """
        if any(key in one.kept for one in self._decoded(_PRESENT, Published, machine=_id(machine))):
            return {}
        return {key: part for (_, key), (part,) in self._intact(_PARTS, machine=_id(machine))}

    def put_points(self, machine: str, points: Iterable[dict[str, Any]]) -> None:
        """Replace what dashboards show of a machine; remaining lives at earlier logs stay."""
        rows = []
        for own in points:
            key = fingerprint(own["quantity"], own["subject"], own["recorded_at"])
            moment = datetime.fromisoformat(own["recorded_at"])
            rows.append(own | {"name": machine, "key": key, "recorded_at": moment})
        earlier = _POINTS.c.machine == _id(machine), _POINTS.c.quantity != "remaining_km"
        with self._begin() as connection:
            connection.execute(sql.delete(_POINTS).where(*earlier))
            self._put(_POINTS, _named(rows))

    def put_status(
        self, statuses: Iterable[Status], changes: Iterable[Change], noticed_at: datetime
    ) -> None:
        """Store the status of machines and what has changed, for dashboards."""
        present = [
            {name: getattr(one, name) for name in _SHOWN.split()}
            | {"name": one.stage, "state": one.device_health, "alarms": " ".join(one.alarms)}
            | {"silent": "yes" if one.silent else "no"}
            for one in statuses
        ]
        changed = [
            {name: getattr(one, name) for name in ("recorded_at", "what", "before", "now")}
            | {"name": one.stage, "key": fingerprint(one), "noticed_at": noticed_at}
            for one in changes
        ]
        with self._begin():
            self._put(_STATUS, _named(present))
            self._put(_CHANGES, _named(changed))

    def put_refused(self, refused: tuple[Refusal, ...]) -> str:
        """Store a list of logs that belong to no machine, and return its key."""
        key = fingerprint(refused)
        self._put(_REFUSED, [{"key": key, "content": pack(refused)}])
        return key

    def publish(self, machine: str, keys: Sequence[str], refused: str) -> None:
        """Make an assessment the present one of a machine, and delete its other assessments.

        The keys are that of the assessment, and those of others of the machine that stay;
        ``refused`` is that of the list of logs that belong to no machine.
        """
        own, key, stored = _id(machine), keys[0], _ASSESSED.c
        present = pack(Published(machine, key, refused, tuple(keys)))
        summary = self._record(_ASSESSED, "summary", machine=own, key=key)
        summaries = self._decoded(_SUMMARIES, _Summarised, machine=own)
        number = 1 + max((one.number for one in summaries), default=0)
        others = sql.delete(_ASSESSED).where(stored.machine == own, stored.key.not_in(keys))
        with self._begin() as connection:
            self._put(_PRESENT, [{"machine": own, "name": machine, "content": present}])
            if summary is not None:
                content = pack(_Summarised(number, summary))
                self._put(_SUMMARIES, [{"machine": own, "key": key, "content": content}])
            connection.execute(others)

    def previous_summary(self, machine: str, key: str) -> Summary | None:
        """Fetch the summary of the newest published assessment under another key; None if none."""
        found = self._decoded(
            _SUMMARIES, _Summarised, _SUMMARIES.c.key != key, machine=_id(machine)
        )
        newest_first = sorted(found, key=lambda one: one.number, reverse=True)
        summaries = (unpack_or_none(one.summary, Summary) for one in newest_first)
        return next((summary for summary in summaries if summary is not None), None)

    def published(self) -> tuple[Published, ...]:
        """List the published assessments of all machines by name; `StoreError` if none is."""
        present = self._decoded(_PRESENT, Published)
        if not present:
            raise self.unfilled("no assessment")
        return tuple(sorted(present, key=lambda one: one.machine))

    def refused(self, keys: Iterable[str]) -> tuple[Refusal, ...]:
        """Fetch lists of logs that belong to no machine, each refusal once."""
        lists = (
            self._decoded(_REFUSED, tuple[Refusal, ...], key=key) for key in dict.fromkeys(keys)
        )
        return tuple(dict.fromkeys(one for found in lists for refused in found for one in refused))

    # Alerts

    def announced(self) -> dict[str, Announced]:
        """Fetch what was announced of each machine last."""
        return {one.status.stage: one for one in self._decoded(_ANNOUNCED, Announced)}

    def put_announced(self, announced: Iterable[Announced]) -> None:
        """Store what was announced of machines."""
        self._put(
            _ANNOUNCED,
            _named({"name": one.status.stage, "content": pack(one)} for one in announced),
        )

    def unsent(self) -> list[Unsent]:
        """Fetch the changes that are to be delivered, the oldest first."""
        found = self._decoded(_UNSENT, Unsent)
        return sorted(found, key=lambda one: (one.number, one.change.stage))

    def put_unsent(self, unsent: Iterable[Unsent]) -> None:
        """Store changes that are to be delivered."""
        self._put(_UNSENT, [_unsent_keys(one) | {"content": pack(one)} for one in unsent])

    def remove_unsent(self, sent: Iterable[Unsent]) -> None:
        """Remove changes that were delivered."""
        with self._begin() as connection:
            for one in sent:
                connection.execute(sql.delete(_UNSENT).filter_by(**_unsent_keys(one)))

    # Statements

    def _of_keys(self, table: sql.Table, keys: Iterable[str]) -> Iterator[tuple[str, bytes]]:
        """Fetch the records that are there under keys, some rows in each query."""
        asked = list(dict.fromkeys(keys))
        for first in range(0, len(asked), constants.ROWS_PER_QUERY):
            part = asked[first : first + constants.ROWS_PER_QUERY]
            rows = self._intact(table, table.c.key.in_(part))
            yield from ((key, content) for (key,), (content,) in rows)

    def _decoded(
        self, table: sql.Table, kind: type[Record], *where: Condition, **keys: str
    ) -> list[Record]:
        """Fetch those records that this version can decode."""
        rows = self._intact(table, *where, **keys)
        found = (unpack_or_none(content, kind) for _, (content,) in rows)
        return [one for one in found if one is not None]

    def _record(self, table: sql.Table, column: str, **keys: str) -> bytes | None:
        """Fetch one record; None where there is none, or it is damaged."""
        return next((content for _, (content,) in self._intact(table, column=column, **keys)), None)

    def _intact(
        self, table: sql.Table, *where: Condition, column: str | None = None, **keys: str
    ) -> list[tuple[tuple[str, ...], tuple[bytes, ...]]]:
        """Fetch keys and records of rows, by default all records of each.

        Rows of which a record is damaged are removed and counted.
        """
        records = [one.name for one in table.columns if isinstance(one.type, _Bytes)]
        named = records if column is None else [column]
        query = sql.select(*table.primary_key.columns, *(table.c[name] for name in named))
        with self._begin() as connection:
            rows = connection.execute(query.where(*where).filter_by(**keys)).all()
        found, n = list[tuple[tuple[str, ...], tuple[bytes, ...]]](), len(table.primary_key)
        for row in rows:
            keys_of_row, stored = tuple(row[:n]), zip(named, row[n:], strict=True)
            opened = [_unsealed(one, name, *keys_of_row) for name, one in stored]
            intact = tuple(record for record in opened if record is not None)
            if len(intact) == len(named):
                found.append((keys_of_row, intact))
            else:
                self._remove_damaged(table, keys_of_row)
        return found

    def _remove_damaged(self, table: sql.Table, keys: tuple[Any, ...]) -> None:
        name = table.name.rpartition("_")[0]
        self.damaged[name] += 1
        _logger.info("damaged row of %s in the store %s", name, self._shown)
        if self._writes:
            row = dict(zip(table.primary_key.columns.keys(), keys, strict=True))
            with self._begin() as connection:
                connection.execute(sql.delete(table).filter_by(**row))

    def _put(self, table: sql.Table, rows: Sequence[dict[str, Any]]) -> None:
        """Write rows, their records sealed, in one statement; later writes replace them."""
        if not rows:
            return
        insert = _INSERT[self._engine.dialect.name](table).values(rows[0])
        keys = [column.name for column in table.primary_key]
        rest = {name: insert.excluded[name] for name in rows[0] if name not in keys}
        upsert = insert.on_conflict_do_update(index_elements=keys, set_=rest)
        with self._begin() as connection:
            connection.execute(upsert, [_sealed(row, keys) for row in rows])

    @contextmanager
    def _begin(self) -> Iterator[Connection]:
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
            why = _reason(error, self._address)
            step = _next_step(error, self._address)
            step = step or "its results are kept, run again to continue"
            # The cause would quote the row.
            raise StoreError(f"the store {self._shown} failed: {why}; {step}") from None


def _id(name: str) -> str:
    return hashlib.sha256(name.encode("utf-8", "surrogatepass")).hexdigest()


def _lock_number(key: str) -> int:
    return int.from_bytes(bytes.fromhex(_id(key))[:8], signed=True)


def _named(rows: Iterable[dict[str, Any]]) -> list[dict[str, Any]]:
    """Add the keys of machines to rows with their names; moments in UTC: SQLite has no zones."""
    return [
        {k: v.astimezone(UTC) if isinstance(v, datetime) else v for k, v in row.items()}
        | {"machine": _id(row["name"])}
        for row in rows
    ]


def _sealed(row: dict[str, Any], keys: Sequence[str]) -> dict[str, Any]:
    """Prefix every record of a row with a digest of it, of its column and of the keys.

    A damaged index of SQLite leads to the record of another key, which is intact by itself.
    """
    own = [row[key] for key in keys]
    return {
        name: _seal(value, name, *own) + value if isinstance(value, bytes) else value
        for name, value in row.items()
    }


def _unsealed(stored: Any, *place: Any) -> bytes | None:
    """Return the record that was stored in a column under keys; None for a damaged one."""
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


def _unsent_keys(one: Unsent) -> dict[str, str]:
    return {
        "machine": _id(one.change.stage),
        "key": fingerprint(one.change),
        "channel": one.channel,
    }


# Databases


def _connect(url: str | URL, *, create: bool) -> tuple[Engine, str]:
    """Open a database; return its engine and its URL as text."""
    address = url if isinstance(url, str) else url.render_as_string(False)
    if "://" not in address:
        needed = "a file is sqlite:///PATH, a database postgresql://user@host/name"
        raise StoreError(f"cannot open the store: the given address is no URL; {needed}")
    engine: Engine | None = None
    try:
        engine = _engine(make_url(url), create=create)
        if create:
            _create_tables(engine)
        with engine.connect():
            return engine, address
    except (SQLAlchemyError, ImportError, TypeError, ValueError) as error:
        if engine is not None:
            engine.dispose()
        step = _next_step(error, address)
        reason = _reason(error, address) + (f"; {step}" if step else "")
        # The cause would be printed with it, and quotes passwords.
        raise StoreError(f"cannot open the store {shown_address(address)}: {reason}") from None


def _engine(url: URL, *, create: bool) -> Engine:
    """Make the engine of a database; without ``create`` SQLite must not create the file."""
    kind = url.get_backend_name()
    if kind not in _INSERT:
        raise ValueError(f"{kind} is not supported: use {' or '.join(_INSERT)}")
    if kind != "sqlite":
        if url.drivername == kind:
            url = url.set(drivername="postgresql+psycopg")  # the driver that the extra installs
        timeout = constants.SERVER_TIMEOUT_S
        wait = {} if "connect_timeout" in url.query else {"connect_timeout": timeout}
        engine = sql.create_engine(url, pool_pre_ping=True, connect_args=wait)
        if url.drivername == "postgresql+psycopg":
            sql.event.listen(engine, "do_connect", _connect_bounded)
        return engine
    name = url.database or ":memory:"
    is_uri = name.startswith("file:")
    if create and not is_uri and not Path(name).parent.is_dir():
        raise ValueError(f"there is no folder {Path(name).parent}")
    if not create and name != ":memory:":
        if not is_uri and not Path(name).exists():
            raise ValueError("there is no such file; `lmshealth run LOGS --store URL` makes it")
        path = name if is_uri else f"file:{quote(name)}"
        how = {"mode": "rw", "uri": "true"} | ({} if is_uri else _unwritable(Path(name)))
        url = url.set(database=path).update_query_dict(how)
    engine = sql.create_engine(url, connect_args={"timeout": constants.SQLITE_BUSY_TIMEOUT_S})

    @sql.event.listens_for(engine, "connect")
    def _set_up(connection: Any, _: Any) -> None:
        # WAL allows readers during a write. No wait for the disk at every log: results that a
        # crash of the computer loses are computed again.
        with suppress(Exception):  # another run may do so now, or the file may be no database
            if create:
                connection.execute("PRAGMA journal_mode = WAL")
        connection.execute("PRAGMA synchronous = NORMAL")
        # A damaged key is another key, and no error of the whole query.
        connection.text_factory = lambda text: text.decode("utf-8", "replace")

    return engine


def _unwritable(path: Path) -> dict[str, str]:
    """Return options that open a file of SQLite whose folder, or itself, is read-only.

    SQLite makes files beside it to read one in WAL mode. None are needed where no run has it open,
    and none has left results in its ``-wal``.
    """
    if all(os.access(one, os.W_OK) for one in (path, path.absolute().parent)):
        return {}
    is_used = path.with_name(path.name + "-wal").exists()
    return {"mode": "ro"} | ({} if is_used else {"immutable": "1"})


def _connect_bounded(_: Any, __: Any, arguments: list[Any], options: dict[str, Any]) -> Any:
    """Connect to PostgreSQL; a server that is frozen then ends a statement, a ping or a commit."""
    from psycopg import Connection, OperationalError

    class Bounded(Connection[Any]):
        def wait(self, *given: Any, **more: Any) -> Any:
            # libpq waits without end for a server whose system still confirms packets.
            late = Event()
            timer = Timer(constants.ANSWER_TIMEOUT_S, _hang_up, [self.fileno(), late])
            timer.daemon = True
            timer.start()
            try:
                return super().wait(*given, **more)
            except OperationalError as error:
                if late.is_set():
                    why = f"the server has not answered for {constants.ANSWER_TIMEOUT_S} s"
                    raise OperationalError(why) from error
                raise
            finally:
                timer.cancel()

    return Bounded.connect(*arguments, **options)


def _hang_up(number: int, late: Event) -> None:
    """Close both directions of a socket, which whoever waits for it notices."""
    late.set()
    connection = socket.socket(fileno=number)
    with suppress(OSError):
        connection.shutdown(socket.SHUT_RDWR)
    connection.detach()


def _create_tables(engine: Engine) -> None:
    """Create the tables that are missing; another run may do so at the same time."""
    attempts = 3  # PostgreSQL may fail where two runs create the same table
    for attempt in range(attempts):
        try:
            with engine.begin() as connection:
                existing = set(sql.inspect(connection).get_table_names())
                for table in _METADATA.sorted_tables:
                    if table.name not in existing:
                        connection.execute(CreateTable(table, if_not_exists=True))
                        _carry_over(connection, table, existing)
                _create_views(connection)
            return
        except SQLAlchemyError:
            if attempt == attempts - 1:
                raise


def _carry_over(connection: Connection, table: sql.Table, existing: set[str]) -> None:
    """Copy the rows of the last schema that no run computes again, by the columns of both."""
    name = table.name.rpartition("_")[0]
    older = [n for n in range(1, constants.SCHEMA) if f"{name}_{n}" in existing]
    if table not in _CARRIED or not older:
        return
    before = sql.Table(f"{name}_{older[-1]}", sql.MetaData(), autoload_with=connection)
    columns = [column.name for column in table.columns if column.name in before.columns]
    if all(column.nullable for column in table.columns if column.name not in columns):
        # SQLite needs a condition in front of ON CONFLICT.
        every = sql.select(*(before.c[name] for name in columns)).where(sql.text("1 = 1"))
        insert = _INSERT[connection.dialect.name](table).from_select(columns, every)
        connection.execute(insert.on_conflict_do_nothing())  # of another run at the same time


def _create_views(connection: Connection) -> None:
    """Create the views of dashboards, or make them those of this schema; rights on them stay."""
    there = sql.inspect(connection)
    existing = there.get_view_names()
    for name, table in _VIEWS.items():
        if name in existing:
            if table.name in (there.get_view_definition(name) or ""):
                continue
            connection.execute(sql.text(f"DROP VIEW {name}"))
        names = [column.name for column in table.columns if not column.primary_key]
        columns = ", ".join("name AS stage" if name == "name" else name for name in names)
        create = _CREATE_VIEW[connection.dialect.name]
        query = f"SELECT {columns} FROM {table.name}"  # noqa: S608 (names of this module)
        connection.execute(sql.text(f"{create} {name} AS {query}"))


# SQLite (beginning of its codes): faults of the computer, another process or its rights.
_PASSING = ("FULL", "BUSY", "LOCKED", "IOERR", "NOMEM", "INTERRUPT", "PROTOCOL", "PERM", "AUTH")
_COST = (
    "the next run then identifies all logs and assesses all machines again; comparisons with "
    "earlier reports, earlier runs on dashboards and alerts that were not sent are lost"
)


def _next_step(error: Exception, address: str) -> str:
    """Return what to do about a database that is damaged or cannot be written to, else nothing."""
    if (origin := getattr(error, "orig", None)) is None:
        return ""
    file = make_url(address).database
    code = getattr(origin, "sqlite_errorname", "").removeprefix("SQLITE_")
    if str(getattr(origin, "sqlstate", "")) in ("XX001", "XX002"):  # damaged data, damaged index
        tables = f"the tables *_{constants.SCHEMA} of lmshealth"
        return f"restore the database from a backup, or drop {tables} in it: {_COST}"
    if code.startswith(("READONLY", "CANTOPEN")):
        return f"copy {file} and {file}-wal, where there is one, to a folder that can be written to"
    if code == "NOTADB":
        return f"give another file by --store; if it was a store, delete it: {_COST}"
    if code and not code.startswith(_PASSING):
        return f"it is damaged: delete {file}, and {file}-wal and -shm where they are: {_COST}"
    return ""


def _reason(error: Exception, address: str) -> str:
    """Return an error in one line, without statements of SQL and without secrets."""
    text = str(getattr(error, "orig", None) or error).strip()
    first = text.splitlines()[0] if text else type(error).__name__
    return without_secrets(first, address)
