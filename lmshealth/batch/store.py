"""Store of results: a content-addressed cache and the published assessments (SQLite, PostgreSQL).

The key of a result is a fingerprint of everything that the result depends on. A change of any of it
gives another key, so that only stale results are computed again. A row that is damaged, or that
this version cannot decode, counts as absent. Every write may be repeated, and may be made by two
runs at once: runs may be killed, and may share a store.
"""

import hashlib
import logging
import re
import socket
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from threading import Event, Timer
from typing import Any, NamedTuple, Self
from urllib.parse import quote

import sqlalchemy as sql
from sqlalchemy.dialects import postgresql, sqlite
from sqlalchemy.engine import URL, Connection, Engine, make_url
from sqlalchemy.exc import DBAPIError, SQLAlchemyError
from sqlalchemy.schema import CreateTable

from lmshealth._serialize import VERSION, fingerprint, pack, unpack
from lmshealth.batch import constants
from lmshealth.batch.addresses import shown_address, without_secrets
from lmshealth.batch.status import Change, Status
from lmshealth.errors import LmshealthError
from lmshealth.io.log import Refusal
from lmshealth.report.assessment import Summary
from lmshealth.tracking.history import LogEstimates

Outcome = LogEstimates | tuple[Refusal, ...]
"""Result of a log: its modal estimates, or why it was refused."""

_INSERT: dict[str, Any] = {"sqlite": sqlite.insert, "postgresql": postgresql.insert}

_logger = logging.getLogger(__name__)


class StoreError(LmshealthError):
    """A store that cannot be opened, read or written."""


# Tables: the key of a machine is a digest, because its name may be longer than an index allows

