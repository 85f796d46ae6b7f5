"""Draw the choice of the cut-off frequency: noise that passes against signal that is lost."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from frictrack.number_format import format_number, format_unit
from frictrack.plots import style
from frictrack.plots.style import axis_label, new_figure, styled
from frictrack.records import CutoffTradeOff


@styled
def cutoff(name: str, found: CutoffTradeOff, mass: float | None = None) -> Figure:
    """Draw the residual analysis (above) and the sum of noise and lost signal (below) over the cut-off frequency.

    Parameters
    ----------
    name : str
        Name of the run.
    found : Trade
        Errors of the acceleration over the cut-off frequency.
    mass : float, optional
        Mass, kg. With it errors are forces in N, without it accelerations in m/s².

    References
    ----------
    D. A. Winter (2009): Biomechanics and Motor Control of Human Movement, 4th ed., residual analysis.

    """
    factor, unit = (1.0, "m/s^2") if mass is None else (mass, "N")
    figure = new_figure(5.4, _title(name, found, factor, unit), width=style.PAGE_WIDTH_IN / 2)
    above, below = figure.subplots(2, 1, sharex=True)
    f = found.frequency
    above.loglog(f, 1e6 * found.residual, color=style.MEASURED_COLOUR, lw=1.6, label="removed by the filter")
    above.loglog(f, 1e6 * found.floor, color=style.BLUE, lw=1.3, ls="--", label="noise alone")
    above.set_ylabel(axis_label("residual", "µm"))
    below.loglog(f, factor * found.total, color=style.MEASURED_COLOUR, lw=1.8, label="total")
    below.loglog(f, factor * found.noise, color=style.BLUE, lw=1.3, ls="--", label="noise that passes")
    below.loglog(f, factor * found.lost, color=style.VERMILLION, lw=1.3, ls=":", label="signal lost")
    below.axhline(
        factor * found.structural, color=style.GREEN, lw=1.6, ls="-.", label="total, vibrations and events modelled"
    )
    below.loglog(f, factor * found.hidden, color="#999999", lw=1.0, label="undetectable vibration")
    top = factor * float(np.max(found.total[f < 3.0 * max(found.chosen, found.least)], initial=found.structural))
    below.set_ylim(0.3 * factor * min(found.structural, float(found.total.min())), 3.0 * top)
    below.set(
        xlabel=axis_label("cut-off frequency", "Hz"), ylabel=axis_label("error of m a" if mass else "error of a", unit)
    )
    for ax in (above, below):
        ax.axvline(found.chosen, color=style.ORANGE, lw=2.0, zorder=0)
        ax.legend(fontsize=8, loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=2)  # a curve may run anywhere inside
    above.annotate(
        f"{format_number(found.chosen)} Hz", (found.chosen, 1.0), xycoords=("data", "axes fraction"),
        xytext=(3, -10), textcoords="offset points", fontsize=8,
    )  # fmt: skip
    return figure


def _title(name: str, found: CutoffTradeOff, factor: float, unit: str) -> str:
    noise, lost = found.at(found.chosen)
    plain, apart = factor * float(np.hypot(noise, lost)), factor * found.structural
    written = format_unit(unit)
    return f"{name}: error {format_number(apart, 2)} {written}; plain low-pass {format_number(plain, 2)} {written}"
