"""Low-pass a displacement: choose the smoother from the data, and bridge missing frames."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated, Any

import numpy as np
import scipy

from frictrack.base.errors import FrictrackError, raise_faults
from frictrack.measure.motion.banded_equations import TREND_ORDER, NoiseColour, SmootherData, cutoff_of, weighted_cubic
from frictrack.measure.motion.filter_methods import (
    METHODS,
    Smoother,
    describe_given_cutoff,
    describe_structure,
    interpolate_missing,
)
from frictrack.measure.motion.grid import FrameGrid, frame_grid, stencil_derivatives
from frictrack.measure.motion.noise import CorrelatedNoise, suspected_noise
from frictrack.measure.motion.place_forces import Course, PlaceForce, find_place_forces
from frictrack.measure.motion.smoother import Event, Structure
from frictrack.measure.motion.structure_search import (
    MAX_WHOLE_FRAMES,
    StructureSearch,
    alternatives,
    find_structure,
    mean_shift,
    window_data,
)
from frictrack.records import Array, Displacement, Filtered, Mask, stretches
from frictrack.settings.filters import KALMAN, STRUCTURAL, FilterChoice


@dataclass(frozen=True, eq=False)
class KnownAcceleration:
    """Acceleration at the frames, as a mean over one frame interval.

    Attributes
    ----------
    a
        Acceleration, m/s^2, (n,); NaN where unknown.
    sigma
        Standard deviation of its white noise, m/s^2, one number or (n,).

    Examples
    --------
    >>> import frictrack as ft
    >>> run = ft.samples.runs()[0]
    >>> known = ft.KnownAcceleration(run.motion.a, 5.0)
    >>> fused = ft.differentiate(ft.low_pass(run.displacement, acceleration=known))
    >>> bool(fused.sigma_a[75] < run.motion.sigma_a[75])
    True

    """

    a: Array
    sigma: float | Array


MISSING_SIGMA = float("inf")  # m, of a frame that was not measured
VIOLENT_RATIO = 10.0  # acceleration of a push or an impact over the median of the moving mass
MIN_SPEED_SHARE = 0.05  # of the highest speed, from which the mass counts as moving
MIN_FRAMES_FOR_CUTOFF = 16  # valid frames from which a cut-off can be estimated
MAX_CORRELATED = 0.999  # largest share and correlation of coloured noise
MAX_COLOUR_TRIALS = 40  # evaluations to fit correlation and share
MAX_SPECTRUM_FRAMES = 100_000  # in which coloured noise is suspected
FORCE_FRAMES = (100, MAX_WHOLE_FRAMES)  # of a record in which forces periodic in place are searched
MIN_FRAMES = 8  # valid frames from which noise can be estimated
MAX_POSITION_M = 1e5  # beyond it the digits of a position no longer hold the motion to the accuracy of its integration
MIN_TRAVEL_M = 1e-15  # of a moving target


def low_pass(
    displacement: Displacement,
    cutoff: Annotated[float, "Hz"] | None = None,
    *,
    method: str | FilterChoice = STRUCTURAL,
    acceleration: KnownAcceleration | None = None,
    noise: CorrelatedNoise | None = None,
) -> Filtered:
    """Low-pass a displacement from the first to the last measured frame, missing frames included.

    By default x and y are each decomposed into a trend, lines (vibrations), events and, for x, forces that are periodic
    in place, by the highest restricted likelihood, and the noise level is estimated with them. Standard deviations of
    the displacement count relative to each other only.

    Parameters
    ----------
    displacement
        Positions with standard deviations, n frames.
    cutoff
        Frequency at which half of the amplitude passes, Hz. With the default method it is that of a plain low-pass,
        which replaces the decomposition.
    method
        "structural" (default), "kalman" (a trend of one stiffness, process noise by maximum likelihood), "butterworth"
        (cut-off by residual analysis if not given), "savitzky-golay" (degree and window by generalised
        cross-validation), "gaussian-process" (maximum likelihood) or "papers" (Butterworth at 100 Hz of the
        displacement as it is, then central differences). A `FilterChoice` also sets order, window and direction.
    acceleration
        Acceleration by a sensor, used for x with "structural" and "kalman".
    noise
        Correlated noise that runs of the same instrument have shown, used with "structural" and "kalman"; by default
        each coordinate is tested by itself. With a `cutoff` and other methods noise counts as white.

    Returns
    -------
    Filtered
        Smoothed positions, estimated noise, cut-off, and the smoother.

    Raises
    ------
    FrictrackError
        For too few valid frames, a position that never changes, uneven time stamps, an unknown method or a setting that
        it does not take, or a cut-off outside 0 to half the frame rate.

    References
    ----------
    Harvey 1989, Forecasting, structural time series models and the Kalman filter; Winter 2009, Biomechanics and Motor
    Control of Human Movement, ch. 3 (residual analysis); Craven & Wahba 1979, Numer. Math. 31 (cross-validation).

    Examples
    --------
    >>> t = np.arange(200) / 1000.0
    >>> none, one = np.full(200, np.nan), np.ones(200)
    >>> x = 2.0 * t - 5.0 * t**2 + 1e-6 * np.random.default_rng(0).standard_normal(200)
    >>> filtered = low_pass(Displacement(t, x, none, none, 1e-6 * one, none, one == 1))
    >>> bool(np.max(np.abs(filtered.x - 2.0 * t + 5.0 * t**2)) < 2e-6)
    True

    """
    known = displacement.known
    _check_position(displacement.x[known], len(known))
    span = displacement.span
    displacement, known = displacement.rows(span), known[span]
    if acceleration is not None:
        sigma = np.broadcast_to(acceleration.sigma, len(acceleration.a))
        acceleration = KnownAcceleration(acceleration.a[span], sigma[span])
    grid = frame_grid(displacement.t)
    choice = method if isinstance(method, FilterChoice) else FilterChoice(method, cutoff)
    raise_faults(list(choice.faults()), "low_pass")
    _check_cutoff(choice.cutoff, grid)
    coordinate = _Coordinate(displacement.x, displacement.sigma_x, known, grid, rounded=bool(displacement.resolution))
    coordinate.colour = _noise_colour(noise) if choice.cutoff is None and method not in METHODS else None
    found = coordinate.low_passed(displacement.t, choice, acceleration, find_forces=True)
    known_y = displacement.valid & np.isfinite(displacement.y)
    if np.sum(known_y) >= MIN_FRAMES:
        y = _Coordinate(displacement.y, displacement.sigma_y, known_y, grid).low_passed(displacement.t, choice, None)
        found = replace(found, y=y.x, sigma_y=y.sigma_x, cutoff_y=y.cutoff)
        found = replace(found, y_measured=y.x_measured, smoother_y=y.smoother)
    found = replace(found, asked=not choice.is_default, repaired=displacement.repaired, shake=displacement.shake)
    return found if acceleration is None else replace(found, sigma_sensor=_sensor_sigma(acceleration))


def _longest_quiet_span(motion: Array, known: Mask, cutoff: float) -> slice:
    """Longest span of a motion (3, n) at least half a period of the cut-off away from pushes and impacts."""
    v, a = np.abs(motion[1:])
    moving = known & (v > MIN_SPEED_SHARE * np.max(v[known]))
    is_violent = known & (a > VIOLENT_RATIO * np.median(a[moving]))
    if not is_violent.any():
        return slice(0, len(v))
    reach = int(np.ceil(0.5 / cutoff)) + 1
    return _longest(scipy.ndimage.maximum_filter1d(is_violent, 2 * reach + 1, mode="constant") == 0)


def _event_rows(e: Event, grid: FrameGrid) -> tuple[int, int]:
    """First and last row of an event, from the centres of its differences."""
    first, last = np.searchsorted(grid.frames, [e.first + TREND_ORDER // 2, e.last + TREND_ORDER // 2])
    last_row = len(grid.frames) - 1
    return min(int(first), last_row), min(int(last), last_row)


class _Coordinate:
    """One coordinate on its grid of frames, without its cubic."""

    def __init__(self, y: Array, sigma: Array, known: Mask, grid: FrameGrid, *, rounded: bool = False) -> None:
        self.grid, self.known = grid, known
        self.w = grid.to_frames(frame_weights(sigma, known))
        self.y, self.trend = _without_cubic(grid.to_frames(np.where(known, y, 0.0)), self.w)
        self.colour: NoiseColour | None = None
        self.rounded = rounded  # whether rounding dominates the noise

    def low_passed(
        self, t: Array, choice: FilterChoice, acceleration: KnownAcceleration | None, *, find_forces: bool = False
    ) -> Filtered:
        """Low-pass as chosen; the coordinate is x of the result."""
        interval, cutoff, method = self.grid.interval, choice.cutoff, choice.method
        search = StructureSearch(SmootherData(self.y, self.w, colour=self.colour))
        stiff = search.stiff
        level = float(np.sqrt(stiff.factor_smoother(search.data).restricted_likelihood()[1]))
        best = cutoff_of(float(np.exp(stiff.stiffness[0])), interval)
        if method in METHODS:
            return self._apply_method(t, choice, level)
        if acceleration is not None:
            search = StructureSearch(self._with_sensor(acceleration, level))
        if cutoff is not None:
            structure, reason = Structure.low_pass(cutoff, interval), describe_given_cutoff(cutoff, best)
        else:
            structure, search.data = self._select_structure(search.data, method)
        smoother = Smoother(structure, colour=search.data.colour)
        variance, signal = _smoothed(structure, search.data)
        if choice.is_default and acceleration is None:
            smoother, variance, signal = self._with_forces_and_average(smoother, search.data, find_forces=find_forces)
            structure = smoother.structure or structure
        if cutoff is None:
            level = float(np.sqrt(variance))
            best = self._slide_cutoff(signal, best)
            reason = describe_structure(smoother, interval)
        return replace(
            self._result(t, signal, level, cutoff or best),
            smoother=str(smoother),
            x_measured=None if acceleration else self._measured(),
            reason=reason,
            events=tuple(_event_rows(e, self.grid) for e in structure.events),
            lines=tuple(omega / 2 / np.pi / interval for omega, _ in structure.lines),
        )

    def _with_forces_and_average(
        self, found: Smoother, data: SmootherData, *, find_forces: bool
    ) -> tuple[Smoother, float, Array]:
        """Add forces that are periodic in place and average over structures: smoother, noise variance, signal (n,)."""
        structure, shift = found.structure, np.zeros(len(self.y))
        forces: tuple[PlaceForce, ...] = ()
        assert structure is not None
        if find_forces and FORCE_FRAMES[0] <= len(self.y) <= FORCE_FRAMES[1]:
            course = Course(_smoothed(structure, data)[1] + self.trend, self.grid.interval)
            forces, structure = find_place_forces(data, structure, course)
            shift = course.displacement(forces)
            data = replace(data, y=np.where(self.w > 0, data.y - shift, 0.0))
        variance, signal = _smoothed(structure, data)
        groups = alternatives(data, structure)
        smoother = Smoother(structure, None, groups, data.colour, forces)
        return smoother, variance, signal + shift + mean_shift(data, structure, groups)

    def _select_structure(self, data: SmootherData, method: str) -> tuple[Structure, SmootherData]:
        """Structure of the highest likelihood with white or coloured noise, and the data with that noise."""
        colour = self._suspected_colour(data)
        if colour is None:
            return _select_by_likelihood(data, method), data
        part = self._longest_window(data)
        suspected = replace(part, colour=colour)
        coloured = replace(part, colour=_fit_colour(suspected, StructureSearch(suspected).stiff))
        pairs = [(_select_by_likelihood(kind, method), kind) for kind in (part, coloured)]
        structure, kind = min(pairs, key=lambda pair: StructureSearch(pair[1]).scored(pair[0]).penalised)
        data = replace(data, colour=_fit_colour(kind, structure))
        return structure if len(part.w) == len(data.w) else _select_by_likelihood(data, method), data

    def _suspected_colour(self, data: SmootherData) -> NoiseColour | None:
        """Coloured noise that the spectrum of the longest span without a missing frame suggests."""
        if data.colour or data.second_difference_weights is not None or self.rounded:
            return None
        span = _longest(self.w > 0)
        first = max(span.start, (span.start + span.stop - MAX_SPECTRUM_FRAMES) // 2)
        return _noise_colour(suspected_noise(self.y[first : min(first + MAX_SPECTRUM_FRAMES, span.stop)]))

    def _longest_window(self, data: SmootherData) -> SmootherData:
        """The data, or of a long record a window in the longest span without a missing frame."""
        span = _longest(self.w > 0)
        first = max(min((span.start + span.stop - MAX_WHOLE_FRAMES) // 2, len(self.w) - MAX_WHOLE_FRAMES), 0)
        is_long = len(self.w) > MAX_WHOLE_FRAMES
        return (is_long and window_data(data, first, first + MAX_WHOLE_FRAMES)) or data

    def _slide_cutoff(self, signal: Array, best: float) -> float:
        """Cut-off (Hz) of a plain low-pass of the slide alone; a push would raise that of the whole record."""
        motion = stencil_derivatives(signal + self.trend, self.grid.interval)
        span = _longest_quiet_span(motion, self.w > 0, best * self.grid.interval)
        if np.sum(self.w[span] > 0) < max(MIN_FRAMES_FOR_CUTOFF, 0.1 * len(self.w)) or span == slice(0, len(self.w)):
            return best
        w = self.w[span]
        y, _ = _without_cubic((self.y + self.trend)[span], w)
        stiff = StructureSearch(SmootherData(y, w, colour=self.colour)).stiff
        return cutoff_of(float(np.exp(stiff.stiffness[0])), self.grid.interval)

    def _apply_method(self, t: Array, choice: FilterChoice, level: float) -> Filtered:
        y = interpolate_missing(self.y + self.trend, self.w > 0)
        method = METHODS[choice.method].fit(y, level, choice, self.grid.interval)
        cutoff = method.cutoff / self.grid.interval
        reason = f"{method.name}, half passes at {cutoff:.3g} Hz" + ", forward only: delayed" * choice.causal
        passed = self._result(t, method.derived(y, 0) - self.trend, level, cutoff)
        return replace(passed, smoother=str(Smoother(method=method)), reason=reason, x_measured=self._measured())

    def _measured(self) -> Array:
        """Unfiltered rows (n,)."""
        return np.where(self.known, (self.y + self.trend)[self.grid.frames], np.nan)

    def _result(self, t: Array, smooth: Array, level: float, cutoff: float) -> Filtered:
        frames = self.grid.frames
        sigma, none = np.full(len(frames), MISSING_SIGMA), np.full(len(frames), np.nan)
        none.setflags(write=False)  # so that the record need not copy it
        sigma[self.known] = level / np.sqrt(self.w[frames][self.known])
        return Filtered(t, (smooth + self.trend)[frames], none, sigma, none, cutoff)

    def _with_sensor(self, acceleration: KnownAcceleration, level: float) -> SmootherData:
        """Data with the sensor's acceleration as second differences, without those of the cubic."""
        square = self.grid.interval**2
        second_differences = self.grid.to_frames(acceleration.a, np.nan)[1:-1] * square - np.diff(self.trend, 2)
        sigma = self.grid.to_frames(_sensor_sigma(acceleration), MISSING_SIGMA)[1:-1]
        weights = sensor_weights(sigma, square, level)
        return SmootherData(self.y, self.w, np.nan_to_num(second_differences), weights, self.colour)


