"""Fit the runs of an effect without it: the residual, the missing force, and what else would explain them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from gallery_runs import Example, SimulatedRun, Values, simulate_example

import frictrack as ft
from frictrack.diagnose.examination import list_candidates
from frictrack.effects import Effect
from frictrack.effects.ranges import oscillates
from frictrack.fit import Fit
from frictrack.fit.least_squares import Solution, refine
from frictrack.fit.linearised import (
    CandidateScan,
    LinearisedModel,
    candidate_grids,
    linearise,
    measured_series,
    scan_candidates,
)
from frictrack.fit.stepwise import effect_for_scan
from frictrack.records import Array, Curve, Run

MIN_SIGMAS_MISFIT = 3.0  # standard deviations of chi-squared by which a misfit exceeds noise
LEVEL_SCATTER = 0.03  # relative, of dry friction from run to run
SMALL = 1e-9  # size of an effect of which a scan judges the shape only, SI units


@dataclass(frozen=True)
class Leftover:
    """What the fit leaves of one run, (n,) each.

    Attributes
    ----------
    t, x, v
        Time (s), and the modelled position (m) and velocity (m/s).
    residual
        Measured less modelled displacement, m.
    F
        Measured less modelled friction force, N; NaN where the filter smears the ends of the run.
    segments
        Number of segments, each with initial conditions of its own, in which the run was fitted.

    """

    t: Array
    x: Array
    v: Array
    residual: Array
    F: Array
    segments: int


@dataclass(frozen=True)
class Failure:
    """A model that lacks one effect, fitted to runs that have it.

    Attributes
    ----------
    effect
        Name of the effect.
    example
        What was simulated.
    runs
        The runs with their truth.
    fit
        The fit without the effect.
    explained
        Share of the misfit that the effect itself and every other effect of the library explain, by name; none where
        there is no misfit, because the friction levels of the runs take it up.

    """

    effect: str
    example: Example
    runs: list[SimulatedRun]
    fit: Fit
    explained: dict[str, float]

    @property
    def lookalikes(self) -> list[tuple[str, float]]:
        """Other effects and their shares of the misfit, largest first."""
        others = ((name, share) for name, share in self.explained.items() if name != self.effect)
        return sorted(others, key=lambda item: -item[1])

    @property
    def levels(self) -> dict[str, float]:
        """Friction level of every run."""
        layout, p = self.fit.solution.problem.layout, self.fit.solution.p
        return {name: layout.values(p, i)[1] for i, name in enumerate(layout.run_names)}

    @cached_property
    def leftovers(self) -> list[Leftover]:
        """What the fit leaves, run by run."""
        return [_leftover(made.run, [c for c in self.fit.curves if c.run == made.run.name]) for made in self.runs]


def _leftover(run: Run, curves: list[Curve]) -> Leftover:
    t, x, v, residual, modelled = (
        np.concatenate([getattr(curve, name) for curve in curves])
        for name in ("t", "x_model", "v_model", "residual", "F_model")
    )
    force, guard = ft.friction(run), run.motion.guard
    inner = (t >= force.t[guard]) & (t <= force.t[-1 - guard])
    inner &= np.diff(t, prepend=t[0]) < 1.5 * np.median(np.diff(t))  # no line across frames that were not fitted
    inner &= np.diff(np.sign(v), prepend=np.sign(v[0])) == 0  # nor across a reversal
    missing = np.interp(t, force.t, force.F) - modelled
    return Leftover(t, x, v, residual, np.where(inner, missing, np.nan), len(curves))


def fit_without(effect: str, example: Example) -> Failure:
    """Simulate the runs of an effect, fit the model that lacks it, and see what else would explain the misfit.

    Parameters
    ----------
    effect
        Name of the effect.
    example
        Its law and design.

    Returns
    -------
    Failure
        The fit and what it leaves.

    """
    runs = simulate_example(effect, example)
    fit = ft.fit(list(example.law), [made.run for made in runs])
    return Failure(effect, example, runs, fit, explained_shares(fit, example.truth))


def explained_shares(fit: Fit, truth: Values) -> dict[str, float]:
    """Share of the misfit that each effect of the library would explain, by name.

    It is the fall of chi-squared in the scan of a diagnosis, over the chi-squared above its expectation. The law's own
    parameters are fitted again beside every candidate, about their true values, where they are linear. An event (a
    collision, a lost frame) may happen in one run.
    """
    left, frames = fit.solution.chi2, fit.solution.problem.n_frames
    if left - frames < MIN_SIGMAS_MISFIT * np.sqrt(2 * frames):
        return {}
    solution = _at_true_values(fit.solution, truth)
    candidates, _ = list_candidates(solution)
    law = linearise(solution)
    series = measured_series(law)
    residual = series.residuals[:, 0].astype(float)
    misfit = float(residual @ residual) - len(residual)
    shares = {}
    for effect in candidates:
        grids = candidate_grids(law, effect_for_scan(solution, effect))
        gains = [_largest_plausible_gain(law, effect, scan) for scan in scan_candidates(law, grids, series)]
        if gains:
            shares[effect.kind] = float(np.clip(max(gains) / max(misfit, 1.0), 0.0, 1.0))
    return shares


def _at_true_values(solution: Solution, truth: Values) -> Solution:
    """The law at its true parameters, friction levels at one; those that the truth does not have stay as fitted."""
    layout = solution.problem.layout
    pairs = enumerate(zip(layout.slots, solution.p, strict=True))
    p = [1.0 if i in layout.levels else truth.get(s.effect, {}).get(s.parameter, fitted) for i, (s, fitted) in pairs]
    return refine(solution.problem, np.array(p), solution.starts, tau=LEVEL_SCATTER, max_steps=0)


def _largest_plausible_gain(law: LinearisedModel, effect: Effect, scan: CandidateScan) -> float:
    """Largest fall of chi-squared at a point of the grid to which the effect itself does not object in any run."""
    for g in np.argsort(-scan.gains):
        if not _objects(law, effect, scan.grid.point(int(g))):
            return float(scan.gains[g])
    return 0.0


def _objects(law: LinearisedModel, effect: Effect, shape: dict[str, float]) -> bool:
    """Whether an effect of this shape, however small, is implausible in a run.

    A wave of less than a period and a half is no wave here, whatever the effect itself says: it imitates any trend.
    """
    checks = [effect.plausible] if effect.plausible else []
    if any(p.unit == "Hz" for p in effect.parameters):
        checks.append(oscillates)
    size = 1.0 if effect.test_draw.own_size else SMALL
    small = shape | {p.name: size for p in effect.parameters if p.linear or p.role == "depth"}
    return any(check(small, span) for check in checks for span in law.solution.problem.layout.spans)
