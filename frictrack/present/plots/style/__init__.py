"""The style that all figures share: colours, axes, grids of panels, files, and the names of models.

The palette is safe for colour-blind readers. Where two things meet in one panel, they also differ in line style,
marker or hatching, so that figures can be read in grey.

References
----------
M. Okabe, K. Ito (2008): Color Universal Design, https://jfly.uni-koeln.de/color/.

"""

from __future__ import annotations

import gc
import io
import re
from base64 import b64encode
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from functools import wraps
from html import escape
from pathlib import Path
from threading import RLock
from typing import Any, ParamSpec

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.backends.backend_svg import FigureCanvasSVG, RendererSVG
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, MaxNLocator, NullFormatter

from frictrack.base.number_format import format_unit
from frictrack.present.plots.style.tick_rows import ticks_in_rows
from frictrack.records import Array, Friction, Mask, Motion, away_from_ends
from frictrack.results.candidates import AXES

BLACK, ORANGE, SKY, GREEN = "#000000", "#E69F00", "#56B4E9", "#009E73"
YELLOW, BLUE, VERMILION, PURPLE = "#F0E442", "#0072B2", "#D55E00", "#CC79A7"
MEASURED_COLOUR, MODEL_COLOUR, NOISE_COLOUR, FREE_COLOUR = "#333333", VERMILION, "#CFE3F1", "#EAF3EA"
REPAIRED_STYLE: Any = {"color": PURPLE, "marker": "|", "ms": 6, "ls": "none", "label": "repaired by the user"}
RUN_STYLES: list[dict[str, Any]] = [
    {"color": color, "linestyle": dash}
    for dash in ("-", (0, (5, 1.5)), (0, (1, 1)))
    for color in (BLUE, ORANGE, GREEN, PURPLE, SKY, VERMILION)
]  # one per run, then again dashed and dotted
DOT_STYLE: dict[str, Any] = {"linestyle": "none", "marker": ".", "markersize": 2.5}
MODEL_STYLE: dict[str, Any] = {"color": MODEL_COLOUR, "linestyle": (0, (4, 1.2)), "label": "model"}
ZERO_STYLE: dict[str, Any] = {"color": "#BBBBBB", "linewidth": 0.7, "zorder": 0}  # of a line at zero behind all else

RC_PARAMS = mpl.rc_params_from_file(Path(__file__).with_name("frictrack.mplstyle"), use_default_template=False)


def run_styles(runs: Sequence[Any]) -> dict[str, dict[str, Any]]:
    """Assign a colour and a line style to each run of a study, the same in all figures.

    Parameters
    ----------
    runs : sequence
        Objects with a `name`, in the order of the study.

    Returns
    -------
    dict
        Keyword arguments of `Axes.plot` by the name of the run.

    """
    return {run.name: RUN_STYLES[k % len(RUN_STYLES)] for k, run in enumerate(runs)}


Y_MARGIN = 0.08  # of the range of values, above and below
BAND_SIGMAS = 2.0  # half width of every band, standard deviations
BAND_LABEL = f"± {BAND_SIGMAS:g} std"
MAX_POINTS = 1500  # of a band; a page cannot show more
MAX_COLUMNS = 4  # of a grid of panels
MAX_GAP_STEPS = 1.5  # median time steps; a line has a gap where the step is longer
MAX_FINE_RATIO = 200.0  # of the ends of a logarithmic axis with ticks at 1, 2 and 5
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


def note(ax: Axes, text: str, at: tuple[float, float], shift: tuple[float, float], **look: Any) -> None:
    """Write a text beside a point of a panel, shifted by some points (1/72 inch)."""
    ax.annotate(text, at, shift, textcoords="offset points", **({"fontsize": 9} | look))


def name_rows(ax: Axes, names: Sequence[str], top: float = -0.6) -> None:
    """Name the rows of a panel, at the places 0, 1, ..., the first on top."""
    ax.set_yticks(range(len(names)), names)
    ax.set_ylim(len(names) - 0.4, top)
    ax.tick_params(axis="y", length=0)


