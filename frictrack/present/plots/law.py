"""Draw the friction law over the speed; how its parameters were found, are known, and change over many studies."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.interpolate import PchipInterpolator

from frictrack.base.distributions import normal_ppf
from frictrack.base.errors import FrictrackError
from frictrack.base.number_format import format_interval, format_number, format_unit
from frictrack.present.plots import style
from frictrack.present.plots.inputs import AnyModel, AnyRun, as_model, as_runs
from frictrack.present.plots.model import modelled_force, worst_runs
from frictrack.present.plots.style import axis_label, axis_scale, draw_band, new_figure, panel_grid, styled
from frictrack.records import Array, Curve
from frictrack.results import ModelResults, RunResults
from frictrack.results.candidates import plain_name
from frictrack.search import Convergence

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


SEARCH_LABELS, HEIGHT_RATIOS = ("misfit", "diversity", "place within the bounds"), (3, 1.2, 3)  # of its panels
HEADROOM = 10.0  # of the axis of misfits above the first best: the mean of a young population may be far higher


@styled
def convergence(model: AnyModel, runs: Sequence[AnyRun] = ()) -> Figure:
    """Draw a global search, one column per group of runs.

    Upper panel: lowest misfit so far and mean of the population. Middle: diversity, 1 for points spread evenly over the
    box and 0 for copies of one. Lower: the parameters of the best individual within the bounds of the search. Vertical
    lines are restarts.

    Parameters
    ----------
    model : ModelResults or Fit
        A model that a global search fitted.
    runs
        Not used: every figure of a fit takes its runs.

    Raises
    ------
    FrictrackError
        If it was fitted in another way.

    """
    model = as_model(model)
    found = model.convergence
    if not found:
        raise FrictrackError(
            f"expected a fit by a global search to draw its convergence but got {model.summary['search']}; fit with "
            'search = "mga", for example'
        )
    title, labels = _convergence_title(model.summary, found), ("generation", *SEARCH_LABELS)
    figure, cells = panel_grid(len(found), (6.2, 0.0), title, labels, sharex="col", height_ratios=HEIGHT_RATIOS)
    for cell, (group, one) in zip(cells, found.items(), strict=True):
        _draw_search(cell, one)
        cell[0].set_title("" if len(found) == 1 else group)
    return figure


def _convergence_title(summary: Mapping[str, Any], found: Mapping[str, Convergence]) -> str:
    """Name of the search, its generations, and how far the misfit fell."""
    name = summary["search"].upper()
    one = next(iter(found.values()))
    if len(found) > 1:
        return f"{name}: convergence in {len(found)} groups"
    end = ", stopped by hand" if summary.get("searched", {}).get("ended") == "interrupted" else ""
    first, last = format_number(one.best[0]), format_number(one.best[-1])
    return f"{name}: misfit from {first} to {last} in {len(one.best) - 1} generations{end}"


def _draw_search(column: Sequence[Axes], one: Convergence) -> None:
    above, middle, below = column
    generation = np.arange(len(one.best))
    above.plot(generation, one.mean, color=style.MEASURED_COLOUR, lw=1.0, label="mean of the population")
    above.plot(generation, one.best, color=style.VERMILION, label="best so far")
    if one.best[-1] > 0:
        style.log_axis(above, "y")
        top = HEADROOM * max(one.best[0], float(np.min(one.mean)))
        above.set_ylim(top=min(top, 1.2 * float(np.max(one.mean))))
    above.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=2)
    middle.plot(generation, one.diversity, color=style.BLUE, label="diversity")
    middle.set_ylim(0, max(1.05, float(one.diversity.max())))
    low, high = one.bounds.T
    for name, place, look in zip(one.parameters, ((one.x - low) / (high - low)).T, style.RUN_STYLES, strict=False):
        below.plot(generation, place, label=name, drawstyle="steps-post", **look)
    below.set_ylim(-0.02, 1.02)
    below.legend(loc="upper left", bbox_to_anchor=(0, -0.28), ncols=4, fontsize=8)
    for ax in column:
        for start in generation[1:][np.diff(one.start) > 0]:
            ax.axvline(start, color="#666666", lw=0.8, ls=(0, (1, 1)))


MAX_SHOWN_RISE = 1.7  # top of a panel over the limit
N_CURVE_POINTS = 200
LOG_AXIS_RATIO = 30.0  # upper over lower end of an interval, from which the axis is logarithmic


@styled
def profiles(summary: Mapping[str, Any]) -> Figure:
    """Draw the rise of chi-squared over each parameter while all others are fitted again, one panel per parameter.

    Parameters
    ----------
    summary : mapping
        The JSON of a fit, with its `profiles` and `parameters`.

    References
    ----------
    D. M. Bates, D. G. Watts (1988): Nonlinear Regression Analysis and Its Applications, ch. 6, profile t plots.

    """
    found = summary["profiles"]
    labels = ("", "rise of chi²")
    figure, cells = panel_grid(len(found), (2.3, 0.8), _profiles_title(found), labels, sharey=True)
    for (ax,), (name, profile) in zip(cells, found.items(), strict=True):
        _panel(ax, name, profile, summary["parameters"].get(name, {}))
    return figure


def _profiles_title(found: Mapping[str, Any]) -> str:
    unclosed = ", ".join(name for name, profile in found.items() if None in (profile["low"], profile["high"]))
    return f"Not bounded on both sides: {unclosed}" if unclosed else "Every parameter is bounded on both sides"


def _panel(ax: Axes, name: str, profile: Mapping[str, Any], quoted: Mapping[str, Any]) -> None:
    limit = float(normal_ppf(0.5 + profile["level"] / 2)) ** 2
    values, rise = np.array(profile["values"]), np.array(profile["rise"])
    factor, unit = axis_scale(values, profile["unit"])
    low, high = _reach(values, rise, profile, limit)
    ends = [end if profile[key] is None else profile[key] for key, end in (("low", low), ("high", high))]
    interval: dict[str, Any] = {"color": style.NOISE_COLOUR, "label": f"{100 * profile['level']:.0f} % interval"}
    ax.axvspan(factor * ends[0], factor * ends[1], lw=0, zorder=0, **interval)
    for key, colour, dashes, label in (
        ("std", style.MODEL_COLOUR, (4, 1.5), "parabola of the standard deviation"),
        ("std_misfit", style.MEASURED_COLOUR, (4, 1, 1, 1), "† standard deviation with the misfit"),
    ):
        if quoted.get(key):
            x = np.linspace(low, high, N_CURVE_POINTS)
            curve = ((x - profile["value"]) / quoted[key]) ** 2
            ax.plot(factor * x, curve, color=colour, lw=1.2, ls=(0, dashes), label=label)
    x, curve = _smooth(values, rise, profile["value"])
    ax.plot(factor * x, curve, color=style.BLUE, lw=1.5, label="profile, all others fitted again")
    ax.plot(factor * values, rise, color=style.BLUE, **(style.DOT_STYLE | {"markersize": 5.0}))
    ax.axhline(limit, color="#666666", lw=0.8, ls=(0, (1, 1)), label="limit")
    if ends[0] > 0 and ends[1] > LOG_AXIS_RATIO * ends[0]:
        low, high = 0.8 * ends[0], 1.25 * ends[1]
        ax.set_xscale("log")
    else:
        ax.locator_params(axis="x", nbins=4)
    ax.set_xlim(factor * low, factor * high)
    ax.set_ylim(-0.06 * limit, MAX_SHOWN_RISE * limit)
    ax.set_title(name, fontweight="normal")
    known = profile["low"] is not None or profile["high"] is not None
    reach = format_interval((profile["low"], profile["high"]), factor)
    ax.set_xlabel(f"{reach} {format_unit(unit) if known else ''}".strip())


def _reach(values: Array, rise: Array, profile: Mapping[str, Any], limit: float) -> tuple[float, float]:
    """Ends of a panel: those of the interval and a margin; on an open side the last computed value."""
    shown = values[rise < 4 * limit]
    low = shown.min() if profile["low"] is None else profile["low"]
    high = shown.max() if profile["high"] is None else profile["high"]
    room = 0.16 * ((high - low) or abs(high) or 1.0)
    return float(low - room), float(high + room)


def _smooth(values: Array, rise: Array, best: float) -> tuple[Array, Array]:
    """Interpolate the points by their signed root, which is nearly a line."""
    if len(values) < 3:
        return values, rise
    root = np.sign(values - best) * np.sqrt(rise)
    logarithmic = values[0] > 0 and values[-1] > LOG_AXIS_RATIO * values[0]
    at = np.log(values) if logarithmic else values
    x = np.unique(np.concatenate([np.linspace(at[0], at[-1], N_CURVE_POINTS), at]))
    curve = np.asarray(PchipInterpolator(at, root)(x)) ** 2
    return (np.exp(x) if logarithmic else x), curve


PANEL_COLUMNS = 2
MAX_ERROR_BARS = 300  # points; the bars of more points would overlap to a grey area
MAX_POINTS = 3000  # points drawn one by one; more points are summarised by quantiles
N_STRETCHES = 150  # equal parts of the series, each with its own quantiles


@styled
def trends(found: Sequence[Mapping[str, Any]]) -> Figure:
    """Draw every quantity over the series, with a line where its trend is significant.

    Parameters
    ----------
    found : sequence of mappings
        Each has `name` and `unit` of the quantity, `along` (label of the x axis), `at`, `value` and `std` (n,),
        `slope` per unit of `at`, `scatter` between studies, `p`, and `holds` where the trend is significant.

    """
    rows = -(-len(found) // PANEL_COLUMNS)
    figure = new_figure(2.3 * rows + 0.4, "Over the series")
    panels = figure.subplots(rows, PANEL_COLUMNS, squeeze=False).ravel()
    for ax, trend in zip(panels, found, strict=False):
        _draw_trend(ax, trend)
    for ax in panels[len(found) :]:
        ax.set_visible(False)
    return figure


def _draw_trend(ax: Axes, trend: Mapping[str, Any]) -> None:
    at, value, std = (np.asarray(trend[key], dtype=float) for key in ("at", "value", "std"))
    if len(at) <= MAX_ERROR_BARS and np.any(np.isfinite(std)):
        ax.errorbar(
            at, value, style.BAND_SIGMAS * np.nan_to_num(std), fmt="none", ecolor=style.SKY, elinewidth=1.0, zorder=1
        )
    if len(at) <= MAX_POINTS:
        ax.plot(at, value, "o", ms=3.5 if len(at) <= MAX_ERROR_BARS else 1.5, color=style.MEASURED_COLOUR, zorder=2)
    else:
        _stretches(ax, at, value)
    if trend["holds"]:
        weight = 1.0 / (np.nan_to_num(std) ** 2 + trend["scatter"] ** 2 + 1e-300)
        middle = np.average(value - trend["slope"] * at, weights=weight)
        ends = np.array([at[0], at[-1]])
        ax.plot(ends, middle + trend["slope"] * ends, color=style.MODEL_COLOUR, lw=2.0, zorder=3)
    ax.set_title(trend["name"])
    ax.set_ylabel(format_unit(trend["unit"]) or "relative")
    ax.set_xlabel(trend["along"])
    low, high = value.min(), value.max()
    longest = style.BAND_SIGMAS * np.nan_to_num(std).max() if len(at) <= MAX_ERROR_BARS else 0.0
    spread = high - low or abs(high) or 1.0
    reach = min(max(longest, 0.08 * (high - low)), 2.0 * spread)  # one very uncertain study must not flatten the others
    ax.set_ylim(low - reach, high + reach)


def _stretches(ax: Axes, at: Array, value: Array) -> None:
    """Summarise many points: median, quartiles and extremes of each part of the series."""
    parts = np.array_split(np.arange(len(at)), N_STRETCHES)
    low, lower, middle, upper, high = np.transpose([np.quantile(value[k], [0.0, 0.25, 0.5, 0.75, 1.0]) for k in parts])
    place = np.array([np.mean(at[k]) for k in parts])
    ax.fill_between(place, low, high, color=style.SKY, alpha=0.3, lw=0.0)
    ax.fill_between(place, lower, upper, color=style.SKY, lw=0.0)
    ax.plot(place, middle, color=style.MEASURED_COLOUR, lw=1.2, zorder=2)
