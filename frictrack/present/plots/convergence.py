"""Draw a global search generation by generation: best and mean misfit, diversity, and the best parameters."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from frictrack.base.errors import FrictrackError
from frictrack.base.number_format import format_number
from frictrack.present.plots import style
from frictrack.present.plots.inputs import AnyModel, AnyRun, as_model
from frictrack.present.plots.style import new_figure, styled
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
    figure = new_figure(6.2, _title(model.summary, found))
    panels = figure.subplots(3, len(found), squeeze=False, sharex="col", height_ratios=HEIGHT_RATIOS)
    for column, (group, one) in zip(panels.T, found.items(), strict=True):
        _draw(column, one)
        column[0].set_title("" if len(found) == 1 else group)
    for ax, label in zip(panels[:, 0], ("misfit", "diversity", "place within the bounds"), strict=True):
        ax.set_ylabel(label)
    figure.align_ylabels(panels[:, 0])
    return figure


def _title(summary: Mapping[str, Any], found: Mapping[str, Convergence]) -> str:
    """Name of the search, its generations, and how far the misfit fell."""
    name = summary["search"].upper()
    one = next(iter(found.values()))
    if len(found) > 1:
        return f"{name}: convergence in {len(found)} groups"
    end = ", stopped by hand" if summary.get("searched", {}).get("ended") == "interrupted" else ""
    first, last = format_number(one.best[0]), format_number(one.best[-1])
    return f"{name}: misfit from {first} to {last} in {len(one.best) - 1} generations{end}"


def _draw(column: Sequence[Axes], one: Convergence) -> None:
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
    below.set(ylim=(-0.02, 1.02), xlabel="generation")
    below.legend(loc="upper left", bbox_to_anchor=(0, -0.28), ncols=4, fontsize=8)
    for ax in column:
        for start in generation[1:][np.diff(one.start) > 0]:
            ax.axvline(start, color="#666666", lw=0.8, ls=(0, (1, 1)))
