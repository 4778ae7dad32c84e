"""Store of results: a content-addressed cache and the published assessments (SQLite, PostgreSQL).

The key of a result is a fingerprint of everything that the result depends on. A change of any of it
gives another key, so that only stale results are computed again. A row that this version cannot
decode counts as absent. Every write may be repeated, and may be made by two runs at once: runs may
be killed, and may share a store.
"""

from __future__ import annotations

import hashlib
import logging
import re
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from urllib.parse import quote

from sqlalchemy import Column, Integer, LargeBinary, MetaData, String, Table, Text
from sqlalchemy import create_engine, delete, event, func, inspect, literal, select
from sqlalchemy.dialects import postgresql, sqlite
from sqlalchemy.engine import URL, Connection, Engine, make_url
from sqlalchemy.exc import SQLAlchemyError
from sqlalchemy.schema import CreateTable

from lmshealth._serialize import VERSION, fingerprint, pack, unpack
from lmshealth.batch import constants
from lmshealth.batch.addresses import shown_address, without_secrets
from lmshealth.errors import LmshealthError
from lmshealth.io.log import Refusal
from lmshealth.report.changes import Reported
from lmshealth.tracking.history import LogEstimates

Outcome = LogEstimates | tuple[Refusal, ...]
"""Result of a log: its modal estimates, or why it was refused."""

_INSERT: dict[str, Any] = {"sqlite": sqlite.insert, "postgresql": postgresql.insert}

_logger = logging.getLogger(__name__)


class StoreError(LmshealthError):
    """A store that cannot be opened, read or written."""


# Tables: the key of a machine is a digest, because its name may be longer than an index allows

_METADATA = MetaData()


def _table(table: str, keys: str, /, **columns: Any) -> Table:
    primary = [Column(key, String(64), primary_key=True) for key in keys.split()]
    others = [Column(key, kind, nullable=key == "machine") for key, kind in columns.items()]
    return Table(f"{table}_{constants.SCHEMA}", _METADATA, *primary, *others)


# Outcome of each log; the columns between key and content are for people.
_IDENTIFIED = _table(
    "identified",
    "key",
    digest=String(64),
    description=String(64),
    version=Text,
    machine=Text,
    content=LargeBinary,
)
# The present assessment of each machine, and the one before the fleet prior was applied.
_ASSESSED = _table(
    "assessed", "machine key", content=LargeBinary, evidence=LargeBinary, summary=LargeBinary
)
# Which assessment of each machine was published last, and the key of its list of refused logs.
_PRESENT = _table("present", "machine", name=Text, key=String(64), refused=String(64))
# Summaries of all published assessments, numbered in the order of publication.
_REPORTED = _table("reported", "machine key", number=Integer, content=LargeBinary)
# Lists of logs that belong to no machine, by the fingerprint of the list.
_REFUSED = _table("refused", "key", content=LargeBinary)


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

    def renamed(self, log: str) -> Identified:
        """Replace the name of the log, which may have been moved since."""
        modes = self.outcome.modes if isinstance(self.outcome, LogEstimates) else None
        listed = self.outcome if modes is None else modes.refused
        refused = tuple(replace(refusal, log=log) for refusal in listed)
        if modes is None:
            return replace(self, outcome=refused)
        modes = replace(modes, refused=refused)
        return replace(self, outcome=replace(self.outcome, log=log, modes=modes))


@dataclass(frozen=True, slots=True)
class PackedAssessment:
    """An assessment as bytes: as a whole, its evidence for a fleet prior, and its summary."""

    content: bytes
    evidence: bytes
    summary: bytes


@dataclass(frozen=True, slots=True)
class Published:
    """Key of the assessment of a machine that was published last, and of its refused logs."""

    machine: str
    key: str
    refused: str


