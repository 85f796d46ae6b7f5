"""Draw the evidence of a diagnosis: candidates, scans, detection limits, missing force; and that of runs to come."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import BoundaryNorm, ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from frictrack import effects
from frictrack.base.errors import FrictrackError
from frictrack.base.number_format import format_change, format_number, format_unit, join_words
from frictrack.present.plots import style
from frictrack.present.plots.inputs import AnySummary, as_summary
from frictrack.present.plots.style import axis_label, draw_band, new_figure, one_panel, styled
from frictrack.records import Array, Mask
from frictrack.results.candidates import AXES, STANDINGS, CandidateRow, candidate_rows

MAX_CANDIDATES = 12  # drawn; the table of the report has all
LOG_AXIS_RATIO = 30.0  # largest over smallest evidence, from which the axis is logarithmic
FAILS: dict[str, Any] = {"label": "explains less, or not significant", "fc": "white", "ec": "#777777", "hatch": "////"}
LOOKS: dict[str, dict[str, Any]] = {
    "named": {"label": STANDINGS["named"], "color": style.BLUE},
    "lead": {"label": STANDINGS["lead"], "color": style.SKY},
    "rival": {"label": "predicts the same data", "color": style.ORANGE},
    "weaker": {"label": "passes, with less evidence", "color": "#B5BCC2"},
    "fails": FAILS,
    "implausible": FAILS,
}  # kind of a candidate -> the look of its bar


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
    figure, ax = one_panel(0.36 * max(len(shown), 2) + 1.5, _candidates_title(rows))
    gains = np.array([max(row.delta_bic, 0.0) for row in shown])
    positive = gains[gains > 1]
    logarithmic = len(positive) > 1 and float(positive.max() / positive.min()) > LOG_AXIS_RATIO
    floor = 1.0 if logarithmic else 0.0
    same_p = len({row.p for row in shown}) == 1
    for y, (row, gain) in enumerate(zip(shown, gains, strict=True)):
        ax.barh(y, max(gain, floor) - floor, left=floor, height=0.62, **LOOKS[row.kind])
        ax.text(max(gain, floor), y, _candidate_label(row, with_p=not same_p), va="center", fontsize=9)
    if logarithmic:
        ax.set_xscale("log")
    top = max(float(gains.max(initial=0.0)), 1.0)
    ax.set_xlim(floor, top**1.45 if logarithmic else 1.45 * top)
    style.name_rows(ax, [row.effect for row in shown])
    ax.set_xlabel("evidence: delta BIC, logarithmic" if logarithmic else "evidence: delta BIC")
    common = [Patch(alpha=0.0, label=f"all have p {shown[0].p} for the whole search")] if same_p else []
    style.legend_below(figure, *common)
    return figure


def _candidate_label(row: CandidateRow, *, with_p: bool) -> str:
    p = f", p {row.p}" if with_p else ""
    held = "" if row.after is None else f", held-out error {format_number(row.after)} {row.unit}"
    return f" {format_change(row.delta_bic)}{p}{held}"


def _candidates_title(rows: Sequence[CandidateRow]) -> str:
    good = [row for row in rows if row.passes]
    if not good:
        return "No candidate is significant for the whole search"
    if rivals := good[0].source.get("indistinguishable_from"):
        return f"{good[0].effect} explains most, but {join_words(rivals)} cannot be distinguished from it"
    return f"{good[0].effect} explains most" + (f"; {len(good) - 1} more pass" if len(good) > 1 else "")


RESULT_CURVES = ("limit", "rise")  # curves of a candidate; the other curves are its settings
MIN_SETTINGS = 5  # over fewer values of a setting nothing is drawn


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
    name, at, _ = _over_setting(curves, "rise")
    return name if len(at) >= MIN_SETTINGS else None


def _over_setting(curves: Mapping[str, Array], result: str) -> tuple[str, Array, Array]:
    """Setting with the most values, these values (k,), and the largest result (k,) at each of them; else all empty."""
    settings = [name for name in curves if name not in RESULT_CURVES]
    if not settings or result not in curves:
        return "", np.zeros(0), np.zeros(0)
    name = max(settings, key=lambda setting: len(np.unique(curves[setting])))
    at, which = np.unique(curves[name], return_inverse=True)
    largest = np.full(len(at), -np.inf)
    np.maximum.at(largest, which, curves[result])
    return name, at, largest


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
    name, at, rise = _over_setting(curves, "rise")
    if len(at) < MIN_SETTINGS:
        raise ValueError(f'expected the scan of an effect but "{effect}" has no setting that was scanned')
    best = float(at[np.argmax(rise)])
    written = parameter_unit(effect, name)
    factor, shown = style.axis_scale(at, written)
    where = f"{format_number(factor * best, 2)} {format_unit(shown)}".strip()
    title = f"{effect} fits best at a {_setting_name(name)} near {where}"
    figure, ax = one_panel(3.2, title if width == style.PAGE_WIDTH_IN else f"{_setting_name(name)} near {where}", width)
    ax.fill_between(factor * at, rise, color=style.SKY, alpha=0.4, lw=0)
    ax.plot(factor * at, rise, color=style.BLUE, lw=1.2)
    ax.plot(factor * best, rise.max(), marker="v", color=style.VERMILION, markersize=8)
    _set_x_axis(ax, name, shown)
    ax.set(ylabel="fall of chi-squared", ylim=(0, None))
    return figure


def _setting_name(name: str) -> str:
    return {"x_c": "place", "w": "width", "v_s": "Stribeck velocity v_s"}.get(name, name)


def parameter_unit(effect: str, name: str) -> str:
    """Unit of a parameter of an effect; "" for an effect that a study defines itself."""
    try:
        return effects.get(effect).parameter(name).unit
    except (FrictrackError, StopIteration):
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
    return [e for e in diagnosis["detection_limits"] if e in figures and len(_scan_axis(figures[e])[1]) >= MIN_SETTINGS]


def _scan_axis(curves: Mapping[str, Array]) -> tuple[str, Array, Array]:
    """Setting with the most values, these values (n,), and the worst detection limit (n,) at each of them.

    Values at which no size is detectable are left out.
    """
    name, at, limit = _over_setting(curves, "limit")
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
    title = "Detection limits: 95 of 100 repeats detect a size above the line"
    figure, cells = style.panel_grid(len(shown), (1.9, 0.6), title, ("", ""))
    for (ax,), effect in zip(cells, shown, strict=True):
        _draw_limit(ax, effect, diagnosis["detection_limits"][effect]["unit"], figures[effect])
    return figure


def _draw_limit(ax: Axes, effect: str, written: str, curves: Mapping[str, Array]) -> None:
    name, at, limit = _scan_axis(curves)
    factor, shown = style.axis_scale(at, parameter_unit(effect, name))
    size, size_unit = style.axis_scale(limit, written)
    ax.plot(factor * at, size * limit, color=style.BLUE, lw=1.2)
    ax.fill_between(factor * at, size * limit, 1.3 * size * limit.max(), color=style.SKY, alpha=0.25, lw=0)
    if limit.max() / limit.min() >= 10:
        style.log_axis(ax, "y")
    ax.set_title(effect, fontweight="normal")
    ax.set_ylabel(axis_label("size", size_unit))
    _set_x_axis(ax, name, shown)


MAX_GAP_STEPS = 20.0  # median steps along an axis; a line has a gap where the step is longer
MAX_RUNS = 12  # drawn one by one; of more runs, those with the largest missing force
MARK_HEIGHT = 0.03  # of a panel's height, between the marks of two runs
FOOT_HEIGHT = 0.05  # of a panel's height, below the lowest mark
Rows = Mapping[str, Array]  # columns (n,) of the samples of all runs; `run` is the index of the run
Looks = Mapping[float, Mapping[str, Any]]  # how the line of a run is drawn, by its index


@styled
def missing_force(
    figures: Mapping[str, Mapping[str, Array]],
    spans: Sequence[Mapping[str, Any]],
    styles: Mapping[str, Mapping[str, Any]],
    repeats: Sequence[Mapping[str, Any]] = (),
) -> Figure:
    """Draw the missing force over time, place, speed, acceleration and phase: of at most 12 runs, and of all together.

    A black line shows the part that is common to all runs. Bands are two standard deviations wide on each side.

    Parameters
    ----------
    figures : mapping
        Curves of the stored diagnosis. `residual_force` has one row per sample of all runs: `run` (index), `F` and
        `sigma_F` in N, one column per axis, and the load if forces are drawn at the reference load; `common_<axis>` has
        `at`, `F` and `sigma_F`.
    spans : sequence of mappings
        Where the model fails; marked at the foot of every panel.
    styles : mapping
        Line styles of the fitted runs by name, in order.
    repeats : sequence of mappings
        Results of the repeatability tests, the clearest axis first.

    Raises
    ------
    KeyError
        If the diagnosis has no missing force; see `has_missing_force`.

    """
    whole, names = at_reference_load(figures["residual_force"]), list(styles)
    shown, kept = [name for name in AXES if name in whole], worst_runs(whole, "F", "sigma_F", MAX_RUNS)
    looks = {k: {"lw": 1.0, "alpha": 0.9, "label": names[int(k)], **styles[names[int(k)]]} for k in kept}
    n = len(np.unique(whole["run"]))
    figure = new_figure(5.4, force_title(repeats) + (f" ({len(kept)} runs of {n})" if len(kept) < n else ""))
    panels = figure.subplots(2, 3)
    shares = {r["axis"]: f"other runs predict {100 * r['share']:.0f} % of the misfit" for r in repeats}
    foot = FOOT_HEIGHT + MARK_HEIGHT * len(looks) if spans else 0.0
    for ax, name in zip(np.ravel(panels), shown, strict=False):
        label = draw_missing_force(ax, whole, name, figures.get(f"common_{name}"), looks, foot=foot)
        if name != "phase":
            _mark_spans(ax, whole, name, spans, looks)
        ax.locator_params(axis="x", nbins=6)
        ax.set_title(shares.get(name, ""), fontweight="normal", fontsize=9.5)
        ax.set_ylabel(label if ax in panels[:, 0] else "")
    for ax in np.ravel(panels)[len(shown) :]:
        ax.set_axis_off()
    handles = style.labelled(figure)
    np.ravel(panels)[len(shown)].legend(handles=handles, loc="center left", ncols=1 + len(handles) // 9)
    return figure


def worst_runs(rows: Rows, values: str, sigma: str, most: int) -> Array:
    """Select the runs to draw one by one: of many, those with the largest values over their error."""
    names, row = np.unique(rows["run"], return_inverse=True)
    mean = np.bincount(row, (rows[values] / rows[sigma]) ** 2) / np.bincount(row)
    return np.sort(names[np.argsort(-mean, kind="stable")[:most]])


def force_title(repeats: Sequence[Mapping[str, Any]]) -> str:
    """Title of the missing force: the axis over which it repeats."""
    if not repeats or not repeats[0]["holds"]:
        return "The missing force"
    return f"The missing force repeats with {AXES[repeats[0]['axis']].name}"


def at_reference_load(whole: Mapping[str, Array]) -> dict[str, Array]:
    """Divide the missing force by the load, if that is stored: runs then agree better."""
    load = whole.get("load", np.ones(1))
    return dict(whole) | {name: whole[name] / load for name in ("F", "sigma_F")}


def draw_missing_force(
    ax: Axes, whole: Rows, axis: str, common: Mapping[str, Array] | None, looks: Looks, *, foot: float = 0.0
) -> str:
    """Draw the missing force of some runs and of all together over an axis, with bands; return the label of the force.

    `foot` is the share of the panel's height that is left free below.
    """
    factor, unit = style.axis_scale(whole["F"], "N")
    scaled = dict(whole) | {key: factor * whole[key] for key in ("F", "sigma_F")}
    draw_runs(ax, scaled, axis, "F", looks, sigma="sigma_F")
    if common is not None:
        known = np.isfinite(common["F"])
        at, force, sigma = (np.asarray(common[key])[known] for key in ("at", "F", "sigma_F"))
        draw_band(ax, at, factor * force, factor * sigma, color="#000000", alpha=0.22, zorder=3)
        ax.plot(at, factor * force, color=style.BLACK, lw=1.8, zorder=4, label=f"all runs, {style.BAND_LABEL}")
    ax.axhline(0, color="#666666", lw=0.7, zorder=1)
    low, high = _force_limits(scaled)
    ax.set_ylim(low - 1.3 * foot * (high - low), high)
    label = style.motion_label(axis)
    if axis == "phase" and "frequency" in whole:
        label = label.replace(" / ", f" at {format_number(float(whole['frequency'][0]))} Hz / ")
    ax.set_xlabel(label)
    return axis_label("missing force\nat reference load" if "load" in whole else "missing force", unit)


def _force_limits(whole: Rows) -> tuple[float, float]:
    """Limits of the force axis; a band wider than the force itself does not set them."""
    usual = float(np.median(whole["sigma_F"]))
    room = style.BAND_SIGMAS * np.minimum(whole["sigma_F"], np.abs(whole["F"]) / 4 + usual)
    low, high = float(np.min(whole["F"] - room)), float(np.max(whole["F"] + room))
    margin = 0.05 * max(high - low, 1e-12)
    return min(low, 0.0) - margin, max(high, 0.0) + margin


def draw_runs(ax: Axes, rows: Rows, axis: str, values: str, looks: Looks, *, sigma: str = "") -> None:
    """Draw a column over an axis, one line for each of some runs, with a band and with gaps where the axis jumps."""
    for k, look in looks.items():
        mine = rows["run"] == k
        x = rows[axis][mine]
        steps = np.abs(np.diff(x, prepend=x[0]))
        usual = 0.5 if axis == "phase" else MAX_GAP_STEPS * max(float(np.median(steps)), 1e-12)
        shown = style.masked(rows[values][mine], steps <= usual)
        if sigma:
            draw_band(ax, x, shown, rows[sigma][mine], color=look["color"], alpha=0.12, zorder=1.5)
        ax.plot(x, shown, **{"zorder": 2, **look})


def _mark_spans(ax: Axes, whole: Rows, name: str, spans: Sequence[Mapping[str, Any]], looks: Looks) -> None:
    """Draw a bar for every span at the foot of the panel, in its run's colour."""
    places = {look["label"]: (k, i) for i, (k, look) in enumerate(looks.items())}
    for s in (s for s in spans if s["run"] in places):
        k, i = places[s["run"]]
        inside = (whole["run"] == k) & _within(whole["x"], s["x"]) & _within(whole["v"], sorted(map(abs, s["v"])))
        if inside.any():
            reach, y = whole[name][inside], FOOT_HEIGHT / 2 + MARK_HEIGHT * i
            bar: dict[str, Any] = {"color": looks[k]["color"], "lw": 3.0, "solid_capstyle": "butt", "zorder": 5}
            bar |= {"transform": ax.get_xaxis_transform(), "label": "fails here (bars below)"}
            ax.plot([reach.min(), reach.max()], [y, y], **bar)


