"""The command prognose: tables, output and refusals."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import xarray
from click.testing import CliRunner, Result

from lmshealth._private.tables import TABLES
from lmshealth.cli import machine_commands
from lmshealth.cli.main import main
from lmshealth.life.posterior.fit import fit_life
from lmshealth.life.prognosis import Prognosis
from lmshealth.report.text import km, plain
from lmshealth.stage.description import Stage
from lmshealth.tracking.history import History
from tests.lives import (
    FADING,
    FREQUENCY,
    MOUNT,
    START,
    TEMPERATURE,
    make_prognosis,
    make_stage,
    true_drift,
)

TAIL = TEMPERATURE + "[usage]\nhorizon_km = 5000\n[decision]\nnext_service = 2026-06-01\n"
LIMIT_KM = 0.4 / 1.5e-4 + 100 - 1200  # where AX-1 is at its limit, from its last log


@pytest.fixture
def toml(tmp_path: Path) -> Path:
    """Write the description of a preload that fades."""
    make_stage(tmp_path / "stage", (FADING,), tail=TAIL)
    return tmp_path / "stage" / "small.toml"


@pytest.fixture
def table(tmp_path: Path) -> Path:
    """Write estimates of a machine that wears and of one that does not."""
    rng = np.random.default_rng(4)
    rows = []
    for stage, rate in (("AX-1", 1.5e-4), ("AX-2", 0.0)):
        for k in range(12):
            left = 1 - rate * 100 * k
            drift = true_drift(("guide_preload",), np.log([left]))
            for j, mode in enumerate(("roll", "pitch")):
                f = FREQUENCY[j] * np.exp(drift[j] + 1e-3 * rng.standard_normal())
                rows.append(
                    {
                        "stage": stage,
                        "log": f"{stage}-{k:02d}",
                        "recorded_at": f"2026-03-{2 * k + 1:02d}T06:00:00+00:00",
                        "travel_km": 100.0 * (k + 1),
                        "temperature_c": 21.0,
                        "mode": mode,
                        "source": "acc",
                        "frequency_hz": f,
                        "frequency_std_hz": 1e-3 * f,
                    }
                )
    path = tmp_path / "modes.csv"
    pd.DataFrame(rows).to_csv(path, index=False)
    return path


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Put a life with a known end in the place of the inference."""

    def fit(history: History, stage: Stage, seed: int) -> object:
        return None if history.has_odometer else fit_life(history, stage, seed)

    def prognose(_: object, history: History, __: Stage) -> Prognosis:
        made = make_prognosis(np.linspace(1e5, 1e6, 1000), np.full(1000, 1e4))
        object.__setattr__(made, "stage", history.stage)
        return made

    monkeypatch.setattr(machine_commands, "fit_life", fit)
    monkeypatch.setattr(machine_commands, "prognosis_of", prognose)


def call(*words: object) -> Result:
    """Run the command."""
    return CliRunner().invoke(main, ["prognose", *map(str, words)])


@pytest.mark.slow
def test_estimates_become_remaining_lives(table: Path, toml: Path, tmp_path: Path) -> None:
    """The truth lies in the 90 % interval, who does not wear lasts longer; draws are kept.

    No log excludes wear that begins later: a sound machine has dates, too.
    """
    out, draws = tmp_path / "new" / "prognosis.csv", tmp_path / "life.nc"
    result = call(table, "--stage", toml, "--out", out, "--posterior", draws, "--by", "2026-05-01")
    assert result.exit_code == 0, result.output
    found = pd.read_csv(out)
    assert tuple(found.columns[: len(TABLES["prognosis"].names)]) == TABLES["prognosis"].names
    worn, sound = (found[found["stage"] == stage].iloc[1] for stage in ("AX-1", "AX-2"))
    assert worn["rul_km_q05"] < LIMIT_KM < worn["rul_km_q95"]
    assert worn["probability_beyond_horizon"] < 0.01 < 0.5 < sound["probability_beyond_horizon"]
    assert np.isnan(sound["rul_km_q50"])  # beyond the horizon
    for one in (worn, sound):
        assert one["service"] == "by" and one["service_risk"] <= 0.05
        assert one["inspect_by"] <= one["service_by"]
    assert sound["probability_at_most"] < 0.5 * worn["probability_at_most"]
    assert worn["before"] == "2026-05-01"
    assert f"Service: by {worn['service_by']} (accepted risk 5 %)" in result.stdout
    assert plain(km(1000 * worn["rul_km_q50"])) in plain(result.stdout)
    assert "AX-2: remaining life" in result.stdout and "beyond 5 000" in plain(result.stdout)
    tree = xarray.open_datatree(draws, engine="h5netcdf")
    assert tree["AX-1/posterior/guide_preload"].to_numpy().mean() == pytest.approx(0.835, abs=0.03)


