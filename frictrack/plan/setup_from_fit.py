"""The set-up as runs that were filmed already show it: their law, noise, scatter and course."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from frictrack import models
from frictrack.diagnose.experiments.virtual_runs import RunDesign
from frictrack.errors import FrictrackError
from frictrack.fit import Fit
from frictrack.fit.parameters import MIN_RUNS_FOR_SCATTER
from frictrack.plan.experiment_setup import NOISE, SCATTER, Entry, Stand

PLAIN = ("coulomb", "stribeck", "viscous", "drag", "spring", "slope", "asymmetry")  # what a base law may hold


def of_fit(fit: Fit) -> Stand:
    """The set-up of a fit: what it found of the law is assumed, and its runs count as filmed.

    Raises FrictrackError where no coasting run was fitted by its displacement.
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
    plain = [e for e in fit.model.effects if e.name in PLAIN]
    if not any(e.name == "coulomb" for e in plain):
        raise FrictrackError("expected Coulomb friction in the fitted law to plan with; fit a model that has it")
    values, _ = layout.values(solution.p, 0)
    pitch = first.pixel_pitch
    noise = float(np.median(np.concatenate([p.sigma for p in solution.problem.pieces])))
    few = len(layout.levels) < MIN_RUNS_FOR_SCATTER
    span = layout.span
    law = models.of(plain)
    assumed = (
        f"law as fitted to {len(fit.runs)} runs: {law.equation(fit.parameters)}",
        f"noise of a frame {1e6 * noise:.3g} µm, as these runs have it",
        f"course of {span.x_max - span.x_min:.2g} m, as far as these runs went",
        f"dry friction that scatters by {100 * (SCATTER if few else solution.tau):.2g} % from run to run"
        + (", which so few runs do not tell" if few else ", as fitted"),
    )
    stand = Stand(
        mass=fit.reference.mass,
        fps=span.fps,
        pitch=pitch if pitch is not None else noise / NOISE,
        noise=noise,
        law=law,
        values={e.name: dict(values[e.name]) for e in plain},
        scatter=SCATTER if few else max(solution.tau, 1e-3),
        course=span.x_max - span.x_min,
        start=span.x_min,
        assumed=assumed,
    )
    return replace(stand, done=tuple(_done(fit, stand, i) for i in range(len(fit.runs))))


def _done(fit: Fit, stand: Stand, index: int) -> Entry:
    """A run that was filmed, as an entry of the menu."""
    run = fit.runs[index]
    pieces = zip(fit.solution.problem.pieces, fit.solution.starts, strict=True)
    start = next(s for p, s in pieces if p.run == index)
    far = stand.start, stand.start + stand.course
    place = float(np.clip(start[0], *far))
    mass = (run.mass or stand.mass) / stand.mass
    film = RunDesign((place, float(start[1])), far, mass=mass, tilt=run.incline)
    return Entry(f"run {run.name}", f"{run.name}, at {start[1]:.2g} m/s", film)
