"""A year of a fleet of twelve stages Y: its truth, its logs, and what every run of `run` says."""

from __future__ import annotations

import csv
import html
import json
import re
import shutil
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from datetime import date, datetime, time, timedelta
from functools import lru_cache
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from models.dynamics.plant import GUIDE_MODES, closed_loop_modes
from models.dynamics.stages import stage_named
from models.lives.circumstances import KM_PER_DAY, Contact, stage_at
from models.lives.degradation import (
    HALL,
    HertzWear,
    Jobs,
    Law,
    Life,
    Loosening,
    Steady,
    Work,
)
from models.recordings.formats import write_log
from models.recordings.recording import payload_kg, record
from studies.harness.command_line import call_here, no_pictures, quick_posteriors
from studies.harness.study import Row

BEGIN = date(2025, 1, 1)
LIMITS = {"guide preload": 0.6, "mount stiffness": 0.7}
REPAIR, ENTERED, SILENT, FOREIGN, LONE = 130, 155, 170, 185, 0.02  # days; ln f of yaw
HORIZON_DAYS = 1666


@dataclass(frozen=True)
class Machine:
    """A machine: its life, the laws after its repair, and its days of logs."""

    name: str
    role: str
    life: Life = field(default_factory=lambda: Life("healthy"))
    repaired: bool = False
    last_day: int = 366
    foreign: bool = False

    def health(self, part: str, day: float, regime: float) -> float:
        """Return a part's health on a day over that at commissioning, by the laws of a day."""
        if self.repaired and regime >= REPAIR:
            return 1.0
        law: Law = self.life.preload if part == "guide preload" else self.life.mount
        return law.at(KM_PER_DAY * day)

    def days(self) -> list[float]:
        """Return the days of logs: two a month, in the morning."""
        rng = np.random.default_rng([47, *self.name.encode()])
        days = 15.2 * np.arange(24) + 4 + rng.uniform(-2, 2, 24)
        return [float(day) for day in days if day < self.last_day]

    def works(self) -> list[tuple[float, str, int]]:
        """Return the day and kind of each work, and the day on which it is entered."""
        own = [(w.travel_km / KM_PER_DAY, w.action) for w in self.life.work]
        found = [(day, action, int(day) + 1) for day, action in own]
        return [*found, *([(REPAIR, "preload-adjust", ENTERED)] if self.repaired else [])]

    def ln_f(self, day: float) -> dict[str, float]:
        """Return ln f of the guide's modes without temperature, payload and tuning."""
        preload, mount = (round(self.health(part, day, day), 6) for part in LIMITS)
        return dict(_ln_f(preload, mount, self.foreign and day >= FOREIGN))


@lru_cache(maxsize=4096)
def _ln_f(preload: float, mount: float, lone: bool) -> tuple[tuple[str, float], ...]:
    condition = replace(Life("").condition(0, 21.0), guide_preload=preload, mount_stiffness=mount)
    found = {mode.name: mode for mode in closed_loop_modes(_stage(lone), condition)}
    return tuple((name, float(np.log(found[name].frequency_hz))) for name in GUIDE_MODES)


def _stage(lone: bool):  # type: ignore[no-untyped-def]
    return stage_at(stage_named("lms-y"), Contact(wander=(0.0, 0.0, LONE * lone)), 0.0)


def _worn(preload: Law = Steady(), mount: Law = Steady()) -> Life:
    return Life("worn", preload=preload, mount=mount)


FLEET = (
    Machine("A-Y", "wears: preload", _worn(HertzWear(8000.0, 1.1))),
    Machine("B-Y", "wears: mount", _worn(mount=Loosening(3000.0, 0.55))),
    Machine("C-Y", "wears: both", _worn(HertzWear(9500.0, 1.1), Loosening(5000.0, 0.6))),
    Machine("D-Y", "repaired", _worn(HertzWear(6000.0, 1.1)), repaired=True),
    Machine("E-Y", "silent", last_day=SILENT),
    Machine("F-Y", "foreign", foreign=True),
    Machine("G-Y", "healthy"),
    Machine("H-Y", "healthy"),
    Machine("I-Y", "healthy", Life("hall", climate=HALL)),
    Machine("J-Y", "healthy", Life("jobs", jobs=Jobs((0.0, 2.0, -1.5), 800.0))),
    Machine("K-Y", "healthy", Life("greased", work=(Work(2400.0, "regrease"),))),
    Machine("L-Y", "healthy", Life("tuned", work=(Work(2000.0, "servo"),))),
)


def played(names: str, months: int, seconds: float, keep: str = "") -> list[Row]:
    """Run the program at the end of each month, and return all that it says of each machine."""
    rows: list[Row] = []
    fleet = [one for one in FLEET if one.name[0] in names]
    with TemporaryDirectory() as folder, quick_posteriors(), no_pictures():
        logs, out = Path(folder) / "logs", Path(folder) / "out"
        logs.mkdir()
        for month in range(1, months + 1):
            today = run_day(month)
            _archive(fleet, logs, month, seconds)
            options = "--stage lms-y --workers 1 --silent-days 45 --today".split()
            call_here("lmshealth", ["run", str(logs), "--out", str(out), *options, str(today)])
            for one in fleet:
                for source, sentence in _said(out, one.name):
                    rows.append({"month": month, "machine": one.name, "source": source,
                                 "said": sentence})  # fmt: skip
            if keep:
                shutil.copytree(out, Path(keep) / f"{month:02d}", dirs_exist_ok=True)
    return rows


