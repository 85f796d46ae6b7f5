"""Find noise that is correlated between neighbouring frames of a displacement series, without a friction law.

Filters of a sensor, mains and air cause such noise. It is modelled as white noise plus a first-order autoregressive
process of rms `s` and correlation time `tau`, whose spectrum is flat at low frequencies. Forces on the mass differ from
it: whether they change slowly or from frame to frame, the spectrum of the motion falls at least with the fourth power
of the frequency. So

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
from dataclasses import dataclass

import numpy as np
import scipy

from frictrack.distributions import chi2_isf
from frictrack.motion.noise.white import DIFFERENCE_ORDER, MEDIAN_TO_SIGMA, OUTLIER_SIGMAS
from frictrack.records import Array

MIN_FRAMES = 64  # of a stretch
BANDWIDTH, TAPERS = 4, 7  # time-bandwidth product of the tapers, and number of tapers with low leakage
DIFFERENCES = 2
MOTION_POWERS = 4, 8  # of the frequency, with which the spectrum of a motion falls
MIN_CORRELATION_TIMES = 20  # within a stretch
CORRELATIONS = np.array([0.1, 0.2, 0.35, 0.5, 0.65, 0.8, 0.88, 0.93, 0.96])
SHARES = np.array([0.3, 0.7, 0.9, 1.0])
MAX_CORRELATION = 0.999
SEARCH_WIDTHS = 0.5, 0.25, 0.12  # steps of the log odds of correlation and share, to refine the best shape
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


def correlated_noise(stretches: Sequence[Array]) -> CorrelatedNoise | None:
    """Find noise that is correlated between neighbouring frames.

    Parameters
    ----------
    stretches
        Evenly spaced positions, m, (n_i,) each.

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
    >>> found = correlated_noise([3.0 * t - t**2 + noise])
    >>> 0.7 < found.correlation < 0.9
    True
    >>> correlated_noise([3.0 * t - t**2 + 1e-5 * np.random.default_rng(2).standard_normal(2000)]) is None
    True

    """
    smooth = [_longest_undisturbed(x) for x in stretches]
    shapes = _shapes(min(map(len, smooth), default=0))
    if not len(shapes):
        return None
    spectra = [_Spectrum.of(x) for x in smooth]
    return _best_shape(spectra, shapes) if _is_significant(spectra, shapes) else None


def suspected_noise(stretch: Array) -> CorrelatedNoise | None:
    """Find correlated noise that the full spectrum of one stretch suggests.

    At low frequencies a motion can look like such noise; the likelihood of the smoother has to confirm it.

    Parameters
    ----------
    stretch
        Evenly spaced positions, m, (n,).

    Returns
    -------
    CorrelatedNoise or None
        None if white noise explains the spectrum.

    """
    smooth = _longest_undisturbed(stretch)
    shapes = _shapes(len(smooth))
    if not len(shapes):
        return None
    spectra = [_Spectrum.of(smooth)]
    return _best_shape(spectra, shapes) if _is_consistent(_evidence(spectra, shapes)) else None


def _best_shape(spectra: Sequence[_Spectrum], shapes: Array) -> CorrelatedNoise:
    """Best-fitting noise: best of the shapes (R, 2), then refined."""
    best = shapes[int(np.argmax(np.sum(_evidence(spectra, shapes), axis=0)))]
    for width in SEARCH_WIDTHS:
        near = _shapes_near(best, width)
        best = near[int(np.argmax(np.sum(_evidence(spectra, near), axis=0)))]
    rms = np.sqrt([s.fit(best[None])[0][0] for s in spectra])
    return CorrelatedNoise(float(best[0]), float(best[1]), rms)


def _is_significant(spectra: Sequence[_Spectrum], shapes: Array) -> bool:
    """Whether one of the shapes (R, 2) is significant above `MIN_FREQUENCY` and the same in all runs.

    Noise of the instrument is the same in all runs, forces are not. Several runs that agree are tested from half of
    that frequency on, too.
    """
    lowest = [MIN_FREQUENCY, MIN_FREQUENCY / 2] if len(spectra) >= MIN_RUNS else [MIN_FREQUENCY]
    return any(_is_consistent(_evidence([s.beyond(f) for s in spectra], shapes)) for f in lowest)


def _is_consistent(evidence: Array) -> bool:
    """Whether the evidence (k, R) of k runs is significant for one shape that fits each run."""
    best = int(np.argmax(np.sum(evidence, axis=0)))
    differs = float(np.sum(np.max(evidence, axis=1) - evidence[:, best]))
    consistent = differs < float(chi2_isf(ALPHA_CORRELATED, max(N_SHAPE_PARAMETERS * (len(evidence) - 1), 1)))
    return consistent and float(np.sum(evidence[:, best])) > float(chi2_isf(ALPHA_CORRELATED, N_SHAPE_PARAMETERS))


def _longest_undisturbed(x: Array) -> Array:
    """Longest part (m,) of a stretch without a jump or kink, whose spectrum would look like noise."""
    d = np.abs(np.diff(x, DIFFERENCE_ORDER))
    if not len(d):
        return x
    jumps = np.flatnonzero(d > OUTLIER_SIGMAS * MEDIAN_TO_SIGMA * np.median(d)) + DIFFERENCE_ORDER // 2
    return max(np.split(x, np.unique(np.concatenate([jumps, jumps + 1]))), key=len) if len(jumps) else x


def _shapes(n: int) -> Array:
    """Correlations and shares (R, 2) to try in stretches of n frames."""
    resolved = CORRELATIONS[np.exp(-MIN_CORRELATION_TIMES / max(n, 1)) >= CORRELATIONS] if n >= MIN_FRAMES else []
    return np.array([(c, share) for c in resolved for share in SHARES]).reshape(-1, 2)


def _shapes_near(shape: Array, width: float) -> Array:
    """Shapes (R, 2) near one: the odds of correlation and share are multiplied by factors."""
    odds = shape / (1 - np.minimum(shape, MAX_CORRELATION))
    factors = np.exp(width * np.array([-1.0, 0.0, 1.0]))
    odds_near = np.array([(odds[0] * a, odds[1] * b) for a in factors for b in factors])
    return np.asarray(odds_near / (1 + odds_near))


def _evidence(spectra: Sequence[_Spectrum], shapes: Array) -> Array:
    """Twice the gain in log-likelihood (k, R) by noise of the shapes (R, 2) over white noise, by stretch."""
    return np.array([s.fit(WHITE)[1] - s.fit(shapes)[1] for s in spectra])


def _slepian_tapers(n: int) -> Array:
    """Slepian tapers (TAPERS, n), eigenvectors of a tridiagonal matrix (Slepian 1978, Bell Syst. Tech. J. 57)."""
    i = np.arange(n, dtype=np.float64)
    diagonal = ((n - 1 - 2 * i) / 2) ** 2 * np.cos(2 * np.pi * BANDWIDTH / n)
    _, tapers = scipy.linalg.eigh_tridiagonal(
        diagonal, i[1:] * (n - i[1:]) / 2, select="i", select_range=(n - TAPERS, n - 1)
    )
    return np.asarray(tapers.T[::-1])


@dataclass(frozen=True)
class _Spectrum:
    """Spectral density (F,), m^2 per (cycle per frame), of one stretch at frequencies (F,), cycles per frame."""

    frequency: Array
    density: Array

    @classmethod
    def of(cls, x: Array) -> _Spectrum:
        """Multitaper spectrum of positions (n,), from second differences without their straight line."""
        differences = np.diff(x, DIFFERENCES)
        n = len(differences)
        t = np.linspace(-1.0, 1.0, n)
        differences = differences - np.polyval(np.polyfit(t, differences, 1), t)
        power = np.mean(np.abs(np.fft.rfft(_slepian_tapers(n) * differences, axis=1)) ** 2, axis=0)
        bins = np.arange(BANDWIDTH, (n - 1) // 2, max(BANDWIDTH, n // (2 * MAX_BINS)))
        frequency = bins / n
        return cls(frequency, power[bins] / (2 * np.sin(np.pi * frequency)) ** (2 * DIFFERENCES))

    def beyond(self, lowest: float) -> _Spectrum:
        """The part from a frequency on, cycles per frame."""
        high = self.frequency >= lowest
        return _Spectrum(self.frequency[high], self.density[high])

    def fit(self, shapes: Array) -> tuple[Array, Array]:
        """Best-fitting variance (R,) of noise of the shapes (R, 2), and twice the negative log-likelihood (R,)."""
        sine = 2 * np.sin(np.pi * self.frequency)
        motion = [(sine / sine[0]) ** -power for power in MOTION_POWERS]
        rotation = np.exp(-2j * np.pi * self.frequency)
        noise = [1 - share + share * (1 - c**2) / np.abs(1 - c * rotation) ** 2 for c, share in shapes]
        parts = np.stack([np.stack([spectrum, *motion]) for spectrum in noise])
        scale = float(np.median(self.density))
        sizes, losses = _fit_sizes(self.density / scale, parts)
        return scale * sizes[:, 0], 2 * TAPERS * losses


def _fit_sizes(power: Array, parts: Array) -> tuple[Array, Array]:
    """Sizes (R, K) of spectra (R, K, F) that sum to a power (F,), and the negative log-likelihood (R,)."""
    sizes = np.median(power / parts, axis=2) / parts.shape[1]
    for _ in range(N_UPDATES):
        model = np.einsum("rk,rkf->rf", sizes, parts)
        weighted_power = np.einsum("rkf,rf->rk", parts, np.minimum(power, LINE_FACTOR * model) / model**2)
        sizes = sizes * np.sqrt(weighted_power / np.einsum("rkf,rf->rk", parts, 1 / model))
    model = np.einsum("rk,rkf->rf", sizes, parts)
    return sizes, np.sum(np.log(model) + np.minimum(power / model, LINE_FACTOR), axis=1)