def unpack_or_none(content: bytes, kind: Any) -> Any:
    """Decode a packed record of a store; None where this version cannot."""
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
    """Results behind an SQLAlchemy URL, of SQLite or PostgreSQL.

    Parameters
    ----------
    url : str or URL
        Such as ``sqlite:///results.sqlite`` or ``postgresql://me@host/fleet``.
    create : bool
        Whether to create the database file and tables that are missing.

    Raises
    ------
    StoreError
        If it cannot be opened, or does not exist and may not be created.
    """

    def __init__(self, url: str | URL, *, create: bool = True) -> None:
        self._engine, self._address = _connect(url, create=create)
        self._shown = shown_address(self._address)
        tables = inspect(self._engine).get_table_names()
        if missing := set(_METADATA.tables) - set(tables):
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
        self._engine.dispose()

    # Logs

    def identified(self, keys: Iterable[str]) -> Iterator[tuple[str, Identified]]:
        """Fetch the outcomes of those logs that are stored, under their names of that time."""
        for key, content in self.packed_identified(keys):
            if (found := unpack_or_none(content, Identified)) is not None:
                yield key, found

    def packed_identified(self, keys: Iterable[str]) -> Iterator[tuple[str, bytes]]:
        """Fetch the same as bytes, for `unpack_or_none` in a worker."""
        asked = list(dict.fromkeys(keys))
        for first in range(0, len(asked), constants.ROWS_PER_QUERY):
            part = asked[first : first + constants.ROWS_PER_QUERY]
            query = select(_IDENTIFIED.c.key, _IDENTIFIED.c.content)
            with self._begin() as connection:
                rows = connection.execute(query.where(_IDENTIFIED.c.key.in_(part))).all()
            yield from ((row.key, row.content) for row in rows)

    def put_identified(self, key: str, digest: str, found: Identified) -> None:
        """Store the outcome of a log whose content has a digest."""
        row = {"key": key, "digest": digest, "description": found.description, "version": VERSION}
        machine = found.stage if isinstance(found.outcome, LogEstimates) else None
        self._upsert(_IDENTIFIED, row | {"machine": machine, "content": pack(found)})

    # Machines

    def has_assessment(self, machine: str, key: str) -> bool:
        """Return whether a machine has an assessment under a key."""
        return self._of_assessment(literal(True), machine, key) is not None

    def assessment(self, machine: str, key: str) -> bytes | None:
        """Fetch a packed assessment; None where it is not stored."""
        content: bytes | None = self._of_assessment(_ASSESSED.c.content, machine, key)
        return content

    def evidence(self, machine: str, key: str) -> bytes | None:
        """Fetch the packed evidence of an assessment for a fleet prior; None as before."""
        content: bytes | None = self._of_assessment(_ASSESSED.c.evidence, machine, key)
        return content

    def put_assessment(self, machine: str, key: str, made: PackedAssessment) -> None:
        """Store an assessment of a machine."""
        row = {"machine": _id(machine), "key": key, "content": made.content}
        self._upsert(_ASSESSED, row | {"evidence": made.evidence, "summary": made.summary})

    def put_refused(self, refused: tuple[Refusal, ...]) -> str:
        """Store a list of logs that belong to no machine, and return its key."""
        key = fingerprint(refused)
        self._upsert(_REFUSED, {"key": key, "content": pack(refused)})
        return key

    def publish(self, machine: str, keys: Sequence[str], refused: str) -> None:
        """Make an assessment the present one of a machine, and delete its other assessments.

        Parameters
        ----------
        machine : str
            Its name.
        keys : sequence of str
            Of the assessment, and of others of the machine that stay.
        refused : str
            Key of the list of logs that belong to no machine.
        """
        own, key, stored = _id(machine), keys[0], _ASSESSED.c
        number = select(func.coalesce(func.max(_REPORTED.c.number), 0) + 1).scalar_subquery()
        summary = select(literal(own), literal(key), number, stored.summary).where(
            stored.machine == own, stored.key == key
        )
        columns = ["machine", "key", "number", "content"]
        row = {"machine": own, "name": machine, "key": key, "refused": refused}
        with self._begin() as connection:
            self._upsert_in(connection, _PRESENT, row)
            add = self._insert(_REPORTED).from_select(columns, summary)
            connection.execute(_or_update(add, _REPORTED, columns))
            others = delete(_ASSESSED).where(stored.machine == own, stored.key.not_in(keys))
            connection.execute(others)

    def previous_summary(self, machine: str, key: str) -> Reported | None:
        """Fetch the summary of the newest published assessment under another key; None if none."""
        query = (
            select(_REPORTED.c.content)
            .where(_REPORTED.c.machine == _id(machine), _REPORTED.c.key != key)
            .order_by(_REPORTED.c.number.desc())
        )
        with self._begin() as connection:
            summaries = (unpack_or_none(row, Reported) for row in connection.scalars(query))
            return next((summary for summary in summaries if summary is not None), None)

    def published(self) -> tuple[Published, ...]:
        """List the published assessments of all machines, in the order of their names.

        Raises
        ------
        StoreError
            If there is none.
        """
        query = select(_PRESENT.c.name, _PRESENT.c.key, _PRESENT.c.refused)
        with self._begin() as connection:
            rows = connection.execute(query).all()
        if not rows:
            raise self._unfilled("no assessment")
        return tuple(sorted((Published(*row) for row in rows), key=lambda one: one.machine))

    def refused(self, keys: Iterable[str]) -> tuple[Refusal, ...]:
        """Fetch lists of logs that belong to no machine, each refusal once."""
        found: dict[Refusal, None] = {}
        for key in dict.fromkeys(keys):
            content = self._first(select(_REFUSED.c.content).where(_REFUSED.c.key == key))
            own = None if content is None else unpack_or_none(content, tuple[Refusal, ...])
            found |= dict.fromkeys(own or ())
        return tuple(found)

    # Statements

    def _of_assessment(self, column: Any, machine: str, key: str) -> Any:
        stored = _ASSESSED.c
        return self._first(select(column).where(stored.machine == _id(machine), stored.key == key))

    def _first(self, query: Any) -> Any:
        """Fetch the first value of a query; None if there is none."""
        with self._begin() as connection:
            return connection.scalars(query).first()

    def _insert(self, table: Table) -> Any:
        return _INSERT[self._engine.dialect.name](table)

    def _upsert(self, table: Table, row: dict[str, Any]) -> None:
        with self._begin() as connection:
            self._upsert_in(connection, table, row)

    def _upsert_in(self, connection: Connection, table: Table, row: dict[str, Any]) -> None:
        connection.execute(_or_update(self._insert(table).values(row), table, row))

    @contextmanager
    def _begin(self) -> Iterator[Connection]:
        """Open a transaction."""
        try:
            with self._engine.begin() as connection:
                yield connection
        except SQLAlchemyError as error:
            raise StoreError(
                f"the store {self._shown} failed: {_reason(error, self._address)}; its results "
                "are kept, run again to continue"
            ) from None  # the cause would quote the row


