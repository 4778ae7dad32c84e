"""Values of machines for dashboards."""

from collections.abc import Mapping, Sequence

import numpy as np

from lmshealth._private.tables import Row
from lmshealth.batch import constants
from lmshealth.stage.constants import INFORMED


def points(rows: Mapping[str, Sequence[Row]]) -> list[Row]:
    """Return values of a machine with 90 % intervals for dashboards, from the rows of its tables.

    Health (in units of the parameter) and frequency at its newest logs, remaining life at the last.
    """
    tables = {name: rows.get(name, ()) for name in ("health", "track", "prognosis", "verdict")}
    found = [
        ("health", row["parameter"], row["recorded_at"], row["q05"], row["median"], row["q95"])
        for row in tables["health"]
        if row["identifiable"] and row["informed"] >= INFORMED
    ]
    for row in tables["track"][-constants.TRACK_POINTS :]:
        hertz, spread = row["frequency_hz"], 1.645 * row["frequency_std_hz"]
        own = hertz - spread, hertz, hertz + spread
        if np.isfinite(own).all():
            found.append(("frequency_hz", row["mode"], row["recorded_at"], *map(float, own)))
    for row in tables["prognosis"]:
        own = tuple(row[f"rul_km_{name}"] for name in ("q05", "q50", "q95"))
        found.append(("remaining_km", row["parameter"], tables["verdict"][0]["recorded_at"], *own))
    names = "quantity", "subject", "recorded_at", "low", "median", "high"
    return [dict(zip(names, own, strict=True)) for own in found]
