"""Find noise of a displacement series that is alike in neighbouring frames, without asking any law.

Filters of a sensor, mains and air make noise whose neighbouring samples are alike. It is taken for white noise and a
first-order autoregressive process, rms `s` and correlation time `tau`, whose spectrum is flat at low frequencies. What
moves the mass shows otherwise: a force that changes slowly, or from frame to frame, moves it with a spectrum that falls
at least with the fourth power of the frequency. So

    S(f) = w + s g(f; tau) + c (2 sin pi f)^-4 + d (2 sin pi f)^-8,      w, s, c, d >= 0

is fitted to the spectrum (Whittle 1953, Ark. Mat. 2; multiplicative updates of Fevotte, Bertin & Durrieu 2009, Neural
Comput. 21), of every run by itself but for tau, which belongs to the instrument. The spectrum is that of the second
differences seen through Slepian tapers (Thomson 1982, Proc. IEEE 70), so that the slide does not leak into it. Lines
stand out of the spectrum and are left out. Whether there is such noise is decided beyond a tenth of the frame rate,
where next to nothing moves a mass, and a correlation time that a record does not hold many times is not looked for:
slow misfit is misfit.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.signal.windows import dpss
from scipy.stats import chi2

from frictrack.motion.noise import DIFFERENCE_ORDER, MEDIAN_TO_SIGMA, OUTLIER_SIGMAS
from frictrack.records import Array

MIN_FRAMES = 64  # of a stretch that has a spectrum
BANDWIDTH, TAPERS = 4, 7  # of the tapers, in units of one over the stretch; how many leak nothing
DIFFERENCES = 2
MOTION_POWERS = 4, 8  # with which the spectrum of a motion falls
MIN_CORRELATION_TIMES = 20  # that a stretch must hold
CORRELATIONS = np.array([0.1, 0.2, 0.35, 0.5, 0.65, 0.8, 0.88, 0.93, 0.96])
SHARES = np.array([0.3, 0.7, 0.9, 1.0])
MAX_CORRELATION = 0.999
SEARCH_WIDTHS = 0.5, 0.25, 0.12  # of the odds of correlation and share, in which the best shape is looked for
WHITE = np.zeros((1, 2))
N_UPDATES = 300
ALPHA_CORRELATED = 1e-3  # probability that white noise is called correlated
MIN_RUNS = 3  # that show what belongs to the instrument
MAX_BINS = 400  # of a spectrum
N_SHAPE_PARAMETERS = 2  # correlation and share
MIN_FREQUENCY = 0.1  # cycles per frame; the spectrum above it decides
LINE_FACTOR = 3.0  # times the smooth spectrum: through so many tapers white noise passes it once in 10 000


@dataclass(frozen=True)
class CorrelatedNoise:
    """Noise of one or more stretches: an autoregressive part beside the white one.

    `correlation` of neighbouring frames of that part and its `share` of the variance, alike in all stretches; the rms
    of both together, m, by stretch (k,).
    """

    correlation: float
    share: float
    rms: Array


def correlated_noise(stretches: Sequence[Array]) -> CorrelatedNoise | None:
    """Find correlated noise in stretches (n_i,) of evenly spaced positions, m; None where white noise will do.

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
    """Correlated noise that the whole spectrum of one stretch (n,) suggests; None where white noise will do.

    What moves the mass may look so at low frequencies: the likelihood of the motion has to confirm it.
    """
    smooth = _longest_undisturbed(stretch)
    shapes = _shapes(len(smooth))
    if not len(shapes):
        return None
    spectra = [_Spectrum.of(smooth)]
    return _best_shape(spectra, shapes) if _is_consistent(_evidence(spectra, shapes)) else None


def _best_shape(spectra: Sequence[_Spectrum], shapes: Array) -> CorrelatedNoise:
    """The noise that suits spectra best, first of these shapes (R, 2), then of those near it."""
    best = shapes[int(np.argmax(np.sum(_evidence(spectra, shapes), axis=0)))]
    for width in SEARCH_WIDTHS:
        near = _shapes_near(best, width)
        best = near[int(np.argmax(np.sum(_evidence(spectra, near), axis=0)))]
    rms = np.sqrt([s.fitted(best[None])[0][0] for s in spectra])
    return CorrelatedNoise(float(best[0]), float(best[1]), rms)


def _is_significant(spectra: Sequence[_Spectrum], shapes: Array) -> bool:
    """Whether noise of one of such shapes (R, 2) is clear beyond a tenth of the frame rate, and alike in all runs.

    It belongs to the instrument, while what moves the mass differs from run to run. Several runs that agree may show it
    from half of that frequency on.
    """
    lowest = [MIN_FREQUENCY, MIN_FREQUENCY / 2] if len(spectra) >= MIN_RUNS else [MIN_FREQUENCY]
    return any(_is_consistent(_evidence([s.beyond(f) for s in spectra], shapes)) for f in lowest)


