"""Tables for dashboards: what other programs show of machines; no run reads them."""

from collections.abc import Iterable, Mapping, Sequence
from datetime import UTC, datetime
from typing import Any

import numpy as np
import sqlalchemy as sql

from lmshealth._private.serialize import fingerprint
from lmshealth._private.tables import Row
from lmshealth.batch import constants
from lmshealth.batch.database import CHANGES, POINTS, STATUS
from lmshealth.batch.store import Store, machine_key
from lmshealth.machine.status import Change, Status
from lmshealth.stage.constants import INFORMED

_SHOWN = ("recorded_at", "verdict", "probability", "service", "service_by", "inspect_by")


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


def put_points(store: Store, machine: str, rows: Iterable[Row]) -> None:
    """Replace what dashboards show of a machine; remaining lives at earlier logs stay."""
    new = [
        own
        | {"name": machine, "recorded_at": datetime.fromisoformat(own["recorded_at"])}
        | {"key": fingerprint(own["quantity"], own["subject"], own["recorded_at"])}
        for own in rows
    ]
    earlier = POINTS.c.machine == machine_key(machine), POINTS.c.quantity != "remaining_km"
    with store.transaction() as connection:
        connection.execute(sql.delete(POINTS).where(*earlier))
        store.upsert(POINTS, _named(new))


def put_status(
    store: Store, statuses: Iterable[Status], changes: Iterable[Change], noticed_at: datetime
) -> None:
    """Write the status of machines, and what has changed."""
    present = [
        {name: getattr(one, name) for name in _SHOWN}
        | {"name": one.stage, "state": one.device_health, "alarms": " ".join(one.alarms)}
        | {"silent": "yes" if one.silent else "no"}
        for one in statuses
    ]
    changed = [
        {name: getattr(one, name) for name in ("recorded_at", "what", "before", "now")}
        | {"name": one.stage, "key": fingerprint(one), "noticed_at": noticed_at}
        for one in changes
    ]
    with store.transaction():
        store.upsert(STATUS, _named(present))
        store.upsert(CHANGES, _named(changed))


def _named(rows: Iterable[dict[str, Any]]) -> list[dict[str, Any]]:
    """Add the keys of machines to rows with their names; moments in UTC: SQLite has no zones."""
    return [
        {k: v.astimezone(UTC) if isinstance(v, datetime) else v for k, v in row.items()}
        | {"machine": machine_key(row["name"])}
        for row in rows
    ]
