"""Describe the verdict of a study in a headline and one paragraph."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

from markupsafe import Markup, escape

from frictrack.base.number_format import (
    describe_change,
    format_number,
    join_words,
    upper_first,
)
from frictrack.present.plots import noise_um, plain_name
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
