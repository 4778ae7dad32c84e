"""What is shown of plans: numbers of logs, or what hinders."""

from __future__ import annotations

import pytest

from lmshealth.cli.planview import print_plans

NAN = float("nan")


def test_plans_are_one_table_each_and_say_why_there_is_none(
    capsys: pytest.CaptureFixture[str],
) -> None:
    """A number of logs or what hinders, dashes for what is not known, what stands for what."""
    asked = {
        "parameter": "p", "loss": 0.05, "power": 0.9, "false_alarm": 0.01, "n_baseline": 7,
        "seconds_for_one_log": 42,
    }  # fmt: skip
    row = {
        "parameter": "p", "loss": 0.05, "seconds_per_log": 60.0, "n_logs": 3, "hindrance": "",
        "power_of_one_log": 0.5, "smallest_loss_of_one_log": 0.04, "smallest_loss": 0.02,
    }  # fmt: skip
    short = row | {
        "seconds_per_log": 0.1, "n_logs": None, "hindrance": "too-short",
        "power_of_one_log": NAN, "smallest_loss_of_one_log": NAN, "smallest_loss": NAN,
    }  # fmt: skip
    weak = row | {"loss": 0.01, "n_logs": None, "hindrance": "baseline"}
    print_plans([asked, asked | {"loss": 0.01, "seconds_for_one_log": None}], [row, short, weak])
    shown = capsys.readouterr().out
    first, second = shown.split("p: to see a loss of 1.0 %")
    assert "loss of 5.0 % with power 0.9, false alarms 0.01" in first
    assert "loss, 7 logs" in first
    assert "60 3 50.0 % 4.0 % 2.0 %" in " ".join(first.split())
    assert "0.1 log too short – – –" in " ".join(first.split())
    assert "from 42 s on" in first
    assert "baseline too short" in second
    assert "No one log of an hour" in second
    assert "hidden" not in shown
    assert max(len(line) for line in shown.splitlines()) <= 80
