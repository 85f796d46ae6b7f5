"""Write the report of a study: one HTML page that contains all its figures."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from markupsafe import Markup

from frictrack import plots
from frictrack.files import replace_text
from frictrack.number_format import format_quantity
from frictrack.records import Array
from frictrack.report import (
    budgets,
    failures,
    fit_text,
    measurement_quality,
    provenance,
    tables,
    unexplained,
    verdict_text,
)
from frictrack.report.markup import mark_equation
from frictrack.report.templates import SvgEmbedder, now, page_template
from frictrack.results import ModelResults, Results, RunResults

MAX_FILMS = 6  # films of which the first frame is shown
MAX_RUNS = 12  # runs of which the motion is drawn
MIN_CORRELATION = 0.95  # of two parameters; less is not reported


@dataclass(frozen=True)
class RejectedModel:
    """A model that failed, and the evidence for what it lacks; figures may be empty."""

    headline: str
    diagnosis: Mapping[str, Any]
    evidence: Markup
    cards: list[tables.CandidateCard]
    scan: Markup
    unexplained: dict[str, Any] | None
    correlated_signals: list[dict[str, Any]]
    importance: tables.TextTable


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
    steps = tables.separating_experiments(results.diagnosis)
    return page.render(
        results=results,
        key=key,
        verdict=verdict_text.study_verdict(results),
        model=results.current,
        written=now(),
        films=_first_frames(results),
        motions=[draw(plots.motion(run)) for run in results.runs[:MAX_RUNS]],
        cutoffs=_cutoffs(results, draw),
        smoothing=measurement_quality.smoothing(results),
        friction=draw(plots.friction(results.runs)) if _has_force(results) else None,
        budgets=[draw(plots.budget(run.name, run.budget)) for run in results.runs[:MAX_RUNS] if run.budget],
        budget_sentences=budgets.budget_sentences(results.runs),
        budget_table=budgets.source_table(results.runs),
        fits=[draw(plots.fit(m, results.runs)) for m in _current_model(results)],
        loops=_loops(results, draw),
        has_measured_friction=fit_text.has_measured_friction(results),
        model_motion=_model_motion(results, draw),
        model_motion_sentences=fit_text.model_motion_sentences(results.current) if results.current else [],
        failures=[failures.failure(m, results, draw, _headline(m)) for m in _rejected(results)],
        rejected=[_rejected_model(m, draw) for m in _rejected(results)],
        steps=steps,
        inseparable=tables.inseparable(results.diagnosis),
        steps_figure=_experiments(steps, draw),
        history=draw(plots.history(results.models)) if len(results.models) > 1 else None,
        limits=_limits(results, draw),
        routes=_routes(results, draw),
        remarks=_remarks(results.current),
        profiles=_profiles(results.current, draw),
        bootstrap=fit_text.bootstrap_sentence(results.current) if results.current else "",
        tables=tables,
        provenance=provenance,
        mark_equation=mark_equation,
        format_quantity=format_quantity,
        measurement=measurement_quality.measurement(results.runs),
        scale_line=fit_text.scale_line(results),
        scale_error=fit_text.scale_error(results),
    )


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


def _cutoffs(results: Results, draw: SvgEmbedder) -> list[Markup]:
    """Draw the choice of the cut-off frequency of each run."""
    shown = [run for run in results.runs[:MAX_RUNS] if run.cutoff is not None]
    return [draw(plots.cutoff(run.name, run.cutoff, run.mass)) for run in shown if run.cutoff is not None]


def _has_force(results: Results) -> bool:
    return any(run.friction is not None for run in results.runs)


def _rejected(results: Results) -> list[ModelResults]:
    """Models that their diagnosis did not find complete; if there is none, the last model that was diagnosed."""
    diagnosed = [m for m in results.models if m.diagnosis is not None]
    return [m for m in diagnosed if m.diagnosis and m.diagnosis["verdict"] != "complete"] or diagnosed[-1:]


def _current_model(results: Results) -> list[ModelResults]:
    """The current model, if there is one."""
    return [results.current] if results.current is not None else []


def _loops(results: Results, draw: SvgEmbedder) -> Markup:
    """Draw the loops of the friction force, if the current model was fitted to measured friction."""
    model = results.current
    if model is None or model.summary["errors"].get("rms_N") is None:
        return Markup("")
    return draw(plots.loops(model, results.runs))


def _model_motion(results: Results, draw: SvgEmbedder) -> Markup:
    """Draw the motion of the current model over the smoothed motion."""
    model = results.current
    return draw(plots.modelled(model, results.runs)) if model is not None and model.motion else Markup("")


def _headline(model: ModelResults) -> str:
    return f"{plots.plain_name(model.name)} {verdict_text.model_status(model.diagnosis or {})}"


def _rejected_model(model: ModelResults, draw: SvgEmbedder) -> RejectedModel:
    diagnosis = model.diagnosis or {}
    best = diagnosis["candidates"][0]["effect"] if diagnosis["candidates"] else ""
    curves: Mapping[str, Array] = model.figures.get(best, {})
    return RejectedModel(
        headline=_headline(model),
        diagnosis=diagnosis,
        evidence=draw(plots.candidates(diagnosis)) if diagnosis["candidates"] else Markup(""),
        cards=tables.candidate_cards(diagnosis),
        scan=draw(plots.scan(best, curves)) if plots.has_scan(curves) else Markup(""),
        unexplained=unexplained.unexplained_force(diagnosis, draw),
        correlated_signals=unexplained.correlated_signals(diagnosis, model.figures, draw),
        importance=tables.importance_table(diagnosis),
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