def _fit_colour(data: SmootherData, structure: Structure) -> NoiseColour | None:
    """Colour of the highest likelihood with a given structure, starting at that of the data."""
    if data.colour is None:
        return None

    def colour(odds: Array) -> NoiseColour:
        low, high = MAX_CORRELATED, 1.0 - MAX_CORRELATED
        return NoiseColour(*np.clip(scipy.special.expit(odds), high, low).tolist())

    def loss(odds: Array) -> float:
        return StructureSearch(replace(data, colour=colour(odds))).loss(structure)

    start = scipy.special.logit(np.minimum([data.colour.correlation, data.colour.share], 0.99))
    options: Any = {"xatol": 0.1, "fatol": 0.1, "maxfev": MAX_COLOUR_TRIALS}
    return colour(scipy.optimize.minimize(loss, start, method="Nelder-Mead", options=options).x)


def _smoothed(structure: Structure, data: SmootherData) -> tuple[float, Array]:
    """Variance of the noise, and the signal (n,)."""
    factor = structure.factor_smoother(data)
    _, variance, unknowns = factor.restricted_likelihood()
    return variance, factor.signal(unknowns)


def _longest(mask: Mask) -> slice:
    """Longest stretch of a mask; an empty one if there is none."""
    return max(stretches(mask), key=lambda s: s.stop - s.start, default=slice(0, 0))


