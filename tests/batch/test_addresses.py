"""Addresses: shown without their secrets, in whatever form they are written."""

from __future__ import annotations

import pytest

from lmshealth.batch.database import shown_address, without_secrets
from tests.security.guards import ADDRESSES

SECRET = "s3cr3t"


@pytest.mark.parametrize(
    ("address", "shown"),
    [
        ("postgresql://me:s3cr3t@host:5432/fleet?sslmode=s3cr3t", "postgresql://host:5432/fleet"),
        ("postgresql+psycopg://me@[::1]/fleet", "postgresql+psycopg://[::1]/fleet"),
        ("sqlite:////home/me@corp/a b.sqlite", "sqlite:////home/me@corp/a b.sqlite"),
        ("sqlite://", "sqlite://"),
        ("tcp://host:8786", "tcp://host:8786"),
        ("no url at all", "no url at all"),
        ("postgresql://me:s3/cr3t@host/fleet", "that was given"),
    ],
)
def test_an_address_is_shown_by_kind_and_place(address: str, shown: str) -> None:
    """User, password and options are left out; where they cannot be separated, all is."""
    assert shown_address(address) == shown


@pytest.mark.parametrize("form", ADDRESSES)
def test_no_part_of_a_password_is_shown(form: str) -> None:
    """Neither the address nor what a library quotes of it, whole or in part, shows the password."""
    address = form.format(*[SECRET] * 2)
    parts = {address, *(part for sign in "/@:?=&" for part in address.split(sign))}
    for quoted in [part for part in parts if SECRET in part]:
        assert SECRET not in without_secrets(f"cannot use {quoted!r}", address)
    assert SECRET not in shown_address(address)


def test_a_reason_without_secrets_is_unchanged() -> None:
    """What helps to mend an address stays."""
    why = "connection to server at 127.0.0.1 failed: Connection refused"
    assert without_secrets(why, "postgresql://me:s3cr3t@127.0.0.1/db?connect_timeout=1") == why


def test_an_encoded_password_is_hidden_in_both_writings() -> None:
    """Libraries quote it as it is written, or as it is meant."""
    shown = without_secrets("a%2Fb or a/b", "postgresql://me:a%2Fb@host/db")
    assert shown == "*** or ***"


@pytest.mark.parametrize("user", ["me", "me@corp"])
@pytest.mark.parametrize("password", ["123/geheim", "1/2", "5432/x@y"])
def test_a_password_is_not_taken_for_a_port(user: str, password: str) -> None:
    """Digits and a slash before the host are no place that could be shown."""
    address = f"postgresql://{user}:{password}@127.0.0.1:1/fleet"
    assert password not in shown_address(address)
    assert password not in without_secrets(f"cannot use {address}", address)
