"""Draw errors of the measurement: error budget of the friction force, noise and lost signal over the cut-off."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from frictrack.base.number_format import format_number, format_range, format_unit
from frictrack.measure.motion import FilteredMotion, compare_filters
from frictrack.present.plots import style
from frictrack.present.plots.inputs import AnyRun, as_run
from frictrack.present.plots.measured import SHORT_LABELS, TIME_LABEL
from frictrack.present.plots.style import RUN_STYLES, axis_label, draw_band, new_figure, panel_grid, styled
from frictrack.records import Array, CutoffTradeOff
from frictrack.results import RunResults

MARKERS = ("o", "s", "^")  # of the first six runs, the next six, and so on
NEGLIGIBLE_SHARE = 2e-3  # of the largest source


def budget(name: str, found: Mapping[str, Any]) -> Figure:
    """Draw the error budget of one run: one row per source, and one for the total.

    Parameters
    ----------
    name : str
        Name of the run.
    found : mapping
        Error budget of the run. Its `rows`, the total last, have `source` and the standard deviations `mean_N` of the
        mean force (left) and `frame_N` of one frame (right), N; None where a source is not known.

    """
    return budgets({name: found})


@styled
def budgets(found: Mapping[str, Mapping[str, Any]]) -> Figure:
    """Draw the error budgets of several runs: one row per source, one mark per run.

    Parameters
    ----------
    found : mapping
        Error budget by run; see `budget`.

    """
    sources = list(dict.fromkeys(row["source"] for one in found.values() for row in one["rows"]))
    sources.sort(key=lambda source: source == "total")
    figure = new_figure(0.25 * len(sources) + 1.45, budgets_title(found))
    left, right = figure.subplots(1, 2, sharey=True)
    for ax, key, label in ((left, "mean_N", "error of the mean force"), (right, "frame_N", "error of a frame, rms")):
        for k, (name, one) in enumerate(found.items()):
            sizes = [(row[key] or 0.0, sources.index(row["source"])) for row in one["rows"]]
            least = NEGLIGIBLE_SHARE * max(sizes)[0]  # what is not known or negligible has no mark
            known = [(size, place) for size, place in sizes if size > 0 and size >= least]
            named = {"label": name if len(found) <= len(RUN_STYLES) else ""}
            ax.plot([size for size, _ in known], [place for _, place in known], **(_mark(k) | named))
            for mark in known if len(found) == 1 else ():
                style.note(ax, format_number(mark[0], 2), mark, (7, 3), fontsize=8.5)
        style.log_axis(ax, "x")
        _say_what_is_absent(ax, found, key, sources)
        ax.grid(axis="y", color="#E4E7EA", lw=0.8)
        ax.set_xlabel(axis_label(label, "N"))
    style.name_rows(left, sources)
    return figure


def budgets_title(found: Mapping[str, Mapping[str, Any]]) -> str:
    """Title of `budgets`: the total over the runs, and the source that is the largest in most of them."""
    totals = [one["rows"][-1]["mean_N"] for one in found.values()]
    largest = [max(one["rows"][:-1], key=lambda row: row["mean_N"] or 0.0)["source"] for one in found.values()]
    error = format_range([total for total in totals if total is not None])
    return f"Standard deviation of the mean force {error} N; largest source: {max(set(largest), key=largest.count)}"


def _say_what_is_absent(ax: Axes, found: Mapping[str, Mapping[str, Any]], key: str, sources: Sequence[str]) -> None:
    """Write at the left of a row without marks whether its source is not known or negligible."""
    for place, source in enumerate(sources):
        rows = [row for one in found.values() for row in one["rows"] if row["source"] == source]
        if not any(row[key] for row in rows):
            words = "not known" if any(row[key] is None for row in rows) else "none"
            look: dict[str, Any] = {"va": "center", "fontsize": 8.5, "style": "italic", "color": "#666666"}
            box = {"facecolor": "white", "edgecolor": "none", "pad": 2}
            style.note(ax, words, (0.0, place), (6, 0), xycoords=("axes fraction", "data"), bbox=box, **look)


def _mark(k: int) -> dict[str, Any]:
    """Look of the k-th run: colour and marker."""
    look = RUN_STYLES[k % len(RUN_STYLES)]
    return {"color": look["color"], "marker": MARKERS[k // 6 % len(MARKERS)], "ls": "none", "ms": 6, "alpha": 0.85}


MAX_PANELS = 8  # runs drawn as small multiples
CUTOFF_LABEL = "cut-off frequency / Hz"
FILTER_LOOKS: tuple[dict[str, Any], ...] = (
    {"color": "#999999", "lw": 0.6},
    {"color": style.VERMILION, "lw": 1.2},
    {"color": style.MEASURED_COLOUR, "lw": 1.4},
)


@styled
def cutoff(name: str, found: CutoffTradeOff, mass: float | None = None) -> Figure:
    """Draw the residual analysis (above) and the sum of noise and lost signal (below) over the cut-off frequency.

    Parameters
    ----------
    name : str
        Name of the run.
    found : Trade
        Errors of the acceleration over the cut-off frequency.
    mass : float, optional
        Mass, kg. With it errors are forces in N, without it accelerations in m/s².

    References
    ----------
    D. A. Winter (2009): Biomechanics and Motor Control of Human Movement, 4th ed., residual analysis.

    """
    factor, unit = (1.0, "m/s^2") if mass is None else (mass, "N")
    title, error = _cutoff_title(name, found, factor, unit), axis_label("error of m a" if mass else "error of a", unit)
    labels, width = (CUTOFF_LABEL, "residual / µm", error), style.PAGE_WIDTH_IN / 2
    figure, ((above, below),) = panel_grid(1, (5.4, 0.0), title, labels, width=width, sharex=True)
    f = found.frequency
    above.loglog(f, 1e6 * found.residual, color=style.MEASURED_COLOUR, lw=1.6, label="removed by the filter")
    above.loglog(f, 1e6 * found.floor, color=style.BLUE, lw=1.3, ls="--", label="noise alone")
    _draw_errors(below, found, factor)
    above.axvline(found.chosen, color=style.ORANGE, lw=2.0, zorder=0)
    for ax in (above, below):
        ax.legend(fontsize=8, loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=2)  # a curve may run anywhere inside
    chosen = f"{format_number(found.chosen)} Hz"
    style.note(above, chosen, (found.chosen, 1.0), (3, -10), xycoords=("data", "axes fraction"), fontsize=8)
    return figure


@styled
def cutoffs(found: Mapping[str, tuple[CutoffTradeOff, float | None]]) -> Figure:
    """Draw, for several runs, the error of the force over the cut-off frequency: one panel each.

    Parameters
    ----------
    found : mapping
        Errors of the acceleration over the cut-off frequency, and the mass in kg (None without), by run. The first
        `MAX_PANELS` are drawn.

    """
    shown = list(found.items())[:MAX_PANELS]
    drawn = f"; the first {MAX_PANELS} runs of {len(found)}" if len(found) > MAX_PANELS else ""
    in_newtons = all(mass is not None for _, (_, mass) in shown)
    error = axis_label("error of m a", "N") if in_newtons else axis_label("error of a", "m/s^2")
    title = f"Error over the cut-off frequency{drawn}"
    figure, cells = panel_grid(len(shown), (2.3, 1.0), title, (CUTOFF_LABEL, error), sharex=True, sharey=True)
    limits: list[float] = []
    for (ax,), (name, (one, mass)) in zip(cells, shown, strict=True):
        _draw_errors(ax, one, mass if in_newtons and mass is not None else 1.0)
        ax.set_title(f"{name}: {format_number(one.chosen)} Hz", fontweight="normal")
        limits += ax.get_ylim()
    cells[0][0].set_ylim(min(limits), max(limits))  # shared by all panels
    return figure


def _draw_errors(ax: Axes, found: CutoffTradeOff, factor: float) -> None:
    """Draw noise that passes, signal that is lost and their sum over the cut-off, which is marked."""
    f = found.frequency
    ax.loglog(f, factor * found.total, color=style.MEASURED_COLOUR, lw=1.8, label="total")
    ax.loglog(f, factor * found.noise, color=style.BLUE, lw=1.3, ls="--", label="noise that passes")
    ax.loglog(f, factor * found.lost, color=style.VERMILION, lw=1.3, ls=":", label="signal lost")
    ax.axhline(
        factor * found.structural, color=style.GREEN, lw=1.6, ls="-.", label="total, vibrations and events modelled"
    )
    ax.loglog(f, factor * found.hidden, color="#999999", lw=1.0, label="undetectable vibration")
    top = factor * float(np.max(found.total[f < 3.0 * max(found.chosen, found.least)], initial=found.structural))
    ax.set_ylim(0.3 * factor * min(found.structural, float(found.total.min())), 3.0 * top)
    ax.axvline(found.chosen, color=style.ORANGE, lw=2.0, zorder=0)


def _cutoff_title(name: str, found: CutoffTradeOff, factor: float, unit: str) -> str:
    noise, lost = found.at(found.chosen)
    plain, apart = factor * float(np.hypot(noise, lost)), factor * found.structural
    written = format_unit(unit)
    return f"{name}: error {format_number(apart, 2)} {written}; plain low-pass {format_number(plain, 2)} {written}"


@styled
def filters(run: AnyRun) -> Figure:
    """Draw what a filter costs: displacement, velocity, acceleration and force as measured, filtered and smoothed.

    The displacement is drawn less the smoothed one. Bands are two standard deviations; the legend has the rms errors of
    the acceleration.

    Parameters
    ----------
    run : RunResults or Run
        The run. The filter is the one asked for, or else the plain low-pass of the force domain.

    """
    run = as_run(run)
    found = compare_filters(run.displacement, run.filtered, run.motion)
    t = 1e3 * run.motion.t
    inside = style.unsmeared(run.motion)
    if run.friction is not None and np.any(run.friction.free & inside):
        inside &= run.friction.free  # a push would hide all else
    errors = [float(np.sqrt(np.mean(one.sigma[2, inside] ** 2))) for one in found]
    lower = found[1].name if errors[1] < errors[2] else "smoothing"
    title = f"{run.name}: smallest stated error by {lower}, {format_number(min(errors[1:]), 2)} m/s²"
    quantities = [axis_label("x \u2212 smoothed", "µm"), *SHORT_LABELS[1:]]
    rows = [[(one.values[k], one.sigma[k]) for one in found] for k in range(3)]
    rows[0] = [(1e6 * (x - found[2].values[0]), 1e6 * sigma) for x, sigma in rows[0]]
    if (force := _forces(run, found)) is not None:
        rows, quantities = [*rows, force], [*quantities, axis_label("F", "N")]
    figure, (panels,) = panel_grid(1, (7.4, 0.0), title, (TIME_LABEL, *quantities), sharex=True)
    for k, (ax, row) in enumerate(zip(panels, rows, strict=True)):
        for one, error, (values, sigma), look in zip(found, errors, row, FILTER_LOOKS, strict=True):
            if one is not found[0]:
                draw_band(ax, t, values, sigma, color=look["color"], alpha=0.25)
            ax.plot(t, values, label=f"{one.name}, stated error {format_number(error, 2)} m/s²", **look)
        ends = [[v[inside] + n * s[inside] for n in (-2.0, 2.0)] for v, s in row]
        ringing = [np.percentile(end, [25, 75]) for end in ends[1]]  # of the filter; it would hide all else
        style.set_y_limits(ax, ringing + ends[2] + (ends[0] if k == 0 else []))  # differences of noise as well
    return figure


def _forces(run: RunResults, found: Sequence[FilteredMotion]) -> list[tuple[Array, Array]] | None:
    """Friction force D - m a by each filter, and its deviation; None if it does not follow from the acceleration."""
    friction, mass = run.friction, run.mass
    if mass is None or friction is None or (run.sensors is not None and run.sensors.friction_N is not None):
        return None
    rest = np.maximum(friction.sigma_F**2 - (mass * run.motion.sigma_a) ** 2, 0.0)  # of mass and drive
    away = [one.values[2] - run.motion.a for one in found]
    sigma = [np.sqrt(rest + (mass * one.sigma[2]) ** 2) for one in found]
    return [(friction.F - mass * a, s) for a, s in zip(away, sigma, strict=True)]
