"""Is every sentence true that the pages and alerts of a fleet say in a year of monthly runs?

Method
    Twelve simulated stages Y, two logs of 6 s a month: three wear (preload, mount, both), one wears
    and is repaired, which is entered 25 days later, one has no log after half a year, of one yaw
    moves alone by 2 %, six are sound (of these with an unheated hall, payloads, regreasing, tuning).
    `run --today` on the first of each month over the growing archive, lives by importance sampling,
    without pictures. First screen, notices, changes, row of the fleet page, status and rows of
    changes.csv are split into sentences, and those that a rule knows are judged by the machine's
    truth on that day. Odds, which may be false as often as they say, are counted apart: intervals,
    their ends, days of an accepted risk. A loss within 3 % of the bound of the verdict is not
    judged. Control, which must fail: the same by the truth of the machine six places on.
Run time
    A quarter of an hour on one processor.
"""

from __future__ import annotations

import re
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from datetime import date
from functools import cached_property
from math import inf
from typing import Any

from models.lives.circumstances import KM_PER_DAY
from studies.harness.claims import Claim, counted
from studies.harness.study import Row, Study
from studies.life.year.fleet import (
    BEGIN, ENTERED, FLEET, FOREIGN, LIMITS, REPAIR, SILENT, Machine, played, run_day,
)  # fmt: skip

MONTHS, SECONDS, EDGE, HORIZON_DAYS, SILENT_DAYS, NEVER = 12, 6.0, 0.03, 1666, 45, inf
LOST = {part: 1 - 0.25 * (1 - limit) for part, limit in LIMITS.items()}
NAMES = {machine.name: machine for machine in FLEET}
NOT_MET: dict[str, str] = {}
_DAY = r"(\d{4}-\d\d-\d\d)"
_RANGE = r"(\d+)(?: %)? to (\d+) %"
_NE = r"State by NAMUR NE 107 on \S+ "


@dataclass(frozen=True)
class Truth:
    """What is true of a machine at the last log before a run."""

    machine: Machine
    month: int

    @cached_property
    def logs(self) -> list[float]:
        return [day for day in self.machine.days() if day < run_day(self.month)]

    @cached_property
    def base(self) -> float:
        """Return the day of the first log of the baseline: after entered work on a part."""
        work = [day for day, action, entered in self.machine.works()
                if entered < run_day(self.month) and action == "preload-adjust"]  # fmt: skip
        return next(day for day in self.machine.days() if day > max(work, default=-1.0))

    def at(self, part: str, day: float) -> float:
        """Return a part's health over that at the baseline, as without later work."""
        own = self.machine.health(part, day, max(self.logs[-1], self.base))
        return own / self.machine.health(part, self.base, self.base)

    @cached_property
    def end(self) -> float:
        """Return the day on which the first limit is reached."""
        days = range(int(self.base), int(self.logs[-1]) + HORIZON_DAYS)
        return next((d for d in days if any(self.at(x, d) <= LIMITS[x] for x in LIMITS)), NEVER)

    def lost(self, part: str) -> bool | None:
        now = self.at(part, self.logs[-1])
        return None if abs(now - LOST[part]) < EDGE else now < LOST[part]

    def lone(self, mode: str = "yaw") -> bool:
        """Return whether a mode moved alone since the baseline."""
        foreign = self.machine.role == "foreign" and self.base < FOREIGN <= self.logs[-1]
        return foreign and mode.lower() == "yaw"

    @property
    def unexplained(self) -> bool:
        """Return whether the modes moved by what is neither wear nor entered."""
        repaired = self.machine.role == "repaired" and self.base < REPAIR <= self.logs[-1]
        return self.lone() or repaired

    def moved(self, mode: str) -> float:
        """Return by how many percent a mode moved since the baseline."""
        return 100 * (self.machine.ln_f(self.logs[-1])[mode] - self.machine.ln_f(self.base)[mode])

    @property
    def sound(self) -> bool | None:
        lost = [self.lost(part) for part in LIMITS]
        return False if self.unexplained or True in lost else None if None in lost else True

    def verdict(self, text: str) -> bool | None:
        """Judge a verdict in words, or that of a table."""
        if "ealthy" in text:
            return self.sound
        if re.search("oss of|preload$|mount$|both$", text):
            told = [x for x in LIMITS if x.split()[x[0] == "g"] in text or "both" in text]
            return all(self.lost(x) is not (x not in told) for x in LIMITS)
        alone, step = re.search("alone|outside", text), re.search("udden|step", text)
        return self.lone() if alone else self.unexplained if step else None

    def remains(self, which: str, text: str) -> bool:
        """Judge an end of the 90 % interval of the remaining life."""
        left = KM_PER_DAY * (self.end - self.logs[-1])
        told = re.sub(r"\D", "", text.split("km")[0])
        km = NEVER if "beyond" in text else 0.0 if "passed" in text else float(told)
        return left >= min(km, 20_000) - 12 if which == "Early" else left <= km + 12


