"""Addresses of stores and schedulers, told without what is secret in them."""

from __future__ import annotations

import re
from urllib.parse import parse_qsl, unquote

# A password with signs of an address in it may be taken for a host or a port by whoever reads it:
# such an address is not of this form.
_FORM = re.compile(
    r"(?P<kind>[\w+.-]+)://"
    r"(?:[^:@/?#]*(?::(?P<password>[^:@/?#]*))?@)?"
    # Only the path of a file, after no host, may hold an @: elsewhere it ends a password.
    r"(?P<place>(?:\[[\da-fA-F:]*\]|[\w.-]*)(?::\d+)?(?:(?<=://)/[^?]*|/[^?@]*)?)"
    r"(?:\?(?P<options>.*))?",
    re.DOTALL,
)
# Nobody writes a password without any sign of an address or an option.
_PLAIN = re.compile(r"[\w .-]*")
_SHORT = 3


def shown_address(address: str) -> str:
    """Write an address without user, password and options."""
    found = _FORM.fullmatch(address)
    if found is None:
        return address if _PLAIN.fullmatch(address) else "that was given"
    return f"{found['kind']}://{found['place']}"


def without_secrets(text: str, address: str) -> str:
    """Write what a library says of an address without the secrets that it may quote.

    Parameters
    ----------
    text : str
        An error's words.
    address : str
        What it is about.

    Returns
    -------
    str
        With ``***`` for password and values of options; where it is not clear what of the address
        is the password, nothing of the text but what to do.
    """
    found = _FORM.fullmatch(address)
    if found is None:
        if _PLAIN.fullmatch(address):
            return text
        return (
            "needed is an address such as postgresql://user:password@host/database, with special "
            "signs of a password written as numbers, @ as %40; the reason may hold the password "
            "and is not shown"
        )
    options = found["options"] or ""
    values = [value for _, value in parse_qsl(options)]
    values += [part.partition("=")[2] for part in options.split("&")]
    # Shorter ones are numbers and switches, which stand everywhere.
    pieces = [value for value in values if len(value) > _SHORT]
    pieces += [found["password"] or "", unquote(found["password"] or "")]
    for piece in sorted(set(pieces) - {""}, key=len, reverse=True):
        text = text.replace(piece, "***")
    return text
