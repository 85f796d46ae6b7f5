"""The verdict in words: what a person at the bench wants to know before any figure."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

from markupsafe import Markup, escape

from frictrack.axes import AXES
from frictrack.number_format import format_change, format_number, format_quantity, format_range
from frictrack.plots import noise_um, passes, plain_name
from frictrack.report.markup import mark_code
from frictrack.results import ModelResults, Results
from frictrack.verdicts import describe_open_question, indistinguishable_effects

EFFECT_NAMES = {
    "coulomb": "Coulomb friction",
    "stribeck": "Stribeck friction",
    "viscous": "viscous friction",
    "drag": "drag",
}
NUMBER_WORDS = ["no", "one", "two", "three", "four", "five", "six", "seven", "eight", "nine", "ten", "eleven", "twelve"]
SCALE_LINE = (
    "Forces go with the mass and the scale, and with the square of the frame rate: a constant error in any of them "
    "fits perfectly and shows nowhere else."
)
MEASURED_LINE = (
    "Friction itself was measured: zero and sensitivity of the load cell go into every force and show nowhere else."
)
NO_SCALE_ERROR = 'How well the scale is known was not given; written as "0.500 +/- 0.002 mm/px" it is carried on.'


@dataclass(frozen=True)
class Verdict:
    """The headline, the paragraph below it, and the kind of verdict it is."""

    headline: str
    sentences: tuple[Markup, ...]
    kind: str  # complete, undetermined, missing, ambiguous, unexplained, or "" before a diagnosis


def verdict(results: Results) -> Verdict:
    """What the study says about friction, in a headline and one paragraph."""
    model, diagnosis = results.current, results.diagnosis
    if model is None:
        return Verdict("Measured, not yet fitted", (Markup("No model has been fitted to these runs."),), "")
    kind = diagnosis["verdict"] if diagnosis else ""
    sentences = [_runs_and_law(results, model), *_added(results.models)]
    if diagnosis:
        sentences += [*_VERDICT_SENTENCES[kind](model, diagnosis), *_next_step(diagnosis)]
    return Verdict(_headline(results, model, kind), tuple(sentences), kind)


def scale_error(results: Results) -> float:
    """Relative standard deviation that the scale adds to every force told from acceleration; 0 for measured forces.

    One camera's scale is common to all its runs, so it does not average out: the largest counts.
    """
    inferred = [
        r for r in results.runs if r.sensors is None or (r.sensors.drive is None and r.sensors.friction_N is None)
    ]
    return max((r.displacement.relative_scale_error for r in inferred), default=0.0)


def measured_friction(results: Results) -> bool:
    """Whether a load cell measured the friction of these runs."""
    return any(r.sensors is not None and r.sensors.friction_N is not None for r in results.runs)


def scale_line(results: Results) -> str:
    """What scale and mass do to forces, and how well the scale is known."""
    if measured_friction(results):
        return MEASURED_LINE
    error = scale_error(results)
    if error > 0:
        return (
            f"{SCALE_LINE} The scale is known to {format_number(100 * error, 2)} %, and so is every force told from "
            "acceleration: this is common to all runs of one camera and stands apart from the ± of the fit."
        )
    filmed = any(r.film is not None for r in results.runs)
    return f"{SCALE_LINE} {NO_SCALE_ERROR}" if filmed else SCALE_LINE


def model_motion_sentences(model: ModelResults) -> list[Markup]:
    """How well the model itself tells the motion, where it misses something, and what it says of collisions."""
    rows = [row for row in model.summary["per_run"] if row["role"] == "fit" and row.get("motion")]
    if not rows:
        return []
    told = [
        Markup("<b>{}</b>: {}.").format(row["run"], mark_code(note)) for row in rows for note in row["motion"]["notes"]
    ]
    return [_motion_precision([row["motion"] for row in rows], held=not told), *told, *_collision_sentences(model)]


def _motion_precision(bands: Sequence[Mapping[str, Any]], *, held: bool) -> Markup:
    own, smooth = ([band[key] for band in bands if band[key] is not None] for key in ("sigma_a", "sigma_a_smoothed"))
    if not (own and smooth):
        return Markup("This law is too far off for a band on its motion.")
    force = [band["sigma_F_N"] for band in bands if band["sigma_F_N"] is not None]
    why = "a law that holds has only its few parameters to be wrong in" if held else "the law misses something"
    return Markup(
        "The model's own acceleration is known to {} m/s² and its friction force to {} N (rms over a run); smoothing "
        "tells the acceleration to {} m/s²: {}."
    ).format(format_range(own), format_range(force), format_range(smooth), why)


def _collision_sentences(model: ModelResults) -> Iterator[Markup]:
    """Collisions by their impulse; a peak force is never told."""
    for c in model.summary.get("collisions", []):
        if c["impulse_N_s"] is not None and c["relative_std"] is not None:
            yield Markup("<b>{}</b>, {} at {} ms after release: impulse {}, known to {} %; {}.").format(
                c["run"],
                c["effect"],
                format_number(1e3 * c["time_s"]) if c["time_s"] is not None else "an unknown time",
                format_quantity(c["impulse_N_s"], c["std"], "N s"),
                format_number(100 * c["relative_std"], 2),
                c["words"],
            )


def join_words(words: Sequence[str], last: str = "and") -> str:
    """Words joined as in a sentence: ``a, b and c``."""
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} {last} {words[-1]}" if words else ""


def effect_names(names: Sequence[str]) -> str:
    """The effects of a model in words."""
    return join_words([EFFECT_NAMES.get(name, name) for name in names])


def model_status(diagnosis: Mapping[str, Any]) -> str:
    """What a diagnosis says of its model, after the model's name."""
    if diagnosis["verdict"] == "complete":
        return "is complete"
    if diagnosis["verdict"] == "undetermined":
        return "is neither confirmed nor refuted"
    if diagnosis["verdict"] == "ambiguous":
        return f"lacks {join_words(indistinguishable_effects(diagnosis), 'or')}"
    if diagnosis["verdict"] == "missing":
        return f"lacks {join_words(diagnosis['missing'])}"
    return "fails, and not all of it is explained"


