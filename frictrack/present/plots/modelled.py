"""Draw the motion that a fitted model predicts over the smoothed motion: acceleration and friction force."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from frictrack.base.number_format import format_number
from frictrack.present.plots import style
from frictrack.present.plots.inputs import AnyModel, AnyRun, as_model, as_runs
from frictrack.present.plots.model import worst_runs
from frictrack.present.plots.style import axis_label, draw_band, panel_grid, plain_name, styled
from frictrack.records import Array, ModelledMotion, stretches
from frictrack.results import ModelResults, RunResults

MAX_PANELS = 6  # runs drawn; of more runs, those that fit worst
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
    shown = [name for name in worst_runs(model, runs) if name in own][:MAX_PANELS]
    if not shown:
        raise ValueError(f'expected a model with its own motion but "{model.name}" has none; fit it again')
    by_name = {run.name: run for run in runs}
    labels = (axis_label("time t", "ms"), axis_label("a", "m/s^2"), axis_label("a − model", "m/s^2"),
              axis_label("friction F", "N"))  # fmt: skip
    figure, cells = panel_grid(len(shown), (5.4, 0.8), modelled_title(model), labels)
    for cell, name in zip(cells, shown, strict=True):
        _draw_run(cell, own[name], by_name[name], _impulses(model, name))
    style.legend_below(figure)
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


def _draw_run(cell: Sequence[Axes], motion: ModelledMotion, run: RunResults, impulses: str) -> None:
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
        middle = float(np.mean(t[motion.blow]))
        cell[0].text(middle, 0.04, impulses, transform=cell[0].get_xaxis_transform(), ha="center", fontsize=9).set_bbox(
            {"facecolor": "white", "alpha": 0.75, "linewidth": 0, "pad": 0.6}
        )


def _draw_model(ax: Axes, motion: ModelledMotion, values: Array, sigma: Array) -> None:
    """Draw the model's line with its band, segment by segment, with a gap at an unresolved blow."""
    for k in np.unique(motion.segment):
        at = motion.segment == k
        shown = style.masked(values, ~motion.blow)[at]
        draw_band(ax, 1e3 * motion.t[at], shown, sigma[at], **MODEL_BAND_STYLE, zorder=2.5)
        ax.plot(1e3 * motion.t[at], shown, zorder=3, lw=1.6, **style.MODEL_STYLE)


def _impulses(model: ModelResults, run: str) -> str:
    """Impulses of a run's collisions as text."""
    motion = [c for c in model.summary.get("collisions", []) if c["run"] == run and c["impulse_N_s"] is not None]
    return ", ".join(
        f"J = {format_number(1e3 * c['impulse_N_s'])} ± {format_number(1e3 * c['std'], 1)} mN s" for c in motion
    )
