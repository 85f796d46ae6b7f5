"""Describe a study in words: its verdict, its fit, and how it was measured."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from itertools import pairwise
from platform import python_version
from typing import Any

import numpy as np
from markupsafe import Markup, escape

from frictrack.base.number_format import format_number, format_quantity, join_words
from frictrack.fit.penalties import SCATTER_BOUNDS
from frictrack.present.plots import noise_um
from frictrack.present.report.tables import Cell, TextTable, describe_evidence, make_table, mark_code, sentences
from frictrack.results import ModelResults, Results, RunResults, verdicts
from frictrack.results.candidates import AXES, candidate_rows, describe_held_out, plain_name

EFFECT_NAMES = {"coulomb": "Coulomb friction", "stribeck": "Stribeck friction", "viscous": "viscous friction"}


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
    outdated = {part.name for part in results.outdated_parts if part.what == "model"}
    paragraph = [*_added_effects([one for one in results.models if one.name not in outdated])]
    if diagnosis:
        rows = {row.effect: row for row in candidate_rows(diagnosis)}
        rivals = verdicts.indistinguishable_effects(diagnosis) if kind == "ambiguous" else []
        alternatives = verdicts.describe_alternatives(diagnosis)
        paragraph += sentences("verdict", diagnosis, _residual(model), rows, rivals, alternatives, AXES)
    name = plain_name(model.name)
    headline = verdicts.describe_verdict(diagnosis, name) if diagnosis else f"{name}, not yet diagnosed"
    return VerdictText(headline, tuple(paragraph), kind, _runs_and_model(model))


def effect_names(names: Sequence[str]) -> str:
    """Write the effects of a model as in a sentence.

    Examples
    --------
    >>> effect_names(["coulomb", "viscous", "texture"])
    'Coulomb friction, viscous friction and texture'

    """
    return join_words([EFFECT_NAMES.get(name, name) for name in names])


def single_additions(models: Sequence[ModelResults]) -> Iterator[tuple[ModelResults, ModelResults, str]]:
    """Yield successive models that differ by one added effect: the model before, the one after, the effect."""
    for before, after in pairwise(models):
        new = [name for name in after.summary["model"] if name not in before.summary["model"]]
        if len(new) == 1 and len(after.summary["model"]) > len(before.summary["model"]):
            yield before, after, new[0]


def _runs_and_model(model: ModelResults) -> str:
    n = sum(row["role"] == "fit" for row in model.summary["per_run"])
    return f"{'1 run was' if n == 1 else f'{n} runs were'} fitted with {effect_names(model.summary['model'])}."


def _added_effects(models: Sequence[ModelResults]) -> Iterator[Markup]:
    """Describe how the error changed as effects were added, in one sentence."""
    added = list(single_additions(models))
    if not added:
        return
    first, last = added[0][0], added[-1][1]
    effects = join_words([f"<b>{escape(effect)}</b>" for *_, effect in added])
    found = [row for row in candidate_rows(first.diagnosis) if len(added) == 1 and row.effect == added[0][2]]
    why = Markup(" ({})").format(describe_evidence(found[0])) if found else Markup("")
    them, change = "it" if len(added) == 1 else "them", describe_held_out(*(m.summary["errors"] for m in (first, last)))
    lacked = Markup("{} lacked {}{}").format(plain_name(first.name), Markup(effects), why)
    yield Markup("{}: with {} {}.").format(lacked, them, change)


def _residual(model: ModelResults) -> str:
    rms, noise = model.summary["errors"].get("rms_displacement_um"), noise_um(model)
    if rms is None or noise is None:
        return ""
    return f"the residual is {format_number(rms)} µm, the noise {format_number(noise)} µm, "


# --- the fit

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

    def is_inferred(run: RunResults) -> bool:
        return run.sensors is None or (run.sensors.drive is None and run.sensors.friction_N is None)

    return max((run.displacement.relative_scale_error for run in results.runs if is_inferred(run)), default=0.0)


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
        certain, rivals = verdicts.certain_effects(diagnosis), verdicts.indistinguishable_effects(diagnosis)
    confirm = {row.effect: row.source["words"].get("confirm") for row in candidate_rows(diagnosis)}
    steps = sentences("next_steps", study, diagnosis, certain, rivals, confirm)
    if not diagnosis.get("complete", True):
        steps.append(mark_code(verdicts.VERDICT_ONLY))
    filmed = any(run.film is not None for run in results.runs)
    unknown = filmed and not has_measured_friction(results) and not scale_error(results)
    if results.warnings:
        return [mark_code(verdicts.CHECK_NEXT), *steps]
    return [*steps, *([Markup(NO_SCALE_ERROR)] if unknown else [])]


# --- the measurement

MIN_LOCKING_SIGMAS = 0.2  # peak locking over the noise of a frame; less is not reported
MIN_BACKWARD_SIGMAS = 0.5  # difference of backward tracking over the noise of a frame; less is not reported
MIN_BLUR_PX = 1.0  # less is not reported
PRECISIONS = ("sigma_px", "sigma_um", "noise_floor_px")  # of the target, px and um, and of a fixed reference, px
GOOD_VERDICTS = ("used", "agrees", "none", "speed of showing")


def measurement(runs: Sequence[RunResults]) -> list[Markup]:
    """Describe the noise of the films and the failed self-checks of their measurement.

    Parameters
    ----------
    runs : sequence of RunResults
        All runs of the study.

    Returns
    -------
    list of Markup
        Sentences; none if no run has a film.

    """
    filmed = [run for run in runs if run.quality]
    if not filmed:
        return []
    values = ([run.quality[k] for run in filmed if run.quality[k] is not None] for k in PRECISIONS)
    failed = [(run.name, found) for run in filmed if (found := failed_checks(run))]
    return sentences("measurement", *values, failed)


def failed_checks(run: RunResults) -> list[str]:
    """Describe the self-checks that one film fails."""
    q = run.quality
    assert run.track is not None
    path = int(np.ptp(np.flatnonzero(run.track.found))) + 1  # before and after it, the target is out of the picture
    lost, locking, sigma = path - q["found"], q["peak_locking_px"], q["sigma_px"]
    backward, blur = (q[key] or 0.0 for key in ("forward_backward_sigmas", "blur_px"))
    is_locked = locking and sigma and locking > max(3 * q["peak_locking_std_px"], MIN_LOCKING_SIGMAS * sigma)
    checks = (
        (lost, verdicts.describe_lost(lost, path)),
        (q["shake_px"], f"camera shake of {_px(q['shake_px'])} at {format_number(q['shake_Hz'])} Hz was subtracted"),
        (is_locked, f"peak locking shifts positions by {_px(locking)}"),
        (backward > MIN_BACKWARD_SIGMAS, f"positions tracked backward differ by {_px(q['forward_backward_px'])}"),
        (blur > MIN_BLUR_PX, f"the target moves {_px(blur)} during the exposure of a frame"),
    )
    timing = [f"{r['what']}: {r['value']}, {r['verdict']}" for r in q["timebase"] if not is_good(r["verdict"])]
    scale = [note for note in run.displacement.notes if "by the motion" in note or "from the motion" in note]
    return [text for failed, text in checks if failed] + timing + scale


def is_good(verdict: str) -> bool:
    """Return whether the verdict of a check of the time base is nothing to worry about."""
    return verdict in GOOD_VERDICTS or "of the frame interval" in verdict


def _px(value: float | None) -> str:
    return f"{format_number(value, 2)} px"


def smoothing(results: Results) -> list[Markup]:
    """Describe how each displacement was smoothed, signals above the cut-off, and the noise at rest.

    Parameters
    ----------
    results : Results
        The study.

    Returns
    -------
    list of Markup
        Sentences.

    """

    def noise_um(run: RunResults) -> float:
        sigma = run.filtered.sigma_x
        return 1e6 * float(np.median(sigma[np.isfinite(sigma)]))

    return sentences("smoothing", results.runs, noise_um)


LIBRARIES = ("numpy", "scipy", "pandas", "matplotlib", "h5py", "opencv-python-headless")
KEYS_WITH_COLUMN = ("name", "video", "table", "mass", "fps", "scale", "role", "x_offset")


def settings_table(results: Results) -> TextTable:
    """Table of the settings of each run."""
    rows = []
    for run in results.runs:
        s = run.settings
        mass = format_quantity(s["mass"][0], s["mass"][1], "kg") if run.mass is not None else str(s.get("mass") or "")
        fps, cutoff = s.get("fps"), run.motion.cutoff
        rates = (f"{fps:g} Hz" if fps else "", f"{cutoff:.0f} Hz" if np.isfinite(cutoff) else "")
        more = {k: v for k, v in s.items() if k not in KEYS_WITH_COLUMN and (v or k == "sigma_drive")}
        further = "; ".join(f"{k} = {v}" for k, v in more.items() if (k, v) != ("reference", "auto"))
        rows.append((run.name, run.source, mass, rates[0], _scale(s.get("scale", "")), rates[1], further))
    return make_table(("run", "source", "mass", "frame rate", "scale", "cut-off", "further keys"), rows)


def _scale(written: Any) -> str:
    """Describe a scale as the study file gives it."""
    if isinstance(written, list):
        return ", checked against ".join(_scale(one) for one in written)
    if not isinstance(written, dict):
        return str(written)
    if "board" in written:
        names = written["board"] if isinstance(written["board"], list) else [written["board"]]
        columns, rows = written["squares"]
        return f"board in {', '.join(map(str, names))}: {columns} x {rows} squares of {written['square']}"
    if "target" in written:
        return f"the target's size, {written['target']}"
    if "plane" in written:
        return f"{len(written['points'])} points at known positions"
    return f"ruler of {written['length']}"


def findings_table(results: Results) -> TextTable:
    """Table of the findings and automatic decisions, run by run."""
    rows: list[Sequence[Cell]] = []
    for run in results.runs:
        rows.append((run.name, f"low-pass: {run.filtered.reason}"))
        if run.friction is not None:
            rows.append(("", f"free section: {run.friction.reason}"))
        rows += [("", note) for note in run.notes]
    rows += [("study", note) for note in results.notes]
    rows += [("diagnosis", note) for note in (results.diagnosis or {}).get("remarks", [])]
    return make_table(("", "finding"), rows)


def hash_table(results: Results) -> TextTable:
    """Table of the first digits of the hash of each film and stage.

    The full hash is shown when the pointer rests on a cell.

    Parameters
    ----------
    results : Results
        The study.

    """
    stages = list(dict.fromkeys(stage for run in results.runs for stage in run.hashes))
    hashes = ((run.film.hash if run.film else "", *map(run.hashes.get, stages)) for run in results.runs)
    short = Markup('<code title="{}">{}</code>').format
    cells = ([short(full, full[:10]) if full else "" for full in own] for own in hashes)
    rows = [(run.name, *own) for run, own in zip(results.runs, cells, strict=True)]
    return make_table(("run", "film (sha256)", *stages), rows)


def software_versions(results: Results) -> str:
    """List the versions of frictrack, Python and the main libraries."""
    found = [f"frictrack {results.version}", f"Python {python_version()}"]
    for name in LIBRARIES:
        try:
            found.append(f"{name} {version(name)}")
        except PackageNotFoundError:
            continue
    return ", ".join(found)
