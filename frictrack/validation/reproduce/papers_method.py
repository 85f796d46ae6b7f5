"""Identify a law by the papers' method: low-pass, two differences, F = -m a, and a search for all parameters.

The error is the sum of squared acceleration residuals over the frames of the free section. The papers do not specify
the low-pass (here Butterworth of order 4, forward and backward), its cut-off (here by residual analysis: Winter 2009,
Biomechanics and Motor Control of Human Movement), the frames left out at the ends (here one period of the cut-off), and
the bounds of the search.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from scipy.optimize import least_squares

from frictrack.records import Array, Run
from frictrack.search import SearchResult, minimise
from frictrack.validation.reproduce.laws import PaperLaw, Real, Reduction

N_SEARCHES = 3  # differential evolutions for the lowest error
MIN_EVALUATIONS = 3000  # of each; with a smaller budget there is only one
OPTIMA_REFINED, MAX_REFINEMENTS = 2, 60  # optima of each that are refined, and evaluations of a refinement
BOUNDS = {
    "F_c": (0.0, 80.0),
    "F_s": (0.0, 120.0),
    "F_v": (0.0, 40.0),
    "v_s": (0.05, 3.0),
    "F": (0.0, 300.0),
    "f": (1.0, 490.0),
    "phi": (-np.pi, np.pi),
}  # N, N s/m, m/s, Hz, rad


@dataclass(frozen=True, eq=False)
class AccelerationSeries:
    """Velocity and acceleration by the papers' method, runs end to end.

    Attributes
    ----------
    t, v, a
        Time since release (s), velocity (m/s) and acceleration (m/s^2), each (n,).
    mass
        Mass, kg.

    """

    t: Array
    v: Array
    a: Array
    mass: float

    @property
    def force(self) -> Array:
        """Friction F = -m a, N."""
        return -self.mass * self.a

    def thinned(self) -> AccelerationSeries:
        """At most every fourth frame, and no fewer than 200 where possible; sufficient for all frequencies searched."""
        step = int(np.clip(len(self.t) // 200, 1, 4))
        return AccelerationSeries(self.t[::step], self.v[::step], self.a[::step], self.mass)

    @cached_property
    def single(self) -> tuple[Real, Real, Real]:
        """t, v, a in single precision, which evaluates a population three times as fast."""
        return self.t.astype(np.float32), self.v.astype(np.float32), self.a.astype(np.float32)


def measure_series(runs: Sequence[Run]) -> AccelerationSeries:
    """Join the motion of runs of one mass end to end, without one period of the cut-off at each end.

    Parameters
    ----------
    runs
        Runs whose motion was filtered and differentiated.

    Returns
    -------
    AccelerationSeries
        Time, velocity and acceleration of all runs.

    """
    parts = []
    for run in runs:
        motion = run.motion
        guard = round(1 / (motion.cutoff * float(np.median(np.diff(motion.t)))))
        parts.append([column[guard:-guard] for column in (motion.t, motion.v, motion.a)])
    t, v, a = (np.concatenate(column) for column in zip(*parts, strict=True))
    return AccelerationSeries(t, v, a, float(runs[0].mass or 1.0))


def search_bounds(law: PaperLaw) -> Array:
    """Bounds of a search, (d, 2)."""
    keys = {"f_c": "F_c", "f_s": "F_s", "f_v": "F_v", "F_c": "F_c", "F_s": "F_s", "F_v": "F_v", "v_s": "v_s"}
    return np.array([BOUNDS[keys.get(name, name.partition("_")[0].rstrip("v"))] for name in law.names])


def misfit(law: PaperLaw, series: AccelerationSeries) -> Callable[[Array], Array]:
    """Build the error function that the searches minimise, in single precision.

    Parameters
    ----------
    law, series
        The law, and the series to explain.

    Returns
    -------
    callable
        Function of parameter sets (P, d) that returns sums of squared acceleration residuals (P,), m^2/s^4.

    """
    t, v, a = series.single
    weight = np.float32(1 / series.mass)

    def cost(p: Array) -> Array:
        residual = law.force(p.astype(np.float32), v, t)
        residual *= weight
        residual += a
        return np.einsum("ij,ij->i", residual, residual).astype(np.float64)

    return cost


def squared_error(law: PaperLaw, p: Array, series: AccelerationSeries) -> float:
    """Compute the papers' error of one parameter set, in double precision.

    Parameters
    ----------
    law, series
        The law, and the series to explain.
    p
        Parameters, (d,).

    Returns
    -------
    float
        Sum of squared acceleration residuals, m^2/s^4.

    """
    residual = series.a + law.force(p[None], series.v, series.t)[0] / series.mass
    return float(residual @ residual)


def search_parameters(
    law: PaperLaw, series: AccelerationSeries, method: str, *, seed: int, budget: int, bounds: Array | None = None
) -> SearchResult:
    """Search all parameters by one method of the papers, without refinement.

    Parameters
    ----------
    law, series
        The law, and the series to explain.
    method
        Search of `frictrack.search`, such as "mga".
    seed, budget
        Seed and number of evaluations.
    bounds
        Bounds (d, 2); by default those of `search_bounds`.

    Returns
    -------
    SearchResult
        What the search found.

    """
    bounds_of_search = search_bounds(law) if bounds is None else bounds
    rng = np.random.default_rng(seed)
    return minimise(misfit(law, series), bounds_of_search, method=method, rng=rng, max_evaluations=budget)


def lowest_error_parameters(
    law: PaperLaw, series: AccelerationSeries, starts: Sequence[Array], rng: np.random.Generator, budget: int
) -> Array:
    """Find the lowest error that a law can reach, independently of the papers' searches.

    Differential evolution searches the non-linear parameters, least squares solves for the others (variable projection;
    Golub & Pereyra 1973, SIAM J. Numer. Anal. 10). The optima and `starts` are then refined within the bounds. For ATM2
    a lower error may exist.

    Parameters
    ----------
    law, series
        The law, and the series to explain.
    starts
        Further parameter sets to refine, (d,) each.
    rng
        Source of the search.
    budget
        Evaluations; a third of it per non-linear parameter and search.

    Returns
    -------
    Array
        Parameters, (d,).

    """
    thinned = series.thinned()
    optima = [p for reduction in law.reductions for p in _reduced_optima(law, reduction, thinned, rng, budget)]
    best = min((refine_parameters(law, thinned, p) for p in optima), key=lambda p: squared_error(law, p, thinned))
    refined = [refine_parameters(law, series, p) for p in (best, *starts)]
    return min((*starts, *refined), key=lambda p: squared_error(law, p, series))


def _reduced_optima(
    law: PaperLaw, reduction: Reduction, series: AccelerationSeries, rng: np.random.Generator, budget: int
) -> list[Array]:
    """Parameters (d,) at the optima of a law whose coefficients are solved for."""
    bounds_of_search, cost = search_bounds(law)[list(reduction.nonlinear)], _reduced_error(reduction, series)
    times = N_SEARCHES if budget >= N_SEARCHES * MIN_EVALUATIONS else 1
    options: dict[str, Any] = {
        "method": "de",
        "rng": rng,
        "max_evaluations": budget // N_SEARCHES * len(bounds_of_search),
    }
    found = [minimise(cost, bounds_of_search, **options) for _ in range(times)]
    return [_full_parameters(reduction, series, q) for result in found for q in result.optima[:OPTIMA_REFINED]]


def _reduced_error(reduction: Reduction, series: AccelerationSeries) -> Callable[[Array], Array]:
    """Error of non-linear parameters (P, k) with the best coefficients, from normal equations."""

    def cost(q: Array) -> Array:
        columns = reduction.columns(q, series.v, series.t)
        gram = columns @ columns.transpose(0, 2, 1)
        size = np.einsum("pii->p", gram) / gram.shape[1]
        gram = gram + 1e-9 * size[:, None, None] * np.eye(gram.shape[1])
        right = columns @ series.force
        best = np.linalg.solve(gram, right[..., None])[..., 0]
        return (series.force @ series.force - np.einsum("pc,pc->p", right, best)) / series.mass**2

    return cost


def _full_parameters(reduction: Reduction, series: AccelerationSeries, q: Array) -> Array:
    """All parameters (d,) for non-linear parameters q (k,) and their best coefficients."""
    columns = reduction.columns(q[None], series.v, series.t)[0]
    return reduction.full(q, np.linalg.lstsq(columns.T, series.force, rcond=None)[0])


def refine_parameters(law: PaperLaw, series: AccelerationSeries, start: Array) -> Array:
    """Refine parameters to the next minimum of the error within the bounds, by least squares.

    Parameters
    ----------
    law, series
        The law, and the series to explain.
    start
        Parameters to start from, (d,).

    Returns
    -------
    Array
        Refined parameters, (d,).

    """
    low, high = search_bounds(law).T
    width = high - low
    inside = np.clip(start, low + 1e-6 * width, high - 1e-6 * width)

    def residual(p: Array) -> Array:
        return np.asarray(series.a + law.force(p[None], series.v, series.t)[0] / series.mass)

    found = least_squares(residual, inside, bounds=(low, high), x_scale=width, max_nfev=MAX_REFINEMENTS)
    return np.asarray(found.x)
