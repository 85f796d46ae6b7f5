"""Describe a fit: the error of the scale, the model's own motion and bootstrap."""

from __future__ import annotations

import re
from collections.abc import Mapping

from markupsafe import Markup, escape

from frictrack.base.number_format import format_number, format_quantity, join_words
from frictrack.fit.penalties import SCATTER_BOUNDS
from frictrack.present.report.markup import mark_code, sentences
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
    own, smoothed, force = (
        [row["motion"][key] for row in rows if row["motion"][key] is not None]
        for key in ("sigma_a", "sigma_a_smoothed", "sigma_F_N")
    )
    notes = [(row["run"], note) for row in rows for note in row["motion"]["notes"]]
    return sentences("motion", own, smoothed, force, notes, model.summary.get("collisions", []))


def mark_addresses(line: str) -> Markup:
    """Set the addresses of parameters in a text as code.

    Examples
    --------
    >>> str(mark_addresses("stribeck.v_s is free"))
    '<code>stribeck.v_s</code> is free'

    """
    return Markup(ADDRESS.sub(r"<code>\g<0></code>", str(escape(line))))


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


def remarks(model: ModelResults) -> list[Markup]:
    """Remarks on the parameters; none of a model that was stored without."""
    return [mark_addresses(line) for line in model.summary.get("remarks", [])]


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
        return [Markup("Fit a model: <code>frictrack fit {}</code>.").format(study)]
    if diagnosis is None:
        return [Markup("Find what the model lacks: <code>frictrack diagnose {}</code>.").format(study)]
    certain, rivals = [], []
    if diagnosis["verdict"] == "ambiguous":
        certain, rivals = certain_effects(diagnosis), indistinguishable_effects(diagnosis)
    confirm = {row.effect: row.source["words"].get("confirm") for row in candidate_rows(diagnosis)}
    steps = sentences("next_steps", study, diagnosis, certain, rivals, confirm)
    if not diagnosis.get("complete", True):
        steps.append(mark_code(VERDICT_ONLY))
    filmed = any(run.film is not None for run in results.runs)
    unknown = filmed and not has_measured_friction(results) and not scale_error(results)
    return [*steps, *([Markup(NO_SCALE_ERROR)] if unknown else [])]
