"""Harmonics whose frequency wanders: recognised by their constant amplitude.

A mode under random forces has a Gaussian response: of its complex envelope z the ratio
E|z|⁴ / (E|z|²)² is 2. The harmonic of a shaft whose speed wanders has nearly constant amplitude:
the ratio is 1, and 2 - s² where a share s of the power is its. Its spectrum alone may look like a
mode's. Harmonics of one shaft wander together: the phase of the n-th is n times that of the first,
by which the others are recognised, however weak they are.

A line of fixed frequency whose amplitude varies has an envelope like noise, but a steady phase: the
squares of its envelope add up, |Σ z²| = Σ |z|². Those of a mode have random phases.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from math import gcd

import numpy as np
from scipy.linalg import eigh
from scipy.ndimage import uniform_filter1d

from lmshealth._private.arrays import BoolArray, ComplexArray, FloatArray
from lmshealth.modal import constants
from lmshealth.modal.ambient.joint_model import JointModel
from lmshealth.signal.constants import LINE_WIDTH
from lmshealth.signal.spectra import CrossSpectrum

# Half widths of the filter, and the widest search for its edges, as fractions of the frequency.
_WIDTHS = (0.015, 0.03)
_WIDEST = 0.1
_DRAWS = 200
# Poles this close with shapes this alike may belong to one harmonic.
_CLOSE, _ALIKE = 0.03, 0.5
# Power over that of everything else from which on the signal stands out.
_STANDS_OUT = 2.0
_LEAST_ORDINATES = 8
# Half width of the band in which a line may be a light mode, where it stands out by the second
# value over its surroundings, up to the third; and the window over which its power is averaged. All
# but the second are fractions of the frequency.
_LIGHT_BAND, _LIGHT_STANDS_OUT, _SURROUNDINGS, _LIGHT_WINDOW = 0.003, 5.0, 0.015, 0.0005
# Its tails reach beyond where it stands out, by this share of that band to either side.
_WIDER = 0.3
# Ratios of the orders of harmonics of one shaft; least mean of a signal that is turned back by the
# phase of another one, over its root mean square; and minus the logarithm of the probability of a
# larger one by chance, exp(-N c²).
_ORDERS = [(n, m) for n in range(1, 9) for m in range(1, 9) if n != m and gcd(n, m) == 1]
_SAME_SHAFT, _CHANCE = 0.5, 7.0


@dataclass(frozen=True, slots=True, eq=False)
class Harmonic:
    """A harmonic that wanders, with its direction, which is left out."""

    frequency: float  # mean in Hz
    low: float  # of its band, in Hz
    high: float
    amplitude: float  # root mean square times √2 in the channel that shows it best, m/s²
    channel: int
    vector: ComplexArray  # column v of its covariance v v*, in (m/s²)/Hz^½, (n_channels,)
    first: int = 0  # index of the Fourier frequency at which its signal begins
    signal: ComplexArray = field(default_factory=lambda: np.zeros(0, complex))  # its transform

    def expected(self, frequency: FloatArray) -> ComplexArray:
        """Return the column in its band and zero elsewhere, ``(n, n_channels, 1)``."""
        within = (frequency >= self.low) & (frequency <= self.high)
        return np.asarray(within[:, None, None] * self.vector[:, None])

    def follows(self, other: Harmonic) -> bool:
        """Return whether both are harmonics of one shaft, from the phases of their signals.

        Of a mode under random forces the phase is independent, and the mean of N ordinates turned
        back by the phase of the other is of the order N^-½.
        """
        size = 4 * max(self.signal.size, other.signal.size)
        if not size or self.frequency == other.frequency:
            return False
        own, theirs = (np.fft.ifft(one.signal, size) for one in (self, other))
        turn = 2 * np.pi * np.arange(size) / size
        phase = np.unwrap(np.angle(theirs)) + turn * other.first
        least = max(_SAME_SHAFT, np.sqrt(_CHANCE / self.signal.size))
        reach = (other.high - other.low) / other.frequency / 2
        for n, m in _ORDERS:
            if abs(self.frequency / other.frequency * m / n - 1) < reach:
                turned = own * np.exp(-1j * (phase * n / m - turn * self.first))
                if abs(turned.mean()) > least * np.sqrt(np.mean(np.abs(own) ** 2)):
                    return True
        return False

    def seen_by(self, model: JointModel) -> ComplexArray:
        """Return its column for the channels of a model, of which it was found in the first ones.

        The model has no expectation of it.
        """
        f, n = model.data.frequency, self.vector.size
        phi = _direction(model, model.expected, (f >= self.low) & (f <= self.high))
        phi = phi * model.data.scale
        return np.asarray(phi * np.vdot(phi[:n], self.vector) / np.vdot(phi[:n], phi[:n]))

    def along(self, vector: ComplexArray) -> Harmonic:
        """Return it for other channels, with its column for these."""
        best = int(np.abs(vector).argmax())
        amplitude = self.amplitude * float(abs(vector[best] / self.vector[self.channel]))
        return replace(self, vector=vector, channel=best, amplitude=amplitude)


def find_harmonic(
    model: JointModel,
    recording: CrossSpectrum,
    known: Sequence[Harmonic] = (),
    lines: Sequence[float] = (),
) -> Harmonic | None:
    """Return the clearest harmonic that wanders among the modes; None if there is none.

    They are recognised in the first segment of the recording, without its lines. Less evidence is
    needed in the bands of known harmonics, whose direction may vary, and at other lines, in Hz; and
    no other of one whose phase follows that of a known one.
    """
    at_line = near_lines(model.f, model.zeta, lines)
    found = [
        (*one, bool(at_line[i]))
        for i in range(model.f.size)
        if (one := _test(model, i, recording)) is not None
    ]
    for sigmas, harmonic, near in sorted(found, key=lambda one: one[0]):
        near |= any(harmonic.low < h.high and h.low < harmonic.high for h in known)
        needed = constants.WANDERING_SIGMAS / (2 if near else 1)
        if sigmas < -needed or any(harmonic.follows(h) for h in known):
            return harmonic
    return None


def is_random(recording: CrossSpectrum, frequency: float) -> bool:
    """Return whether what stands out at a frequency in Hz is narrow-band noise: a mode, not a line.

    Neither its amplitude nor its phase is steady, in the channel that shows it best. A record that
    holds few independent values of the envelope is no evidence.
    """
    off = recording.frequency / frequency - 1
    reach = slice(*np.searchsorted(off, [-_SURROUNDINGS, _SURROUNDINGS]))
    off, transforms = off[reach], recording.transforms[0, reach] * recording.free[reach, None]
    power = np.abs(transforms) ** 2
    around = np.abs(off) > _SURROUNDINGS / 3
    if not around.any():
        return False
    width = max(3, int(_LIGHT_WINDOW * frequency * recording.duration)) | 1
    level = uniform_filter1d(power, width, axis=0)
    level /= np.median(power[around], axis=0).clip(1e-300) / np.log(2)
    at = int(np.abs(off).argmin())
    channel = int(level[at].argmax())
    near = (level[:, channel] > _LIGHT_STANDS_OUT) & (np.abs(off) < _LIGHT_BAND)
    z = transforms[_around(near, at), channel]
    if not near[at] or z.size < _LEAST_ORDINATES:
        return False
    envelope = np.fft.ifft(z, 2 * z.size)
    steady = np.abs(np.fft.fft(envelope**2, 4 * z.size)).max() / np.sum(np.abs(envelope) ** 2)
    # Of a harmonic that wanders further the narrow band holds parts, which look random.
    wide = np.fft.ifft(transforms[:, channel], 2 * len(transforms))
    kurtosis = min(_kurtosis(one[None])[0] for one in (envelope, wide))
    return bool(kurtosis > constants.WANDERING_KURTOSIS and steady < constants.STEADY_PHASE)


def near_lines(f: FloatArray, zeta: FloatArray, lines: Sequence[float]) -> BoolArray:
    """Return which modes have one of the lines in Hz at their resonance, shape ``(n_modes,)``."""
    apart = np.abs(f[:, None] / np.asarray(lines) - 1)
    return np.asarray((apart < LINE_WIDTH + zeta[:, None]).any(axis=1))


def _test(model: JointModel, i: int, recording: CrossSpectrum) -> tuple[float, Harmonic] | None:
    """Return by how many standard deviations the amplitude is too constant for noise."""
    f0 = model.f[i]
    shape = model.phi / np.linalg.norm(model.phi, axis=0)
    own = (np.abs(model.f / f0 - 1) < _CLOSE) & (np.abs(shape.conj().T @ shape[:, i]) ** 2 > _ALIKE)
    rest = model.subset(~own)
    expected = rest.expected
    near = np.abs(model.data.frequency / f0 - 1) < max(0.01, model.zeta[i])
    phi = _direction(model, expected, near) if near.any() else shape[:, i]
    gain = np.linalg.inv(expected) @ phi
    precision = np.real(gain @ phi.conj())
    weight = gain / precision[:, None]  # passes the direction unchanged, with the least of the rest
    first, last = np.searchsorted(recording.frequency, [f0 * (1 - _WIDEST), f0 * (1 + _WIDEST)])
    frequency = recording.frequency[first:last]
    if frequency.size < _LEAST_ORDINATES:
        return None
    weights = np.stack([np.interp(frequency, model.data.frequency, w) for w in weight.T], axis=1)
    transforms = recording.transforms[0, first:last] * recording.free[first:last, None]
    z = np.sum(weights.conj() * transforms / model.data.scale, axis=1)
    noise = np.interp(frequency, model.data.frequency, 1 / precision)
    width = int(0.5 * model.zeta[i] * f0 * recording.duration) | 1
    width = min(max(5, width), (z.size - 1) | 1)
    level = np.convolve(np.abs(z) ** 2, np.ones(width) / width, "same")
    within = _around(level > _STANDS_OUT * noise, int(np.argmin(np.abs(frequency - f0))))
    wide, power = frequency[within], np.abs(z[within]) ** 2
    if np.count_nonzero(power) < 2:  # lines are masked there
        return None
    windows = [slice(*np.searchsorted(frequency, [f0 * (1 - w), f0 * (1 + w)])) for w in _WIDTHS]
    sigmas = min(_constancy(z[w], level[w]) for w in (within, *windows))
    size = 10 * float(np.sqrt(level[within].max()))  # far above its level: nothing is left of it
    physical = phi * model.data.scale
    channel = int(np.argmax(np.abs(physical)))
    more = _WIDER * float(wide[-1] - wide[0])
    reach = slice(*np.searchsorted(frequency, [wide[0] - more, wide[-1] + more]))
    return sigmas, Harmonic(
        float(np.average(wide, weights=power)),
        float(wide[0]) - more,
        float(wide[-1]) + more,
        float(np.sqrt(2 * power.sum() / recording.duration) * abs(physical[channel])),
        channel,
        size * physical,
        first=int(np.rint(frequency[reach.start] * recording.duration)),
        signal=z[reach],
    )


def _direction(model: JointModel, expected: ComplexArray, near: BoolArray) -> ComplexArray:
    """Return the direction that exceeds the rest most near a frequency, of unit norm."""
    expected, matrix, count = expected[near], model.data.matrix[near], model.data.count[near]
    white = np.linalg.solve(expected, matrix)
    strongest = expected[np.argmax(np.trace(white, axis1=1, axis2=2).real * count)]
    phi = strongest @ eigh(np.tensordot(count, matrix, axes=1), strongest)[1][:, -1]
    return np.asarray(phi / np.linalg.norm(phi))


def _around(stands_out: np.ndarray, k: int) -> slice:
    """Return the run of true values that holds an index."""
    off = np.flatnonzero(~stands_out)
    place = int(np.searchsorted(off, k))
    low = int(off[place - 1]) + 1 if place else 0
    high = int(off[place]) if place < off.size else stands_out.size
    return slice(low, max(low + 1, high))


def _constancy(z: ComplexArray, level: FloatArray) -> float:
    """Return the logarithm of the envelope's kurtosis, in standard deviations of Gaussian noise."""
    n = z.size
    if n < _LEAST_ORDINATES:
        return 0.0
    kurtosis = np.log(_kurtosis(np.fft.ifft(z, 2 * n)[None])[0])
    if kurtosis > np.log(constants.WANDERING_KURTOSIS):
        return 0.0
    rng = np.random.default_rng(n)
    draws = rng.standard_normal((_DRAWS, 2 * n)).view(complex) * np.sqrt(level / 2)
    noise = np.log(_kurtosis(np.fft.ifft(draws, 2 * n, axis=1)))
    return float((kurtosis - noise.mean()) / noise.std())


def _kurtosis(z: ComplexArray) -> FloatArray:
    square = np.abs(z) ** 2
    return np.asarray((square**2).mean(axis=1) / square.mean(axis=1) ** 2)
