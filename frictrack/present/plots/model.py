"""Draw the model against the measurement: forces, residual, held-out error of each model tried, and its own motion.

Modelled and measured displacement look the same: an error of 30 um over a slide of half a metre cannot be seen. So
these figures show the force, and of the displacement only the residual. Where a load cell measured friction, the
residual is a force.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from frictrack.base.number_format import describe_change, format_number, format_share
from frictrack.present.plots import style
from frictrack.present.plots.inputs import AnyModel, AnyRun, as_model, as_run, as_runs
from frictrack.present.plots.style import axis_label, draw_band, new_figure, one_panel, panel_grid, styled
from frictrack.records import Array, Curve, ModelledMotion, stretches
from frictrack.results import ModelResults, RunResults
from frictrack.results.candidates import plain_name

MIN_LABEL_DISTANCE = 0.12  # of a panel's width; closer labels would touch
MAX_PANELS = 8  # runs drawn; of more runs, those that fit worst
BETTER_MODEL_STYLE: dict[str, Any] = {"color": "#999999", "marker": "x", "markersize": 2.0, "markeredgewidth": 0.6}


@dataclass(frozen=True)
class Residual:
    """Residual of one segment: measured minus modelled displacement in um, or force in N.

    Attributes
    ----------
    t : Array
        (n,) time, ms; of points (v, F) the velocity, mm/s.
    values : Array
        (n,) residual, um or N.
    sigma : Array
        (n,) standard deviation of the noise, um or N.
    repaired : Array or None
        (n,) codes of repaired frames; None if there are none.

    """

    t: Array
    values: Array
    sigma: Array
    repaired: NDArray[np.int8] | None = None


@styled
def fit(model: AnyModel, runs: Sequence[AnyRun]) -> Figure:
    """Draw per run the modelled and the measured friction force over time, and the residual below.

    Parameters
    ----------
    model : ModelResults or Fit
        The fitted model.
    runs : sequence of RunResults or Run
        All runs of the study.

    """
    model, runs = as_model(model), as_runs(runs)
    shown = worst_runs(model, runs)
    labels = (_axis_words(runs), "friction force F / N", axis_label("residual", residual_unit(model)))
    title = fit_title(model) + _how_many(model, shown)
    figure, cells = panel_grid(len(shown), (3.3, 0.7), title, labels, height_ratios=(2, 1.1), sharex="cell")
    for (above, left), run in zip(cells, shown, strict=True):
        _draw_measured_force(above, run)
        _draw_modelled_force(above, model, run)
        _draw_residual(left, residuals(model, run))
        above.set_title(_panel_title(model, run), fontweight="normal")
    _share_y([left for _, left in cells])
    return figure


@styled
def failing(
    model: AnyModel, runs: Sequence[AnyRun], spans: Sequence[dict[str, Any]], better: AnyModel | None = None
) -> Figure:
    """Draw the residual of every run, with the spans where the model fails.

    Parameters
    ----------
    model : ModelResults or Fit
        The model that fails.
    runs : sequence of RunResults or Run
        All runs of the study.
    spans : sequence of dict
        Where it fails: each has `run`, `t` (start and end, s) and `share_of_error`, which is written on it.
    better : ModelResults or Fit, optional
        A later model, whose residual is drawn in grey.

    """
    model, runs, better = as_model(model), as_runs(runs), None if better is None else as_model(better)
    styles = style.run_styles(runs)
    shown = worst_runs(model, runs)
    labels = (_axis_words(runs), axis_label("residual", residual_unit(model)))
    title = _failing_title(model, runs, spans) + _how_many(model, shown)
    figure, cells = panel_grid(len(shown), (2.0, 0.9), title, labels, sharey=True)
    for (ax,), run in zip(cells, shown, strict=True):
        color = styles[run.name]["color"]
        if better is not None:
            label = plain_name(better.name)
            _draw_residual(ax, residuals(better, run), with_band=False, label=label, **BETTER_MODEL_STYLE)
        _draw_residual(ax, residuals(model, run), color=color, zorder=3, label=plain_name(model.name))
        ax.set_title(_panel_title(model, run), fontweight="normal")
        _mark_spans(ax, [s for s in spans if s["run"] == run.name], color, "v" if _of_points(runs) else "t")
    return figure


@styled
def routes(default: AnyModel, papers: AnyModel, run: AnyRun) -> Figure:
    """Draw the friction force of one run: measured, fitted in the displacement domain, and by the papers' route.

    Parameters
    ----------
    default, papers : ModelResults or Fit
        The same model, fitted in both ways.
    run : RunResults or Run
        A run that both have fitted.

    """
    default, papers, run = as_model(default), as_model(papers), as_run(run)
    figure, ax = one_panel(3.4, f"{run.name}: measured force and both fits")
    _draw_measured_force(ax, run)
    _draw_modelled_force(ax, default, run, label="displacement domain")
    _draw_modelled_force(ax, papers, run, label="papers' route", color=style.BLUE, linestyle=(0, (1, 1)))
    ax.set(xlabel=_axis_words([run]), ylabel="friction force F / N")
    return figure


def fit_title(model: ModelResults) -> str:
    """Title of `fit`: the verdict, and the errors."""
    verdict = (model.diagnosis or {}).get("verdict")
    words = {None: "", "complete": " is complete", "undetermined": " is undetermined"}.get(verdict, " fails")
    return f"{plain_name(model.name)}{words}: {error_words(model)}"


def error_words(model: ModelResults) -> str:
    """Residual, noise and force error of a model, as far as they are known."""
    errors = model.summary["errors"]
    rms, force = errors.get("rms_displacement_um"), errors.get("relative_force_error")
    parts = [] if rms is None else [f"residual {format_number(rms)} µm{_noise_words(noise_um(model), 'µm')}"]
    kind = "force error" if rms is None else "filtered force error"
    parts += [] if force is None else [f"{kind} {format_number(100 * force, 2)} %"]
    return ", ".join(parts)


def _noise_words(noise: float | None, unit: str) -> str:
    return "" if noise is None else f", noise {format_number(noise)} {unit}"


def _how_many(model: ModelResults, shown: Sequence[RunResults]) -> str:
    """How many runs are drawn, if not all."""
    n = len({curve.run for curve in model.curves})
    return f" ({len(shown)} worst of {n} runs)" if len(shown) < n else ""


def _residual_title(model: ModelResults, runs: Sequence[RunResults]) -> str:
    most = max(float(np.max(np.abs(part.values))) for run in runs for part in residuals(model, run))
    noise = _noise_words(noise_um(model), "µm")
    return f"{plain_name(model.name)}: residual up to {format_number(most)} {residual_unit(model)}{noise}"


def _failing_title(model: ModelResults, runs: Sequence[RunResults], spans: Sequence[dict[str, Any]]) -> str:
    if not spans:
        return _residual_title(model, runs)
    worst = max(spans, key=lambda s: s["share_of_error"])
    axis, unit = ("v", "mm/s") if _of_points(runs) else ("t", "ms")
    begin, end = (format_number(1e3 * reach) for reach in worst[axis])
    share = f"{format_share(worst['share_of_error'])} of the error"
    return f"{plain_name(model.name)} fails most in {worst['run']} from {begin} to {end} {unit}: {share}"


def _of_points(runs: Sequence[RunResults]) -> bool:
    """Whether there are points (v, F), which are drawn over the velocity."""
    return any(run.is_of_points for run in runs)


def _axis_words(runs: Sequence[RunResults]) -> str:
    return axis_label("velocity v", "mm/s") if _of_points(runs) else axis_label("time t", "ms")


def _abscissa(run: RunResults, t: Array) -> Array:
    """Times t (n,), s, in ms; of points (v, F), which t counts, the velocities in mm/s."""
    return 1e3 * (np.interp(t, run.motion.t, run.motion.v) if run.is_of_points else t)


def noise_um(model: ModelResults) -> float | None:
    """Standard deviation of the noise of all fitted runs, rms.

    Returns
    -------
    float or None
        um; None if no displacement was fitted.

    """
    if model.diagnosis and model.diagnosis.get("noise_um"):
        return float(model.diagnosis["noise_um"])
    return _rms([row.get("noise_um") for row in model.summary.get("per_run", ()) if row["role"] == "fit"])


def worst_runs(model: ModelResults, runs: Sequence[RunResults]) -> list[RunResults]:
    """Select the runs to draw.

    Parameters
    ----------
    model : ModelResults
        The fitted model.
    runs : sequence of RunResults
        All runs of the study.

    Returns
    -------
    list of RunResults
        The fitted runs in order; of more than `MAX_PANELS`, those with the largest residual over its noise.

    """
    by_name = {run.name: run for run in runs}
    fitted = [by_name[name] for name in dict.fromkeys(curve.run for curve in model.curves)]
    if len(fitted) <= MAX_PANELS:
        return fitted

    def size(run: RunResults) -> float:
        return float(np.mean(np.concatenate([part.values / part.sigma for part in residuals(model, run)]) ** 2))

    kept = sorted(fitted, key=size, reverse=True)[:MAX_PANELS]
    return [run for run in fitted if run in kept]


def residual_unit(model: ModelResults) -> str:
    """Unit of the model's residual: um of displacement, or N if only forces were measured."""
    return "N" if model.summary["errors"]["rms_displacement_um"] is None else "µm"


