"""Draw the fitted friction law over the speed, and measured and modelled force against displacement and velocity."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from frictrack.base.number_format import format_number
from frictrack.present.plots import style
from frictrack.present.plots.inputs import AnyModel, AnyRun, as_model, as_runs
from frictrack.present.plots.model import modelled_force, worst_runs
from frictrack.present.plots.style import axis_label, draw_band, new_figure, panel_grid, styled
from frictrack.records import Array, Curve
from frictrack.results import ModelResults, RunResults
from frictrack.results.rows import plain_name

HEIGHT_IN, WIDTH_IN = 3.4, 7.0
POINT_STYLE: dict[str, Any] = {"color": style.MEASURED_COLOUR, "ls": "none", "marker": ".", "ms": 2.2, "alpha": 0.4}
MAX_SIGMA_RATIO = 5.0  # of a frame over the median of its run: the filter rings after a push, and the band says so
DIRECTIONS = {1: "toward +x (v > 0)", -1: "toward \N{MINUS SIGN}x (v < 0)"}


@styled
def law(model: AnyModel, runs: Sequence[AnyRun], *, title: bool = True, width: float = WIDTH_IN) -> Figure:
    """Draw the friction force against the motion over the speed, one panel per direction, with its band.

    The right axis gives the coefficient of friction, where the load is known. The points are the measured force at the
    load of the law, less what the other effects of the model contribute: the law plus measured minus modelled force.

    Parameters
    ----------
    model : ModelResults or Fit
        The fitted model.
    runs : sequence of RunResults or Run
        All runs of the study.
    title : bool
        Whether the figure has a headline.
    width : float
        Width of the figure, inches.

    Raises
    ------
    ValueError
        If no effect of the model depends on the speed alone.

    """
    model, runs = as_model(model), as_runs(runs)
    if not has_law(model):
        raise ValueError(f'expected a model with a law over the speed but "{model.name}" has none; add coulomb')
    branches: list[Mapping[str, Any]] = model.summary["law"]
    directions = sorted({branch["direction"] for branch in branches}, reverse=True)
    factor, unit = style.axis_scale(np.array([branch["v"][-1] for branch in branches]), "m/s")
    labels, size = (axis_label("speed |v|", unit), "friction force F / N"), (HEIGHT_IN, 0.3 * title)
    said = law_title(model) if title else ""
    figure, cells = panel_grid(len(directions), size, said, labels, width=width, sharey=True)
    panels = [ax for (ax,) in cells]
    for ax, direction in zip(panels, directions, strict=True):
        own = [branch for branch in branches if branch["direction"] == direction]
        for k, branch in enumerate(own):
            color = style.RUN_STYLES[k]["color"] if len(own) > 1 else style.MODEL_COLOUR
            _draw_branch(ax, branch, _measured_points(model, runs, branch), factor, color)
        ax.set_xlim(left=0.0)
        if len(directions) > 1:
            ax.set_title(DIRECTIONS[direction], fontweight="normal")
    _limit_force(panels[0], branches)
    _name_wide_band(panels[0], branches)
    if load := branches[0]["load_N"]:
        right = panels[-1].secondary_yaxis("right", functions=(lambda F: F / load, lambda mu: mu * load))
        right.set_ylabel("coefficient of friction µ")
    style.legend_below(figure, markerscale=3)
    return figure


def has_law(model: ModelResults) -> bool:
    """Whether the law over the speed is stored with a model; it is not for models of early versions."""
    return bool(model.summary.get("law"))


def law_title(model: ModelResults) -> str:
    """Title of `law`: the force at the slowest and the fastest speed."""
    first = model.summary["law"][0]
    factor, unit = style.axis_scale(np.array(first["v"]), "m/s")
    slow, fast = (format_number(factor * v) for v in (first["v"][0], first["v"][-1]))
    begin, end = (format_number(force) for force in (first["F"][0], first["F"][-1]))
    if begin == end:
        return f"{plain_name(model.name)}: friction {begin} N from {slow} to {fast} {unit}"
    return f"{plain_name(model.name)}: friction {begin} N at {slow} {unit}, {end} N at {fast} {unit}"


def _draw_branch(ax: Axes, branch: Mapping[str, Any], measured: Array, factor: float, color: str) -> None:
    """Draw one direction: measured points (2, n), then the law with its band; speeds times a factor."""
    v, force, sigma = (np.array(branch[key]) for key in ("v", "F", "sigma_F"))
    at, points = measured[:, :: max(1, measured.shape[1] // style.MAX_POINTS)]
    ax.plot(factor * at, points, label="measured", rasterized=True, zorder=1, **POINT_STYLE)
    draw_band(ax, factor * v, force, sigma, color=color, alpha=0.3, zorder=2, label=style.BAND_LABEL)
    ax.plot(factor * v, force, color=color, lw=2.0, zorder=3, label=f"law {branch.get('group', '')}".strip())


def _measured_points(model: ModelResults, runs: Sequence[RunResults], branch: Mapping[str, Any]) -> Array:
    """Speed and force (2, n) of all fitted runs of a branch, in its direction."""
    own = {run.name: run for run in runs if branch.get("group", run.group) == run.group and run.friction is not None}
    parts = [_points(model, c, own[c.run], branch) for c in model.curves if c.role == "fit" and c.run in own]
    return np.concatenate([np.zeros((2, 0)), *parts], axis=1)


def _points(model: ModelResults, curve: Curve, run: RunResults, branch: Mapping[str, Any]) -> Array:
    """Speed and law plus residual force (2, n) of one segment, in the direction of a branch."""
    f, direction = run.friction, branch["direction"]
    assert f is not None
    measured = np.interp(curve.t, f.t, style.masked(f.F, style.unsmeared_frames(f, run.motion.guard)))
    left = direction * (measured - modelled_force(model, curve))
    sigma = np.interp(curve.t, f.t, f.sigma_F)
    kept = np.isfinite(left) & (direction * curve.v_model > branch["v"][0])
    if np.any(kept):
        kept &= sigma <= MAX_SIGMA_RATIO * np.median(sigma[kept])
    speed = np.abs(curve.v_model[kept])
    return np.array([speed, np.interp(speed, branch["v"], branch["F"]) + left[kept]])


def _limit_force(ax: Axes, branches: Sequence[Mapping[str, Any]]) -> None:
    """Show the axis from zero to the law and the bulk of the points; a few wild points set no limit."""
    dots = (line for line in ax.lines if line.get_linestyle() == "None")
    points = np.concatenate([np.asarray(line.get_ydata(), float) for line in dots])
    bulk = np.percentile(points, [1, 99]) if len(points) else points
    values = np.concatenate([np.ravel([branch["F"] for branch in branches]), bulk, [0.0]])
    style.set_y_limits(ax, [values])


def _name_wide_band(ax: Axes, branches: Sequence[Mapping[str, Any]]) -> None:
    """Say in the legend where the band fills the panel from edge to edge: these runs do not determine the law."""
    low, high = ax.get_ylim()
    force, sigma = (np.concatenate([b[key] for b in branches]) for key in ("F", "sigma_F"))
    room = style.BAND_SIGMAS * sigma
    if np.median(force - room) < low and np.median(force + room) > high:
        for band in ax.collections:
            band.set_label(f"{band.get_label()}, beyond this panel")


MAX_PANELS = 4  # runs drawn; of more runs, those that fit worst


@styled
def loops(model: AnyModel, runs: Sequence[AnyRun]) -> Figure:
    """Draw per run the hysteresis loops of measured and modelled friction force over displacement and velocity.

    Parameters
    ----------
    model : ModelResults or Fit
        The fitted model.
    runs : sequence of RunResults or Run
        All runs of the study.

    Raises
    ------
    ValueError
        If no run has a friction force.

    """
    model, runs = as_model(model), as_runs(runs)
    shown = [run for run in worst_runs(model, runs) if run.friction is not None][:MAX_PANELS]
    if not shown:
        raise ValueError("expected a run with a friction force but got none")
    figure = new_figure(3.1 * len(shown) + 0.6, _title(model))
    panels = figure.subplots(len(shown), 2, squeeze=False, sharey="row")
    for (left, right), run in zip(panels, shown, strict=True):
        _loops((left, right), [c for c in model.curves if c.run == run.name], run)
        left.set_title(run.name, fontweight="normal")
        left.set_ylabel("friction force F / N")
    return figure


def _loops(pair: tuple[Axes, Axes], curves: Sequence[Curve], run: RunResults) -> None:
    """Draw F of one run against x from the middle of the travel, and against v."""
    f = run.friction
    assert f is not None
    everywhere = np.concatenate([c.x for c in curves])
    middle = 0.5 * float(everywhere.min() + everywhere.max())
    for ax, of, words, unit in (
        (pair[0], lambda c: c.x - middle, "displacement x from the middle", "m"),
        (pair[1], lambda c: c.v_model, "velocity v", "m/s"),
    ):
        factor, written = style.axis_scale(np.concatenate([of(c) for c in curves]), unit)
        for c in curves:
            at, shown = factor * of(c), style.unbroken(c.t)
            measured = style.masked(np.interp(c.t, f.t, f.F), shown)
            ax.plot(at, measured, color=style.MEASURED_COLOUR, lw=0.9, label="measured")
            ax.plot(at, style.masked(c.F_model, shown), lw=1.8, **style.MODEL_STYLE)
        ax.axhline(0, **style.ZERO_STYLE)
        ax.set_xlabel(axis_label(words, written))
    pair[1].axvline(0, **style.ZERO_STYLE)


def _title(model: ModelResults) -> str:
    error = model.summary["errors"]["relative_force_error"]
    return f"{plain_name(model.name)}: error {format_number(100 * error, 2)} % of the measured friction force"
