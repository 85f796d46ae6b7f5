"""Write the report of a study: one HTML page that contains all its figures."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from markupsafe import Markup

from frictrack.base.files import replace_text
from frictrack.base.glossary import symbols_in
from frictrack.present import plots
from frictrack.present.report import (
    failures,
    fit_text,
    measurement_quality,
    provenance,
    section_lines,
    tables,
    verdict_text,
)
from frictrack.present.report.markup import SvgEmbedder, explain_words, mark_equation, now, page_template
from frictrack.records import Array
from frictrack.results import ModelResults, Results, RunResults
from frictrack.results.candidates import MAIN_KINDS, candidate_rows
from frictrack.results.verdicts import CHECK_FIRST

MAX_FILMS = 4  # films of which the first frame is shown
MAX_MODELS_FIRST_SCREEN = 4  # whose errors are named on the first screen; of more, a figure names them
MAX_RUNS_FIRST_SCREEN = 4  # whose motion is drawn where there is neither a model nor a force
MIN_CORRELATION = 0.95  # of two parameters; less is not reported


def write(results: Results, path: Path, key: str = "") -> Path:
    """Write the report of a study as HTML, completely or not at all.

    Parameters
    ----------
    results : Results
        The study.
    path : Path
        File to write.
    key : str
        Hash of the inputs of the report, written into its head.

    Returns
    -------
    Path
        The written file.

    Raises
    ------
    FrictrackError
        If the folder cannot be written.

    """
    return replace_text(path, render(results, key))


def render(results: Results, key: str = "") -> str:
    """Render the report of a study.

    Parameters
    ----------
    results : Results
        The study.
    key : str
        Hash of the inputs of the report, written into its head.

    Returns
    -------
    str
        HTML that contains all figures and refers to no other file.

    """
    page = page_template("page.html.j2")
    draw = SvgEmbedder()
    html = page.render(
        results=results,
        key=key,
        check_first=CHECK_FIRST,
        written=now(),
        lines=section_lines.section_lines(results),
        tables=tables,
        provenance=provenance,
        mark_equation=mark_equation,
        symbols_in=symbols_in,
        scatter_words=fit_text.scatter_words,
        **_first_screen(results, draw),
        **_diagnosis_sections(results, draw),
        **_model_sections(results, draw),
        **_measurement_sections(results, draw),
    )
    return explain_words(html)


def _first_screen(results: Results, draw: SvgEmbedder) -> dict[str, Any]:
    """The verdict, its figure, the parameters and what to do next."""
    model = results.current
    if model is not None:
        figure = draw(plots.verdict(results, title=False))
    elif _has_force(results):
        figure = draw(plots.friction(results.runs))
    else:
        figure = draw(plots.motions(results.runs[:MAX_RUNS_FIRST_SCREEN]))
    return {
        "verdict": verdict_text.study_verdict(results),
        "verdict_figure": figure,
        **_law(model, results, draw),
        "model": model,
        "next_steps": fit_text.next_steps(results),
        "scale_error": fit_text.scale_error(results),
        "scale_line": fit_text.scale_line(results),
    }


def _law(model: ModelResults | None, results: Results, draw: SvgEmbedder) -> dict[str, Any]:
    """The law of the current model over the speed, where it has one."""
    if model is None or not plots.has_law(model):
        return {"law": None}
    return {"law": draw(plots.law(model, results.runs, title=False)), "law_title": plots.law_title(model)}


def _diagnosis_sections(results: Results, draw: SvgEmbedder) -> dict[str, Any]:
    """Where the model fails, what is missing, the next experiments and the detection limits."""
    steps = tables.separating_experiments(results.diagnosis)
    shown = plots.failed_model(results)
    judged = [m for m in _rejected(results) if m is shown or m.current] or _rejected(results)
    return {
        "failures": [
            failures.failure(m, results, draw, _headline(m)) for m in judged if plots.is_rejected(m.diagnosis)
        ],
        "rejected": [_rejected_model(m, draw) for m in judged],
        "earlier": [_headline(m) for m in _rejected(results) if m not in judged],
        "steps": steps,
        "inseparable": tables.inseparable(results.diagnosis),
        "steps_figure": _experiments(steps, draw),
        "limits": _limits(results, draw),
    }


def _model_sections(results: Results, draw: SvgEmbedder) -> dict[str, Any]:
    """The current model: its errors, its parameters, and both routes."""
    model = results.current
    return {
        "history": draw(plots.history(results.models)) if len(results.models) > MAX_MODELS_FIRST_SCREEN else None,
        "fits": [draw(plots.fit(m, results.runs)) for m in _current_model(results)],
        "loops": _loops(results, draw),
        "model_motion": _model_motion(results, draw),
        "model_motion_sentences": fit_text.model_motion_sentences(model) if model else [],
        "routes": _routes(results, draw),
        "searches": [
            draw(plots.convergence(m)) if m is not None and m.convergence else None for m in (model, results.papers)
        ],
        "remarks": _remarks(model),
        "profiles": _profiles(model, draw),
        "bootstrap": fit_text.bootstrap_sentence(model) if model else "",
    }


def _measurement_sections(results: Results, draw: SvgEmbedder) -> dict[str, Any]:
    """Friction, motion, films, smoothing and error budgets of the runs."""
    smoothed = {run.name: (run.cutoff, run.mass) for run in results.runs if run.cutoff is not None}
    found = {run.name: run.budget for run in results.runs if run.budget}
    return {
        "films": _first_frames(results),
        "motions": Markup("") if _of_points(results) else draw(plots.motions(results.runs)),
        "filters": draw(plots.filters(results.runs[0])) if smoothed else Markup(""),
        "cutoffs": draw(plots.cutoffs(smoothed)) if smoothed else Markup(""),
        "smoothing": measurement_quality.smoothing(results),
        "friction": draw(plots.friction(results.runs)) if _has_force(results) and not _of_points(results) else None,
        "has_measured_friction": fit_text.has_measured_friction(results),
        "budgets": draw(plots.budgets(found)) if found else Markup(""),
        "budget_sentences": tables.budget_sentences(results.runs),
        "budget_table": tables.source_table(results.runs),
        "measurement": measurement_quality.measurement(results.runs),
    }


def _experiments(steps: Sequence[Mapping[str, Any]], draw: SvgEmbedder) -> Markup:
    """Draw the evidence that the proposed experiments are expected to give."""
    known = tables.with_expected_evidence(steps)
    return draw(plots.next_experiments(known)) if known else Markup("")


def _first_frames(results: Results) -> list[Markup]:
    """Draw the first frames of the first films; a single one takes the whole width."""
    filmed = [run for run in results.runs if run.film is not None and run.track is not None]
    return [_first_frame(run, wide=len(filmed) == 1) for run in filmed[:MAX_FILMS]]


def _first_frame(run: RunResults, *, wide: bool) -> Markup:
    data = base64.b64encode(plots.png(plots.film(run, wide=wide), dpi=110 if wide else 200)).decode()
    return Markup('<img alt="first frame of {} with the track" src="data:image/png;base64,{}">').format(run.name, data)


def _of_points(results: Results) -> bool:
    """Whether the runs are points (v, F), which have no motion to draw."""
    return any(run.is_of_points for run in results.runs)


def _has_force(results: Results) -> bool:
    return any(run.friction is not None for run in results.runs)


def _rejected(results: Results) -> list[ModelResults]:
    """Models that their diagnosis rejects; if there is none, the last model that was diagnosed."""
    diagnosed = [m for m in results.models if m.diagnosis is not None]
    return [m for m in diagnosed if plots.is_rejected(m.diagnosis)] or diagnosed[-1:]


def _current_model(results: Results) -> list[ModelResults]:
    """The current model, if there is one."""
    return [results.current] if results.current is not None else []


def _loops(results: Results, draw: SvgEmbedder) -> Markup:
    """Draw the loops of the friction force, if the current model was fitted to measured friction."""
    model = results.current
    if model is None or model.summary["errors"].get("rms_N") is None or _of_points(results):
        return Markup("")
    return draw(plots.loops(model, results.runs))


def _model_motion(results: Results, draw: SvgEmbedder) -> Markup:
    """Draw the motion of the current model over the smoothed motion."""
    model = results.current
    return draw(plots.modelled(model, results.runs)) if model is not None and model.motion else Markup("")


def _headline(model: ModelResults) -> str:
    return f"{plots.plain_name(model.name)} {verdict_text.model_status(model.diagnosis or {})}"


def _rejected_model(model: ModelResults, draw: SvgEmbedder) -> dict[str, Any]:
    """A model that failed, and the evidence for what it lacks; figures may be empty."""
    diagnosis = model.diagnosis or {}
    rows = candidate_rows(diagnosis)
    best = rows[0].effect if rows else ""
    curves: Mapping[str, Array] = model.figures.get(best, {})
    return dict(
        headline=_headline(model),
        candidates=tables.candidate_table(rows),
        cards=tables.candidate_cards([row for row in rows if row.kind in MAIN_KINDS]),
        scan=draw(plots.scan(best, curves)) if plots.has_scan(curves) else Markup(""),
        unexplained=failures.unexplained_force(diagnosis, draw),
        correlated_signals=failures.correlated_signals(diagnosis, model.figures, draw),
        importance=tables.importance_table(diagnosis),
        undetermined=tables.undetermined_table(diagnosis),
    )


def _limits(results: Results, draw: SvgEmbedder) -> Markup:
    found = results.diagnosis
    if not found or not plots.has_limits(found, results.figures):
        return Markup("")
    return draw(plots.limits(found, results.figures))


def _routes(results: Results, draw: SvgEmbedder) -> Markup:
    """Draw the default and the papers' route for the first run that both have fitted."""
    if results.papers is None or results.current is None:
        return Markup("")
    fitted = {curve.run for curve in results.papers.curves} & {curve.run for curve in results.current.curves}
    run = next((r for r in results.runs if r.name in fitted and r.friction is not None), None)
    return draw(plots.routes(results.current, results.papers, run)) if run is not None else Markup("")


def _remarks(model: ModelResults | None) -> list[Markup]:
    """Remarks on the parameters; for a model that was stored without remarks, its correlations."""
    if model is None:
        return []
    if "remarks" in model.summary:
        return [fit_text.mark_addresses(line) for line in model.summary["remarks"]]
    return [
        fit_text.correlation_sentence(a, b, r) for a, b, r in model.summary["correlations"] if abs(r) > MIN_CORRELATION
    ]


def _profiles(model: ModelResults | None, draw: SvgEmbedder) -> Markup:
    """Draw the profiles of the current model, if they were computed."""
    return draw(plots.profiles(model.summary)) if model is not None and model.summary.get("profiles") else Markup("")
