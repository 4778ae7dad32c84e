"""Standard streams that end no command: closed, full, or of an encoding without some characters."""

import codecs
import errno
import io
import os
import sys
import unicodedata
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any

import click

_ERRORS = "lmshealth-readable"
# What neither a decomposition nor the name of a character gives.
_ASCII = {"±": "+/-", "−": "-", "–": "-", "—": "-", "×": "x", "°": "deg", "→": "->", "─": "-",
          "µ": "u", "μ": "u", "∆": "delta", "∞": "inf", "≈": "~", "≤": "<=", "≥": ">="}  # fmt: skip


def readable(text: str) -> str:
    """Replace what standard output cannot encode by ASCII: +/- for ±, delta for Δ, else ?."""
    return text.encode(_charset(), _ERRORS).decode(_charset())


def is_unicode() -> bool:
    """Return whether standard output encodes all characters."""
    return codecs.lookup(_charset()).name.startswith("utf")


def _charset() -> str:
    return getattr(sys.stdout, "charset", None) or sys.stdout.encoding or "utf-8"


def lost() -> OSError | None:
    """Return why standard output takes no more, if it does not."""
    found: OSError | None = getattr(sys.stdout, "lost", None)
    return found


def _replace(error: UnicodeError) -> tuple[str, int]:
    assert isinstance(error, UnicodeEncodeError)
    return "".join(map(_spelled, error.object[error.start : error.end])), error.end


def _spelled(character: str) -> str:
    if character in _ASCII:
        return _ASCII[character]
    parts = unicodedata.normalize("NFKD", character).replace("\u2044", "/")
    name = unicodedata.name(character, "")
    if name.startswith("GREEK"):
        return name.rpartition("LETTER ")[2].partition(" ")[0].lower()
    return parts.encode("ascii", "ignore").decode() or "?" * (not unicodedata.combining(character))


codecs.register_error(_ERRORS, _replace)


class _Stream(io.TextIOWrapper):
    """Standard stream that goes on, and writes nowhere, once it cannot be written to."""

    lost: OSError | None = None

    def __init__(self, stream: io.TextIOWrapper) -> None:
        self._original = stream  # it closes the buffer when it is deleted
        with suppress(OSError):
            stream.flush()  # what was written before comes first
        self.charset = codecs.lookup(stream.encoding).name
        # click writes UTF-8 to whatever is ASCII.
        encoding = "latin-1" if self.charset == "ascii" else self.charset
        how: Any = {name: getattr(stream, name) for name in ("line_buffering", "write_through")}
        super().__init__(stream.buffer, encoding, _ERRORS, **how)

    def write(self, text: str) -> int:
        try:
            super().write(text.encode(self.charset, _ERRORS).decode(self.charset))
        except OSError as error:
            self._lose(error)
        return len(text)

    def flush(self) -> None:
        try:
            super().flush()
        except OSError as error:
            self._lose(error)

    def _lose(self, error: OSError) -> None:
        """Send what follows, and what is still in the buffer, nowhere."""
        self.lost = error
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, self.fileno())
        os.close(nowhere)


@contextmanager
def standard_streams() -> Iterator[None]:
    """Work with whatever standard streams the process has.

    Characters that a stream cannot encode are replaced, see `readable`. A closed stream is one
    that nobody reads. What cannot be written (a full disk, a closed pipe) is lost, the work is
    done, and the exit status is at least 1.
    """
    # Else the next file that is opened, such as the store, has the number of a standard stream.
    while (descriptor := os.open(os.devnull, os.O_RDWR)) <= 2:
        os.set_inheritable(descriptor, True)
    os.close(descriptor)
    was_closed = sys.stdout is None
    for number, name in enumerate(("stdout", "stderr"), 1):
        stream = getattr(sys, name) or os.fdopen(number, "w", encoding="utf-8", closefd=False)
        # Others are of a caller, who reads what was written.
        if getattr(sys, name) is getattr(sys, f"__{name}__"):
            setattr(sys, name, _Stream(stream))
    if was_closed:
        click.echo("note: standard output is closed: results are not printed", err=True)
    try:
        yield
    except SystemExit as end:
        sys.stdout.flush()
        error = lost()
        if error is None:
            raise
        if error.errno != errno.EPIPE:  # of `| head`, which has read what it needs
            why = f"standard output: {error.strerror}: what was to be printed is lost"
            click.echo(f"lmshealth: {why}; files are not concerned", err=True)
        sys.exit(end.code or 1)
