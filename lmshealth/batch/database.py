"""Databases of a store: tables, connections (SQLite, PostgreSQL), and what to do about faults.

No message quotes the secrets of an address.
"""

import logging
import os
import re
import socket
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from threading import Event, Timer
from typing import Any
from urllib.parse import parse_qsl, quote, unquote

import sqlalchemy as sql
from sqlalchemy.dialects import postgresql, sqlite
from sqlalchemy.engine import URL, Engine, make_url
from sqlalchemy.exc import SQLAlchemyError
from sqlalchemy.schema import CreateTable

from lmshealth.batch import constants
from lmshealth.errors import LmshealthError

# A run that is interrupted while a connection returns to its pool would print a traceback.
logging.getLogger("sqlalchemy").addHandler(logging.NullHandler())

INSERT: dict[str, Any] = {"sqlite": sqlite.insert, "postgresql": postgresql.insert}
"""Insert statements that know of conflicts, by the kind of database."""


class StoreError(LmshealthError):
    """A store that cannot be opened, read or written."""


# Tables


class _Bytes(sql.LargeBinary):
    """Bytes as the database returns them: a damaged row of SQLite may hold a number or a text."""

    def result_processor(self, dialect: Any, coltype: Any) -> None:
        """Convert nothing: `Store` checks what it reads."""


_DIGEST = sql.String(64)
VALUES = sql.Table(
    f"values_{constants.SCHEMA}",
    sql.MetaData(),
    *(sql.Column(name, _DIGEST, primary_key=True) for name in ("kind", "owner", "key")),
    sql.Column("name", sql.Text, nullable=False),
    sql.Column("content", _Bytes, nullable=False),
)
"""All values that runs read, by their kind, the machine that they are of, and the fingerprint of
what they depend on. The owner is a digest, because the name of a machine may be longer than an
index allows; the name is for people."""


def is_older(tables: Iterable[str]) -> bool:
    """Return whether tables are those of another format of the store."""
    return any(re.fullmatch(r"(identified|assessed|values)_\d+", one) for one in tables)


# Connections


def connect(url: str | URL, *, create: bool) -> tuple[Engine, str, bool]:
    """Open a database; return its engine, its URL as text, and whether an older store is in it."""
    address = url if isinstance(url, str) else url.render_as_string(False)
    if "://" not in address:
        needed = "a file is sqlite:///PATH, a database postgresql://user@host/name"
        raise StoreError(f"cannot open the store: the given address is no URL; {needed}")
    engine: Engine | None = None
    try:
        engine = _engine(make_url(url), create=create)
        is_made_anew = create and _create_table(engine)
        with engine.connect():
            return engine, address, is_made_anew
    except (SQLAlchemyError, ImportError, TypeError, ValueError) as error:
        if engine is not None:
            engine.dispose()
        step = next_step(error, address)
        why = reason(error, address) + (f"; {step}" if step else "")
        # The cause would be printed with it, and quotes passwords.
        raise StoreError(f"cannot open the store {shown_address(address)}: {why}") from None


def _engine(url: URL, *, create: bool) -> Engine:
    """Make the engine of a database; without ``create`` SQLite must not create the file."""
    kind = url.get_backend_name()
    if kind not in INSERT:
        raise ValueError(f"{kind} is not supported: use {' or '.join(INSERT)}")
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
            late, number = Event(), self.fileno()

            def hang_up() -> None:
                """Close both directions of the socket, which whoever waits for it notices."""
                late.set()
                connection = socket.socket(fileno=number)
                with suppress(OSError):
                    connection.shutdown(socket.SHUT_RDWR)
                connection.detach()

            timer = Timer(constants.ANSWER_TIMEOUT_S, hang_up)
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


