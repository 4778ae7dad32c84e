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
        ("95 % intervals of f and ζ of single logs hold",),
        "forces of the eight kinds in the study; at least 90 % are required",
        "beside a hump of the force, and where it grows within the log (ramp), intervals of ζ are "
        "too narrow (87 to 94 % of 289); ± is the scatter of right intervals",
    ),
    Statement(
        "modes of a machine that nobody described", "modes/without_description",
        ("modes found without a description",), "modes further apart than a half-power bandwidth",
        "closer modes may be merged; harmonics that wander may be named modes",
    ),
    Statement(
        "a description that is incomplete or shifted puts no wrong name on a mode without a "
        "warning", "modes/wrong_descriptions",
        ("logs with an incomplete", "description lacking, one shifted"),
        "at most a mode missing, searches shifted by some percent",
        "a resonance of another cause in the search of a mode that is not seen takes its name, "
        "without a warning in a single log (row of measured machines)",
    ),
    Statement(
        "with a right description every mode has its name", "modes/described",
        ("described modes named",), "descriptions as the machine is",
        "two modes 1 % apart may have each other's names; modes beside much stronger ones outside "
        "the band are refused",
    ),
    Statement(
        "the servo's following error is a sensor of modes", "paper/three_methods",
        ("lms-y: methods that show",),
        "the simulated stage Y, without friction",
        "Δe never shows roll, which accelerometers and half of the responses do; with friction "
        "intervals of the response miss the eigenvalue, by 0.002 % at 10 mm/s and 0.4 % at 1 mm/s; "
        "those of the other two are hundreds of times as wide at 10 mm/s; the mean of the "
        "accelerometers is 0.19 ± 0.06 Hz off there, so that up to 0.3 Hz (0.2 %) is not excluded",
    ),
    Statement(
        "alarms when modes drift", "track/drift", ("alarms, fast wear", "alarms, healthy"),
        "3 % within eight logs, three modes, 30 to 60 logs",
        "where stated errors are four times too small, next to no loss of 5 % is found; lives that "
        "wander, or whose temperature lags, and slow losses alarm less often (rows below)",
    ),
    Statement(
        "losses that are found, by what else the machine does", "robustness/off_model",
        ("lives that alarm: control, losing", "lives that alarm: wander 0.5 sd, 5 logs, losing",
         "lives that alarm: lag 8 h, losing", "lives that alarm: scatter 4, losing",
         "lives that alarm: bathtub", "lives that alarm: shocks"),
        "lives of 40 logs with known truth; frequencies follow the preload by the shipped map",
        "stated errors four times too small (scatter 4); losses by shocks (1 to 28 %), or fast at "
        "first (bathtub, 4 to 13 %), though most are larger than 5 %",
    ),
    Statement(
        "what reads as wear: a sensor that drifts, logs of two machines", "robustness/off_model",
        ("lives that alarm: sensor drifts", "lives that alarm: two",
         "lives that alarm: wander 3 sd, 12 logs",
         "lives that alarm: wander 3 sd, 5 logs, in common",
         "lives that alarm: amplitude", "lives that alarm: lag 24 h", "lives that alarm: outliers",
         "lives that alarm: running-in", "lives that alarm in"),
        "the same lives without a loss; the share of all worlds is without the first two",
        "all that are not met; of slow wander (12 logs) too few drifts are held; where a machine "
        "runs in, drifts are judged since the second log",
    ),
    Statement(
        "remaining preload and stiffness, with uncertainty, by kind of life", "life/kinds",
        ("90 % intervals hold: ",),
        "the modal map is right to its stated error; posterior by importance sampling, not by "
        "chains; without machines that stay, where nearly all draws are the baseline",
        "wear that is fast at first, slow wander of all modes at once, a crash in the last log; of "
        "half of the kinds intervals are more than 1.15 times as wide as those of an estimator "
        "that knows the course",
        each="kinds and parameters", pool=_COURSES,
    ),
    Statement(
        "which part lost, or that none did", "life/kinds", ("verdicts that are right",),
        "causes move the modes in different proportions; a loss below a quarter of that at the "
        "limit counts as none, lives within 5 % of this are left out; `step`, which names no part, "
        "is right where the loss was sudden", "in X the mount moves no mode by itself",
        pool=_COURSES,
    ),
    Statement(
        "the distribution of the remaining life", "life/kinds",
        ("90 % intervals of the remaining life hold", "services that come before the limit"),
        "no crash and no loosened bolt is still to come; nothing beyond the description's horizon; "
        "importance sampling, not chains",
        "wear that sets in after a while (onset) or goes in steps; at 90 % of the life half of "
        "the kinds have a median width of more than 1.2 times what is left, onset of 112 times",
        pool=_COURSES,
    ),
    Statement(
        "the same where all that is not known is drawn from the description", "life/calibration",
        ("90 % intervals hold the truth: health now, remaining life and lone modes, posterior",),
        "lives of the program's own model", "machines that are not as the model: see the row above",
    ),
    Statement(
        "no coarse fault of the chains of emcee is found (the row above is of the draws of "
        "importance sampling between them)",
        "life/calibration",
        ("90 % intervals hold the truth: health now, remaining life and lone modes, by chains",),
        "lives of the program's own model", "40 lives show coarse faults only",
    ),
    Statement(
        "from modal estimates to the service date, of machines that differ from the map",
        "robustness/drawn_machines",
        ("health at the last log: 90 % intervals hold the truth",
         "remaining life: 90 % intervals hold the truth", "services at a risk",
         "machines that never reach a limit", "verdicts that are right",
         "drawn machines without health", "nominal machines that alarm, life payload-not-logged"),
        "estimates with recorded covariances; importance sampling, not chains; health and life are "
        "judged also where the program withholds them, as of most machines whose modes are off the "
        "shipped description; of the 100 machines 81 fail, so that 0 of 81 services are late (at "
        "most 4.5 %)",
        "a payload or a drift that no log states; machines that would never fail are sent to "
        "service as well; of 50 verdicts with more than 95 % one is wrong",
    ),
    Statement(
        "from raw samples to drifts and health, of machines that differ from the map",
        "robustness/off_model/raw", tuple(f"raw logs, {world}: drifts" for world in (
            "nominal machines", "healthy", "thermal-lag", "payload-not-logged", "amplitude-growth",
            "drawn")),
        "closed-loop logs of 20 s, 16 a machine; frequencies of the new machine entered in its "
        "description; the service date is judged in the row above only",
        "an amplitude dependence that grows: one machine of 12 is surely worn and wrong; a payload "
        "that no log states alarms in all machines, also the five sound ones, and holds health in "
        "13 of 16; in the other worlds health is held in 91 of 94",
    ),
    Statement(
        "no verdict of what the data do not determine", "health/measured",
        ("changes beyond the description", "unchanged machines judged healthy"),
        "three measured sets, none of a stage or with a known preload; their days are ours; the "
        "frame was at hand when the program was corrected for it; of one change the map ends "
        "before it, of another the logs are refused, and the last verdict is withheld after five "
        "intervals without a log that could be used",
        "where logs of the new state are refused, the last result stays that of the old state; "
        "a frame that nobody changed is `outside-map`",
    ),
    Statement(
        "a change of a measured machine is estimated right", "health/measured",
        ("known changes inside",),
        "the place of one beam's support, whose distance from the clamp is taken from another set "
        "of the same testbed; the map is beam theory, and not fitted to the data; neighbouring "
        "changes share logs",
        "beside the clamp, where the theory overstates the change by 16 %",
    ),
    Statement(
        "the smallest loss that can be detected", "health/detectability",
        ("smallest loss of", "power in Y"),
        "the map is exact, one parameter changes, and errors are at the Cramér-Rao bound, which "
        "identification exceeds by a tenth to a half; no threshold of the verdict",
        "with the map's error, and another parameter free: the last figure",
    ),
    Statement(
        "sentences on pages and in alerts of a fleet are true",
        "life/year", ("sentences that are true",),
        "a simulated year of monthly runs of twelve machines of the map; five of six sentences "
        "state no fact that can be judged (probabilities, what no log states)",
        "the false ones stop two of four wearing machines more than a month early; sentences "
        "repeat, so that the interval is too narrow",
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
        "a new log costs 0.6 to 0.9 of the first run", "cost/new_log",
        ("processor time after one new log", "growth of that time"),
        "machines of the study, one processor", "grows with the history",
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
            f"{begin}: {percents(shares)} of {len(own)} {each}, least {rest[worst]}: "
            f"{_shown(worst)}; {sum(not claim.met for claim in own)} not met"
        )
        together = [f"; {rest[x]}, together: {_shown(x)}{_mark(x)}" for x in pooled]
        return text + "".join(together)
    texts = [f"{rest[x]}: {_shown(x)}{_mark(x)}".removeprefix(": ") for x in (*own, *pooled)]
    return f"{begin} {'; '.join(texts)}"


def _shown(claim: Claim) -> str:
    """Return the figure of a claim with its interval, if it has one."""
    return ", ".join(filter(None, (claim.figure, claim.interval)))


def _mark(claim: Claim) -> str:
    """Return what stands behind the figure of a claim that is not met."""
    return "" if claim.met else " **not met**"
