"""The noise of friction at constant speeds: points (v, F) without order in time.

Repeated speeds show it (pure error, Draper & Smith 1998, section 2.1). Without them it is what the force scatters about
a smooth course over the logarithm of the speed: the residual variance of the most likely Gaussian process (Matern 5/2),
one for each load, and one for each direction where these differ, about straight lines.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from frictrack.fit.smooth_functions import matern_covariance
from frictrack.records import Array, Run

MAX_SAME_SPEED, MAX_SAME_LOAD = 1e-3, 0.05  # relative difference of speeds that are repeats, and of loads that are one
MIN_REPEATS = 4  # points beyond the first of their speed that show the noise
LENGTHS = np.geomspace(0.7, 8.0, 12)  # correlation lengths in ln v: no law of friction changes faster than twofold in v
RATIOS = np.geomspace(1e-2, 1e7, 46)  # variance of the course over that of the noise


@dataclass(frozen=True, eq=False)
class SpeedPoints:
    """Where the points of a table were measured, and how their noise is known.

    `v` (n,): speeds, m/s; `load` (n,): loads over their mean; `relative` (n,): deviations over their mean; `stated`:
    whether the deviations were given.
    """

    v: Array
    load: Array
    relative: Array
    stated: bool = False

    @property
    def repeats(self) -> int:
        """Number of points beyond the first at their speed and load, which show the noise; 0 of too few."""
        count = len(self.v) - len(np.unique(self._places()))
        return count if count >= MIN_REPEATS else 0

    @property
    def source(self) -> str:
        """From what the noise is known."""
        if self.stated:
            return "as stated"
        if self.repeats:
            return f"the scatter of repeated speeds, {self.repeats} degrees of freedom"
        return "what the force scatters about a smooth course over the speed"

    def noise(self, force: Array) -> Array:
        """Mean standard deviation (D,) of the noise of forces (n, D)."""
        weight = 1.0 / self.relative
        if not self.repeats:
            return self._scatter_about_course(force, weight)
        members = self._places() == np.unique(self._places())[:, None]
        share = members * weight**2
        share = share / share.sum(axis=1)[:, None]  # (groups, n)
        left = (force - members.T @ (share @ force)) * weight[:, None]
        return np.asarray(np.sqrt(np.sum(left**2, axis=0) / self.repeats))

    def _kinds(self) -> NDArray[np.int64]:
        """Number (n,) of the direction and load of every point."""
        return 2 * _numbered(self.load, MAX_SAME_LOAD) + (self.v > 0)

    def _places(self) -> NDArray[np.int64]:
        """Number (n,) of the speed, direction and load of every point."""
        return len(self.v) * self._kinds() + _numbered(self.v, MAX_SAME_SPEED)

    def _scatter_about_course(self, force: Array, weight: Array) -> Array:
        """Noise (D,) of forces (n, D): its restricted likelihood averaged over all courses."""
        kinds, direction = self._kinds(), np.sign(self.v)
        both = [np.abs(self.v)] if np.ptp(direction) else []
        lines = np.column_stack([kinds[:, None] == np.unique(kinds), self.v, *both]) * weight[:, None]
        free = np.linalg.svd(lines)[0][:, np.linalg.matrix_rank(lines) :]  # what no straight lines explain
        y = free.T @ (force * weight[:, None])
        own = (kinds[:, None] == kinds) * 1.0
        odd = (kinds[:, None] // 2 == kinds // 2) * direction[:, None] * direction  # one course for both directions
        variances, costs = [], []
        for length, together in product(LENGTHS, [own, odd] if both else [own]):
            course = matern_covariance(np.log(np.abs(self.v)), length) * together * weight[:, None] * weight
            values, vectors = np.linalg.eigh(free.T @ course @ free)
            squares = (vectors.T @ y) ** 2
            for ratio in RATIOS:
                spread = 1.0 + ratio * np.maximum(values, 0.0)
                variances.append(np.mean(squares / spread[:, None], axis=0))
                costs.append(len(y) * np.log(np.maximum(variances[-1], 1e-300)) + np.sum(np.log(spread)))
        share = np.exp(-0.5 * (np.array(costs) - np.min(costs, axis=0)))
        return np.asarray(np.sqrt(np.sum(share * variances, axis=0) / np.sum(share, axis=0)))


def _numbered(values: Array, tolerance: float) -> NDArray[np.int64]:
    """Number (n,) of the group of every value; neighbours within a relative tolerance are one group."""
    order = np.argsort(values)
    steps = np.diff(values[order]) > tolerance * np.abs(values[order][1:])
    out = np.empty(len(values), dtype=np.int64)
    out[order] = np.concatenate([[0], np.cumsum(steps)])
    return out


def points_of(run: Run) -> tuple[SpeedPoints, Array]:
    """The points of a table of speeds and forces, and their standard deviations (n,), N."""
    force = np.asarray(run.friction_N, dtype=float)
    load = np.ones(len(force)) if run.loads is None else run.loads / np.mean(run.loads)
    stated = run.sigma_friction if run.sigma_friction is not None else run.noise
    if stated is not None:
        sigma = np.broadcast_to(np.asarray(stated, dtype=float), force.shape)
        return SpeedPoints(run.motion.v, load, sigma / np.mean(sigma), stated=True), sigma
    points = SpeedPoints(run.motion.v, load, np.ones(len(force)))
    return points, np.full(len(force), points.noise(force[:, None])[0])