_METADATA = sql.MetaData()
_BYTES, _DIGEST = sql.LargeBinary, sql.String(64)
_KINDS: dict[str, Any] = {"content": _BYTES, "evidence": _BYTES, "summary": _BYTES}
_KINDS |= {"number": sql.Integer, "version": sql.Text, "machine": sql.Text, "name": sql.Text}
_KINDS |= dict.fromkeys(("low", "median", "high", "probability"), sql.Float)
_KINDS |= dict.fromkeys(("service_by", "inspect_by"), sql.Date)
_KINDS |= dict.fromkeys(("recorded_at", "noticed_at"), sql.DateTime(timezone=True))
_KINDS |= dict.fromkeys(("state", "verdict", "service", "alarms", "silent"), sql.Text)
_KINDS |= dict.fromkeys(("quantity", "subject", "what", "before", "now"), sql.Text)
_DIGEST_BYTES = 16  # of a record and its keys, before the record
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
_HASHED = _table("hashed", "key", "digest")
# Outcome of each log; the columns between key and content are for people.
_IDENTIFIED = _table("identified", "key", "digest description version machine content")
# The present assessment of each machine, and the one before the fleet prior was applied.
_ASSESSED = _table("assessed", "machine key", "content evidence summary")
# Parts of the last assessment of each machine, by the fingerprint of what they depend on.
_PARTS = _table("parts", "machine key", "content")
# Which assessment of each machine was published last, and the key of its list of refused logs.
_PRESENT = _table("present", "machine", "name key refused")
# Summaries of all published assessments, numbered in the order of publication.
_REPORTED = _table("reported", "machine key", "number content")
# Lists of logs that belong to no machine, by the fingerprint of the list.
_REFUSED = _table("refused", "key", "content")
# For dashboards: the present status of each machine, its values at logs, changes between runs.
_SHOWN = "recorded_at verdict probability service service_by inspect_by"
_STATUS = _table("status", "machine", f"name {_SHOWN} state alarms silent")
_POINTS = _table("points", "machine key", "name recorded_at quantity subject low median high")
_CHANGES = _table("changes", "machine key", "name recorded_at noticed_at what before now")
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
    """Key of the assessment of a machine that was published last, and of its refused logs."""

    machine: str
    key: str
    refused: str


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
        self._shown = shown_address(self._address)
        tables = sql.inspect(self._engine).get_table_names()
        self._claims: Connection | None = None
        optional = {table.name for table in (_HASHED, *_VIEWS.values())}
        if missing := _METADATA.tables.keys() - optional - set(tables):
            older = any(re.fullmatch(r"(identified|assessed)_\d+", table) for table in tables)
            found = "only results of another version of lmshealth" if older else "no results"
            self.close()
            raise self._unfilled(f"{found} (no table {min(missing)})")

    def _unfilled(self, found: str) -> StoreError:
        return StoreError(
            f"the store {self._shown} holds {found}; `lmshealth run LOGS --store URL` fills it"
        )

    def close(self) -> None:
        """Close all connections."""
        self._drop_claims()
        self._engine.dispose()

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

    # Logs

    def digests(self, keys: Iterable[str]) -> dict[str, str]:
        """Fetch the digests of the content of those files that are known by their keys."""
        return {row.key: row.digest for row in self._of_keys(_HASHED, _HASHED.c.digest, keys)}

    def put_digests(self, digests: Mapping[str, str]) -> None:
        """Store digests of the content of files."""
        with self._begin() as connection:
            rows = [{"key": key, "digest": digest} for key, digest in digests.items()]
            self._put_rows(connection, _HASHED, rows)

    def identified(self, keys: Iterable[str]) -> Iterator[tuple[str, Identified]]:
        """Fetch the outcomes of those logs that are stored, under their names of that time."""
        for key, content in self.packed_identified(keys):
            if (found := unpack_or_none(content, Identified)) is not None:
                yield key, found

    def packed_identified(self, keys: Iterable[str]) -> Iterator[tuple[str, bytes]]:
        """Fetch the same as bytes, for `unpack_or_none` in a worker."""
        for row in self._of_keys(_IDENTIFIED, _IDENTIFIED.c.content, keys):
            if (content := _unsealed(row.content, row.key)) is not None:
                yield row.key, content

    def put_identified(self, rows: Iterable[OutcomeRow]) -> None:
        """Store outcomes of logs in one transaction."""
        whole = [
            row._asdict() | {"content": _sealed(row.content, row.key), "version": VERSION}
            for row in rows
        ]
        with self._begin() as connection:
            self._put_rows(connection, _IDENTIFIED, whole)

    # Machines

    def has_assessment(self, machine: str, key: str) -> bool:
        """Return whether a machine has an assessment under a key."""
        return self._of_assessment(sql.literal(True), machine, key) is not None

    def assessment(self, machine: str, key: str) -> bytes | None:
        """Fetch a packed assessment; None where it is not stored."""
        return _unsealed(self._of_assessment(_ASSESSED.c.content, machine, key), machine, key)

    def evidence(self, machine: str, key: str) -> bytes | None:
        """Fetch the packed evidence of an assessment for a fleet prior; None as before."""
        return _unsealed(self._of_assessment(_ASSESSED.c.evidence, machine, key), machine, key)

    def put_assessment(self, machine: str, key: str, made: PackedAssessment) -> None:
        """Store an assessment of a machine, and its parts in place of those stored before."""
        own, parts = _id(machine), made.parts
        row = {
            name: _sealed(getattr(made, name), machine, key)
            for name in ("content", "evidence", "summary")
        }
        with self._begin() as connection:
            connection.execute(self._upsert(_ASSESSED, {"machine": own, "key": key} | row))
            if parts is None:
                return
            of_this = _PARTS.c.machine == own
            connection.execute(sql.delete(_PARTS).where(of_this, _PARTS.c.key.not_in(list(parts))))
            self._put_rows(connection, _PARTS, [_part(machine, *part) for part in parts.items()])

    def put_part(self, machine: str, key: str, content: bytes) -> None:
        """Store one more part of the last assessment of a machine."""
        self._put(_PARTS, _part(machine, key, content))

    def part(self, machine: str, key: str) -> bytes | None:
        """Fetch a part of the last assessment of a machine; None where it is not stored."""
        where = _PARTS.c.machine == _id(machine), _PARTS.c.key == key
        return _unsealed(self._first(sql.select(_PARTS.c.content).where(*where)), machine, key)

    def parts(self, machine: str) -> dict[str, bytes]:
        """Fetch the parts of the last assessment of a machine by key."""
        query = sql.select(_PARTS.c.key, _PARTS.c.content).where(_PARTS.c.machine == _id(machine))
        with self._begin() as connection:
            rows = connection.execute(query).all()
        found = {row.key: _unsealed(row.content, machine, row.key) for row in rows}
        return {key: content for key, content in found.items() if content is not None}

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
            self._put_rows(connection, _POINTS, _named(rows))

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
        with self._begin() as connection:
            self._put_rows(connection, _STATUS, _named(present))
            self._put_rows(connection, _CHANGES, _named(changed))

    def put_refused(self, refused: tuple[Refusal, ...]) -> str:
        """Store a list of logs that belong to no machine, and return its key."""
        key = fingerprint(refused)
        self._put(_REFUSED, {"key": key, "content": _sealed(pack(refused), key)})
        return key

    def publish(self, machine: str, keys: Sequence[str], refused: str) -> None:
        """Make an assessment the present one of a machine, and delete its other assessments.

        The keys are that of the assessment, and those of others of the machine that stay;
        ``refused`` is that of the list of logs that belong to no machine.
        """
        own, key, stored = _id(machine), keys[0], _ASSESSED.c
        present = {"machine": own, "name": machine, "key": key, "refused": refused}
        newest = sql.func.coalesce(sql.func.max(_REPORTED.c.number), 0)
        summary: dict[str, Any] = {"machine": sql.literal(own), "key": sql.literal(key)}
        summary["number"] = sql.select(newest + 1).scalar_subquery()
        summary["content"] = stored.summary
        others = sql.delete(_ASSESSED).where(stored.machine == own, stored.key.not_in(keys))
        with self._begin() as connection:
            connection.execute(self._upsert(_PRESENT, present))
            of_this = (stored.machine == own) & (stored.key == key)
            connection.execute(self._upsert(_REPORTED, summary, where=of_this))
            connection.execute(others)

    def previous_summary(self, machine: str, key: str) -> Summary | None:
        """Fetch the summary of the newest published assessment under another key; None if none."""
        query = (
            sql.select(_REPORTED.c.key, _REPORTED.c.content)
            .where(_REPORTED.c.machine == _id(machine), _REPORTED.c.key != key)
            .order_by(_REPORTED.c.number.desc())
        )
        with self._begin() as connection:
            summaries = (
                unpack_or_none(_unsealed(row.content, machine, row.key), Summary)
                for row in connection.execute(query)
            )
            return next((summary for summary in summaries if summary is not None), None)

    def published(self) -> tuple[Published, ...]:
        """List the published assessments of all machines by name; `StoreError` if none is."""
        query = sql.select(_PRESENT.c.name, _PRESENT.c.key, _PRESENT.c.refused)
        with self._begin() as connection:
            rows = connection.execute(query).all()
        if not rows:
            raise self._unfilled("no assessment")
        return tuple(sorted((Published(*row) for row in rows), key=lambda one: one.machine))

    def refused(self, keys: Iterable[str]) -> tuple[Refusal, ...]:
        """Fetch lists of logs that belong to no machine, each refusal once."""
        found: dict[Refusal, None] = {}
        for key in dict.fromkeys(keys):
            content = self._first(sql.select(_REFUSED.c.content).where(_REFUSED.c.key == key))
            listed = unpack_or_none(_unsealed(content, key), tuple[Refusal, ...])
            found |= dict.fromkeys(listed or ())
        return tuple(found)

    # Statements

    def _of_keys(self, table: sql.Table, column: Any, keys: Iterable[str]) -> Iterator[Any]:
        """Fetch a column of the rows that are there under keys, some rows in each query."""
        asked = list(dict.fromkeys(keys))
        for first in range(0, len(asked), constants.ROWS_PER_QUERY):
            part = asked[first : first + constants.ROWS_PER_QUERY]
            query = sql.select(table.c.key, column).where(table.c.key.in_(part))
            with self._begin() as connection:
                rows = connection.execute(query).all()
            yield from rows

    def _of_assessment(self, column: Any, machine: str, key: str) -> Any:
        where = _ASSESSED.c.machine == _id(machine), _ASSESSED.c.key == key
        return self._first(sql.select(column).where(*where))

    def _first(self, query: Any) -> Any:
        """Fetch the first value of a query; None if there is none."""
        with self._begin() as connection:
            return connection.scalars(query).first()

    def _put(self, table: sql.Table, row: dict[str, Any]) -> None:
        with self._begin() as connection:
            connection.execute(self._upsert(table, row))

    def _put_rows(
        self, connection: Connection, table: sql.Table, rows: Sequence[dict[str, Any]]
    ) -> None:
        """Write rows in one statement."""
        if rows:
            connection.execute(self._upsert(table, rows[0]), rows)

    def _upsert(self, table: sql.Table, row: dict[str, Any], *, where: Any = None) -> Any:
        """Insert or update a row, of another table with ``where``: a later write replaces it."""
        insert = _INSERT[self._engine.dialect.name](table)
        if where is None:
            insert = insert.values(row)
        else:
            insert = insert.from_select(list(row), sql.select(*row.values()).where(where))
        keys = [column.name for column in table.primary_key]
        rest = {name: insert.excluded[name] for name in row if name not in keys}
        return insert.on_conflict_do_update(index_elements=keys, set_=rest)

    @contextmanager
    def _begin(self) -> Iterator[Connection]:
        """Open a transaction."""
        with self._faults(), self._engine.begin() as connection:
            yield connection

    @contextmanager
    def _faults(self) -> Iterator[None]:
        """Replace the errors of the database by a `StoreError`."""
        try:
            yield
        except SQLAlchemyError as error:
            why = f"{_reason(error, self._address)}; its results are kept, run again to continue"
            # The cause would quote the row.
            raise StoreError(f"the store {self._shown} failed: {why}") from None


