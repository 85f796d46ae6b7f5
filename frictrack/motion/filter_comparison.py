"""Compare what filters make of one displacement: as measured, low-passed, and smoothed by the default."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from frictrack.motion.derivative import best_smoothing, derivatives, differentiate
from frictrack.motion.filter import low_pass
from frictrack.motion.filter_methods import interpolate_missing
from frictrack.motion.grid import frame_grid
from frictrack.motion.stencil import stencil_derivatives, stencils
from frictrack.records import Array, Displacement, Filtered, Motion


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
