"""Results -> one HTML page that needs nothing else: figures as SVG, film frames as PNG, all inside it."""

from __future__ import annotations

import base64
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from typing import Any

from markupsafe import Markup
from matplotlib.figure import Figure

from frictrack import plots
from frictrack.files import replace_text
from frictrack.number_format import format_quantity
from frictrack.records import Array
from frictrack.report import (
    budgets,
    failures,
    measurement_quality,
    next_experiments,
    provenance,
    tables,
    unexplained,
    verdict_text,
)
from frictrack.report.markup import mark_equation
from frictrack.report.templates import now, template
from frictrack.results import ModelResults, Results, RunResults

MAX_FILMS = 6  # whose first frame is shown
MAX_RUNS = 12  # whose motion is drawn; of more, the first ones
ID_ATTRIBUTES = re.compile(r'(\bid="|url\(#|xlink:href="#)')


@dataclass(frozen=True)
class RejectedModel:
    """A model that failed, and the evidence on what it lacks."""

    headline: str
    diagnosis: Mapping[str, Any]
    evidence: Markup
    cards: list[tables.Card]
    scan: Markup
    unexplained: dict[str, Any] | None
    in_step: list[dict[str, Any]]
    importance: tables.TextTable


def write(results: Results, path: Path, key: str = "") -> Path:
    """Write the report to `path`, whole or not at all, and return the path. `key` tells what it was made from.

    Raises `FrictrackError` when the folder cannot be written.
    """
    return replace_text(path, render(results, key))


def render(results: Results, key: str = "") -> str:
    """The report as HTML."""
    page = template("page.html.j2")
    draw = SvgEmbedder()
    steps = next_experiments.separating_experiments(results.diagnosis)
    return page.render(
        results=results,
        key=key,
        verdict=verdict_text.verdict(results),
        model=results.current,
        written=now(),
        films=_first_frames(results),
        motions=[draw(plots.motion(run)) for run in results.runs[:MAX_RUNS]],
        cutoffs=_cutoffs(results, draw),
        smoothing=measurement_quality.smoothing(results),
        friction=draw(plots.friction(results.runs)) if _has_force(results) else None,
        budgets=[draw(plots.budget(run.name, run.budget)) for run in results.runs[:MAX_RUNS] if run.budget],
        worth=budgets.budget_sentences(results.runs),
        sources=budgets.source_table(results.runs),
        fits=[draw(plots.fit(m, results.runs)) for m in _current_model(results)],
        loops=_loops(results, draw),
        by_cell=verdict_text.measured_friction(results),
        own=_model_motion(results, draw),
        told=verdict_text.model_motion_sentences(results.current) if results.current else [],
        failures=[failures.failure(m, results, draw, _headline(m)) for m in _rejected(results)],
        trials=[_rejected_model(m, draw) for m in _rejected(results)],
        next_experiments=next_experiments,
        steps=steps,
        hopeless=next_experiments.inseparable(results.diagnosis),
        settling=draw(plots.next_experiments(next_experiments.drawable(steps)))
        if next_experiments.drawable(steps)
        else Markup(""),
        history=draw(plots.history(results.models)) if len(results.models) > 1 else None,
        limits=_limits(results, draw),
        routes=_routes(results, draw),
        remarks=_remarks(results.current),
        profiles=_profiles(results.current, draw),
        drawn=verdict_text.bootstrap_sentence(results.current) if results.current else "",
        tables=tables,
        provenance=provenance,
        mark_equation=mark_equation,
        format_quantity=format_quantity,
        measured=measurement_quality.measurement(results.runs),
        scale_line=verdict_text.scale_line(results),
        scale_error=verdict_text.scale_error(results),
    )