def _lock_number(key: str) -> int:
    digest = hashlib.sha256(key.encode("utf-8", "surrogatepass")).digest()
    return int.from_bytes(digest[:8], signed=True)


def _id(machine: str) -> str:
    return hashlib.sha256(machine.encode("utf-8", "surrogatepass")).hexdigest()


def _named(rows: Iterable[dict[str, Any]]) -> list[dict[str, Any]]:
    """Add the keys of machines to rows with their names; moments in UTC: SQLite has no zones."""
    return [
        {k: v.astimezone(UTC) if isinstance(v, datetime) else v for k, v in row.items()}
        | {"machine": _id(row["name"])}
        for row in rows
    ]


def _sealed(content: bytes, *keys: str) -> bytes:
    """Prefix a record with a digest of it and of its keys.

    A damaged index of SQLite leads to the record of another key, which is intact by itself.
    """
    return _digest(content, keys) + content


def _unsealed(stored: bytes | None, *keys: str) -> bytes | None:
    """Return the record that was stored under these keys; None for none or a damaged one."""
    if stored is None:
        return None
    digest, content = stored[:_DIGEST_BYTES], stored[_DIGEST_BYTES:]
    return content if digest == _digest(content, keys) else None


def _digest(content: bytes, keys: tuple[str, ...]) -> bytes:
    subject = "\0".join(keys).encode("utf-8", "surrogatepass")
    return hashlib.blake2b(
        content, digest_size=_DIGEST_BYTES, key=hashlib.sha256(subject).digest()
    ).digest()


