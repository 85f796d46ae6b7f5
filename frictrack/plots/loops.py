"""Draw measured and modelled friction force against displacement and velocity, for friction that was measured."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from frictrack.number_format import format_number
from frictrack.plots import style
from frictrack.plots.inputs import AnyModel, AnyRun, as_model, as_runs
from frictrack.plots.model import worst_runs
from frictrack.plots.style import axis_label, new_figure, plain_name, styled
from frictrack.records import Array, Curve, Mask
from frictrack.results import ModelResults, RunResults

MAX_PANELS = 4  # runs drawn; of more runs, those that fit worst
MAX_GAP_STEPS = 1.5  # median time steps; a line has a gap where the step is longer


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
    by_name = {run.name: run for run in runs}
    shown = [name for name in worst_runs(model, runs) if by_name[name].friction is not None][:MAX_PANELS]
    if not shown:
        raise ValueError("expected a run with a friction force but got none")
    figure = new_figure(3.1 * len(shown) + 0.6, _title(model))
    panels = figure.subplots(len(shown), 2, squeeze=False, sharey="row")
    for (left, right), name in zip(panels, shown, strict=True):
        _loops((left, right), [c for c in model.curves if c.run == name], by_name[name])
        left.set_title(name, fontweight="normal")
        left.set_ylabel("friction force F / N")
    handles = [
        Line2D([], [], color=style.MEASURED_COLOUR, lw=1.0, label="measured"),
        Line2D([], [], color=style.MODEL_COLOUR, lw=1.8, ls=(0, (4, 1.2)), label="model"),
    ]
    figure.legend(handles=handles, loc="outside lower left", ncols=2)
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
            at, unbroken = factor * of(c), _unbroken(c.t)
            ax.plot(at, style.masked(np.interp(c.t, f.t, f.F), unbroken), color=style.MEASURED_COLOUR, lw=0.9)
            ax.plot(at, style.masked(c.F_model, unbroken), color=style.MODEL_COLOUR, lw=1.8, ls=(0, (4, 1.2)))
        ax.axhline(0, color="#BBBBBB", lw=0.7, zorder=0)
        ax.set_xlabel(axis_label(words, written))
    pair[1].axvline(0, color="#BBBBBB", lw=0.7, zorder=0)


def _unbroken(t: Array) -> Mask:
    """(n,) False at the first frame after a gap in time."""
    steps = np.diff(t, prepend=t[0])
    return np.asarray(steps <= MAX_GAP_STEPS * np.median(steps))


def _title(model: ModelResults) -> str:
    error = model.summary["errors"]["relative_force_error"]
    return f"{plain_name(model.name)}: error {format_number(100 * error, 2)} % of the measured friction force"
