"""Is every sentence true that the pages and alerts of a fleet say in a year of monthly runs?

Method
    Twelve simulated stages Y for a year, two logs of 6 s a month, 12 km a day: three wear (preload,
    mount, both), one wears and is repaired, which its owner enters 25 days later, one has no log
    after half a year, of one yaw moves alone by 2 % (no cause of the map), six are sound (two plain,
    a hall without heating, payloads, regreasing, tuning). `lmshealth run --today` on the first of
    each month over the growing archive, lives by importance sampling, pages without pictures. First
    screen, next steps, notices, changes, row of the fleet page, status and rows of changes.csv are
    split into sentences; each that a rule knows is compared with the machine's truth on that day.
    A sentence that is an interval or a day within an accepted risk may be false as often as it
    says; the end of a limit's interval counts as its own sentence. Truth within 3 % of the limit of
    a verdict is not judged. Control, which must fail: the same sentences by the truth of the
    machine six places on.
Run time
    Ten minutes on one processor.
"""

from __future__ import annotations

import re
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from datetime import date
from functools import cached_property
from typing import Any

from models.lives.circumstances import KM_PER_DAY
from studies.harness.claims import Claim, counted
from studies.harness.study import Row, Study
from studies.life.year.fleet import (
    BEGIN, ENTERED, FLEET, FOREIGN, HORIZON_DAYS, LIMITS, REPAIR, SILENT, Machine, played, run_day,
)  # fmt: skip

MONTHS, SECONDS, EDGE = 12, 6.0, 0.03
NOT_MET: dict[str, str] = {}
LOST = {part: 1 - 0.25 * (1 - limit) for part, limit in LIMITS.items()}
DAY = r"(\d{4}-\d\d-\d\d)"
INTERVAL = r"(\d+)(?: %)? to (\d+) %"
NAMES = {machine.name: machine for machine in FLEET}
Judge = Callable[[Any, "Truth"], "bool | None"]


@dataclass(frozen=True)
class Truth:
    """What is true of a machine on the day of a run, beside what its owner has entered."""

    machine: Machine
    month: int

    @property
    def today(self) -> int:
        return (run_day(self.month) - BEGIN).days

    @cached_property
    def logs(self) -> list[float]:
        return [day for day in self.machine.days() if day < self.today]

    @property
    def last(self) -> float:
        return self.logs[-1]

    @cached_property
    def base(self) -> float:
        """Return the day of the first log of the baseline: after work that restores a part."""
        work = [day for day, action, entered in self.machine.works()
                if entered < self.today and action == "preload-adjust"]  # fmt: skip
        return next(day for day in self.logs if day > max(work, default=-1.0))

    def at(self, part: str, day: float) -> float:
        """Return a part's health over that at the baseline, as it is without later work."""
        own = self.machine.health(part, day, max(self.last, self.base))
        return own / self.machine.health(part, self.base, self.base)

    def ends(self, part: str | None = None) -> float | None:
        """Return the day on which the limit of a part, or the first of all, is reached."""
        parts = [part] if part else list(LIMITS)
        for day in range(int(self.base), int(self.last) + HORIZON_DAYS):
            if any(self.at(one, day) <= LIMITS[one] for one in parts):
                return float(day)
        return None

    def lost(self, part: str) -> bool | None:
        """Return whether a part is lost at the last log; None close to the bound of the verdict."""
        now = self.at(part, self.last)
        return None if abs(now - LOST[part]) < EDGE else now < LOST[part]

    @property
    def unexplained(self) -> bool:
        """Return whether something moved the modes that is neither wear nor entered."""
        foreign = self.machine.foreign and self.base < FOREIGN <= self.last
        return foreign or (self.machine.repaired and self.base < REPAIR <= self.last)

    def moved(self, mode: str) -> float:
        """Return the change of ln f of a mode from the baseline to the last log."""
        return self.machine.ln_f(self.last)[mode] - self.machine.ln_f(self.base)[mode]

    @property
    def sound(self) -> bool | None:
        """Return whether nothing is lost, and nothing moved by another cause."""
        lost = [self.lost(part) for part in LIMITS]
        return False if self.unexplained or True in lost else None if None in lost else True


def day_of(text: str) -> int:
    return (date.fromisoformat(text) - BEGIN).days