def _part(machine: str, key: str, content: bytes) -> dict[str, Any]:
    return {"machine": _id(machine), "key": key, "content": _sealed(content, machine, key)}


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
        reason = _reason(error, address)
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
        url = url.set(database=path).update_query_dict({"mode": "rw", "uri": "true"})
    engine = sql.create_engine(url, connect_args={"timeout": constants.SQLITE_BUSY_TIMEOUT_S})

    @sql.event.listens_for(engine, "connect")
    def _set_up(connection: Any, _: Any) -> None:
        # WAL allows readers during a write. No wait for the disk at every log: results that a
        # crash of the computer loses are computed again.
        with suppress(Exception):  # another run may do so now, or the file may be no database
            if create:
                connection.execute("PRAGMA journal_mode = WAL")
        connection.execute("PRAGMA synchronous = NORMAL")

    return engine


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
    name, _, number = table.name.rpartition("_")
    found = (re.fullmatch(rf"{name}_(\d+)", other) for other in existing)
    older = max((n for one in found if one and (n := int(one[1])) < int(number)), default=None)
    if table not in (_REPORTED, _POINTS, _CHANGES) or older is None:
        return
    there = {column["name"] for column in sql.inspect(connection).get_columns(f"{name}_{older}")}
    columns = [column for column in table.columns if column.name in there]
    if all(column.nullable for column in table.columns if column not in columns):
        before = sql.table(f"{name}_{older}", *(sql.column(c.name, c.type) for c in columns))
        insert = _INSERT[connection.dialect.name](table)
        # SQLite needs a condition in front of ON CONFLICT.
        every = sql.select(before).where(sql.text("1 = 1"))
        insert = insert.from_select([c.name for c in columns], every)
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
        connection.execute(sql.text(f"{create} {name} AS SELECT {columns} FROM {table.name}"))


def _reason(error: Exception, address: str) -> str:
    """Return an error in one line, without statements of SQL and without secrets."""
    text = str(getattr(error, "orig", None) or error).strip()
    first = text.splitlines()[0] if text else type(error).__name__
    return without_secrets(first, address)
