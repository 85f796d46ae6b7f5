"""Align the clock of a sensor with the camera's by maximum likelihood, to far below one frame.

    camera's differences = gain * sensor's differences at (t - offset) + bias + other known terms + noise

The noise is that of the camera plus gain^2 times that of the sensor, both with their exact covariance
(`frame_differences`). So every frequency has its proper weight: the sensor where the camera's noise dominates the
acceleration, the camera where the sensor drifts. The sensor is a regressor with noise: the expected part of its noise
is subtracted from the normal equations (Fuller 1987, Measurement Error Models, ch. 2); otherwise the gain would be
biased low and the offset would appear too certain.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import scipy
from numpy.typing import NDArray

from frictrack.base.distributions import chi2_sf
from frictrack.measure.sensors.sensor_record import FrameDifferences, SensorRecord, Whitener, second_differences
from frictrack.records import Array, Displacement, Mask, Motion

OFFSET_STEP = 0.5  # between two offsets that are tried, in frame (or sensor, if longer) intervals
TABLE_STEP = 0.125  # of the same interval: the grid on which the sensor is tabulated for the search
MAX_SEARCH_VALUES = 2e7  # that a search may compute; it bounds how far offsets are searched
MIN_OVERLAP = 0.5  # share of the film that the sensor must cover
MIN_DIFFERENCES = 16  # fewer differences cannot be aligned
MIN_EXPLAINED_CHI2 = 30.0  # that the sensor must explain: over thousands of offsets, chance reaches 20
MAX_RIVAL_CHI2 = 40.0  # within which minima are compared; with any prior here, those beyond are impossible
COARSE_SCAN_ERROR = 0.05  # of the chi2 that the sensor explains: error of a minimum of the scan before it is refined
MAX_RIVAL_PROBABILITY = 1e-3  # of another offset, from which the alignment is ambiguous
SAME_OFFSET_SIGMAS = 3.0  # standard deviations within which two minima are one offset
LIKELY_SHARE = 0.01  # of the highest probability; of the offsets above it the nearest to 0 is stated
NEGATIVE_GAIN_PRIOR = 0.05  # over that of a positive gain: more sensors are mounted the right way round
GAIN_SPREAD = 0.2  # half-width of the prior of log |gain|, of Cauchy's shape: another unit stays possible
MAX_ITERATIONS = 20
MIN_RATE_SIGMAS = 4.0  # standard deviations from which the two clocks are reported to run at different rates
MAX_RATE = 0.05  # relative; a record whose rate is off by more has no usable clock
MIN_DIFFERENCES_FOR_RATE = 200  # differences from which a difference of rates can be measured
MAX_GAIN_CHANGE = 1.5  # between the search and the refined alignment; more is another motion, such as a drift
SEARCH_GAINS = (1.0, 1e-3)  # gains at which the sensor's noise is weighed in the search: its unit may be another
FREQUENCIES = (np.arange(512) + 0.5) * np.pi / 512  # rad per frame, at which noises are compared
ALPHA_WHITENESS = 1e-3  # significance level at which the residual is judged not to be white
LOWEST_BAND_SIZE = 8  # coefficients in the lowest band of the residual's spectrum
SCORE_BLOCKS = 24  # parts of the record whose scores are summed where the residual is not white
MIN_SPEED_SIGMAS = 3.0  # |v| over sigma_v; above it friction has the sign of the motion


@dataclass(frozen=True)
class Alignment:
    """Clock and scale of a sensor relative to the camera; None where the data do not determine a value.

    The model is a = gain * sensor(t - offset + rate * (t - middle)) + bias.

    Attributes
    ----------
    offset, sigma_offset : float
        Time to add to the sensor's clock to obtain the camera's at `middle`, and its standard deviation, s.
    gain, sigma_gain : float or None
        Camera over sensor, and its standard deviation.
    bias, sigma_bias : float or None
        Zero error, in the unit of the camera's differences, m/s^2.
    rate, sigma_rate : float
        Relative amount by which the sensor's clock runs fast.
    middle : float
        Camera time to which the offset refers, s.
    reason : str
        Why the offset was chosen, or why it is not determined.
    level : float
        Factor on the variance of the sensor's noise; for a drive the variance of unknown forces.
    rivals : tuple of (float, float, float)
        Offset (s), gain and probability of other offsets that the data leave possible, the likeliest first.

    """

    offset: float
    sigma_offset: float | None
    gain: float | None
    sigma_gain: float | None
    bias: float | None
    sigma_bias: float | None
    rate: float
    sigma_rate: float | None
    middle: float
    reason: str
    level: float = 1.0  # of the sensor's noise in variance; in the drive's case that of the forces nobody knows
    rivals: tuple[tuple[float, float, float], ...] = ()

    def lag(self, t: Array) -> Array:
        """Compute by how much the sensor's clock is behind the camera's.

        `t` (n,): camera times, s. The result is in s.
        """
        return np.asarray(self.offset - self.rate * (t - self.middle))


@dataclass(frozen=True, eq=False)
class AlignmentProblem:
    """Data of an alignment.

    Attributes
    ----------
    frames : FrameDifferences
        Second differences of the camera.
    series : SensorRecord
        Record of the sensor.
    other_regressors : array (r, p)
        Other terms that act, m/s^2.
    sigma : float or None
        White noise of a sample. None where it is unknown, as are further forces (a drive under friction); it is then
        estimated.

    """

    frames: FrameDifferences
    series: SensorRecord
    other_regressors: Array
    sigma: float | None = None

    def rows(self, alignment: Alignment) -> Mask:
        """Find the differences during which the sensor was running.

        Returns the rows of the problem.
        """
        first, last = self.frames.ends()
        return self.series.covers(first - alignment.lag(first), last - alignment.lag(last))

    def select(self, rows: Mask) -> AlignmentProblem:
        """Select some of the differences.

        `rows` (r,): differences to keep.
        """
        return replace(self, frames=self.frames.select(rows), other_regressors=self.other_regressors[rows])


@dataclass(frozen=True, eq=False)
class AlignmentFit:
    """Linearised solution.

    Attributes
    ----------
    theta : array (p,)
        Gain, step of the offset, step of the rate if it is free, then the other regressors.
    covariance : array (p, p)
        Their covariance.
    residual, regressors : array (r,), array (r, p)
        Both whitened.

    """

    theta: Array  # gain, step of the offset, step of the rate or none, then what acts beside
    covariance: Array
    residual: Array
    regressors: Array


def _unaligned(frames: FrameDifferences, offset: float = 0.0, reason: str = "") -> Alignment:
    """Alignment of which at most the offset is known."""
    middle = float(np.mean(frames.t[[0, -1]]))
    return Alignment(offset, None, None, None, None, None, 0.0, None, middle, reason)


def align(problem: AlignmentProblem, offset: float | None = None) -> Alignment:
    """Align a sensor with the camera.

    `offset`: known offset, s; by default it is estimated. Where the data do not determine the offset it is 0,
    its standard deviation None, and `reason` says why.

    References
    ----------
    W. A. Fuller, Measurement Error Models (1987), ch. 2.

    """
    given = offset is not None
    initial = _unaligned(problem.frames, offset or 0.0, "as given" if given else "")
    fault = _obstacle(problem, initial if given else None)
    if fault:
        return replace(initial, reason=f"{initial.reason}, {fault}" if given else f"{fault}; 0 is kept")
    if given:
        return _iterate(problem, initial, 1)
    for gain in SEARCH_GAINS if problem.sigma is not None else SEARCH_GAINS[:1]:
        initial = _search_at_gain(problem, gain)
        if initial.gain is not None:
            break
    else:
        return initial
    accepted = _accepted(problem, initial, _refine(problem, initial))
    if accepted.gain is None and problem.sigma is not None:  # a sensor that creeps is aligned all the same
        creeping = replace(problem, other_regressors=_with_drift(problem))
        accepted = _accepted(problem, initial, _refine(creeping, initial))
    return accepted


def _obstacle(problem: AlignmentProblem, given: Alignment | None) -> str:
    """State why nothing can be aligned; "" where it can."""
    series, t = problem.series, problem.frames.t
    if len(problem.frames.z) < MIN_DIFFERENCES:
        return f"expected at least {MIN_DIFFERENCES} neighbouring frames but got {len(problem.frames.z)}"
    if len(series.t) < MIN_DIFFERENCES:
        return f"expected at least {MIN_DIFFERENCES} samples but got {len(series.t)}"
    if np.ptp(series.values[series.known]) == 0.0:
        return "it is constant, so that no offset can be determined"
    if given is not None and np.sum(problem.rows(given)) < MIN_DIFFERENCES:
        running = f"{series.t[0] + given.offset:.4g} s to {series.t[-1] + given.offset:.4g} s"
        return f"it was running from {running} but the film lasts from {t[0]:.4g} s to {t[-1]:.4g} s"
    return ""


def _candidate_offsets(problem: AlignmentProblem) -> Array:
    """Offsets to try: those with the sensor over half of the film, as near to 0 as the effort allows."""
    t, s = problem.frames.t, problem.series.t
    span = float(t[-1] - t[0])
    least = min(MIN_OVERLAP * span, 0.9 * float(s[-1] - s[0]))
    low, high = t[0] + least - s[-1], t[-1] - least - s[0]
    step = OFFSET_STEP * max(problem.frames.interval, problem.series.interval)
    middle = 0.0 if low <= 0.0 <= high else (low + high) / 2.0
    reach = MAX_SEARCH_VALUES / len(t) / 2.0 * step
    low, high = max(low, middle - reach), min(high, middle + reach)
    return middle + step * np.arange(np.ceil((low - middle) / step), np.floor((high - middle) / step) + 1)


def _search_at_gain(problem: AlignmentProblem, gain: float) -> Alignment:
    """The most probable of many offsets, with the sensor's noise weighted for this gain."""
    frames, offsets = problem.frames, _candidate_offsets(problem)
    initial = replace(_unaligned(frames), gain=gain)
    initial = replace(initial, level=_unmodelled_variance(problem, initial, sensor_included=False))
    misfit, none, gains = _scan(problem, offsets, initial)
    lowest = int(np.argmin(misfit))
    if problem.sigma is None:  # now that the drive may explain some of it, the rest is smaller
        level = _unmodelled_variance(problem, replace(initial, offset=float(offsets[lowest])))
        initial = replace(initial, level=level)
        misfit, none, _ = _scan(problem, offsets, initial)
    elif none - misfit[lowest] > MIN_EXPLAINED_CHI2:  # with the sensor's noise at its likeliest gain
        lowest = int(np.argmin(misfit - 2.0 * np.log(_gain_prior(gains))))
        initial = replace(initial, gain=abs(float(gains[lowest])))
        misfit, none, _ = _scan(problem, offsets, initial)
    explained = none - float(np.min(misfit))
    span = f"{1e3 * offsets[0]:.4g} to {1e3 * offsets[-1]:.4g} ms"
    if explained < MIN_EXPLAINED_CHI2:
        return _unaligned(frames, reason=f"at no offset from {span} does it agree with the camera; 0 is kept")
    share = _sensor_share(problem, initial)
    # camera times sensor noise is in chi2 of every offset; as each has other products, chi2 of two differs by chance
    own_noise = 8.0 * len(frames.z) * float(np.mean(share * (1.0 - share)))
    within = MAX_RIVAL_CHI2 + 4.0 * np.sqrt(own_noise) + COARSE_SCAN_ERROR * explained
    at, misfit, gains = _refined_minima(problem, offsets, misfit, within, initial)
    fall = (misfit - np.min(misfit)) / max(1.0, float(np.min(misfit)) / len(frames.z))
    log_posterior = -2.0 * fall**2 / np.maximum(4.0 * fall + own_noise, 1e-300)
    if problem.sigma is not None:  # the gain of a drive is a mass
        log_posterior += np.log(_gain_prior(gains))
    probability = np.exp(log_posterior - np.max(log_posterior))
    probability /= np.sum(probability)
    likely = np.flatnonzero(probability > LIKELY_SHARE * np.max(probability))
    chosen = likely[np.argmin(np.abs(at[likely]))]
    others = [k for k in np.argsort(-probability) if k != chosen and probability[k] > MAX_RIVAL_PROBABILITY]
    rivals = tuple((float(at[k]), float(gains[k]), float(probability[k])) for k in others)
    best = replace(initial, offset=float(at[chosen]), gain=float(gains[chosen]))
    return replace(best, rivals=rivals, reason=f"best of {span}")