def close(low: Any, high: Any, true: float) -> bool:
    """Return whether an interval of whole percents holds the truth."""
    return int(low) - 0.5 <= 100 * true <= int(high) + 0.5


def in_time(text: str, t: Truth, *, needed: bool = False) -> bool:
    """Return whether a day is before the limit is reached; ``needed``: and one is."""
    end = t.ends()
    return not needed if end is None else day_of(text) <= end


def verdict(text: str, t: Truth) -> bool | None:
    """Judge a verdict in words."""
    if "healthy" in text.lower():
        return t.sound
    if "loss of" in text.lower():
        told = [t.lost(part) is not False if part in text else t.lost(part) is not True
                for part in LIMITS]  # fmt: skip
        return all(told)
    if "alone" in text:
        return t.unexplained and t.machine.foreign
    if "udden" in text:
        return t.unexplained
    return None


def life(m: Any, t: Truth) -> bool | None:
    """Judge the early or the late end of the remaining life."""
    end, early = t.ends(), m[1] == "Early"
    left = None if end is None else KM_PER_DAY * (end - t.last)
    if "beyond" in m[2]:
        return left is None if early else True
    km = 0.0 if "passed" in m[2] else float(re.sub(r"\D", "", m[2].split("km")[0]))
    if left is None:
        return early
    return left >= km - 12 if early else left <= km + 12


# What a sentence says (regular expression), whether it is a statement of probability, and its test.
RULES: tuple[tuple[str, bool, Judge], ...] = (
    (rf"Written on {DAY}, last log {DAY}", False,
     lambda m, t: (day_of(m[1]), day_of(m[2])) == (t.today, int(t.last))),
    (rf"Unknown since {DAY}: no log for (\d+) days", False,
     lambda m, t: day_of(m[1]) == int(t.last) and int(m[2]) == t.today - int(t.last)),
    (r"no log for (\d+) days", False, lambda m, t: int(m[1]) == t.today - int(t.last)),
    (r"silent: last log of .* no log for (\d+) days", False,
     lambda m, t: int(m[1]) == t.today - int(t.last) > 45),
    (r"(?:\S )?(At the last log: healthy|Healthy)", False, lambda m, t: t.sound),
    (r"(?:\S )?(Loss of .*|Sudden change .*|A mode moved alone.*)", False,
     lambda m, t: verdict(m[1], t)),
    (r"(?:\S )?Alarm: unexplained change of (.*)", False,
     lambda m, t: all(abs(t.moved(x)) > 0.002 for x in re.findall("roll|pitch|yaw", m[1]))),
    (rf"Alarm since {DAY}: (\w+) has moved by ([-+][\d.]+) ± ([\d.]+) %", True,
     lambda m, t: abs(100 * t.moved(m[2]) - float(m[3])) < 2 * float(m[4]) + 0.1),
    (r"(\w+) has moved by .* alone", False,
     lambda m, t: t.unexplained and t.machine.foreign and m[1].lower() == "yaw"),
    (rf"At least half of it is there since the log of {DAY}", False,
     lambda m, t: t.machine.foreign and 0 <= day_of(m[1]) - FOREIGN < 31),
    (rf"(Guide preload|Mount stiffness):? .*?90 %[a-z :]*{INTERVAL}", True,
     lambda m, t: close(m[2], m[3], t.at(m[1].lower(), t.last))),
    (rf"(Guide preload|Mount stiffness): \d+ % {INTERVAL}", True,
     lambda m, t: close(m[2], m[3], t.at(m[1].lower(), t.last))),
    (r"(Early|Late) \(\d+ %\) (.*)", True, life),
    (r"Verdict: (?:still |.* → )(.*)", False, lambda m, t: verdict(m[1], t)),
    (rf"(?:Service: )?By {DAY}", True, lambda m, t: in_time(m[1], t)),
    (rf"(?:Service: )?Overdue since {DAY}", False,
     lambda m, t: day_of(m[1]) < t.today and t.ends() is not None),
    (rf"Order and plan .* before {DAY}", False, lambda m, t: in_time(m[1], t, needed=True)),
    (rf"Plan .* for {DAY} at the latest", True, lambda m, t: in_time(m[1], t)),
    (rf"Record .*order nothing yet.*before {DAY}", True, lambda m, t: in_time(m[1], t)),
    (r"No work is needed yet", False, lambda m, t: (t.ends() or 9e9) > t.today),
    (r"No service is needed within", False, lambda m, t: t.ends() is None),
    (r"(?:Service: )?No service needed yet", False, lambda m, t: (t.ends() or 9e9) > t.today),
    (r"Do .* now", False, lambda m, t: (t.ends() or 9e9) < t.today + 30),
    (r"(?:Service: )?Now$", False, lambda m, t: (t.ends() or 9e9) < t.today + 30),
    (r"Inspect guide and mount now", False, lambda m, t: t.sound is not True),
    (r"Find out what moved the mode", False, lambda m, t: t.unexplained),
    (r"Record a log now: without one", False, lambda m, t: t.today - t.last > 20),
    (r"State by NAMUR NE 107 on \S+ normal", False, lambda m, t: t.sound),
    (r"NORMAL$", False, lambda m, t: t.sound and t.today - t.last <= 45),
    (r"State by NAMUR NE 107 on \S+ failure|FAILURE$|.*limit-reached", False,
     lambda m, t: any(t.at(x, t.today) <= LIMITS[x] + EDGE for x in LIMITS)),
    (r"State by NAMUR NE 107 on \S+ out of spec|OFF_SPEC$", False,
     lambda m, t: t.unexplained or t.sound is False),
    (r"The baseline has changed", False, lambda m, t: t.base > 31),
    (r"(\d+) logs? more, ([\d ]+) km further", False,
     lambda m, t: int(m[1]) == len(t.logs) - len(Truth(t.machine, t.month - 1).logs)),
    (r"serious: verdict: .* → (.*)", False,
     lambda m, t: verdict({"outside-map": "alone", "step": "sudden"}.get(m[1], "loss of " + {
         "preload": "guide preload", "mount": "mount stiffness",
         "both": "guide preload and mount stiffness"}.get(m[1], "?")), t)),
    (r"note: verdict: .* → healthy|note: recovered: (?:preload|mount|both|step|outside).*healthy",
     False, lambda m, t: t.sound),
    (r"serious: alarm: +→ (\w+)", False, lambda m, t: abs(t.moved(m[1])) > 0.002),
    (rf"caution: service-due: +→ by {DAY}", True, lambda m, t: in_time(m[1], t)),
)  # fmt: skip


