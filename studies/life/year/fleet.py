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
from models.dynamics.stages import Stage, stage_named
from models.lives.circumstances import KM_PER_DAY, Contact, stage_at
from models.lives.degradation import HALL, HertzWear, Jobs, Life, Loosening, Work
from models.recordings.formats import write_log
from models.recordings.recording import payload_kg, record
from studies.harness.command_line import call_here, no_pictures, quick_posteriors
from studies.harness.study import Row

BEGIN = date(2025, 1, 1)
LIMITS = {"guide preload": 0.6, "mount stiffness": 0.7}
REPAIR, ENTERED, SILENT, FOREIGN, LONE = 130, 155, 170, 185, 0.02  # days; ln f of yaw
_WORK = ["stage", "recorded_at", "travel_km", "action"]
_PLAIN = str.maketrans("\u2011\u2212\u202f\xa0", "--  ")


@dataclass(frozen=True)
class Machine:
    """A machine and its life: ``repaired`` it does not wear any more."""

    name: str
    role: str = "healthy"
    life: Life = field(default_factory=lambda: Life("healthy"))

    def health(self, part: str, day: float, regime: float) -> float:
        """Return a part's health on a day over that when new, as without work after ``regime``."""
        if self.role == "repaired" and regime >= REPAIR:
            return 1.0
        law = self.life.preload if part == "guide preload" else self.life.mount
        return law.at(KM_PER_DAY * day)

    def days(self) -> list[float]:
        """Return the days of logs: two a month, up to the silence."""
        rng = np.random.default_rng([47, *self.name.encode()])
        days = 15.2 * np.arange(24) + 4 + rng.uniform(-2, 2, 24)
        return [float(day) for day in days if self.role != "silent" or day < SILENT]

    def works(self) -> list[tuple[float, str, int]]:
        """Return the day and kind of each work, and the day on which it is entered."""
        days = [(work.travel_km / KM_PER_DAY, work.action) for work in self.life.work]
        found = [(day, action, int(day) + 1) for day, action in days]
        return found + [(REPAIR, "preload-adjust", ENTERED)] * (self.role == "repaired")

    def stage(self, day: float) -> Stage:
        """Return the stage on a day: with what moves yaw alone."""
        moved = LONE * (self.role == "foreign" and day >= FOREIGN)
        return stage_at(stage_named("lms-y"), Contact(wander=(0.0, 0.0, moved)), 0.0)

    @lru_cache(maxsize=None)  # noqa: B019
    def ln_f(self, day: float) -> dict[str, float]:
        """Return ln f of the guide's modes without temperature, payload and tuning."""
        preload, mount = (self.health(part, day, day) for part in LIMITS)
        new = Life("new").condition(0, 21.0)
        worn = replace(new, guide_preload=preload, mount_stiffness=mount)
        modes = {mode.name: mode for mode in closed_loop_modes(self.stage(day), worn)}
        return {name: float(np.log(modes[name].frequency_hz)) for name in GUIDE_MODES}


FLEET = (
    Machine("A-Y", "wears", Life("preload", HertzWear(8000.0, 1.1))),
    Machine("B-Y", "wears", Life("mount", mount=Loosening(3000.0, 0.55))),
    Machine("C-Y", "wears", Life("both", HertzWear(9500.0, 1.1), Loosening(5000.0, 0.6))),
    Machine("D-Y", "repaired", Life("preload", HertzWear(6000.0, 1.1))),
    Machine("E-Y", "silent"),
    Machine("F-Y", "foreign"),
    Machine("G-Y"),
    Machine("H-Y"),
    Machine("I-Y", life=Life("hall", climate=HALL)),
    Machine("J-Y", life=Life("jobs", jobs=Jobs((0.0, 2.0, -1.5), 800.0))),
    Machine("K-Y", life=Life("greased", work=(Work(2400.0, "regrease"),))),
    Machine("L-Y", life=Life("tuned", work=(Work(2000.0, "servo"),))),
)


