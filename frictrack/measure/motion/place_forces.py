"""Find forces that are periodic in place, such as the texture of a course, in a displacement.

At a changing speed they have no frequency, so that neither a trend nor a line describes them. Their displacement is
linear in their amplitudes: the double integral of sgn(v) cos(2 pi x/P) and sgn(v) sin(2 pi x/P) along the smoothed
course, whose error is far below a period P. They are columns C with amplitudes b in y = trend + lines + C b + noise (a
linear mixed model; Robinson 1991, Stat. Sci. 6). With the covariance V of all else,

    b = (C' V^-1 C)^-1 C' V^-1 y,      2 log-likelihood gained = b' C' V^-1 C b.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from frictrack.measure.motion.banded_equations import TREND_ORDER, SmootherData
from frictrack.measure.motion.grid import stencil_derivatives
from frictrack.measure.motion.smoother import FactoredSmoother, Structure
from frictrack.measure.motion.structure_search import (
    LINE_COST,
    MAX_LINES,
    MAX_REFINEMENT_GAIN,
    MIN_LINE_CYCLES,
    STIFFENINGS,
    TRIAL_STEPS,
    StructureSearch,
)
from frictrack.records import Array

REST_SPEED = 0.02  # of the highest speed, below which the mass counts as at rest
MIN_PERIOD_FRAMES = 4.0  # at the highest speed
CYCLE_STEP = 0.25  # cycles within the travel, between the periods that are tried
PERIOD_STEP = 1e-4  # relative, of the slope with respect to the period
MIN_OMEGA = 1e-3  # radians per frame
MAX_SHARE = 0.999  # of the residual that a force may explain, by the approximate information
N_REFINEMENTS = 3  # Gauss-Newton steps of the period


class PlaceForce(NamedTuple):
    """Force over mass sgn(v) (cosine cos(2 pi x/period) + sine sin(2 pi x/period)); m, m/s^2."""

    period: float
    cosine: float
    sine: float


@dataclass(frozen=True, eq=False)
class Course:
    """Places x (n,), m, and the frame interval, s."""

    x: Array
    interval: float

    def waves(self, periods: Array) -> NDArray[np.complex128]:
        """Force sgn(v) exp(2 pi i x/P), (n, K); 0 at rest."""
        v = np.gradient(self.x)
        sign = np.where(np.abs(v) > REST_SPEED * np.max(np.abs(v)), np.sign(v), 0.0)
        return np.asarray(sign[:, None] * np.exp(2j * np.pi * self.x[:, None] / periods))

    def columns(self, periods: Array) -> Array:
        """Displacement (n, 2 K) by unit accelerations with the cosines, then the sines, of K periods."""
        waves = self.waves(periods)
        force = np.concatenate([waves.real, waves.imag], axis=1)
        second = (force[:-2] + 10 * force[1:-1] + force[2:]) * (self.interval**2 / 12)  # Numerov's differences
        out = np.zeros(force.shape)
        out[2:] = np.cumsum(np.cumsum(second, axis=0), axis=0)
        cubic, _ = np.linalg.qr(np.vander(np.linspace(-1.0, 1.0, len(out)), TREND_ORDER))
        return np.asarray(out - cubic @ (cubic.T @ out))

    def displacement(self, forces: Sequence[PlaceForce]) -> Array:
        """Displacement (n,) by forces, without its cubic."""
        if not forces:
            return np.zeros(len(self.x))
        period, cosine, sine = np.array(forces).T
        return np.asarray(self.columns(period) @ np.concatenate([cosine, sine]))

    def slopes(self, forces: Sequence[PlaceForce]) -> Array:
        """Change of the displacement (n, K) by a relative change of each period."""
        ends = [[f._replace(period=f.period * (1 + sign * PERIOD_STEP)) for sign in (1, -1)] for f in forces]
        slopes = [self.displacement([up]) - self.displacement([down]) for up, down in ends]
        return np.stack(slopes, axis=1) / (2 * PERIOD_STEP)


class _Regression:
    """Columns (n, k) fitted beside a smoother: what it leaves of them, their inverse covariance and information."""

    def __init__(self, factor: FactoredSmoother, columns: Array) -> None:
        self.left = columns - factor.smooth(columns)
        self.inverse = factor.data.apply_inverse_covariance(self.left)
        self.information = columns.T @ self.inverse

    def amplitudes(self, y: Array) -> Array:
        return np.asarray(scipy.linalg.lstsq(self.information, self.inverse.T @ y)[0])


def place_force_errors(factor: FactoredSmoother, course: Course, forces: Sequence[PlaceForce]) -> Iterator[Array]:
    """Yield changes of x, v and a, (3, n), by one standard deviation of independent combinations of the parameters."""
    if forces:
        columns = np.concatenate([course.columns(np.array([f.period for f in forces])), course.slopes(forces)], axis=1)
        columns /= np.linalg.norm(columns, axis=0)  # the information is then well conditioned
        found = _Regression(factor, columns)
        size, direction = np.linalg.eigh(found.information)
        for change in (found.left @ (direction / np.sqrt(np.maximum(size, np.finfo(float).eps * size[-1])))).T:
            yield stencil_derivatives(change, course.interval)


def find_place_forces(
    data: SmootherData, structure: Structure, course: Course
) -> tuple[tuple[PlaceForce, ...], Structure]:
    """Add forces that are periodic in place while the likelihood gains more than their parameters would by chance."""
    n = len(data.w)
    forces: tuple[PlaceForce, ...] = ()
    cost = LINE_COST * np.log(data.count) + 2.0 * np.log(n / 2.0)  # as `undetectable_amplitude` has it
    best = StructureSearch(data).scored(structure).penalised
    travel, fastest = float(np.ptp(course.x)), float(np.max(np.abs(np.diff(course.x))))
    # from half the travel to a few frames at the highest speed
    periods = travel / np.arange(MIN_LINE_CYCLES, travel / (MIN_PERIOD_FRAMES * fastest), CYCLE_STEP)
    while len(periods) and len(forces) < MAX_LINES:
        _, gain, trend, period = min(_scan(data, structure, forces, course, periods), key=lambda found: found[0])
        if gain < cost:
            break
        tried = _refined(data, trend, (*forces, PlaceForce(period, 0.0, 0.0)), course)
        search = StructureSearch(replace(data, y=_without(data, tried, course)))
        if search.refine(search.scored(trend), TRIAL_STEPS).penalised + cost * len(tried) > best + MAX_REFINEMENT_GAIN:
            break
        found = search.search()
        tried = _refined(data, found, tried, course)
        rest = replace(data, y=_without(data, tried, course))
        loss = StructureSearch(rest).scored(found).penalised + cost * len(tried)
        if loss >= best:
            break
        best, forces, structure = loss, tried, found
    return forces, structure


def _without(data: SmootherData, forces: Sequence[PlaceForce], course: Course) -> Array:
    return np.where(data.w > 0, data.y - course.displacement(forces), 0.0)


def _scan(
    data: SmootherData, structure: Structure, forces: tuple[PlaceForce, ...], course: Course, periods: Array
) -> Iterator[tuple[float, float, Structure, float]]:
    """Yield, for trends of several stiffnesses without lines, the loss with the best further period, and its gain.

    With u = V^-1 y, C' u is the sum of the force times q, where q has the second difference u. The information is about
    the sum of (1 - H)/omega^4 over the frames, with the trend's response H at the local frequency omega.
    """
    rest = replace(data, y=_without(data, forces, course))
    search = StructureSearch(rest)
    waves = course.waves(periods)
    omega = np.clip(2 * np.pi * np.abs(np.gradient(course.x))[:, None] / periods, MIN_OMEGA, np.pi)
    for stiffer in STIFFENINGS:
        trend = search.stiffer(replace(structure, lines=()), stiffer)
        factor = trend.factor_smoother(rest)
        u = rest.apply_inverse_covariance(rest.y - factor.smooth(rest.y))
        variance = factor.restricted_likelihood()[1]
        q = np.cumsum(np.cumsum(u[::-1]))[::-1]
        lam = np.exp(trend.log_lambda(len(u)))
        lam = np.pad(lam, TREND_ORDER // 2, mode="edge")[:, None]
        kept = 1.0 / (1.0 + 1.0 / (lam * (2 * np.sin(omega / 2)) ** (2 * TREND_ORDER)))
        information = np.maximum(0.5 * np.sum(kept / omega**4, axis=0), np.finfo(float).tiny)
        share = np.abs(q[1:] @ waves[:-1]) ** 2 / information / variance / data.count  # of the residual, explained
        k = int(np.argmax(share))
        gain = -data.count * np.log1p(-min(float(share[k]), MAX_SHARE))
        yield search.loss(trend) - gain, gain, trend, float(periods[k])


def _refined(
    data: SmootherData, structure: Structure, forces: tuple[PlaceForce, ...], course: Course
) -> tuple[PlaceForce, ...]:
    """Fit amplitudes, and periods by Gauss-Newton steps of at most half a cycle within the travel."""
    factor = structure.factor_smoother(data)
    for step in range(N_REFINEMENTS + 1):
        periods = np.array([f.period for f in forces])
        b = _Regression(factor, course.columns(periods)).amplitudes(data.y)
        forces = tuple(PlaceForce(*map(float, row)) for row in zip(periods, *np.split(b, 2), strict=True))
        if step < N_REFINEMENTS:
            columns = np.concatenate([course.columns(periods), course.slopes(forces)], axis=1)
            change = _Regression(factor, columns).amplitudes(data.y)[2 * len(forces) :]
            limit = 0.5 * periods / np.ptp(course.x)
            periods = periods * (1 + np.clip(change, -limit, limit))
            forces = tuple(f._replace(period=float(p)) for f, p in zip(forces, periods, strict=True))
    return forces
