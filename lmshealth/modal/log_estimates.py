"""Everything that is identified in one log."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lmshealth.io.log import Metadata, Refusal
from lmshealth.modal.mode_shapes import ModeShapes
from lmshealth.modal.modes import Modes
from lmshealth.modal.spectra_summary import SpectraSummary


@dataclass(frozen=True, slots=True, eq=False)
class LogEstimates:
    r"""Modal estimates of one log, with its metadata.

    Attributes
    ----------
    log, digest : str
        Name of the log, and SHA-256 of its content.
    metadata : Metadata
        With identity of the machine, moment and odometer.
    modes : Modes
        The estimates.
    loop_error : float or None
        RMS of the following error from 1 to 40 Hz in m; None where unknown.
    spectra : SpectraSummary or None
        Spectrum of each channel with the fit of the modes, for plots; None if it was not kept.
    shapes : ModeShapes or None
        Complex shapes of the modes, for plots; None if they were not kept.
    sample_rate : float or None
        Of the log in Hz; None where unknown, which compares it with no other.

    Examples
    --------
    A log of noise has no mode:

    >>> import numpy as np
    >>> import lmshealth
    >>> noise = np.random.default_rng(1).standard_normal(20_000)
    >>> head = "# sample_rate_hz: 1000\n# stage: AX-3-Y\n# travel_km: 12.5\nacc_pitch_m_s2"
    >>> np.savetxt("log.csv", noise, header=head, comments="")
    >>> log = lmshealth.read_log("log.csv")
    >>> modes = lmshealth.identify(log, lmshealth.load_stage("lms-y"))
    >>> estimates = lmshealth.LogEstimates(log.name, log.digest, log.metadata, modes)
    >>> estimates.metadata.stage, estimates.metadata.travel, estimates.modes.names
    ('AX-3-Y', 12500.0, ())
    >>> [(refusal.mode, refusal.reason) for refusal in estimates.modes.refused]
    [('roll', 'not-excited'), ('pitch', 'not-excited'), ('yaw', 'not-excited')]
    """

    log: str
    digest: str
    metadata: Metadata
    modes: Modes
    loop_error: float | None = None
    spectra: SpectraSummary | None = None
    shapes: ModeShapes | None = None
    sample_rate: float | None = None


# Estimates of one recording that was stored in two forms agree to this part of their standard
# deviations; those of two recordings do once in 180 for each number, and that at one moment.
_EQUAL = 0.01


def without_copies(
    logs: Sequence[LogEstimates],
) -> tuple[list[LogEstimates], list[Refusal]]:
    """Return logs of which no two are one recording, and the refusals of the others.

    Another format, attribute or rounding makes another file of a recording. It is of one machine,
    moment and odometer, and has equal estimates: a day without a time may have several logs.
    """
    kept, refused = list[LogEstimates](), list[Refusal]()
    by_moment: dict[object, list[LogEstimates]] = {}
    for log in logs:
        own = log.metadata
        before = by_moment.setdefault((own.stage, own.recorded_at, own.travel), [])
        first = next((one for one in before if _are_equal(one.modes, log.modes)), None)
        if first is None or own.recorded_at is None:
            kept.append(log)
            before.append(log)
            continue
        detail = f"same recording as {first.log}, which is analysed for both"
        refused.append(Refusal(log.log, "duplicate", detail, machine=own.stage or ""))
    return kept, refused


def _are_equal(one: Modes, other: Modes) -> bool:
    if not one.names or one.names != other.names:
        return False
    off = np.abs(one.estimate - other.estimate)
    return bool((off <= _EQUAL * np.sqrt(np.diag(one.cov))).all())