def _within(values: Array, reach: Sequence[float]) -> Mask:
    room = 1e-6 + 1e-3 * (reach[1] - reach[0])
    return np.asarray((values >= reach[0] - room) & (values <= reach[1] + room))


SIDES = {"L * s": "resisting motion, with the load", "s": "resisting motion", "": "independent of the direction"}
SIGNAL_NAMES = {"vertical": "vertical motion", "accelerometer": "the accelerometer"}


@styled
def unexplained(found: Mapping[str, Any]) -> Figure:
    """Draw the force that no effect explains over the axis along which it repeats best, with two standard deviations.

    Parameters
    ----------
    found : mapping
        The `unexplained` part of a diagnosis: `axis`, `curve` (n, 2) of axis and force in N, and `band` (n,), the
        standard deviation of the force.

    """
    curve, axis = np.asarray(found["curve"], dtype=float), found["axis"]
    figure, ax = one_panel(3.4, f"Unexplained force over {AXES[axis].name}, {SIDES[found.get('factor', '')]}")
    ax.axhline(0, color="#666666", lw=0.7)
    if found.get("band"):
        draw_band(ax, curve[:, 0], curve[:, 1], np.asarray(found["band"]), color=style.VERMILION, alpha=0.2)
    ax.plot(*curve.T, color=style.VERMILION, lw=1.8)
    label = axis_label("phase of the motion", "rad") if axis == "phase" else style.motion_label(axis)
    ax.set(xlabel=label, ylabel="unexplained force / N")
    ax.margins(x=0)
    return figure


