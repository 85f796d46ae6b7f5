"""Fit a homography to points at known places on a plane, with the covariance of its parameters.

The errors are those of the picture points, and their squares are minimised in the picture, on normalised coordinates
(Hartley & Zisserman 2004, Multiple View Geometry, 4.2 and 4.4). One radial coefficient k of the lens,
p = c + (q - c)(1 + k |q - c|^2 / R^2), can be fitted as well.

Compute the map of a plane from four or more points at known places.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import scipy

from frictrack.base.distributions import chi2_sf
from frictrack.base.errors import FrictrackError
from frictrack.measure.calibration.scale import PlaneMap, Straight, as_seen, check_points, click_std, project
from frictrack.records import Array

MIN_ASPECT = 0.02  # extent of the points across over that lengthwise; less is one line
N_PARAMETERS = 8  # of a homography
NEWTON_STEPS = 20
MAX_RADIAL_COEFFICIENT = 0.3  # a larger k is no lens


@dataclass(frozen=True, eq=False)
class Normalisation:
    """Normalise coordinates to order one: (points - middle) / size."""

    middle: Array
    size: float

    def __call__(self, points: Array) -> Array:
        """Normalise points (n, 2)."""
        return np.asarray((points - self.middle) / self.size, dtype=np.float64)

    def restore(self, points: Array) -> Array:
        """Undo the normalisation of points (n, 2)."""
        return np.asarray(points * self.size + self.middle, dtype=np.float64)


@dataclass(frozen=True, eq=False)
class Homography:
    """Fitted view of a plane.

    Attributes
    ----------
    map : PlaneMap
        Map from the picture to the plane.
    rms : float
        Rms distance of the points, px.
    chi2 : float
        Sum of squares over the given variances.
    degrees : int
        Degrees of freedom.

    """

    map: PlaneMap
    rms: float  # px, of the distance
    chi2: float  # sum of squares over the variances that were given
    degrees: int


def fit_view(
    points: Array, places: Array, sigma: Array, straight: Straight = as_seen, lens: Normalisation | None = None
) -> Homography:
    """Fit the view of a plane to points at known places.

    Parameters
    ----------
    points : array (n, 2)
        Points in the picture, px.
    places : array (n, 2)
        The same points on the plane, m.
    sigma : array (n,)
        Standard deviation of each point along x and y, px.
    straight : callable
        Removes the distortion of a known lens from points (n, 2) px.
    lens : Normalisation, optional
        Middle of the picture and distance to a corner. If it is given, one radial coefficient is fitted.

    Returns
    -------
    Homography
        The map and its quality.

    Raises
    ------
    FrictrackError
        Where the points do not determine a plane before the camera.

    References
    ----------
    R. Hartley and A. Zisserman, Multiple View Geometry in Computer Vision (2004), ch. 4.

    """
    _check_spread(points, "points")
    _check_spread(places, "places on the plane")
    plane_norm = _norm(places)
    straightened = straight(points)
    if not np.all(np.isfinite(straightened)):
        raise FrictrackError("the lens file cannot undo the distortion at the points of the scale; check the file")
    picture = _norm(straightened)
    start = _linear(plane_norm(places), picture(straightened))
    distortion = None if lens is None else partial(_distort, lens=lens)
    values, covariance, misfit = _fit(
        start, (plane_norm, picture, distortion), (points if distortion else straightened, places), sigma
    )
    place = partial(_place, (plane_norm, picture), straight if lens is None else lens)
    middle = points.mean(axis=0)
    centre, reach = (float(middle[0]), float(middle[1])), float(np.hypot(*np.ptp(points, axis=0)))
    plane = PlaneMap(values, covariance, place, centre=centre, zero=(0.0, 0.0), reach=reach)
    rms = float(np.sqrt(2 * np.mean((misfit * sigma) ** 2)))
    return Homography(plane, rms, float(np.sum(misfit**2)), 2 * len(points) - len(values))


def _place(
    frames: tuple[Normalisation, Normalisation], lens: Straight | Normalisation, values: Array, at: Array
) -> Array:
    """Points of the plane, m, of picture points whose distortion a known lens or a fitted coefficient removes."""
    flat = _undistort(float(values[N_PARAMETERS]), at, lens) if isinstance(lens, Normalisation) else lens(at)
    return frames[0].restore(project(_inverse(values), frames[1](flat)))


def _fit(
    start: Array,
    transforms: tuple[Normalisation, Normalisation, Callable[..., Array] | None],
    data: tuple[Array, Array],
    sigma: Array,
) -> tuple[Array, Array, Array]:
    """Fit by least squares: values, covariance, and residuals (2, n) in standard deviations."""
    (plane_norm, picture, distortion), (points, places) = transforms, data
    flat = plane_norm(places)

    def residual(values: Array) -> Array:
        at = picture.restore(project(_matrix(values), flat))
        at = at if distortion is None else distortion(float(values[N_PARAMETERS]), at)
        return np.nan_to_num(((at - points) / sigma[:, None]).T.ravel(), nan=1e6)

    free = np.concatenate([start, [0.0] * (distortion is not None)])
    found = scipy.optimize.least_squares(residual, free, method="lm", x_scale="jac", xtol=1e-14, ftol=1e-14)
    slopes = np.asarray(found.jac, dtype=np.float64)
    normal = slopes.T @ slopes
    size = np.sqrt(np.diag(normal))
    if not np.all(size > 0) or np.linalg.cond(normal / np.outer(size, size)) > 1e13:
        raise FrictrackError("the points do not determine the plane: three of four lie on one line; spread them")
    covariance = np.linalg.inv(normal / np.outer(size, size)) / np.outer(size, size)
    return found.x, covariance, found.fun.reshape(2, -1)


def _distort(k: float, points: Array, lens: Normalisation) -> Array:
    """Apply the radial coefficient k to straight points (n, 2) px."""
    q = lens(points)
    return lens.restore(q * (1 + k * np.sum(q**2, axis=1, keepdims=True)))


def _undistort(k: float, points: Array, lens: Normalisation) -> Array:
    """Remove the radial coefficient k from points (n, 2) px: Newton's method on r (1 + k r^2) = r_seen."""
    straightened = lens(points)
    radius = np.linalg.norm(straightened, axis=1)
    r = radius.copy()
    for _ in range(NEWTON_STEPS):
        r -= (r * (1 + k * r**2) - radius) / np.maximum(1 + 3 * k * r**2, 0.1)
    return lens.restore(straightened / (1 + k * r**2)[:, None])


