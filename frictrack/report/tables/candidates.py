"""Build the cards and tables of a diagnosis: candidate effects, their importance, detection limits."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from markupsafe import Markup

from frictrack.number_format import DASH, format_number, format_quantity, format_size, format_unit
from frictrack.plots import held_out_order, passes
from frictrack.report.candidate_text import held_out_change
from frictrack.report.markup import mark_code
from frictrack.report.tables.parameters import PER_RUN_NAME
from frictrack.report.tables.text_table import Cell, TextTable, code_cell, make_table

TEXT_KEYS = ("what", "looks_like", "here", "confirm")
MAIN_KINDS = ("named", "rival")
MAX_OTHERS_SHOWN = 3  # where no candidate was found
KIND_WORDS = {
    "named": "found",
    "lead": "explains a part",
    "rival": "predicts the same data as the best one",
    "weaker": "passes, but explains less",
    "fails": "does not pass",
}
ACTS_ON = {"force": "a force on the mass", "measurement": "an error of the measurement"}


@dataclass(frozen=True)
class CandidateCard:
    """The texts about one candidate effect.

    Attributes
    ----------
    name : str
        Name of the effect.
    passes : bool
        Whether it is significant, improves the BIC, and is plausible.
    acts_on : str
        Whether it is a force or an error of the measurement.
    rank : str
        Its place among the candidates.
    words : mapping
        What it is, what it looks like, where it shows here, how to confirm it.
    numbers : tuple
        Its parameters and the evidence.
    rivals : tuple of str
        Effects that these runs cannot distinguish from it.

    """

    name: str
    passes: bool
    acts_on: str
    rank: str
    words: Mapping[str, Markup]
    numbers: tuple[Cell, ...]
    rivals: tuple[str, ...]


def candidate_cards(diagnosis: Mapping[str, Any]) -> list[CandidateCard]:
    """Describe the candidates of a diagnosis.

    Parameters
    ----------
    diagnosis : mapping
        The JSON of a diagnosis.

    Returns
    -------
    list of CandidateCard
        One card per candidate, the best first.

    """
    return [
        CandidateCard(
            name=c["effect"],
            passes=passes(c),
            acts_on=ACTS_ON.get(c["acts_on"], ""),
            rank=_rank(c, diagnosis["candidates"][0]),
            words={key: mark_code(c["words"].get(key, "")) for key in TEXT_KEYS},
            numbers=tuple(_numbers(c)),
            rivals=tuple(c["indistinguishable_from"]),
        )
        for c in diagnosis["candidates"]
    ]


def _rank(c: Mapping[str, Any], best: Mapping[str, Any]) -> str:
    """Place of a candidate relative to the best one."""
    if c.get("implausible"):
        return f"fits, but is not plausible: {c['implausible']}"
    if not passes(c):
        return "does not pass"
    if c is best:
        return "passes, the best candidate"
    if c["effect"] in best["indistinguishable_from"]:
        return "passes, as good as the best"
    return f"passes, delta BIC {format_number(best['delta_bic'] - c['delta_bic'])} below the best"


def _numbers(c: Mapping[str, Any]) -> list[Cell]:
    """Shared parameters, then the evidence."""
    shared = {name: p for name, p in c["parameters"].items() if not PER_RUN_NAME.match(name)}
    per_run = sorted({m["name"] for name in c["parameters"] if (m := PER_RUN_NAME.match(name))})
    out: list[Cell] = [f"{name} {format_quantity(p['value'], p['std'], p['unit'])}" for name, p in shared.items()]
    if per_run:
        out.append(f"one {' and one '.join(per_run)} per run")
    out.append(f"p = {format_number(c['p'], 1)}, delta BIC {format_number(c['delta_bic'])}")
    change = held_out_change(c)
    if change:
        out.append(f"held-out error {change} ({'whole runs' if c['heldout'] == 'run' else 'every other frame'})")
    return out


@dataclass(frozen=True)
class CandidateTable:
    """The candidates of a diagnosis, those that matter apart from the others.

    Attributes
    ----------
    note : str
        What holds for all of them: the error without any, and a p-value that they share.
    shown, others : TextTable
        The candidates that were found or cannot be told from those, and the others, sorted by held-out error.

    """

    note: str
    shown: TextTable
    others: TextTable


def candidate_table(diagnosis: Mapping[str, Any]) -> CandidateTable:
    """Tables of the candidates of a diagnosis, sorted by held-out error.

    Parameters
    ----------
    diagnosis : mapping
        The JSON of a diagnosis.

    """
    found = sorted(diagnosis["candidates"], key=held_out_order)
    same_p = len({c["p"] for c in found if not c.get("implausible")}) <= 1
    shares = {row["effect"]: row["explained_alone"] for row in diagnosis.get("importance") or []}
    kinds = {c["effect"]: _kind(c, diagnosis) for c in found}
    apart = [c for c in found if kinds[c["effect"]] in MAIN_KINDS] or found[:MAX_OTHERS_SHOWN]
    rest = [c for c in found if c not in apart]
    heads = ("effect", f"held-out error / {_unit_of(found)}", "explains alone", "p", "delta BIC", "")

    def table(listed: Sequence[Mapping[str, Any]]) -> TextTable:
        rows = [_candidate_row(c, kinds[c["effect"]], shares.get(c["effect"]), with_p=not same_p) for c in listed]
        return make_table(heads, rows, (1, 2, 3, 4))

    return CandidateTable(_candidates_note(found, diagnosis, same_p=same_p), table(apart), table(rest))


def _held_out(c: Mapping[str, Any], when: str) -> float | None:
    um, newton = (c.get(f"heldout_rms_{when}_{unit}") for unit in ("um", "N"))
    found: float | None = newton if um is None else um
    return found


def _unit_of(found: Sequence[Mapping[str, Any]]) -> str:
    return "N" if any(c.get("heldout_rms_after_N") is not None for c in found) else "µm"


def _kind(c: Mapping[str, Any], diagnosis: Mapping[str, Any]) -> str:
    """What a candidate means; also the CSS class of its mark."""
    if c.get("implausible"):
        return "implausible"
    if not passes(c):
        return "fails"
    if c["effect"] in diagnosis["missing"]:
        return "named"
    if c["effect"] in diagnosis.get("leads", []):
        return "lead"
    best = diagnosis["candidates"][0]
    rivals = best["indistinguishable_from"] if best["effect"] in diagnosis["missing"] else ()
    return "rival" if c["effect"] in rivals else "weaker"


def _candidate_row(c: Mapping[str, Any], kind: str, share: float | None, *, with_p: bool) -> Sequence[Cell]:
    error = _held_out(c, "after")
    return (
        Markup('<span class="mark {}"></span><code>{}</code>').format(kind, c["effect"]),
        _why_not_held_out(c, kind) if error is None else format_number(error),
        _share_of_misfit(share),
        format_number(c["p"], 1) if with_p else "",
        format_number(c["delta_bic"]),
        f"not plausible: {c['implausible']}" if kind == "implausible" else KIND_WORDS[kind],
    )


def _why_not_held_out(c: Mapping[str, Any], kind: str) -> Markup:
    """A dash with the reason why there is no held-out error."""
    why = "not significant" if kind == "fails" else "not computed" if c["parameters"] else "not simulated: far behind"
    return Markup('{} <span class="note">{}</span>').format(DASH, why)


def _candidates_note(found: Sequence[Mapping[str, Any]], diagnosis: Mapping[str, Any], *, same_p: bool) -> str:
    before = next((e for e in (_held_out(c, "before") for c in found) if e is not None), None)
    unit = _unit_of(found)
    noise = diagnosis.get("noise_um") if unit == "µm" else diagnosis.get("noise_N")
    parts = []
    if before is not None:
        against = "" if noise is None else f", the noise {format_number(noise)} {unit}"
        parts.append(f"Without any of them the held-out error is {format_number(before)} {unit}{against}.")
    if same_p and found:
        p = next((c["p"] for c in found if not c.get("implausible")), found[0]["p"])
        parts.append(f"All have p = {format_number(p, 1)} for the whole search.")
    return " ".join(parts)


def importance_table(diagnosis: Mapping[str, Any]) -> TextTable:
    """Table of the misfit that each effect explains alone and after the effects above it.

    Parameters
    ----------
    diagnosis : mapping
        The JSON of a diagnosis. Without `importance` the table is empty.

    """
    rows = []
    for row in diagnosis.get("importance") or []:
        shares = [_share_of_misfit(row[key]) for key in ("explained_alone", "explained_in_sequence")]
        unit = "um" if "heldout_rms_after_um" in row else "N"
        error = row[f"heldout_rms_after_{unit}"]
        after = "" if error is None else f"{format_number(error)} {format_unit(unit)}"
        rows.append((code_cell(row["effect"]), *shares, after, "stop here" if row["stop"] else ""))
    return make_table(("effect", "explains alone", "adds in sequence", "held-out error after it", ""), rows, (1, 2, 3))


def _share_of_misfit(share: float | None) -> str:
    return "" if share is None else f"{100 * share:.1f} %"


def undetermined_table(diagnosis: Mapping[str, Any]) -> TextTable:
    """Table of the questions that the runs leave open, and what would answer them.

    Parameters
    ----------
    diagnosis : mapping
        The JSON of a diagnosis. Without `undetermined` the table is empty.

    """
    rows = [
        (mark_code(gap["what"]), mark_code(gap["why"]), mark_code(gap["settled_by"] or ""))
        for gap in diagnosis.get("undetermined") or []
    ]
    return make_table(("not determined", "why", "what settles it"), rows)


def detection_limit_table(diagnosis: Mapping[str, Any]) -> TextTable:
    """Table of the smallest size of each effect that 95 of 100 repeats would detect.

    Parameters
    ----------
    diagnosis : mapping
        The JSON of a diagnosis, with `detection_limits`.

    """
    rows = [
        (code_cell(name), _limit(limit), limit.get("reason") or _worst_setting(name, limit))
        for name, limit in diagnosis["detection_limits"].items()
    ]
    return make_table(("effect", "detectable from", "at the least favourable"), rows, (1,))


def _limit(limit: Mapping[str, Any]) -> str:
    return DASH if limit["value"] is None else format_size(limit["value"], limit["unit"])


def _worst_setting(effect: str, limit: Mapping[str, Any]) -> str:
    from frictrack import effects  # noqa: PLC0415 - only for the units

    kind = effects.known().get(effect.split(":", maxsplit=1)[0])
    units = {} if kind is None else {p.name: p.unit for p in kind.parameters}
    return ", ".join(f"{name} {format_size(value, units.get(name, ''))}" for name, value in limit.get("at", {}).items())
