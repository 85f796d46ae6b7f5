"""List every figure of a study: those of its runs, of its models, and of the study as a whole."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial

from matplotlib.figure import Figure

from frictrack.present.plots import evidence, law, measured, verdict
from frictrack.present.plots import model as of_models
from frictrack.present.plots.style import run_styles
from frictrack.results import ModelResults, Results, RunResults
from frictrack.results.candidates import candidate_rows
from frictrack.results.verdicts import force_without_effect

NamedFigure = tuple[str, Callable[..., Figure]]


def study_figures(results: Results) -> Iterator[NamedFigure]:
    """List every figure of a study; each is drawn when its function is called, with options of that figure.

    Yields
    ------
    tuple of (str, callable)
        File name without suffix, and the function that draws the figure.

    """
    of_points = any(run.is_of_points for run in results.runs)
    for run in results.runs if not of_points else ():
        yield from _of_run(run)
    for model in results.models:
        yield from _of_model(model, results)
    smoothed = {run.name: (run.cutoff, run.mass) for run in results.runs if run.cutoff is not None}
    budget = {run.name: run.budget for run in results.runs if run.budget}
    if results.runs and not of_points:
        yield "motions", partial(measured.motions, results.runs)
    if any(run.friction is not None for run in results.runs):
        yield "friction", partial(measured.friction, results.runs)
    if smoothed:
        yield "cutoffs", partial(measured.cutoffs, smoothed)
    if budget:
        yield "budgets", partial(measured.budgets, budget)
    if results.current is not None:
        yield from _of_current_model(results.current, results, of_points=of_points)


def _of_run(run: RunResults) -> Iterator[NamedFigure]:
    yield f"motion {run.name}", partial(measured.motion, run)
    if run.film is not None:
        yield f"film {run.name}", partial(measured.film, run)
    if run.cutoff is not None:
        yield f"cutoff {run.name}", partial(measured.cutoff, run.name, run.cutoff, run.mass)
    yield f"filters {run.name}", partial(measured.filters, run)


def _of_model(model: ModelResults, results: Results) -> Iterator[NamedFigure]:
    yield f"model {model.name}", partial(of_models.fit, model, results.runs)
    if law.has_law(model):
        yield f"law {model.name}", partial(law.law, model, results.runs)
    if model.convergence:
        yield f"convergence {model.name}", partial(law.convergence, model)
    found, curves = model.diagnosis, model.figures
    if not found:
        return
    better = None if model is results.current else results.current
    yield f"fails {model.name}", partial(of_models.failing, model, results.runs, found["fails_at"], better)
    yield f"candidates {model.name}", partial(evidence.candidates, found)
    if "residual_force" in curves:
        fitted = {row["run"] for row in model.summary["per_run"] if row["role"] == "fit"}
        styles = {name: look for name, look in run_styles(results.runs).items() if name in fitted}
        draw = partial(evidence.missing_force, curves, found["fails_at"], styles, found.get("repeats", []))
        yield f"missing force {model.name}", draw
    best = next((row.effect for row in candidate_rows(found)), "")
    if evidence.has_scan(curves.get(best, {})):
        yield f"scan {model.name}", partial(evidence.scan, best, curves[best])
    if left := force_without_effect(found):
        yield f"unexplained {model.name}", partial(evidence.unexplained, left)
    for k, signal in enumerate(found.get("evidence") or []):
        if f"evidence_{k}" in curves:
            yield f"signal {k} {model.name}", partial(evidence.correlated_signal, signal, curves[f"evidence_{k}"])


def _of_current_model(model: ModelResults, results: Results, *, of_points: bool) -> Iterator[NamedFigure]:
    yield "verdict", partial(verdict.verdict, results)
    yield "history", partial(of_models.history, results.models)
    if model.motion:
        yield "modelled", partial(of_models.modelled, model, results.runs)
    if model.summary["errors"].get("rms_N") is not None and not of_points:
        yield "loops", partial(law.loops, model, results.runs)
    if model.summary.get("profiles"):
        yield "profiles", partial(law.profiles, model.summary)
    if diagnosis := results.diagnosis:
        steps = [step for step in diagnosis.get("next_experiment") or [] if step.get("expected_if_true")]
        if evidence.has_limits(diagnosis, results.figures):
            yield "limits", partial(evidence.limits, diagnosis, results.figures)
        if steps:
            yield "next experiments", partial(evidence.next_experiments, steps)
    if papers := results.papers:
        both = {c.run for c in papers.curves} & {c.run for c in model.curves}
        run = next((one for one in results.runs if one.name in both and one.friction is not None), None)
        if papers.convergence:
            yield "convergence papers", partial(law.convergence, papers)
        if run is not None:
            yield "routes", partial(of_models.routes, model, papers, run)
