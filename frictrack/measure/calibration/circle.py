"""Find a circular course in the positions x, y, and count x along it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import least_squares

from frictrack.base.number_format import format_plus_minus
from frictrack.records import Array, Displacement
from frictrack.sampling import noise_level

MIN_ROWS = 10
MIN_BEND = 0.01  # rms off a straight line over its length, up to which a lens without calibration bends it
MIN_EXCESS_SIGMAS = 1.0  # standard deviations of the variance of the noise by which positions leave the circle
MAX_ARC_SHARE = 0.1  # rms off the circle over rms off the line: a curvature of ten deviations, if all errors are one


@dataclass(frozen=True)
class Circle:
    """A circle (m, or px) and the standard deviation of its radius."""

    centre: Array
    radius: float
    sigma: float


def fit_circle(at: Array) -> Circle | None:
    """Fit a circle to positions (n, 2), the second upward; None if a line describes them as well.

    Examples
    --------
    >>> angle = np.linspace(0, 1, 50)
    >>> fit_circle(2 * np.column_stack([np.sin(angle), 1 - np.cos(angle)])).radius.__round__(9)
    2.0

    """
    at = at[np.all(np.isfinite(at), axis=1)]
    if len(at) < MIN_ROWS:
        return None
    middle = at.mean(axis=0)
    off = at - middle
    along = off @ np.linalg.svd(off, full_matrices=False)[2].T
    line = float(np.std(along[:, 1]))
    if line <= MIN_BEND * np.ptp(along[:, 0]):
        return None
    columns = np.column_stack([2 * off, np.ones(len(off))])  # x^2 + y^2 = 2 a x + 2 b y + c (Kasa 1976)
    a, b, c = np.linalg.lstsq(columns, np.sum(off**2, axis=1), rcond=None)[0]

    def off_circle(circle: Array) -> Array:
        return np.hypot(off[:, 0] - circle[0], off[:, 1] - circle[1]) - circle[2]

    found = least_squares(off_circle, [a, b, np.sqrt(max(c + a**2 + b**2, 0.0))], x_scale=line)
    rms = float(np.std(found.fun))
    if rms >= MAX_ARC_SHARE * line:
        return None
    jacobian = np.asarray(found.jac)
    sigma = rms * float(np.sqrt(np.linalg.pinv(jacobian.T @ jacobian)[2, 2]))
    return Circle(found.x[:2] + middle, float(found.x[2]), sigma)


def on_circle(displacement: Displacement, x_offset: float = 0.0) -> Displacement:
    """Return a displacement with x along the circle on which its positions lie; unchanged if they do not.

    x counts from the lowest place of the circle counter-clockwise, so that it grows to the right there; y is outward.
    By what y leaves the circle beyond its noise, x is uncertain as well: the errors of a tracker that learnt a rotating
    target depend on the angle.

    Parameters
    ----------
    displacement : Displacement
        Positions x, y of a course, y upward.
    x_offset : float
        Added to x along the circle, m.

    Returns
    -------
    Displacement
        With `radius` and `sigma_radius`, and a note that says so, if the course is a circle.

    """
    at = np.stack([displacement.x, displacement.y], axis=1)
    seen = np.where(displacement.valid[:, None], at, np.nan)
    circle = fit_circle(seen)
    if circle is None:
        return displacement
    off = at - circle.centre
    angle, known = np.arctan2(off[:, 0], -off[:, 1]), np.isfinite(off[:, 0])
    angle[known] = np.unwrap(angle[known])
    angle -= 2 * np.pi * np.round(angle[known][0] / (2 * np.pi))
    sizes = displacement.sigma_x * np.cos(angle), displacement.sigma_y * np.sin(angle)
    sigma = displacement.sigma_x if np.all(np.isnan(displacement.sigma_y)) else np.hypot(*sizes)
    y = np.hypot(*off.T) - circle.radius
    note = (
        f"its path is a circle of radius {format_plus_minus(circle.radius, circle.sigma)} m: x is the way along it, "
        'counter-clockwise from its lowest place; with incline = "0 deg" it stands upright, without one it lies flat'
    )
    return replace(
        displacement,
        x=circle.radius * angle + x_offset,
        y=y,
        sigma_x=sigma,
        systematic=float(np.hypot(displacement.systematic, _slow_error(y, displacement))),
        radius=circle.radius,
        sigma_radius=float(np.hypot(circle.sigma, displacement.pixel_pitch or 0.0)),  # a target is placed to a pixel
        notes=(*displacement.notes, note),
    )


def _slow_error(y: Array, displacement: Displacement) -> float:
    """Root mean square of what the distance y (n,) from the circle has beyond its white noise, m."""
    noise, relative = noise_level(y, displacement.valid, t=displacement.t)
    excess = np.nanvar(y) - noise**2
    return float(np.sqrt(excess)) if excess > MIN_EXCESS_SIGMAS * 2 * relative * noise**2 else 0.0
