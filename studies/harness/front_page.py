"""Write the page of the front page's statements, each with its figure from the records."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

from studies.harness.claims import Claim, percents

_MOST = 8  # claims that are shown one by one


class Statement(NamedTuple):
    """A statement of README.md, and the claims that support it."""

    what: str
    study: str  # its folder or module under studies/
    claims: tuple[str, ...]  # how the claims begin that are its figure
    assumes: str
    fails: str
    each: str = "kinds"  # what each claim is of, where there are many
    pool: str = ""  # how the claim of several kinds together continues: it is no kind


_COURSES = "preload, all courses"  # of `studies.life.kinds.run`
STATEMENTS = (
    Statement(
        "natural frequencies of one log, with their uncertainty",
        "modes/identification", ("kinds of records", "coverage of 95 % intervals"),
        "a force that is stationary, Gaussian and white near a mode",
        "a hump in the force's spectrum up to three times as wide as a mode; one force through "
        "paths that differ by milliseconds",
    ),
    Statement(
        "the same where the force is not steady and white", "modes/single_logs",
        ("95 % intervals of f and ζ of single logs",), "forces of the eight kinds in the study",
        "beside a hump of the force intervals are too narrow",
    ),
    Statement(
        "modes of a machine that nobody described", "modes/without_description",
        ("modes found without a description",), "modes further apart than a half-power bandwidth",
        "closer modes may be merged; harmonics that wander may be named modes",
    ),
    Statement(
        "a description puts no wrong name on a mode", "modes/wrong_descriptions",
        ("logs with an incomplete",), "at most a mode missing, searches shifted by some percent",
        "a mode of another cause within a search, seen where the described one is not",
    ),
    Statement(
        "the servo's following error is a sensor of modes", "paper/three_methods",
        ("lms-y: methods that show",),
        "the simulated stage Y, without friction",
        "Δe never shows roll, which accelerometers and half of the responses do; with friction the "
        "response misses the eigenvalue, the other two do not",
    ),
    Statement(
        "alarms when modes drift", "track/drift", ("alarms, fast wear", "alarms, healthy"),
        "3 % within eight logs, three modes, 30 to 60 logs",
        "a temperature that no log states, two machines in one archive, a sensor that was changed; "
        "of healthy machines whose modes wander together by 0.3 to 0.4 % some alarm (row below)",
    ),
    Statement(
        "what reads as wear: a sensor that drifts, logs of two machines", "robustness/off_model",
        ("lives that alarm: control", "lives that alarm: sensor drifts", "lives that alarm: two",
         "lives that alarm: wander 3 sd, 5 logs, in common", "lives that alarm in"),
        "lives of 40 logs with known truth, of worlds without the estimator's laws",
        "lives that run in: their drifts are those since the second log",
    ),
    Statement(
        "remaining preload and stiffness, with uncertainty, by kind of life", "life/kinds",
        ("90 % intervals hold: ",), "the modal map is right to its stated error",
        "wear that is fast at first, slow wander of all modes at once, a crash in the last log",
        each="kinds and parameters", pool=_COURSES,
    ),
    Statement(
        "which part lost, or that none did", "life/kinds", ("verdicts that are right",),
        "causes move the modes in different proportions", "in X the mount moves no mode by itself",
        pool=_COURSES,
    ),
    Statement(
        "the distribution of the remaining life", "life/kinds",
        ("90 % intervals of the remaining life hold",),
        "no crash and no loosened bolt is still to come; nothing beyond the description's horizon",
        "wear that begins late or goes in steps: services come too late",
        pool=_COURSES,
    ),
    Statement(
        "the same where all that is not known is drawn from the description", "life/calibration",
        ("90 % intervals hold the truth: health now, remaining life and lone modes, posterior",),
        "lives of the program's own model", "machines that are not as the model: see the row above",
    ),
    Statement(
        "the chains of emcee and the draws of importance sampling between them are calibrated",
        "life/calibration",
        ("90 % intervals hold the truth: health now, remaining life and lone modes, by chains",),
        "lives of the program's own model", "40 lives show coarse faults only",
    ),
    Statement(
        "from modal estimates to the service date, of machines that differ from the map",
        "robustness/drawn_machines",
        ("health at the last log", "remaining life: 90 %", "services at a risk",
         "verdicts that are right", "drawn machines without health"),
        "estimates with recorded covariances; health and life are judged also where the program "
        "withholds them, as of most machines whose modes are off the shipped description",
        "a payload or a drift that no log states",
    ),
    Statement(
        "from raw samples to drifts and health, of machines that differ from the map",
        "robustness/off_model/raw", ("raw logs, nominal", "raw logs, drawn: ", "raw logs, healthy"),
        "closed-loop logs of 20 s, 16 a machine; the service date is judged in the row above only",
        "an amplitude dependence that grows, and a payload that no log states",
    ),
    Statement(
        "no verdict of what the data do not determine", "health/measured",
        ("changes beyond the description", "unchanged machines judged healthy"),
        "three measured sets, none of a stage or with a known preload; their days are ours",
        "a resonance in the search of a mode that has left it takes its name, and the verdict is "
        "`outside-map` while it does; so is that of a frame that nobody changed",
    ),
    Statement(
        "a change of a measured machine is estimated right", "health/measured",
        ("known changes inside",),
        "the place of a beam's support; the map is beam theory, and not fitted to the data",
        "beside the clamp, where the theory overstates the change by 16 %",
    ),
    Statement(
        "the smallest loss that can be detected", "health/detectability",
        ("smallest loss of",), "the map is exact and one parameter changes",
        "with the map's error, and another parameter free, the power is much lower",
    ),
    Statement(
        "sentences on pages and in alerts of a fleet are true",
        "life/year", ("sentences that are true",),
        "a simulated year of monthly runs", "sentences that need what no log states are not judged",
    ),
    Statement(
        "files are read right, or refused with the reason", "inputs/foreign_files",
        ("files of 16 formats", "drawn dialects that are read with wrong"),
        "files by independent writers, tables without a header of their own excluded",
        "some tables with one reading are refused, and ask for a column map",
    ),
    Statement(
        "a damaged log is listed, and the others are analysed", "inputs/damaged",
        ("damaged logs", "good logs"), "the kinds of damage in the study",
        "damage that leaves a file readable and its values plausible",
    ),
    Statement(
        "a new log costs a part of the first run", "cost/new_log",
        ("processor time after one new log",), "machines of the study, one processor",
        "a verdict that changes is computed anew",
    ),
    Statement(
        "size of an installation", "cost/installation", ("a plain installation",),
        "Linux, from the registry's wheels", "extras need more",
    ),
)  # fmt: skip


class Support(NamedTuple):
    """What a study claims, none where it is not recorded, its command, and where it is shown."""

    claims: Sequence[Claim]
    command: str
    address: str


def lines(studies: Mapping[str, Support]) -> Iterator[str]:
    """Return the table of the statements, of the studies by name."""
    yield "| statement | figure | command | assumes | where it fails |"
    yield "| --- | --- | --- | --- | --- |"
    for one in STATEMENTS:
        study = studies[one.study]
        found = [
            figure(study.claims, begin, one.each, one.pool) for begin in one.claims if study.claims
        ]
        command = f"[`{study.command}`]({study.address})"
        cells = one.what, "; ".join(found) or "not recorded", command, one.assumes, one.fails
        yield f"| {' | '.join(cells)} |"


def figure(claims: Sequence[Claim], begin: str, each: str = "kinds", pool: str = "") -> str:
    """Summarise the claims that begin so: each, or of many shares their range and the least.

    A claim that continues with ``pool`` is of several kinds together: it is beside the range.
    """
    own = [claim for claim in claims if claim.what.startswith(begin)]
    if not own:
        raise ValueError(f"no claim begins with {begin!r}")
    rest = {claim: claim.what.removeprefix(begin).strip(" :,") for claim in own}
    begin, pooled = begin.strip(" :,"), [x for x in own if pool and rest[x].startswith(pool)]
    if pool and not pooled:
        raise ValueError(f"no claim of {begin!r} is of {pool!r}")
    own = [claim for claim in own if claim not in pooled]
    shares = [claim.shares[0][0] for claim in own if claim.shares]
    if len(own) > _MOST and len(shares) == len(own):
        worst = own[shares.index(min(shares))]
        text = (
            f"{begin}: {percents(shares)} of {len(own)} {each}, least {rest[worst]} "
            f"({worst.figure}); {sum(not claim.met for claim in own)} not met"
        )
        together = [f"; {rest[x]}, together: {x.figure}{_mark(x)}" for x in pooled]
        return text + "".join(together)
    texts = [
        f"{rest[claim]}: {claim.figure}".removeprefix(": ")
        + (f" ({claim.interval})" if claim.interval and len(own) == 1 else "")
        + _mark(claim)
        for claim in (*own, *pooled)
    ]
    return f"{begin} {'; '.join(texts)}"


def _mark(claim: Claim) -> str:
    """Return what stands behind the figure of a claim that is not met."""
    return "" if claim.met else " **not met**"
