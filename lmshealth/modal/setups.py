"""Measurements of several set-ups of one machine, merged to one estimate per mode.

Where a machine has more positions than sensors, some sensors stay (the references) and the others
rove. Each set-up shows a part of a mode's shape, on a scale of its own.
"""

import hashlib
import re
from collections.abc import Sequence
from dataclasses import replace
from itertools import chain

import numpy as np

from lmshealth._private.arrays import BoolArray, FloatArray
from lmshealth.errors import NotEnoughData
from lmshealth.modal import constants
from lmshealth.modal.log_estimates import LogEstimates
from lmshealth.modal.mode_shapes import ModeShapes
from lmshealth.modal.modes import Modes, merge, paired
from lmshealth.modal.naming import assurance

# Set-ups and rows of the estimates of one mode.
_Group = list[tuple[int, int]]
# Channels, and shapes over them, ``(n_modes, n_channels)``.
_Shapes = tuple[tuple[str, ...], np.ndarray]


def merge_setups(setups: Sequence[LogEstimates]) -> LogEstimates:
    r"""Merge the modes of several set-ups of one machine.

    Estimates are of one mode if their frequencies differ by less than 2 % and their shapes agree
    over the common channels (MAC of 0.8); estimates with different names of a description are of
    two. Frequencies and dampings are averaged by generalised least squares; where they scatter by
    more than they state, their covariance is widened by the factor ``set-ups``. Shapes are merged
    by least squares over all set-ups [Au2011b].

    Parameters
    ----------
    setups : sequence of LogEstimates
        At least two; each has a channel in common with another one, so that all are connected. A
        channel has the same name wherever its sensor has the same place.

    Returns
    -------
    LogEstimates
        Modes with shapes over all channels, NaN in those of set-ups that do not show the mode. The
        flag ``loose-shape`` marks modes that the common channels hardly show: these have no shape.

    Raises
    ------
    NotEnoughData
        If there is one set-up only, or no channel connects two groups of them; if two are the same
        log, or they are of several machines.

    Examples
    --------
    A sensor stays on the base, another one moves from the left to the right:

    >>> import numpy as np
    >>> import lmshealth
    >>> from scipy.signal import lfilter
    >>> rng, pole = np.random.default_rng(1), 0.99 * np.exp(0.4j)
    >>> setups = []
    >>> for place, size in (("left", 2.0), ("right", -1.0)):
    ...     motion = lfilter([1], np.poly([pole, pole.conj()]).real, rng.standard_normal(60_000))
    ...     both = np.outer(motion, [1.0, size]) + rng.standard_normal((60_000, 2))
    ...     columns = f"acc_base_m_s2,acc_{place}_m_s2"
    ...     head = f"# sample_rate_hz: 1000\n# stage: M\n# travel_km: 1\n{columns}"
    ...     np.savetxt(f"{place}.csv", both, header=head, comments="", delimiter=",")
    ...     log = lmshealth.read_log(f"{place}.csv")
    ...     modes = lmshealth.identify(log, band=(40.0, 90.0))
    ...     setups.append(lmshealth.LogEstimates(log.name, log.digest, log.metadata, modes))
    >>> merged = lmshealth.merge_setups(setups).modes
    >>> merged.shape_channels, (merged.shapes / merged.shapes[:, :1]).round(1).tolist()
    (('acc_base', 'acc_left', 'acc_right'), [[1.0, 2.0, -1.0]])
    """
    modes = [one.modes for one in setups]
    channels = tuple(dict.fromkeys(chain.from_iterable(one.shape_channels for one in modes)))
    _expect_connected(setups)
    groups = _same_modes(modes)
    joined = _joined(modes, groups, channels)
    shapes, parts = None, [(one.shapes.channels, one.shapes.shapes) for one in setups if one.shapes]
    if len(parts) == len(setups):
        merged = _merged_shapes(parts, groups, channels)
        shapes = ModeShapes(joined.names, channels, merged / _largest(merged))
    names = " + ".join(one.log for one in setups)
    digest = hashlib.sha256("".join(one.digest for one in setups).encode()).hexdigest()
    return LogEstimates(names, digest, setups[0].metadata, joined, shapes=shapes)


