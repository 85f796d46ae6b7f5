"""Compute the map of a plane from four or more points at known places."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from frictrack.calibration.homography import Homography, fit_view
from frictrack.calibration.plane import PlaneMap, Straight, as_seen
from frictrack.calibration.scale import check_points, click_std
from frictrack.distributions import chi2_sf
from frictrack.records import Array

ALPHA_MISFIT = 1e-3  # significance level at which the points fit worse than they were clicked


def from_points(scale: Mapping[str, Any], straight: Straight = as_seen) -> PlaneMap:
    """Compute the map of ``{points = [[x, y], ...], plane = [[X, Y], ...]}``.

    Parameters
    ----------
    scale : mapping
        Points in the picture (px) and their places on the plane.
    straight : callable
        Removes the distortion of a known lens from points (n, 2) px.

    Returns
    -------
    PlaneMap
        With five or more points their misfit is tested; a significant one enlarges the covariance and gives a note.

    Raises
    ------
    FrictrackError
        For points that do not determine a plane.

    """
    points, places, std = check_points(scale)
    click = click_std(scale)
    sigma = np.full(len(points), click)
    fitted = fit_view(points, places, sigma, straight)
    if np.any(std > 0):  # uncertain places count as clicks that are as uncertain
        pitch = np.sqrt(np.abs(np.linalg.det(fitted.map.jacobian(points))))
        sigma = np.sqrt(click**2 + np.mean(std**2, axis=1) / pitch**2)
        fitted = fit_view(points, places, sigma, straight)
    return _with_misfit(fitted, click, points)


def _with_misfit(fitted: Homography, click: float, points: Array) -> PlaneMap:
    """Add the misfit of the points to the map: a description, or a note and a larger covariance."""
    n, degrees = len(points), fitted.degrees
    used = f"scale by {n} points of known place, clicked to {click:g} px"
    if degrees == 0:
        return replace(fitted.map, used=f"{used}; a fifth point would show whether they fit")
    used += f"; they fit to {fitted.rms:.2g} px"
    if chi2_sf(fitted.chi2, degrees) >= ALPHA_MISFIT:
        return replace(fitted.map, used=used)
    variance_ratio = fitted.chi2 / degrees
    note = (
        f"the points of the scale lie {np.sqrt(variance_ratio):.1f} times as far off as clicks of {click:g} px would: "
        "check places, order and lens; the uncertainty of the scale is enlarged by that"
    )
    return replace(fitted.map, used=used, covariance=fitted.map.covariance * variance_ratio, notes=(note,))
