"""Find the most likely smooth force over place, time since release, speed, or phase of an oscillating motion.

The force is a Gaussian process (Matern 5/2) on spline coefficients, compared through its trace in the compressed
residual, with the model and the scatter of its friction levels projected out. Amplitude and length maximise the
restricted likelihood.

References
----------
Rasmussen & Williams (2006), Gaussian Processes for Machine Learning, ch. 5.

"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from typing import Any

import numpy as np
from scipy.interpolate import BSpline

from frictrack.diagnose.compressed import SPLINE_DEGREE, CompressedResidual, compress_residual, is_far_from_data
from frictrack.effects import Path
from frictrack.fit.least_squares import Solution
from frictrack.fit.smooth_functions import SmoothProcess, matern_root, most_likely_process
from frictrack.records import Array

N_SPLINES = 60  # per axis
LENGTH_RATIOS = np.array([1.0, 0.5, 0.25, 0.125, 0.0625, 0.03, 0.015])  # correlation lengths over the axis
N_CURVE_POINTS = 81  # of the curve
MIN_LOAD_RATIO = 1.2  # above which runs differ in load
MIN_REVERSALS = 2  # of a motion with a phase


FACTORS: dict[str, Callable[[Path], Any]] = {  # what may multiply a force, as in a study file
    "L": lambda p: p.load,
    "s": lambda p: p.s,
    "x": lambda p: p.x,
    "t": lambda p: p.t,
    "abs(v)": lambda p: p.speed,
    "mass": lambda p: p.mass,
    "mass^(-1/2)": lambda p: np.asarray(p.mass, dtype=float) ** (-1 / 2),
    "mass^(-1/3)": lambda p: np.asarray(p.mass, dtype=float) ** (-1 / 3),
}


@dataclass(frozen=True)
class Axis:
    """A variable over which a force may repeat.

    Parameters
    ----------
    name
        Its name: "x", "t", "v" or "phase".
    of
        Function from a path to the variable, (n,).
    factor
        Factor on the force along the path, as in a study file: a product of `FACTORS`, such as "L * s", or "".

    """

    name: str
    of: Callable[[Path], Array]
    factor: str

    def times(self, path: Path) -> Array:
        """Factor on the force along a path, (n,)."""
        out = np.ones_like(path.t)
        for one in self.factor.split(" * ") if self.factor else ():
            out = out * FACTORS[one](path)
        return out


@dataclass(frozen=True)
class SmoothForce:
    """The most likely smooth force over one axis.

    Parameters
    ----------
    axis
        The axis.
    gain
        Twice the rise of the log restricted likelihood.
    at, force, sigma
        Values of the axis, force and its standard deviation N, (k,).
    share
        Share of the chi-squared above its expectation.
    length
        Correlation length, in the unit of the axis.
    traces
        Traces (M, k) in the compressed residual of its k independent components of unit variance, model included.

    """

    axis: Axis
    gain: float
    at: Array
    force: Array
    sigma: Array
    share: float
    length: float
    traces: Array


@dataclass(frozen=True, eq=False)
class ResidualForces:
    """What the residual of a fit says of smooth forces; each is computed once, when it is first asked for.

    Parameters
    ----------
    solution
        The fit.
    about_measurement
        Whether it is linearised about the measured motion instead of its own.

    """

    solution: Solution
    about_measurement: bool = False

    @cached_property
    def compressed(self) -> CompressedResidual:
        """The compressed residual."""
        return compress_residual(self.solution, about_measurement=self.about_measurement)

    @cached_property
    def smooth(self) -> list[SmoothForce]:
        """The most likely smooth force over every axis, largest gain first."""
        return smooth_forces(self.compressed)


def forces_of(solution: Solution) -> ResidualForces:
    """Return the forces in the residual of a fit, about the measured motion where its own is far from the data."""
    return ResidualForces(solution, is_far_from_data(solution))


def smooth_forces(compressed: CompressedResidual, axes: Sequence[Axis] = ()) -> list[SmoothForce]:
    """Find the most likely smooth force over every axis.

    `axes`: the axes; by default those that the runs can distinguish, without multipliers. The largest gain comes
    first.
    """
    return sorted((_smooth(compressed, axis) for axis in axes or candidate_axes(compressed)), key=lambda s: -s.gain)


@dataclass(frozen=True)
class SeparateCurves:
    """A smooth force over time in every run, with common amplitude and length: one process on splines, run by run."""

    process: SmoothProcess
    runs: list[int]
    knots: Array

    def at(self, run: int, t: Array) -> tuple[Array, Array]:
        """Mean and variance (n,) of the force in one run at times since release."""
        k = self.runs.index(run)
        own, basis = slice(k * N_SPLINES, (k + 1) * N_SPLINES), _basis(t, self.knots)
        return basis @ self.process.mean[own], np.sum((basis @ self.process.spread[own]) ** 2, axis=1)


def separate_curves(compressed: CompressedResidual, known: Array | None = None) -> SeparateCurves:
    """Find the most likely smooth force over time if every run has its own.

    `known`: traces (M, k) of forces that explain a part of it.
    """
    t, runs = compressed.concatenate(lambda p: p.t), sorted(set(compressed.runs))
    knots = _knots(float(t.min()), float(t.max()))
    of = np.repeat(compressed.runs, [len(p.t) for p in compressed.paths])
    basis = _basis(t, knots)
    columns = np.hstack([basis * (of == run)[:, None] for run in runs])
    traces = compressed.traces_of(compressed.split_by_piece(columns))
    if known is not None:
        q, _ = np.linalg.qr(known)
        traces = traces - q @ (q.T @ traces)
        residual = compressed.residual - q @ (q.T @ compressed.residual)
    else:
        residual = compressed.residual
    roots = [np.asarray(np.kron(np.eye(len(runs)), root), np.float64) for root in _roots()]
    return SeparateCurves(most_likely_process(traces.T @ traces, traces.T @ residual, roots), runs, knots)


def candidate_axes(compressed: CompressedResidual) -> list[Axis]:
    """Axes that these runs can distinguish; a phase needs a motion that reverses repeatedly."""
    steady = compressed.paths[0].steady
    named: dict[str, Callable[[Path], Array]] = {} if steady else {"x": lambda p: p.x, "t": lambda p: p.t}
    named["v"] = lambda p: p.speed
    if not steady and min(_count_reversals(compressed, run) for run in set(compressed.runs)) >= MIN_REVERSALS:
        named["phase"] = _phase_function(compressed)
    loads = compressed.concatenate(lambda p: np.broadcast_to(p.load, p.t.shape))
    one_way = np.ptp(compressed.concatenate(lambda p: p.s)) == 0
    factors = ["L * s"] + ([] if one_way else [""]) + (["s"] if np.max(loads) > MIN_LOAD_RATIO * np.min(loads) else [])
    return [Axis(name, of, factor) for name, of in named.items() for factor in factors]


def _count_reversals(compressed: CompressedResidual, run: int) -> int:
    """Number of reversals of a run."""
    s = np.concatenate([p.s for p, r in zip(compressed.paths, compressed.runs, strict=True) if r == run])
    return int(np.sum(np.diff(s[s != 0]) != 0))


def _phase_function(compressed: CompressedResidual) -> Callable[[Path], Array]:
    """Phase of an oscillating motion, rad: 0 at its middle going up, pi/2 at its upper end."""
    x, v = compressed.concatenate(lambda p: p.x), compressed.concatenate(lambda p: p.v)
    middle, reach, fast = (x.max() + x.min()) / 2, np.ptp(x) / 2, np.abs(v).max()
    return lambda p: np.arctan2((p.x - middle) / reach, p.v / fast)


def _smooth(compressed: CompressedResidual, axis: Axis) -> SmoothForce:
    """The most likely process over one axis."""
    u = compressed.concatenate(axis.of)
    low, high = float(u.min()), float(u.max())
    span = max(high - low, 1e-12)
    knots = _knots(low, high)
    columns = _basis(u, knots) * compressed.concatenate(axis.times)[:, None]
    raw = raw_traces(compressed, compressed.split_by_piece(columns))
    traces = compressed.project_out_model(raw)
    gram, right_side = traces.T @ traces, traces.T @ compressed.residual
    grid = np.linspace(low, high, N_CURVE_POINTS)
    found = most_likely_process(gram, right_side, _roots())
    basis = _basis(grid, knots)
    return SmoothForce(
        axis=axis,
        gain=found.gain,
        at=grid,
        force=basis @ found.mean,
        sigma=np.linalg.norm(basis @ found.spread, axis=1),
        share=_share(compressed, traces @ found.mean),
        length=span * float(LENGTH_RATIOS[found.root]),
        traces=raw @ found.prior,
    )


def raw_traces(compressed: CompressedResidual, columns: Sequence[Array]) -> Array:
    """Traces (M, k) of forces (n_i, k) along the pieces, N, without projection."""
    return np.concatenate([m @ c for m, c in zip(compressed.force_maps, columns, strict=True)])


def _knots(low: float, high: float) -> Array:
    return np.concatenate(
        [[low] * SPLINE_DEGREE, np.linspace(low, high, N_SPLINES - SPLINE_DEGREE + 1), [high] * SPLINE_DEGREE]
    )


def _basis(u: Array, knots: Array) -> Array:
    """Values (n, m) of the splines at u (n,), constant beyond their ends."""
    return np.asarray(BSpline.design_matrix(np.clip(u, knots[0], knots[-1]), knots, SPLINE_DEGREE).toarray())


@cache
def _roots() -> list[Array]:
    """Roots (m, m) of the covariance of the spline coefficients for every length ratio."""
    knots = _knots(0.0, 1.0)
    centres = np.array([knots[i + 1 : i + SPLINE_DEGREE + 1].mean() for i in range(N_SPLINES)])
    return [matern_root(centres, length) for length in LENGTH_RATIOS.tolist()]


def _share(compressed: CompressedResidual, fitted: Array) -> float:
    """Share of the chi-squared above its expectation that a trace (M,) removes."""
    explained = float(compressed.residual @ compressed.residual - np.sum((compressed.residual - fitted) ** 2))
    return float(np.clip(explained / max(compressed.excess, explained, 1e-300), 0.0, 1.0))
