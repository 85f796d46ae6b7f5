"""The one thing that every calibration yields: a map from the picture to the plane of the course.

A map is a function of some numbers (a pitch, a homography, a camera and its pose) and of picture points; with the
covariance of the numbers it carries their uncertainty to every length that is measured through it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from frictrack.records import Array

Place = Callable[[Array, Array], Array]

DIFFERENCE_STEP = 0.01  # of central differences: px, and the share of a standard deviation


@dataclass(frozen=True, eq=False)
class PlaneMap:
    """Picture points (px, y down) -> points of the course's plane (m).

    `place(values, points)` maps points (n, 2) px to (n, 2) m; NaN beyond the horizon. `values` (k,) are the
    numbers of the calibration and `covariance` (k, k) theirs. `centre` is the picture point at which directions
    in the picture are turned into directions in the plane, `zero` the point of the plane that is 0 (m; None: where
    the picture's corner lies), `reach` the length that was measured in the picture (px, 0 where that says nothing),
    `used` says in words what it was made from.
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
        """Points of the plane (n, 2) m."""
        return self.place(self.values, np.asarray(points, dtype=np.float64))

    def jacobian(self, points: Array) -> Array:
        """Change (n, 2, 2) of the point in the plane, m, per px of movement in the picture."""
        points = np.asarray(points, dtype=np.float64)
        sides = [(self(points + d) - self(points - d)) / (2 * DIFFERENCE_STEP) for d in DIFFERENCE_STEP * np.eye(2)]
        return np.stack(sides, axis=2)

    def pitch(self, at: Array, direction: Array) -> float:
        """Metres per pixel at a picture point (2,), along a direction (2,) in the picture."""
        step_px = np.asarray(direction, dtype=np.float64)
        return float(np.linalg.norm(self.jacobian(np.reshape(at, (1, 2)))[0] @ step_px) / np.linalg.norm(step_px))

    def length(self, ends: Array) -> tuple[float, float]:
        """Distance in m between two picture points (2, 2) px, and its relative standard deviation."""
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
        """The map times a factor that is itself known to a relative standard deviation."""
        k, place = len(self.values), self.place
        covariance = np.zeros((k + 1, k + 1))
        covariance[:k, :k], covariance[k, k] = self.covariance, (relative * factor) ** 2
        zero = None if self.zero is None else (self.zero[0] * factor, self.zero[1] * factor)
        return replace(
            self,
            values=np.append(self.values, factor),
            covariance=covariance,
            place=lambda values, points: values[k] * place(values[:k], points),
            zero=zero,
        )


def uniform(values: ArrayLike, covariance: ArrayLike, pitch: Callable[[Array], float], straight: Straight) -> PlaneMap:
    """The same pitch everywhere on the straightened picture; `pitch(values)` in m/px."""
    return PlaneMap(
        np.asarray(values, dtype=np.float64),
        np.asarray(covariance, dtype=np.float64),
        lambda given, points: pitch(given) * straight(points),
    )


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
