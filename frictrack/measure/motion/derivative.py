"""Compute velocity and acceleration of a low-passed displacement, with standard deviations and covariances.

The deviations count the noise let through, the signal lost, and the errors of line frequencies and forces. The
posterior covariance assumes a signal that is as rough as the penalties say, on average over the record. Smoothing the
smoothed series once more (twicing; Tukey 1977, Exploratory Data Analysis, ch. 16) shows where it is smoother or
rougher: with the smoother A, (1 - A) A y of such a signal has the covariance A^2 (1 - A), of which A^2 (1 - A)^2 is
noise and A^3 (1 - A) is signal.

Filters are compared with that best estimate of the motion: cut-offs of a plain low-pass, and what each filter makes of
it. Residual analysis (Winter 2009, Biomechanics and Motor Control of Human Movement, ch. 3): what a low-pass removes
falls with its cut-off until only noise is removed, and then follows the level of white noise. The removed signal is
computed from the series of the structural smoother, the best estimate of the motion.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import NamedTuple
from weakref import WeakKeyDictionary

import numpy as np
import scipy
from numpy.polynomial import Polynomial
from numpy.typing import NDArray

from frictrack.base.distributions import robust_std
from frictrack.base.errors import FrictrackError
from frictrack.measure.motion.banded_equations import (
    TREND_ORDER,
    NoiseColour,
    SmootherData,
    penalty,
    response,
    weighted_cubic,
)
from frictrack.measure.motion.filter import MISSING_SIGMA, frame_weights, low_pass, sensor_weights
from frictrack.measure.motion.filter_methods import Smoother, interpolate_missing
from frictrack.measure.motion.grid import (
    STENCIL_REACH,
    FrameGrid,
    frame_grid,
    stencil_derivative,
    stencil_derivatives,
    stencil_start,
    stencil_weights,
    stencils,
)
from frictrack.measure.motion.place_forces import Course, place_force_errors
from frictrack.measure.motion.smoother import FactoredSmoother, Structure
from frictrack.measure.motion.structure_search import (
    MAX_WHOLE_FRAMES,
    added_variances,
    mean_shift,
    undetectable_amplitude,
)
from frictrack.records import Array, CutoffTradeOff, Displacement, Filtered, Mask, Motion, mask_of_spans

QUANTITIES = ("x", "v", "a")
FRAMES_AT_ONCE = 1 << 16  # whose stencils are held
_BEST: WeakKeyDictionary[Filtered, Filtered] = WeakKeyDictionary()


def differentiate(filtered: Filtered) -> Motion:
    """Compute velocity and acceleration of a low-passed displacement by finite differences.

    Stencils have five points inside and six at the ends; they are exact for polynomials up to fourth order. Standard
    deviations follow from the covariance of the smoother: noise let through and signal removed. Where the acceleration
    jumps between two frames, sigma_a covers the values on both sides. The remainder of a camera shake is included.

    Parameters
    ----------
    filtered
        Displacement of n frames, smoothed by `low_pass`.

    Returns
    -------
    Motion
        x (m), v (m/s) and a (m/s^2) with standard deviations, each (n,). Its `guard` is the number of frames at an end
        that are not reliable: half a period of the cut-off, which reduces an abrupt event to a fifth, or the end frames
        with sigma_a above twice its median if these are more; at most an eighth of the record.

    Examples
    --------
    >>> from frictrack.measure.motion import low_pass
    >>> from frictrack.records import Displacement
    >>> t = np.arange(200) / 1000.0
    >>> none, one = np.full(200, np.nan), np.ones(200)
    >>> x = 2.0 * t - 5.0 * t**2 + 1e-6 * np.random.default_rng(0).standard_normal(200)
    >>> motion = differentiate(low_pass(Displacement(t, x, none, none, 1e-6 * one, none, one == 1)))
    >>> bool(abs(motion.a[100] + 10.0) < 0.1)
    True

    """
    of_x = Derivatives.of_x(filtered)
    sigma, values = of_x.deviations(), of_x.values()
    if filtered.events:
        sigma[2] = np.hypot(sigma[2], _jump_deviation(values[2], filtered.events))
    shake_a = 0.0
    if filtered.shake:
        shake = of_x.shake_errors(*filtered.shake)
        sigma, shake_a = np.hypot(sigma, shake), float(np.sqrt(np.mean(shake[2] ** 2)))
    a_y = sigma_a_y = np.full(len(filtered), np.nan)
    if np.isfinite(filtered.cutoff_y):
        of_y = Derivatives.of_y(filtered)
        a_y, sigma_a_y = of_y.values()[2], of_y.deviations()[2]
    for column in (values, sigma, a_y):
        column.setflags(write=False)  # so that the record need not copy them
    period = 1.0 / (filtered.cutoff * of_x.grid.interval)
    return Motion(
        t=filtered.t,
        x=values[0],
        v=values[1],
        a=values[2],
        a_y=a_y,
        sigma_x=sigma[0],
        sigma_v=sigma[1],
        sigma_a=sigma[2],
        sigma_a_y=sigma_a_y,
        guard=_guard_frames(sigma[2][filtered.sigma_x < MISSING_SIGMA], period),
        cutoff=filtered.cutoff,
        filter=filtered.smoother if of_x.smoother.method else "",
        events=filtered.events,
        lines=filtered.lines,
        shake_a=shake_a,
        repaired=filtered.repaired,
        smoother=filtered.smoother if filtered.sigma_sensor is None else "",
    )


def filtered_acceleration(motion: Motion, measured: Displacement, x: Array) -> Array | None:
    """Compute the acceleration of another displacement through the filter of a motion.

    A filter is linear once its settings are chosen, so a model can be seen as the measurement was.

    Parameters
    ----------
    motion
        What `differentiate` computed, n frames.
    measured
        The displacement of the same frames; its deviations weight the frames.
    x
        The other displacement, m, (n,).

    Returns
    -------
    Array or None
        Acceleration, m/s^2, (n,). None if the filter of the motion is not known.

    """
    if not motion.smoother:
        return None
    known = measured.known
    sigma = np.full(len(motion), MISSING_SIGMA)
    sigma[known] = frame_weights(measured.sigma_x, known)[known] ** -0.5
    none = np.full(len(motion), np.nan)
    filtered = Filtered(motion.t, motion.x, none, sigma, none, cutoff=motion.cutoff, smoother=motion.smoother)
    cubic = Polynomial.fit(motion.t, x, 3)  # the filters smooth what is left after it, and add it again
    change = Derivatives.of_x(filtered).apparent_motion((x - cubic(motion.t))[:, None])[2, :, 0]
    return np.asarray(cubic.deriv(2)(motion.t) + change)


def derivatives(filtered: Filtered) -> Array:
    """Compute x, v and a without their standard deviations, which take most of the time.

    Parameters
    ----------
    filtered
        Displacement of n frames, smoothed by `low_pass`.

    Returns
    -------
    Array
        x (m), v (m/s) and a (m/s^2), (3, n).

    """
    return Derivatives.of_x(filtered).values()


def covariance(filtered: Filtered, of: str, rows: NDArray[np.int64] | None = None) -> Array:
    """Compute the covariance of x, v or a among frames; smoothing correlates their errors.

    The standard deviation of a mean or a slope of the friction force follows from it.

    Parameters
    ----------
    filtered
        Displacement smoothed by `low_pass`.
    of
        "x", "v" or "a".
    rows
        Rows of the record, (m,); by default all.

    Returns
    -------
    Array
        Covariance, (m, m), in m^2, m^2/s^2 or m^2/s^4.

    Raises
    ------
    FrictrackError
        For another quantity.

    Examples
    --------
    >>> import frictrack as ft
    >>> filtered = ft.low_pass(ft.samples.runs()[0].displacement)
    >>> matrix = ft.covariance(filtered, "v", np.arange(60, 70))
    >>> matrix.shape, bool(np.allclose(np.diag(matrix) ** 0.5, ft.differentiate(filtered).sigma_v[60:70]))
    ((10, 10), True)

    """
    if of not in QUANTITIES:
        raise FrictrackError(f'covariance: expected x, v or a but got "{of}"')
    chosen = np.arange(len(filtered)) if rows is None else np.asarray(rows, dtype=np.int64)
    unit = np.zeros((len(filtered), len(chosen)))
    unit[chosen, np.arange(len(chosen))] = 1.0
    return Derivatives.of_x(filtered).covariance(QUANTITIES.index(of), unit)


@dataclass(frozen=True, eq=False)
class Derivatives:
    """Derivatives of one low-passed coordinate and their standard deviations.

    Attributes
    ----------
    filtered
        What was low-passed.
    grid
        Frame numbers of the n rows, on N frames.
    x
        Low-passed rows, m, (n,).
    w
        Weights on the grid, (N,).
    noise
        Standard deviation of a frame of weight 1, m.
    smoother
        What low-passed the coordinate.
    sensor_weights
        Weights of the second differences that a sensor measured, (N - 2,).
    measured
        Unfiltered series on the grid, (N,), where the deviations need it.

    """

    filtered: Filtered
    grid: FrameGrid
    x: Array
    w: Array
    noise: float
    smoother: Smoother
    sensor_weights: Array | None = None
    measured: Array | None = None

    @classmethod
    def of_x(cls, filtered: Filtered) -> Derivatives:
        """Derivatives of x."""
        grid, known = frame_grid(filtered.t), filtered.sigma_x < MISSING_SIGMA
        noise = float(np.mean(filtered.sigma_x[known] ** -2.0) ** -0.5)
        measured = None if filtered.x_measured is None else grid.to_frames(np.nan_to_num(filtered.x_measured))
        w = grid.to_frames(frame_weights(filtered.sigma_x, known))
        smoother, of_sensor = Smoother.read(filtered.smoother), None
        if filtered.sigma_sensor is not None and not smoother.method:
            sigma = grid.to_frames(filtered.sigma_sensor, MISSING_SIGMA)[1:-1]
            of_sensor = sensor_weights(sigma, grid.interval**2, noise)
        return cls(filtered, grid, filtered.x, w, noise, smoother, of_sensor, measured)

    @classmethod
    def of_y(cls, filtered: Filtered) -> Derivatives:
        """Derivatives of y: those of x after y was put in its place."""
        return cls.of_x(
            replace(
                filtered,
                x=filtered.y,
                sigma_x=filtered.sigma_y,
                x_measured=filtered.y_measured,
                smoother=filtered.smoother_y,
                sigma_sensor=None,
            )
        )

    @cached_property
    def best(self) -> Derivatives | None:
        """Derivatives by the default smoother, where another filter was asked for.

        Given the data, the true motion differs from these by their deviations, whatever the filter. So the error of the
        filter asked for, noise that it passes and signal that it loses, is its distance from these and their error.
        """
        best = best_smoothing(self.filtered)
        return None if best is self.filtered else Derivatives.of_x(best)

    def values(self) -> Array:
        """Derivatives of order 0, 1 and 2 of the rows, (3, n)."""
        if self.measured is not None and self.smoother.method is not None:
            return self.grid.to_rows(self._respond(self.measured))
        return self.grid.to_rows(stencil_derivatives(self._on_grid(), self.grid.interval))

    def _respond(self, columns: Array) -> Array:
        """Derivatives (3, N, ...) of what the filter makes of columns (N, ...); missing frames do not count."""
        if (method := self.smoother.method) is not None:
            filled = interpolate_missing(columns, self.w > 0)
            found = [method.derived(filled, k) for k in range(3)]
        else:
            smooth = self.factor.smooth(columns)
            found = [stencil_derivative(smooth, k) for k in range(3)]
        return np.stack([one / self.grid.interval**k for k, one in enumerate(found)])

    def deviations(self) -> Array:
        """Standard deviations of `values`, (3, n)."""
        if self.best is not None:
            return np.asarray(np.hypot(self.best.deviations(), self.values() - self.best.values()))
        best, structure, measured = self._without_forces, self.smoother.structure, self.measured
        changes: list[tuple[slice, Array, Array]] = []
        if structure is not None and measured is not None and self.smoother.alternatives:
            rest = measured - self._course.displacement(self.smoother.forces)
            rest = np.where(self.w > 0, rest - weighted_cubic(rest, self.w), 0.0) / self.noise
            average = SmootherData(rest, self.w, colour=self.smoother.colour), structure, self.smoother.alternatives
            best = best - self.noise * mean_shift(*average)  # of the best structure alone
            changes = [*added_variances(*average, self.grid.interval)]
        spread = deviations(self.factor, best, self.noise, self.grid.interval)
        for frames, left, more in changes:
            spread[:, frames] = np.sqrt(spread[:, frames] ** 2 * left + more)
        for error in self.parameter_errors:
            np.hypot(spread, error, out=spread)
        spread *= self.noise
        return self.grid.to_rows(spread)

    @cached_property
    def parameter_errors(self) -> list[Array]:
        """Changes of x, v and a by one standard deviation of frequencies and forces, (3, N), for unit noise."""
        lines = line_frequency_errors(self.factor, self._without_forces / self.noise, self.grid.interval)
        return [*lines, *place_force_errors(self.factor, self._course, self.smoother.forces)]

    @cached_property
    def _course(self) -> Course:
        return Course(self._on_grid(), self.grid.interval)

    @cached_property
    def _without_forces(self) -> Array:
        """Low-passed series (N,) without the displacement by forces that are periodic in place."""
        return self._course.x - self._course.displacement(self.smoother.forces)

    def shake_errors(self, frequency: float, size: float) -> Array:
        """Rms errors (3, n) of x, v and a by a sinusoidal displacement (Hz; rms, m) of any phase."""
        angle = 2 * np.pi * frequency * self.grid.interval * self.grid.frames
        waves = size * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        return np.asarray(np.sqrt(np.sum(self.apparent_motion(waves) ** 2, axis=2)))

    def apparent_motion(self, ghosts: Array) -> Array:
        """Response (3, n, k) of x, v and a to displacements (n, k), m, that the measurement adds."""
        return np.asarray(self._respond(self.grid.to_frames(ghosts))[:, self.grid.frames])

    def covariance(self, order: int, weights: Array) -> Array:
        """Covariance (m, m) of sums of one derivative over the rows, with weights (n, m)."""
        if self.best is not None:
            away = weights.T @ (self.values() - self.best.values())[order]
            return self.best.covariance(order, weights) + np.outer(away, away)
        errors = [error[order] for error in self.parameter_errors]
        variance = self.factor.variances(stencil_start(self.grid.n), self.stencil(order)) + sum(e**2 for e in errors)
        # correlations as the equations of the smoother give them for unit noise, variances as stated
        weights = weights * (self.deviations()[order] / np.sqrt(self.grid.to_rows(variance)))[:, None]
        positions = self.position_weights(order, weights)
        found = positions.T @ self.factor.posterior_covariance_times(positions)
        for error in errors:
            change = weights.T @ self.grid.to_rows(error)
            found += np.outer(change, change)
        return np.asarray(found)

    def stencil(self, order: int) -> Callable[[slice], Array]:
        """Weights (m, 6) of one derivative in m frames of the grid, as a function of these frames."""
        return lambda frames: stencil_weights(self.grid.n, self.grid.interval, frames)[order]

    def position_weights(self, order: int, weights: Array) -> Array:
        """Weights (N, m) on positions of the grid that give weighted sums of one derivative over the rows."""
        on_grid, start, stencil = self.grid.to_frames(weights), stencil_start(self.grid.n), self.stencil(order)
        out = np.zeros(on_grid.shape)
        for first in range(0, self.grid.n, FRAMES_AT_ONCE):
            rows = slice(first, first + FRAMES_AT_ONCE)
            for k, of_frame in enumerate(stencil(rows).T):
                np.add.at(out, start[rows] + k, of_frame[:, None] * on_grid[rows])
        return out

    @cached_property
    def factor(self) -> FactoredSmoother:
        """Equations of the structural smoother."""
        assert self.smoother.structure is not None
        data = SmootherData(np.zeros(self.grid.n), self.w, None, self.sensor_weights, self.smoother.colour)
        return self.smoother.structure.factor_smoother(data)

    def _on_grid(self) -> Array:
        """Low-passed rows on the grid (N,); missing frames are interpolated as smoothly as possible."""
        if self.grid.n == len(self.x):
            return self.x
        w = self.grid.to_frames(np.full(len(self.x), 1e6))  # so large that the rows, which are smooth, do not move
        y = self.grid.to_frames(self.x)
        cubic = weighted_cubic(y, w)
        rest = np.where(w > 0, y - cubic, 0.0)
        return cubic + Structure((0.0,)).factor_smoother(SmootherData(rest, w)).smooth(rest)


def best_smoothing(filtered: Filtered) -> Filtered:
    """Smooth the same x by the default method; once, however many ask for it.

    Parameters
    ----------
    filtered
        A displacement low-passed by any method.

    Returns
    -------
    Filtered
        The same object if it was smoothed by the default, or if a sensor was fused.

    """
    if not filtered.asked or filtered.x_measured is None:
        return filtered
    if filtered not in _BEST:
        none, known = np.full(len(filtered), np.nan), filtered.sigma_x < MISSING_SIGMA
        rows = Displacement(filtered.t, filtered.x_measured, none, none, filtered.sigma_x, none, known)
        _BEST[filtered] = low_pass(rows)
    return _BEST[filtered]


def _jump_deviation(a: Array, events: tuple[tuple[int, int], ...]) -> Array:
    """Standard deviation (n,) of an acceleration that jumps between its neighbours; 0 outside events."""
    change = np.abs(np.roll(a, -STENCIL_REACH) - np.roll(a, STENCIL_REACH)) / np.sqrt(12.0)
    reach, n = STENCIL_REACH, len(a)
    inside = mask_of_spans([(max(first - reach, reach), min(last + reach, n - reach - 1)) for first, last in events], n)
    return np.where(inside, change, 0.0)


def _guard_frames(sigma_a: Array, period: float) -> int:
    """Frames not to be trusted at an end; `period` of the cut-off in frames.

    The deviations of a long record differ along it: each end is judged against its own eighth.
    """
    n = len(sigma_a)
    window = n if n <= MAX_WHOLE_FRAMES else n // 8
    ends = (sigma_a, sigma_a[::-1])
    ragged = max(int(np.flatnonzero(end <= 2.0 * np.median(end[:window]))[0]) for end in ends)
    return int(min(max(np.ceil(period / 2.0), ragged), n // 8))


N_PROBES, PROBE_SEED = 24, 20261121  # random signs that estimate diagonals within a fifth (Hutchinson 1990)
PERIODS_OF_PROBES = 250  # of the cut-off; a longer record needs fewer probes for averages as precise
MAX_LOST_RATIO = 4.0  # times the lost signal that the penalties expect
NOISE_SHARE = 0.1  # of the noise in what is taken, below which signal cannot be distinguished from it
PRIOR_WEIGHT = 0.1  # of what the penalties expect, against what a part of the record shows
PROBE_VALUES = 1 << 21  # of the probes that are smoothed at once
MAX_BINS = 1 << 17  # of the lost signal along the record
MIN_PARTS = 6  # parts of the record over which lost signal is averaged


def deviations(factor: FactoredSmoother, x: Array, noise: float, interval: float) -> Array:
    """Compute standard deviations of smoothed positions and their derivatives.

    Parameters
    ----------
    factor
        The smoother.
    x
        Smoothed positions, m, (n,).
    noise
        Standard deviation of a frame of weight 1, m.
    interval
        Frame interval, s.

    Returns
    -------
    Array
        Standard deviations of x, v and a over `noise`, (3, n).

    """
    weights = partial(stencil_weights, len(x), interval)
    share = _lost_share(factor, x / noise, interval)

    def with_lost(both: Array, rows: slice) -> Array:
        posterior, passed = both
        lost = share[:, np.arange(rows.start, rows.stop) // _bin_frames(len(x))] * np.maximum(posterior - passed, 0.0)
        return np.asarray(passed + lost)

    total = factor.posterior_and_noise_variance(stencil_start(len(x)), weights, with_lost)
    return np.asarray(np.sqrt(total, out=total))


def line_frequency_errors(factor: FactoredSmoother, x: Array, interval: float) -> Iterator[Array]:
    """Yield for each line the change of x, v and a by one standard deviation of its frequency, (3, n), for unit noise.

    A frequency error changes the phase of the line along the record; the smoother removes a part of that. A line found
    in n frames is known to half a Rayleigh cell, pi/n per frame, in any case.
    """
    n, d = factor.n, factor.data
    if not factor.k:
        return
    found = factor.unknowns_of(x - weighted_cubic(x, d.w)).components
    frames_from_centre = np.arange(n) - 0.5 * (n - 1)
    for line, omega in zip(found[1:], factor.lines.omega, strict=False):
        phase_error = frames_from_centre * np.gradient(line) / omega
        left = phase_error - factor.smooth(phase_error)
        information = max(float(np.sum(d.apply_inverse_covariance(phase_error) * left)), 0.0)
        yield stencil_derivatives(left, interval) / np.sqrt(information + (n / np.pi) ** 2)


def _lost_share(factor: FactoredSmoother, x: Array, interval: float) -> Array:
    """Variance of the lost signal over that expected by the penalties, averaged along the record, (3, bins)."""
    bins = np.arange(0, len(x), _bin_frames(len(x)))
    out = np.ones((3, len(bins)))
    if factor.data.second_difference_weights is not None:  # a sensor recovers what smoothing loses
        return out
    residual = x - weighted_cubic(x, factor.data.w)
    residual -= factor.smooth(residual)
    taken = np.array([np.add.reduceat(stencil_derivative(residual, k) ** 2, bins) for k in range(3)])
    # over many periods of the cut-off the products are averaged, and fewer probes do
    period = 2.0 * np.pi * float(np.max(factor.lam)) ** (0.5 / TREND_ORDER)
    many = int(np.clip(np.ceil(N_PROBES * PERIODS_OF_PROBES * period / factor.n), 1, N_PROBES))
    rng, at_once = np.random.default_rng(PROBE_SEED), max(PROBE_VALUES // len(x), 1)
    del x, residual  # the largest memory is needed now
    noise, expected = np.zeros((2, *out.shape))
    for first in range(0, many, at_once):
        once = factor.smooth(factor.data.probes(rng, min(at_once, many - first)))
        kept = factor.smooth(once)
        lost = np.subtract(once, kept, out=once)
        for k in range(3):
            lost_k = stencil_derivative(lost, k)
            noise[k] += np.add.reduceat(np.einsum("np,np->n", lost_k, lost_k), bins) / many
            lost_k *= stencil_derivative(kept, k)
            expected[k] += np.add.reduceat(np.sum(lost_k, axis=1), bins) / many
    for k in range(3):
        observed = np.maximum(_moving_sum(taken[k] - noise[k]), 0.0)
        # signal far below the noise cannot be distinguished from it
        expected_sum = np.maximum(_moving_sum(expected[k]), 0.0) + _moving_sum(NOISE_SHARE * noise[k])
        share = (observed + PRIOR_WEIGHT * expected_sum) / ((1.0 + PRIOR_WEIGHT) * expected_sum)
        out[k] = np.minimum(share, MAX_LOST_RATIO)
    return out


def _bin_frames(n: int) -> int:
    """Frames whose products are summed before they are averaged along a record of n frames."""
    return max(n // MAX_BINS, 1)


def _moving_sum(row: Array) -> Array:
    """Moving sum of a row (n,) over a part of the record, reflected at the ends."""
    window = len(row) // MIN_PARTS | 1
    return np.asarray(window * scipy.ndimage.uniform_filter1d(row, window, mode="mirror"))


N_CUTOFFS = 32
MIN_CYCLES, MAX_CUTOFF = 2.0, 0.4  # lowest cut-off in cycles per record, highest in cycles per frame
EVENT_MARGIN_FRAMES = 8
MAX_LOST_STD = 4.0  # robust deviations of a lost signal; a frame beyond is beside a push
MIN_PASSED_AMPLITUDE = 0.9  # share of the amplitude; a line of which less passes lies above the cut-off
N_FREQUENCIES = 2048  # at which the noise spectrum is summed


def cutoff_tradeoff(displacement: Displacement, filtered: Filtered, motion: Motion) -> CutoffTradeOff:
    """Compute for many cut-offs of a plain low-pass of x the noise let through and the signal removed.

    Parameters
    ----------
    displacement
        Measured displacement.
    filtered, motion
        Its low-passed series and its derivatives.

    Returns
    -------
    Trade
        Residual, noise and lost signal at each frequency, and the chosen cut-off: the given one, or that of the highest
        likelihood, which the force domain uses. Warnings name vibrations and events above it.

    Examples
    --------
    >>> import frictrack as ft
    >>> run = ft.samples.runs()[0]
    >>> filtered = ft.low_pass(run.displacement)
    >>> found = ft.cutoff_tradeoff(run.displacement, filtered, ft.differentiate(filtered))
    >>> bool(found.noise[0] < found.noise[-1])
    True

    """
    displacement = displacement.rows(displacement.span)
    best = best_smoothing(filtered)
    derived = Derivatives.of_x(best)
    grid, w, noise, colour = derived.grid, derived.w, derived.noise, derived.smoother.colour
    y, signal = (grid.to_frames(column) for column in (np.where(displacement.known, displacement.x, 0.0), best.x))
    frequency = np.geomspace(MIN_CYCLES / (grid.n * grid.interval), MAX_CUTOFF / grid.interval, N_CUTOFFS)
    undisturbed = _undisturbed(best, motion.guard, grid)
    both = np.stack([y - weighted_cubic(y, w), signal - weighted_cubic(signal, w)], axis=1)
    rows = np.array([_residual_and_lost(f, grid, w, both, undisturbed) for f in frequency])
    floor, passed = np.array([_passed_noise(f, grid.interval, colour) for f in frequency]).T * noise
    of_best = motion.sigma_a if best is filtered else derived.deviations()[2]
    own, least = (float(np.median(q[undisturbed[grid.frames]])) for q in (motion.sigma_a, of_best))
    # No filter is known to be better than the best estimate: what that one does not know either is lost, too.
    lost = np.hypot(rows[:, 1], np.sqrt(np.maximum(least**2 - passed**2, 0.0)))
    return CutoffTradeOff(
        frequency=frequency,
        residual=rows[:, 0],
        floor=floor,
        noise=passed,
        lost=lost,
        hidden=undetectable_amplitude(int(np.sum(w > 0))) * noise * (2 * np.pi * frequency) ** 2 / np.sqrt(2.0),
        chosen=filtered.cutoff,
        least=float(frequency[np.argmin(np.hypot(passed, lost))]),
        structural=own,
        warnings=tuple(_warnings(best, filtered.cutoff, grid.interval)),
    )


def _undisturbed(best: Filtered, guard: int, grid: FrameGrid) -> Mask:
    """Frames (n,) away from the ends and from events, where the lost signal of a push would dominate."""
    out = grid.to_frames((best.sigma_x < MISSING_SIGMA).astype(float)) > 0
    out[:guard] = out[len(out) - guard :] = False
    ends = ((grid.frames[first], grid.frames[last]) for first, last in best.events)
    return out & ~mask_of_spans([(max(i - EVENT_MARGIN_FRAMES, 0), j + EVENT_MARGIN_FRAMES) for i, j in ends], len(out))


def _residual_and_lost(f: float, grid: FrameGrid, w: Array, both: Array, undisturbed: Mask) -> tuple[float, float]:
    """Rms residual of the measured series (m), and acceleration lost of the signal (m/s^2), at one cut-off (Hz).

    `both` are the series and the signal without their cubics, (n, 2). What is lost is an rms without the few frames
    beside a push, where it is many times the friction.
    """
    removed = Structure.low_pass(f, grid.interval).factor_smoother(SmootherData(w, w)).smooth(both)
    np.subtract(both, removed, out=removed)
    residual = np.sqrt(np.average(removed[:, 0] ** 2, weights=w))
    lost = stencil_derivative(removed[:, 1], 2)[undisturbed] / grid.interval**2
    usual = lost[np.abs(lost) <= MAX_LOST_STD * robust_std(lost)]
    return float(residual), float(np.sqrt(np.mean(usual**2))) if len(usual) else 0.0


def _passed_noise(f: float, interval: float, colour: NoiseColour | None) -> tuple[float, float]:
    """Rms residual and rms acceleration by noise of unit size, away from the ends."""
    nu = (np.arange(N_FREQUENCIES) + 0.5) / (2 * N_FREQUENCIES)
    density = colour.spectrum(2 * np.pi * nu) if colour else np.ones(N_FREQUENCIES)
    h = response(2 * np.pi * nu, penalty(f, interval))
    second = (15.0 - 16.0 * np.cos(2 * np.pi * nu) + np.cos(4 * np.pi * nu)) / 6.0 / interval**2  # five points
    return float(np.sqrt(np.mean((1 - h) ** 2 * density))), float(np.sqrt(np.mean((h * second) ** 2 * density)))


def _warnings(best: Filtered, cutoff: float, interval: float) -> list[str]:
    """Describe vibrations and events above a cut-off."""
    warnings = []
    for f in best.lines:
        passed_share = float(response(np.array(2 * np.pi * f * interval), penalty(cutoff, interval)))
        if passed_share < MIN_PASSED_AMPLITUDE:
            warnings.append(
                f"a vibration at {f:.4g} Hz lies above the cut-off of {cutoff:.3g} Hz: a plain low-pass leaves "
                f"{100 * passed_share:.0f} % of its amplitude"
            )
    for first, last in best.events:
        duration = (last - first + 1) * interval
        if duration < 0.5 / cutoff:
            at = 1e3 * 0.5 * (best.t[first] + best.t[last])
            warnings.append(
                f"what happens at {at:.1f} ms is over in {1e3 * duration:.2g} ms, shorter than half a period of the "
                f"cut-off of {cutoff:.3g} Hz ({500 / cutoff:.2g} ms): a plain low-pass smears it"
            )
    return warnings


class FilteredMotion(NamedTuple):
    """x (m), v (m/s) and a (m/s^2) by one filter, and their standard deviations, (3, n) each."""

    name: str
    values: Array
    sigma: Array


def compare_filters(displacement: Displacement, filtered: Filtered, motion: Motion) -> tuple[FilteredMotion, ...]:
    """Differentiate a displacement as measured, by a low-pass, and by the default smoother.

    Parameters
    ----------
    displacement
        Measured displacement.
    filtered, motion
        Its low-passed series and its derivatives.

    Returns
    -------
    tuple of FilteredMotion
        As measured; by the filter asked for, or else by the plain low-pass of the force domain; by the default.
        The error of a filter is its distance from the default and the deviation of that one.

    Examples
    --------
    >>> import frictrack as ft
    >>> run = ft.samples.runs()[0]
    >>> found = compare_filters(run.displacement, ft.low_pass(run.displacement), run.motion)
    >>> [one.name.split(",")[0] for one in found]
    ['as measured', 'plain low-pass at 116 Hz', 'smoothed']

    """
    displacement = displacement.rows(displacement.span)
    best = motion if not filtered.asked else differentiate(best_smoothing(filtered))
    smoothed = np.array([best.x, best.v, best.a]), np.array([best.sigma_x, best.sigma_v, best.sigma_a])
    if filtered.asked and not np.array_equal(best.a, motion.a):
        name, values = filtered.reason.split(",")[0], np.array([motion.x, motion.v, motion.a])
    else:
        only_x = replace(displacement, y=np.full(len(displacement), np.nan))  # y would double the time
        name, values = f"plain low-pass at {motion.cutoff:.3g} Hz", derivatives(low_pass(only_x, motion.cutoff))
    return (
        FilteredMotion("as measured", *_as_measured(displacement)),
        FilteredMotion(name, values, np.hypot(smoothed[1], values - smoothed[0])),
        FilteredMotion("smoothed", *smoothed),
    )


def _as_measured(displacement: Displacement) -> tuple[Array, Array]:
    """Differences of the measured positions, and their deviations by white noise."""
    grid, known = frame_grid(displacement.t), displacement.known
    w = grid.to_frames(known.astype(float)) > 0
    y = interpolate_missing(grid.to_frames(np.where(known, displacement.x, 0.0)), w)
    _, weights = stencils(grid.n, grid.interval)
    noise = np.nanmedian(displacement.sigma_x[known])
    return grid.to_rows(stencil_derivatives(y, grid.interval)), grid.to_rows(noise * np.linalg.norm(weights, axis=2))
