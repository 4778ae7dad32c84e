"""How other programs search a band, with settings that a user can choose without the truth.

The record is decimated to the lowest rate above 2.5 times the top of the band, displacements are
differentiated twice and channels scaled to unit variance. SSI reaches order 40 (60 of pyOMA2 and
koma above four channels), poly-reference LSCF 20, with as many block rows as lags of a third of a
second hold, 20 to 40 of them, of pyOMA2 at least as many as the largest order needs.
Everything else is the default of the program. Poles outside the band, or undamped, are discarded.
Standard deviations are those that a program states with its estimates; pyOMA2 searches once more
for them, as it then takes many times as long and drops uncertain poles.
"""

from __future__ import annotations

import io
import logging
import time
import warnings
from collections.abc import Callable, Sequence
from contextlib import redirect_stdout
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.signal import decimate, find_peaks, welch

from studies.modes.without_description.worlds import World

Array = NDArray[np.float64]


class Found(NamedTuple):
    """Modes that a program found; nan is what it does not state."""

    frequency: Array  # Hz, ``(n_modes,)``
    damping_ratio: Array  # ``(n_modes,)``
    std: Array  # of ln f and ln ζ, ``(2, n_modes)``
    seconds: float  # processor time


CONTROL = "peaks of single channels"
PRESETS = ("Magalhaes", "Reynders", "Neu", "Kvaale", "Dederichs", "hdbscan", "hier_avg")
_LAG = 1 / 3  # s
_LARGEST_DAMPING = 0.1


def _prepare(world: World) -> tuple[Array, float]:
    """Return samples, ``(n_samples, n_channels)``, and their rate in Hz."""
    factor = max(1, int(world.sample_rate / (2.5 * world.band[1])))
    rate, n = world.sample_rate / factor, world.n_displacements
    samples = decimate(world.samples, factor, axis=0) if factor > 1 else world.samples
    if n:
        second = np.diff(samples[:, :n], 2, axis=0)
        samples = np.concatenate([second, samples[1:-1, n:]], axis=1)
    return (samples - samples.mean(axis=0)) / samples.std(axis=0), rate