def _expect_connected(setups: Sequence[LogEstimates]) -> None:
    """Require different logs of one machine, connected by common channels."""
    from scipy.sparse.csgraph import connected_components  # late: reading a result needs none of it

    machines = sorted({one.metadata.stage or "" for one in setups})
    if len(machines) > 1:
        raise NotEnoughData(
            f"set-ups are of {len(machines)} machines: {', '.join(machines)}; needed is one"
        )
    if len({one.digest for one in setups}) < len(setups):
        names = ", ".join(one.log for one in setups)
        raise NotEnoughData(f"of the set-ups {names} two are the same log: name each once")
    channels = [set(one.modes.shape_channels) for one in setups]
    shared = np.array([[bool(one & other) for other in channels] for one in channels])
    n_groups = connected_components(shared, directed=False)[0] if setups else 0
    if len(setups) < 2 or n_groups > 1:
        named = [(one.log, ", ".join(one.modes.shape_channels)) for one in setups]
        parts = "; ".join(f"{log}: {names or 'no mode shape'}" for log, names in named)
        raise NotEnoughData(
            "set-ups with mode shapes are merged by the channels that they share; found are "
            f"{parts}; needed are two or more, each with a channel of another one; keep a sensor "
            "at its place and its name in all set-ups"
        )


def _same_modes(setups: Sequence[Modes]) -> list[_Group]:
    """Return the estimates of each mode, ascending in frequency, of a mode the clearest first."""
    from scipy.optimize import linear_sum_assignment  # late: reading a result needs none of it

    groups: list[_Group] = []
    for s, one in enumerate(setups):
        distance = np.zeros((len(one.names), len(groups)))
        for j, group in enumerate(groups):
            off = [np.abs(one.ln_frequency - setups[t].ln_frequency[i]) for t, i in group]
            same = [_may_be_same(one, setups[t], i) for t, i in group]
            near = np.logical_and.reduce(same) & (off[0] < constants.SETUP_LN_F)
            distance[:, j] = np.where(near, off[0], np.inf)
        far = 2 * len(groups) * constants.SETUP_LN_F + 1
        rows, columns = linear_sum_assignment(np.minimum(distance, far))
        matched = {
            int(r): int(c) for r, c in zip(rows, columns, strict=True) if distance[r, c] < np.inf
        }
        for row in range(len(one.names)):
            if row in matched:
                groups[matched[row]].append((s, row))
            else:
                groups.append([(s, row)])
    # The clearest estimate comes first, and the lowest mode.
    clear = [sorted(group, key=lambda at: -setups[at[0]].snr[at[1]]) for group in groups]
    return sorted(clear, key=lambda group: float(setups[group[0][0]].ln_frequency[group[0][1]]))


def _may_be_same(one: Modes, other: Modes, i: int) -> BoolArray:
    """Return which modes may be mode i of another set-up, by names and shapes: ``(n_modes,)``."""
    common = [name for name in one.shape_channels if name in other.shape_channels]
    own, before = (
        part.shapes[:, [part.shape_channels.index(name) for name in common]]
        for part in (one, other)
    )
    alike = ~(assurance(own, before[[i]])[:, 0] < constants.SETUP_MAC)
    # Numbers are no names.
    named = [
        not (_described(name) and _described(other.names[i])) or name == other.names[i]
        for name in one.names
    ]
    return np.asarray(alike & np.array(named, dtype=bool))


def _described(name: str) -> bool:
    return re.fullmatch(r"(mode_\d+)?", name) is None


