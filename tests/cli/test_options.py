"""Options that commands share: values are read or refused as wrong usage."""

from __future__ import annotations

import logging
from pathlib import Path

import click
import pytest
from click.testing import CliRunner, Result

from lmshealth.cli import options
from lmshealth.cli.main import main
from lmshealth.cli.stage_commands import plan


@options.command("modes a", "modes b")
@options.band_option("Band.")
def echo(**given: object) -> None:
    """Show what was read."""
    click.echo(repr(given))


def test_a_band_has_its_ends_in_order() -> None:
    """None stays None, a band itself; anything else is wrong usage."""
    run = CliRunner().invoke
    assert run(echo, []).output == "{'band': None}\n"
    assert run(echo, ["--band", "0", "10"]).output == "{'band': (0.0, 10.0)}\n"
    for band, why in (
        (("10", "10"), "needs LOW < HIGH"),
        (("20", "10"), "needs LOW < HIGH"),
        (("-1", "10"), "not in the range x>=0"),
    ):
        result = run(echo, ["--band", *band])
        assert result.exit_code == 2
        assert "Invalid value for" in result.output
        assert why in result.output


CONTEXT = click.Context(main)
NUMBERS = [
    (name, option)
    for name in main.list_commands(CONTEXT)
    for command in [main.get_command(CONTEXT, name)]
    if command is not None
    for option in command.params
    if isinstance(option.type, click.types.IntParamType | click.types.FloatParamType)
    and option.name != "band"  # two numbers, which are compared
]


@pytest.mark.parametrize(
    ("name", "option"), NUMBERS, ids=[f"{name} {option.opts[0]}" for name, option in NUMBERS]
)
def test_every_number_has_a_range(name: str, option: click.Option) -> None:
    """Huge, infinite and undefined numbers are wrong usage, whatever the option."""
    assert isinstance(option.type, click.IntRange | click.FloatRange)
    assert option.type.min is not None and option.type.max is not None
    whole = isinstance(option.type, click.IntRange)
    for value in (str(10**400), "-1", *(() if whole else ("1e300", "nan", "inf", "-inf"))):
        given = (value,) if option.multiple else value
        with pytest.raises(click.BadParameter, match=r"range|finite|not a valid"):
            option.type_cast_value(CONTEXT, given)


def test_a_day_is_in_the_calendar() -> None:
    """Days are from 1970 to 2099."""
    assert options.day("2027-03-01").year == 2027
    for wrong in ("1969-12-31", "2100-01-01", "9999-12-31", "0001-01-01"):
        with pytest.raises(click.BadParameter, match="is not a day from 1970-01-01 on"):
            options.day(wrong)


@pytest.mark.parametrize("band", [("nan", "10"), ("1", "inf"), ("-inf", "1")])
def test_a_band_is_finite_and_one(band: tuple[str, str]) -> None:
    """A second band is refused, unless it is the same."""
    run = CliRunner().invoke
    assert "is not a finite number" in run(echo, ["--band", *band]).output
    twice = run(echo, ["--band", "1", "10", "--band", "20", "30"])
    assert (twice.exit_code, "needed is one band" in twice.output) == (2, True)
    assert run(echo, 2 * ["--band", "1", "10"]).output == "{'band': (1.0, 10.0)}\n"


def test_examples_are_one_per_line_and_not_wrapped() -> None:
    """They end the help, as they were written."""
    lines = CliRunner().invoke(echo, ["--help"]).output.splitlines()
    assert lines[-3:] == ["  Examples:", "      lmshealth modes a", "      lmshealth modes b"]


def read_detect(*arguments: str) -> object:
    """Parse the arguments of `plan`."""
    context = plan.make_context("plan", ["--stage", "lms-y", *arguments])
    return context.params["detections"]


def test_losses_are_read_once_each() -> None:
    """Several of them, the same twice counts once."""
    arguments = [part for value in ("a=0.1", "b=5e-2", "a=0.1") for part in ("--detect", value)]
    assert read_detect(*arguments) == [("a", 0.1), ("b", 0.05)]


@pytest.mark.parametrize("value", ["a", "a=", "a=much", "a=b=0.1", "0.1"])
def test_what_is_no_name_and_number_is_wrong_usage(value: str) -> None:
    """The error contains the expected form and the input."""
    with pytest.raises(click.BadParameter, match=f"NAME=LOSS.*'{value}'"):
        read_detect("--detect", value)


def test_a_log_file_is_no_other_file_of_the_command(tmp_path: Path) -> None:
    """One that is read or written too is wrong usage, and stays as it is."""
    table, stage, out = (tmp_path / name for name in ("modes.csv", "my.toml", "track.csv"))
    for path in (table, stage):
        path.write_text("as it was")

    def track(log: Path, described: object = "lms-y") -> Result:
        words = ["track", table, "--stage", described, "--out", out, "--log-file", log]
        return CliRunner().invoke(main, [str(word) for word in words])

    for log, other in ((table, "the input"), (out, "--log-file"), (stage, "the input")):
        result = track(log, stage if log == stage else "lms-y")
        assert result.exit_code == 2
        assert f"is also {other}; needed is another file" in result.output
    # An error of the description ends the command before it knows its other files.
    words = ["track", "--stage", stage, "--log-file", table, "--out", out, table]
    assert CliRunner().invoke(main, [str(word) for word in words]).exit_code == 2
    assert table.read_text() == stage.read_text() == "as it was"
    assert not out.exists()


def test_a_log_file_has_the_error_that_ends_a_command(tmp_path: Path) -> None:
    """Whether it is of an option or of the work; nothing is logged after the program has ended."""
    log, table = tmp_path / "log.txt", tmp_path / "empty.csv"
    table.touch()
    for *words, name in (
        ("stage", "none.toml", "none.toml"),
        ("track", table, "--out", tmp_path / "track.csv", "empty.csv"),
    ):
        given = [*words, "--log-file", log]
        assert CliRunner().invoke(main, [str(word) for word in given]).exit_code == 1
        assert name in log.read_text().splitlines()[-1]
        assert logging.getLogger("lmshealth").handlers == []
