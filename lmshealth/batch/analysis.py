"""Analysis of one machine from its logs in one call."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path

from lmshealth.batch.constants import NO_LOSS
from lmshealth.errors import BadLog, NotEnoughData
from lmshealth.io.column_map import ColumnsGiven, column_map
from lmshealth.io.log import Log, Notice, Refusal
from lmshealth.io.manifest import (
    NOT_LOGS,
    Manifest,
    copy_error,
    find_logs,
    read_manifest,
    read_manifest_beside,
)
from lmshealth.io.reading import read_log
from lmshealth.machine.assessment import Assessment, assess, expect_settings
from lmshealth.modal.identification import identify
from lmshealth.modal.log_estimates import LogEstimates, without_copies
from lmshealth.signal.readings import loop_error
from lmshealth.stage.description import Stage, expect_stage, why_unmatched
from lmshealth.tracking.maintenance import (
    Maintenance,
    baseline_notices,
    read_maintenance,
    read_maintenance_beside,
    without_logs,
)


def analyse(
    logs: str | Path | Iterable[str | Path | Log],
    stage: Stage,
    *,
    columns: ColumnsGiven | None = None,
    latest: datetime | None = None,
    epochs: int = 40,
    seed: int = 0,
) -> Assessment:
    """Read and identify the logs of one machine, and infer its health and remaining life.

    Parameters
    ----------
    logs : path, or iterable of paths or logs
        A folder with its ``manifest.csv`` and ``maintenance.csv``, or files, with those beside
        each, or results of `read_log`.
    stage : Stage
        Description of the machine; a log that it does not match is refused.
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
    BadStage
        If the stage is no result of `load_stage`.
    NotEnoughData
        If no log can be used, or they are of several machines.

    Examples
    --------
    >>> import lmshealth
    >>> lmshealth.analyse([], lmshealth.load_stage("lms-y"))
    Traceback (most recent call last):
    lmshealth.errors.NotEnoughData: no log can be used: none is given
    """
    expect_stage(stage)
    expect_settings(epochs, seed)
    used, given = column_map(columns), _given(logs, latest)
    refused, found = [*given.refused], list[LogEstimates]()
    seen: dict[str, tuple[str, dict[str, str]]] = {}
    for one in given.logs:
        overrides, is_declared, log = dict[str, str](), False, one
        try:
            if isinstance(log, Path):
                manifest = given.manifests[log]
                is_declared, overrides = manifest.is_baseline(log), manifest.overrides(log)
                log = read_log(log, columns=used, overrides=overrides, latest=latest)
            if log.digest in seen:
                raise copy_error(log.name, overrides, *seen[log.digest])
            seen[log.digest] = log.name, overrides
            found.append(_estimates(log, stage))
        except BadLog as error:
            machine = log.metadata.stage if isinstance(log, Log) else overrides.get("stage")
            refusal = Refusal(error.log, error.reason, error.detail, baseline=is_declared)
            refused.append(replace(refusal, machine=machine or ""))
    found, copies = without_copies(found)
    refused += copies
    if not found:
        why = "; ".join(f"{one.log}: {one.detail}" for one in refused[:3]) or "none is given"
        raise NotEnoughData(f"no log can be used: {why}")
    made = assess(found, stage, work=given.work, epochs=epochs, seed=seed)
    return _with_refusals(made, refused, given.work)


@dataclass(frozen=True, slots=True, eq=False)
class _Given:
    """Logs to analyse, of copies first that in a manifest, and what their folders state."""

    logs: list[Path | Log]
    manifests: dict[Path, Manifest]  # of each path
    work: Maintenance
    refused: tuple[Refusal, ...] = ()  # files that are no logs, and rows of manifests


def _given(logs: str | Path | Iterable[str | Path | Log], latest: datetime | None) -> _Given:
    """Find the logs of a folder, or take those that are given, with the tables beside them."""
    given: list[Path | Log]
    if isinstance(logs, str | Path):
        folder = Path(logs)
        manifest, work = read_manifest(folder), read_maintenance(folder, latest=latest)
        listed = find_logs(folder, manifest=manifest)
        given, refused = [*listed.logs], (*listed.refused, *manifest.refused)
        manifests = dict.fromkeys(listed.logs, manifest)
    else:
        given, refused = [one if isinstance(one, Log) else Path(one) for one in logs], ()
        paths = [one for one in given if isinstance(one, Path)]
        beside = {path.parent: path for path in paths}
        of_folder = {folder: read_manifest_beside(path) for folder, path in beside.items()}
        manifests = {path: of_folder[path.parent] for path in paths}
        work = read_maintenance_beside(paths, latest)

    def is_unlisted(one: Path | Log) -> bool:
        return isinstance(one, Path) and not manifests[one].names(one)

    # Of several copies the first is analysed; only one in a manifest has its metadata.
    return _Given(sorted(given, key=is_unlisted), manifests, work, refused)


def _estimates(log: Log, stage: Stage) -> LogEstimates:
    """Identify the modes of a log; `BadLog` where the description is that of another machine."""
    stated = log.metadata.stage or log.metadata.description
    if stated is not None and not stage.matches(log.metadata):
        raise BadLog(log.name, "no-stage", why_unmatched(log.metadata, [stage]))
    own = log.name, log.digest, log.metadata, identify(log, stage), loop_error(log)
    return LogEstimates(*own, sample_rate=log.sample_rate)


def _with_refusals(made: Assessment, refused: Sequence[Refusal], work: Maintenance) -> Assessment:
    """Add refusals of logs and rows, and notices of those that concern the machine."""
    machine = made.history.stage
    mine = [one for one in refused if one.machine in ("", machine)]
    notices = [*made.notices, *baseline_notices(mine, made.history.logs[made.history.baseline])]
    unused = without_logs(work.actions, [machine])
    notices += [Notice("maintenance-unused", "caution", "maintenance.csv", one) for one in unused]
    of_logs = (one for one in mine if Path(one.log).name not in NOT_LOGS)
    lost = tuple(one for one in of_logs if one.reason not in NO_LOSS)
    return replace(made, lost=lost, refused=(*refused, *made.refused), notices=tuple(notices))