def _is_consistent(each: Array) -> bool:
    """Whether evidence (k, R) of runs for shapes is clear for one of them, which suits every run."""
    best = int(np.argmax(np.sum(each, axis=0)))
    differs = float(np.sum(np.max(each, axis=1) - each[:, best]))
    alike = differs < float(chi2.isf(ALPHA_CORRELATED, max(N_SHAPE_PARAMETERS * (len(each) - 1), 1)))
    return alike and float(np.sum(each[:, best])) > float(chi2.isf(ALPHA_CORRELATED, N_SHAPE_PARAMETERS))


def _longest_undisturbed(x: Array) -> Array:
    """The longest part (m,) of a stretch without a jump or a kink: their spectrum would be taken for noise."""
    d = np.abs(np.diff(x, DIFFERENCE_ORDER))
    if not len(d):
        return x
    jumps = np.flatnonzero(d > OUTLIER_SIGMAS * MEDIAN_TO_SIGMA * np.median(d)) + DIFFERENCE_ORDER // 2
    return max(np.split(x, np.unique(np.concatenate([jumps, jumps + 1]))), key=len) if len(jumps) else x


def _shapes(n: int) -> Array:
    """Correlations and shares (R, 2) that are tried in stretches of n frames."""
    held = CORRELATIONS[np.exp(-MIN_CORRELATION_TIMES / max(n, 1)) >= CORRELATIONS] if n >= MIN_FRAMES else []
    return np.array([(c, share) for c in held for share in SHARES]).reshape(-1, 2)


def _shapes_near(shape: Array, width: float) -> Array:
    """Shapes (R, 2) about one: the odds of correlation and share differ by factors."""
    odds = shape / (1 - np.minimum(shape, MAX_CORRELATION))
    factors = np.exp(width * np.array([-1.0, 0.0, 1.0]))
    tried = np.array([(odds[0] * a, odds[1] * b) for a in factors for b in factors])
    return np.asarray(tried / (1 + tried))


def _evidence(spectra: Sequence[_Spectrum], shapes: Array) -> Array:
    """Twice the rise of the log likelihood (k, R) by noise of such shapes (R, 2) over white noise, by stretch."""
    return np.array([s.fitted(WHITE)[1] - s.fitted(shapes)[1] for s in spectra])


@dataclass(frozen=True)
class _Spectrum:
    """Spectral density of one stretch (F,), m^2 per unit of frequency in cycles a frame."""

    frequency: Array
    density: Array

    @classmethod
    def of(cls, x: Array) -> _Spectrum:
        """Of positions (n,): second differences, without their straight line, through tapers; no lines."""
        bent = np.diff(x, DIFFERENCES)
        n = len(bent)
        t = np.linspace(-1.0, 1.0, n)
        bent = bent - np.polyval(np.polyfit(t, bent, 1), t)
        power = np.mean(np.abs(np.fft.rfft(dpss(n, BANDWIDTH, TAPERS) * bent, axis=1)) ** 2, axis=0)
        bins = np.arange(BANDWIDTH, (n - 1) // 2, max(BANDWIDTH, n // (2 * MAX_BINS)))
        frequency = bins / n
        return cls(frequency, power[bins] / (2 * np.sin(np.pi * frequency)) ** (2 * DIFFERENCES))

    def beyond(self, lowest: float) -> _Spectrum:
        """Its part from a frequency on, cycles a frame."""
        high = self.frequency >= lowest
        return _Spectrum(self.frequency[high], self.density[high])

    def fitted(self, shapes: Array) -> tuple[Array, Array]:
        """Variance (R,) of noise of such shapes (R, 2) that suits it best, and twice the negative log likelihood."""
        sine = 2 * np.sin(np.pi * self.frequency)
        motion = [(sine / sine[0]) ** -power for power in MOTION_POWERS]
        turn = np.exp(-2j * np.pi * self.frequency)
        noise = [1 - share + share * (1 - c**2) / np.abs(1 - c * turn) ** 2 for c, share in shapes]
        parts = np.stack([np.stack([each, *motion]) for each in noise])
        unit = float(np.median(self.density))
        sizes, misses = _fit_sizes(self.density / unit, parts)
        return unit * sizes[:, 0], 2 * TAPERS * misses


def _fit_sizes(power: Array, parts: Array) -> tuple[Array, Array]:
    """Sizes (R, K) of spectra (R, K, F) that add up to a power (F,), and the negative log likelihood (R,)."""
    sizes = np.median(power / parts, axis=2) / parts.shape[1]
    for _ in range(N_UPDATES):
        whole = np.einsum("rk,rkf->rf", sizes, parts)
        asked = np.einsum("rkf,rf->rk", parts, np.minimum(power, LINE_FACTOR * whole) / whole**2)
        sizes = sizes * np.sqrt(asked / np.einsum("rkf,rf->rk", parts, 1 / whole))
    whole = np.einsum("rk,rkf->rf", sizes, parts)
    return sizes, np.sum(np.log(whole) + np.minimum(power / whole, LINE_FACTOR), axis=1)
