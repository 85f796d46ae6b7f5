"""Draw the evidence for each candidate effect, for each size of one effect, and the detection limits."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from frictrack import effects
from frictrack.base.errors import FrictrackError
from frictrack.base.number_format import format_change, format_number, format_unit, join_words
from frictrack.present.plots import style
from frictrack.present.plots.inputs import AnySummary, as_summary
from frictrack.present.plots.style import axis_label, new_figure, styled
from frictrack.records import Array
from frictrack.results.candidates import CandidateRow, candidate_rows

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
    or failing (hatched). At most `MAX_CANDIDATES` are drawn.

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
    handles = [Patch(label=name, **look) for name, look in dict(LOOKS[row.kind] for row in shown).items()]
    if same_p:
        handles.append(Patch(alpha=0.0, label=f"all have p {shown[0].p} for the whole search"))
    if handles:
        style.legend_below(figure, handles)
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


RESULT_CURVES = ("limit", "rise")  # curves of a candidate; the other curves are its settings


def has_scan(curves: Mapping[str, Array]) -> str | None:
    """Select the setting over which `scan` draws.

    Parameters
    ----------
    curves : mapping
        Settings of a candidate and the fall of chi-squared, `rise`, all (n,).

    Returns
    -------
    str or None
        Name of the scanned setting with the most values; None if there is nothing to draw.

    """
    if "rise" not in curves:
        return None
    settings = [name for name in curves if name not in RESULT_CURVES and len(np.unique(curves[name])) > 4]
    return max(settings, key=lambda name: len(np.unique(curves[name])), default=None)


@styled
def scan(effect: str, curves: Mapping[str, Array], width: float = style.PAGE_WIDTH_IN) -> Figure:
    """Draw how far chi-squared falls with an effect, over the setting that was scanned.

    Other settings have their best values.

    Parameters
    ----------
    effect : str
        Name of the effect.
    curves : mapping
        Its settings and the fall of chi-squared, `rise`, all (n,).
    width : float
        Width of the figure, inches.

    Raises
    ------
    ValueError
        If no setting of the effect was scanned.

    """
    name = has_scan(curves)
    if name is None:
        raise ValueError(f'expected the scan of an effect but "{effect}" has no setting that was scanned')
    at, rise = envelope(curves[name], curves["rise"], np.maximum)
    best = float(at[np.argmax(rise)])
    written = _unit(effect, name)
    factor, shown = style.axis_scale(at, written)
    where = f"{format_number(factor * best, 2)} {format_unit(shown)}".strip()
    title = f"{effect} fits best at a {_setting_name(name)} near {where}"
    figure = new_figure(3.2, title if width == style.PAGE_WIDTH_IN else f"{_setting_name(name)} near {where}", width)
    ax = figure.subplots()
    ax.fill_between(factor * at, rise, color=style.SKY, alpha=0.4, lw=0)
    ax.plot(factor * at, rise, color=style.BLUE, lw=1.2)
    ax.plot(factor * best, rise.max(), marker="v", color=style.VERMILION, markersize=8)
    _set_x_axis(ax, name, shown)
    ax.set(ylabel="fall of chi-squared", ylim=(0, None))
    return figure


def envelope(at: Array, values: Array, best: Any) -> tuple[Array, Array]:
    """Select the best value at each setting.

    Parameters
    ----------
    at : Array
        (n,) setting.
    values : Array
        (n,) values, at all combinations with other settings.
    best : ufunc
        `np.maximum` or `np.minimum`.

    Returns
    -------
    places : Array
        (k,) distinct settings, sorted.
    out : Array
        (k,) best value at each of them.

    """
    places, which = np.unique(at, return_inverse=True)
    out = np.full(len(places), -np.inf if best is np.maximum else np.inf)
    best.at(out, which, values)
    return places, out


def _setting_name(name: str) -> str:
    return {"x_c": "place", "w": "width", "v_s": "Stribeck velocity v_s"}.get(name, name.replace("_", " "))


def _unit(effect: str, name: str) -> str:
    try:
        return effects.get(effect).parameter(name).unit
    except (FrictrackError, StopIteration):  # an effect that a study defines itself
        return ""


def _set_x_axis(ax: Axes, name: str, written: str) -> None:
    """Set up the axis of a setting; frequencies and periods are logarithmic, with plain numbers at the ticks."""
    if name in ("frequency", "period"):
        style.log_axis(ax, "x")
    ax.set_xlabel(axis_label(_setting_name(name), written))
    ax.margins(x=0.01)


def has_limits(diagnosis: Mapping[str, Any], figures: Mapping[str, Mapping[str, Array]]) -> list[str]:
    """Select the effects whose detection limit can be drawn over a setting.

    Parameters
    ----------
    diagnosis : mapping
        A diagnosis with its `detection_limits`.
    figures : mapping
        Curves of the stored diagnosis by effect.

    Returns
    -------
    list of str
        Names of the effects.

    """
    return [e for e in diagnosis["detection_limits"] if e in figures and len(_scan_axis(figures[e])[1]) > 4]


def _scan_axis(curves: Mapping[str, Array]) -> tuple[str, Array, Array]:
    """Setting with the most values, these values (n,), and the worst detection limit (n,) at each of them.

    Values at which no size is detectable are left out.
    """
    settings = [name for name in curves if name not in RESULT_CURVES]
    if not settings:
        return "", np.empty(0), np.empty(0)
    name = max(settings, key=lambda n: len(np.unique(curves[n])))
    at, limit = envelope(curves[name], curves["limit"], np.maximum)
    good = np.isfinite(limit) & (limit > 0)
    return name, at[good], limit[good]


@styled
def limits(diagnosis: AnySummary, figures: Mapping[str, Mapping[str, Array]] | None = None) -> Figure:
    """Draw the detection limit of each effect over the setting on which it depends, one panel per effect.

    Parameters
    ----------
    diagnosis : mapping or Diagnosis
        A diagnosis with its `detection_limits`.
    figures : mapping, optional
        Curves of the stored diagnosis by effect; a Diagnosis has its own.

    Raises
    ------
    ValueError
        If no limit depends on a setting.

    """
    figures = getattr(diagnosis, "figures", {}) if figures is None else figures
    diagnosis = as_summary(diagnosis)
    shown = has_limits(diagnosis, figures)
    if not shown:
        raise ValueError("expected the curve of a detection limit but got none")
    columns = style.panel_columns(len(shown))
    rows = -(-len(shown) // columns)
    figure = new_figure(1.9 * rows + 0.6, "Detection limits: 95 of 100 repeats detect an amplitude above the line")
    panels = figure.subplots(rows, columns, squeeze=False)
    for ax, effect in zip(np.ravel(panels), shown, strict=False):
        _limit(ax, effect, diagnosis["detection_limits"][effect]["unit"], figures[effect])
    for ax in np.ravel(panels)[len(shown) :]:
        ax.set_axis_off()
    return figure


def _limit(ax: Axes, effect: str, written: str, curves: Mapping[str, Array]) -> None:
    name, at, limit = _scan_axis(curves)
    factor, shown = style.axis_scale(at, _unit(effect, name))
    size, size_unit = style.axis_scale(limit, written)
    ax.plot(factor * at, size * limit, color=style.BLUE, lw=1.2)
    ax.fill_between(factor * at, size * limit, 1.3 * size * limit.max(), color=style.SKY, alpha=0.25, lw=0)
    if limit.max() / limit.min() >= 10:
        style.log_axis(ax, "y")
    ax.set_title(effect, fontweight="normal")
    ax.set_ylabel(axis_label("amplitude", size_unit))
    _set_x_axis(ax, name, shown)