def single_additions(models: Sequence[ModelResults]) -> Iterator[tuple[ModelResults, ModelResults, str]]:
    """Model before, model after, and the one effect that was added between them."""
    for before, after in pairwise(models):
        new = [name for name in after.summary["model"] if name not in before.summary["model"]]
        if len(new) == 1 and len(after.summary["model"]) > len(before.summary["model"]):
            yield before, after, new[0]


def find_candidate(diagnosis: Mapping[str, Any] | None, effect: str) -> Mapping[str, Any] | None:
    """The candidate of that name."""
    return next((c for c in (diagnosis or {}).get("candidates", []) if c["effect"] == effect), None)


def held_out_error(errors: Mapping[str, Any]) -> tuple[float | None, str]:
    """Held-out error and its unit: um of displacement, or N where forces were measured."""
    if errors.get("heldout_rms_um") is not None:
        return errors["heldout_rms_um"], "µm"
    return errors.get("heldout_rms_N"), "N"


def held_out_change(found: Mapping[str, Any]) -> str:
    """Held-out error of a candidate, ``21.2 to 10.2 µm``; empty where nothing was held out."""
    for key, unit in (("um", "µm"), ("N", "N")):
        before, after = (found.get(f"heldout_rms_{when}_{key}") for when in ("before", "after"))
        if before is not None and after is not None:
            return f"{format_number(before)} to {format_number(after)} {unit}"
    return ""


def _headline(results: Results, model: ModelResults, kind: str) -> str:
    name = plain_name(model.name)
    diagnosis = results.diagnosis or {}
    if kind == "complete":
        added = [effect for *_, effect in single_additions(results.models) if effect in model.summary["model"]]
        return f"Complete with {join_words(added)}" if added else f"{name} is complete for these runs"
    if kind == "undetermined":
        return f"Undetermined: {describe_open_question(diagnosis)}"
    if kind == "ambiguous":
        return f"{name} {model_status(diagnosis)}: these runs cannot tell which"
    return f"{name} {model_status(diagnosis)}" if kind else f"{name}, not yet diagnosed"


