"""The next experiment for what no effect explains: does it belong to the place, the time since release or the speed.

The force that is left is taken to be any curve over one of these axes, hats with free heights, and the runs of the
menu are weighed between them as between effects.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from frictrack.diagnose.compressed import reduced
from frictrack.diagnose.experiments.expected_separation import Explanation
from frictrack.diagnose.formulas import LETTERS
from frictrack.diagnose.smooth_forces import Axis, Smooth, smooth_forces
from frictrack.effects import Effect, Parameter, Path
from frictrack.effects.base import Nonlinear
from frictrack.errors import FrictrackError
from frictrack.fit.least_squares import Solution, refine
from frictrack.records import Array
from frictrack.words import AXES

HATS = 14  # over an axis
LOOSE = 0.5  # of friction: what is known of a height beside the runs
STEPS = 8


def along_axes(solution: Solution) -> list[Explanation]:
    """Explanations of what a law leaves by a curve over every axis, the likeliest first."""
    friction = float(np.median(np.abs(np.concatenate([r.piece.mass * r.motion.a for r in solution.responses]))))
    found = []
    for smooth in smooth_forces(reduced(solution)):
        if smooth.axis.name in LETTERS:
            try:
                made = _explained(solution, smooth, LOOSE * friction)
            except FrictrackError:  # a curve under which no motion can be integrated
                continue
            gain = max(solution.objective - made.objective, 0.0)
            found.append(Explanation(AXES[smooth.axis.name].word, made, gain, made))
    return sorted(found, key=lambda e: -e.gain)


def _explained(solution: Solution, smooth: Smooth, loose: float) -> Solution:
    """The law with any curve over one axis, from where the smooth one stands."""
    knots = np.linspace(smooth.at[0], smooth.at[-1], HATS)
    effect = _curve(AXES[smooth.axis.name].word, smooth.axis, knots, loose)
    old = solution.problem.layout
    layout = replace(old, model=replace(old.model, effects=(*old.model.effects, effect)))
    there = dict(zip(old.names, solution.p, strict=True))
    there |= {f"{effect.name}.h{k}": float(h) for k, h in enumerate(np.interp(knots, smooth.at, smooth.force))}
    problem = solution.problem.over(layout, solution.problem.pieces)
    p = np.array([there[name] for name in layout.names])
    return refine(problem, p, solution.starts, tau=max(solution.tau, 1e-3), max_steps=STEPS)


def _curve(name: str, axis: Axis, knots: Array, loose: float) -> Effect:
    """A force that is any curve over an axis: hats at knots (K,), its ends held beyond them."""

    def columns(path: Path, nonlinear: Nonlinear) -> Array:
        at = np.clip(axis.of(path), knots[0], knots[-1])
        hats = np.stack([np.interp(at, knots, row) for row in np.eye(len(knots))], axis=1)
        return np.asarray(axis.times(path)[:, None] * hats)

    heights = tuple(Parameter(f"h{k}", "N", linear=True, prior=(0.0, loose)) for k in range(len(knots)))
    return Effect(name=name, acts_on="force", equation=f"any curve over {name}", parameters=heights, columns=columns)