def masked(values: Array, mask: Mask) -> Array:
    """Replace the values outside a mask by NaN, so that a line has gaps there.

    Examples
    --------
    >>> masked(np.array([1.0, 2.0]), np.array([True, False])).tolist()
    [1.0, nan]

    """
    return np.where(mask, values, np.nan)


def unbroken(t: Array) -> Mask:
    """Find the frames (n,) that follow the one before: a line has a gap where the step is longer than usual."""
    steps = np.diff(t, prepend=t[0])
    return np.asarray(steps <= MAX_GAP_STEPS * np.median(steps))


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
    return away_from_ends(friction.free, guard)


def unsmeared(motion: Motion) -> Mask:
    """Find the frames (n,) away from the ends that the low-pass filter smears; all frames of a very short record."""
    return away_from_ends(np.ones(len(motion), dtype=bool), motion.guard)


def log_axis(ax: Axes, which: str) -> None:
    """Make the "x" or the "y" axis logarithmic, with plain numbers at the ticks; over many decades only at powers."""
    low, high = getattr(ax.dataLim, f"interval{which}")
    getattr(ax, f"set_{which}scale")("log")
    axis = ax.xaxis if which == "x" else ax.yaxis
    subs = (1, 2, 5) if high < MAX_FINE_RATIO * low else (1,)
    axis.set_major_locator(LogLocator(subs=subs) if high > 5 * low else MaxNLocator(4))  # two ticks at least
    axis.set_major_formatter(lambda value, _: f"{value:g}")
    axis.set_minor_formatter(NullFormatter())


def motion_label(axis: str) -> str:
    """Label one of the axes over which a misfit or a force may repeat."""
    return axis_label(AXES[axis].label, AXES[axis].unit)


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


def set_y_limits(ax: Axes, values: Iterable[Array]) -> None:
    """Limit the y axis to the given values and a margin, so that smeared ends do not set the scale.

    Parameters
    ----------
    ax : Axes
        The panel.
    values : iterable of Array
        Arrays of any shape; NaN is ignored.

    """
    together = np.concatenate([np.ravel(v) for v in values])
    together = together[np.isfinite(together)]
    if len(together):
        low, high = float(together.min()), float(together.max())
        room = Y_MARGIN * ((high - low) or abs(high) or 1.0)
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
    look = REPAIRED_STYLE | {"transform": ax.get_xaxis_transform(), "clip_on": False, "zorder": 4}
    ax.plot(at, np.zeros(len(at)), **look)


PAGE_WIDTH_IN = 12.0  # inches: a figure over the whole page
SVG_DPI = 72  # of matplotlib's SVG; laid out at the same, so that texts are measured once
RASTER_DPI = 200  # of a PNG file, and of what is drawn as a bitmap in an SVG
_MEASURING = RendererSVG(1, 1, io.StringIO(), image_dpi=SVG_DPI)  # measures texts once for the layout of all figures
P = ParamSpec("P")
_RC_LOCK = RLock()  # the settings of matplotlib are common to all threads


@contextmanager
def _common_style() -> Iterator[None]:
    """Set up matplotlib for all figures; collecting garbage would take a sixth of the time, and a figure makes none."""
    collects = gc.isenabled()
    gc.disable()
    try:
        with _RC_LOCK, mpl.rc_context(RC_PARAMS):
            yield
    finally:
        if collects:
            gc.enable()


def styled(draw: Callable[P, Figure]) -> Callable[P, Figure]:
    """Decorate a function that draws: it uses the common style and leaves the settings of matplotlib as they were.

    What has a label is explained below the panels, unless the function drew a legend itself.
    """

    @wraps(draw)
    def drawn(*args: P.args, **kwargs: P.kwargs) -> Figure:
        with _common_style():
            figure = draw(*args, **kwargs)
            if not (figure.legends or any(ax.get_legend() for ax in figure.axes)):
                legend_below(figure)
            return figure

    return drawn


