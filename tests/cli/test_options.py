"""Options that commands share: values are read or refused as wrong usage."""

from __future__ import annotations

import click
import pytest
from click.testing import CliRunner

from lmshealth.cli.options import DETECT, checked_band, examples


def test_a_band_has_its_ends_in_order() -> None:
    """None stays None, a band itself; anything else is wrong usage."""
    assert checked_band(None) is None
    assert checked_band((0.0, 10.0)) == (0.0, 10.0)
    for band in ((10.0, 10.0), (20.0, 10.0), (-1.0, 10.0)):
        with pytest.raises(click.BadParameter, match="LOW < HIGH"):
            checked_band(band)


def test_examples_are_one_per_line_and_not_wrapped() -> None:
    """The mark that keeps click from wrapping comes first."""
    assert examples("modes a", "modes b").splitlines() == [
        "\b", "Examples:", "    lmshealth modes a", "    lmshealth modes b",
    ]  # fmt: skip


@click.command()
@DETECT
def echo(detections: list[tuple[str, float]]) -> None:
    """Show what was read."""
    click.echo(repr(detections))


def test_losses_are_read_once_each() -> None:
    """Several of them, the same twice counts once."""
    arguments = [part for value in ("a=0.1", "b=5e-2", "a=0.1") for part in ("--detect", value)]
    assert CliRunner().invoke(echo, arguments).output.strip() == "[('a', 0.1), ('b', 0.05)]"


@pytest.mark.parametrize("value", ["a", "a=", "a=much", "a=b=0.1", "0.1"])
def test_what_is_no_name_and_number_is_wrong_usage(value: str) -> None:
    """The error contains the expected form and the input."""
    result = CliRunner().invoke(echo, ["--detect", value])
    assert result.exit_code == 2
    assert "NAME=LOSS" in result.output
