"""What has been done already, so that a run can go on and a report needs no logs.

Results are named by fingerprints of everything they depend on: a change of anything is another
name, so that what is stale is done again and nothing else is. A row that this version cannot read
counts as absent.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from urllib.parse import quote

from sqlalchemy import LargeBinary, String, Text, create_engine, delete, inspect, select, update
from sqlalchemy.engine import URL, make_url
from sqlalchemy.exc import ArgumentError, SQLAlchemyError
from sqlalchemy.orm import DeclarativeBase, Mapped, Session, mapped_column

from lmshealth.changes import Reported, reported
from lmshealth.errors import LmshealthError
from lmshealth.history import Reading
from lmshealth.logs import Refusal
from lmshealth.packing import pack, unpack
from lmshealth.summary import Assessment

SCHEMA = 3  # part of the names of the tables: what an older one holds is not read

Outcome = Reading | tuple[Refusal, ...]
"""What became of a log: its reading, or why it was refused."""

_logger = logging.getLogger(__name__)


class StoreError(LmshealthError):
    """A store that cannot be opened, read or written."""


class _Base(DeclarativeBase):
    pass


class _Identified(_Base):
    __tablename__ = f"identified_{SCHEMA}"

    key: Mapped[str] = mapped_column(String(64), primary_key=True)
    content: Mapped[bytes] = mapped_column(LargeBinary)


class _Assessed(_Base):
    """The present assessment of each machine: earlier ones would be megabytes each.

    Beside it stands what the run that reported it last refused of logs that belong to no machine.
    """

    __tablename__ = f"assessed_{SCHEMA}"

    machine: Mapped[str] = mapped_column(Text, primary_key=True)
    key: Mapped[str] = mapped_column(String(64))
    content: Mapped[bytes] = mapped_column(LargeBinary)
    refused: Mapped[bytes] = mapped_column(LargeBinary)


class _Reported(_Base):
    """What all assessments said, the present ones too, in the order in which they were made."""

    __tablename__ = f"reported_{SCHEMA}"

    number: Mapped[int] = mapped_column(primary_key=True)
    machine: Mapped[str] = mapped_column(Text, index=True)
    key: Mapped[str] = mapped_column(String(64))
    content: Mapped[bytes] = mapped_column(LargeBinary)


@dataclass(frozen=True, slots=True, eq=False)
class Fleet:
    """All that a report is written from.

    Attributes
    ----------
    assessments : tuple of Assessment
        The present one of every machine.
    refused : tuple of Refusal
        Logs that belong to no machine.
    earlier : dict of str to Reported
        By machine, what the report before the present one said.
    unread : tuple of str
        Machines whose assessment this version cannot read.
    """

    assessments: tuple[Assessment, ...]
    refused: tuple[Refusal, ...]
    earlier: dict[str, Reported]
    unread: tuple[str, ...] = ()


def beside(folder: Path) -> URL:
    """URL of the default store: a SQLite file in the folder of the output, whatever its name."""
    return URL.create("sqlite", database=str(folder / "lmshealth.sqlite"))


class Store:
    """Results behind an SQLAlchemy URL.

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
        try:
            parsed = make_url(url)
            self._shown = parsed.render_as_string(hide_password=True)
            self._engine = create_engine(parsed if create else _as_it_is(parsed))
            if create:
                _Base.metadata.create_all(self._engine)
            tables = inspect(self._engine).get_table_names()
        except (ArgumentError, SQLAlchemyError, ImportError, ValueError) as error:
            # The URL may hold a password, before the host or among its options.
            shown = re.sub(r"//[^/]*@", "//", str(url)).split("?")[0]
            detail = _why(error).replace(str(url), shown)
            raise StoreError(f"cannot open the store {shown}: {detail}") from error
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

    def get(self, key: str, log: str) -> Outcome | None:
        """Fetch the outcome of a log under its present name; None when it is not there."""
        query = select(_Identified.content).where(_Identified.key == key)
        outcome: Outcome | None = self._read(query, Outcome)
        if isinstance(outcome, Reading):
            modes = replace(outcome.modes, refused=_renamed(outcome.modes.refused, log))
            return replace(outcome, log=log, modes=modes)
        return None if outcome is None else _renamed(outcome, log)

    def put(self, key: str, outcome: Outcome) -> Outcome:
        """Keep the outcome of a log, and give back what `get` will give."""
        content = pack(outcome)
        with self._session() as session:
            session.merge(_Identified(key=key, content=content))
        kept: Outcome = unpack(content, Outcome)
        return kept

    def recall(self, machine: str, key: str) -> Assessment | None:
        """Fetch the present assessment of a machine; None when it is not the one of that key."""
        query = select(_Assessed.content).where(_Assessed.machine == machine, _Assessed.key == key)
        assessment: Assessment | None = self._read(query, Assessment)
        return assessment

    def keep(self, machine: str, key: str, assessment: Assessment) -> Assessment:
        """Make an assessment the present one, and give back what `recall` will give.

        Pages made from what comes back are those that are made from the store later: sums over an
        array in another order in memory may differ in their last digit.
        """
        content = pack(assessment)
        again = _Reported.machine == machine, _Reported.key == key
        with self._session() as session:
            session.merge(_Assessed(machine=machine, key=key, content=content, refused=pack(())))
            session.execute(delete(_Reported).where(*again))
            said = pack(reported(assessment))
            session.add(_Reported(machine=machine, key=key, content=said))
        kept: Assessment = unpack(content, Assessment)
        return kept

    def keep_refused(self, machines: Iterable[str], refused: tuple[Refusal, ...]) -> None:
        """Keep which logs of no machine were refused by the run that reported these machines."""
        query = update(_Assessed).where(_Assessed.machine.in_(list(machines)))
        with self._session() as session:
            session.execute(query.values(refused=pack(refused)))

    def earlier(self, machine: str, key: str) -> Reported | None:
        """Give what the newest assessment of a machine with another key said; None for none."""
        query = (
            select(_Reported.content)
            .where(_Reported.machine == machine, _Reported.key != key)
            .order_by(_Reported.number.desc())
        )
        said: Reported | None = self._read(query, Reported)
        return said

    def fleet(self) -> Fleet:
        """Fetch everything that a report is written from.

        Raises
        ------
        StoreError
            If there is no assessment that this version can read.
        """
        query = select(_Assessed.machine, _Assessed.key, _Assessed.refused)
        with self._session() as session:
            rows = session.execute(query.order_by(_Assessed.machine)).all()
        keys = {machine: key for machine, key, _ in rows}
        # Machines of one run have the same: it is listed once.
        refused = dict.fromkeys(row.refused for row in rows)
        found = {machine: self.recall(machine, key) for machine, key in keys.items()}
        assessments = tuple(one for one in found.values() if one is not None)
        if not assessments:
            state = "no assessment" if not found else "only what another version of lmshealth kept"
            raise StoreError(
                f"the store {self._shown} holds {state}; `lmshealth run LOGS --store URL` fills it"
            )
        before = {machine: self.earlier(machine, keys[machine]) for machine in found}
        return Fleet(
            assessments=assessments,
            refused=tuple(r for own in refused for r in _read(own, tuple[Refusal, ...]) or ()),
            earlier={machine: said for machine, said in before.items() if said is not None},
            unread=tuple(machine for machine, one in found.items() if one is None),
        )

    def _read(self, query: Any, kind: Any) -> Any:
        """Give the first row of one column that can be read, else None."""
        with self._session() as session:
            rows = session.scalars(query)
            return next((one for row in rows if (one := _read(row, kind)) is not None), None)

    @contextmanager
    def _session(self) -> Iterator[Session]:
        try:
            with Session(self._engine) as session, session.begin():
                yield session
        except SQLAlchemyError as error:
            raise StoreError(f"the store {self._shown} failed: {_why(error)}") from error


def _as_it_is(url: URL) -> URL:
    """Ask SQLite not to make a file that is not there."""
    name = url.database or ":memory:"
    if url.get_backend_name() != "sqlite" or name == ":memory:":
        return url
    if not name.startswith("file:") and not Path(name).exists():
        raise ValueError("there is no such file; `lmshealth run LOGS --store URL` makes it")
    path = name if name.startswith("file:") else f"file:{quote(name)}"
    return url.set(database=path).update_query_dict({"mode": "rw", "uri": "true"})


def _why(error: Exception) -> str:
    """Say in one line what went wrong, without SQLAlchemy's statements and addresses."""
    text = str(getattr(error, "orig", None) or error).strip()
    return text.splitlines()[0] if text else type(error).__name__


def _read(content: bytes, kind: Any) -> Any:
    try:
        return unpack(content, kind)
    except ValueError as error:
        _logger.debug("%s", error)
        return None


def _renamed(refused: tuple[Refusal, ...], log: str) -> tuple[Refusal, ...]:
    return tuple(replace(refusal, log=log) for refusal in refused)
