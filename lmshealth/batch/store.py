"""What has been done already, so that a run can go on and a report needs no logs.

Results are named by fingerprints of everything they depend on: a change of anything is another
name, so that what is stale is done again and nothing else is. A row that this version cannot read
counts as absent. Every write may be done twice and by two at once, so that runs may be killed, and
may share a store.
"""

from __future__ import annotations

import hashlib
import logging
import re
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from sqlalchemy import (
    LargeBinary,
    String,
    Text,
    delete,
    func,
    inspect,
    literal,
    select,
)
from sqlalchemy.engine import URL
from sqlalchemy.exc import SQLAlchemyError
from sqlalchemy.orm import DeclarativeBase, Mapped, Session, mapped_column

from lmshealth._serialize import VERSION, fingerprint, pack, unpack
from lmshealth.batch.addresses import shown_address
from lmshealth.batch.database import INSERT, StoreError, connect, why
from lmshealth.io.log import Refusal
from lmshealth.report.changes import Reported
from lmshealth.tracking.history import LogEstimates

SCHEMA = 5  # part of the names of the tables: what an older one holds is not read

Outcome = LogEstimates | tuple[Refusal, ...]
"""What became of a log: its reading, or why it was refused."""

# Rows asked for at a time.
_BATCH = 400

_logger = logging.getLogger(__name__)


class _Base(DeclarativeBase):
    pass


class _Identified(_Base):
    """What became of each log; the columns between key and content are for people."""

    __tablename__ = f"identified_{SCHEMA}"

    key: Mapped[str] = mapped_column(String(64), primary_key=True)
    digest: Mapped[str] = mapped_column(String(64))
    description: Mapped[str] = mapped_column(String(64))
    version: Mapped[str] = mapped_column(Text)
    machine: Mapped[str | None] = mapped_column(Text)
    content: Mapped[bytes] = mapped_column(LargeBinary)


class _Assessed(_Base):
    """The present assessment of each machine, and what it was before the fleet's prior.

    Machines are named by a digest: their own names may be longer than an index takes.
    """

    __tablename__ = f"assessed_{SCHEMA}"

    machine: Mapped[str] = mapped_column(String(64), primary_key=True)
    key: Mapped[str] = mapped_column(String(64), primary_key=True)
    content: Mapped[bytes] = mapped_column(LargeBinary)
    evidence: Mapped[bytes] = mapped_column(LargeBinary)
    said: Mapped[bytes] = mapped_column(LargeBinary)


class _Present(_Base):
    """Which assessment of each machine was told last, and by a run that refused which logs."""

    __tablename__ = f"present_{SCHEMA}"

    machine: Mapped[str] = mapped_column(String(64), primary_key=True)
    name: Mapped[str] = mapped_column(Text)
    key: Mapped[str] = mapped_column(String(64))
    refused: Mapped[str] = mapped_column(String(64))


class _Reported(_Base):
    """What all assessments that were told said, in the order in which they were."""

    __tablename__ = f"reported_{SCHEMA}"

    machine: Mapped[str] = mapped_column(String(64), primary_key=True)
    key: Mapped[str] = mapped_column(String(64), primary_key=True)
    number: Mapped[int]
    content: Mapped[bytes] = mapped_column(LargeBinary)


class _Refused(_Base):
    """Logs that belong to no machine, by the fingerprint of their list."""

    __tablename__ = f"refused_{SCHEMA}"

    key: Mapped[str] = mapped_column(String(64), primary_key=True)
    content: Mapped[bytes] = mapped_column(LargeBinary)


@dataclass(frozen=True, slots=True, eq=False)
class Identified:
    """What became of a log, and of what that is true.

    Attributes
    ----------
    outcome : LogEstimates or tuple of Refusal
        What it gave.
    description : str
        Digest of the stage description that had a part in it; empty where none had.
    stage, asked : str or None
        Identity of the machine and name of the description as the log's metadata have them.
    lasting : bool
        Whether trying again would give the same; False where something beside the log failed.
    """

    outcome: Outcome
    description: str = ""
    stage: str | None = None
    asked: str | None = None
    lasting: bool = True

    def named(self, log: str) -> Identified:
        """Give it under the present name of the log."""
        if not isinstance(self.outcome, LogEstimates):
            return replace(self, outcome=_renamed(self.outcome, log))
        modes = replace(self.outcome.modes, refused=_renamed(self.outcome.modes.refused, log))
        return replace(self, outcome=replace(self.outcome, log=log, modes=modes))


