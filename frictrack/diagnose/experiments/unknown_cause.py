"""Explain an unexplained force by a free curve over place, time since release or speed, so that runs can be rated.

The curve is piecewise linear with free heights. The candidate runs are rated between such curves as between effects.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from frictrack.axes import AXES
from frictrack.diagnose.compressed import compress_residual
from frictrack.diagnose.experiments.expected_separation import FittedExplanation
from frictrack.diagnose.formulas import AXIS_SYMBOLS
from frictrack.diagnose.smooth_forces import Axis, SmoothForce, smooth_forces
from frictrack.effects import Effect, Nonlinear, Parameter, Path
from frictrack.errors import FrictrackError
from frictrack.fit.least_squares import Solution, refine
from frictrack.fit.smooth_functions import linear_interpolation_matrix
from frictrack.records import Array

INVARIANTS = {  # by axis: what a force over it keeps when a run is made differently
    "x": "what depends on the place comes again at the same place",
    "t": "what depends on the time comes again equally long after release",
    "v": "what depends on the speed comes again at the same speed",
}
N_HATS = 14  # knots of a free curve
PRIOR_STD_RATIO = 0.5  # of friction: prior standard deviation of a height
MAX_AXES = 2  # over which an unexplained force is compared
MAX_STEPS = 8
MIN_CHI2_FALL = 0.1  # of a step; less does not change which runs separate two curves


def explain_by_axes(solution: Solution) -> list[FittedExplanation]:
    """Explain the residual of a fit by a free curve over each of its most likely axes.

    Parameters
    ----------
    solution
        The fit.

    Returns
    -------
    list of FittedExplanation
        Largest gain first.

    """
    friction = float(np.median(np.abs(np.concatenate([r.piece.mass * r.motion.a for r in solution.responses]))))
    likeliest: dict[str, SmoothForce] = {}  # by axis, over its factors
    for smooth in smooth_forces(compress_residual(solution)):
        likeliest.setdefault(smooth.axis.name, smooth)
    found = []
    for name in [name for name in likeliest if name in AXIS_SYMBOLS][:MAX_AXES]:
        try:
            made = _fit_free_curve(solution, likeliest[name], PRIOR_STD_RATIO * friction)
        except FrictrackError:  # a curve under which no motion can be integrated
            continue
        gain = max(solution.objective - made.objective, 0.0)
        found.append(FittedExplanation(AXES[name].name, made, gain, made))
    return sorted(found, key=lambda e: -e.gain)


def _fit_free_curve(solution: Solution, smooth: SmoothForce, prior_std: float) -> Solution:
    """Fit the model with a free curve over one axis, starting from the smooth force."""
    knots = np.linspace(smooth.at[0], smooth.at[-1], N_HATS)
    effect = _free_curve_effect(AXES[smooth.axis.name].name, smooth.axis, knots, prior_std)
    old = solution.problem.layout
    layout = replace(old, model=replace(old.model, effects=(*old.model.effects, effect)))
    values_by_name = dict(zip(old.names, solution.p, strict=True))
    values_by_name |= {f"{effect.name}.h{k}": float(h) for k, h in enumerate(np.interp(knots, smooth.at, smooth.force))}
    problem = solution.problem.rebuild(layout, solution.problem.pieces)
    p = np.array([values_by_name[name] for name in layout.names])
    return refine(
        problem, p, solution.starts, tau=solution.tau_of_other_runs, max_steps=MAX_STEPS, min_fall=MIN_CHI2_FALL
    )


def _free_curve_effect(name: str, axis: Axis, knots: Array, prior_std: float) -> Effect:
    """An effect that is any piecewise linear curve over an axis, constant beyond its knots (K,)."""

    def columns(path: Path, nonlinear: Nonlinear) -> Array:
        hats = linear_interpolation_matrix(np.clip(axis.of(path), knots[0], knots[-1]), knots)
        return np.asarray(axis.times(path)[:, None] * hats)

    heights = tuple(Parameter(f"h{k}", "N", linear=True, prior=(0.0, prior_std)) for k in range(len(knots)))
    return Effect(
        name=name,
        acts_on="force",
        equation=f"any curve over {name}",
        parameters=heights,
        columns=columns,
        invariant=INVARIANTS[axis.name],
    )