def _runs_and_law(results: Results, model: ModelResults) -> Markup:
    fitted = [row for row in model.summary["per_run"] if row["role"] == "fit"]
    n = len(fitted)
    runs = "One run was" if n == 1 else f"{NUMBER_WORDS[n].capitalize() if n < len(NUMBER_WORDS) else n} runs were"
    return Markup("{} fitted with {}.").format(runs, effect_names(model.summary["model"]))


def _added(models: Sequence[ModelResults]) -> Iterator[Markup]:
    for before, after, effect in single_additions(models):
        found = find_candidate(before.diagnosis, effect)
        (old, unit), (new, _) = held_out_error(before.summary["errors"]), held_out_error(after.summary["errors"])
        why = Markup("")
        if found is not None:
            why = Markup(" ({}; {})").format(_as_clause(found["words"].get("what", "")), evidence(found))
        yield Markup("{} failed; it lacked <b>{}</b>{}: with it the held-out error {} from {} to <b>{} {}</b>.").format(
            plain_name(before.name),
            effect,
            why,
            _falls_or_rises(old, new),
            format_number(old),
            format_number(new),
            unit,
        )
        yield _added_parameters(after, effect)


def _as_clause(sentence: str) -> str:
    """A sentence as part of another one."""
    return sentence[:1].lower() + sentence[1:].rstrip(".")


def _falls_or_rises(old: float | None, new: float | None) -> str:
    return "rises" if old is not None and new is not None and new > old else "falls"


def _added_parameters(model: ModelResults, effect: str) -> Markup:
    """What the added effect came to: its shared parameters."""
    known = {
        name.removeprefix(f"{effect}."): format_quantity(p["value"], p.get("std_misfit", p["std"]), p["unit"])
        for name, p in model.summary["parameters"].items()
        if name.startswith(f"{effect}.") and "[" not in name and p["std"]
    }
    told = join_words([f"{name} {value}" for name, value in known.items()])
    return Markup("It has {}.").format(told.replace("_", " ")) if told else Markup("")


def evidence(found: Mapping[str, Any]) -> Markup:
    """How sure: p for the whole search and delta BIC."""
    return Markup("p = {} for the whole search, delta BIC {}").format(
        format_number(found["p"], 1),
        format_change(found["delta_bic"]),
    )


def _complete(model: ModelResults, diagnosis: Mapping[str, Any]) -> Iterator[Markup]:
    yield Markup(
        "Nothing more is seen: {}lack of fit has p = {}, and no further effect of the library passes. "
        "This speaks of this library and these runs; what would have stayed unseen stands under "
        '<a href="#limits">detection limits</a>.'
    ).format(_residual(model), format_number(diagnosis["p_lack_of_fit"], 2))


def _residual(model: ModelResults) -> str:
    rms, noise = model.summary["errors"].get("rms_displacement_um"), noise_um(model)
    if rms is None or noise is None:
        return ""
    return f"the residual is {format_number(rms)} µm where the noise is {format_number(noise)} µm, "


def _undetermined(model: ModelResults, diagnosis: Mapping[str, Any]) -> Iterator[Markup]:
    yield Markup("These runs cannot show whether something is missing: {}lack of fit has p = {}.").format(
        _residual(model), format_number(diagnosis["p_lack_of_fit"], 2)
    )
    for gap in diagnosis["undetermined"]:
        advice = f"; to settle it: {_as_clause(gap['settled_by'])}" if gap["settled_by"] else ""
        yield Markup("Open is <b>{}</b>: {}{}.").format(gap["what"], mark_code(gap["why"]), mark_code(advice))


