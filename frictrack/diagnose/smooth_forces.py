"""Axes along which a force may repeat, and the smooth force over each that is most likely.

The force is a Gaussian process over place, time since release, speed, or the phase of a motion to and fro, seen where
the noise is white: through the motion that it makes, beside the law and the scatter of its levels. Size and length of
the process are those of the highest restricted likelihood (Rasmussen & Williams 2006, ch. 5).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import BSpline

from frictrack.diagnose.compressed import SPLINE_DEGREE, CompressedResidual
from frictrack.effects import Path
from frictrack.records import Array

N_SPLINES = 60  # over an axis
LENGTHS = np.array([1.0, 0.5, 0.25, 0.125, 0.0625, 0.03, 0.015])  # of the axis, over which a force is alike
SIZES = np.geomspace(1e-3, 1e3, 61)  # of the process, over what a unit of chi-squared asks for
JITTER = 1e-8
N_CURVE_POINTS = 81  # of the curve
MIN_LOAD_RATIO = 1.2  # ratio of loads beyond which runs differ in their load
MIN_REVERSALS = 2  # times that a motion must turn back to have a phase


@dataclass(frozen=True)
class Axis:
    """Along what a force may repeat: `of` a path (n,), and what multiplies it there, as a study file writes it."""

    name: str
    of: Callable[[Path], Array]
    factor: str  # "L * s", "s" or ""

    def times(self, path: Path) -> Array:
        """The factor along a path, (n,)."""
        return np.ones_like(path.t) if not self.factor else path.s * (path.load if "L" in self.factor else 1.0)


@dataclass(frozen=True)
class SmoothForce:
    """The most likely smooth force over one axis: places (k,), force and its deviation (k,), N; its evidence."""

    axis: Axis
    gain: float  # twice the rise of the log restricted likelihood
    at: Array
    force: Array
    sigma: Array
    share: float  # of the chi-squared above the noise
    length: float  # over which the force is alike, in the unit of the axis


def smooth_forces(left: CompressedResidual) -> list[SmoothForce]:
    """The most likely force over every axis, the most likely axis first."""
    return sorted((_smooth(left, axis) for axis in candidate_axes(left)), key=lambda s: -s.gain)


def gain_of_separate_curves(left: CompressedResidual) -> float:
    """The same gain where every run has a smooth force of its own over time, alike in size and length alone."""
    t = left.gathered(lambda p: p.t)
    knots = _knots(float(t.min()), float(t.max()))
    design = BSpline.design_matrix(t, knots, SPLINE_DEGREE).toarray()
    of = np.repeat(left.runs, [len(p.t) for p in left.paths])
    seen = np.hstack([left.trace(left.cut(design * (of == run)[:, None])) for run in sorted(set(left.runs))])
    gram, pull, span = seen.T @ seen, seen.T @ left.left, float(np.ptp(t))
    each = np.eye(len(set(left.runs)))
    roots: list[Array] = [np.asarray(np.kron(each, _root(knots, span * length)), np.float64) for length in LENGTHS]
    return max(_likeliest(gram, pull, root)[0] for root in roots)


def candidate_axes(left: CompressedResidual) -> list[Axis]:
    """Axes that these runs can tell apart; the phase is that of a motion that turns back again and again."""
    named: dict[str, Callable[[Path], Array]] = {"x": lambda p: p.x, "t": lambda p: p.t, "v": lambda p: p.speed}
    if min(_turns(left, run) for run in set(left.runs)) >= MIN_REVERSALS:
        named["phase"] = _phase_of(left)
    loads = [p.load for p in left.paths]
    one_way = np.ptp(left.gathered(lambda p: p.s)) == 0
    factors = ["L * s"] + ([] if one_way else [""]) + (["s"] if max(loads) > MIN_LOAD_RATIO * min(loads) else [])
    return [Axis(name, of, factor) for name, of in named.items() for factor in factors]


def _turns(left: CompressedResidual, run: int) -> int:
    """How often a run turns back."""
    s = np.concatenate([p.s for p, r in zip(left.paths, left.runs, strict=True) if r == run])
    return int(np.sum(np.diff(s[s != 0]) != 0))


def _phase_of(left: CompressedResidual) -> Callable[[Path], Array]:
    """Phase of a motion to and fro, rad: 0 at its middle on the way up, pi/2 at its upper end."""
    x, v = left.gathered(lambda p: p.x), left.gathered(lambda p: p.v)
    middle, reach, fast = (x.max() + x.min()) / 2, np.ptp(x) / 2, np.abs(v).max()
    return lambda p: np.arctan2((p.x - middle) / reach, p.v / fast)


def _smooth(left: CompressedResidual, axis: Axis) -> SmoothForce:
    """The most likely process over one axis."""
    u = left.gathered(axis.of)
    low, high = float(u.min()), float(u.max())
    span = max(high - low, 1e-12)
    knots = _knots(low, high)
    design = BSpline.design_matrix(np.clip(u, low, high), knots, SPLINE_DEGREE).toarray()
    factor = left.gathered(axis.times)
    seen = left.trace(left.cut(design * factor[:, None]))
    gram, pull = seen.T @ seen, seen.T @ left.left
    grid = np.linspace(low, high, N_CURVE_POINTS)
    tried = [_likeliest(gram, pull, _root(knots, span * length)) for length in LENGTHS]
    best = int(np.argmax([t[0] for t in tried]))
    gain, mean, root = tried[best]
    spread = root @ root.T
    show = BSpline.design_matrix(grid, knots, SPLINE_DEGREE).toarray()
    return SmoothForce(
        axis=axis,
        gain=gain,
        at=grid,
        force=show @ mean,
        sigma=np.sqrt(np.maximum(np.einsum("ki,ij,kj->k", show, spread, show), 0.0)),
        share=_share(left, seen @ mean),
        length=span * float(LENGTHS[best]),
    )


def _knots(low: float, high: float) -> Array:
    return np.concatenate(
        [[low] * SPLINE_DEGREE, np.linspace(low, high, N_SPLINES - SPLINE_DEGREE + 1), [high] * SPLINE_DEGREE]
    )


def _root(knots: Array, length: float) -> Array:
    """Square root (m, m) of the covariance of spline coefficients, alike over `length` (Matern 5/2)."""
    centres = np.array([knots[i + 1 : i + SPLINE_DEGREE + 1].mean() for i in range(N_SPLINES)])
    z = np.sqrt(5.0) * np.abs(centres[:, None] - centres) / length
    return np.linalg.cholesky((1 + z + z**2 / 3) * np.exp(-z) + JITTER * np.eye(N_SPLINES))


def _likeliest(gram: Array, pull: Array, root: Array) -> tuple[float, Array, Array]:
    """Gain, mean (m,) and a root of the covariance (m, m) of the coefficients at the most likely size."""
    values, vectors = np.linalg.eigh(root.T @ gram @ root)
    values = np.maximum(values, 0.0)
    g = vectors.T @ (root.T @ pull)
    sizes = SIZES[:, None] * max(float(g @ g) / max(float(values @ values), 1e-300), 1e-300)
    gains = np.sum(sizes * g**2 / (1 + sizes * values) - np.log1p(sizes * values), axis=1)
    best = int(np.argmax(gains))
    shrunk = sizes[best] / (1 + sizes[best] * values)
    basis = root @ vectors
    return float(gains[best]), basis @ (shrunk * g), basis * np.sqrt(shrunk)


def _share(left: CompressedResidual, fitted: Array) -> float:
    """Part of the chi-squared above the noise that a trace (M,) takes away."""
    gone = float(left.left @ left.left - np.sum((left.left - fitted) ** 2))
    return float(np.clip(gone / max(left.excess, gone, 1e-300), 0.0, 1.0))
