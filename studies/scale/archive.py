"""Archives of any number of short logs: each another file, none dearer to analyse than another."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np

from studies.faults.logfiles import DESCRIPTION, Archive, log_of, recordings, write

LOGS_PER_MACHINE, SECONDS = 100, 10.0
_N_BASES = 8


def make_archive(folder: Path, n_logs: int, *, longer: bool = False) -> None:
    """Write a stage description and so many logs of machines that do not age.

    Parameters
    ----------
    folder : Path
        Gets ``stage.toml`` and ``logs``.
    n_logs : int
        A hundred to a machine.
    longer : bool
        Whether the later half is three times as long, which must be seen.
    """
    (folder / "stage.toml").write_text(DESCRIPTION.replace("damaged-?-Y", "many-*-Y"))
    archive = Archive(folder / "logs")
    n_bases = min(_N_BASES, -(-n_logs // 2))
    bases = recordings(n_bases, SECONDS)
    if longer:
        bases += recordings(n_bases, 3 * SECONDS)
    for k in range(n_logs):
        machine, own = divmod(k, LOGS_PER_MACHINE)
        late = n_bases if longer and k >= n_logs // 2 else 0
        log = log_of(bases[late + k % n_bases], 0, np.random.default_rng([20261122, k]))
        moment = datetime(2026, 1, 1, tzinfo=UTC) + timedelta(hours=own)
        log.metadata["stage"] = f"many-{machine:04d}-Y"
        log.metadata["recorded_at"] = moment.isoformat()
        log.metadata["travel_km"] = f"{0.5 * own:g}"
        write(archive, archive.folder / f"{machine:04d}" / f"{own:03d}.h5", log)