def _missing(model: ModelResults, diagnosis: Mapping[str, Any]) -> Iterator[Markup]:
    yield Markup("The model fails: {}reduced chi-squared is {}.").format(
        _residual(model), format_number(diagnosis["reduced_chi2"])
    )
    for effect in diagnosis["missing"]:
        found = find_candidate(diagnosis, effect)
        if found is not None:
            change = held_out_change(found)
            yield Markup("Missing is <b>{}</b> ({}; {}{}).").format(
                effect,
                _as_clause(found["words"].get("what", "")),
                evidence(found),
                f"; adding it brings the held-out error from {change}" if change else "",
            )
        else:
            yield Markup("Once that is added, <b>{}</b> is missing too.").format(effect)


def _ambiguous(model: ModelResults, diagnosis: Mapping[str, Any]) -> Iterator[Markup]:
    yield from _missing(model, diagnosis)
    others = indistinguishable_effects(diagnosis)[1:]
    yield Markup("But <b>{}</b> would predict the same data within the noise.").format(join_words(others, "or"))


def _unexplained(model: ModelResults, diagnosis: Mapping[str, Any]) -> Iterator[Markup]:
    yield Markup("The model fails: {}reduced chi-squared is {}.").format(
        _residual(model), format_number(diagnosis["reduced_chi2"])
    )
    left = diagnosis.get("unexplained")
    if left and left.get("words"):
        yield Markup("It is none of the library's effects: {}.").format(left["words"])
        return
    if diagnosis["missing"]:
        yield Markup("Adding <b>{}</b> helps, but structure remains.").format(join_words(diagnosis["missing"]))
    elif not any(passes(c) for c in diagnosis["candidates"]):
        yield Markup("No effect of the library passes.")
    if left:
        yield Markup("What is left repeats best along {}.").format(AXES[left["axis"]].name)


_VERDICT_SENTENCES = {
    "complete": _complete,
    "undetermined": _undetermined,
    "missing": _missing,
    "ambiguous": _ambiguous,
    "unexplained": _unexplained,
}


def _next_step(diagnosis: Mapping[str, Any]) -> Iterator[Markup]:
    """What to film next."""
    for step in (diagnosis.get("next_experiment") or [])[:1]:
        yield Markup('To settle it: {}. More stands under <a href="#settle">what would settle it</a>.').format(
            mark_code(step["what"])
        )
    if diagnosis["verdict"] in ("missing", "ambiguous") and not diagnosis.get("next_experiment"):
        for effect in indistinguishable_effects(diagnosis):
            found = find_candidate(diagnosis, effect)
            if found is not None and found["words"].get("confirm"):
                yield Markup("To confirm <b>{}</b>: {}.").format(
                    effect, mark_code(_as_clause(found["words"]["confirm"]))
                )


ADDRESS = re.compile(r"\b[a-z][a-z_0-9]*(?::\d+)?\.[A-Za-z][A-Za-z_0-9]*")  # of a parameter: stribeck.v_s


def mark_addresses(line: str) -> Markup:
    """What a fit says of its parameters, their addresses set as code."""
    out, at = Markup(""), 0
    for found in ADDRESS.finditer(line):
        out += escape(line[at : found.start()]) + Markup("<code>{}</code>").format(found[0])
        at = found.end()
    return out + escape(line[at:])


def bootstrap_sentence(model: ModelResults) -> str:
    """What a bootstrap rests on; empty where there was none."""
    told = model.summary.get("bootstrap")
    if not told:
        return ""
    failed = f"; {told['failed']} more gave no law" if told["failed"] else ""
    how = "white noise"
    if told["correlated"]:
        how = f"blocks of the residual, which is correlated in {join_words(told['correlated'])}"
    return f"Bootstrap of {told['draws']} draws from the fitted model, with {how}{failed}."


def correlation(first: str, second: str, r: float) -> Markup:
    """A correlation in words."""
    way = "up and the other down" if r < 0 else "and the other up together"
    return Markup(
        "<code>{}</code> and <code>{}</code> are hardly told apart (correlation {}): "
        "one {} changes the prediction little, so these runs fix a combination of them better than either."
    ).format(first, second, f"{r:+.3f}".replace("-", "\N{MINUS SIGN}"), way)
