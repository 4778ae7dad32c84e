"""Everything that is identified in one log."""

from dataclasses import dataclass

from lmshealth.io.log import Metadata
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