def _or_update(insert: Any, table: Table, columns: Iterable[str]) -> Any:
    """Update a row that exists: of two that are written at once the later one stays."""
    keys = [column.name for column in table.primary_key]
    rest = {name: insert.excluded[name] for name in columns if name not in keys}
    return insert.on_conflict_do_update(index_elements=keys, set_=rest)


def _id(machine: str) -> str:
    return hashlib.sha256(machine.encode("utf-8", "surrogatepass")).hexdigest()


# Databases


def _connect(url: str | URL, *, create: bool) -> tuple[Engine, str]:
    """Open a database; return its engine and its URL as text."""
    address = url if isinstance(url, str) else url.render_as_string(False)
    if "://" not in address:
        raise StoreError(
            "cannot open the store: the given address is no URL; a file is sqlite:///PATH, a "
            "database postgresql://user@host/name"
        )
    engine: Engine | None = None
    try:
        parsed = _parsed(url)
        engine = _engine(parsed) if create else _engine(_existing(parsed), shared=False)
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


def _parsed(url: str | URL) -> URL:
    """Parse a URL; PostgreSQL uses the driver that the extra installs."""
    parsed = make_url(url)
    kind = parsed.get_backend_name()
    if kind not in _INSERT:
        raise ValueError(f"{kind} is not supported: use {' or '.join(_INSERT)}")
    plain = parsed.drivername == "postgresql"
    return parsed.set(drivername="postgresql+psycopg") if plain else parsed


def _engine(url: URL, *, shared: bool = True) -> Engine:
    if url.get_backend_name() != "sqlite":
        timeout = constants.SERVER_TIMEOUT_S
        wait = {} if "connect_timeout" in url.query else {"connect_timeout": timeout}
        return create_engine(url, pool_pre_ping=True, connect_args=wait)
    folder = Path(url.database or "").parent
    if not (url.database or "").startswith("file:") and not folder.is_dir():
        raise ValueError(f"there is no folder {folder}")
    engine = create_engine(url, connect_args={"timeout": constants.SQLITE_BUSY_TIMEOUT_S})

    @event.listens_for(engine, "connect")
    def _set_up(connection: Any, _: Any) -> None:
        # WAL allows readers during a write. No wait for the disk at every log: results that a
        # crash of the computer loses are computed again.
        with suppress(Exception):  # another run may do so now, or the file may be no database
            if shared:
                connection.execute("PRAGMA journal_mode = WAL")
        connection.execute("PRAGMA synchronous = NORMAL")

    return engine


def _create_tables(engine: Engine) -> None:
    """Create the tables that are missing; another run may do so at the same time."""
    attempts = 3  # PostgreSQL may fail where two runs create the same table
    for attempt in range(attempts):
        try:
            with engine.begin() as connection:
                existing = set(inspect(connection).get_table_names())
                for table in _METADATA.sorted_tables:
                    if table.name not in existing:
                        connection.execute(CreateTable(table, if_not_exists=True))
            return
        except SQLAlchemyError:
            if attempt == attempts - 1:
                raise


def _existing(url: URL) -> URL:
    """Add to a URL that SQLite must not create the file."""
    name = url.database or ":memory:"
    if url.get_backend_name() != "sqlite" or name == ":memory:":
        return url
    if not name.startswith("file:") and not Path(name).exists():
        raise ValueError("there is no such file; `lmshealth run LOGS --store URL` makes it")
    path = name if name.startswith("file:") else f"file:{quote(name)}"
    return url.set(database=path).update_query_dict({"mode": "rw", "uri": "true"})


def _reason(error: Exception, address: str) -> str:
    """Return an error in one line, without statements of SQL and without secrets."""
    text = str(getattr(error, "orig", None) or error).strip()
    first = text.splitlines()[0] if text else type(error).__name__
    return without_secrets(first, address)