class _NotebookFigure(Figure):
    """Figure that a notebook shows as a picture, whether or not pyplot is loaded."""

    def _repr_png_(self) -> bytes:
        return png(self)


def new_figure(height: float, title: str, width: float = PAGE_WIDTH_IN) -> Figure:
    """Create an empty figure with its title at the left.

    Parameters
    ----------
    height, width : float
        Size in inches.
    title : str
        The finding that the figure shows, in a few words.

    """
    figure = _NotebookFigure(figsize=(width, height), layout="constrained")
    figure.suptitle(title, x=0.01, ha="left")
    return figure


def one_panel(height: float, title: str, width: float = PAGE_WIDTH_IN) -> tuple[Figure, Axes]:
    """Create a figure with one panel; see `new_figure`."""
    figure = new_figure(height, title, width)
    return figure, figure.subplots()


HANDLE_IN, LETTER_IN = 0.62, 0.082  # inches of a legend: a sample with its gaps, a letter of the mean width


def labelled(figure: Figure) -> list[Any]:
    """What is drawn in the panels of a figure with a label, each label once."""
    found = [handle for ax in figure.axes for handle in ax.get_legend_handles_labels()[0]]
    return list({str(handle.get_label()): handle for handle in reversed(found)}.values())[::-1]


def legend_below(figure: Figure, *more: Any, **look: Any) -> None:
    """Draw the legend below the panels, in as many columns as fit into the width of the figure.

    Parameters
    ----------
    figure : Figure
        The figure: everything in its panels that has a label is explained; of equal labels the first counts.
    *more : artist
        What is explained beside it.
    **look
        For `Figure.legend`.

    """
    by_label = {str(h.get_label()): h for h in (*labelled(figure), *more)}
    labels = list(by_label)
    if not labels:
        return
    widths = [HANDLE_IN + LETTER_IN * len(label) for label in labels]

    def fits(n: int) -> bool:
        rows = -(-len(labels) // n)
        return sum(max(widths[k : k + rows]) for k in range(0, len(labels), rows)) < figure.get_figwidth()

    columns = next((n for n in range(len(labels), 1, -1) if fits(n)), 1)
    columns = -(-len(labels) // -(-len(labels) // columns))  # as few as the rows allow: rows of like length
    figure.legend([by_label[label] for label in labels], labels, loc="outside lower left", ncols=columns, **look)


def panel_grid(
    n: int,
    size: tuple[float, float],
    title: str,
    labels: tuple[str, ...],
    *,
    width: float = PAGE_WIDTH_IN,
    **subplots: Any,
) -> tuple[Figure, list[Any]]:
    """Create a figure of n cells in rows as even as possible, each with its panels one above the other.

    Parameters
    ----------
    n : int
        Number of cells.
    size : tuple of float
        Height of a row of cells, and of the rest of the figure, inches.
    title : str
        As for `new_figure`.
    labels : tuple of str
        Label of the x axis, then of the y axis of each panel of a cell.
    width : float
        Width of the figure, inches.
    **subplots
        For `Figure.subplots`; `height_ratios` of one cell; `sharex` = "cell": the panels of a cell share their x axis.

    Returns
    -------
    figure, cells
        The figure, and the panels of each cell.

    """
    x_label, *y_labels = labels
    rows, each = -(-n // MAX_COLUMNS), len(y_labels)
    columns = -(-n // rows)
    if "height_ratios" in subplots:
        subplots["height_ratios"] = [*subplots["height_ratios"]] * rows
    in_cells = subplots.get("sharex") == "cell" and subplots.pop("sharex")
    figure = new_figure(size[0] * rows + size[1], title, width)
    panels: Any = figure.subplots(each * rows, columns, squeeze=False, **subplots)
    cells = [panels[each * (k // columns) : each * (k // columns + 1), k % columns] for k in range(rows * columns)]
    for k, cell in enumerate(cells):
        for ax, label in zip(cell, y_labels, strict=True):
            ax.set_ylabel(label if k % columns == 0 else "")
            if k >= n:
                ax.set_axis_off()
        for ax in cell[:-1] if in_cells else ():
            ax.sharex(cell[-1])
            ax.tick_params(labelbottom=False)
        if k + columns >= n:
            cell[-1].set_xlabel(x_label)
            cell[-1].tick_params(labelbottom=True)
    figure.align_ylabels(panels[:, 0])
    return figure, cells[:n]


def svg(figure: Figure) -> str:
    """Convert a figure to SVG that can be put into an HTML page.

    Returns
    -------
    str
        One `<svg>` element without header and metadata, coordinates rounded to 0.01 pt. The same figure gives the
        same text.

    """
    buffer, canvas = io.StringIO(), FigureCanvasSVG(figure)
    vars(canvas)["get_renderer"] = lambda: _MEASURING
    figure.set_dpi(SVG_DPI)
    with _laid_out(figure):
        figure.set_dpi(RASTER_DPI)  # of what is drawn as a bitmap in it
        canvas.print_svg(buffer, metadata=dict.fromkeys(("Date", "Creator", "Format", "Type")))
    text = buffer.getvalue()
    text = re.sub(r"<metadata>.*?</metadata>\s*", "", text[text.index("<svg") :], flags=re.DOTALL)
    text = text.replace("<svg ", '<svg style="max-width: 100%; height: auto" ', 1)  # fits where the page is narrower
    return re.sub(r' (?:d|x|y)="[^"]*"', lambda m: re.sub(r"(\.\d\d)\d+", r"\1", m[0]), text)  # half the size


def svg_file(figure: Figure) -> str:
    """Convert a figure to the text of an SVG file; see `svg`."""
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + svg(figure)


def file_content(figure: Figure, form: str) -> bytes:
    """Convert a figure to the content of a file: "svg", "png" or "pdf"."""
    if form == "svg":
        return svg_file(figure).encode()
    return png(figure, dpi=RASTER_DPI) if form == "png" else pdf(figure)


@contextmanager
def _laid_out(figure: Figure) -> Iterator[None]:
    """Lay a figure out once and draw it fast inside this context; `savefig` would draw it twice for the layout."""
    with _common_style(), ticks_in_rows(figure):
        if (engine := figure.get_layout_engine()) is not None:
            engine.execute(figure)
            figure.set_layout_engine("none")
        yield


def png(figure: Figure, dpi: float = 110) -> bytes:
    """Convert a figure to the content of a PNG file.

    Parameters
    ----------
    figure : Figure
        The figure.
    dpi : float
        Dots per inch.

    """
    buffer, canvas = io.BytesIO(), FigureCanvasAgg(figure)
    figure.set_dpi(dpi)
    with _laid_out(figure):
        canvas.print_png(buffer)
    return buffer.getvalue()


def pdf(figure: Figure) -> bytes:
    """Convert a figure to the content of a PDF file, without its date: the same figure gives the same bytes."""
    from matplotlib.backends.backend_pdf import FigureCanvasPdf  # noqa: PLC0415 - loads fonts that others do not need

    buffer = io.BytesIO()
    with _laid_out(figure):
        FigureCanvasPdf(figure).print_pdf(buffer, metadata=dict.fromkeys(("CreationDate", "Creator", "Producer")))
    return buffer.getvalue()


def html(result: Any) -> str:
    """Return the text and the figure of a result as HTML, for a notebook.

    Parameters
    ----------
    result : object
        A result with `plot`; its text is its `repr`.

    """
    picture = b64encode(png(result.plot())).decode()
    image = f'<img alt="" style="max-width: 100%" src="data:image/png;base64,{picture}">'
    return f"<p><code>{escape(repr(result))}</code></p>{image}"