class SvgEmbedder:
    """Figures as inline SVG; each gets ids of its own, since all share one page."""

    def __init__(self) -> None:
        self._numbers: Iterator[int] = count(1)

    def __call__(self, figure: Figure) -> Markup:
        """The figure as SVG."""
        mark = f"f{next(self._numbers)}-"
        return Markup(ID_ATTRIBUTES.sub(rf"\g<1>{mark}", plots.svg(figure)))


def _first_frames(results: Results) -> list[Markup]:
    """The first frames of the first films, a single one over the whole page."""
    filmed = [run for run in results.runs if run.film is not None and run.track is not None]
    return [_first_frame(run, wide=len(filmed) == 1) for run in filmed[:MAX_FILMS]]


def _first_frame(run: RunResults, *, wide: bool) -> Markup:
    data = base64.b64encode(plots.png(plots.film(run, wide=wide), dpi=110 if wide else 200)).decode()
    return Markup('<img alt="first frame of {} with the track" src="data:image/png;base64,{}">').format(run.name, data)


def _cutoffs(results: Results, draw: SvgEmbedder) -> list[Markup]:
    """Where a plain low-pass would cut off, run by run."""
    shown = [run for run in results.runs[:MAX_RUNS] if run.cutoff is not None]
    return [draw(plots.cutoff(run.name, run.cutoff, run.mass)) for run in shown if run.cutoff is not None]


def _has_force(results: Results) -> bool:
    return any(run.friction is not None for run in results.runs)


def _rejected(results: Results) -> list[ModelResults]:
    """Models whose diagnosis found them wanting; the current one where there is none, for its candidates."""
    asked = [m for m in results.models if m.diagnosis is not None]
    return [m for m in asked if m.diagnosis and m.diagnosis["verdict"] != "complete"] or asked[-1:]


def _current_model(results: Results) -> list[ModelResults]:
    """The model in force."""
    return [results.current] if results.current is not None else []


def _loops(results: Results, draw: SvgEmbedder) -> Markup:
    """Loops of the friction force, where it was measured and is what the model in force was fitted to."""
    model = results.current
    if model is None or model.summary["errors"].get("rms_N") is None:
        return Markup("")
    return draw(plots.loops(model, results.runs))


def _model_motion(results: Results, draw: SvgEmbedder) -> Markup:
    """The motion that the model in force tells, on the smoothed one."""
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
        cards=tables.cards(diagnosis),
        scan=draw(plots.scan(best, curves)) if plots.has_scan(curves) else Markup(""),
        unexplained=unexplained.unexplained(diagnosis, draw),
        in_step=unexplained.first_evidence(diagnosis, model.figures, draw),
        importance=tables.importance(diagnosis),
    )


def _limits(results: Results, draw: SvgEmbedder) -> Markup:
    found = results.diagnosis
    if not found or not plots.has_limits(found, results.figures):
        return Markup("")
    return draw(plots.limits(found, results.figures))


def _routes(results: Results, draw: SvgEmbedder) -> Markup:
    """The papers' route beside the default, on the first run that both have fitted."""
    if results.papers is None or results.current is None:
        return Markup("")
    fitted = {curve.run for curve in results.papers.curves} & {curve.run for curve in results.current.curves}
    run = next((r for r in results.runs if r.name in fitted and r.friction is not None), None)
    return draw(plots.routes(results.current, results.papers, run)) if run is not None else Markup("")


def _remarks(model: ModelResults | None) -> list[Markup]:
    """What is to be said of the parameters together; of a model stored before there were remarks, its correlations."""
    if model is None:
        return []
    if "remarks" in model.summary:
        return [verdict_text.mark_addresses(line) for line in model.summary["remarks"]]
    return [verdict_text.correlation(a, b, r) for a, b, r in model.summary["correlations"] if abs(r) > 0.95]


def _profiles(model: ModelResults | None, draw: SvgEmbedder) -> Markup:
    """The profiles of the model in force, where they were asked for."""
    return draw(plots.profiles(model.summary)) if model is not None and model.summary.get("profiles") else Markup("")
