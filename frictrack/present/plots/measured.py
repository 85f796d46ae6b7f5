"""Draw what was measured: the film with its track, the motion with its bands, the friction force."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Polygon

from frictrack.base.number_format import format_number, format_range
from frictrack.base.polygons import polygon
from frictrack.present.plots import style
from frictrack.present.plots.inputs import AnyRun, as_run, as_runs
from frictrack.present.plots.style import axis_label, axis_scale, draw_band, new_figure, panel_grid, styled
from frictrack.records import Array, FrameTable, Motion, stretches
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
    figure = new_figure(float(np.clip(width * rows / columns + 1.0, 1.8, 7.0)), title, width)
    ax = figure.subplots()
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
