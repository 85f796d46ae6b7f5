"""Draw the evidence for each candidate effect."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from frictrack.candidates import CandidateRow, candidate_rows
from frictrack.number_format import format_change, format_number, join_words
from frictrack.plots import style
from frictrack.plots.inputs import AnySummary, as_summary
from frictrack.plots.style import new_figure, styled
from frictrack.records import Array

MAX_CANDIDATES = 12  # drawn; the table of the report has all
LOG_AXIS_RATIO = 30.0  # largest over smallest evidence, from which the axis is logarithmic
FAILS: tuple[str, dict[str, Any]] = ("does not pass", {"fc": "white", "ec": "#777777", "hatch": "////"})
LOOKS: dict[str, tuple[str, dict[str, Any]]] = {
    "named": ("found", {"color": style.BLUE}),
    "lead": ("explains a part", {"color": style.SKY}),
    "rival": ("predicts the same data", {"color": style.ORANGE}),
    "weaker": ("passes, with less evidence", {"color": "#B5BCC2"}),
    "fails": FAILS,
    "implausible": FAILS,
}  # kind of a candidate -> its name in the legend, and the look of its bar


@styled
def candidates(diagnosis: AnySummary) -> Figure:
    """Draw delta BIC of the candidates as bars, in the order of the list of candidates.

    The colour says what a candidate means: found, not distinguishable from what was found, passing with less evidence,
    or failing (hatched). At most `MAX_CANDIDATES` are drawn. A bracket joins candidates that these runs cannot
    distinguish.

    Parameters
    ----------
    diagnosis : mapping or Diagnosis
        A diagnosis with its `candidates`.

    """
    rows = candidate_rows(as_summary(diagnosis))
    shown = rows[:MAX_CANDIDATES]
    figure = new_figure(0.36 * max(len(shown), 2) + 1.5, _candidates_title(rows))
    ax = figure.subplots()
    gains = np.array([max(row.delta_bic, 0.0) for row in shown])
    logarithmic = _needs_log_axis(gains)
    floor = 1.0 if logarithmic else 0.0
    same_p = len({row.p for row in shown}) == 1
    for y, (row, gain) in enumerate(zip(shown, gains, strict=True)):
        ax.barh(y, max(gain, floor) - floor, left=floor, height=0.62, **LOOKS[row.kind][1])
        ax.text(max(gain, floor), y, _candidate_label(row, with_p=not same_p), va="center", fontsize=9)
    if logarithmic:
        ax.set_xscale("log")
    top = max(float(gains.max(initial=0.0)), 1.0)
    ax.set_xlim(floor, top**1.45 if logarithmic else 1.45 * top)
    ax.set_yticks(range(len(shown)), [row.effect for row in shown])
    ax.set_ylim(len(shown) - 0.4, -0.6)
    ax.set_xlabel("evidence: delta BIC, logarithmic" if logarithmic else "evidence: delta BIC")
    _draw_brackets(ax, shown)
    handles = [Patch(label=name, **look) for name, look in dict(LOOKS[row.kind] for row in shown).items()]
    if same_p:
        handles.append(Patch(alpha=0.0, label=f"all have p {shown[0].p} for the whole search"))
    if handles:
        figure.legend(handles=handles, loc="outside lower left", ncols=len(handles))
    return figure


def _candidate_label(row: CandidateRow, *, with_p: bool) -> str:
    p = f", p {row.p}" if with_p else ""
    held = "" if row.after is None else f", held-out error {format_number(row.after)} {row.unit}"
    return f" {format_change(row.delta_bic)}{p}{held}"


def _needs_log_axis(gains: Array) -> bool:
    positive = gains[gains > 1]
    return len(positive) > 1 and float(positive.max() / positive.min()) > LOG_AXIS_RATIO


def _candidates_title(rows: Sequence[CandidateRow]) -> str:
    good = [row for row in rows if row.passes]
    if not good:
        return "No candidate is significant for the whole search"
    rivals = good[0].source.get("indistinguishable_from") or []
    if rivals:
        return f"{good[0].effect} explains most, but {join_words(rivals)} cannot be distinguished from it"
    return f"{good[0].effect} explains most" + (f"; {len(good) - 1} more pass" if len(good) > 1 else "")


def _draw_brackets(ax: Axes, rows: Sequence[CandidateRow]) -> None:
    """Draw a bracket at the right of each group whose members predict the same data: an effect and its rivals."""
    groups = {_group(rows, y) for y, row in enumerate(rows) if row.passes}
    largest = [group for group in groups if len(group) > 1 and not any(group < other for other in groups)]
    for k, group in enumerate(sorted(largest, key=min)):
        x, across = 0.985 - 0.03 * k, ax.get_yaxis_transform()
        ax.plot([x, x], [min(group), max(group)], transform=across, color="black", lw=1.5)
        for y in group:
            ax.plot([x - 0.012, x], [y, y], transform=across, color="black", lw=1.5)
        ax.text(
            x - 0.018, (min(group) + max(group)) / 2, "cannot be\ndistinguished",
            transform=across, ha="right", va="center", fontsize=8.5, style="italic",
        )  # fmt: skip


def _group(rows: Sequence[CandidateRow], y: int) -> frozenset[int]:
    """Rows of a candidate and of its rivals; a better rival counts only if it names this one too."""
    named = rows[y].source["indistinguishable_from"]
    return frozenset(
        k
        for k, row in enumerate(rows)
        if k == y or (row.effect in named and (k > y or rows[y].effect in row.source["indistinguishable_from"]))
    )