def run_day(month: int) -> date:
    """Return the day of a run: the first of the next month."""
    return date(BEGIN.year + month // 12, month % 12 + 1, 1)


def _archive(fleet: list[Machine], folder: Path, month: int, seconds: float) -> None:
    """Add the logs of a month, and write manifest and maintenance as an owner keeps them."""
    today = (run_day(month) - BEGIN).days
    manifest, work = [], []
    for one in fleet:
        for k, day in enumerate(one.days()):
            if day >= today:
                break
            row, name = _log(one, k, day, folder, seconds), f"{one.name}-{k + 1:02d}.h5"
            manifest.append({"file": name, "stage": one.name, **row})
        for day, action, entered in one.works():
            if entered < today:
                work.append({"stage": one.name, "recorded_at": _moment(day),
                             "travel_km": round(KM_PER_DAY * day, 3), "action": action})  # fmt: skip
    for name, rows in (("manifest", manifest), ("maintenance", work)):
        with (folder / f"{name}.csv").open("w", newline="") as file:
            fields = rows[0] if rows else ("stage", "recorded_at", "travel_km", "action")
            writer = csv.DictWriter(file, list(fields))
            writer.writeheader()
            writer.writerows(rows)


def _log(one: Machine, k: int, day: float, folder: Path, seconds: float) -> Row:
    """Write a log unless it is there, and return its metadata."""
    rng, travel = np.random.default_rng([48, k, *one.name.encode()]), round(KM_PER_DAY * day, 3)
    warm = one.life.climate.at(datetime.fromisoformat(_moment(day)), rng)
    condition = replace(
        one.life.condition(travel, round(warm, 2)),
        guide_preload=one.health("guide preload", day, day),
        mount_stiffness=one.health("mount stiffness", day, day),
    )
    stage = _stage(one.foreign and day >= FOREIGN)
    row = {"recorded_at": _moment(day), "travel_km": travel, "temperature_c": round(warm, 2),
           "payload_kg": payload_kg(stage, condition), "servo_id": condition.servo_id}  # fmt: skip
    path = folder / f"{one.name}-{k + 1:02d}.h5"
    if not path.exists():
        made = record(stage, condition, seconds=seconds, rng=rng)
        write_log(made.described(stage=one.name, **row), path, "hdf5")
    return row


def _moment(day: float) -> str:
    moment = datetime.combine(BEGIN, time()) + timedelta(days=day)
    return moment.replace(microsecond=0).isoformat() + "+00:00"


def _said(out: Path, name: str) -> Iterator[tuple[str, str]]:
    """Yield source and sentence of all that a run says of a machine: page, fleet page, alerts."""
    page = (out / f"{name}.html").read_text(encoding="utf-8")
    page = page[page.index("<h1>") : page.index('<section id="modes"')]
    page = re.sub(r'</h3>\s*<p class="reading">', ": ", page)
    yield from (("page", one) for one in _sentences(page))
    index = (out / "index.html").read_text(encoding="utf-8")
    for row in re.findall(r"<tr role.*?</tr>", index, re.DOTALL):
        if f'href="{name}.html"' in row:
            cells = re.sub(r'<td[^>]*data-label="([^"]*)"[^>]*>', r"<p>\1: ", row)
            yield from (("fleet", one) for one in _sentences(cells.replace("</td>", "</p>").replace("<span", " <span")))
    status = json.loads((out / f"{name}.status.json").read_text(encoding="utf-8"))
    yield "status", status["DeviceHealth"]
    with (out / "changes.csv").open() as file:
        for row in csv.DictReader(file):
            if row["stage"] == name:
                told = f"{row['severity']}: {row['what']}: {row['before']} → {row['now']}"
                yield "alert", told


def _sentences(page: str) -> Iterator[str]:
    """Yield the sentences of a part of a page, with plain spaces, hyphens and signs."""
    page = re.sub(r"<(style|script|svg|nav)\b.*?</\1>", "", page, flags=re.DOTALL)
    page = re.sub(r"\s+", " ", page)
    page = re.sub(r"</t[dh]>", " ", page)
    page = re.sub(r"</(p|li|h\d|div|tr|section)>|<br>|<p[ >]", lambda m: "\n" + m[0], page)
    text = html.unescape(re.sub(r"<[^>]*>", "", page))
    for old, new in (("\u2011", "-"), ("\u2212", "-"), ("\u202f", " "), ("\xa0", " ")):
        text = text.replace(old, new)
    for line in text.split("\n"):
        for one in re.split(r"(?<=[a-z0-9)%][.])\s+(?=[A-Z])", " ".join(line.split())):
            if one:
                yield one