def _create_table(engine: Engine) -> bool:
    """Create the table if it is missing; another run may do so at the same time.

    Return whether there were tables of an older store, and none of this one.
    """
    attempts = 3  # PostgreSQL may fail where two runs create it
    for attempt in range(attempts):
        try:
            with engine.begin() as connection:
                existing = set(sql.inspect(connection).get_table_names())
                if VALUES.name not in existing:
                    connection.execute(CreateTable(VALUES, if_not_exists=True))
            return VALUES.name not in existing and is_older(existing)
        except SQLAlchemyError:
            if attempt == attempts - 1:
                raise
    raise AssertionError  # the last attempt returns or raises


# SQLite (beginning of its codes): faults of the computer, another process or its rights.
_PASSING = ("FULL", "BUSY", "LOCKED", "IOERR", "NOMEM", "INTERRUPT", "PROTOCOL", "PERM", "AUTH")
_COST = (
    "the next run then identifies all logs and assesses all machines again; comparisons with "
    "earlier reports and alerts that were not sent are lost"
)


def next_step(error: Exception, address: str) -> str:
    """Return what to do about a missing driver, or a damaged or read-only file, else nothing."""
    if isinstance(error, ImportError):
        return 'a PostgreSQL store needs an extra: pip install "lmshealth[postgres]"'
    if (origin := getattr(error, "orig", None)) is None:
        return ""
    file = make_url(address).database
    code = getattr(origin, "sqlite_errorname", "").removeprefix("SQLITE_")
    if str(getattr(origin, "sqlstate", "")) in ("XX001", "XX002"):  # damaged data, damaged index
        tables = f"the table {VALUES.name} of lmshealth"
        return f"restore the database from a backup, or drop {tables} in it: {_COST}"
    if code.startswith(("READONLY", "CANTOPEN")):
        return f"copy {file} and {file}-wal, where there is one, to a folder that can be written to"
    if code == "NOTADB":
        return f"give another file by --store; if it was a store, delete it: {_COST}"
    if code and not code.startswith(_PASSING):
        return f"it is damaged: delete {file}, and {file}-wal and -shm where they are: {_COST}"
    return ""


def reason(error: Exception, address: str) -> str:
    """Return an error in one line, without statements of SQL and without secrets."""
    text = str(getattr(error, "orig", None) or error).strip()
    first = text.splitlines()[0] if text else type(error).__name__
    return without_secrets(first, address)


# Addresses

# A password that contains characters with a meaning in URLs could be read as a host or a port: such
# an address does not match.
_URL = re.compile(
    r"(?P<kind>[\w+.-]+)://"
    r"(?:[^:@/?#]*(?::(?P<password>[^:@/?#]*))?@)?"
    # Only the path of a file, after no host, may contain an @: elsewhere it ends a password.
    r"(?P<place>(?:\[[\da-fA-F:]*\]|[\w.-]*)(?::\d+)?(?:(?<=://)/[^?]*|/[^?@]*)?)"
    r"(?:\?(?P<options>.*))?",
    re.DOTALL,
)
# Without any character of an address or option there is no password.
_NO_URL = re.compile(r"[\w .-]*")


def shown_address(address: str) -> str:
    """Return an address without user, password and options."""
    found = _URL.fullmatch(address)
    if found is None:
        return address if _NO_URL.fullmatch(address) else "that was given"
    return f"{found['kind']}://{found['place']}"


def without_secrets(text: str, address: str) -> str:
    """Mask the password and the values of options of an address in an error message about it.

    Where the password cannot be separated from the rest of the address, only what to do is
    returned.
    """
    found = _URL.fullmatch(address)
    if found is None:
        if _NO_URL.fullmatch(address):
            return text
        return (
            "needed is an address such as postgresql://user:password@host/database, with special "
            "characters of a password percent-encoded, @ as %40; the reason may contain the "
            "password and is not shown"
        )
    options = found["options"] or ""
    values = [value for _, value in parse_qsl(options)]
    values += [part.partition("=")[2] for part in options.split("&")]
    secrets = [value for value in values if len(value) >= constants.SHORTEST_SECRET]
    secrets += [found["password"] or "", unquote(found["password"] or "")]
    for secret in sorted(set(secrets) - {""}, key=len, reverse=True):
        text = text.replace(secret, "***")
    return text