@pytest.mark.slow
@pytest.mark.usefixtures("quick")
def test_the_command_line_chooses_the_day(table: Path, toml: Path, tmp_path: Path) -> None:
    """A risk or a ratio of costs stands in for that of the description; the plan stays."""
    out, days = tmp_path / "p.csv", []
    for more in ((), ("--max-risk", 0.3), ("--cost-ratio", 1.5), ("--cost-ratio", 300)):
        result = call(table, "--stage", toml, "--out", out, *more)
        assert result.exit_code == 0, result.output
        assert "Before the service planned for 2026-06-01: 91 %" in result.stdout
        days.append(pd.read_csv(out)["service_by"].iloc[1])
    assert days[0] < days[1] and days[3] < days[2]
    assert "least cost, where a failure costs 300 times" in result.stdout
    assert call(table, "--stage", toml, "--out", out, "--cost-ratio", 1).exit_code == 2


def test_two_choices_of_the_day_are_wrong_usage(table: Path, toml: Path, tmp_path: Path) -> None:
    """Both options together: status 2, and both are named."""
    words = ("--max-risk", 0.3, "--cost-ratio", 3)
    result = call(table, "--stage", toml, "--out", tmp_path / "p.csv", *words)
    assert result.exit_code == 2
    assert "--max-risk and --cost-ratio" in result.stderr


@pytest.mark.usefixtures("quick")
@pytest.mark.parametrize(("first", "lost"), [(6, True), (11, False)])
def test_an_odometer_that_was_reset_gives_no_date(
    table: Path, toml: Path, tmp_path: Path, first: int, lost: bool
) -> None:
    """Status 3 and a reason where logs contradict each other; a single one is only left out."""
    rows, out = pd.read_csv(table), tmp_path / "p.csv"
    later = (rows["stage"] == "AX-2") & (rows["log"] >= f"AX-2-{first:02d}")
    rows.loc[later, "travel_km"] -= 100.0 * first - 50
    rows.to_csv(table, index=False)
    result = call(table, "--stage", toml, "--out", out)
    assert result.exit_code == 3
    assert "of 12 logs odometer or date contradicts" in " ".join(result.stderr.split())
    assert ("AX-2" in set(pd.read_csv(out)["stage"])) == (not lost)


@pytest.mark.usefixtures("quick")
def test_a_machine_without_odometer_is_left_out(table: Path, toml: Path, tmp_path: Path) -> None:
    """Status 3 where one of two machines has no odometer, 1 and no file where none has."""
    rows, out = pd.read_csv(table), tmp_path / "p.csv"
    rows.loc[rows["stage"] == "AX-2", "travel_km"] = np.nan
    rows.to_csv(table, index=False)
    result = call(table, "--stage", toml, "--out", out)
    assert result.exit_code == 3
    assert "AX-2: not every log has travel_km" in result.stderr
    assert set(pd.read_csv(out)["stage"]) == {"AX-1"}
    rows[rows["stage"] == "AX-2"].to_csv(table, index=False)
    result = call(table, "--stage", toml, "--out", tmp_path / "none.csv")
    assert result.exit_code == 1
    assert not (tmp_path / "none.csv").exists()


def test_a_description_without_limits_is_one_line_and_status_1(table: Path, tmp_path: Path) -> None:
    """Without a limit there is no end of life, whatever the table."""
    make_stage(tmp_path / "free", (FADING.replace("limit = { below = 0.6 }", ""),), tail=TAIL)
    stage = tmp_path / "free" / "small.toml"
    result = call(table, "--stage", stage, "--out", tmp_path / "p.csv")
    assert result.exit_code == 1
    assert result.stderr.count("\n") == 1
    assert "no [[parameter]] has a limit" in result.stderr


@pytest.mark.usefixtures("quick")
def test_maintenance_of_other_machines_is_noted(table: Path, toml: Path, tmp_path: Path) -> None:
    """A name that the table does not have may be a slip of the pen."""
    actions = tmp_path / "maintenance.csv"
    actions.write_text("stage,recorded_at,action\nAX-9,2026-03-02T00:00:00Z,servo\n")
    out = tmp_path / "p.csv"
    result = call(table, "--stage", toml, "--out", out, "--maintenance", actions)
    assert result.exit_code == 0, result.output
    assert (
        "note: maintenance.csv: work on AX-9 is not used: no usable log is of it; is it AX-"
        in result.stderr
    )