def at(day: str) -> int:
    return (date.fromisoformat(day) - BEGIN).days


# What a sentence says (regular expression), whether it states odds, and its test.
RULES: tuple[tuple[str, bool, Callable[[Any, Truth], bool | None]], ...] = (
    (f"Written on {_DAY}, last log {_DAY}", False,
     lambda m, t: (at(m[1]), at(m[2])) == (run_day(t.month), int(t.logs[-1]))),
    (f"Unknown since {_DAY}: no log for", False, lambda m, t: at(m[1]) == int(t.logs[-1])),
    (r".*no log for (\d+) days", False,
     lambda m, t: int(m[1]) == run_day(t.month) - int(t.logs[-1])),
    (r"(?:Verdict: )?(?:. )?(At the last log: healthy|Healthy|Loss of.*|Sudden change.*|A mode "
     r"moved alone.*)", False, lambda m, t: t.verdict(m[1])),
    (r"Verdict: (?:still |.* → )(.*)", False, lambda m, t: t.verdict(m[1])),
    (r"(?:serious|note): (?:verdict|recovered): .* → (.*)", False, lambda m, t: t.verdict(m[1])),
    (r"(?:Verdict: )?(?:. )?Alarm: unexplained|serious: alarm: ", False,
     lambda m, t: all(abs(t.moved(x)) > 0.2 for x in re.findall("roll|pitch|yaw", m.string))),
    (r"Alarm since \S+: (\w+) has moved by (\S+) ± (\S+) %", True,
     lambda m, t: abs(t.moved(m[1]) - float(m[2])) < 1.645 * float(m[3])),
    (r"(?:<?strong>?)?(\w+) has moved by .* alone", False, lambda m, t: t.lone(m[1])),
    (f"At least half of it is there since the log of {_DAY}", False,
     lambda m, t: t.lone() and 0 <= at(m[1]) - FOREIGN < 31),
    (f"(Guide preload|Mount stiffness)(?:: \\d+ %| .*90 %: | .*interval|: .*90 %: |: .*interval) *"
     f"{_RANGE}", True,
     lambda m, t: int(m[2]) - 0.5 <= 100 * t.at(m[1].lower(), t.logs[-1]) <= int(m[3]) + 0.5),
    (r"(Early|Late) \(\d+ %\) (.*)", True, lambda m, t: t.remains(m[1], m[2])),
    (f"(?:Service: )?By {_DAY}|caution: service-due: +→ by {_DAY}", True,
     lambda m, t: at(m[1] or m[2]) <= t.end),
    (f"(?:Plan|Record .*order nothing yet).* {_DAY}", True, lambda m, t: at(m[1]) <= t.end),
    (f"(?:Service: )?Overdue since {_DAY}", False,
     lambda m, t: at(m[1]) < run_day(t.month) and t.end < NEVER),
    ("Order and plan", False, lambda m, t: t.end < NEVER),
    ("No work is needed yet|(?:Service: )?No service needed yet", False,
     lambda m, t: t.end > run_day(t.month)),
    ("No service is needed within", False, lambda m, t: t.end == NEVER),
    ("Do .* now|(?:Service: )?Now$", False, lambda m, t: t.end < run_day(t.month) + 31),
    ("Inspect guide and mount now", False, lambda m, t: t.sound is not True),
    ("Find out what moved the mode", False, lambda m, t: t.unexplained),
    ("Record a log now: without one", False, lambda m, t: run_day(t.month) - t.logs[-1] > 20),
    (_NE + "normal|NORMAL$", False, lambda m, t: t.sound),
    (_NE + "failure|FAILURE$|serious: limit-reached", False, lambda m, t: any(
        t.at(x, run_day(t.month)) <= LIMITS[x] + EDGE for x in LIMITS)),
    (_NE + "out of spec|OFF_SPEC$", False, lambda m, t: t.sound is not True),
    ("The baseline has changed", False, lambda m, t: t.base > 31),
    ("(\\d+) logs? more", False, lambda m, t: int(m[1]) == len(t.logs) - len(
        Truth(t.machine, t.month - 1).logs)),
)  # fmt: skip

# True events: machine, what, its day or the bounds that health falls below, its alert.
EVENTS: tuple[tuple[str, str, Any, str], ...] = (
    *((name, "loss", LOST, "serious: verdict: .*→ (?:preload|mount|both)") for name in "ABCD"),
    *((name, "limit", LIMITS, "serious: limit-reached") for name in "ABC"),
    ("D", "repair, entered", ENTERED, "note: (?:recovered|verdict): .*→ (?:healthy|not)"),
    ("E", "silence", SILENT + SILENT_DAYS - 15, "caution: silent"),
    ("F", "lone mode", FOREIGN, "serious: (?:verdict|alarm)"),
)


