"""Find noise of a displacement series that is correlated between neighbouring frames.

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

import numpy as np
import scipy

from frictrack.base.distributions import chi2_isf, robust_std
from frictrack.records import Array
from frictrack.sampling import DIFFERENCE_ORDER

OUTLIER_SIGMAS = 6.0  # robust standard deviations beyond which a difference belongs to an impact
MIN_HALF_WAVE_FRAMES = 4  # frames in half a period of the fastest slow error


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
    # noise of the instrument is the same in all runs, forces are not: runs that agree are tested lower down, too
    lowest = [MIN_FREQUENCY, MIN_FREQUENCY / 2] if len(stretches) >= MIN_RUNS else [MIN_FREQUENCY]
    found = n_shapes and any(_is_consistent(NoiseStretch.evidence(stretches, f, n_shapes)) for f in lowest)
    return _best_shape(stretches, n_shapes) if found else None


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
