"""The map from the picture to the plane of the course, which every calibration yields.

A map is a function of some values (a pitch, a homography, a camera and its pose) and of picture points. The covariance
of the values gives the uncertainty of every length that is measured through it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import ArrayLike

from frictrack.records import Array

Place = Callable[[Array, Array], Array]

DIFFERENCE_STEP = 0.01  # of central differences: px, and the share of a standard deviation


@dataclass(frozen=True, eq=False)
class PlaneMap:
    """Map from picture points (px, y down) to points of the course's plane (m).

    Attributes
    ----------
    values : array (k,)
        Parameters of the calibration.
    covariance : array (k, k)
        Their covariance.
    place : callable
        ``place(values, points)`` maps points (n, 2) px to (n, 2) m; NaN beyond the horizon.
    used : str
        Description of the data from which it was made.
    centre : tuple of float
        Picture point at which directions are transformed to the plane, px.
    zero : tuple of float or None
        Origin in the plane, m; None for the corner of the picture.
    reach : float
        Length that was measured in the picture, px; 0 where it does not matter.
    notes : tuple of str
        Notes for the user.

    """

    values: Array
    covariance: Array
    place: Place
    used: str = ""
    centre: tuple[float, float] = (0.0, 0.0)
    zero: tuple[float, float] | None = None
    reach: float = 0.0
    notes: tuple[str, ...] = ()

    def __call__(self, points: Array) -> Array:
        """Map picture points (n, 2) px to points of the plane (n, 2) m."""
        return self.place(self.values, np.asarray(points, dtype=np.float64))

    def jacobian(self, points: Array) -> Array:
        """Compute the derivative of the plane by the picture.

        Parameters
        ----------
        points : array (n, 2)
            Picture points, px.

        Returns
        -------
        array (n, 2, 2)
            m/px.

        """
        points = np.asarray(points, dtype=np.float64)
        sides = [(self(points + d) - self(points - d)) / (2 * DIFFERENCE_STEP) for d in DIFFERENCE_STEP * np.eye(2)]
        return np.stack(sides, axis=2)

    def pitch(self, at: Array, direction: Array) -> float:
        """Compute the pitch at a picture point along a direction.

        Parameters
        ----------
        at : array (2,)
            Picture point, px.
        direction : array (2,)
            Direction in the picture.

        Returns
        -------
        float
            m/px.

        """
        step_px = np.asarray(direction, dtype=np.float64)
        return float(np.linalg.norm(self.jacobian(np.reshape(at, (1, 2)))[0] @ step_px) / np.linalg.norm(step_px))

    def length(self, ends: Array) -> tuple[float, float]:
        """Compute the distance of two picture points in the plane.

        Parameters
        ----------
        ends : array (2, 2)
            Picture points, px.

        Returns
        -------
        length : float
            m.
        relative : float
            Relative standard deviation from the covariance of the values (linear propagation).

        """
        length = _distance(self.place(self.values, ends))
        slope = np.zeros(len(self.values))
        for k in range(len(slope)):
            std = float(np.sqrt(self.covariance[k, k]))
            step = np.zeros(len(self.values))
            step[k] = DIFFERENCE_STEP * std
            if std > 0:
                far, near = (_distance(self.place(self.values + s, ends)) for s in (step, -step))
                slope[k] = (far - near) / (2 * DIFFERENCE_STEP * std)
        return length, float(np.sqrt(max(float(slope @ self.covariance @ slope), 0.0))) / length

    def scaled(self, factor: float, relative: float) -> PlaneMap:
        """Multiply the map by an uncertain factor.

        Parameters
        ----------
        factor : float
            Factor.
        relative : float
            Its relative standard deviation.

        Returns
        -------
        PlaneMap
            With the factor as one more value.

        """
        k = len(self.values)
        covariance = np.zeros((k + 1, k + 1))
        covariance[:k, :k], covariance[k, k] = self.covariance, (relative * factor) ** 2
        zero = None if self.zero is None else (self.zero[0] * factor, self.zero[1] * factor)
        return replace(
            self,
            values=np.append(self.values, factor),
            covariance=covariance,
            place=partial(_times_last_value, self.place),
            zero=zero,
        )


def _times_last_value(place: Callable[[Array, Array], Array], values: Array, points: Array) -> Array:
    return np.asarray(values[-1] * place(values[:-1], points))


def uniform(values: ArrayLike, covariance: ArrayLike, pitch: Callable[[Array], float], straight: Straight) -> PlaneMap:
    """Create a map with the same pitch everywhere on the undistorted picture.

    Parameters
    ----------
    values, covariance : array-like
        Parameters of the pitch and their covariance.
    pitch : callable
        ``pitch(values)`` in m/px.
    straight : callable
        Removes lens distortion from points (n, 2) px.

    Returns
    -------
    PlaneMap
        Linear map.

    Examples
    --------
    >>> uniform([5e-4], [[1e-12]], lambda values: float(values[0]), as_seen)(np.array([[100.0, 20.0]])).tolist()
    [[0.05, 0.01]]

    """
    return PlaneMap(
        np.asarray(values, dtype=np.float64),
        np.asarray(covariance, dtype=np.float64),
        partial(_uniform, pitch, straight),
    )


def _uniform(pitch: Callable[[Array], float], straight: Straight, values: Array, points: Array) -> Array:
    return pitch(values) * straight(points)


Straight = Callable[[Array], Array]  # picture points (n, 2) px -> where a lens without distortion shows them


def as_seen(points: Array) -> Array:
    """Picture points without a lens to correct."""
    return points


def project(matrix: Array, points: Array) -> Array:
    """Points (n, 2) through a homography (3, 3); NaN beyond the horizon (where the sign of w is not the matrix's)."""
    x, y, w = (points @ matrix[:, :2].T + matrix[:, 2]).T
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where((w > 0)[:, None], np.stack([x / w, y / w], axis=1), np.nan)


def _distance(ends: Array) -> float:
    return float(np.linalg.norm(ends[1] - ends[0]))