def _select_by_likelihood(data: SmootherData, method: str) -> Structure:
    """Structure of the highest likelihood; a trend of one stiffness for "kalman" and short records."""
    is_plain = method == KALMAN or data.count < MIN_FRAMES_FOR_CUTOFF
    return StructureSearch(data).stiff if is_plain else find_structure(data)


def _noise_colour(noise: CorrelatedNoise | None) -> NoiseColour | None:
    """Noise in the form of the smoother, which needs a white part, however small."""
    return NoiseColour(noise.correlation, min(noise.share, MAX_CORRELATED)) if noise else None


def _without_cubic(y: Array, w: Array) -> tuple[Array, Array]:
    """Series (n,) without its cubic, 0 in missing frames, and the cubic (n,)."""
    cubic = weighted_cubic(y, w)
    return np.where(w > 0, y - cubic, 0.0), cubic


def sensor_weights(sigma: Array, square: float, level: float) -> Array:
    """Compute the weights of second differences of the position from a sensor's accelerations."""
    return np.asarray((level / (sigma * square)) ** 2)


def _sensor_sigma(acceleration: KnownAcceleration) -> Array:
    """Standard deviations of the sensor (n,), inf where it has no value."""
    return np.where(np.isfinite(acceleration.a), acceleration.sigma, MISSING_SIGMA)


