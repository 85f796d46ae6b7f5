"""The papers' route: low-pass, two differences, F = -m a, and a search for all parameters along the measured v.

The error is theirs by context: the sum of squared acceleration residuals over the frames of the free section. Not
specified by the papers: the low-pass (Butterworth of order 4, forward and backward, here) and its cut-off (by residual
analysis, Winter 2009), the ends that are left out (one period of the cut-off at either), and the box that is searched.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from scipy.optimize import least_squares

from frictrack.records import Array, Run
from frictrack.reproduce.laws import Law, Real, Reduction
from frictrack.search import SearchResult, minimise

TIMES, EACH = 3, 3000  # differential evolutions in search of the lowest error; with fewer evaluations only one
STARTS, STEPS = 2, 60  # optima of each that are followed down, and how far
BOX = {
    "F_c": (0.0, 80.0),
    "F_s": (0.0, 120.0),
    "F_v": (0.0, 40.0),
    "v_s": (0.05, 3.0),
    "F": (0.0, 300.0),
    "f": (1.0, 490.0),
    "phi": (-np.pi, np.pi),
}  # N, N s/m, m/s, Hz, rad


@dataclass(frozen=True, eq=False)
class Series:
    """Time (s, since release), velocity and acceleration of the papers' chain, and the mass; frames end to end."""

    t: Array
    v: Array
    a: Array
    mass: float

    @property
    def force(self) -> Array:
        """Friction F = -m a, N."""
        return -self.mass * self.a

    def thinned(self) -> Series:
        """At most every fourth frame, enough for every frequency searched, and no fewer than 200 where possible."""
        step = int(np.clip(len(self.t) // 200, 1, 4))
        return Series(self.t[::step], self.v[::step], self.a[::step], self.mass)

    @cached_property
    def single(self) -> tuple[Real, Real, Real]:
        """t, v, a in single precision, in which a population costs a third."""
        return self.t.astype(np.float32), self.v.astype(np.float32), self.a.astype(np.float32)


def measured(runs: Sequence[Run]) -> Series:
    """What the papers' chain makes of runs of one mass, end to end."""
    parts = []
    for run in runs:
        motion = run.motion
        guard = round(1 / (motion.cutoff * float(np.median(np.diff(motion.t)))))
        parts.append([column[guard:-guard] for column in (motion.t, motion.v, motion.a)])
    t, v, a = (np.concatenate(column) for column in zip(*parts, strict=True))
    return Series(t, v, a, float(runs[0].mass or 1.0))


def box(law: Law) -> Array:
    """Bounds (d, 2) of a search."""
    keys = {"f_c": "F_c", "f_s": "F_s", "f_v": "F_v", "F_c": "F_c", "F_s": "F_s", "F_v": "F_v", "v_s": "v_s"}
    return np.array([BOX[keys.get(name, name.partition("_")[0].rstrip("v"))] for name in law.names])


def misfit(law: Law, series: Series) -> Callable[[Array], Array]:
    """Sum of squared acceleration residuals (P,), m^2/s^4, of parameter sets (P, d)."""
    t, v, a = series.single
    weight = np.float32(1 / series.mass)

    def cost(p: Array) -> Array:
        rest = law.force(p.astype(np.float32), v, t)
        rest *= weight
        rest += a
        return np.einsum("ij,ij->i", rest, rest).astype(np.float64)

    return cost


def error(law: Law, p: Array, series: Series) -> float:
    """The papers' error of one parameter set (d,), m^2/s^4."""
    rest = series.a + law.force(p[None], series.v, series.t)[0] / series.mass
    return float(rest @ rest)


def search(
    law: Law, series: Series, method: str, *, seed: int, budget: int, bounds: Array | None = None
) -> SearchResult:
    """All parameters by one search of the papers; what it found is left as it is."""
    where = box(law) if bounds is None else bounds
    rng = np.random.default_rng(seed)
    return minimise(misfit(law, series), where, method=method, rng=rng, max_evaluations=budget)


def lowest(law: Law, series: Series, starts: Sequence[Array], rng: np.random.Generator, budget: int) -> Array:
    """The parameters (d,) of the lowest error that is known: what a law can do, whatever search one has.

    Differential evolution over the non-linear parameters (a third of `budget` for each of them), the rest by least
    squares, several times; from there and
    from `starts` down to the nearest minimum inside the box. For ATM2 this is no proof that there is none lower.
    """
    thin = series.thinned()
    near = [p for reduction in law.reductions for p in _basins(law, reduction, thin, rng, budget)]
    best = min((down(law, thin, p) for p in near), key=lambda p: error(law, p, thin))
    tried = [down(law, series, p) for p in (best, *starts)]
    return min((*starts, *tried), key=lambda p: error(law, p, series))


def _basins(law: Law, reduction: Reduction, series: Series, rng: np.random.Generator, budget: int) -> list[Array]:
    """Parameters (d,) at the optima of a reduced law."""
    where, cost = box(law)[list(reduction.nonlinear)], _reduced(reduction, series)
    times = TIMES if budget >= TIMES * EACH else 1
    how: dict[str, Any] = {"method": "de", "rng": rng, "max_evaluations": budget // TIMES * len(where)}
    found = [minimise(cost, where, **how) for _ in range(times)]
    return [_full(reduction, series, q) for one in found for q in one.optima[:STARTS]]


def _reduced(reduction: Reduction, series: Series) -> Callable[[Array], Array]:
    """Error of non-linear parameters (P, k) with the best coefficients, by normal equations."""

    def cost(q: Array) -> Array:
        columns = reduction.columns(q, series.v, series.t)
        gram = columns @ columns.transpose(0, 2, 1)
        size = np.einsum("pii->p", gram) / gram.shape[1]
        gram = gram + 1e-9 * size[:, None, None] * np.eye(gram.shape[1])
        right = columns @ series.force
        best = np.linalg.solve(gram, right[..., None])[..., 0]
        return (series.force @ series.force - np.einsum("pc,pc->p", right, best)) / series.mass**2

    return cost


def _full(reduction: Reduction, series: Series, q: Array) -> Array:
    """All parameters (d,) of non-linear ones q (k,) with their best coefficients."""
    columns = reduction.columns(q[None], series.v, series.t)[0]
    return reduction.full(q, np.linalg.lstsq(columns.T, series.force, rcond=None)[0])


def down(law: Law, series: Series, start: Array) -> Array:
    """The minimum of the error inside the box next to a start, by least squares with bounds."""
    low, high = box(law).T
    width = high - low
    inside = np.clip(start, low + 1e-6 * width, high - 1e-6 * width)

    def rest(p: Array) -> Array:
        return np.asarray(series.a + law.force(p[None], series.v, series.t)[0] / series.mass)

    found = least_squares(rest, inside, bounds=(low, high), x_scale=width, max_nfev=STEPS)
    return np.asarray(found.x)
