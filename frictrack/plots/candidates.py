"""Draw the evidence for each candidate effect, and say which candidates pass."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from frictrack.number_format import format_change, format_number
from frictrack.plots import style
from frictrack.plots.inputs import AnySummary, as_summary
from frictrack.plots.style import new_figure, styled
from frictrack.records import Array

MAX_P = 0.005  # half of alpha = 0.01, the half that the candidates get
MAX_CANDIDATES = 12  # drawn; the table of the report has all
LOG_AXIS_RATIO = 30.0  # largest over smallest evidence, from which the axis is logarithmic


def passes(candidate: Mapping[str, Any]) -> bool:
    """Whether a candidate is significant for the whole search, confirmed by its simulated fit, and plausible.

    Parameters
    ----------
    candidate : mapping
        A candidate of a diagnosis: `passes`; in results of older versions `p`, `delta_bic` and, where it is not
        plausible, `implausible`.

    Examples
    --------
    >>> passes({"p": 0.001, "delta_bic": 40.0}), passes({"p": 0.2, "delta_bic": 40.0})
    (True, False)

    """
    if "passes" in candidate:
        return bool(candidate["passes"])
    return bool(candidate["p"] < MAX_P and candidate["delta_bic"] > 0 and not candidate.get("implausible"))


@styled
def candidates(diagnosis: AnySummary) -> Figure:
    """Draw delta BIC of the candidates as bars, the smallest held-out error on top.

    The colour says what a candidate means: found, not distinguishable from what was found, passing with less evidence,
    or failing (hatched). At most `MAX_CANDIDATES` are drawn. A bracket joins candidates that these runs cannot
    distinguish.

    Parameters
    ----------
    diagnosis : mapping or Diagnosis
        A diagnosis with its `candidates`.

    """
    diagnosis = as_summary(diagnosis)
    found = sorted(diagnosis["candidates"], key=held_out_order)[:MAX_CANDIDATES]
    figure = new_figure(0.36 * max(len(found), 2) + 1.5, _candidates_title(diagnosis))
    ax = figure.subplots()
    gains = np.array([max(c["delta_bic"], 0.0) for c in found])
    logarithmic = _needs_log_axis(gains)
    floor = 1.0 if logarithmic else 0.0
    same_p = len({c["p"] for c in found}) == 1
    used: dict[str, dict[str, Any]] = {}
    for y, c in enumerate(found):
        name, look = _candidate_look(c, diagnosis)
        used[name] = look
        ax.barh(y, max(c["delta_bic"], floor) - floor, left=floor, height=0.62, **look)
        ax.text(max(c["delta_bic"], floor), y, _candidate_label(c, with_p=not same_p), va="center", fontsize=9)
    if logarithmic:
        ax.set_xscale("log")
    top = float(gains.max()) if len(gains) and gains.max() > 0 else 1.0
    ax.set_xlim(floor, top ** (1.45) if logarithmic else 1.45 * top)
    ax.set_yticks(range(len(found)), [c["effect"] for c in found])
    ax.set_ylim(len(found) - 0.4, -0.6)
    ax.set_xlabel("evidence: delta BIC, logarithmic" if logarithmic else "evidence: delta BIC")
    _draw_brackets(ax, found)
    handles = [Patch(label=name, **look) for name, look in used.items()]
    if same_p:
        handles.append(Patch(alpha=0.0, label=f"all have p = {format_number(found[0]['p'], 1)} for the whole search"))
    if handles:
        figure.legend(handles=handles, loc="outside lower left", ncols=len(handles))
    return figure


def held_out_order(candidate: Mapping[str, Any]) -> tuple[bool, float, float]:
    """Sort key of a candidate: by held-out error, those without one last, by their evidence.

    Examples
    --------
    >>> held_out_order({"heldout_rms_after_um": 10.2, "delta_bic": 812.0})
    (False, 10.2, -812.0)

    """
    errors = (candidate.get(f"heldout_rms_after_{unit}") for unit in ("um", "N"))
    error = next((e for e in errors if e is not None), None)
    return error is None, 0.0 if error is None else error, -candidate["delta_bic"]


def _candidate_look(c: Mapping[str, Any], diagnosis: Mapping[str, Any]) -> tuple[str, dict[str, Any]]:
    """What a candidate means, and the look of its bar."""
    if not passes(c):
        return "does not pass", {"fc": "white", "ec": "#777777", "hatch": "////"}
    best = diagnosis["candidates"][0]
    if c["effect"] in diagnosis["missing"] or (c is best and not diagnosis["missing"]):
        return "found", {"color": style.BLUE}
    if c["effect"] in best["indistinguishable_from"]:
        return "predicts the same data", {"color": style.ORANGE}
    return "passes, with less evidence", {"color": "#B5BCC2"}


def _candidate_label(c: Mapping[str, Any], *, with_p: bool) -> str:
    p = f", p = {format_number(c['p'], 1)}" if with_p else ""
    errors = ((c.get(f"heldout_rms_after_{key}"), unit) for key, unit in (("um", "µm"), ("N", "N")))
    held = next((f", held-out error {format_number(e)} {unit}" for e, unit in errors if e is not None), "")
    return f" {format_change(c['delta_bic'])}{p}{held}"


def _needs_log_axis(gains: Array) -> bool:
    positive = gains[gains > 1]
    return len(positive) > 1 and float(positive.max() / positive.min()) > LOG_AXIS_RATIO


def _candidates_title(diagnosis: Mapping[str, Any]) -> str:
    good = [c["effect"] for c in diagnosis["candidates"] if passes(c)]
    if not diagnosis["candidates"]:
        return "No effect of the library could be tried"
    if not good:
        return "No candidate is significant for the whole search"
    rivals = diagnosis["candidates"][0].get("indistinguishable_from") or []
    if rivals:
        return f"{good[0]} explains most, but {' and '.join(rivals)} cannot be distinguished from it"
    return f"{good[0]} explains most" + (f", {len(good) - 1} more pass with less evidence" if len(good) > 1 else "")


def _draw_brackets(ax: Axes, found: Sequence[Mapping[str, Any]]) -> None:
    """Draw a bracket at the right of each group whose members predict the same data."""
    drawn: set[frozenset[int]] = set()
    for c in found:
        group = _peers(found, c)
        if len(group) < 2 or any(group <= earlier for earlier in drawn):
            continue
        x = 0.985 - 0.03 * len(drawn)
        drawn.add(group)
        across = ax.get_yaxis_transform()
        ax.plot([x, x], [min(group), max(group)], transform=across, color="black", lw=1.5)
        for y in group:
            ax.plot([x - 0.012, x], [y, y], transform=across, color="black", lw=1.5)
        ax.text(
            x - 0.018, (min(group) + max(group)) / 2, "cannot be\ndistinguished",
            transform=across, ha="right", va="center", fontsize=8.5, style="italic",
        )  # fmt: skip


def _peers(found: Sequence[Mapping[str, Any]], c: Mapping[str, Any]) -> frozenset[int]:
    """Rows of a passing candidate and of its rivals; a better rival counts only if it names this one too."""
    place = found.index(c)
    named = [
        y
        for y, other in enumerate(found)
        if other["effect"] in c["indistinguishable_from"]
        and (y > place or c["effect"] in other["indistinguishable_from"])
    ]
    return frozenset((place, *named)) if passes(c) else frozenset()
