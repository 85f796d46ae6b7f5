"""List every figure of a study: those of its runs, of its models, and of the study as a whole."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial

from matplotlib.figure import Figure

from frictrack.present.plots.budget import budgets
from frictrack.present.plots.candidates import candidates, has_limits, has_scan, limits, scan
from frictrack.present.plots.convergence import convergence
from frictrack.present.plots.cutoff import cutoff, filters
from frictrack.present.plots.held_out import history
from frictrack.present.plots.law import has_law, law, loops
from frictrack.present.plots.measured import film, friction, motion, motions
from frictrack.present.plots.missing_force import has_missing_force, missing_force, unexplained
from frictrack.present.plots.model import failing, fit, routes
from frictrack.present.plots.modelled import modelled
from frictrack.present.plots.profiles import profiles
from frictrack.present.plots.style import run_styles
from frictrack.present.plots.verdict import verdict
from frictrack.results import ModelResults, Results, RunResults

NamedFigure = tuple[str, Callable[[], Figure]]


def study_figures(results: Results) -> Iterator[NamedFigure]:
    """List every figure of a study; each is drawn when its function is called.

    Yields
    ------
    tuple of (str, callable)
        File name without suffix, and the function that draws the figure.

    """
    for run in results.runs:
        yield from _of_run(run)
    for model in results.models:
        yield from _of_model(model, results)
    yield from _of_measurement(results)
    if results.current is not None:
        yield from _of_current_model(results.current, results)


def _of_run(run: RunResults) -> Iterator[NamedFigure]:
    if run.is_of_points:
        return
    yield f"motion {run.name}", partial(motion, run)
    if run.film is not None:
        yield f"film {run.name}", partial(film, run)
    if run.cutoff is not None:
        yield f"cutoff {run.name}", partial(cutoff, run.name, run.cutoff, run.mass)
        yield f"filters {run.name}", partial(filters, run)


def _of_model(model: ModelResults, results: Results) -> Iterator[NamedFigure]:
    yield f"model {model.name}", partial(fit, model, results.runs)
    if has_law(model):
        yield f"law {model.name}", partial(law, model, results.runs)
    if model.convergence:
        yield f"convergence {model.name}", partial(convergence, model)
    found = model.diagnosis
    if not found:
        return
    fails = found["fails_at"]
    yield f"fails {model.name}", partial(failing, model, results.runs, fails)
    yield f"candidates {model.name}", partial(candidates, found)
    if has_missing_force(model.figures):
        fitted = {row["run"] for row in model.summary["per_run"] if row["role"] == "fit"}
        styles = {name: style for name, style in run_styles(results.runs).items() if name in fitted}
        draw = partial(missing_force, model.figures, fails, styles, found.get("repeats", []))
        yield f"missing force {model.name}", draw
    best = found["candidates"][0]["effect"] if found["candidates"] else ""
    if has_scan(model.figures.get(best, {})):
        yield f"scan {model.name}", partial(scan, best, model.figures[best])
    if found.get("unexplained"):
        yield f"unexplained {model.name}", partial(unexplained, found["unexplained"])


def _of_measurement(results: Results) -> Iterator[NamedFigure]:
    budget = {run.name: run.budget for run in results.runs if run.budget}
    if results.runs:
        yield "motions", partial(motions, results.runs)
    if any(run.friction is not None for run in results.runs):
        yield "friction", partial(friction, results.runs)
    if budget:
        yield "budgets", partial(budgets, budget)


def _of_current_model(model: ModelResults, results: Results) -> Iterator[NamedFigure]:
    yield "verdict", partial(verdict, results)
    yield "history", partial(history, results.models)
    if model.motion:
        yield "modelled", partial(modelled, model, results.runs)
    if model.summary["errors"].get("rms_N") is not None:
        yield "loops", partial(loops, model, results.runs)
    if model.summary.get("profiles"):
        yield "profiles", partial(profiles, model.summary)
    if results.diagnosis and has_limits(results.diagnosis, results.figures):
        yield "limits", partial(limits, results.diagnosis, results.figures)
    if results.papers is not None:
        both = {c.run for c in results.papers.curves} & {c.run for c in model.curves}
        run = next((one for one in results.runs if one.name in both and one.friction is not None), None)
        if results.papers.convergence:
            yield "convergence papers", partial(convergence, results.papers)
        if run is not None:
            yield "routes", partial(routes, model, results.papers, run)