@styled
def correlated_signal(evidence: Mapping[str, Any], curve: Mapping[str, Array]) -> Figure:
    """Draw the residual of one run and the part that another measured signal predicts.

    Parameters
    ----------
    evidence : mapping
        One entry of the diagnosis' `evidence`: `shown` (name of the run), `kind` and `name` of the signal.
    curve : mapping
        `t` in s, `left` (residual) and `told` (predicted part) in m, all (n,).

    """
    source = evidence["name"] or SIGNAL_NAMES[evidence["kind"]]
    figure, ax = one_panel(3.0, f"{evidence['shown']}: residual, and the part that {source} predicts")
    factor, unit = style.axis_scale(np.asarray(curve["left"]), "m")
    ax.axhline(0, color="#666666", lw=0.7)
    ax.plot(curve["t"], factor * curve["left"], color="#777777", lw=1.0, label="residual")
    ax.plot(curve["t"], factor * curve["told"], color=style.BLUE, lw=1.6, label=f"predicted by {source}")
    ax.set(xlabel=style.motion_label("t"), ylabel=axis_label("displacement", unit))
    ax.margins(x=0)
    return figure


UNSEEN = -1.0  # value of a pair of which one effect is not detectable
SEPARATION_LEVELS = (-2.0, 0.0, 1.0, 10.0, 100.0, 1e3, 1e12)
# browns: not separated; greens: separated
SEPARATION_COLOURS = ("#e3e5e7", "#8c2d04", "#fe9929", "#d9f0d3", "#7fbf7b", "#1b7837")
SEPARATION_LABELS = ("not detectable", "below 1", "1 to 10", "10 to 100", "100 to 1000", "above 1000")