def residuals(model: ModelResults, run: RunResults) -> list[Residual]:
    """Compute the residuals of one run.

    Parameters
    ----------
    model : ModelResults
        The fitted model.
    run : RunResults
        A run of the study.

    Returns
    -------
    list of Residual
        One per segment of the fit; none if the run was not fitted.

    """
    curves = [c for c in model.curves if c.run == run.name]
    if residual_unit(model) == "µm":
        return [Residual(1e3 * c.t, 1e6 * c.residual, 1e6 * c.sigma_x, c.repaired) for c in curves]
    f = run.friction
    if f is None:
        return []
    force, sigma = ([np.interp(c.t, f.t, column) for c in curves] for column in (f.F, f.sigma_F))
    return [Residual(_abscissa(run, c.t), F - c.F_model, s) for c, F, s in zip(curves, force, sigma, strict=True)]


def _draw_residual(ax: Axes, parts: Sequence[Residual], *, with_band: bool = True, **look: Any) -> None:
    """Draw residuals over their noise band; many points as a bitmap, to keep the file small."""
    many = sum(len(part.t) for part in parts) > 4 * style.MAX_POINTS
    for part in parts:
        if with_band:
            noise: dict[str, Any] = {"color": style.NOISE_COLOUR, "zorder": 0, "label": f"noise, {style.BAND_LABEL}"}
            draw_band(ax, part.t, np.zeros(len(part.t)), part.sigma, **noise)
        dots: dict[str, Any] = {"color": style.BLUE, "rasterized": many, "label": "measured minus modelled"}
        ax.plot(part.t, part.values, **(dots | style.DOT_STYLE | look))
        if with_band:
            style.mark_repaired(ax, part.t, part.repaired)
    ax.axhline(0, color="#666666", lw=0.7, zorder=1)


