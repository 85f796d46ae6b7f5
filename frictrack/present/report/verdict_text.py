"""Describe the verdict of a study in a headline and a paragraph, and each section of the report in one line."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from markupsafe import Markup, escape

from frictrack.base.number_format import (
    describe_change,
    format_number,
    format_range,
    format_share,
    join_words,
    upper_first,
)
from frictrack.present import plots
from frictrack.present.plots import noise_um, plain_name
from frictrack.present.report import measurement_quality, tables
from frictrack.present.report.fit_text import scatter_words
from frictrack.present.report.markup import describe_evidence, sentences
from frictrack.results import ModelResults, Results
from frictrack.results.candidates import candidate_rows
from frictrack.results.error_rows import held_out_error
from frictrack.results.motion_axes import AXES
from frictrack.results.verdicts import certain_effects, describe_alternatives, indistinguishable_effects

EFFECT_NAMES = {
    "coulomb": "Coulomb friction",
    "stribeck": "Stribeck friction",
    "viscous": "viscous friction",
    "drag": "drag",
}
MAX_GAPS_NAMED = 2  # in a headline
NUMBER_WORDS = ["no", "one", "two", "three", "four", "five", "six", "seven", "eight", "nine", "ten", "eleven", "twelve"]


@dataclass(frozen=True)
class VerdictText:
    """The verdict of a study as text.

    Attributes
    ----------
    headline : str
        The verdict in one line.
    sentences : tuple of Markup
        The paragraph below it.
    kind : str
        complete, undetermined, missing, ambiguous or unexplained; "" before a diagnosis.
    fitted : str
        Which runs were fitted with which effects; "" before a fit.

    """

    headline: str
    sentences: tuple[Markup, ...]
    kind: str
    fitted: str = ""


def study_verdict(results: Results) -> VerdictText:
    """Describe what a study found about friction.

    Parameters
    ----------
    results : Results
        The study. Its current model and the diagnosis of that model give the verdict.

    Returns
    -------
    VerdictText
        Headline, sentences and kind of the verdict.

    """
    model, diagnosis = results.current, results.diagnosis
    if model is None:
        return VerdictText("Measured, not yet fitted", (Markup("No model has been fitted to these runs."),), "")
    kind = diagnosis["verdict"] if diagnosis else ""
    paragraph = [*_added_effects(results.models)]
    if diagnosis:
        rows = {row.effect: row for row in candidate_rows(diagnosis)}
        rivals = indistinguishable_effects(diagnosis) if kind == "ambiguous" else []
        alternatives = describe_alternatives(diagnosis)
        paragraph += sentences("verdict", diagnosis, _residual(model), rows, rivals, alternatives, AXES)
    return VerdictText(_headline(results, model, kind), tuple(paragraph), kind, _runs_and_model(model))


def effect_names(names: Sequence[str]) -> str:
    """Write the effects of a model as in a sentence.

    Examples
    --------
    >>> effect_names(["coulomb", "viscous", "texture"])
    'Coulomb friction, viscous friction and texture'

    """
    return join_words([EFFECT_NAMES.get(name, name) for name in names])


def model_status(diagnosis: Mapping[str, Any]) -> str:
    """Describe the verdict of a diagnosis as a predicate that follows the model's name.

    Examples
    --------
    >>> model_status({"verdict": "missing", "missing": ["texture"]})
    'lacks texture'

    """
    if diagnosis["verdict"] == "complete":
        return "is complete"
    if diagnosis["verdict"] == "undetermined":
        return "is neither confirmed nor refuted"
    if diagnosis["verdict"] == "ambiguous":
        certain, group = certain_effects(diagnosis), join_words(indistinguishable_effects(diagnosis), "or")
        return f"lacks {join_words(certain)}, and {group}" if certain else f"lacks {group}"
    if diagnosis["verdict"] == "missing":
        return f"lacks {join_words(diagnosis['missing'])}"
    return "fails, and part of the misfit is unexplained"


def single_additions(models: Sequence[ModelResults]) -> Iterator[tuple[ModelResults, ModelResults, str]]:
    """Yield successive models that differ by one added effect: the model before, the one after, the effect."""
    for before, after in pairwise(models):
        new = [name for name in after.summary["model"] if name not in before.summary["model"]]
        if len(new) == 1 and len(after.summary["model"]) > len(before.summary["model"]):
            yield before, after, new[0]


def _headline(results: Results, model: ModelResults, kind: str) -> str:
    name = plain_name(model.name)
    diagnosis = results.diagnosis or {}
    if kind == "complete":
        added = [effect for *_, effect in single_additions(results.models) if effect in model.summary["model"]]
        if added:
            verb = "explains" if len(added) == 1 else "explain"
            return f"{upper_first(join_words(added))} {verb} the misfit; nothing else is detectable"
        return f"{name} is complete for these runs"
    if kind == "undetermined":
        gaps = diagnosis.get("undetermined") or [{"what": "the law"}]
        return f"Undetermined: these runs do not determine {join_words([gap['what'] for gap in gaps[:MAX_GAPS_NAMED]])}"
    if kind == "ambiguous":
        unclear = "the last of them" if certain_effects(diagnosis) else "them"
        return f"{name} {model_status(diagnosis)}: these runs cannot distinguish {unclear}"
    return f"{name} {model_status(diagnosis)}" if kind else f"{name}, not yet diagnosed"


def _runs_and_model(model: ModelResults) -> str:
    fitted = [row for row in model.summary["per_run"] if row["role"] == "fit"]
    n = len(fitted)
    runs = "One run was" if n == 1 else f"{NUMBER_WORDS[n].capitalize() if n < len(NUMBER_WORDS) else n} runs were"
    return f"{runs} fitted with {effect_names(model.summary['model'])}."


def _added_effects(models: Sequence[ModelResults]) -> Iterator[Markup]:
    """Describe how the error changed as effects were added, in one sentence."""
    added = list(single_additions(models))
    if not added:
        return
    first, last = added[0][0], added[-1][1]
    (old, unit), (new, _) = held_out_error(first.summary["errors"]), held_out_error(last.summary["errors"])
    effects = join_words([f"<b>{escape(effect)}</b>" for *_, effect in added])
    found = [row for row in candidate_rows(first.diagnosis) if len(added) == 1 and row.effect == added[0][2]]
    why = Markup(" ({})").format(describe_evidence(found[0])) if found else Markup("")
    yield Markup("{} lacked {}{}: with {} the held-out error {}.").format(
        plain_name(first.name),
        Markup(effects),
        why,
        "it" if len(added) == 1 else "them",
        describe_change(old, new, unit),
    )


def _residual(model: ModelResults) -> str:
    rms, noise = model.summary["errors"].get("rms_displacement_um"), noise_um(model)
    if rms is None or noise is None:
        return ""
    return f"the residual is {format_number(rms)} µm, the noise {format_number(noise)} µm, "


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


def _where_line(results: Results) -> str:
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


def _missing_line(results: Results) -> str:
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


def _next_line(results: Results) -> str:
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
    return "" if model is None else plots.error_words(model)


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
    failed = sum(bool(measurement_quality.failed_checks(run)) for run in filmed if run.quality)
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
        else f"force domain, {results.papers.summary['search']}: {plots.error_words(results.papers)}"
    )


def _findings(results: Results) -> str:
    return f"{len(measurement_quality.findings_table(results).rows)} notes and automatic decisions"


def _record(results: Results) -> str:
    return f"{results.path.name}, frictrack {results.version}"


def _lowered(title: str) -> str:
    return title[:1].lower() + title[1:]


_LINES: Mapping[str, Callable[[Results], str]] = {
    "where": _where_line,
    "missing": _missing_line,
    "settle": _next_line,
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
