"""How other programs are called: each with settings that suit these records.

Settings were chosen by their errors on twelve records of other seeds, with the truth known, from a
small grid: decimation by 1 or 2, block rows 8 to 60, segments of 512 to 8192 samples, both
estimates of spectra, bands of 4 to 10 Hz about a mode, windows and blocks of VarPLSCF. Moves are
concatenated: where a program averages over segments or blocks these are the moves themselves. The
"covariance" in the results of pyOMA2 is a standard deviation.

``python -m studies.modes_peers.peers TOOL CASE`` prints the peak memory of a call in MB.
"""

from __future__ import annotations

import io
import json
import logging
import sys
import warnings
from collections.abc import Callable
from contextlib import redirect_stdout
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from lmshealth import identify
from lmshealth.errors import BadLog
from lmshealth.io.log import Log
from studies.common.cost import memory_bytes
from studies.identification.cases import CASES, Case
from studies.identification.records import RATE, Array, accelerations, describe

# pyOMA2 silences numpy's warnings for the whole process when it is imported.
with np.errstate(), warnings.catch_warnings():
    warnings.simplefilter("ignore")
    from pyOMA.core.PreProcessingTools import PreProcessSignals
    from pyOMA.core.VarPLSCF import VarPLSCF
    from pyoma2.algorithms import EFDD, FDD, FSDD, SSI, pLSCF
    from pyoma2.setup import SingleSetup

# Poles may be as they like, the truth chooses among them.
_ANY = {"xi_max": 0.1, "mpc_lim": None, "mpd_lim": None, "CoV_max": None}
_BLOCKS, _ORDER = 50, 14
# A pole further from every mode than this share of its frequency is none of them.
_FAR = 0.05
_PERCENT = 100
_SHORT = 6.0  # s of the record before memory is measured


@dataclass(frozen=True)
class Tool:
    """A program, and what of it is compared."""

    name: str
    # Of a log and its case: ``[f, ζ, std f, std ζ]`` of all poles of all orders, in Hz, shape
    # ``(n_orders, n_poles, 4)``; NaN where it does not say
    poles: Callable[[Log, Case], Array]
    slow: bool = False  # Whether the quick form leaves it out

    def __call__(self, log: Log, case: Case) -> Array:
        """Call the program without its messages; nothing found where it raises."""
        with warnings.catch_warnings(), redirect_stdout(io.StringIO()):
            warnings.simplefilter("ignore")
            logging.disable(logging.CRITICAL)
            try:
                return self.poles(log, case)
            except (BadLog, ValueError, IndexError, np.linalg.LinAlgError):
                return np.full((1, 1, 4), np.nan)
            finally:
                logging.disable(logging.NOTSET)


def nearest(poles: Array, case: Case) -> Array:
    """Choose the poles nearest to the truth, order by order; NaN where there is none near."""
    taken = np.full((len(poles), len(case.modes), 4), np.nan)
    for j, mode in enumerate(case.modes):
        zeta = np.where(np.isfinite(poles[..., 1]), poles[..., 1], mode.damping)
        # In the complex plane; damping is small.
        off = np.hypot(poles[..., 0] - mode.frequency, zeta * poles[..., 0] - mode.bandwidth / 2)
        off = np.where(off < _FAR * mode.frequency, off, np.inf)
        best = off.argmin(axis=1)
        found = np.isfinite(off.min(axis=1))
        taken[found, j] = poles[np.arange(len(poles)), best][found]
    return taken


def _ours(log: Log, case: Case) -> Array:
    modes = identify(log, describe(case.modes))
    f, zeta = modes.frequency, modes.damping_ratio
    return np.stack([f, zeta, modes.frequency_std, modes.damping_ratio_std], axis=-1)[None]


def _samples(log: Log) -> Array:
    """Join the samples of all moves, shape ``(n_samples, n_channels)``."""
    values = np.stack([channel.values[:] for channel in log.channels], axis=1)
    return np.concatenate([values[start:stop] for start, stop in log.pieces])


def _run(log: Log, algorithm: Any, decimation: int = 1) -> Any:
    setup = SingleSetup(_samples(log), fs=RATE)
    if decimation > 1:
        setup.decimate_data(q=decimation)
    setup.add_algorithms(algorithm)
    setup.run_by_name(algorithm.name)
    return algorithm.result