def _draw_modelled_force(ax: Axes, model: ModelResults, run: RunResults, **look: Any) -> None:
    for c in model.curves:
        if c.run == run.name:
            ax.plot(_abscissa(run, c.t), modelled_force(model, c, run), **(style.MODEL_STYLE | {"lw": 2.0} | look))


def modelled_force(model: ModelResults, curve: Curve, run: RunResults | None = None) -> Array:
    """Friction force of the model on one fitted segment, through the filter that the measured force went through.

    Parameters
    ----------
    model : ModelResults
        The fitted model.
    curve : Curve
        One segment of the fit, n samples.
    run : RunResults, optional
        Its run: the force is NaN where the filter smears it.

    Returns
    -------
    Array
        (n,) force, N; NaN after a gap in time. Where no filter is known, it is also NaN during a blow that is too short
        to be resolved: only its impulse is known.

    """
    known = style.unbroken(curve.t)
    own = next((motion for motion in model.motion if motion.run == curve.run), None)
    if curve.F_filtered is None and own is not None:
        known &= ~np.isin(curve.t, own.t[own.blow])
    if curve.F_filtered is not None and run is not None and run.friction is not None:
        clean = style.unsmeared_frames(run.friction, run.motion.guard)
        known &= clean[np.clip(np.searchsorted(run.friction.t, curve.t - 1e-9), 0, len(clean) - 1)]
    return style.masked(curve.F_as_measured, known)


def _draw_measured_force(ax: Axes, run: RunResults) -> None:
    """Draw the measured friction force of the free section with its band, without smeared frames."""
    f = run.friction
    if f is None:
        return
    F = style.masked(f.F, style.unsmeared_frames(f, run.motion.guard))
    draw_band(ax, _abscissa(run, f.t), F, f.sigma_F, color="#BBBBBB", alpha=0.6)
    ax.plot(_abscissa(run, f.t), F, color=style.MEASURED_COLOUR, lw=1.0, label="measured")


