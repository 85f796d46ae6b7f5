"""Compare filters of one displacement: cut-offs of a plain low-pass, and what each filter makes of the motion.

Residual analysis (Winter 2009, Biomechanics and Motor Control of Human Movement, ch. 3): what a low-pass removes falls
with its cut-off until only noise is removed, and then follows the level of white noise. The removed signal is computed
from the series of the structural smoother, the best estimate of the motion.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from frictrack.measure.motion.banded_equations import NoiseColour, SmootherData, penalty, response, weighted_cubic
from frictrack.measure.motion.derivative import best_smoothing, derivatives, differentiate
from frictrack.measure.motion.filter import MISSING_SIGMA, frame_weights, low_pass
from frictrack.measure.motion.filter_methods import Smoother, interpolate_missing
from frictrack.measure.motion.grid import FrameGrid, frame_grid, stencil_derivative, stencil_derivatives, stencils
from frictrack.measure.motion.smoother import Structure
from frictrack.measure.motion.structure_search import undetectable_amplitude
from frictrack.records import Array, CutoffTradeOff, Displacement, Filtered, Mask, Motion

N_CUTOFFS = 32
MIN_CYCLES, MAX_CUTOFF = 2.0, 0.4  # lowest cut-off in cycles per record, highest in cycles per frame
EVENT_MARGIN_FRAMES = 8
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
    grid, known = frame_grid(displacement.t), displacement.known
    w = grid.to_frames(frame_weights(displacement.sigma_x, known))
    best = best_smoothing(filtered)
    y, signal = grid.to_frames(np.where(known, displacement.x, 0.0)), grid.to_frames(best.x)
    measured_frames = best.sigma_x < MISSING_SIGMA
    noise = float(np.mean(best.sigma_x[measured_frames] ** -2.0) ** -0.5)
    frequency = np.geomspace(MIN_CYCLES / (grid.n * grid.interval), MAX_CUTOFF / grid.interval, N_CUTOFFS)
    undisturbed = _undisturbed(best, motion.guard, grid)
    both = np.stack([y - weighted_cubic(y, w), signal - weighted_cubic(signal, w)], axis=1)
    rows = np.array([_residual_and_lost(f, grid, w, both, undisturbed) for f in frequency])
    colour = Smoother.read(best.smoother).colour
    floor, passed = np.array([_passed_noise(f, grid.interval, colour) for f in frequency]).T * noise
    structural = float(np.sqrt(np.mean(motion.sigma_a[undisturbed[grid.frames]] ** 2)))
    # No filter is known to be better than the best estimate: what that one does not know either is lost, too.
    lost = np.hypot(rows[:, 1], np.sqrt(np.maximum(structural**2 - passed**2, 0.0)))
    return CutoffTradeOff(
        frequency=frequency,
        residual=rows[:, 0],
        floor=floor,
        noise=passed,
        lost=lost,
        hidden=undetectable_amplitude(int(np.sum(w > 0))) * noise * (2 * np.pi * frequency) ** 2 / np.sqrt(2.0),
        chosen=filtered.cutoff,
        least=float(frequency[np.argmin(np.hypot(passed, lost))]),
        structural=structural,
        warnings=tuple(_warnings(best, filtered.cutoff, grid.interval)),
    )


def _undisturbed(best: Filtered, guard: int, grid: FrameGrid) -> Mask:
    """Frames (n,) away from the ends and from events, where the lost signal of a push would dominate."""
    out = grid.to_frames((best.sigma_x < MISSING_SIGMA).astype(float)) > 0
    out[:guard] = out[len(out) - guard :] = False
    for first, last in best.events:
        out[max(grid.frames[first] - EVENT_MARGIN_FRAMES, 0) : grid.frames[last] + EVENT_MARGIN_FRAMES + 1] = False
    return out


def _residual_and_lost(f: float, grid: FrameGrid, w: Array, both: Array, undisturbed: Mask) -> tuple[float, float]:
    """Rms residual of the measured series (m), and rms acceleration lost of the signal (m/s^2), at one cut-off (Hz).

    `both` are the series and the signal without their cubics, (n, 2).
    """
    removed = Structure.low_pass(f, grid.interval).factor_smoother(SmootherData(w, w)).smooth(both)
    np.subtract(both, removed, out=removed)
    residual = np.sqrt(np.average(removed[:, 0] ** 2, weights=w))
    lost = stencil_derivative(removed[:, 1], 2)[undisturbed] / grid.interval**2
    return float(residual), float(np.sqrt(np.mean(lost**2)))


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