def _pole_table(result: Any) -> Array:
    f = result.Fn_poles
    stds = [getattr(result, name, None) for name in ("Fn_poles_std", "Xi_poles_std")]
    table = [f, result.Xi_poles, *(np.full_like(f, np.nan) if s is None else s for s in stds)]
    return np.swapaxes(np.stack(table, axis=-1), 0, 1)


def _ssi(log: Log, case: Case, *, method: str, intervals: bool = True) -> Array:
    # Decimation would carry each move into the next.
    decimation, rows = (2, 12) if method == "cov" and case.moves == 1 else (1, 15)
    rows = 20 if method == "dat" else rows
    algorithm = SSI(name="ssi", method=method, br=rows, ordmax=_ORDER, calc_unc=intervals,
                    nb=case.moves if case.moves > 1 else _BLOCKS, hc=_ANY)  # fmt: skip
    return _pole_table(_run(log, algorithm, decimation))


def _plscf(log: Log, case: Case) -> Array:
    # Correlations of half a segment: a move is half of one.
    length, decimation = (4096, 2) if case.moves == 1 else (round(2 * case.seconds * RATE), 1)
    algorithm = pLSCF(name="plscf", ordmax=8, nxseg=length, method_SD="cor", hc=_ANY)
    return _pole_table(_run(log, algorithm, decimation))


def _decomposed(log: Log, case: Case, *, kind: Any, **options: float) -> Array:
    length, overlap = (1024, 0.5) if case.moves == 1 else (round(case.seconds * RATE), 0.0)
    algorithm = kind(name="fdd", nxseg=length, method_SD="per", pov=overlap)
    _run(log, algorithm)
    algorithm.mpe(sel_freq=[mode.frequency for mode in case.modes], **options)
    f = np.asarray(algorithm.result.Fn)
    nothing = np.full_like(f, np.nan)
    zeta = nothing if kind is FDD else np.asarray(algorithm.result.Xi)
    return np.stack([f, zeta, nothing, nothing], axis=-1)[None]


def _var_plscf(log: Log, case: Case) -> Array:
    blocks = case.moves if case.moves > 1 else 30
    model = VarPLSCF(PreProcessSignals(_samples(log), RATE))
    model.build_half_spectra(401, 0.0, RATE / 2, window_decay=0.01, num_blocks=blocks)
    model.compute_modal_params(8, modal_contrib=False)
    zeta, std = model.modal_damping / _PERCENT, model.std_damping / _PERCENT
    return np.stack([model.modal_frequencies, zeta, model.std_frequencies, std], axis=-1)


OURS = "lmshealth"
TOOLS = (
    Tool(OURS, _ours),
    Tool("SSI-cov", lambda log, case: _ssi(log, case, method="cov")),
    Tool("SSI-cov, no intervals",
         lambda log, case: _ssi(log, case, method="cov", intervals=False)),
    Tool("SSI-dat", lambda log, case: _ssi(log, case, method="dat"), slow=True),
    Tool("FDD", lambda log, case: _decomposed(log, case, kind=FDD, DF=1.0)),
    Tool("EFDD", lambda log, case: _decomposed(log, case, kind=EFDD, DF1=2.0, DF2=5.0)),
    Tool("FSDD", lambda log, case: _decomposed(log, case, kind=FSDD, DF1=2.0, DF2=7.0)),
    Tool("pLSCF", _plscf),
    Tool("VarPLSCF", _var_plscf),
)  # fmt: skip


def main() -> None:
    """Call the tool for a short record, whose imports do not count, and then for the record."""
    tool = next(tool for tool in TOOLS if tool.name == sys.argv[1])
    case, rng = CASES[int(sys.argv[2])], np.random.default_rng(0)
    log = case.make(rng, case.modes, case.noise)
    short = replace(case, moves=1, make=partial(accelerations, seconds=_SHORT, moves=1))
    tool(short.make(rng, short.modes, short.noise), short)
    before = memory_bytes("VmRSS")
    Path("/proc/self/clear_refs").write_text("5")  # forgets the peak so far
    tool(log, case)
    print(json.dumps((memory_bytes() - before) / 2**20))


if __name__ == "__main__":
    main()
