"""What the command line says of an archive: nothing is read but what it wrote for its user."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pandas as pd

from lmshealth.stage.constants import INFORMED
from studies.blind_lives.lives import STAGES
from studies.harness.command_line import call
from studies.harness.study import Row

EPOCHS = 3
LEVELS = ("q05", "q25", "q50", "q75", "q95")
_UNEXPLAINED = 1e-4  # of `fit`, as the README tells it
# What the front page writes for each word of verdict.csv.
SHOWN = {
    "healthy": "Healthy",
    "preload": "Loss of guide preload",
    "mount": "Loss of mount stiffness",
    "both": "Loss of guide preload and mount stiffness",
    "step": "Sudden change without a known cause",
    "not-enough-data": "Not enough data for a verdict",
}
# Instead of the last where modes have moved.
ALARM = "Alarm: "
_INDEX_ROW = re.compile(
    r'<tr role="row" data-state.*?<a href="([^"]+)">([^<]+)</a>.*?'
    r'<span class="mark \w+"><span[^>]*>.</span>([^<]*)</span>',
    re.S,
)


def analyse(logs: Path, out: Path, *, quick: bool = False) -> dict[str, Row]:
    """Run the command line over an archive of both stages, and read what it says of each machine.

    Parameters
    ----------
    logs, out : Path
        Folders of the archive, and of the answers.
    quick : bool
        As in `call`, and with health at the last log alone.

    Returns
    -------
    dict
        By machine: ``verdict`` and ``probability``, ``shown`` on the front page as on its row,
        quantiles of ``health`` where it is told and of what is ``left`` in km (None past the
        horizon), counts of ``events`` that are no declared work, and of ``refused`` by reason.
    """
    stages = [word for name in STAGES for word in ("--stage", name)]
    call("lmshealth", "run", logs, *stages, "--out", out,
         "--epochs", 1 if quick else EPOCHS, "--workers", 1,
         quick=quick, some_refused=True)  # fmt: skip
    shown = front_page(out / "index.html")
    verdicts = pd.read_csv(out / "verdict.csv")
    health, left = _health(out / "health.csv"), _left(out / "prognosis.csv")
    events = pd.read_csv(out / "events.csv")
    events = events[~events["declared"].astype(bool)]
    refused = pd.read_csv(out / "refused.csv")
    refused["stage"] = refused["log"].str.split("/").str[0]  # logs stand in folders of machines
    answers = {}
    for row in verdicts.to_dict("records"):
        name, told = row["stage"], float(row["probability"])
        answers[name] = {
            "verdict": row["verdict"],
            "probability": told if np.isfinite(told) else None,
            "shown": shown.get(name),
            "health": health.get(name, {}),
            "left": left.get(name, {}),
            "events": _counts(events[events["stage"] == name].drop_duplicates("kind")["kind"]),
            "refused": _counts(refused[refused["stage"] == name]["reason"]),
        }
    return answers


def agrees(told: Row) -> bool:
    """Whether the front page says what the table of verdicts does."""
    alarm = told["verdict"] == "not-enough-data" and (told["shown"] or "").startswith(ALARM)
    return alarm or told["shown"] == SHOWN[told["verdict"]]


def front_page(path: Path) -> dict[str, str]:
    """Read the rows of the front page: the verdict in words, of each machine that has a page."""
    rows = _INDEX_ROW.findall(path.read_text(encoding="utf-8"))
    return {name: words.strip() for file, name, words in rows if (path.parent / file).exists()}


def _counts(values: pd.Series) -> dict[str, int]:
    return {str(name): int(count) for name, count in values.value_counts().items()}


def _health(path: Path) -> dict[str, dict[str, Row]]:
    """Read the last epoch of every machine, of what is told and not only believed."""
    found: dict[str, dict[str, Row]] = {}
    table = pd.read_csv(path)
    for (stage, name), rows in table.groupby(["stage", "parameter"]):
        row = rows.iloc[-1]
        claimed = row["converged"] and row["identifiable"] and not row["fit"] < _UNEXPLAINED
        if claimed and row["informed"] >= INFORMED:
            own = {"q50" if k == "median" else k: float(row[k])
                   for k in ("q05", "q25", "median", "q75", "q95")}  # fmt: skip
            found.setdefault(str(stage), {})[str(name)] = own
    return found


def _left(path: Path) -> dict[str, dict[str, Row]]:
    """Read the quantiles of the remaining travel; an empty one lies past the horizon."""
    found: dict[str, dict[str, Row]] = {}
    for row in pd.read_csv(path).to_dict("records"):
        values = {level: float(row[f"rul_km_{level}"]) for level in LEVELS}
        own = {level: None if np.isnan(km) else km for level, km in values.items()}
        own["past"] = float(row["probability_already_past"])
        own["beyond"] = float(row["probability_beyond_horizon"])
        found.setdefault(str(row["stage"]), {})[str(row["parameter"])] = own
    return found