def _matrix(values: Array) -> Array:
    return np.append(values[:N_PARAMETERS], 1.0).reshape(3, 3)


def _inverse(values: Array) -> Array:
    """Matrix from the picture to the plane, with w > 0 where the middle of the points is visible."""
    inverse = np.linalg.inv(_matrix(values))
    return np.asarray(inverse * np.sign(inverse[2] @ [values[2], values[5], 1.0]), dtype=np.float64)


def _linear(places: Array, points: Array) -> Array:
    """Parameters (8,) of the direct linear transform with h33 = 1; it maps the middle, so that h33 is not 0."""
    one = np.ones(len(places))
    x, y = points.T
    at = np.column_stack([places, one])
    zeros = np.zeros_like(at)
    rows = np.vstack([np.hstack([at, zeros, -x[:, None] * at]), np.hstack([zeros, at, -y[:, None] * at])])
    _, strength, right = np.linalg.svd(rows, full_matrices=True)
    if strength[N_PARAMETERS - 1] < 1e-6 * strength[0]:
        raise FrictrackError("the points do not determine the plane: three of four lie on one line; spread them")
    h = right[-1] / (right[-1, -1] or 1.0)
    if abs(right[-1, -1]) < 1e-6 or np.any(at @ h[6:] <= 0):
        raise FrictrackError(
            "no camera can see the places where the points are; check that points and plane come in the same order"
        )
    return np.asarray(h[:N_PARAMETERS], dtype=np.float64)


def _norm(points: Array) -> Normalisation:
    middle = points.mean(axis=0)
    return Normalisation(middle, float(np.sqrt(np.mean(np.sum((points - middle) ** 2, axis=1)))))


def _check_spread(points: Array, what: str) -> None:
    strength = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    if not strength[1] > MIN_ASPECT * strength[0]:
        raise FrictrackError(f"expected {what} that span a plane but all of them lie on one line; add one beside it")


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
