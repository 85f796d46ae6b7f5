"""Describe a fit: the error of the scale, the model's own motion, bootstrap and correlations."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

from markupsafe import Markup, escape

from frictrack.base.number_format import MINUS, format_number, format_quantity, format_range, join_words, lower_first
from frictrack.fit.penalties import SCATTER_BOUNDS
from frictrack.present.report.markup import mark_code
from frictrack.results import ModelResults, Results
from frictrack.results.candidates import candidate_rows
from frictrack.results.verdicts import VERDICT_ONLY, certain_effects, indistinguishable_effects

SCALE_LINE = (
    "Forces are proportional to the mass, the scale and the square of the frame rate. A constant error in one of them "
    "does not change the quality of the fit."
)
MEASURED_LINE = (
    "A load cell measured the friction force. An error of its zero or sensitivity is in every force and does not "
    "change the quality of the fit."
)
NO_SCALE_ERROR = 'The error of the scale is not given. Write it behind the scale, "... +/- ... mm/px", to include it.'
ADDRESS = re.compile(r"\b[a-z][a-z_0-9]*(?::\d+)?\.[A-Za-z][A-Za-z_0-9]*")  # of a parameter: stribeck.v_s


def scale_error(results: Results) -> float:
    """Relative standard deviation that the scale adds to every force inferred from acceleration.

    All runs of one camera share its scale, so its error does not average out; the largest one counts.

    Returns
    -------
    float
        0.0 if all forces were measured or the error is not known.

    """
    inferred = [
        r for r in results.runs if r.sensors is None or (r.sensors.drive is None and r.sensors.friction_N is None)
    ]
    return max((r.displacement.relative_scale_error for r in inferred), default=0.0)


def has_measured_friction(results: Results) -> bool:
    """Whether a load cell measured the friction of these runs."""
    return any(r.sensors is not None and r.sensors.friction_N is not None for r in results.runs)


def scale_line(results: Results) -> str:
    """Describe how errors of scale and mass enter the forces, and how large the error of the scale is."""
    if has_measured_friction(results):
        return MEASURED_LINE
    error = scale_error(results)
    if error > 0:
        return (
            f"{SCALE_LINE} The scale has a standard deviation of {format_number(100 * error, 2)} %. This error is "
            "common to all runs of one camera; every ± includes it."
        )
    filmed = any(r.film is not None for r in results.runs)
    return f"{SCALE_LINE} {NO_SCALE_ERROR}" if filmed else SCALE_LINE


def scatter_words(scatter: Mapping[str, float]) -> str:
    """Describe by how much dry friction differs from run to run; at its lower bound the estimate is no number."""
    if scatter["value"] < 2 * SCATTER_BOUNDS[0]:
        return "no scatter of dry friction between runs is seen"
    return f"dry friction scatters between runs by {format_quantity(100 * scatter['value'], 100 * scatter['std'], '%')}"


def model_motion_sentences(model: ModelResults) -> list[Markup]:
    """Describe how precisely the model gives the motion, where it misses something, and the collisions.

    Returns
    -------
    list of Markup
        Sentences; none if the model has no motion of its own.

    """
    rows = [row for row in model.summary["per_run"] if row["role"] == "fit" and row.get("motion")]
    if not rows:
        return []
    notes = [
        Markup("<b>{}</b>: {}.").format(row["run"], mark_code(note)) for row in rows for note in row["motion"]["notes"]
    ]
    precision = _motion_precision([row["motion"] for row in rows], is_adequate=not notes)
    return [precision, *notes, *_collision_sentences(model)]


def _motion_precision(bands: Sequence[Mapping[str, Any]], *, is_adequate: bool) -> Markup:
    own, smooth = ([band[key] for band in bands if band[key] is not None] for key in ("sigma_a", "sigma_a_smoothed"))
    if not (own and smooth):
        return Markup("The model fits too badly to give an error band for its motion.")
    force = [band["sigma_F_N"] for band in bands if band["sigma_F_N"] is not None]
    why = "The model is more precise because it has few parameters." if is_adequate else "The model misses something."
    return Markup(
        "Standard deviations, rms over a run: acceleration of the model {} m/s², its friction force {} N; acceleration "
        "by smoothing {} m/s². {}"
    ).format(format_range(own), format_range(force), format_range(smooth), why)


def _collision_sentences(model: ModelResults) -> Iterator[Markup]:
    """Describe collisions by their impulse; the peak force is not known."""
    for c in model.summary.get("collisions", []):
        if c["impulse_N_s"] is not None and c["relative_std"] is not None:
            yield Markup("<b>{}</b>, {} at {} ms after release: impulse {}, relative error {} %; {}.").format(
                c["run"],
                c["effect"],
                format_number(1e3 * c["time_s"]) if c["time_s"] is not None else "an unknown time",
                format_quantity(c["impulse_N_s"], c["std"], "N s"),
                format_number(100 * c["relative_std"], 2),
                c["words"],
            )


def mark_addresses(line: str) -> Markup:
    """Set the addresses of parameters in a text as code.

    Examples
    --------
    >>> str(mark_addresses("stribeck.v_s is free"))
    '<code>stribeck.v_s</code> is free'

    """
    out, at = Markup(""), 0
    for found in ADDRESS.finditer(line):
        out += escape(line[at : found.start()]) + Markup("<code>{}</code>").format(found[0])
        at = found.end()
    return out + escape(line[at:])


def bootstrap_sentence(model: ModelResults) -> str:
    """Describe the bootstrap: number of draws and the noise that was used; "" if there was none."""
    bootstrap = model.summary.get("bootstrap")
    if not bootstrap:
        return ""
    failed = f"; the fit of {bootstrap['failed']} further draws failed" if bootstrap["failed"] else ""
    noise = "white noise"
    if bootstrap["correlated"]:
        noise = f"blocks of the residual, which is correlated in {join_words(bootstrap['correlated'])}"
    return f"Bootstrap of {bootstrap['draws']} draws from the fitted model, with {noise}{failed}."


def correlation_sentence(first: str, second: str, r: float) -> Markup:
    """Describe the correlation `r` of two parameters."""
    way = "decreases" if r < 0 else "increases too"
    return Markup(
        "<code>{}</code> and <code>{}</code> are strongly correlated ({}): if one increases and the other {}, the "
        "prediction hardly changes. These runs determine a combination of them better than either."
    ).format(first, second, f"{r:+.3f}".replace("-", MINUS), way)


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
    first = [*certain_effects(diagnosis), *diagnosis["missing"], *rivals][0]
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