def main() -> None:
    """Run the study; ``--quick`` has three machines for three months and records nothing."""
    study = Study(__file__, __doc__, keep="")
    names, months = ("AFG", 3) if study.quick else ("".join(name[0] for name in NAMES), MONTHS)
    rows = study.trials.once(played, names, months, SECONDS, study.options.keep)
    table, wrong = tabled(rows)
    sentences, odds = (total(own for own in table if own["odds"] is kind) for kind in (False, True))
    control = total(own for own in tabled(rows, len(FLEET) // 2)[0] if not own["odds"])
    events = [] if study.quick else [announced(rows, *event) for event in EVENTS]
    alarms = Counter(row["said"].split(":")[1].strip() for row in rows if row["source"] == "alert"
                     and NAMES[row["machine"]].role == "healthy")  # fmt: skip
    passed = {
        "no sentence is false": not sentences["false"],
        "odds hold": odds["false"] <= 0.1 * (odds["true"] + odds["false"]),
        "each event is announced once": all(event["alerts"] == 1 for event in events),
        "no alert of a healthy machine": not alarms,
        "false by the truth of others": control["false"] > 10 * max(sentences["false"], 1),
    }
    answer = {"sentences": sentences, "odds": odds, "control": control, "events": events}
    answer |= {"alarms": dict(alarms), "passed": passed}
    details = {"table": table, "false": wrong}
    study.conclude(answer, details=details, not_met=NOT_MET, quick_may_fail=True)


def tabled(rows: list[Row], shift: int = 0) -> tuple[list[Row], list[str]]:
    """Return how often each sentence was said, and was true, false or not judged; false ones."""
    found: dict[tuple[str, bool], Counter[str]] = defaultdict(Counter)
    wrong, names = [], list(NAMES)
    for row in rows:
        said = row["said"]
        truth = Truth(FLEET[(names.index(row["machine"]) + shift) % len(FLEET)], row["month"])
        rules = ((odds, rule(m, truth)) for pattern, odds, rule in RULES
                 if (m := re.match(pattern, said)))  # fmt: skip
        odds, true = next(rules, (False, None))
        word = {True: "true", False: "false", None: "not judged"}[true]
        found[pattern_of(said), odds].update(["said", word])
        wrong += [f"{row['machine']} {row['month']} {row['source']}: {said}"] * (true is False)
    table = [{"sentence": text, "odds": odds, **own} for (text, odds), own in found.items()]
    return sorted(table, key=lambda own: -own["said"]), wrong


def pattern_of(said: str) -> str:
    """Return a sentence without its days, numbers, modes and parts."""
    for pattern, word in ((_DAY + r"( \d\d:\d\d UTC)?", "DAY"), ("(?i:roll|pitch|yaw)", "MODE"),
                          ("(?i:guide preload|mount stiffness)", "PART"), ("[A-L]-Y", "NAME"),
                          ("PART and PART", "PART"), (r"[-+]?\d([\d. ]*\d)?", "N")):  # fmt: skip
        said = re.sub(pattern, word, said)
    return said


def total(table: Iterator[Row]) -> Counter[str]:
    """Sum a table."""
    found: Counter[str] = Counter({"true": 0, "false": 0, "not judged": 0})
    for own in table:
        found.update({key: own.get(key, 0) for key in found})
    return found


def announced(rows: list[Row], letter: str, what: str, when: Any, pattern: str) -> Row:
    """Return an event with its day, the count of its alerts, and the days to the first."""
    name = f"{letter}-Y"
    if isinstance(when, dict):
        when = next(day for day in range(400) if any(
            NAMES[name].health(part, day, day) <= when[part] for part in LIMITS))  # fmt: skip
    told = [run_day(row["month"]) for row in rows if row["machine"] == name
            and row["source"] == "alert" and re.match(pattern, row["said"])]  # fmt: skip
    late = told[0] - when if told else None
    return {"machine": name, "event": what, "day": when, "alerts": len(told), "late_days": late}


def claims(record: Row) -> Iterator[Claim]:
    """Yield the claims of a record."""
    passed, own, odds, other = (record[x] for x in ("passed", "sentences", "odds", "control"))
    beside = (f"{own['not judged']:,} not judged; by the truth of others {other['false']:,} of "
              f"{other['true'] + other['false']:,} are false")  # fmt: skip
    yield counted("sentences of a year that are true, of those judged", own["true"],
                  own["true"] + own["false"], beside, met=passed["no sentence is false"])  # fmt: skip
    yield counted("intervals, their ends, and days of services that hold", odds["true"],
                  odds["true"] + odds["false"], met=passed["odds hold"])  # fmt: skip
    late = [event["late_days"] for event in record["events"] if event["late_days"] is not None]
    yield counted("events that are announced once", sum(event["alerts"] == 1 for event in
                  record["events"]), len(record["events"]), f"{min(late)} to {max(late)} days after "
                  "their begin, runs a month apart", met=passed["each event is announced once"])  # fmt: skip
    kinds = ", ".join(f"{n} {what}" for what, n in record["alarms"].items())
    yield Claim("alerts of the six healthy machines", str(sum(record["alarms"].values())),
                beside=kinds, met=passed["no alert of a healthy machine"])  # fmt: skip


if __name__ == "__main__":
    main()