# Each true event: machine, what, its day, and the alert that announces it.
EVENTS = (
    *((name, "loss", LOST, "serious: verdict: .*→ (?:preload|mount|both)") for name in "ABCD"),
    *((name, "limit", LIMITS, "serious: limit-reached") for name in "ABC"),
    ("D", "repair entered", ENTERED, "note: recovered|note: verdict: .*→ (?:healthy|not)"),
    ("E", "silence", SILENT + 30, "caution: silent"),
    ("F", "foreign change", FOREIGN, "serious: (?:verdict|alarm)"),
)


def main() -> None:
    """Run the study; ``--quick`` has three machines for three months and records nothing."""
    study = Study(__file__, __doc__, keep="")
    names, months = ("AFG", 3) if study.quick else ("".join(name[0] for name in NAMES), MONTHS)
    rows = study.trials.once(played, names, months, SECONDS, study.options.keep)
    table, wrong = tabled(rows)
    totals = {kind: counts(own for own in table if own["odds"] is odds)
              for kind, odds in (("sentences", False), ("odds", True))}  # fmt: skip
    control = counts(tabled(rows, shift=len(FLEET) // 2)[0])
    events = [] if study.quick else list(announced(rows))
    alarms = Counter(f"{row['machine']}: {row['said'].split(':')[1].strip()}" for row in rows
                     if row["source"] == "alert" and NAMES[row["machine"]].role == "healthy"
                     and not row["said"].startswith("note"))  # fmt: skip
    true = totals["sentences"]
    passed = {
        "no sentence is false": true["false"] == 0,
        "odds are kept": totals["odds"]["false"] <= 0.1 * sum(totals["odds"].values()),
        "each event is announced once": all(event["alerts"] == 1 for event in events),
        "no alert of a healthy machine": not alarms,
        "by the truth of others many are false": control["false"] > 20 * max(true["false"], 1),
    }
    details = {"table": table, "false": wrong}
    answer = {"totals": totals, "control": control, "events": events, "alarms": dict(alarms),
              "passed": passed}  # fmt: skip
    study.conclude(answer, details=details, not_met=NOT_MET, quick_may_fail=True)


def judge(row: Row, shift: int = 0) -> tuple[bool, bool | None]:
    """Return whether what was said is a statement of probability, and whether it is true."""
    place = (list(NAMES).index(row["machine"]) + shift) % len(FLEET)
    truth = Truth(FLEET[place], row["month"])
    for pattern, odds, rule in RULES:
        if found := re.match(pattern, row["said"]):
            return odds, rule(found, truth)
    return False, None


def tabled(rows: list[Row], shift: int = 0) -> tuple[list[Row], list[str]]:
    """Return how often each sentence was said, true, false and not judged; the false ones."""
    found: dict[tuple[str, bool], Counter[str]] = defaultdict(Counter)
    wrong = []
    for row in rows:
        odds, true = judge(row, shift)
        word = {True: "true", False: "false", None: "not judged"}[true]
        found[pattern_of(row["said"]), odds][word] += 1
        if true is False:
            wrong.append(f"{row['machine']} {row['month']} {row['source']}: {row['said']}")
    table = [{"sentence": text, "odds": odds, "said": sum(own.values()), **own}
             for (text, odds), own in found.items()]  # fmt: skip
    return sorted(table, key=lambda own: -own["said"]), wrong


def pattern_of(said: str) -> str:
    """Return a sentence without its days, numbers, modes and parts."""
    said = re.sub(DAY + r"(?: \d\d:\d\d UTC)?", "DAY", said)
    said = re.sub(r"roll|pitch|yaw", "MODE", said, flags=re.I)
    said = re.sub(r"guide preload|mount stiffness", "PART", said, flags=re.I)
    said = re.sub(r"PART and PART", "PART", re.sub(r"\b[A-L]-Y\b", "NAME", said))
    return re.sub(r"[-+]?\d[\d. ]*\d|[-+]?\d", "N", said)


def counts(table: Any) -> dict[str, int]:
    """Sum a table."""
    total: Counter[str] = Counter({"true": 0, "false": 0, "not judged": 0})
    for own in table:
        total.update({key: own[key] for key in total.keys() & own.keys()})
    return dict(total)


def announced(rows: list[Row]) -> Iterator[Row]:
    """Yield each event with the count of its alerts, and the days from it to the first."""
    for letter, what, when, pattern in EVENTS:
        machine = NAMES[f"{letter}-Y"]
        if isinstance(when, dict):
            when = next(day for day in range(400) if any(
                machine.health(part, day, day) <= when[part] for part in LIMITS))  # fmt: skip
        told = [row["month"] for row in rows if row["machine"] == machine.name
                and row["source"] == "alert" and re.match(pattern, row["said"])]  # fmt: skip
        late = (run_day(told[0]) - BEGIN).days - when if told else None
        yield {"machine": machine.name, "event": what, "day": when, "alerts": len(told),
               "late_days": late}  # fmt: skip


def claims(record: Row) -> Iterator[Claim]:
    """Yield the claims of a record."""
    passed, totals = record["passed"], record["totals"]
    for kind, check, what in (
        ("sentences", "no sentence is false", "sentences of a year that are true, of those judged"),
        ("odds", "odds are kept", "intervals and days of services that hold"),
    ):
        own, beside = totals[kind], ""
        if kind == "sentences":
            other = record["control"]
            beside = (f"{own['not judged']:,} not judged; by the truth of others "
                      f"{other['false']:,} of {other['true'] + other['false']:,} false")  # fmt: skip
        yield counted(what, own["true"], own["true"] + own["false"], beside, met=passed[check])
    events = record["events"]
    late = [event["late_days"] for event in events if event["late_days"] is not None]
    once = sum(event["alerts"] == 1 for event in events)
    yield counted("events of machines that are announced once", once, len(events),
                  f"{min(late)} to {max(late)} days after they begin, runs a month apart",
                  met=passed["each event is announced once"])  # fmt: skip
    yield Claim("alerts of the six healthy machines", str(sum(record["alarms"].values())),
                met=passed["no alert of a healthy machine"])  # fmt: skip


if __name__ == "__main__":
    main()
