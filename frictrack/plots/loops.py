"""Where friction itself was measured: its loops against place and velocity, the model on the measurement."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from frictrack.number_format import format_number
from frictrack.plots import style
from frictrack.plots.model import worst_runs
from frictrack.plots.style import axis, blank, plain_name, styled
from frictrack.records import Array, Curve, Mask
from frictrack.results import ModelResults, RunResults

MAX_PANELS = 4  # runs drawn; of more, those that fit worst
GAP = 1.5  # usual steps of time beyond which a line is broken


@styled
def loops(model: ModelResults, runs: Sequence[RunResults]) -> Figure:
    """Per run, measured and modelled friction force against displacement and against velocity.

    Raises ValueError where no friction was measured.
    """
    by_name = {run.name: run for run in runs}
    shown = [name for name in worst_runs(model, runs) if by_name[name].friction is not None][:MAX_PANELS]
    if not shown:
        raise ValueError("expected a run with a friction force but got none")
    figure = blank(3.1 * len(shown) + 0.6, _title(model))
    panels = figure.subplots(len(shown), 2, squeeze=False, sharey="row")
    for (left, right), name in zip(panels, shown, strict=True):
        _loops((left, right), [c for c in model.curves if c.run == name], by_name[name])
        left.set_title(name, fontweight="normal")
        left.set_ylabel("friction force F / N")
    handles = [
        Line2D([], [], color=style.MEASURED, lw=1.0, label="measured"),
        Line2D([], [], color=style.MODEL, lw=1.8, ls=(0, (4, 1.2)), label="model"),
    ]
    figure.legend(handles=handles, loc="outside lower left", ncols=2)
    return figure


def _loops(pair: tuple[Axes, Axes], curves: Sequence[Curve], run: RunResults) -> None:
    """One run: F against x measured from the middle of the travel, and against v."""
    f = run.friction
    assert f is not None
    everywhere = np.concatenate([c.x for c in curves])
    middle = 0.5 * float(everywhere.min() + everywhere.max())
    for ax, of, words, unit in (
        (pair[0], lambda c: c.x - middle, "displacement x from the middle", "m"),
        (pair[1], lambda c: c.v_model, "velocity v", "m/s"),
    ):
        factor, written = style.scaled(np.concatenate([of(c) for c in curves]), unit)
        for c in curves:
            at, unbroken = factor * of(c), _unbroken(c.t)
            ax.plot(at, style.broken(np.interp(c.t, f.t, f.F), unbroken), color=style.MEASURED, lw=0.9)
            ax.plot(at, style.broken(c.F_model, unbroken), color=style.MODEL, lw=1.8, ls=(0, (4, 1.2)))
        ax.axhline(0, color="#BBBBBB", lw=0.7, zorder=0)
        ax.set_xlabel(axis(words, written))
    pair[1].axvline(0, color="#BBBBBB", lw=0.7, zorder=0)


def _unbroken(t: Array) -> Mask:
    """Frames (n,) that do not follow on a gap."""
    steps = np.diff(t, prepend=t[0])
    return np.asarray(steps <= GAP * np.median(steps))


def _title(model: ModelResults) -> str:
    error = model.summary["errors"]["relative_force_error"]
    return f"{plain_name(model.name)} leaves {format_number(100 * error, 2)} % of the measured friction force"
