"""Draw what was measured: the film with its track, the motion with its bands, the friction force; and their errors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Polygon

from frictrack.base.number_format import format_number, format_range, format_unit
from frictrack.base.polygons import polygon
from frictrack.measure.motion import FilteredMotion, compare_filters
from frictrack.present.plots import style
from frictrack.present.plots.inputs import AnyRun, as_run, as_runs
from frictrack.present.plots.style import RUN_STYLES, axis_label, axis_scale, draw_band, new_figure, panel_grid, styled
from frictrack.records import Array, CutoffTradeOff, FrameTable, Motion, stretches
from frictrack.results import RunResults

TARGET_COLOUR, PATH_COLOUR = style.ORANGE, style.SKY
MAX_PUSH_RATIO = 4.0  # range of all accelerations over that of the free section; beyond it the push is not shown
MAX_NAMED_EVENTS = 8
MAX_POINTS_OF_ALL = 6000  # of the force of all runs together; more only make the file larger
MAX_MOTIONS = 8  # runs drawn as small multiples
TIME_LABEL, SHORT_LABELS = "time t / ms", ("x / m", "v / (m/s)", "a / (m/s²)")
MOTION_LABELS = tuple(map(" ".join, zip(("displacement", "velocity", "acceleration"), SHORT_LABELS, strict=True)))
NAME_WIDTH = 0.12  # of the panel's width
REST_SPEED_SHARE = 0.02  # of the highest speed: below it the mass counts as stopped


@styled
def film(run: RunResults, *, wide: bool = True) -> Figure:
    """Draw the first frame of the film with the target's outline and the path of its centre.

    Parameters
    ----------
    run : RunResults
        A run with a film and a track.
    wide : bool
        Whether the figure takes the whole width of the page or half of it.

    Raises
    ------
    ValueError
        If the run has no film or no track.

    """
    if run.film is None or run.track is None:
        raise ValueError(f'expected a run with a film and a track but "{run.name}" is a table')
    picture, track = run.film.picture, run.track
    rows, columns = picture.shape
    found, frames = int(np.sum(track.found)), len(track)
    known = track.sigma_px[np.isfinite(track.sigma_px)]
    precision = f", ± {format_number(float(np.median(known)), 2)} px" if wide and len(known) else ""
    title = f"{run.name}: target found in {found} of {frames} frames{precision}"
    width = style.PAGE_WIDTH_IN if wide else style.PAGE_WIDTH_IN / 2
    figure, ax = style.one_panel(float(np.clip(width * rows / columns + 1.0, 1.8, 7.0)), title, width)
    low, high = np.percentile(picture, [0.5, 99.5])
    ax.imshow(picture, cmap="gray", vmin=low, vmax=max(high, low + 1), interpolation="nearest")
    ax.plot(track.x_px, track.y_px, color="black", lw=3.5)
    ax.plot(track.x_px, track.y_px, color=PATH_COLOUR, lw=1.8, label="path of its centre")
    if track.repaired is not None:
        at = track.repaired > 0
        ax.plot(track.x_px[at], track.y_px[at], **style.REPAIRED_STYLE)
    if track.target is not None:
        outline = track.outline or polygon(list(track.target))
        for color, lw, dash, label in (("black", 3.8, "-", ""), (TARGET_COLOUR, 2.0, "--", "target")):
            ax.add_patch(Polygon(outline, fill=False, ec=color, lw=lw, ls=dash, label=label))
    ax.set(xlim=(-0.5, columns - 0.5), ylim=(rows - 0.5, -0.5), xlabel="x / px", ylabel="y / px")
    return figure


@styled
def motion(run: AnyRun) -> Figure:
    """Draw displacement, velocity and acceleration of a run over time, with bands of two standard deviations.

    The free section is shaded. Ends that the low-pass filter smears are hatched; events are marked and named.
    """
    run = as_run(run)
    figure, ((*panels,),) = panel_grid(
        1, (5.4, 0.8), _motion_title(run), (TIME_LABEL, *MOTION_LABELS), width=style.PAGE_WIDTH_IN / 2, sharex="cell"
    )
    _draw_motion(panels, run)
    return figure


@styled
def motions(runs: Sequence[AnyRun]) -> Figure:
    """Draw displacement, velocity and acceleration of several runs as small multiples.

    Parameters
    ----------
    runs : sequence of RunResults or Run
        Runs of a study; the first `MAX_MOTIONS` are drawn.

    """
    able = as_runs(runs)
    shown = able[:MAX_MOTIONS]
    labels = (TIME_LABEL, *SHORT_LABELS)
    figure, cells = panel_grid(len(shown), (4.4, 0.8), motions_title(able), labels, sharex="cell")
    for cell, run in zip(cells, shown, strict=True):
        _draw_motion(cell, run)
        cell[0].set_title(run.name, fontweight="normal")
    return figure


def motions_title(runs: Sequence[RunResults]) -> str:
    """Title of `motions`: how many runs, how fast, and how many are drawn."""
    top = [float(np.max(np.abs(run.motion.v))) for run in runs]
    count = "1 run" if len(runs) == 1 else f"{len(runs)} runs"
    drawn = f"; the first {MAX_MOTIONS} are drawn" if len(runs) > MAX_MOTIONS else ""
    return f"{count} with a highest speed of {format_range(top)} m/s{drawn}"


def _draw_motion(panels: Sequence[Axes], run: RunResults) -> None:
    """Draw x, v and a of one run in three panels, with its sections and events."""
    m = run.motion
    inside = style.unsmeared(m)
    moved = inside if run.friction is None else inside | run.friction.free
    columns = ((m.x, m.sigma_x, moved), (m.v, m.sigma_v, moved), (m.a, m.sigma_a, inside))
    for ax, (values, sigma, shown) in zip(panels, columns, strict=True):
        _shade_sections(ax, run)
        draw_band(ax, 1e3 * m.t, values, sigma, color=style.SKY, alpha=0.55, label=style.BAND_LABEL)
        ax.plot(1e3 * m.t, values, color=style.MEASURED_COLOUR, lw=1.3)
        style.set_y_limits(ax, (values[shown] - sigma[shown], values[shown] + sigma[shown]))
        style.mark_repaired(ax, 1e3 * m.t, m.repaired)
    panels[-1].set_xlim(1e3 * m.t[0], 1e3 * m.t[-1])
    _zoom_to_free_section(panels[-1], run)
    _mark_events(panels, run)


def _mark_events(panels: Sequence[Axes], run: RunResults) -> None:
    """Mark every event by a line, with its name in the first panel."""
    named = [(1e3 * 0.5 * (begins + ends), kind) for kind, begins, ends in run.events.events]
    for ax in panels:
        for at, _ in named:
            ax.axvline(at, color=style.PURPLE, lw=1.0, ls=(0, (4, 2)), zorder=0.7)
    reach = 1e3 * float(run.motion.t[-1] - run.motion.t[0])
    for k, (at, kind) in enumerate(named[:MAX_NAMED_EVENTS]):
        crowded = k > 0 and at - named[k - 1][0] < NAME_WIDTH * reach
        late = at > 1e3 * float(run.motion.t[-1]) - NAME_WIDTH * reach  # its name stands before its line
        side, shift = ("right", -2) if late else ("left", 2)
        look: dict[str, Any] = {"fontsize": 8, "color": style.PURPLE, "xycoords": ("data", "axes fraction")}
        look["bbox"] = {"fc": "white", "ec": "none", "pad": 0.5, "alpha": 0.85}
        style.note(panels[0], kind, (at, 1.0), (shift, -9 - 10 * (crowded and k % 2)), ha=side, **look)


def _motion_title(run: RunResults) -> str:
    m = run.motion
    at = run.friction.free if run.friction is not None and np.any(run.friction.free) else np.ones(len(m), bool)
    v = m.v[at]
    if np.any(np.diff(np.sign(v)) != 0):
        return f"{run.name} moves to and fro at up to {format_number(float(np.max(np.abs(v))), 2)} m/s"
    start, end = abs(float(v[0])), abs(float(v[-1]))
    first, last = format_number(start), format_number(end)
    if min(start, end) >= REST_SPEED_SHARE * max(start, end):
        return f"{run.name} {'slows' if end < start else 'speeds up'} from {first} to {last} m/s"
    if end < start:
        return f"{run.name} slows from {first} m/s to a stop"
    return f"{run.name} starts from rest and reaches {last} m/s"


def _zoom_to_free_section(ax: Axes, run: RunResults) -> None:
    """Limit the axis to the acceleration of the free section if that of the push is much larger."""
    if run.friction is None or not np.any(run.friction.free):
        return
    a = run.motion.a[style.unsmeared_frames(run.friction, run.motion.guard)]
    low, high = ax.get_ylim()
    room = float(np.ptp(a)) + 0.5 * float(np.max(np.abs(a)))
    if high - low > MAX_PUSH_RATIO * room:
        ax.set_ylim(min(a.min(), 0.0) - room, max(a.max(), 0.0) + room)


def _shade_sections(ax: Axes, run: RunResults) -> None:
    """Shade the free section and hatch the smeared ends."""
    t, guard = 1e3 * run.motion.t, run.motion.guard
    if run.friction is not None:
        for s in stretches(run.friction.free):
            ax.axvspan(t[s.start], t[s.stop - 1], color=style.FREE_COLOUR, lw=0, zorder=0, label="free section")
    if guard:
        for a, b in ((t[0], t[min(guard, len(t) - 1)]), (t[max(len(t) - 1 - guard, 0)], t[-1])):
            ax.axvspan(a, b, fill=False, hatch="///", lw=0, ec="#AAAAAA", zorder=0.5, label="smeared by the filter")


@styled
def friction(runs: Sequence[AnyRun]) -> Figure:
    """Draw the friction force of all runs on their free sections, against time and against velocity.

    Parameters
    ----------
    runs : sequence of RunResults or Run
        All runs of the study.

    Raises
    ------
    ValueError
        If no run has a friction force.

    """
    able = [run for run in as_runs(runs) if run.friction is not None and np.any(run.friction.free)]
    if not able:
        raise ValueError("expected a run with a friction force but got none; a mass is needed")
    figure = new_figure(3.8, friction_title(able))
    left, right = figure.subplots(1, 2, sharey=True)
    everything, styles, named = [], style.run_styles(runs), len(able) <= len(style.RUN_STYLES)
    for run in able:
        f, look = run.friction, styles[run.name]
        assert f is not None
        shown = style.masked(f.F, style.unsmeared_frames(f, run.motion.guard))
        rows = slice(None, None, max(1, len(f) * len(able) // MAX_POINTS_OF_ALL))
        for ax, at in ((left, 1e3 * (f.t - f.t[np.argmax(f.free)])), (right, run.motion.v)):
            draw_band(ax, at[rows], shown[rows], f.sigma_F[rows], color=look["color"], alpha=0.18)
            ax.plot(at[rows], shown[rows], lw=1.0, alpha=0.85, label=run.name if named else "", **look)
            style.mark_repaired(ax, at, f.repaired)
        everything += [shown - f.sigma_F, shown + f.sigma_F]
    style.set_y_limits(left, everything)
    left.set(xlabel=axis_label("time since the free section begins", "ms"), ylabel=axis_label("friction force F", "N"))
    right.set_xlabel(axis_label("velocity v", "m/s"))
    for ax in (left, right):
        ax.axhline(0, **style.ZERO_STYLE)
    right.axvline(0, **style.ZERO_STYLE)
    return figure


def friction_title(runs: Sequence[RunResults]) -> str:
    """Title of `friction`: the range of force and speed on the free sections."""
    shown = [(run, f, style.unsmeared_frames(f, run.motion.guard)) for run in runs if (f := run.friction) is not None]
    low, high = np.percentile(np.concatenate([np.abs(f.F[at]) for _, f, at in shown]), [5, 95])
    speed = np.concatenate([np.abs(run.motion.v[at]) for run, _, at in shown])
    return (
        f"Friction between {format_number(low, 2)} and {format_number(high, 2)} N "
        f"at speeds from {format_number(float(speed.min()), 2)} to {format_number(float(speed.max()), 2)} m/s"
    )


PANEL_HEIGHT_IN = 1.7


@styled
def table(record: FrameTable) -> Figure:
    """Draw the measured columns of a record over time, one panel each.

    Parameters
    ----------
    record : FrameTable
        A track, displacement, motion or friction force. A column ``x`` has its standard deviation in ``sigma_x``.

    """
    columns = [f for f in fields(record) if _is_drawn(record, f.name, f.metadata)]  # type: ignore[arg-type]
    name = getattr(record, "name", "") or getattr(record, "run", "")
    title = f"{type(record).__name__} of {name}" if name else type(record).__name__
    scales = [axis_scale(getattr(record, f.name), f.metadata["unit"]) for f in columns]
    labels = (TIME_LABEL, *(axis_label(f.name, unit) for f, (_, unit) in zip(columns, scales, strict=True)))
    figure, (panels,) = panel_grid(1, (PANEL_HEIGHT_IN * len(columns), 0.7), title, labels, sharex=True)
    t: Array = 1e3 * record.t  # type: ignore[attr-defined]
    for ax, f, (factor, _) in zip(panels, columns, scales, strict=True):
        values = getattr(record, f.name)  # its deviation is sigma_x of x, sigma_px of x_px
        sigma = getattr(record, f"sigma_{f.name}".replace("sigma_x_px", "sigma_px"), None)
        if sigma is not None:
            draw_band(ax, t, factor * values, factor * sigma, color=style.SKY, alpha=0.55)
        ax.plot(t, factor * values, color=style.BLUE, lw=1.0)
        if isinstance(record, Motion) and f.name == "a":  # the ends are smeared
            style.set_y_limits(ax, [factor * values[style.unsmeared(record)]])
    return figure


def _is_drawn(record: Any, name: str, meta: Any) -> bool:
    """Whether a column is a measured number with some known values, not the time or a standard deviation."""
    values = getattr(record, name)
    if not meta.get("column") or values is None or name == "t" or name.startswith("sigma"):
        return False
    return values.dtype.kind == "f" and bool(np.any(np.isfinite(values)))


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
    return f"Standard deviation of the mean force {error} N; largest source: {max(largest, key=largest.count)}"


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