def _refined_minima(
    problem: AlignmentProblem, offsets: Array, misfit: Array, within: float, initial: Alignment
) -> tuple[Array, Array, Array]:
    """Offsets, chi2 and gains (k,) at the minima of a scan; a parabola on a finer grid gives each vertex."""
    step = float(offsets[1] - offsets[0]) if len(offsets) > 1 else 0.0
    k = _minima(misfit, within)
    at = offsets[k] + step * _vertex(misfit[k - 1], misfit[k], misfit[k + 1])
    at, step = (at if len(k) else offsets[[np.argmin(misfit)]]), step / 4.0
    around, _, _ = _scan(problem, (at[:, None] + step * np.arange(-1.0, 2.0)).ravel(), initial)
    at = at + step * _vertex(*around.reshape(-1, 3).T)
    misfit, _, gains = _scan(problem, at, initial)
    return at, misfit, gains


def _vertex(left: Array, middle_value: Array, right: Array) -> Array:
    """Vertex of the parabola through three values, in steps from the middle, at most 2."""
    curvature = left - 2.0 * middle_value + right
    return np.clip((left - right) / (2.0 * np.where(curvature > 0.0, curvature, np.inf)), -2.0, 2.0)


def _gain_prior(gain: Array) -> Array:
    """Relative prior probability of gains: the right sign and unit are likeliest, others possible."""
    size = np.log(np.maximum(np.abs(gain), 1e-300)) / GAIN_SPREAD
    return np.where(gain < 0.0, NEGATIVE_GAIN_PRIOR, 1.0) / (1.0 + size**2)