def _panel_title(model: ModelResults, run: RunResults) -> str:
    row = next((r for r in model.summary["per_run"] if r["run"] == run.name), None)
    if row is None or row["errors"].get("rms_displacement_um") is None:
        return run.name
    remark = ", not fitted" if row["role"] == "validation" else ""
    return f"{run.name}: {format_number(row['errors']['rms_displacement_um'])} µm{remark}"


def _mark_spans(ax: Axes, spans: Sequence[dict[str, Any]], color: str, axis: str) -> None:
    """Shade each span over an axis, with its share; a label that would overlap an earlier one is left out."""
    low, high = ax.get_xlim()
    labelled: list[float] = []
    for s in spans:
        a, b = (1e3 * end for end in s[axis])
        ax.axvspan(a, b, fc=color, lw=0, zorder=0.5, alpha=0.25, label="misfit here; share of the whole misfit")
        if any(abs((a + b) / 2 - t) < MIN_LABEL_DISTANCE * (high - low) for t in labelled):
            continue
        labelled.append((a + b) / 2)
        _write_over(ax, (a + b) / 2, 0.98, format_share(s["share_of_error"]), va="top", fontweight="bold")


def _write_over(ax: Axes, x: float, height: float, text: str, **look: Any) -> None:
    """Write a text over curves: at a place of the x axis, and at a share of the height of the panel."""
    box = {"facecolor": "white", "alpha": 0.75, "linewidth": 0, "pad": 0.6}
    ax.text(x, height, text, transform=ax.get_xaxis_transform(), ha="center", fontsize=9, bbox=box, **look)


def _share_y(panels: Sequence[Axes]) -> None:
    """Give all panels the same y axis."""
    reach = [ax.get_ylim() for ax in panels]
    for ax in panels:
        ax.set_ylim(min(low for low, _ in reach), max(high for _, high in reach))


ERROR_LOG_AXIS_RATIO = 8.0  # largest over smallest error, from which the axis is logarithmic
MIN_HISTORY_WIDTH_IN, INCHES_PER_MODEL = 4.5, 1.5
MIN_NOISE_SHOWN = 0.02  # of the smallest error: lower noise is not drawn
MAX_CHARACTERS = 8.0  # of the names of models side by side, per inch of the panel; more models are numbered
MAX_STEPS_NAMED = 2  # effects that one model adds to the one before; of more, the whole model is named


@dataclass(frozen=True)
class HeldOutError:
    """Held-out error of one model, um or N; `tried` for an effect that the diagnosis tried but nobody added."""

    label: str
    value: float
    tried: bool = False


def errors_of_models(models: Sequence[ModelResults], unit: str) -> list[HeldOutError]:
    """Held-out errors of the models that have one, each named by what it adds to the model before."""
    key = "heldout_rms_um" if unit == "µm" else "heldout_rms_N"
    steps = zip([None, *models], models, strict=False)
    found = ((_step(before, model), model.summary["errors"].get(key)) for before, model in steps)
    return [HeldOutError(label, float(error)) for label, error in found if error is not None]


def _step(previous: ModelResults | None, model: ModelResults) -> str:
    """The model, or what was added to or removed from the one before."""
    if previous is None:
        return plain_name(model.name)
    new, old = model.summary["model"], previous.summary["model"]
    gained, lost = [e for e in new if e not in old], [e for e in old if e not in new]
    steps = [*(f"+ {e}" for e in gained), *(f"without {e}" for e in lost)]
    return "\n".join(steps) if 0 < len(steps) <= MAX_STEPS_NAMED else plain_name(model.name)


@styled
def history(models: Sequence[AnyModel]) -> Figure:
    """Draw the held-out error of every model in the order in which they were fitted, and the noise.

    Parameters
    ----------
    models : sequence of ModelResults or Fit
        All models of the study.

    """
    tried = [as_model(model) for model in models]
    in_um = any(m.summary["errors"].get("heldout_rms_um") is not None for m in tried)
    unit = "µm" if in_um else "N"
    noise = noise_um(tried[-1]) if in_um else (tried[-1].diagnosis or {}).get("noise_N")
    errors = errors_of_models(tried, unit)
    width = min(style.PAGE_WIDTH_IN, MIN_HISTORY_WIDTH_IN + INCHES_PER_MODEL * len(errors))
    figure = new_figure(3.3, _history_title(errors, noise, unit), width)
    draw_held_out(figure.subplots(), errors, noise, unit, width)
    return figure


