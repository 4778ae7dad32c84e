"""Databases behind the store: SQLite and PostgreSQL, by their SQLAlchemy URLs."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import Any
from urllib.parse import quote

from sqlalchemy import MetaData, create_engine, event, inspect
from sqlalchemy.dialects import postgresql, sqlite
from sqlalchemy.engine import URL, Engine, make_url
from sqlalchemy.exc import SQLAlchemyError
from sqlalchemy.schema import CreateIndex, CreateTable

from lmshealth.batch.addresses import shown_address, without_secrets
from lmshealth.errors import LmshealthError

INSERT: dict[str, Any] = {"sqlite": sqlite.insert, "postgresql": postgresql.insert}
"""By database, the statement that writes a row which may be there already."""

# Seconds that a writer waits while others write to the same file.
_PATIENCE = 120
# Seconds that a server has to answer; its URL may say another number.
_ANSWER = 20


class StoreError(LmshealthError):
    """A store that cannot be opened, read or written."""


def connect(url: str | URL, metadata: MetaData, *, create: bool) -> tuple[Engine, str]:
    """Open a database, and give its URL as text.

    Parameters
    ----------
    url : str or URL
        Such as ``sqlite:///results.sqlite`` or ``postgresql://me@host/fleet``.
    metadata : MetaData
        Its tables.
    create : bool
        Whether to make it, or its tables, where they are not there.

    Raises
    ------
    StoreError
        If it cannot be opened, or is not there and not to be made.
    """
    address = url if isinstance(url, str) else url.render_as_string(False)
    shown = shown_address(address)
    if "://" not in address:
        raise StoreError(
            "cannot open the store: what was given is no URL; a file is sqlite:///PATH, a database "
            "postgresql://user@host/name"
        )
    engine: Engine | None = None
    try:
        parsed = _understood(url)
        engine = _engine(parsed) if create else _engine(_as_it_is(parsed), shared=False)
        if create:
            _make_tables(engine, metadata)
        with engine.connect():
            return engine, address
    except (SQLAlchemyError, ImportError, TypeError, ValueError) as error:
        if engine is not None:
            engine.dispose()
        # What led to it would be shown with it, and quotes passwords.
        raise StoreError(f"cannot open the store {shown}: {why(error, address)}") from None


def _understood(url: str | URL) -> URL:
    """Read a URL; PostgreSQL goes by the driver that the extra installs."""
    parsed = make_url(url)
    kind = parsed.get_backend_name()
    if kind not in INSERT:
        raise ValueError(f"{kind} is not among what is understood: {' and '.join(INSERT)}")
    plain = parsed.drivername == "postgresql"
    return parsed.set(drivername="postgresql+psycopg") if plain else parsed


def _engine(url: URL, *, shared: bool = True) -> Engine:
    if url.get_backend_name() != "sqlite":
        wait = {} if "connect_timeout" in url.query else {"connect_timeout": _ANSWER}
        return create_engine(url, pool_pre_ping=True, connect_args=wait)
    folder = Path(url.database or "").parent
    if not (url.database or "").startswith("file:") and not folder.is_dir():
        raise ValueError(f"there is no folder {folder}")
    engine = create_engine(url, connect_args={"timeout": _PATIENCE})

    @event.listens_for(engine, "connect")
    def _set_up(connection: Any, _: Any) -> None:
        # Readers and a writer at a time, and no wait for the disk at every log: what a crash of the
        # computer itself takes is done again.
        with suppress(Exception):  # another one may be about it, or the file be no database at all
            if shared:
                connection.execute("PRAGMA journal_mode = WAL")
        connection.execute("PRAGMA synchronous = NORMAL")

    return engine


def _make_tables(engine: Engine, metadata: MetaData) -> None:
    """Make the tables that are not there; another run may be about the same."""
    for attempt in range(3):  # PostgreSQL may fail where two make the same table at once
        try:
            with engine.begin() as connection:
                known = set(inspect(connection).get_table_names())
                for table in metadata.sorted_tables:
                    if table.name not in known:
                        connection.execute(CreateTable(table, if_not_exists=True))
                        for index in table.indexes:
                            connection.execute(CreateIndex(index, if_not_exists=True))
            return
        except SQLAlchemyError:
            if attempt == 2:
                raise


def _as_it_is(url: URL) -> URL:
    """Ask SQLite not to make a file that is not there."""
    name = url.database or ":memory:"
    if url.get_backend_name() != "sqlite" or name == ":memory:":
        return url
    if not name.startswith("file:") and not Path(name).exists():
        raise ValueError("there is no such file; `lmshealth run LOGS --store URL` makes it")
    path = name if name.startswith("file:") else f"file:{quote(name)}"
    return url.set(database=path).update_query_dict({"mode": "rw", "uri": "true"})


def why(error: Exception, address: str) -> str:
    """Say in one line what went wrong, without SQLAlchemy's statements, and without secrets."""
    text = str(getattr(error, "orig", None) or error).strip()
    first = text.splitlines()[0] if text else type(error).__name__
    return without_secrets(first, address)
