"""The modes of one machine as they become known, log by log."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace

import numpy as np

from lmshealth._arrays import FloatArray
from lmshealth.tracking.association.estimates import Table
from lmshealth.tracking.association.hypotheses import (
    Hypotheses,
    Scan,
    explain,
    normalised,
    reduce_hypotheses,
)
from lmshealth.tracking.association.mode_filters import Bank, IntArray, Readings
from lmshealth.tracking.association.track_initiation import Newcomers

# Posterior probability from which on a label is given.
SURE = 0.95
# Inside the first, in standard deviations, an estimate is its mode's if no other mode is inside
# the second, and its shape has at least the MAC.
_NEAR, _FAR = 4.0, 12.0
_SAME_SHAPE = 0.8
# Filters that catch up need no more logs than these: older ones have no pull any more.
_MEMORY = 64


@dataclass(frozen=True, slots=True, eq=False)
class Log:
    """A log as far as it matters who is who.

    Attributes
    ----------
    epoch : int
        Its number.
    clock, scale : float
        Its place and the length of a life, on the clock.
    offsets : ndarray
        Its covariates, shape ``(n_covariates,)``.
    opened : bool
        Whether frequencies may have stepped before it.
    names, sources : tuple of str
        Of its estimates.
    """

    epoch: int
    clock: float
    scale: float
    offsets: FloatArray
    opened: bool
    names: tuple[str, ...]
    sources: tuple[str, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Verdict:
    """What became of the estimates of a scan.

    Attributes
    ----------
    scan : Scan
        The estimates.
    modes : list of int
        Mode of each, -1 for none.
    chances : ndarray
        Probability of each mode known before, last of none, ``(n, m + 1)``; empty where all was
        plain.
    expected : ndarray
        Where ln f of each mode was expected, ``(m,)``.
    jumps : tuple of int
        Estimates that are of the mode that their name means, far from where it was, or of none.
    """

    scan: Scan
    modes: list[int]
    chances: FloatArray
    expected: FloatArray
    jumps: tuple[int, ...] = ()


class Identities:
    """Modes known so far, under all hypotheses, and what may become one.

    Parameters
    ----------
    prior_std : ndarray
        Of the covariates' coefficients, shape ``(n_covariates,)``.
    n_channels : int
        Channels of shapes.

    Attributes
    ----------
    names : list of str
        Of the modes, in the order in which they were found.
    first : list of float
        Their first ln f.
    settled : bool
        Whether there is one hypothesis, nothing else to watch, and modes are in order.
    """

    def __init__(self, prior_std: FloatArray, n_channels: int) -> None:
        self.names: list[str] = []
        self.first: list[float] = []
        self._prior_std = prior_std
        self._shaped = n_channels > 1
        # Modes that names mean, ascending in first frequency.
        self._order = np.empty(0, dtype=int)
        bank = Bank.empty(prior_std.size, n_channels)
        self._now = Hypotheses(bank, normalised(np.zeros((1, 2))), np.empty((1, 0), dtype=int))
        self._new = Newcomers(prior_std.size, n_channels)
        self._groups: dict[tuple[tuple[str, ...], ...], list[tuple[IntArray, IntArray]]] = {}
        self._deferred: deque[tuple[Log, Readings]] = deque(maxlen=_MEMORY)
        self._clock: float | None = None
        self._scale = 0.0
        self._row = np.empty(0)
        self.settled = False

    def see(self, log: Log, table: Table) -> list[Verdict]:
        """Take in a log, source by source.

        Parameters
        ----------
        log : Log
            The log, none before it to follow.
        table : Table
            Holds its estimates.
        """
        self._catch_up()
        self._move(log)
        readings = table.readings(log.epoch)
        verdicts: list[Verdict] = []
        gone: set[int] = set()
        back: set[int] = set()
        for g in range(len(self._grouped(log))):
            rows, meant = self._grouped(log)[g]
            own = readings if rows.size == len(log.names) else readings.pick(rows)
            scan = Scan(log.epoch, rows, meant, own, self._row)
            verdict = None if log.opened else self._plain(scan)
            if verdict is None:
                verdict = self._weigh(scan, log, gone)
            back.update(mode for mode in verdict.modes if mode >= 0)
            verdicts.append(verdict)
        if self._new:
            self._new.forget(log.epoch, gone, back)
        self.settled = len(self._now.bank.mean) == 1 and not self._new and self._in_order()
        return verdicts

    def defer(self, log: Log, table: Table) -> None:
        """Take a log at its names while there is one hypothesis; filters follow when needed."""
        self._deferred.append((log, table.readings(log.epoch)))

    def _catch_up(self) -> None:
        for log, readings in self._deferred:
            self._move(log)
            for rows, meant in self._grouped(log):
                own = readings if rows.size == len(log.names) else readings.pick(rows)
                self._now.bank.absorb((np.zeros_like(meant), meant), own, self._row)
        self._deferred.clear()

    def _move(self, log: Log) -> None:
        step = log.clock - self._clock if self._clock is not None else 0.0
        self._clock, self._scale = log.clock, log.scale
        self._row = np.concatenate([(1.0, 0.0), log.offsets])
        self._now.bank.predict(step, log.scale, opened=log.opened)
        if self._new:
            self._new.bank.predict(step, log.scale, opened=log.opened)

    def _in_order(self) -> bool:
        """Tell whether names by order and by mode are the same."""
        at = self._now.bank.seen(self._row)[0][0, self._order]
        return bool((np.diff(at) > 0).all())

    def _grouped(self, log: Log) -> list[tuple[IntArray, IntArray]]:
        """Rows of each source, and which modes their names mean."""
        names, sources = log.names, log.sources
        if (names, sources) not in self._groups:
            index = {name: i for i, name in enumerate(self.names)}
            unknown = len(self.names)
            meant = np.array([index.get(n, unknown) if n else -1 for n in names], dtype=int)
            each = [np.flatnonzero(np.array(sources) == s) for s in dict.fromkeys(sources)]
            self._groups[names, sources] = [(rows, meant[rows]) for rows in each]
        return self._groups[names, sources]

    def _plain(self, scan: Scan) -> Verdict | None:
        """Take a scan that has one explanation; None where it may have others."""
        bank, new = self._now.bank, scan.readings
        if len(bank.mean) > 1 or not bank.n_modes:
            return None
        at, var = (side[0] for side in bank.seen(scan.row))
        squared = (new.ln_f[:, None] - at) ** 2 / (new.var_f[:, None] + var)
        rows, modes = np.nonzero(squared < _FAR**2)
        if rows.size != scan.rows.size or np.unique(modes).size < rows.size:
            return None
        if (rows != np.arange(rows.size)).any() or (squared[rows, modes] > _NEAR**2).any():
            return None
        named = scan.names >= 0
        # Names by order and by mode must be the same.
        if named.any() and not (
            np.array_equal(scan.names[named], modes[named]) and (np.diff(at[self._order]) > 0).all()
        ):
            return None
        if not self._is_usual(modes, new):
            return None
        bank.absorb((np.zeros_like(modes), modes), new, scan.row)
        return Verdict(scan, modes.tolist(), np.empty((0, 0)), at)

    def _is_usual(self, modes: IntArray, new: Readings) -> bool:
        """Tell whether dampings and shapes are those of the modes."""
        bank = self._now.bank
        off = (new.ln_zeta - bank.ln_zeta[0, modes]) ** 2
        if (off > _NEAR**2 * (new.var_zeta + bank.var_zeta[0, modes])).any():
            return False
        if not self._shaped:
            return True
        mac = np.nansum(new.shapes * bank.shapes[0, modes], axis=-1) ** 2
        return bool((mac > _SAME_SHAPE).all())

    def _weigh(self, scan: Scan, log: Log, gone: set[int]) -> Verdict:
        """Follow all explanations of a scan and choose labels that are sure."""
        expected = self._now.bank.seen(scan.row)[0][0]
        grown = explain(self._now, scan, self._order, opened=log.opened)
        self._now = reduce_hypotheses(grown)
        m = len(self.names)
        chances = grown.chances(m)
        best = np.where(chances.argmax(1) < m, chances.argmax(1), -1)
        modes = np.where(chances.max(1) >= SURE, best, -1).tolist()
        jumps = [i for i in range(len(modes)) if modes[i] < 0 and _is_jump(i, scan, chances, best)]
        for i in np.flatnonzero(chances[:, -1] > 0.5).tolist():
            name = log.names[scan.rows[i]]
            if name and name not in self.names:
                modes[i] = self._found(scan.readings.pick(np.array([i])), name)
        lone = [i for i, mode in enumerate(modes) if mode < 0 and chances[i, -1] > 0.5]
        left = np.array(sorted({*lone, *jumps}), dtype=int)
        meant = np.where(np.isin(left, jumps), scan.names[left], -1)
        rest = Scan(scan.epoch, scan.rows[left], meant, scan.readings.pick(left), scan.row)
        confirmed = self._new.watch(rest, self._prior_std, self._scale)
        for i, j in zip(left.tolist(), confirmed, strict=True):
            if j is not None:
                modes[i] = self._confirm(j)
                gone.add(j)
        return Verdict(scan, modes, chances, expected, tuple(jumps))

    def _found(self, reading: Readings, name: str) -> int:
        """Begin a mode at the first estimate that has its name."""
        bank = self._now.bank.found(reading, self._row, self._prior_std, self._scale)
        self._now = replace(self._now, bank=bank)
        mode = self._enrol(name, float(reading.ln_f[0]))
        by_first = np.argsort([self.first[i] for i in (*self._order, mode)], kind="stable")
        self._order = np.append(self._order, mode)[by_first]
        return mode

    def _confirm(self, j: int) -> int:
        """Make a newcomer a mode, or the new level of the mode that it is named after."""
        new = self._new.bank.keep(np.array([j]))
        mode = self._new.name(j)
        bank = self._now.bank
        if mode >= 0:
            bank.mean[:, mode], bank.cov[:, mode] = new.mean[0, 0], new.cov[0, 0]
            bank.ln_zeta[:, mode], bank.var_zeta[:, mode] = new.ln_zeta[0, 0], new.var_zeta[0, 0]
            return mode
        self._now = replace(self._now, bank=bank.join(new))
        ln_f = float(new.seen(self._row)[0][0, 0])
        return self._enrol(self._unique(float(np.exp(ln_f))), ln_f)

    def _enrol(self, name: str, ln_f: float) -> int:
        self.names.append(name)
        self.first.append(ln_f)
        self._groups.clear()
        return len(self.names) - 1

    def _unique(self, frequency: float) -> str:
        """Name a mode by its frequency, with as many digits as tell it from others."""
        for digits in range(6):
            name = f"{frequency:.{digits}f}_hz"
            if name not in self.names:
                return name
        return f"{name[:-3]}_{len(self.names)}_hz"


def _is_jump(i: int, scan: Scan, chances: FloatArray, best: IntArray) -> bool:
    """Tell whether an estimate is of the mode that its name means or of none.

    A name whose mode is seen elsewhere in the log tells nothing.
    """
    own = int(scan.names[i])
    if not 0 <= own < chances.shape[1] - 1 or own in np.delete(best, i):
        return False
    return bool(chances[i, own] + chances[i, -1] >= SURE)
