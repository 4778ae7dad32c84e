"""Accelerations at the modes of a log, and its spectral lines."""

from contextlib import suppress
from dataclasses import dataclass

from lmshealth.errors import BadLog
from lmshealth.io.log import Log, Refusal
from lmshealth.modal.targets import check_band
from lmshealth.signal.constants import LEVEL_BAND_RANGE
from lmshealth.signal.readings import Magnitude, choose_bands, read_magnitudes
from lmshealth.signal.segments import Part
from lmshealth.signal.spectral_lines import Line, find_lines_by_velocity
from lmshealth.stage.description import Stage


@dataclass(frozen=True, slots=True)
class Survey:
    """Accelerations and lines of one log."""

    log: str  # file name
    magnitudes: tuple[Magnitude, ...]  # channel by channel
    lines: tuple[Line, ...]  # in the bands and between them
    refused: tuple[Refusal, ...]  # channels that could not be used


def survey(
    log: Log, stage: Stage | None, band: tuple[float, float] | None, *, part: Part = "record"
) -> Survey:
    """Read accelerations and spectral lines of the accelerometers of a part of a log.

    Without a stage a grid of bands is read; ``band`` in Hz restricts modes, grid and lines.
    `BadLog` as `read_magnitudes` does.
    """
    check_band(log, band)
    accelerometers = [c for c in log.channels if c.kind == "acceleration"]
    identified: dict[str, float] | None = None
    if stage is not None and accelerometers:
        # Otherwise accelerations are read at the described frequencies.
        from lmshealth.modal.identification import identify  # late: only this needs it

        with suppress(BadLog):
            found = identify(log, stage, channels=[c.name for c in accelerometers])
            identified = dict(zip(found.names, found.frequency.tolist(), strict=True))
    bands = choose_bands(stage, identified, band)
    magnitudes = read_magnitudes(log, bands, part=part)
    widest = band or (
        min([LEVEL_BAND_RANGE[0], *(b.low for b in bands)]),
        max([LEVEL_BAND_RANGE[1], *(b.high for b in bands)]),
    )
    return Survey(
        log.name,
        magnitudes,
        find_lines_by_velocity(log, accelerometers, stage, widest, part=part),
        log.refused,
    )
