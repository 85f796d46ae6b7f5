"""Draw how parameters were found and how well they are known: convergence of a search, likelihood profiles."""

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
from frictrack.present.plots.inputs import AnyModel, AnyRun, as_model
from frictrack.present.plots.style import axis_scale, panel_grid, styled
from frictrack.records import Array
from frictrack.search import Convergence

HEIGHT_RATIOS = (3, 1.2, 3)
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
    title, labels = (
        _convergence_title(model.summary, found),
        ("generation", "misfit", "diversity", "place within the bounds"),
    )
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
