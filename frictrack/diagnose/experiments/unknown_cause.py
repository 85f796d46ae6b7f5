"""The next experiment for what no effect explains: does it belong to the place, the time since release or the speed.

The force that is left is taken to be any curve over one of these axes, hats with free heights, and the runs of the
menu are weighed between them as between effects.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from frictrack.axes import AXES
from frictrack.diagnose.compressed import compress_residual
from frictrack.diagnose.experiments.expected_separation import Explanation
from frictrack.diagnose.formulas import AXIS_SYMBOLS
from frictrack.diagnose.smooth_forces import Axis, SmoothForce, smooth_forces
from frictrack.effects import Effect, Parameter, Path
from frictrack.effects.base import Nonlinear
from frictrack.errors import FrictrackError
from frictrack.fit.least_squares import Solution, refine
from frictrack.records import Array

N_HATS = 14  # over an axis
PRIOR_STD_RATIO = 0.5  # of friction: what is known of a height beside the runs
MAX_STEPS = 8


def explain_by_axes(solution: Solution) -> list[Explanation]:
    """Explanations of what a law leaves by a curve over every axis, the likeliest first."""
    friction = float(np.median(np.abs(np.concatenate([r.piece.mass * r.motion.a for r in solution.responses]))))
    found = []
    for smooth in smooth_forces(compress_residual(solution)):
        if smooth.axis.name in AXIS_SYMBOLS:
            try:
                made = _explained(solution, smooth, PRIOR_STD_RATIO * friction)
            except FrictrackError:  # a curve under which no motion can be integrated
                continue
            gain = max(solution.objective - made.objective, 0.0)
            found.append(Explanation(AXES[smooth.axis.name].name, made, gain, made))
    return sorted(found, key=lambda e: -e.gain)


def _explained(solution: Solution, smooth: SmoothForce, loose: float) -> Solution:
    """The law with any curve over one axis, from where the smooth one stands."""
    knots = np.linspace(smooth.at[0], smooth.at[-1], N_HATS)
    effect = _curve(AXES[smooth.axis.name].name, smooth.axis, knots, loose)
    old = solution.problem.layout
    layout = replace(old, model=replace(old.model, effects=(*old.model.effects, effect)))
    there = dict(zip(old.names, solution.p, strict=True))
    there |= {f"{effect.name}.h{k}": float(h) for k, h in enumerate(np.interp(knots, smooth.at, smooth.force))}
    problem = solution.problem.over(layout, solution.problem.pieces)
    p = np.array([there[name] for name in layout.names])
    return refine(problem, p, solution.starts, tau=max(solution.tau, 1e-3), max_steps=MAX_STEPS)


def _curve(name: str, axis: Axis, knots: Array, loose: float) -> Effect:
    """A force that is any curve over an axis: hats at knots (K,), its ends held beyond them."""

    def columns(path: Path, nonlinear: Nonlinear) -> Array:
        at = np.clip(axis.of(path), knots[0], knots[-1])
        hats = np.stack([np.interp(at, knots, row) for row in np.eye(len(knots))], axis=1)
        return np.asarray(axis.times(path)[:, None] * hats)

    heights = tuple(Parameter(f"h{k}", "N", linear=True, prior=(0.0, loose)) for k in range(len(knots)))
    return Effect(name=name, acts_on="force", equation=f"any curve over {name}", parameters=heights, columns=columns)
