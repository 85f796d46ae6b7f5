"""Draw what several figures need: bands, broken lines, axis labels and axis limits."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.ticker import LogLocator, NullFormatter

from frictrack.number_format import format_unit
from frictrack.plots.style.colours import REPAIRED_COLOUR
from frictrack.records import Array, Friction, Mask, stretches

BAND_SIGMAS = 2.0  # half width of every band, standard deviations
MAX_POINTS = 1500  # of a band; a page cannot show more
MAX_COLUMNS = 4  # of a grid of panels
PREFIXED_UNITS = ("m", "s", "N", "N s", "m/s")  # units whose thousandths and millionths are common


def axis_label(quantity: str, unit: str) -> str:
    """Label an axis as quantity over unit (ISO 80000-1).

    Examples
    --------
    >>> axis_label("velocity v", "m/s"), axis_label("force F", "N"), axis_label("depth", "1")
    ('velocity v / (m/s)', 'force F / N', 'depth')

    """
    text = format_unit(unit)
    return f"{quantity} / ({text})" if "/" in text else f"{quantity} / {text}" if text else quantity


def draw_band(ax: Axes, x: Array, middle: Array, sigma: Array, **style: Any) -> None:
    """Shade `BAND_SIGMAS` standard deviations on both sides of a line.

    Parameters
    ----------
    ax : Axes
        Where to draw.
    x, middle, sigma : Array
        (n,) abscissa, line, and standard deviation. At most `MAX_POINTS` are drawn.
    **style
        Arguments of `Axes.fill_between`.

    """
    step = max(1, len(x) // MAX_POINTS)
    x, middle, sigma = x[::step], middle[::step], BAND_SIGMAS * sigma[::step]
    ax.fill_between(x, middle - sigma, middle + sigma, linewidth=0, **style)


def masked(values: Array, mask: Mask) -> Array:
    """Replace the values outside a mask by NaN, so that a line has gaps there.

    Examples
    --------
    >>> masked(np.array([1.0, 2.0]), np.array([True, False])).tolist()
    [1.0, nan]

    """
    return np.where(mask, values, np.nan)


def unsmeared_frames(friction: Friction, guard: int) -> Mask:
    """Find the free frames whose force the low-pass filter does not smear.

    Parameters
    ----------
    friction : Friction
        Friction force of n frames, with its free sections.
    guard : int
        Frames that the filter smears at each end of a section.

    Returns
    -------
    Mask
        (n,) True away from the ends of each free section; a section of at most 3 `guard` frames is kept whole.

    """
    out = np.zeros(len(friction), dtype=bool)
    for section in stretches(friction.free):
        if section.stop - section.start > 3 * guard:
            out[section.start + guard : section.stop - guard] = True
        else:
            out[section] = True
    return out


def panel_columns(n: int) -> int:
    """Columns of a grid of n panels: at most four, in rows as even as possible.

    Examples
    --------
    >>> [panel_columns(n) for n in (1, 2, 3, 4, 5, 6, 8)]
    [1, 2, 3, 4, 3, 3, 4]

    """
    rows = -(-n // MAX_COLUMNS)
    return -(-n // rows) if n else 1


def log_axis(ax: Axes, which: str, subs: Sequence[float] = (1, 2, 5)) -> None:
    """Make the "x" or the "y" axis logarithmic, with plain numbers at the ticks."""
    getattr(ax, f"set_{which}scale")("log")
    axis = ax.xaxis if which == "x" else ax.yaxis
    axis.set_major_locator(LogLocator(subs=subs))
    axis.set_major_formatter(lambda value, _: f"{value:g}")
    axis.set_minor_formatter(NullFormatter())


def axis_scale(values: Array, unit: str) -> tuple[float, str]:
    """Choose the prefix of an axis whose values are small.

    Returns
    -------
    factor : float
        Factor from the given unit to the one of the axis.
    unit : str
        Unit of the axis.

    Examples
    --------
    >>> axis_scale(np.array([0.012, -0.04]), "m")
    (1000.0, 'mm')

    """
    largest = float(np.nanmax(np.abs(values), initial=0.0))
    if unit not in PREFIXED_UNITS or not 0 < largest < 1.0:
        return 1.0, unit
    return (1e3, f"m{unit}") if largest >= 5e-4 else (1e6, f"µ{unit}")


def set_y_limits(ax: Axes, values: Iterable[Array], margin: float = 0.08) -> None:
    """Limit the y axis to the given values and a margin, so that smeared ends do not set the scale.

    Parameters
    ----------
    ax : Axes
        The panel.
    values : iterable of Array
        Arrays of any shape; NaN is ignored.
    margin : float
        Margin over the range of the values.

    """
    together = np.concatenate([np.ravel(v) for v in values])
    together = together[np.isfinite(together)]
    if len(together):
        low, high = float(together.min()), float(together.max())
        room = margin * ((high - low) or abs(high) or 1.0)
        ax.set_ylim(low - room, high + room)


def mark_repaired(ax: Axes, x: Array, codes: np.ndarray[Any, Any] | None) -> None:
    """Mark the frames that the user repaired by small ticks at the lower edge.

    Parameters
    ----------
    ax : Axes
        Where to draw.
    x : Array
        (n,) values of the frames on the x axis.
    codes : array of int or None
        (n,) 0 for frames that were not repaired; None if there are none.

    """
    if codes is None or not np.any(codes):
        return
    at = x[codes > 0]
    marks: Any = {"color": REPAIRED_COLOUR, "marker": "|", "markersize": 6, "linestyle": "none", "zorder": 4}
    ax.plot(at, np.zeros(len(at)), transform=ax.get_xaxis_transform(), clip_on=False, **marks)


def repaired_handles(codes: np.ndarray[Any, Any] | None) -> list[Line2D]:
    """Return the entry of a legend for the ticks of `mark_repaired`; empty if no frame was repaired."""
    if codes is None or not np.any(codes):
        return []
    look: Any = {"color": REPAIRED_COLOUR, "marker": "|", "markersize": 6, "linestyle": "none"}
    return [Line2D([], [], label="repaired by the user", **look)]