def _history_title(errors: Sequence[HeldOutError], noise: float | None, unit: str) -> str:
    against = _noise_words(noise, unit)
    if not errors:
        return "No held-out error was computed"
    before, after = errors[0].value, errors[-1].value
    if len(errors) == 1:
        return f"Held-out error of {errors[0].label}: {format_number(before)} {unit}{against}"
    return f"Held-out error {describe_change(before, after, unit)}{against}"


def draw_held_out(ax: Axes, errors: Sequence[HeldOutError], noise: float | None, unit: str, width: float) -> None:
    """Draw the errors and the noise into a panel of a width in inches; models whose names have no room are numbered."""
    values = np.array([one.value for one in errors])
    longest = [max(map(len, one.label.replace(" + ", "\n+ ").split("\n"))) for one in errors]
    is_named = sum(longest) <= MAX_CHARACTERS * width
    ax.plot(range(len(values)), values, color="#777777", lw=1.4, zorder=1)
    for k, one in enumerate(errors):
        colour = style.VERMILION if k == 0 and len(errors) > 1 else style.BLUE
        ax.plot(k, one.value, "o", ms=8, mec=colour, mfc="white" if one.tried else colour, mew=1.6, zorder=2)
        if is_named or k in (0, len(errors) - 1):
            falls = k > 0 and values[k - 1] > one.value  # the line comes from above, on the left
            number: dict[str, Any] = {"ha": "left" if falls else "center", "fontsize": 10, "fontweight": "bold"}
            style.note(ax, format_number(one.value), (k, one.value), (5, 5) if falls else (0, 9), **number)
    known = values
    if noise is not None and noise > MIN_NOISE_SHOWN * values.min(initial=np.inf):
        known = np.append(values, noise)
        ax.axhline(noise, color="black", ls=(0, (4, 2)), lw=1.2, zorder=0.5)
        style.note(ax, "noise", (0, noise), (4, 3), xycoords=("axes fraction", "data"))
    low, top = known.min(initial=np.inf), known.max(initial=0.0)
    if top > ERROR_LOG_AXIS_RATIO * low > 0:
        style.log_axis(ax, "y")
        ax.set_ylim(0.6 * low, 2.2 * top)
    else:
        ax.set_ylim(0, 1.25 * top or 1.0)
    names = [one.label.replace(" + ", "\n+ ") + ("\n(tried)" if one.tried else "") for one in errors]
    ax.set_xticks(range(len(errors)), names if is_named else [str(k) for k in range(1, len(errors) + 1)])
    ax.set_xlabel("" if is_named else "models in the order tried")
    ax.set_xlim(-0.5, len(errors) - 0.5)
    ax.set_ylabel(axis_label("held-out error, rms", unit))


MAX_MODELLED_RUNS = 6  # runs drawn; of more runs, those that fit worst
SMOOTHED_STYLE: dict[str, Any] = {"color": "#BBBBBB", "alpha": 0.7, "label": f"smoothed, {style.BAND_LABEL}"}
MODEL_BAND_STYLE: dict[str, Any] = {
    "facecolor": style.ORANGE,
    "edgecolor": style.MODEL_COLOUR,
    "alpha": 0.4,
    "hatch": "////",
    "label": f"model, {style.BAND_LABEL}",
}
BLOW_STYLE: dict[str, Any] = {
    "fill": False, "hatch": "xx", "lw": 0, "ec": "#999999", "zorder": 0.5, "label": "blow too short to resolve"
}  # fmt: skip


@styled
def modelled(model: AnyModel, runs: Sequence[AnyRun]) -> Figure:
    """Draw per run the acceleration, smoothed minus modelled acceleration, and friction force, with their bands.

    A blow that is too short to be resolved is hatched, without the model's line; its impulse is written there.

    Parameters
    ----------
    model : ModelResults or Fit
        The fitted model, with its own motion.
    runs : sequence of RunResults or Run
        All runs of the study.

    Raises
    ------
    ValueError
        If the model has no motion of its own.

    """
    model, runs = as_model(model), as_runs(runs)
    own = {motion.run: motion for motion in model.motion}
    shown = [run for run in worst_runs(model, runs) if run.name in own][:MAX_MODELLED_RUNS]
    if not shown:
        raise ValueError(f'expected a model with its own motion but "{model.name}" has none; fit it again')
    labels = ("time t / ms", "a / (m/s²)", "a − model / (m/s²)", "friction F / N")
    figure, cells = panel_grid(len(shown), (5.4, 0.8), modelled_title(model), labels)
    for cell, run in zip(cells, shown, strict=True):
        _draw_modelled_run(cell, own[run.name], run, _impulses(model, run.name))
    return figure