def pyoma2(world: World, *, with_std: bool = False) -> dict[str, Found]:
    """Search with covariance-driven SSI of pyOMA2, clustered by each of its presets."""
    from pyoma2.algorithms import SSI
    from pyoma2.algorithms.data.run_params import Clustering
    from pyoma2.setup import SingleSetup

    start = time.process_time()
    samples, rate = _prepare(world)
    order = 40 if samples.shape[1] <= 4 else 60
    # A model of the largest order needs more rows than this.
    rows = max(_rows(rate), order // samples.shape[1] + 1)
    algorithm = SSI(name="ssi", br=rows, ordmax=order, calc_unc=with_std)
    setup = SingleSetup(samples, fs=rate)
    setup.add_algorithms(algorithm)

    def poles() -> Sequence[Array]:
        setup.run_by_name("ssi")
        return np.empty(0), np.empty(0)

    def clustered(name: str) -> Sequence[Array]:
        algorithm.add_clustering(Clustering(name=name, quick=name, freqlim=world.band))
        algorithm.run_clustering(name=name)
        one = algorithm.result.clustering_results[name]
        return one.Fn, one.Xi, *([one.Fn_std, one.Xi_std] if with_std else [])

    alone = _found(poles, world.band, start).seconds
    found = {}
    for name in PRESETS:
        start = time.process_time() - alone
        program = f"pyOMA2 SSI{' with std' * with_std}, {name}"
        found[program] = _found(partial(clustered, name), world.band, start)
    return found


def koma(world: World) -> dict[str, Found]:
    """Search with SSI of koma, in clusters of ten stable poles: order 40 has at most 20."""
    from koma.clustering import PoleClusterer, group_clusters
    from koma.oma import covssi, find_stable_poles

    start = time.process_time()
    samples, rate = _prepare(world)
    orders = np.arange(2, 42 if samples.shape[1] <= 4 else 62, 2)

    def search() -> Sequence[Array]:
        poles = covssi(samples, rate, _rows(rate), orders, showinfo=False)
        range_ = {"freq": [0, np.inf], "damping": [0, _LARGEST_DAMPING], "mpc": [0, 1]}
        *stable, _ = find_stable_poles(*poles, s=2, valid_range=range_)
        clusters = PoleClusterer(*stable, min_samples=10, min_cluster_size=10).postprocess()
        zeta, omega = ([np.median(one) for one in each] for each in group_clusters(*clusters)[:2])
        return np.array(omega) / (2 * np.pi), np.array(zeta)

    return {"koma SSI": _found(search, world.band, start)}


def toolbox(world: World, *, method: str) -> dict[str, Found]:
    """Search with a method of pyoma-toolbox, and its automatic clearing and selection."""
    from pyOMA.core.PreProcessingTools import PreProcessSignals
    from pyOMA.core.SSICovRef import BRSSICovRef
    from pyOMA.core.StabilDiagram import StabilCluster
    from pyOMA.core.VarPLSCF import VarPLSCF

    start = time.process_time()
    samples, rate = _prepare(world)
    signals = PreProcessSignals(samples, rate)

    def search() -> Sequence[Array]:
        if method == "SSI":
            rows = _rows(rate)
            signals.correlation(2 * rows + 2)
            model = BRSSICovRef(signals)
            model.build_toeplitz_cov(rows)
            model.compute_modal_params(40, modal_contrib=False)
        else:
            model = VarPLSCF(signals)
            lines = min(401, len(samples) // 30 - 1)
            model.build_half_spectra(lines, 0.0, rate / 2, window_decay=0.01, num_blocks=30)
            model.compute_modal_params(20, modal_contrib=False)
        cluster = StabilCluster(model)
        cluster.calculate_soft_critera_matrices()
        cluster.calculate_stabilization_masks(d_range=(0, 100 * _LARGEST_DAMPING))
        cluster.automatic_clearing()
        cluster.automatic_classification()
        cluster.automatic_selection()
        f, percent, *_, f_std, percent_std, _ = cluster.get_selected_modal_values()
        std = [] if f_std is None else [f_std, np.divide(percent_std, 100)]
        return f, np.divide(percent, 100), *std

    return {f"pyoma-toolbox {method}": _found(search, world.band, start)}


def peaks(world: World) -> dict[str, Found]:
    """Pick the peaks of the spectrum of each channel (control).

    A peak exceeds its surroundings by six standard deviations of a mean of ordinates; peaks of
    several channels within 1 % are one.
    """
    seconds = len(world.samples) / world.sample_rate
    low, high = world.band
    segment = min(seconds / 8, 200 / low)  # resolves half a percent of the bottom of the band
    n = round(segment * world.sample_rate)
    f, density = welch(world.samples, world.sample_rate, "hann", n, axis=0)
    within = (f >= low) & (f <= high)
    prominence = 6 / np.sqrt(1.5 * seconds / segment)
    every = [
        (f[within][k], height)
        for column in np.log(density[within]).T
        for k, height in zip(*_peaks(column, prominence), strict=True)
    ]
    chosen: list[float] = []
    for place, _ in sorted(every, key=lambda one: -one[1]):
        if all(abs(place / other - 1) > 0.01 for other in chosen):
            chosen.append(float(place))
    f = np.sort(chosen)
    return {CONTROL: Found(f, f * np.nan, np.full((2, f.size), np.nan), 0.0)}


def _peaks(level: Array, prominence: float) -> tuple[NDArray[np.intp], Array]:
    place, properties = find_peaks(level, prominence=prominence)
    return place, properties["prominences"]


def _rows(rate: float) -> int:
    return int(np.clip(_LAG * rate, 20, 40))


def _found(search: Callable[[], Sequence[Array]], band: tuple[float, float], start: float) -> Found:
    """Call a program without its messages; nothing is found where it raises."""
    values = np.empty((4, 0))
    with warnings.catch_warnings(), redirect_stdout(io.StringIO()), np.errstate(all="ignore"):
        warnings.simplefilter("ignore")
        logging.disable(logging.CRITICAL)
        try:
            # A program may return a single mode without a dimension.
            found = np.array([np.atleast_1d(one) for one in search()], dtype=float)
            values = np.full((4, found.shape[1]), np.nan)
            values[: len(found)] = found
        except Exception:  # of any kind: these are programs of others
            pass
        finally:
            logging.disable(logging.NOTSET)
    inside = (values[0] >= band[0]) & (values[0] <= band[1]) & (values[1] > 0)
    f, zeta, *std = values[:, inside][:, np.argsort(values[0, inside])]
    return Found(f, zeta, np.array(std) / [f, zeta], time.process_time() - start)
