"""Detection of changed files, executed SQL, control characters, and active markup."""

from __future__ import annotations

import hashlib
import os
import re
import zlib
from collections.abc import Iterable, Mapping, Sequence
from html.parser import HTMLParser
from pathlib import Path

from sqlalchemy import create_engine, inspect, text

# Ways to write a password into an address; some of them are no addresses at all.
ADDRESSES = (
    "postgresql+psycopg://u:{}@127.0.0.1:1/db",
    "postgresql://u:{}@127.0.0.1:1/db?connect_timeout=1",
    "postgresql://u:a/{}@127.0.0.1:1/db",
    "postgresql://u:a@{}@127.0.0.1:1/db",
    "postgresql://u:a?{}@127.0.0.1:1/db",
    "postgresql://u:a#{}@127.0.0.1:1/db",
    "postgresql://u@127.0.0.1:{}/db",
    "postgresql://u:%2F{}@127.0.0.1:1/db",
    "postgresql://127.0.0.1:1/db?password={}",
    "postgresql://127.0.0.1:1/db?sslpassword={}&bogus={}",
    "sqlite:////nowhere/store.sqlite?timeout={}",
    "mysql://u:{}@127.0.0.1/db",
    "u:{}@127.0.0.1/db",
    "host=127.0.0.1 password={}",
)

_CANARY = [(1, "sings"), (2, "sings too")]
# Signs that a terminal acts on or that turn the direction of writing; line ends and tabs are not.
_ACTING = re.compile(
    "[\x00-\x08\x0b\x0c\x0e-\x1f\x7f-\x9f\u200b-\u200f\u2028-\u202e\u2060-\u206f\ufeff]"
)
_DEVICE = re.compile(r"(con|prn|aux|nul|com\d|lpt\d)(\..*)?", re.IGNORECASE)


def snapshot(folder: Path, without: Iterable[Path] = ()) -> dict[str, str]:
    """Describe everything below a folder: kinds, targets of links, and hashes of contents."""
    left_out = [os.fsencode(path) for path in without]
    found = {}
    for parent, folders, files in os.walk(os.fsencode(folder)):
        folders[:] = [name for name in folders if os.path.join(parent, name) not in left_out]
        for name in (*folders, *files):
            path = os.path.join(parent, name)
            if os.path.islink(path):
                state = f"link to {os.readlink(path)!r}"
            elif os.path.isfile(path):
                with open(path, "rb") as stream:
                    state = hashlib.file_digest(stream, "sha256").hexdigest()
            else:
                state = f"mode {os.stat(path).st_mode:o}"
            found[repr(path)] = state
    return found


def differences(before: Mapping[str, str], after: Mapping[str, str]) -> list[str]:
    """Name what is new, gone or different."""
    return sorted(path for path in {*before, *after} if before.get(path) != after.get(path))


def plant(url: str) -> None:
    """Put a table into a database that nothing may touch."""
    engine = create_engine(url)
    with engine.begin() as connection:
        connection.execute(text("CREATE TABLE canary (id INTEGER PRIMARY KEY, said TEXT)"))
        for number, said in _CANARY:
            row = {"number": number, "said": said}
            connection.execute(text("INSERT INTO canary VALUES (:number, :said)"), row)
    engine.dispose()


def touched(url: str) -> list[str]:
    """Return what happened to the planted table, and unexpected tables."""
    engine = create_engine(url)
    with engine.connect() as connection:
        names = inspect(connection).get_table_names()
        strange = [n for n in names if not re.fullmatch(r"canary|[a-z]+_\d+", n)]
        if "canary" not in names:
            return ["the table is gone", *strange]
        rows = connection.execute(text("SELECT id, said FROM canary ORDER BY id")).all()
    engine.dispose()
    return strange + ([] if [tuple(row) for row in rows] == _CANARY else ["its rows differ"])


def everything_in(url: str) -> bytes:
    """Read all that a database holds, unpacked where it is packed."""
    engine = create_engine(url)
    found = b""
    with engine.connect() as connection:
        for name in inspect(connection).get_table_names():
            for row in connection.execute(text(f'SELECT * FROM "{name}"')):
                for cell in row:
                    whole = bytes(cell) if isinstance(cell, bytes | memoryview) else b""
                    found += whole or str(cell).encode("utf-8", "replace")
                    try:
                        found += zlib.decompress(whole)
                    except zlib.error:
                        continue
    engine.dispose()
    return found


def acting(content: str) -> list[str]:
    """List signs that a terminal or an editor acts on instead of showing them."""
    return sorted({ascii(sign) for sign in _ACTING.findall(content)})


def bad_names(names: Sequence[str]) -> list[str]:
    """List names of files that some system takes for something else, or for each other."""
    folded = [name.casefold() for name in names]
    return [
        name
        for name in names
        if not re.fullmatch(r"[\w.-]+", name)
        or _DEVICE.fullmatch(name)
        or name.rstrip(". ") != name
        or len(name.encode()) > 255
        or folded.count(name.casefold()) > 1
    ]


class _Page(HTMLParser):
    """Notes what a page runs and loads."""

    def __init__(self) -> None:
        super().__init__(convert_charrefs=True)
        self.found: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag in ("iframe", "object", "embed", "base", "form", "img", "audio", "video"):
            self.found.append(tag)
        for name, value in attrs:
            given = (value or "").strip()
            if name.startswith("on"):
                self.found.append(f"{tag} {name}")
            loads = name in ("src", "href", "xlink:href", "action", "data", "srcset")
            if loads and not re.match(r"#|data:image/|[\w.%-]+\.html(#|$)", given):
                self.found.append(f"{tag} {name}={given[:60]}")
            if name == "style" and "url(" in given:
                self.found.append(f"{tag} style={given[:60]}")

    def handle_data(self, data: str) -> None:
        if self.lasttag == "style" and re.search(r"url\((?!['\"]?(#|data:))|@import", data):
            self.found.append("style loads something")


def loaded(page: str) -> list[str]:
    """List what a page loads, and what in it runs but its own scripts."""
    reader = _Page()
    reader.feed(page)
    return sorted(set(reader.found))


def scripts(page: str) -> list[str]:
    """Return the scripts of a page."""
    return re.findall(r"<script.*?</script>", page, re.DOTALL | re.IGNORECASE)