@styled
def pair_separation(plan: Mapping[str, Any]) -> Figure:
    """Draw the expected difference of chi-squared between any two effects with all planned runs.

    Parameters
    ----------
    plan : mapping
        The JSON of a plan.

    """
    names = plan["evidence"]["effects"]
    table = np.array([[np.nan if e is None else e for e in row] for row in plan["evidence"]["table"]])
    hidden = np.isin(names, [one["effect"] for one in plan["unseen"]])
    table[hidden | hidden[:, None]] = UNSEEN
    table[np.triu_indices(len(names))] = np.nan
    figure, ax = one_panel(0.29 * len(names) + 2.2, "Expected evidence between any two effects with these runs")
    picture = ax.imshow(
        table[1:, :-1],
        cmap=ListedColormap(list(SEPARATION_COLOURS)),
        norm=BoundaryNorm(SEPARATION_LEVELS, len(SEPARATION_COLOURS)),
    )
    ax.set_xticks(range(len(names) - 1), names[:-1], rotation=55, ha="right", rotation_mode="anchor")
    ax.set_yticks(range(len(names) - 1), names[1:])
    ax.tick_params(length=0)
    ax.spines[:].set_visible(False)
    _draw_cell_borders(ax, len(names) - 1)
    bar = figure.colorbar(picture, ax=ax, shrink=0.5, ticks=[], pad=0.02)
    bar.outline.set_visible(False)
    for k, words in enumerate(SEPARATION_LABELS):
        bar.ax.text(1.4, (k + 0.5) / len(SEPARATION_LABELS), words, transform=bar.ax.transAxes, va="center", fontsize=9)
    bar.ax.set_title("expected chi²", fontsize=9, fontweight="normal", loc="left")
    return figure