def frame_weights(sigma: Array, known: Mask) -> Array:
    """Weights of frames from their standard deviations.

    Parameters
    ----------
    sigma
        Standard deviations, m, (n,); NaN or 0 where not stated, which counts as the median.
    known
        Measured frames, (n,).

    Returns
    -------
    Array
        Weights with mean 1 over the known frames, 0 elsewhere, (n,).

    Examples
    --------
    >>> frame_weights(np.array([1.0, 1.0, 9.0]), np.array([True, True, False])).tolist()
    [1.0, 1.0, 0.0]

    """
    stated = known & np.isfinite(sigma) & (sigma > 0)
    usual = float(np.median(sigma[stated])) if np.any(stated) else 1.0
    w = np.where(known, np.where(stated, sigma, usual), np.inf) ** -2.0
    return np.asarray(w / np.mean(w[known]))


def _check_position(x: Array, n: int) -> None:
    """Raise FrictrackError for too few valid frames, or a target that does not move."""
    fault, far = "", float(np.min(np.abs(x), initial=np.inf))
    if len(x) < MIN_FRAMES:
        fault = f"at least {MIN_FRAMES} valid frames but got {len(x)} of {n}; check that the target was found"
    elif np.ptp(x) < MIN_TRAVEL_M:
        still = f"x is {x[0]:g} m in all {len(x)} valid frames"
        fault = f"a moving target but {still}; check which target was tracked"
    elif far > MAX_POSITION_M:
        beyond = f"positions within {MAX_POSITION_M:g} m of their origin but all lie {far:g} m away"
        fault = f"{beyond}; subtract a constant from the positions"
    if fault:
        raise FrictrackError(f"displacement: expected {fault}")


def _check_cutoff(cutoff: float | None, grid: FrameGrid) -> None:
    """Raise FrictrackError for a cut-off outside 0 to half the frame rate."""
    nyquist = 0.5 / grid.interval
    if cutoff is not None and not 0.0 < cutoff < nyquist:
        raise FrictrackError(
            f"cutoff: expected a frequency between 0 and half the frame rate, {nyquist:g} Hz, but got "
            f"{cutoff:g} Hz; leave it out to have it chosen from the data"
        )