def modelled_title(model: ModelResults) -> str:
    """Title of `modelled`: standard deviations of the acceleration by the model and by smoothing."""
    rows = [row["motion"] for row in model.summary["per_run"] if row["role"] == "fit" and row.get("motion")]
    if not rows:
        return f"{plain_name(model.name)}: its own motion over the smoothed motion"
    own, smooth = (format_number(_rms([row[key] for row in rows]), 2) for key in ("sigma_a", "sigma_a_smoothed"))
    motion = f"{plain_name(model.name)}: std of a {own} m/s²; by smoothing {smooth} m/s²"
    return f"{motion}; the model misses something" if any(row["notes"] for row in rows) else motion


def _rms(values: Sequence[float | None]) -> float | None:
    known = [v for v in values if v is not None]
    return float(np.sqrt(np.mean(np.square(known)))) if known else None


def _draw_modelled_run(cell: Sequence[Axes], motion: ModelledMotion, run: RunResults, impulses: str) -> None:
    """Draw one run in its three panels."""
    m, f, rows = run.motion, run.friction, np.searchsorted(run.motion.t, motion.t - 1e-9)
    t, at, seen = 1e3 * motion.t, 1e3 * m.t[rows], ~motion.blow
    clean = (style.unsmeared(m) if f is None else style.unsmeared_frames(f, m.guard))[rows]
    clean = clean if np.any(clean) else ~clean  # of a very short run all frames
    none = np.zeros(len(motion))
    panels = (
        (m.a[rows], m.sigma_a[rows], motion.a, motion.sigma_a),
        (m.a[rows] - motion.a, m.sigma_a[rows], none, motion.sigma_a),
        (motion.F if f is None else f.F[rows], none if f is None else f.sigma_F[rows], motion.F, motion.sigma_F),
    )
    for ax, (smooth, sigma, own, own_sigma) in zip(cell, panels, strict=True):
        shown = style.masked(smooth, clean)
        draw_band(ax, at, shown, sigma, **SMOOTHED_STYLE)
        ax.plot(at, shown, color=style.MEASURED_COLOUR, lw=1.0, label="smoothed")
        _draw_model(ax, motion, own, own_sigma)
        # most of the smoothed line: a smeared blow must not set the scale
        reach = np.quantile(smooth[clean & seen], [0.02, 0.98])
        style.set_y_limits(ax, (reach, own[seen] - 2 * own_sigma[seen], own[seen] + 2 * own_sigma[seen]))
    for ax in cell:
        for s in stretches(motion.blow):
            ax.axvspan(t[s.start], t[s.stop - 1], **BLOW_STYLE)
        ax.set_xlim(t[0], t[-1])
    cell[0].set_title(motion.run + (", not fitted" if motion.role == "validation" else ""), fontweight="normal")
    if impulses and np.any(motion.blow):
        _write_over(cell[0], float(np.mean(t[motion.blow])), 0.04, impulses)


def _draw_model(ax: Axes, motion: ModelledMotion, values: Array, sigma: Array) -> None:
    """Draw the model's line with its band, segment by segment, with a gap at an unresolved blow."""
    for k in np.unique(motion.segment):
        at = motion.segment == k
        shown = style.masked(values, ~motion.blow)[at]
        draw_band(ax, 1e3 * motion.t[at], shown, sigma[at], **MODEL_BAND_STYLE, zorder=2.5)
        ax.plot(1e3 * motion.t[at], shown, zorder=3, lw=1.6, **style.MODEL_STYLE)


def _impulses(model: ModelResults, run: str) -> str:
    """Impulses of a run's collisions as text."""
    known = [c for c in model.summary.get("collisions", []) if c["run"] == run and c["impulse_N_s"] is not None]
    sizes = ((format_number(1e3 * c["impulse_N_s"]), format_number(1e3 * c["std"], 1)) for c in known)
    return ", ".join(f"J = {impulse} ± {std} mN s" for impulse, std in sizes)