@dataclass(frozen=True, slots=True)
class Made:
    """An assessment as bytes: whole, what it teaches of others, and what it says in short."""

    content: bytes
    evidence: bytes
    said: bytes


@dataclass(frozen=True, slots=True)
class Told:
    """What a store was told last of a machine: under which key, by which list of refused logs."""

    machine: str
    key: str
    refused: str


def beside(folder: Path) -> URL:
    """URL of the default store: a SQLite file in the folder of the output, whatever its name.

    Raises
    ------
    StoreError
        If a link stands there: what it points to is not in the folder.
    """
    path = folder / "lmshealth.sqlite"
    if path.is_symlink():
        raise StoreError(f"the store {path} is a link; remove it, or name what is meant by --store")
    return URL.create("sqlite", database=str(path))


class Store:
    """Results behind an SQLAlchemy URL, of SQLite or PostgreSQL.

    Parameters
    ----------
    url : str or URL
        Such as ``sqlite:///results.sqlite``.
    create : bool
        Whether to make the store, or its tables, where they are not there.

    Raises
    ------
    StoreError
        If it cannot be opened, or is not there and not to be made.
    """

    def __init__(self, url: str | URL, *, create: bool = True) -> None:
        self._engine, self._address = connect(url, _Base.metadata, create=create)
        self._shown = shown_address(self._address)
        tables = inspect(self._engine).get_table_names()
        if missing := {table for table in _Base.metadata.tables if table not in tables}:
            older = any(re.fullmatch(r"(identified|assessed)_\d+", table) for table in tables)
            found = "only what another version of lmshealth kept" if older else "no results"
            self.close()
            raise StoreError(
                f"the store {self._shown} holds {found} (no table {min(missing)}); "
                "`lmshealth run LOGS --store URL` fills it"
            )

    def close(self) -> None:
        """Let go of all connections."""
        self._engine.dispose()

    # Logs

    def identified(self, keys: Iterable[str]) -> Iterator[tuple[str, Identified]]:
        """Fetch what became of those logs that the store knows, under the names of then."""
        for key, content in self.contents(keys):
            if (found := read(content, Identified)) is not None:
                yield key, found

    def contents(self, keys: Iterable[str]) -> Iterator[tuple[str, bytes]]:
        """Fetch the same packed, for `read` elsewhere."""
        asked = list(dict.fromkeys(keys))
        for first in range(0, len(asked), _BATCH):
            part = asked[first : first + _BATCH]
            query = select(_Identified.key, _Identified.content).where(_Identified.key.in_(part))
            with self._session() as session:
                rows = session.execute(query).all()
            yield from ((row.key, row.content) for row in rows)

    def put(self, key: str, digest: str, found: Identified) -> None:
        """Keep what became of a log of that content."""
        reading = found.outcome if isinstance(found.outcome, LogEstimates) else None
        row = {
            "key": key,
            "digest": digest,
            "description": found.description,
            "version": VERSION,
            "machine": None if reading is None else found.stage,
            "content": pack(found),
        }
        with self._session() as session:
            session.execute(self._upsert(_Identified, row))

    # Machines

    def has(self, machine: str, key: str) -> bool:
        """Tell whether there is an assessment of a machine under a key."""
        query = select(literal(1)).where(_Assessed.machine == _id(machine), _Assessed.key == key)
        with self._session() as session:
            return session.execute(query).first() is not None

    def assessment(self, machine: str, key: str) -> bytes | None:
        """Fetch a packed assessment; None where it is not there."""
        return self._column(_Assessed.content, machine, key)

    def evidence(self, machine: str, key: str) -> bytes | None:
        """Fetch what an assessment teaches, packed; None where it is not there."""
        return self._column(_Assessed.evidence, machine, key)

    def keep(self, machine: str, key: str, made: Made) -> None:
        """Keep an assessment of a machine."""
        row = {"machine": _id(machine), "key": key, "content": made.content}
        row |= {"evidence": made.evidence, "said": made.said}
        with self._session() as session:
            session.execute(self._upsert(_Assessed, row))

    def keep_refused(self, refused: tuple[Refusal, ...]) -> str:
        """Keep a list of logs that belong to no machine, and give its key."""
        key = fingerprint(refused)
        with self._session() as session:
            session.execute(self._upsert(_Refused, {"key": key, "content": pack(refused)}))
        return key

    def tell(self, machine: str, key: str, refused: str, *, beside: Sequence[str] = ()) -> None:
        """Make an assessment the present one of a machine, and forget others.

        Parameters
        ----------
        machine, key : str
            Which assessment.
        refused : str
            Key of the list of logs that belong to no machine.
        beside : sequence of str
            Keys of assessments of the machine that stay.
        """
        own = _id(machine)
        number = select(func.coalesce(func.max(_Reported.number), 0) + 1).scalar_subquery()
        said = select(literal(own), literal(key), number, _Assessed.said).where(
            _Assessed.machine == own, _Assessed.key == key
        )
        columns = ["machine", "key", "number", "content"]
        add = INSERT[self._engine.dialect.name](_Reported).from_select(columns, said)
        add = add.on_conflict_do_update(
            index_elements=["machine", "key"],
            set_={"number": add.excluded.number, "content": add.excluded.content},
        )
        row = {"machine": own, "name": machine, "key": key, "refused": refused}
        others = _Assessed.machine == own, _Assessed.key.not_in([key, *beside])
        with self._session() as session:
            session.execute(self._upsert(_Present, row))
            session.execute(add)
            session.execute(delete(_Assessed).where(*others))

    def earlier(self, machine: str, key: str) -> Reported | None:
        """Give what the newest assessment of a machine with another key said; None for none."""
        query = (
            select(_Reported.content)
            .where(_Reported.machine == _id(machine), _Reported.key != key)
            .order_by(_Reported.number.desc())
        )
        with self._session() as session:
            rows = session.scalars(query)
            said = (read(row, Reported) for row in rows)
            return next((one for one in said if one is not None), None)

    def told(self) -> tuple[Told, ...]:
        """List all machines with what was told of them last, in the order of their names.

        Raises
        ------
        StoreError
            If there is none.
        """
        with self._session() as session:
            rows = session.execute(select(_Present.name, _Present.key, _Present.refused)).all()
        if not rows:
            raise StoreError(
                f"the store {self._shown} holds no assessment; `lmshealth run LOGS --store URL` "
                "fills it"
            )
        return tuple(sorted((Told(*row) for row in rows), key=lambda told: told.machine))

    def refused(self, keys: Iterable[str]) -> tuple[Refusal, ...]:
        """Fetch lists of logs that belong to no machine; what two lists share is told once."""
        found: dict[Refusal, None] = {}
        for key in dict.fromkeys(keys):
            query = select(_Refused.content).where(_Refused.key == key)
            with self._session() as session:
                content = session.scalars(query).first()
            own = None if content is None else read(content, tuple[Refusal, ...])
            found |= dict.fromkeys(own or ())
        return tuple(found)

    def _column(self, column: Any, machine: str, key: str) -> bytes | None:
        query = select(column).where(_Assessed.machine == _id(machine), _Assessed.key == key)
        with self._session() as session:
            content: bytes | None = session.scalars(query).first()
        return content

    def _upsert(self, table: type[_Base], row: dict[str, Any]) -> Any:
        """Write a row, or write it anew: of two that do so at once the later one stays."""
        keys = [column.name for column in inspect(table).primary_key]
        insert = INSERT[self._engine.dialect.name](table).values(row)
        rest = {name: insert.excluded[name] for name in row if name not in keys}
        return insert.on_conflict_do_update(index_elements=keys, set_=rest)

    @contextmanager
    def _session(self) -> Iterator[Session]:
        try:
            with Session(self._engine) as session, session.begin():
                yield session
        except SQLAlchemyError as error:
            raise StoreError(
                f"the store {self._shown} failed: {why(error, self._address)}; what it has is "
                "kept, run again to go on"
            ) from None  # what led to it would show the row


def read(content: bytes, kind: Any) -> Any:
    """Rebuild what a store gave packed; None where this version cannot."""
    try:
        return unpack(content, kind)
    except ValueError as error:
        _logger.debug("%s", error)
        return None


def _id(machine: str) -> str:
    return hashlib.sha256(machine.encode("utf-8", "surrogatepass")).hexdigest()


def _renamed(refused: tuple[Refusal, ...], log: str) -> tuple[Refusal, ...]:
    return tuple(replace(refusal, log=log) for refusal in refused)
