"""Derive an experimental setup from a fit: its friction law, noise, scatter and course."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from frictrack import models
from frictrack.costs import DEFAULT_COSTS, Costs
from frictrack.diagnose.experiments import RunDesign, max_frames_of_film
from frictrack.errors import FrictrackError
from frictrack.fit import Fit
from frictrack.fit.parameters import MIN_RUNS_FOR_SCATTER
from frictrack.number_format import format_plain
from frictrack.plan.experiment_setup import DEFAULT_NOISE_PX, DEFAULT_SCATTER, Experiment, ExperimentSetup


def fitted_setup(fit: Fit, costs: Costs = DEFAULT_COSTS) -> ExperimentSetup:
    """Derive the setup from a fit; its runs count as completed.

    Parameters
    ----------
    fit
        A fit of coasting runs to their displacement.
    costs
        Costs of the runs, and what the set-up can do.

    Returns
    -------
    ExperimentSetup

    Raises
    ------
    FrictrackError
        If friction or the drive was measured, or the model lacks Coulomb friction.

    """
    if fit.measured:
        raise FrictrackError(
            "expected runs whose displacement is filmed but their friction was measured; plan from a study without runs"
        )
    if any(run.drive is not None for run in fit.runs):
        raise FrictrackError(
            "expected runs that coast but their drive is measured; a plan is made for struck, pushed or tilted runs: "
            "plan from a study without runs"
        )
    solution, first = fit.solution, fit.runs[0]
    layout = solution.problem.layout
    base_effects = [e for e in fit.model.effects if e.in_base_law]
    if not any(e.name == "coulomb" for e in base_effects):
        raise FrictrackError("expected Coulomb friction in the fitted law to plan with; fit a model that has it")
    values, _ = layout.values(solution.p, 0)
    pitch = first.pixel_pitch
    noise = float(np.median(np.concatenate([p.sigma for p in solution.problem.pieces])))
    scatter_is_assumed = len(layout.levels) < MIN_RUNS_FOR_SCATTER
    span = layout.span
    law = models.of(base_effects)
    scatter = 100 * (DEFAULT_SCATTER if scatter_is_assumed else solution.tau)
    assumed: tuple[str, ...] = (
        f"friction law fitted to {len(fit.runs)} runs: {law.equation(fit.parameters)}",
        f"position noise per frame: {format_plain(1e6 * noise, 3)} µm, as measured",
        f"course length: {span.x_max - span.x_min:.2g} m, as far as these runs went",
        f"scatter of dry friction from run to run: {scatter:.2g} %, "
        + ("assumed because there are too few runs to estimate it" if scatter_is_assumed else "as fitted"),
    )
    frames = max_frames_of_film(solution, costs)
    if costs.frames is None and np.isfinite(frames):
        assumed += (
            f"largest number of frames in one film: {frames:.0f}, as in the longest film so far, which ended while the "
            "mass still moved; give frames in [costs] if the camera can film more",
        )
    setup = ExperimentSetup(
        mass=fit.reference.mass,
        fps=span.fps,
        pitch=pitch if pitch is not None else noise / DEFAULT_NOISE_PX,
        noise=noise,
        law=law,
        values={e.name: dict(values[e.name]) for e in base_effects},
        scatter=DEFAULT_SCATTER if scatter_is_assumed else solution.tau_of_other_runs,
        course=span.x_max - span.x_min,
        start=span.x_min,
        assumed=assumed,
        costs=replace(costs, frames=frames),
    )
    return replace(setup, completed=tuple(_completed_run(fit, setup, i) for i in range(len(fit.runs))))


def _completed_run(fit: Fit, setup: ExperimentSetup, index: int) -> Experiment:
    """A run that was filmed, as an experiment."""
    run = fit.runs[index]
    pieces = zip(fit.solution.problem.pieces, fit.solution.starts, strict=True)
    start = next(s for p, s in pieces if p.run == index)
    ends = setup.start, setup.start + setup.course
    place = float(np.clip(start[0], *ends))
    mass = (run.mass or setup.mass) / setup.mass
    frames = sum(len(p.t) for p in fit.solution.problem.pieces if p.run == index)
    design = RunDesign((place, float(start[1])), ends, mass=mass, tilt=run.incline, frames=frames)
    return Experiment(f"run {run.name}", f"{run.name}, at {start[1]:.2g} m/s", design)
