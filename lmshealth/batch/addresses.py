"""Addresses of stores, schedulers and messengers, whose secrets no message quotes."""

import os
import re
import sys
from urllib.parse import parse_qsl, unquote

import msgspec

from lmshealth.batch import constants

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


def notify() -> None:
    """Send the changes on standard input by apprise, in a process that `run_command` bounds.

    The addresses hold passwords: no message quotes them.
    """
    import apprise  # an extra

    changes = msgspec.json.decode(sys.stdin.buffer.read())["changes"]
    messenger, addresses = apprise.Apprise(), os.environ.get(constants.NOTIFY, "").split()
    # All are tried, so that each is named.
    if not all([messenger.add(address) for address in addresses]):  # noqa: C419
        sys.exit(f"apprise does not know an address in {constants.NOTIFY}")
    body = "\n".join(f"{change['text']} ({change['severity']})" for change in changes)
    if not messenger.notify(title=f"lmshealth: {len(changes)} changes", body=body):
        sys.exit(f"apprise could not deliver to every address in {constants.NOTIFY}")
