"""Say in one line what each section of the report found, so that a folded section need not be opened."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from frictrack.base.number_format import describe_change, format_number, format_range, format_share, join_words
from frictrack.present import plots
from frictrack.present.report import provenance, tables
from frictrack.present.report.fit_text import scatter_words
from frictrack.present.report.measurement_quality import failed_checks
from frictrack.results import ModelResults, Results
from frictrack.results.candidates import candidate_rows
from frictrack.results.error_rows import held_out_error
from frictrack.results.motion_axes import AXES

MAX_LIMITS_NAMED = 3


def section_lines(results: Results) -> dict[str, str]:
    """Describe what each section found.

    Parameters
    ----------
    results : Results
        The study.

    Returns
    -------
    dict of str
        One line by the id of the section.

    """
    return {name: describe(results) for name, describe in _LINES.items()}


def _where(results: Results) -> str:
    model = plots.failed_model(results)
    diagnosis = (model.diagnosis if model else None) or {}
    spans = diagnosis.get("fails_at") or []
    if not model or not spans:
        return "no span is significant: the misfit is spread over the runs" if model else "nowhere"
    worst = max(spans, key=lambda s: s["share_of_error"])
    count = len({s["run"] for s in spans})
    runs = "1 run" if count == 1 else f"{count} runs"
    words = (
        f"{plots.plain_name(model.name)} in {runs}, most in {worst['run']} ({format_share(worst['share_of_error'])})"
    )
    repeats = [r for r in diagnosis.get("repeats") or [] if r["holds"]]
    return f"{words}; the misfit repeats with {AXES[repeats[0]['axis']].name}" if repeats else words


def _missing(results: Results) -> str:
    model = plots.failed_model(results)
    diagnosis = (model.diagnosis if model else None) or results.diagnosis or {}
    rows = candidate_rows(diagnosis) if diagnosis else []
    tried = f"{len(diagnosis.get('candidates') or [])} effects tried"
    if not diagnosis.get("missing"):
        left = diagnosis.get("unexplained")
        if leads := diagnosis.get("leads"):
            return f"nothing explains it; leads: {join_words(leads)}; {tried}"
        more = f"a force over {AXES[left['axis']].name} that no effect explains; " if left else ""
        significant = sum(row.passes for row in rows)
        return f"{more}{significant} effects are significant" if significant else f"{more}no effect is significant"
    words = f"{join_words(diagnosis['missing'])}; {tried}"
    return f"{words}; held-out error {rows[0].held_out}" if rows and rows[0].held_out else words


def _next(results: Results) -> str:
    steps = (results.diagnosis or {}).get("next_experiment") or []
    return str(steps[0].get("key") or steps[0]["what"]).rstrip(".").replace("`", "") if steps else ""


def _history(results: Results) -> str:
    models = results.models
    if len(models) < 2:
        return "1 model tried"
    (old, unit), (new, _) = (held_out_error(models[k].summary["errors"]) for k in (0, -1))
    if old is None or new is None:
        return f"{len(models)} models tried"
    return f"{len(models)} models tried; the held-out error {describe_change(old, new, unit)}"


def _parameters(results: Results) -> str:
    model = results.current
    if model is None:
        return ""
    shared = tables.shared_parameters(model)
    unknown = [name for name, p in shared.items() if p["value"] is None]
    scatter = model.summary.get("friction_scatter")
    words = f"{len(shared)} shared by all runs"
    if unknown:
        words += f"; not determined: {join_words(unknown)}"
    return f"{words}; {scatter_words(scatter)}" if scatter else words


def _model(results: Results) -> str:
    model = results.current
    return "" if model is None else _error_words(model)


def _error_words(model: ModelResults) -> str:
    errors, noise = model.summary["errors"], plots.noise_um(model)
    rms, force = errors.get("rms_displacement_um"), errors.get("relative_force_error")
    parts = [] if rms is None else [f"residual {format_number(rms)} µm"]
    parts += [] if rms is None or noise is None else [f"noise {format_number(noise)} µm"]
    parts += [] if force is None else [f"force error {format_number(100 * force, 2)} %"]
    return ", ".join(parts)


def _friction(results: Results) -> str:
    able = [run for run in results.runs if run.friction is not None and np.any(run.friction.free)]
    return _lowered(plots.friction_title(able)) if able else ""


def _motion(results: Results) -> str:
    return plots.motions_title(results.runs).split(";")[0]


def _film(results: Results) -> str:
    filmed = [run for run in results.runs if run.film is not None and run.track is not None]
    if not filmed:
        return ""
    noise = [run.quality["sigma_px"] for run in filmed if run.quality and run.quality["sigma_px"] is not None]
    words = "1 film" if len(filmed) == 1 else f"{len(filmed)} films"
    words += f"; standard deviation of a position {format_range(noise)} px" if noise else ""
    failed = sum(bool(failed_checks(run)) for run in filmed if run.quality)
    return f"{words}; {failed} with failed self-checks" if failed else f"{words}; all self-checks passed"


def _budget(results: Results) -> str:
    found = {run.name: run.budget for run in results.runs if run.budget}
    return _lowered(plots.budgets_title(found)) if found else ""


def _limits(results: Results) -> str:
    found = (results.diagnosis or {}).get("detection_limits") or {}
    known = sorted((one["value"], name) for name, one in found.items() if one["value"] and one["unit"] == "N")
    words = [f"{name} from {format_number(value, 2)} N" for value, name in known[:MAX_LIMITS_NAMED]]
    unknown = sum(one["value"] is None for one in found.values())
    if unknown:
        words.append(f"{unknown} of {len(found)} effects not detectable")
    return "; ".join(words)


def _papers(results: Results) -> str:
    return (
        ""
        if results.papers is None
        else f"force domain, {results.papers.summary['search']}: {_error_words(results.papers)}"
    )


def _findings(results: Results) -> str:
    return f"{len(provenance.findings_table(results).rows)} notes and automatic decisions"


def _record(results: Results) -> str:
    return f"{results.path.name}, frictrack {results.version}"


def _lowered(title: str) -> str:
    return title[:1].lower() + title[1:]


_LINES: Mapping[str, Callable[[Results], str]] = {
    "where": _where,
    "missing": _missing,
    "settle": _next,
    "history": _history,
    "parameters": _parameters,
    "model": _model,
    "papers": _papers,
    "friction": _friction,
    "motion": _motion,
    "film": _film,
    "budget": _budget,
    "limits": _limits,
    "findings": _findings,
    "record": _record,
}
