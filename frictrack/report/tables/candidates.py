"""Build the cards and tables of a diagnosis: candidate effects, their importance, detection limits."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from markupsafe import Markup

from frictrack.candidates import MAIN_KINDS, CandidateRow
from frictrack.number_format import DASH, format_number, format_size, format_unit
from frictrack.report.markup import mark_code
from frictrack.report.tables.text_table import TextTable, code_cell, make_table

TEXT_KEYS = ("what", "looks_like", "here", "confirm")
MAX_OTHERS_SHOWN = 3  # where no candidate was found
ACTS_ON = {"force": "a force on the mass", "measurement": "an error of the measurement"}


@dataclass(frozen=True)
class CandidateCard:
    """The texts about one candidate effect.

    Attributes
    ----------
    row : CandidateRow
        Its row in the list of candidates.
    acts_on : str
        Whether it is a force or an error of the measurement.
    words : mapping
        What it is, what it looks like, where it shows here, how to confirm it.
    numbers : tuple
        Its parameters and the evidence.
    rivals : tuple of str
        Effects that these runs cannot distinguish from it.

    """

    row: CandidateRow
    acts_on: str
    words: Mapping[str, Markup]
    numbers: tuple[str, ...]
    rivals: tuple[str, ...]


def candidate_cards(rows: Sequence[CandidateRow]) -> list[CandidateCard]:
    """Describe candidates, one card each.

    Parameters
    ----------
    rows : sequence of CandidateRow
        From `frictrack.candidates.candidate_rows`.

    """
    return [
        CandidateCard(
            row=row,
            acts_on=ACTS_ON.get(row.source["acts_on"], ""),
            words={key: mark_code(row.source["words"].get(key, "")) for key in TEXT_KEYS},
            numbers=(*row.parameters, row.evidence, *_held_out_words(row)),
            rivals=tuple(row.source["indistinguishable_from"]) if row.passes else (),
        )
        for row in rows
    ]


def _held_out_words(row: CandidateRow) -> list[str]:
    how = "whole runs" if row.source.get("heldout") == "run" else "every other frame"
    return [f"held-out error {row.held_out} ({how})"] if row.held_out else []


def candidate_table(rows: Sequence[CandidateRow], diagnosis: Mapping[str, Any]) -> tuple[TextTable, TextTable]:
    """Tables of the candidates that were found or cannot be told from those, and of the others.

    Parameters
    ----------
    rows : sequence of CandidateRow
        From `frictrack.candidates.candidate_rows`.
    diagnosis : mapping
        The JSON of the diagnosis, with the share of the misfit that each explains.

    """
    shares = {row["effect"]: row["explained_alone"] for row in diagnosis.get("importance") or []}
    heads = ("effect", "", "held-out error", "explains alone", "p", "delta BIC")
    shown = [row for row in rows if row.kind in MAIN_KINDS] or list(rows[:MAX_OTHERS_SHOWN])

    def table(listed: Sequence[CandidateRow]) -> TextTable:
        cells = [
            (
                Markup('<span class="mark {}"></span><code>{}</code>').format(row.kind, row.effect),
                row.standing,
                row.held_out,
                _share_of_misfit(shares.get(row.effect)),
                row.p,
                format_number(row.delta_bic),
            )
            for row in listed
        ]
        return make_table(heads, cells, (2, 3, 4, 5))

    return table(shown), table([row for row in rows if row not in shown])


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
