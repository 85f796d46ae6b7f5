"""The look that all figures share: colour-blind safe, readable printed in grey, no global state left behind.

Colours are those of Okabe and Ito (2008, jfly.uni-koeln.de/color); wherever two things meet in one panel they
differ in line style, marker or hatching too. Figures are `matplotlib.figure.Figure`, never pyplot's.
"""

from __future__ import annotations

import io
import re
from collections.abc import Callable, Iterable, Sequence
from functools import wraps
from threading import RLock
from typing import Any, ParamSpec

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure

from frictrack import records
from frictrack.number_format import format_unit
from frictrack.records import Array, Friction, Mask

BLACK, ORANGE, SKY, GREEN = "#000000", "#E69F00", "#56B4E9", "#009E73"
YELLOW, BLUE, VERMILLION, PURPLE = "#F0E442", "#0072B2", "#D55E00", "#CC79A7"
MEASURED, MODEL, NOISE, FREE, FAILS = "#333333", VERMILLION, "#CFE3F1", "#EAF3EA", "#FBE3B5"
RUNS: list[dict[str, Any]] = [
    {"color": color, "linestyle": dash}
    for dash in ("-", (0, (5, 1.5)), (0, (1, 1)))
    for color in (BLUE, ORANGE, GREEN, PURPLE, SKY, VERMILLION)
]  # one per run, then again dashed and dotted
SIGMAS = 2.0  # half width of every band, standard deviations
WIDTH = 10.0  # inches of a figure over the whole page
MAX_POINTS = 1500  # of a band; more than a page can show
DOTS: dict[str, Any] = {"linestyle": "none", "marker": ".", "markersize": 2.5}

STYLE: Any = {
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans"],
    "font.size": 10,
    "axes.titlesize": 10.5,
    "axes.titlelocation": "left",
    "axes.titleweight": "bold",
    "axes.labelsize": 10,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": "#666666",
    "axes.linewidth": 0.8,
    "axes.labelcolor": "#222222",
    "axes.axisbelow": True,
    "xtick.color": "#444444",
    "ytick.color": "#444444",
    "xtick.labelsize": 9,
    "ytick.labelsize": 9,
    "legend.fontsize": 9,
    "legend.frameon": False,
    "legend.handlelength": 2.4,
    "lines.linewidth": 1.5,
    "hatch.linewidth": 0.6,
    "hatch.color": "#777777",
    "figure.titlesize": 12,
    "figure.titleweight": "bold",
    "svg.fonttype": "none",
    "svg.hashsalt": "frictrack",
    "path.simplify_threshold": 0.2,
}

P = ParamSpec("P")
_ALONE = RLock()  # matplotlib's settings are one for all threads


def styled(draw: Callable[P, Figure]) -> Callable[P, Figure]:
    """Draw in our style and leave matplotlib's settings as they were."""

    @wraps(draw)
    def drawn(*args: P.args, **kwargs: P.kwargs) -> Figure:
        with _ALONE, mpl.rc_context(STYLE):
            return draw(*args, **kwargs)

    return drawn


def blank(height: float, title: str, width: float = WIDTH) -> Figure:
    """An empty figure of some inches, its title at the left."""
    figure = Figure(figsize=(width, height), layout="constrained")
    figure.suptitle(title, x=0.01, ha="left")
    return figure


def svg(figure: Figure) -> str:
    """The figure as an `<svg>` element: no header, no metadata, coordinates to a hundredth of a point."""
    with _ALONE, mpl.rc_context(STYLE):
        held = io.StringIO()
        figure.set_dpi(200)
        canvas, engine = FigureCanvasSVG(figure), figure.get_layout_engine()
        if engine is not None:  # laid out once here; `savefig` would draw the whole figure once more for that
            engine.execute(figure)
            figure.set_layout_engine("none")
        canvas.print_svg(held, metadata=dict.fromkeys(("Date", "Creator", "Format", "Type")))
    text = held.getvalue()
    text = re.sub(r"<metadata>.*?</metadata>\s*", "", text[text.index("<svg") :], flags=re.DOTALL)
    return re.sub(r' (?:d|x|y)="[^"]*"', lambda m: re.sub(r"(\.\d\d)\d+", r"\1", m[0]), text)  # half the size