@pytest.mark.usefixtures("quick")
def test_work_after_the_last_log_leaves_its_limit_out(
    table: Path, toml: Path, tmp_path: Path
) -> None:
    """The day was that of the state before the work, which no log shows; of others it stays."""
    actions, out = tmp_path / "maintenance.csv", tmp_path / "p.csv"
    for action, known in (("regrease", True), ("preload-adjust", False)):
        actions.write_text(
            "stage,recorded_at,action\n"
            f"AX-1,2026-03-25T00:00:00Z,{action}\nAX-2,2026-02-02T00:00:00Z,preload-adjust\n"
        )
        result = call(table, "--stage", toml, "--out", out, "--maintenance", actions)
        assert result.exit_code == 0, result.output
        rows = pd.read_csv(out).set_index(["stage", "parameter"])
        assert rows.loc[("AX-2", "any"), "service"] == "by"
        assert rows.loc[("AX-1", "any"), "service"] == ("by" if known else "unknown")
        assert rows["service_by"].notna()[("AX-1", "any")] == known
        assert ("Service: not known before a log" in result.stdout) == (not known)
        note = "AX-1: preload-adjust on 2026-03-25: no log since"
        assert (note in plain(result.stderr)) == (not known)


@pytest.mark.usefixtures("quick")
def test_rows_are_of_the_limits_that_no_work_has_restored(
    table: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A limit that work after the last log has restored has no row, nor a part in any limit."""
    make_stage(tmp_path / "stage", (FADING, MOUNT), tail=TAIL)
    soon, late = np.linspace(1e5, 2e5, 1000), np.linspace(1e6, 2e6, 1000)

    def prognose(_: object, history: History, __: Stage) -> Prognosis:
        both = np.column_stack([soon, late, soon])
        made = replace(
            make_prognosis(soon, np.full(1000, 1e4)),
            stage=history.stage,
            parameters=("guide_preload", "mount_stiffness", "any"),
            limits=np.array([0.6, 0.7, np.nan]),
            remaining=both,
            half=both[:, :-1] / 2,
            health=np.full((1000, 2), 0.8),
            curve_quantiles=np.full((5, 3, 2), 0.8),
        )
        return made

    monkeypatch.setattr(machine_commands, "prognosis_of", prognose)
    actions, out = tmp_path / "maintenance.csv", tmp_path / "p.csv"
    actions.write_text("stage,recorded_at,action\nAX-1,2026-03-25T00:00:00Z,preload-adjust\n")
    words = ("--stage", tmp_path / "stage" / "small.toml", "--by", "2026-05-01", "--out", out)
    result = call(table, *words, "--maintenance", actions)
    assert result.exit_code == 0, result.output
    rows = pd.read_csv(out).set_index("stage")
    mended, other = rows.loc["AX-1"], rows.loc["AX-2"]
    assert mended["parameter"].tolist() == ["mount_stiffness", "any"]
    assert other["parameter"].tolist() == ["guide_preload", "mount_stiffness", "any"]
    same = ["rul_km_q50", "probability_at_most"]
    assert mended[same].iloc[1].tolist() == other[same].iloc[1].tolist()
    assert mended["rul_km_q50"].iloc[1] > 5 * other["rul_km_q50"].iloc[2]
    assert mended["service_by"].iloc[1] > other["service_by"].iloc[2]


@pytest.mark.parametrize("option", ["--max-risk", "--cost-ratio"])
@pytest.mark.parametrize("value", ["nan", "inf"])
def test_a_number_that_is_not_finite_is_wrong_usage(
    table: Path, toml: Path, tmp_path: Path, option: str, value: str
) -> None:
    """Neither NaN nor infinity chooses a day: status 2, the option is named, nothing is written."""
    out = tmp_path / "p.csv"
    result = call(table, "--stage", toml, "--out", out, option, value)
    assert result.exit_code == 2
    assert option in result.stderr and not out.exists()


@pytest.mark.usefixtures("quick")
def test_a_past_day_has_no_probability(table: Path, toml: Path, tmp_path: Path) -> None:
    """The day of the last log, or one before it, has a note and no probability anywhere."""
    out = tmp_path / "p.csv"
    for day in ("2026-01-01", START.date().isoformat()):
        result = call(table, "--stage", toml, "--out", out, "--by", day)
        assert result.exit_code == 0, result.output
        assert f"--by {day} is not after the last log" in result.stderr
        assert f"before {day}" not in result.stdout
        assert "before" not in pd.read_csv(out).columns


@pytest.mark.parametrize("day", ["soon", "01.03.2027", "2027-13-01"])
def test_an_invalid_day_is_refused_with_an_example(
    table: Path, toml: Path, tmp_path: Path, day: str
) -> None:
    """Status 2, with the form and an example instead of the signs of a format."""
    result = call(table, "--stage", toml, "--out", tmp_path / "p.csv", "--by", day)
    assert result.exit_code == 2
    assert f"{day!r} is not a day; needed is YYYY-MM-DD, such as 2027-03-01" in result.stderr
    assert "%" not in result.stderr