def run_day(month: int) -> int:
    """Return the day of a run, since the first day of the year: the first of the next month."""
    return (date(BEGIN.year + month // 12, month % 12 + 1, 1) - BEGIN).days


def played(letters: str, months: int, seconds: float, keep: str) -> list[Row]:
    """Run the program after each month, and return all that it says of each machine."""
    rows: list[Row] = []
    fleet = [one for one in FLEET if one.name[0] in letters]
    with TemporaryDirectory() as folder, quick_posteriors(), no_pictures():
        logs, out = Path(folder) / "logs", Path(folder) / "out"
        logs.mkdir()
        for month in range(1, months + 1):
            _archive(fleet, logs, run_day(month), seconds)
            today = BEGIN + timedelta(days=run_day(month))
            words = f"--stage lms-y --workers 1 --silent-days 45 --today {today}".split()
            call_here("lmshealth", ["run", str(logs), "--out", str(out), *words])
            for name in (one.name for one in fleet):
                told = ({"source": source, "said": said} for source, said in _said(out, name))
                rows += ({"month": month, "machine": name, **one} for one in told)
            if keep:
                shutil.copytree(out, Path(keep) / f"{month:02d}", dirs_exist_ok=True)
    return rows


def _archive(fleet: list[Machine], folder: Path, today: int, seconds: float) -> None:
    """Add the logs up to a day, and write manifest and maintenance as an owner keeps them."""
    manifest = [_log(one, k, day, folder, seconds) for one in fleet
                for k, day in enumerate(one.days()) if day < today]  # fmt: skip
    work = [(one.name, _moment(day), round(KM_PER_DAY * day, 3), action) for one in fleet
            for day, action, entered in one.works() if entered < today]  # fmt: skip
    for name, rows in (("manifest", [[*manifest[0]], *(row.values() for row in manifest)]),
                       ("maintenance", [_WORK, *work])):  # fmt: skip
        with (folder / f"{name}.csv").open("w", newline="") as file:
            csv.writer(file).writerows(rows)


def _log(one: Machine, k: int, day: float, folder: Path, seconds: float) -> Row:
    """Write a log unless it is there, and return its row of the manifest."""
    rng, travel = np.random.default_rng([48, k, *one.name.encode()]), round(KM_PER_DAY * day, 3)
    warm = round(one.life.climate.at(datetime.fromisoformat(_moment(day)), rng), 2)
    preload, mount = (one.health(part, day, day) for part in LIMITS)
    state = one.life.condition(travel, warm)
    state = replace(state, guide_preload=preload, mount_stiffness=mount)
    row = {"stage": one.name, "recorded_at": _moment(day), "travel_km": travel,
           "temperature_c": warm, "payload_kg": payload_kg(one.stage(day), state),
           "servo_id": state.servo_id}  # fmt: skip
    path = folder / f"{one.name}-{k + 1:02d}.h5"
    if not path.exists():
        made = record(one.stage(day), state, seconds=seconds, rng=rng)
        write_log(made.described(**row), path, "hdf5")
    return {"file": path.name, **row}


def _moment(day: float) -> str:
    moment = datetime.combine(BEGIN, time()) + timedelta(days=day)
    return moment.replace(microsecond=0).isoformat() + "+00:00"


def _said(out: Path, name: str) -> Iterator[tuple[str, str]]:
    """Yield source and sentence of what a run says of a machine: page, fleet page, alerts."""
    page = (out / f"{name}.html").read_text(encoding="utf-8")
    page = page[page.index("<h1>") : page.index('<section id="modes"')]
    page = re.sub(r'</h3>\s*<p class="reading">', ": ", page)
    yield from (("page", one) for one in _sentences(page))
    index = (out / "index.html").read_text(encoding="utf-8")
    for row in re.findall(r"<tr role.*?</tr>", index, re.DOTALL):
        if f'href="{name}.html"' in row:
            cells = re.sub(r'<td[^>]*data-label="([^"]*)"[^>]*>', r"<p>\1: ", row)
            yield from (("fleet", one) for one in _sentences(cells.replace("</td>", "</p>")))
    status = json.loads((out / f"{name}.status.json").read_text(encoding="utf-8"))
    yield "status", status["DeviceHealth"]
    with (out / "changes.csv").open() as file:
        for row in csv.DictReader(file):
            if row["stage"] == name:
                yield "alert", "{severity}: {what}: {before} → {now}".format(**row)


def _sentences(page: str) -> Iterator[str]:
    """Yield the sentences of a part of a page, with plain spaces, hyphens and signs."""
    page = re.sub(r"<(style|script|svg|nav)\b.*?</\1>", "", page, flags=re.DOTALL)
    page = re.sub(r"</t[dh]>|<span", lambda found: f" {found[0]}", re.sub(r"\s+", " ", page))
    page = re.sub(r"</(p|li|h\d|div|tr|section)>|<br>|<p[ >]", lambda m: "\n" + m[0], page)
    text = html.unescape(re.sub(r"<[^>]*>", "", page)).translate(_PLAIN)
    for line in text.split("\n"):
        found = re.split(r"(?<=[a-z0-9)%][.])\s+(?=[A-Z])", " ".join(line.split()))
        yield from filter(None, found)