def _joined(setups: Sequence[Modes], groups: list[_Group], channels: tuple[str, ...]) -> Modes:
    """Return one estimate per group; what is not averaged is of its clearest set-up."""
    parts: list[Modes] = []
    for k, group in enumerate(groups):
        names = [setups[t].names[j] for t, j in group]
        name = next((own for own in names if _described(own)), f"mode_{k + 1}")
        # Of two resonances with one name the higher one is numbered: which is right is open.
        name = f"mode_{k + 1}" if any(part.names == (name,) for part in parts) else name
        s, i = group[0]
        parts.append(replace(setups[s].select([i]), names=(name,)))
    refused = [row for one in setups for row in one.refused]
    joined = merge(parts, (), refused, channels)
    estimate, cov, factor = _averaged(setups, groups)
    n = len(groups)
    shapes = _merged_shapes([(one.shape_channels, one.shapes) for one in setups], groups, channels)
    loose = np.isnan(shapes).all(axis=1).tolist()
    flags = [f"{own} loose-shape".strip() if lost else own
             for own, lost in zip(joined.flags, loose, strict=True)]  # fmt: skip
    joined = replace(
        joined,
        ln_frequency=estimate[:n],
        ln_damping=estimate[n:],
        cov=cov,
        shapes=shapes * np.sign(_largest(shapes)),
        flags=tuple(flags),
    )
    return joined.widened("set-ups", factor * cov) if factor > 1 else joined


def _averaged(
    setups: Sequence[Modes], groups: list[_Group]
) -> tuple[FloatArray, FloatArray, float]:
    """Average estimates by generalised least squares.

    Returned are ``[ln f, ln ζ]``, ``(2 n_groups,)``, its covariance, and the factor by which the
    set-ups scatter more than they state; 1 where that may be chance.
    """
    from scipy.stats import chi2

    n = len(groups)
    information, weighted = np.zeros((2 * n, 2 * n)), np.zeros(2 * n)
    parts = []
    for s, one in enumerate(setups):
        pairs = [(g, i) for g, group in enumerate(groups) for t, i in group if t == s]
        places, rows = (paired(side, m) for side, m in zip(
            zip(*pairs, strict=True) if pairs else ((), ()), (n, len(one.names)), strict=True
        ))  # fmt: skip
        precision = np.linalg.inv(one.cov[np.ix_(rows, rows)])
        information[np.ix_(places, places)] += precision
        weighted[places] += precision @ one.estimate[rows]
        parts.append((places, one.estimate[rows], precision))
    cov: FloatArray = np.asarray(np.linalg.inv(information))
    estimate = cov @ weighted
    off = [(own - estimate[places], precision) for places, own, precision in parts]
    scatter = sum(float(r @ precision @ r) for r, precision in off)
    freedom = sum(r.size for r, _ in off) - 2 * n
    chance = float(chi2.sf(scatter, freedom)) if freedom else 1.0
    return estimate, cov, scatter / freedom if chance < constants.SETUP_P_VALUE else 1.0


def _largest(shapes: np.ndarray) -> np.ndarray:
    """Return the largest component of each shape, ``(n, 1)``; 1 where there is none."""
    at = np.nan_to_num(np.abs(shapes)).argmax(axis=1)[:, None]
    return np.asarray(np.nan_to_num(np.take_along_axis(shapes, at, axis=1), nan=1.0))


def _merged_shapes(
    parts: Sequence[_Shapes],
    groups: list[_Group],
    channels: tuple[str, ...],
) -> np.ndarray:
    """Merge the shapes of each group, of given channels, to unit norm: ``(n_groups, n_channels)``.

    The least squares of what no scale of the parts explains: the smallest eigenvector of the sum of
    the projections off each part. NaN where the scales are not determined.
    """
    found = np.full((len(groups), len(channels)), np.nan, dtype=parts[0][1].dtype)
    for own, group in zip(found, groups, strict=True):
        total = np.zeros((len(channels), len(channels)), dtype=found.dtype)
        shown = np.zeros(len(channels), dtype=bool)
        for s, i in group:
            names, shapes = parts[s]
            seen = np.flatnonzero(np.isfinite(shapes[i]))
            at = [channels.index(names[c]) for c in seen]
            shown[at] = True
            part = shapes[i, seen] / np.linalg.norm(shapes[i, seen])
            total[np.ix_(at, at)] += np.eye(len(at)) - np.outer(part, part.conj())
        known = np.flatnonzero(shown)
        if not known.size:
            continue
        values, vectors = np.linalg.eigh(total[np.ix_(known, known)])
        if known.size == 1 or values[1] - values[0] > constants.SETUP_EIGENVALUE:
            own[known] = vectors[:, 0]
    return found
