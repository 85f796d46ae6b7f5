"""Find what may be wrong with one run if no effect explains the misfit: its mass, or the run as a whole.

Where one run is at fault, the model explains all others without it; only the mass of such a run is fitted. Dry friction
decelerates all masses alike, so a wrong mass shows only in the forces that do not grow with the load. What it leaves is
small, and fits no effect. Often several masses would explain it; all are named.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.optimize import minimize_scalar

from frictrack.diagnose.hypothesis_tests import lack_of_fit
from frictrack.diagnose.null_distribution import draw_null_ensemble
from frictrack.errors import FrictrackError
from frictrack.fit import Fit, fit
from frictrack.fit.least_squares import Solution, fit_with_scatter
from frictrack.models import Model
from frictrack.number_format import format_number
from frictrack.records import Run

MIN_RUNS = 3  # two others show that they agree
MAX_RUNS, MAX_FRAMES = 8, 20_000  # of all runs together; a mass takes about ten fits
N_DRAWS = 199
MIN_P_EXPLAINED = 0.05  # of the lack of fit
MAX_LOG_FACTOR = float(np.log(5.0))  # of a mass
MIN_LOG_FACTOR = 0.05  # a smaller change is no mistake of a person
LOG_TOLERANCE = 0.02


def suspect_run_remarks(last: Solution, runs: Sequence[Run], rng: np.random.Generator) -> list[str]:
    """Describe what may be wrong with one run: masses that would explain what is left, or the run that disagrees.

    Parameters
    ----------
    last
        The model with the effects found, which leaves a significant misfit.
    runs
        The fitted runs.
    rng
        Random generator of the tests.

    Returns
    -------
    list of str
        At most one sentence. Empty for fewer than three runs, or where many runs or frames would make it slow.

    """
    fitted = [run for run in runs if run.role != "validation"]
    frames = sum(len(run.motion) for run in fitted)
    if not (MIN_RUNS <= len(fitted) <= MAX_RUNS and frames <= MAX_FRAMES and last.problem.simulates):
        return []
    odd = [run for run in fitted if _explains(_without(last, run.name), rng)]
    masses = _masses_that_explain(last.problem.model, fitted, odd, rng)
    if masses:
        each = [f"{format_number(m)} kg instead of {format_number(run.mass)} kg for {run.name}" for run, m in masses]
        return [f"one wrong mass would explain what the effects leave: {', or '.join(each)}; check the masses"]
    if len(odd) != 1:
        return []
    check = "check its mass, frame rate and scale, and whether its surface was the same"
    return [f"without {odd[0].name} the model with the effects found explains all other runs: {check}"]


def _without(last: Solution, run: str) -> Solution | None:
    """The same model refined for all runs but one; the unknowns of that run keep their values."""
    problem = last.problem
    kept = [i for i, piece in enumerate(problem.pieces) if problem.layout.run_names[piece.run] != run]
    fewer = problem.rebuild(problem.layout, [problem.pieces[i] for i in kept])
    fewer = fewer.beginning_at([last.responses[i] for i in kept])
    try:
        return fit_with_scatter(fewer, last.p, [last.starts[i] for i in kept], last.tau)
    except FrictrackError:
        return None


def _explains(found: Solution | None, rng: np.random.Generator) -> bool:
    """Whether a model leaves no significant misfit."""
    return found is not None and lack_of_fit(draw_null_ensemble(found, rng, N_DRAWS)) >= MIN_P_EXPLAINED


def _fit(model: Model, runs: Sequence[Run]) -> Fit | None:
    try:
        return fit(model, runs)
    except FrictrackError:
        return None


def _masses_that_explain(
    model: Model, runs: Sequence[Run], odd: Sequence[Run], rng: np.random.Generator
) -> list[tuple[Run, float]]:
    """The odd ones among the runs with a mass that would explain what is left, kg; the best first."""
    found = []
    for run in odd:
        if run.mass is not None and run.normal_load is None and run.drive is None:
            factor, best = _best_mass_factor(model, runs, run)
            if best is not None and MIN_LOG_FACTOR < abs(np.log(factor)) < 0.98 * MAX_LOG_FACTOR:
                found.append((best.reduced_chi2, run, factor * run.mass, best))
    found.sort(key=lambda one: one[0])
    return [(run, mass) for _, run, mass, best in found if _explains(best.solution, rng)]


def _best_mass_factor(model: Model, runs: Sequence[Run], run: Run) -> tuple[float, Fit | None]:
    """The factor on the mass of one run with the smallest misfit, and the fit with it."""
    assert run.mass is not None
    mass = run.mass

    def fitted(log_factor: float) -> Fit | None:
        return _fit(model, [replace(one, mass=float(np.exp(log_factor)) * mass) if one is run else one for one in runs])

    def misfit(log_factor: float) -> float:
        found = fitted(log_factor)
        return np.inf if found is None else found.reduced_chi2

    bounds = (-MAX_LOG_FACTOR, MAX_LOG_FACTOR)
    best = minimize_scalar(misfit, bounds=bounds, method="bounded", options={"xatol": LOG_TOLERANCE})
    return float(np.exp(best.x)), fitted(best.x)