def _scan(problem: AlignmentProblem, offsets: Array, initial: Alignment) -> tuple[Array, float, Array]:
    """chi2 (k,) and gain (k,) at every offset, and chi2 without the sensor."""
    frames = problem.frames
    white = Whitener(_covariance(problem, replace(initial, offset=float(np.median(offsets)))))
    basis = np.linalg.qr(white(_with_drift(problem)))[0]
    residual = white(frames.z)
    residual = residual - basis @ (basis.T @ residual)
    misfit, gains = np.empty(len(offsets)), np.empty(len(offsets))
    at, table = frames.t[frames.centre], _table(problem, offsets)
    for part in np.array_split(np.arange(len(offsets)), max(len(offsets) * len(frames.t) // 2_000_000, 1)):
        sensed = white(np.interp(at[:, None] - offsets[part], *table))
        size = np.sum(sensed**2, axis=0)
        sensed -= basis @ (basis.T @ sensed)
        power = np.sum(sensed**2, axis=0)
        gain = np.where(power > 1e-9 * size, residual @ sensed / np.maximum(power, 1e-300), 0.0)
        misfit[part], gains[part] = float(residual @ residual) - gain**2 * power, gain
    none = float(residual @ residual)
    if problem.sigma is not None:  # `white` divides by the sensor's noise at one gain and over the whole film
        ends, clock = frames.t[[0, -1]], problem.series.t[[0, -1]]
        shared = np.minimum(ends[1], clock[1] + offsets) - np.maximum(ends[0], clock[0] + offsets)
        covered = np.clip(shared / (ends[1] - ends[0]), 0.0, 1.0)
        own_noise = len(frames.z) * float(np.mean(_sensor_share(problem, initial)))
        ratio = np.minimum(np.abs(gains) / (initial.gain or 1.0), MAX_GAIN_CHANGE)  # no noise times a huge gain
        misfit -= own_noise * covered * ratio**2
    return misfit, none, gains


def _table(problem: AlignmentProblem, offsets: Array) -> tuple[Array, Array]:
    """Differences of the sensor over three frames on a fine grid of its own clock: times and values."""
    frames, h = problem.frames, problem.frames.interval
    ends = frames.t[frames.centre[[0, -1]]] - np.array([np.max(offsets), np.min(offsets)])
    count = int((ends[1] - ends[0]) / (TABLE_STEP * max(h, problem.series.interval))) + 2
    u = np.linspace(ends[0], ends[1], count)
    before, middle_value, after = (problem.series.integral(u + k * h, 2) for k in (-1.0, 0.0, 1.0))
    return u, (before - 2.0 * middle_value + after) / h**2


def _with_drift(problem: AlignmentProblem) -> Array:
    """Other regressors and a linear drift, so that the drift of a sensor is not matched."""
    t = problem.frames.t[problem.frames.centre]
    return np.concatenate([(t - np.mean(t))[:, None] / np.std(t), problem.other_regressors], axis=1)


def _sensor_share(problem: AlignmentProblem, initial: Alignment) -> Array:
    """Share of the sensor's noise in that of the differences, at `FREQUENCIES`."""
    covariance = _covariance(problem, initial)
    return np.clip(1.0 - _spectrum(problem.frames.camera) / _spectrum(covariance), 0.0, 1.0)


def _minima(values: Array, within: float) -> NDArray[np.int64]:
    """Local minima whose vertex, by a parabola through three values, is near the lowest of all."""
    left, middle_value, right = values[:-2], values[1:-1], values[2:]
    lowest = middle_value - (left - right) * _vertex(left, middle_value, right) / 4.0
    lowest = np.where((middle_value <= left) & (middle_value < right), lowest, np.inf)
    return np.flatnonzero(lowest < np.min(lowest, initial=np.inf) + within) + 1


def _covariance(problem: AlignmentProblem, at: Alignment) -> scipy.sparse.csr_array:
    """Covariance of the differences: camera plus sensor, or what nobody knows."""
    sigma = 1.0 if problem.sigma is None else (at.gain or 1.0) * problem.sigma
    return problem.frames.camera + at.level * sigma**2 * problem.frames.noise(problem.series, at.offset)


def _unmodelled_variance(problem: AlignmentProblem, alignment: Alignment, *, sensor_included: bool = True) -> float:
    """Variance of unknown white forces by restricted maximum likelihood; 1 where the noise is known."""
    if problem.sigma is not None:
        return 1.0
    frames = problem.frames
    shape = frames.noise(problem.series, alignment.offset)
    regressors = problem.other_regressors
    if sensor_included:
        sensed = frames.sensor_differences(problem.series, alignment.lag(frames.t)[:, None])
        regressors = np.concatenate([sensed, regressors], axis=1)
    typical = float(np.mean(frames.camera.diagonal()) / np.mean(shape.diagonal()))

    def loss(log_level: float) -> float:
        white = Whitener(frames.camera + float(np.exp(log_level)) * shape)
        q, r = np.linalg.qr(white(regressors))
        z = white(frames.z)
        residual = z - q @ (q.T @ z)
        size = np.abs(np.diag(r))
        logdet = white.logdet + 2.0 * float(np.sum(np.log(size[size > 1e-12 * np.max(size)])))
        return logdet + float(residual @ residual)

    bounds = np.log(typical) + np.array([-25.0, 10.0])
    best = scipy.optimize.minimize_scalar(loss, bounds=bounds, method="bounded", options={"xatol": 0.02})
    return float(np.exp(best.x))


def _refine(problem: AlignmentProblem, initial: Alignment) -> Alignment:
    """Refine an offset near the best by Gauss-Newton, and the rate where it is significant."""
    found = _iterate(problem, initial, 2)
    if len(problem.frames.z) >= MIN_DIFFERENCES_FOR_RATE and found.sigma_offset is not None:
        drifting = _iterate(problem, found, 3)
        if drifting.sigma_rate is not None and MIN_RATE_SIGMAS * drifting.sigma_rate < abs(drifting.rate):
            return drifting
    return found


def _iterate(problem: AlignmentProblem, found: Alignment, unknowns: int) -> Alignment:
    """Iterate Gauss-Newton until the offset changes by less than a thousandth of its standard deviation."""
    max_step = OFFSET_STEP * max(problem.frames.interval, problem.series.interval)
    for _ in range(MAX_ITERATIONS):
        rows = problem.rows(found)
        if np.sum(rows) < MIN_DIFFERENCES or abs(found.rate) > MAX_RATE:
            return _unaligned(problem.frames)
        fitted = fit_alignment(problem.select(rows), found, unknowns)
        found = _updated(found, fitted, unknowns, max_step)
        if unknowns == 1 or abs(fitted.theta[1]) < 1e-3 * np.sqrt(max(fitted.covariance[1, 1], 0.0)):
            break
    kept = problem.select(rows)
    if problem.sigma is None:
        found = replace(found, level=_unmodelled_variance(kept, found))
    return _updated(found, fit_alignment(kept, found, unknowns), unknowns, max_step)


def _updated(found: Alignment, fitted: AlignmentFit, unknowns: int, max_step: float) -> Alignment:
    """Alignment after one step."""
    std, theta = np.sqrt(np.maximum(np.diag(fitted.covariance), 0.0)).tolist(), fitted.theta.tolist()
    known = {"gain": theta[0], "sigma_gain": std[0], "bias": theta[-1], "sigma_bias": std[-1]}
    changed = replace(found, **known, sigma_offset=None, sigma_rate=None)
    if unknowns > 1:
        step = min(max(theta[1], -max_step), max_step)
        changed = replace(changed, offset=found.offset + step, sigma_offset=std[1])
    return replace(changed, rate=found.rate + theta[2], sigma_rate=std[2]) if unknowns > 2 else changed


def fit_alignment(problem: AlignmentProblem, at: Alignment, unknowns: int = 2) -> AlignmentFit:
    """Solve the linear problem about an alignment.

    `problem`: rows with both; `unknowns`: 1 for the gain, 2 with the offset, 3 with the rate as well. The last
    regressor is the bias.
    """
    frames, series = problem.frames, problem.series
    gain = 1.0 if at.gain is None else at.gain
    lag = at.lag(frames.t)[:, None]
    dilated = (1.0 + at.rate) ** 2  # of time, in which the sensor is integrated twice
    columns = [frames.sensor_differences(series, lag) / dilated]
    if unknowns > 1:
        slope = -gain * frames.sensor_differences(series, lag, 1) / dilated
        columns += [slope, slope * (at.middle - frames.t[frames.centre])[:, None]][: unknowns - 1]
    noise = frames.noise(series, at.offset)
    covariance = frames.camera + at.level * (1.0 if problem.sigma is None else gain * problem.sigma) ** 2 * noise
    white = Whitener(covariance)
    regressors = white(np.concatenate([*columns, problem.other_regressors], axis=1))
    z = white(frames.z)
    size = np.sqrt(np.sum(regressors**2, axis=0)) + 1e-300
    normal = (regressors / size).T @ (regressors / size)
    share = _noise_share(problem, covariance, noise, gain) / size[:2] ** 2
    corrected = normal.copy()
    for k in range(min(unknowns, 2)):
        corrected[k, k] -= min(float(share[k]), 0.5)
    inverse = np.linalg.pinv(corrected, rcond=1e-10, hermitian=True)
    theta = inverse @ ((regressors / size).T @ z) / size
    residual = z - regressors @ theta
    modelled = whiteness_test(regressors, residual)[0] > ALPHA_WHITENESS
    score_spread = normal if modelled else _score_covariance(regressors / size, residual)
    return AlignmentFit(theta, inverse @ score_spread @ inverse / np.outer(size, size), residual, regressors)


def whiteness_test(regressors: Array, residual: Array) -> tuple[float, Array]:
    """Test whether a residual is white.

    `regressors` (r, p): whitened regressors, whose degrees of freedom are subtracted from each band; `residual` (r,):
    whitened residual. Returns `p`, probability of the strongest octave or line under white noise, times the number of
    octaves and lines; `excess` (r,), cosine power spectrum less its expectation.

    Examples
    --------
    >>> rng = np.random.default_rng(0)
    >>> bool(whiteness_test(np.ones((256, 1)), rng.standard_normal(256))[0] > 1e-3)
    True

    """
    power = np.asarray(scipy.fft.dct(residual, norm="ortho")) ** 2
    basis = scipy.fft.dct(np.linalg.qr(regressors)[0], axis=0, norm="ortho")
    free = 1.0 - np.sum(basis**2, axis=1)
    n = len(power)
    edges = [0, *(LOWEST_BAND_SIZE * 2**k for k in range(32) if LOWEST_BAND_SIZE * 2**k < 0.75 * n), n]
    p = [chi2_sf(np.sum(power[i:j]), max(float(np.sum(free[i:j])), 0.5)) for i, j in pairwise(edges)]
    line = n * float(chi2_sf(np.max(power[1:] + power[:-1]), 2))
    return min(1.0, 2.0 * float(np.min(p)) * len(p), 2.0 * line), power - free


def _noise_share(
    problem: AlignmentProblem, covariance: scipy.sparse.csr_array, noise: scipy.sparse.csr_array, gain: float
) -> Array:
    """Part that the sensor's own noise adds to the squares of its white differences, and to those of their slope."""
    sigma = problem.series.sigma if problem.sigma is None else problem.sigma
    whole = _spectrum(covariance)
    ratio = sigma**2 * np.maximum(_spectrum(noise), 0.0) / np.maximum(whole, 1e-12 * np.max(whole))
    omega = FREQUENCIES / problem.frames.interval
    return len(problem.frames.z) * np.array([np.mean(ratio), gain**2 * np.mean(ratio * omega**2)])


def _spectrum(covariance: scipy.sparse.csr_array) -> Array:
    """Power spectrum at `FREQUENCIES` of the noise with this covariance, from its middle row."""
    middle = covariance.shape[0] // 2
    after = np.trim_zeros(covariance[[middle]].toarray()[0, middle:], "b")
    lag = np.arange(1, len(after))
    return np.asarray(after[0] + 2.0 * np.cos(np.outer(FREQUENCIES, lag)) @ after[1:])


def _score_covariance(regressors: Array, residual: Array) -> Array:
    """Covariance of the scores, from parts of the record long enough to be independent."""
    parts = np.array_split(np.arange(len(residual)), min(SCORE_BLOCKS, max(len(residual) // 8, 2)))
    sums = np.array([regressors[p].T @ residual[p] for p in parts])
    return np.asarray(sums.T @ sums) * len(parts) / max(len(parts) - regressors.shape[1], 1)


def _accepted(problem: AlignmentProblem, initial: Alignment, found: Alignment) -> Alignment:
    """The alignment if its offset is significant, else 0 and the reason."""
    reach = 4.0 * max(problem.frames.interval, problem.series.interval)
    span = float(problem.frames.t[-1] - problem.frames.t[0])
    gain, sigma = found.gain, found.sigma_offset
    if gain is None or abs(gain) < np.sqrt(MIN_EXPLAINED_CHI2) * (found.sigma_gain or 0.0):
        fault = "at no offset does it agree with the camera"
    elif problem.sigma is not None and not 1 / MAX_GAIN_CHANGE < gain / (initial.gain or np.inf) < MAX_GAIN_CHANGE:
        fault = "its gain is not determined"
    elif sigma is None or not 0.0 < sigma < 0.1 * span:
        fault = "its offset is not determined"
    elif abs(found.offset - initial.offset) > max(reach, 5.0 * sigma):
        fault = "its offset did not converge"
    else:
        return _with_rivals(found)
    return _unaligned(problem.frames, reason=f"{fault}; 0 is kept")


def _with_rivals(found: Alignment) -> Alignment:
    """The alignment without rivals at the same offset, and with the others in its deviation and its reason."""
    assert found.sigma_offset is not None
    others = tuple(r for r in found.rivals if abs(r[0] - found.offset) > SAME_OFFSET_SIGMAS * found.sigma_offset)
    if not others:
        return replace(found, rivals=())
    offset, gain, probability = others[0]
    spread = np.sqrt(sum(p * (o - found.offset) ** 2 for o, _, p in others))
    reason = f"ambiguous, {1e3 * offset:.4g} ms with gain {gain:.3g} agrees, too (probability {probability:.2g})"
    return replace(found, rivals=others, reason=reason, sigma_offset=float(np.hypot(found.sigma_offset, spread)))


def align_drive(
    displacement: Displacement,
    motion: Motion,
    series: SensorRecord,
    *,
    offset: float | None = None,
    until: float = np.inf,
) -> Alignment:
    """Align a measured drive with the camera: a = D(t - offset) / m - F_c/m sgn v - F_v/m v + const.

    The gain is 1/m. Coulomb and viscous friction, gravity on an incline and a zero error are fitted as well. Other
    forces
    are taken as white, and their level is estimated. The standard deviation of the offset comes from the scatter over
    parts of the record. Frames at rest do not count, because static friction is undetermined.

    `displacement`: displacement of the slider, m; `motion`: its velocity, m/s; `series`: drive force, N; `offset`:
    known offset, s; `until`: time after which frames do not count, s. Returns the clock of the drive and 1/m.
    """
    frames = second_differences(displacement.rows(displacement.span))
    about = frames.map.indices.reshape(-1, 3)  # the three frames of each difference
    sure = motion.v[about] / motion.sigma_v[about]
    one_way = np.all(sure > MIN_SPEED_SIGMAS, axis=1) | np.all(sure < -MIN_SPEED_SIGMAS, axis=1)
    frames = frames.select(one_way & (frames.ends()[1] <= until))
    v = motion.v[frames.centre]
    friction = [-np.sign(v)] if np.ptp(np.sign(v)) > 0 else []  # else the constant stands for it
    return align(AlignmentProblem(frames, series, np.stack([*friction, -v, np.ones(len(v))], axis=1)), offset)
