"""Analysis of one machine from its logs in one call."""

from collections.abc import Iterable
from dataclasses import replace
from datetime import datetime
from pathlib import Path

from lmshealth.errors import BadLog, NotEnoughData
from lmshealth.io.column_map import ColumnMap
from lmshealth.io.log import Refusal
from lmshealth.io.manifest import find_logs, read_manifest, read_manifest_beside
from lmshealth.io.reading import read_log
from lmshealth.machine.assessment import Assessment, assess
from lmshealth.modal.identification import identify
from lmshealth.modal.log_estimates import LogEstimates
from lmshealth.signal.following_error import loop_error
from lmshealth.stage.description import Stage
from lmshealth.tracking.maintenance import NO_MAINTENANCE, read_maintenance


def analyse(
    logs: str | Path | Iterable[str | Path],
    stage: Stage,
    *,
    columns: ColumnMap | None = None,
    latest: datetime | None = None,
    epochs: int = 40,
    seed: int = 0,
) -> Assessment:
    """Read and identify the logs of one machine, and infer its health and remaining life.

    Parameters
    ----------
    logs : path, or iterable of paths
        A folder with its ``manifest.csv`` and ``maintenance.csv``, or files, with the manifest
        beside each.
    stage : Stage
        Description of the machine.
    columns, latest
        As of `read_log`.
    epochs, seed : int
        As of `assess`.

    Returns
    -------
    Assessment
        With ``history``, ``track``, ``health``, ``prognosis``, ``judgement`` and ``refused``; a
        result that the data do not support is None, with the reason among the notices.

    Raises
    ------
    NotEnoughData
        If no log can be used.

    Examples
    --------
    >>> import lmshealth
    >>> lmshealth.analyse([], lmshealth.load_stage("lms-y"))
    Traceback (most recent call last):
    lmshealth.errors.NotEnoughData: no log can be used: none is given
    """
    work, refused, found = NO_MAINTENANCE, list[Refusal](), list[LogEstimates]()
    if isinstance(logs, str | Path):
        folder = Path(logs)
        manifest, work = read_manifest(folder), read_maintenance(folder, latest=latest)
        listed = find_logs(folder, manifest=manifest)
        paths = [*listed.logs]
        refused += [*listed.refused, *manifest.refused]
        manifests = dict.fromkeys(paths, manifest)
    else:
        paths = [*map(Path, logs)]
        manifests = {path: read_manifest_beside(path) for path in paths}
    for path in paths:
        try:
            overrides = manifests[path].overrides(path)
            log = read_log(path, columns=columns, overrides=overrides, latest=latest)
            modes = identify(log, stage)
            own = log.name, log.digest, log.metadata, modes, loop_error(log)
            found.append(LogEstimates(*own, sample_rate=log.sample_rate))
        except BadLog as error:
            refused.append(Refusal(str(path), error.reason, error.detail))
    if not found:
        why = "; ".join(f"{one.log}: {one.detail}" for one in refused[:3]) or "none is given"
        raise NotEnoughData(f"no log can be used: {why}")
    made = assess(found, stage, work=work, epochs=epochs, seed=seed)
    return replace(made, refused=(*refused, *made.refused))
