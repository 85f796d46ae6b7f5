"""Describe what to do next: the command to type, or the run to film."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import Any

from markupsafe import Markup

from frictrack.candidates import candidate_rows
from frictrack.number_format import lower_first
from frictrack.report.fit_text import NO_SCALE_ERROR, has_measured_friction, scale_error
from frictrack.report.markup import mark_code
from frictrack.results import Results
from frictrack.verdicts import VERDICT_ONLY, certain_effects, indistinguishable_effects

MAX_GAPS = 2  # open questions whose answer is proposed


def next_steps(results: Results) -> list[Markup]:
    """Describe what to do next with a study.

    Parameters
    ----------
    results : Results
        The study.

    Returns
    -------
    list of Markup
        One or two sentences each, the most useful first.

    """
    study, diagnosis = results.path.name, results.diagnosis
    if results.current is None:
        return [Markup("Fit a model: {}.").format(_command("fit", study))]
    if diagnosis is None:
        return [Markup("Find what the model lacks: {}.").format(_command("diagnose", study))]
    steps = list(_STEPS[diagnosis["verdict"]](diagnosis, study))
    if not diagnosis.get("complete", True):
        steps.append(mark_code(VERDICT_ONLY))
    return [*steps, *_scale_step(results)]


def _command(name: str, study: str, *more: str) -> Markup:
    return Markup("<code>{}</code>").format(" ".join(("frictrack", name, study, *more)))


def _complete(diagnosis: Mapping[str, Any], study: str) -> Iterator[Markup]:
    yield Markup(
        'Use the parameters. To detect effects below the <a href="#limits">detection limits</a>, film more runs: '
        "{} lists those that help most."
    ).format(_command("plan", study))


def _undetermined(diagnosis: Mapping[str, Any], study: str) -> Iterator[Markup]:
    for gap in (diagnosis.get("undetermined") or [])[:MAX_GAPS]:
        if gap["settled_by"]:
            yield Markup("To determine {}: {}.").format(
                mark_code(gap["what"]), mark_code(lower_first(gap["settled_by"]))
            )
    yield Markup("{} lists the runs that would decide it.").format(_command("plan", study))


def _missing(diagnosis: Mapping[str, Any], study: str) -> Iterator[Markup]:
    best = diagnosis["missing"][0]
    yield Markup("Add it: {} fits the model again with <b>{}</b> and prints the error before and after.").format(
        _command("add", study, best), best
    )
    yield from _experiment(diagnosis) or _confirm(diagnosis, [best])


def _ambiguous(diagnosis: Mapping[str, Any], study: str) -> Iterator[Markup]:
    rivals = indistinguishable_effects(diagnosis)
    first = [*certain_effects(diagnosis), *rivals][0]
    yield from _experiment(diagnosis) or _confirm(diagnosis, rivals)
    yield Markup("To see how much <b>{}</b> explains: {}.").format(first, _command("add", study, first))
    if formula := (diagnosis.get("unexplained") or {}).get("rival"):
        yield Markup("To see how much {} explains: {}.").format(formula, _command("add", study, "formula:1"))


def _unexplained(diagnosis: Mapping[str, Any], study: str) -> Iterator[Markup]:
    left = diagnosis.get("unexplained") or {}
    if left.get("formulas"):
        yield Markup(
            'To try the first formula under <a href="#missing">What is missing</a>, type {}: it is written into the '
            "study file and fitted."
        ).format(_command("add", study, "formula:1"))
    elif leads := diagnosis.get("leads"):
        yield Markup("To see how much of it <b>{}</b> explains: {}.").format(leads[0], _command("add", study, leads[0]))
    yield from _experiment(diagnosis)
    if not left.get("formulas"):
        yield Markup(
            "Film the same run twice and at another speed; {} lists runs. You can also write a cause of your own as a "
            "formula in an <code>[[effect]]</code> table of the study file."
        ).format(_command("plan", study))


def _experiment(diagnosis: Mapping[str, Any]) -> list[Markup]:
    """The best proposed experiment, if there is one."""
    return [
        Markup('To settle it: {}. See <a href="#settle">next experiments</a>.').format(
            mark_code(lower_first(step["what"]))
        )
        for step in (diagnosis.get("next_experiment") or [])[:1]
    ]


def _confirm(diagnosis: Mapping[str, Any], names: list[str]) -> list[Markup]:
    """How to confirm effects by another run."""
    words = {row.effect: row.source["words"] for row in candidate_rows(diagnosis)}
    found = [(name, words.get(name, {}).get("confirm")) for name in names]
    return [Markup("To confirm <b>{}</b>: {}.").format(name, mark_code(lower_first(how))) for name, how in found if how]


def _scale_step(results: Results) -> list[Markup]:
    """What to write into the study file so that the error of the scale is known."""
    filmed = any(run.film is not None for run in results.runs)
    unknown = filmed and not has_measured_friction(results) and not scale_error(results)
    return [Markup(NO_SCALE_ERROR)] if unknown else []


_STEPS: dict[str, Callable[[Mapping[str, Any], str], Iterator[Markup]]] = {
    "complete": _complete,
    "undetermined": _undetermined,
    "missing": _missing,
    "ambiguous": _ambiguous,
    "unexplained": _unexplained,
}
