"""Draw the scan of a candidate effect, the held-out error of each model, and the detection limits."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter

from frictrack import effects
from frictrack.errors import FrictrackError
from frictrack.number_format import format_number, format_unit
from frictrack.plots import style
from frictrack.plots.inputs import AnyModel, AnySummary, as_model, as_summary
from frictrack.plots.model import noise_um
from frictrack.plots.style import axis_label, new_figure, plain_name, styled
from frictrack.records import Array
from frictrack.results import ModelResults

MIN_NOISE_SHOWN = 0.02  # of the smallest error: lower noise is given in the title only
LOG_AXIS_RATIO_ERRORS = 8.0  # largest over smallest held-out error, from which the axis is logarithmic
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
        low, high = ax.dataLim.intervalx
        ax.set_xscale("log")
        ax.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5) if high < 200 * low else (1,)))
        ax.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
        ax.xaxis.set_minor_formatter(NullFormatter())
    ax.set_xlabel(axis_label(_setting_name(name), written))
    ax.margins(x=0.01)


@styled
def history(models: Sequence[AnyModel]) -> Figure:
    """Draw the held-out error of every model in the order in which they were fitted, and the noise.

    Parameters
    ----------
    models : sequence of ModelResults or Fit
        All models of the study.

    """
    tried = [as_model(model) for model in models]
    unit, values, noise = _held_out(tried)
    figure = new_figure(3.3, _history_title(tried, values, noise, unit))
    ax = figure.subplots()
    places = np.arange(len(tried))
    ax.plot(places, values, color=style.BLUE, marker="o", markersize=8, lw=1.8)
    for x, y in zip(places, values, strict=True):
        ax.annotate(format_number(y), (x, y), (0, 9), textcoords="offset points", ha="center", fontweight="bold")
    if noise is not None and noise > MIN_NOISE_SHOWN * float(np.nanmin(values)):
        ax.axhline(noise, color="black", ls=(0, (4, 2)), lw=1.2)
        ax.annotate(f"noise {format_number(noise)} {unit}", (1, noise), (-4, 4), xycoords=("axes fraction", "data"),
                    textcoords="offset points", ha="right", va="bottom")  # fmt: skip
    ax.set_xticks(places, [_wrapped(plain_name(m.name)) for m in tried])
    ax.set_xlim(-0.5, len(tried) - 0.5)
    _set_error_axis(ax, values, noise)
    ax.set_ylabel(axis_label("held-out error, rms", unit))
    return figure


def _set_error_axis(ax: Axes, values: Array, noise: float | None) -> None:
    """Start the axis at zero, or make it logarithmic if the last errors could not be seen otherwise."""
    known = values[np.isfinite(values)]
    if noise is not None and len(known) and noise > MIN_NOISE_SHOWN * float(known.min()):
        known = np.append(known, noise)
    top = float(known.max(initial=0.0)) or 1.0
    if len(known) and 0 < float(known.min()) < top / LOG_AXIS_RATIO_ERRORS:
        ax.set_yscale("log")
        ax.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        ax.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
        ax.yaxis.set_minor_formatter(NullFormatter())
        ax.set_ylim(0.6 * float(known.min()), 2.0 * top)
    else:
        ax.set_ylim(0, 1.2 * top)


def _held_out(models: Sequence[ModelResults]) -> tuple[str, Array, float | None]:
    """Unit, held-out errors (NaN where unknown) and noise: um, or N where forces were fitted."""
    errors = [m.summary["errors"] for m in models]
    in_um = any(e.get("heldout_rms_um") is not None for e in errors)
    key, unit = ("heldout_rms_um", "µm") if in_um else ("heldout_rms_N", "N")
    values = np.array([np.nan if e.get(key) is None else e[key] for e in errors], dtype=float)
    noise = noise_um(models[-1]) if in_um else (models[-1].diagnosis or {}).get("noise_N")
    return unit, values, noise


def _history_title(models: Sequence[ModelResults], values: Array, noise: float | None, unit: str) -> str:
    against = "" if noise is None else f", noise {format_number(noise)} {unit}"
    if len(models) == 1:
        return f"Held-out error of {plain_name(models[0].name)}: {format_number(float(values[0]))} {unit}{against}"
    falls = "falls" if values[-1] < values[0] else "does not fall:"
    before, after = (format_number(float(values[k])) for k in (0, -1))
    return f"Held-out error {falls} from {before} to {after} {unit}{against}"


def _wrapped(name: str) -> str:
    return name.replace(" + ", "\n+ ")


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
    ax.set_yscale("log")
    ax.yaxis.set_minor_formatter(NullFormatter())
    ax.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
    if limit.max() / limit.min() < 10:
        ax.set_yscale("linear")
    ax.set_title(effect, fontweight="normal")
    ax.set_ylabel(axis_label("amplitude", size_unit))
    _set_x_axis(ax, name, shown)