def _draw_cell_borders(ax: Axes, n: int) -> None:
    """White lines between the cells."""
    ax.set_xticks(np.arange(n + 1) - 0.5, minor=True)
    ax.set_yticks(np.arange(n + 1) - 0.5, minor=True)
    ax.grid(which="minor", color="white", lw=1.5)
    ax.tick_params(which="minor", length=0)


MIN_DELTA_BIC = 10.0  # expected difference of BIC from which two effects are distinguished
MARKERS = ("o", "s", "^", "D", "v", "P")
MIN_SHOWN_BIC = 2.0  # where the axis begins


@styled
def next_experiments(steps: Sequence[Mapping[str, Any]]) -> Figure:
    """Draw one row per experiment and one marker per effect: the evidence for that effect if it is the true one.

    Parameters
    ----------
    steps : sequence of mappings
        Proposed experiments, best first: `key`, and `expected_if_true`, the expected difference of BIC by effect.

    """
    figure, ax = one_panel(0.36 * len(steps) + 1.5, f"Best next: {steps[0]['key']}")
    names = list(dict.fromkeys(name for step in steps for name in step["expected_if_true"]))
    for row, step in enumerate(steps):
        ends = [max(e, MIN_SHOWN_BIC) for e in step["expected_if_true"].values()]
        ax.plot([min(ends), max(ends)], [row, row], color="#999999", lw=1.0, zorder=1)
    for k, name in enumerate(names):
        rows = [row for row, step in enumerate(steps) if name in step["expected_if_true"]]
        evidence = [max(steps[row]["expected_if_true"][name], MIN_SHOWN_BIC) for row in rows]
        color, marker = style.RUN_STYLES[k % len(style.RUN_STYLES)]["color"], MARKERS[k % len(MARKERS)]
        ax.plot(evidence, rows, ls="none", marker=marker, color=color, ms=8, label=f"if {name} is true")
    ax.axvline(MIN_DELTA_BIC, color=style.MEASURED_COLOUR, lw=1.0, linestyle="--")
    style.note(ax, "distinguished", (MIN_DELTA_BIC, -0.62), (4, 0), va="center")
    ax.set_xscale("log")
    style.name_rows(ax, [f"{k}. {step['key']}" for k, step in enumerate(steps, 1)], top=-0.85)
    ax.set_xlabel("expected difference of BIC from the nearest of the others")
    figure.legend(loc="outside right upper")
    return figure
