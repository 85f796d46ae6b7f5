"""Estimate the noise of a displacement series: its white level, and correlation between neighbouring frames.

For white noise of variance s^2 the differences of order k have the variance C(2k, k) s^2 and the autocorrelations
(-1)^j C(2k, k + j) / C(2k, k); a signal of frequency f enters them with (2 sin(pi f / fs))^k. Its level is estimated
from fifth differences, which contain little slow signal. Third differences need shorter stretches and give a slightly
more precise estimate, but contain jerks and the ripple of a tracker.

Filters of a sensor, mains and air cause noise that is correlated between neighbouring frames, whatever the friction
law. It is modelled as white noise plus a first-order autoregressive process of rms `s` and correlation time `tau`,
whose spectrum is flat at low frequencies. Forces on the mass differ from it: whether they change slowly or from frame
to frame, the spectrum of the motion falls at least with the fourth power of the frequency. So

    S(f) = w + s g(f; tau) + c (2 sin pi f)^-4 + d (2 sin pi f)^-8,      w, s, c, d >= 0

is fitted to the spectrum (Whittle likelihood: Whittle 1953, Ark. Mat. 2; multiplicative updates: Fevotte, Bertin &
Durrieu 2009, Neural Comput. 21) of each run; only tau, a property of the instrument, is common. The spectrum is a
multitaper estimate of the second differences (Thomson 1982, Proc. IEEE 70), so that the slide does not leak into it.
Lines are left out. The test for such noise uses frequencies above a tenth of the frame rate, where hardly any force
moves a mass. Correlation times that a record does not contain many times are not tried: a slow misfit belongs to the
model.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from math import comb

import numpy as np
import scipy

from frictrack.base.distributions import chi2_isf, robust_std
from frictrack.records import Array, Mask
from frictrack.sampling import frame_numbers, uneven_noise

DIFFERENCE_ORDER = 5
FALLBACK_ORDER = 3  # used where missing frames leave less than half as many fifth as third differences
HIGHER_ORDERS, FALL_SIGMAS = (8, 12, 16, 24), 3.0  # tried while the level falls by more than its deviations
OUTLIER_SIGMAS = 6.0  # robust standard deviations beyond which a difference belongs to an impact
MAX_GAP_SHARE, MAX_UNEVENNESS = 0.2, 0.01  # of the intervals, that differ from the usual one by more of it
MIN_HALF_WAVE_FRAMES = 4  # frames in half a period of the fastest slow error


def _is_uneven(t: Array) -> bool:
    """Whether many intervals differ from the usual one, so that few rows in a row are evenly spaced."""
    steps = np.diff(t) / np.median(np.diff(t)) if len(t) > 1 else np.ones(1)
    return bool(np.mean(np.abs(steps - 1.0) > MAX_UNEVENNESS) > MAX_GAP_SHARE)


def difference_variance(order: int) -> float:
    """Variance of the differences of unit white noise, C(2k, k)."""
    return float(comb(2 * order, order))


def correlation_cost(order: int) -> float:
    """Sum of the squared autocorrelations of the differences: frames per degree of freedom."""
    return comb(4 * order, 2 * order) / comb(2 * order, order) ** 2


CORRELATION_COST = correlation_cost(DIFFERENCE_ORDER)  # 2.91


def slow_spectrum(n: int) -> Array:
    """Amplitudes of a slow error of unit rms in the first cosines of n frames.

    The error has equal power in each octave from a few frames to the whole piece.

    Parameters
    ----------
    n
        Number of frames.

    Returns
    -------
    Array
        Amplitudes of the orthonormal cosines, without the constant, (k,).

    """
    k = np.arange(1, max(n // MIN_HALF_WAVE_FRAMES, 2))
    return np.asarray(np.sqrt(n / np.sum(1 / k) / k))


def noise_level(x: Array, valid: Mask, relative: Array | None = None, t: Array | None = None) -> tuple[float, float]:
    """Estimate the standard deviation of the white noise of a series.

    Differences over a missing frame, and outliers by an impact, are left out. From m fifth differences,
    var(s^2) / s^4 = 2 * 2.91 / m, and half of its root for s.

    Parameters
    ----------
    x
        Values at evenly spaced frames in any unit, (n,).
    valid
        Frames that were measured, (n,).
    relative
        Relative standard deviations of the frames, (n,); the result then is that of a frame where they are 1.
    t
        Times, s, (n,), if intervals between frames may be longer than others.

    Returns
    -------
    tuple of float
        Standard deviation, and its relative standard deviation. NaN if fewer than four neighbouring frames are valid.

    Examples
    --------
    >>> noise = np.random.default_rng(0).standard_normal(5000)
    >>> sigma, _ = noise_level(np.linspace(0.0, 50.0, 5000) ** 2 + noise, np.ones(5000, dtype=bool))
    >>> 0.95 < sigma < 1.05
    True

    """
    steps = np.minimum(np.diff(frame_numbers(t)), 2.0) if t is not None and len(t) > 1 else np.ones(1)
    if t is not None and _is_uneven(t) and np.sum(valid) > DIFFERENCE_ORDER:
        scale = np.ones(len(x)) if relative is None else relative
        level = uneven_noise(t[valid], x[valid], scale[valid])
        return level, 0.5 * float(np.sqrt(2.0 * correlation_cost(4) / np.sum(valid)))
    if np.any(steps > 1):
        rows = np.repeat(np.arange(len(x)), np.append(steps, 1).astype(int))  # with a frame in every gap, not measured
        measured = valid[rows] & np.append(True, np.diff(rows) > 0)
        if np.any(_complete_differences(measured, FALLBACK_ORDER)):
            return noise_level(x[rows], measured, None if relative is None else relative[rows])
    complete = {order: _complete_differences(valid, order) for order in (DIFFERENCE_ORDER, FALLBACK_ORDER)}
    order = difference_order(*(int(np.sum(whole)) for whole in complete.values()))
    if not np.any(complete[order]):
        return np.nan, np.nan
    return _level_of_differences(x, valid, complete[order], relative)


def _level_of_differences(x: Array, valid: Mask, whole: Mask, relative: Array | None = None) -> tuple[float, float]:
    """White noise of a series (n,) from its complete differences of one order, and its relative standard deviation."""
    order = len(x) - len(whole)
    d = np.diff(np.where(valid, x, 0.0), order)[whole] / _expected(relative, valid, order)[whole]
    kept = d[np.abs(d) <= OUTLIER_SIGMAS * robust_std(d)]
    return float(np.sqrt(np.mean(kept**2))), 0.5 * float(np.sqrt(2.0 * correlation_cost(order) / len(kept)))


def noise_of_smooth(x: Array) -> float:
    """White noise of a series (n,) that may change fast: the order of differences rises while they hold signal."""
    level, valid = white_noise(x), np.isfinite(x)
    for order in HIGHER_ORDERS:
        whole = _complete_differences(valid, order)
        if np.sum(whole) < MIN_FRAMES:
            break
        higher, error = _level_of_differences(x, valid, whole)
        if higher > (1 - FALL_SIGMAS * error) * level:  # of white noise, all orders find the same
            break
        level = higher
    return level


def white_noise(x: Array, valid: Mask | None = None) -> float:
    """Estimate the white noise of a series (n,), as `noise_level`, by default of its finite values; 0 if that fails."""
    return float(np.nan_to_num(noise_level(x, np.isfinite(x) if valid is None else valid)[0]))


def difference_order(many: int, few: int) -> int:
    """Choose the order of differences.

    Parameters
    ----------
    many, few
        Numbers of complete differences of `DIFFERENCE_ORDER` and `FALLBACK_ORDER`.

    Returns
    -------
    int
        `FALLBACK_ORDER` if missing frames leave too few differences of the higher order.

    Examples
    --------
    >>> difference_order(100, 102), difference_order(10, 60)
    (5, 3)

    """
    return DIFFERENCE_ORDER if 2 * many >= few else FALLBACK_ORDER


def _expected(relative: Array | None, valid: Mask, order: int) -> Array:
    """Standard deviation of the differences (n - order,) of independent noise with relative standard deviations."""
    size = np.ones(len(valid)) if relative is None else np.where(valid, relative, 1.0)
    weights = np.array([float(comb(order, k)) for k in range(order + 1)])
    return np.sqrt(np.convolve(size**2, weights**2, mode="valid"))


def _complete_differences(valid: Mask, order: int) -> Mask:
    """Mask of the differences without a missing frame."""
    count = max(len(valid) - order, 0)
    return np.asarray(np.all([valid[k : k + count] for k in range(order + 1)], axis=0))


MIN_FRAMES = 64  # of a stretch
BANDWIDTH, TAPERS = 4, 7  # time-bandwidth product of the tapers, and number of tapers with low leakage
DIFFERENCES = 2
MOTION_POWERS = 4, 8  # of the frequency, with which the spectrum of a motion falls
MIN_CORRELATION_TIMES = 20  # within a stretch
CORRELATIONS = np.array([0.1, 0.2, 0.35, 0.5, 0.65, 0.8, 0.88, 0.93, 0.96])
SHARES = np.array([0.3, 0.7, 0.9, 1.0])
MAX_CORRELATION = 0.999
SEARCH_WIDTHS = 0.5, 0.25, 0.12  # steps of the log odds of correlation and share, to refine the best shape
SHAPES = np.array([(c, share) for c in CORRELATIONS for share in SHARES])  # (R, 2)
WHITE = np.zeros((1, 2))
N_UPDATES = 300
ALPHA_CORRELATED = 1e-3  # false-alarm probability for white noise
MIN_RUNS = 3  # needed to attribute noise to the instrument from half of `MIN_FREQUENCY` on
MAX_BINS = 400  # of a spectrum
N_SHAPE_PARAMETERS = 2  # correlation and share
MIN_FREQUENCY = 0.1  # cycles per frame; the test uses the spectrum above it
LINE_FACTOR = 3.0  # over the smooth spectrum; white noise exceeds it with these tapers once in 10 000


@dataclass(frozen=True)
class CorrelatedNoise:
    """White noise plus autoregressive noise of k stretches.

    Attributes
    ----------
    correlation
        Correlation of neighbouring frames of the autoregressive part; the same in all stretches.
    share
        Its share of the variance; the same in all stretches.
    rms
        Standard deviation of both parts together by stretch, m, (k,).

    """

    correlation: float
    share: float
    rms: Array


@dataclass(frozen=True, eq=False)
class NoiseStretch:
    """Evenly spaced positions (n,), m, with what was computed of their noise, so that it is computed once.

    The positions must not be changed.
    """

    positions: Array
    _evidence: dict[float, Array] = field(default_factory=dict, init=False, repr=False)

    @cached_property
    def smooth(self) -> Array:
        """Longest part (m,) without a jump or kink, whose spectrum would look like noise."""
        d = np.abs(np.diff(self.positions, DIFFERENCE_ORDER))
        if not len(d):
            return self.positions
        jumps = np.flatnonzero(d > OUTLIER_SIGMAS * robust_std(d)) + DIFFERENCE_ORDER // 2
        return max(np.split(self.positions, np.unique(np.concatenate([jumps, jumps + 1]))), key=len)

    @cached_property
    def spectrum(self) -> tuple[Array, Array]:
        """Frequencies (F,), cycles per frame, and the density (F,), m^2 per (cycle per frame), of the smooth part.

        It is the multitaper spectrum of second differences without their straight line.
        """
        differences = np.diff(self.smooth, DIFFERENCES)
        n = len(differences)
        t = np.linspace(-1.0, 1.0, n)
        differences = differences - np.polyval(np.polyfit(t, differences, 1), t)
        tapers = scipy.signal.windows.dpss(n, BANDWIDTH, TAPERS)  # Slepian 1978, Bell Syst. Tech. J. 57
        power = np.mean(np.abs(np.fft.rfft(tapers * differences, axis=1)) ** 2, axis=0)
        bins = np.arange(BANDWIDTH, (n - 1) // 2, max(BANDWIDTH, n // (2 * MAX_BINS)))
        return bins / n, power[bins] / (2 * np.sin(np.pi * bins / n)) ** (2 * DIFFERENCES)

    def fit(self, shapes: Array, lowest: float = 0.0) -> tuple[Array, Array]:
        """Fit noise of some shapes (R, 2) and motions to the spectrum from a frequency on, cycles per frame.

        Returns the variances (R,) of the noise that sum with the motions to the spectrum, and -2 log-likelihood (R,).
        """
        frequency, density = (q[self.spectrum[0] >= lowest] for q in self.spectrum)
        scale = float(np.median(density))
        power, rotation, sine = density / scale, np.exp(-2j * np.pi * frequency), 2 * np.sin(np.pi * frequency)
        noise = np.array([1 - share + share * (1 - c**2) / np.abs(1 - c * rotation) ** 2 for c, share in shapes])
        motion = np.array([(sine / sine[0]) ** -exponent for exponent in MOTION_POWERS])
        of_motion = np.broadcast_to(np.median(power / motion, axis=1), (len(shapes), len(motion)))
        sizes = np.column_stack([np.median(power / noise, axis=1), of_motion]) / (1 + len(motion))  # all alone, shared
        for _ in range(N_UPDATES):
            inverse = 1.0 / (sizes[:, :1] * noise + sizes[:, 1:] @ motion)
            capped = np.minimum(power * inverse, LINE_FACTOR) * inverse
            up, down = (np.column_stack([np.einsum("rf,rf->r", q, noise), q @ motion.T]) for q in (capped, inverse))
            sizes = sizes * np.sqrt(up / down)
        model = sizes[:, :1] * noise + sizes[:, 1:] @ motion
        losses = np.sum(np.log(model) + np.minimum(power / model, LINE_FACTOR), axis=1)
        return scale * sizes[:, 0], 2 * TAPERS * losses

    def gains(self, shapes: Array, lowest: float = 0.0) -> Array:
        """Twice the gain in log-likelihood (R,) by noise of the shapes (R, 2) over white noise."""
        losses = self.fit(np.concatenate([WHITE, shapes]), lowest)[1]
        return losses[0] - losses[1:]

    @staticmethod
    def evidence(stretches: Sequence[NoiseStretch], lowest: float, n_shapes: int | None = None) -> Array:
        """Evidence (k, R) for the first `SHAPES`, by stretch, in the spectra from a frequency on, cycles per frame."""
        for stretch in stretches:
            if lowest not in stretch._evidence:
                stretch._evidence[lowest] = stretch.gains(SHAPES, lowest)
        return np.array([s._evidence[lowest][:n_shapes] for s in stretches])


def correlated_noise(stretches: Sequence[NoiseStretch]) -> CorrelatedNoise | None:
    """Find noise that is correlated between neighbouring frames.

    Parameters
    ----------
    stretches
        The stretches; what is computed of one is kept with it.

    Returns
    -------
    CorrelatedNoise or None
        None if white noise explains the spectra.

    References
    ----------
    Thomson 1982, Proc. IEEE 70, 1055-1096; Whittle 1953, Ark. Mat. 2, 423-434.

    Examples
    --------
    >>> import numpy as np
    >>> from scipy.signal import lfilter
    >>> t = np.linspace(0.0, 1.0, 2000)
    >>> noise = 1e-5 * lfilter([0.6], [1.0, -0.8], np.random.default_rng(1).standard_normal(2000))
    >>> found = correlated_noise([NoiseStretch(3.0 * t - t**2 + noise)])
    >>> 0.7 < found.correlation < 0.9
    True
    >>> white = 1e-5 * np.random.default_rng(2).standard_normal(2000)
    >>> correlated_noise([NoiseStretch(3.0 * t - t**2 + white)]) is None
    True

    """
    n_shapes = _n_resolved(stretches)
    return _best_shape(stretches, n_shapes) if n_shapes and _is_significant(stretches, n_shapes) else None


def suspected_noise(stretch: Array) -> CorrelatedNoise | None:
    """Find correlated noise that the full spectrum of one stretch suggests.

    At low frequencies a motion can look like such noise; the likelihood of the smoother has to confirm it.
    """
    own = [NoiseStretch(stretch)]
    n_shapes = _n_resolved(own)
    is_suspected = n_shapes and _is_consistent(NoiseStretch.evidence(own, 0.0, n_shapes))
    return _best_shape(own, n_shapes) if is_suspected else None


def _best_shape(stretches: Sequence[NoiseStretch], n_shapes: int) -> CorrelatedNoise:
    """Best-fitting noise: best of the first shapes, then refined."""
    best = SHAPES[int(np.argmax(np.sum(NoiseStretch.evidence(stretches, 0.0, n_shapes), axis=0)))]
    for width in SEARCH_WIDTHS:
        near = _shapes_near(best, width)
        best = near[int(np.argmax(sum(s.gains(near) for s in stretches)))]
    variances = [s.fit(best[None])[0][0] for s in stretches]
    return CorrelatedNoise(float(best[0]), float(best[1]), np.sqrt(variances))


def _is_significant(stretches: Sequence[NoiseStretch], n_shapes: int) -> bool:
    """Whether one of the first shapes is significant above `MIN_FREQUENCY` and the same in all runs.

    Noise of the instrument is the same in all runs, forces are not. Several runs that agree are tested from half of
    that frequency on, too.
    """
    lowest = [MIN_FREQUENCY, MIN_FREQUENCY / 2] if len(stretches) >= MIN_RUNS else [MIN_FREQUENCY]
    return any(_is_consistent(NoiseStretch.evidence(stretches, f, n_shapes)) for f in lowest)


def _is_consistent(evidence: Array) -> bool:
    """Whether the evidence (k, R) of k runs is significant for one shape that fits each run."""
    best = int(np.argmax(np.sum(evidence, axis=0)))
    differs = float(np.sum(np.max(evidence, axis=1) - evidence[:, best]))
    consistent = differs < float(chi2_isf(ALPHA_CORRELATED, max(N_SHAPE_PARAMETERS * (len(evidence) - 1), 1)))
    return consistent and float(np.sum(evidence[:, best])) > float(chi2_isf(ALPHA_CORRELATED, N_SHAPE_PARAMETERS))


def _n_resolved(stretches: Sequence[NoiseStretch]) -> int:
    """Number of `SHAPES`, from the first on, that the shortest stretch contains often enough."""
    n = min((len(s.smooth) for s in stretches), default=0)
    return int(np.sum(np.exp(-MIN_CORRELATION_TIMES / n) >= SHAPES[:, 0])) if n >= MIN_FRAMES else 0


def _shapes_near(shape: Array, width: float) -> Array:
    """Shapes (R, 2) near one: the odds of correlation and share are multiplied by factors."""
    odds = shape / (1 - np.minimum(shape, MAX_CORRELATION))
    factors = np.exp(width * np.array([-1.0, 0.0, 1.0]))
    odds_near = np.array([(odds[0] * a, odds[1] * b) for a in factors for b in factors])
    return np.asarray(odds_near / (1 + odds_near))