def png(figure: Figure, dpi: float = 110) -> bytes:
    """The figure as a PNG file."""
    with _ALONE, mpl.rc_context(STYLE):
        held = io.BytesIO()
        figure.savefig(held, format="png", dpi=dpi)
    return held.getvalue()


def axis(quantity: str, written: str) -> str:
    """Label of an axis, quantity over unit: ``"velocity v / (m/s)"``."""
    text = format_unit(written)
    return f"{quantity} / ({text})" if "/" in text else f"{quantity} / {text}" if text else quantity


def band(ax: Axes, x: Array, middle: Array, sigma: Array, **look: Any) -> None:
    """A shaded band of `SIGMAS` standard deviations round a line."""
    step = max(1, len(x) // MAX_POINTS)
    x, middle, sigma = x[::step], middle[::step], SIGMAS * sigma[::step]
    ax.fill_between(x, middle - sigma, middle + sigma, linewidth=0, **look)


def broken(values: Array, mask: Mask) -> Array:
    """The values where the mask holds, NaN elsewhere: a line with gaps."""
    return np.where(mask, values, np.nan)


def run_looks(runs: Sequence[Any]) -> dict[str, dict[str, Any]]:
    """Colour and dashes of the runs of a study by name, the same in all figures."""
    return {run.name: RUNS[k % len(RUNS)] for k, run in enumerate(runs)}


def stretches(friction: Friction) -> list[slice]:
    """Free sections as slices of the record."""
    return records.stretches(friction.free)


def clear(friction: Friction, guard: int) -> Mask:
    """Free frames whose force the filter does not smear: away from the record's ends and from a stop inside it."""
    out = np.zeros(len(friction), dtype=bool)
    for s in stretches(friction):
        if s.stop - s.start > 3 * guard:
            out[s.start + guard : s.stop - guard] = True
        else:
            out[s] = True
    return out


def across(n: int) -> int:
    """Panels in a row, of n: at most three, and none left alone."""
    return 2 if n == 4 else min(3, n)


def scaled(values: Array, written: str) -> tuple[float, str]:
    """Factor and unit in which small lengths, times and forces read as plain numbers: ``(1e3, "mm")``."""
    largest = float(np.nanmax(np.abs(values), initial=0.0))
    if written not in ("m", "s", "N", "N s", "m/s") or not 0 < largest < 1.0:
        return 1.0, written
    return (1e3, f"m{written}") if largest >= 5e-4 else (1e6, f"µ{written}")


def robust(ax: Axes, values: Iterable[Array], margin: float = 0.08) -> None:
    """Limit the y axis to what the given values reach, so that smeared ends do not set the scale."""
    together = np.concatenate([np.ravel(v) for v in values])
    together = together[np.isfinite(together)]
    if len(together):
        low, high = float(together.min()), float(together.max())
        room = margin * ((high - low) or abs(high) or 1.0)
        ax.set_ylim(low - room, high + room)


def numbered_name(group: str) -> str:
    """The same with its number in the history, which keeps apart what was tried twice: ``"2. Tustin + texture"``."""
    return f"{group.split('_', 1)[0]}. {plain_name(group)}"


def plain_name(group: str) -> str:
    """The name of a model in words: ``"2_tustin+texture"`` -> ``"Tustin + texture"``."""
    words = group.split("_", 1)[-1].split("+")
    known = {
        "tustin": "Tustin",
        "coulomb": "Coulomb",
        "stribeck": "Stribeck",
        "stribeck-model": "Stribeck model",
    }
    words = [known.get(w, w.upper() if w.startswith("atm") else w) for w in words]
    return " + ".join(words)
