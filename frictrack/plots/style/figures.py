"""Create figures and write them as SVG, PDF or PNG, without changing the settings of matplotlib or using pyplot."""

from __future__ import annotations

import io
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import lru_cache, wraps
from threading import RLock
from typing import Any, ParamSpec

import matplotlib as mpl
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.backends.backend_mixed import MixedModeRenderer
from matplotlib.backends.backend_pdf import FigureCanvasPdf
from matplotlib.backends.backend_svg import FigureCanvasSVG, RendererSVG
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties
from matplotlib.textpath import text_to_path

from frictrack.plots.style.colours import RC_PARAMS
from frictrack.plots.style.drawing import panel_columns
from frictrack.plots.style.tick_rows import collection_paused, ticks_in_rows

PAGE_WIDTH_IN = 12.0  # inches: a figure over the whole page
SVG_DPI = 72  # of matplotlib's SVG; laid out at the same, so that texts are measured once
RASTER_DPI = 200  # of what is drawn as a bitmap in an SVG
P = ParamSpec("P")
_RC_LOCK = RLock()  # the settings of matplotlib are common to all threads


def styled(draw: Callable[P, Figure]) -> Callable[P, Figure]:
    """Decorate a function that draws: it uses the common style and leaves the settings of matplotlib as they were."""

    @wraps(draw)
    def drawn(*args: P.args, **kwargs: P.kwargs) -> Figure:
        with _RC_LOCK, mpl.rc_context(RC_PARAMS), collection_paused():
            return draw(*args, **kwargs)

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


def panel_grid(
    n: int, size: tuple[float, float], title: str, labels: tuple[str, ...], **subplots: Any
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
    **subplots
        For `Figure.subplots`; `height_ratios` of one cell.

    Returns
    -------
    figure, cells
        The figure, and the panels of each cell.

    """
    x_label, *y_labels = labels
    columns, each = panel_columns(n), len(y_labels)
    rows = -(-n // columns)
    if "height_ratios" in subplots:
        subplots["height_ratios"] = [*subplots["height_ratios"]] * rows
    figure = new_figure(size[0] * rows + size[1], title)
    panels: Any = figure.subplots(each * rows, columns, squeeze=False, **subplots)
    cells = [panels[each * (k // columns) : each * (k // columns + 1), k % columns] for k in range(rows * columns)]
    for k, cell in enumerate(cells):
        for ax, label in zip(cell, y_labels, strict=True):
            ax.set_ylabel(label if k % columns == 0 else "")
            if k >= n:
                ax.set_axis_off()
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
    with _RC_LOCK, mpl.rc_context(RC_PARAMS):
        canvas = _SvgCanvas(figure)
        figure.set_dpi(SVG_DPI)
        with _laid_out(figure):
            text = canvas.to_svg()
    text = re.sub(r"<metadata>.*?</metadata>\s*", "", text[text.index("<svg") :], flags=re.DOTALL)
    text = text.replace("<svg ", '<svg style="max-width: 100%; height: auto" ', 1)  # fits where the page is narrower
    return re.sub(r' (?:d|x|y)="[^"]*"', lambda m: re.sub(r"(\.\d\d)\d+", r"\1", m[0]), text)  # half the size


def svg_file(figure: Figure) -> str:
    """Convert a figure to the text of an SVG file; see `svg`."""
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + svg(figure)


class _SvgCanvas(FigureCanvasSVG):
    """Canvas of a figure whose sizes of texts are those of all figures: most texts stand in several of them."""

    def get_renderer(self) -> RendererSVG:
        """Return a renderer that measures texts for the layout."""
        return self._renderer(io.StringIO())

    def to_svg(self) -> str:
        """Draw the figure; return its SVG file."""
        buffer = io.StringIO()
        width, height = self.figure.get_size_inches()
        renderer: Any = MixedModeRenderer(self.figure, width, height, RASTER_DPI, self._renderer(buffer))
        self.figure.draw(renderer)
        renderer.finalize()
        return buffer.getvalue()

    def _renderer(self, buffer: io.StringIO) -> RendererSVG:
        width, height = (SVG_DPI * length for length in self.figure.get_size_inches())
        nothing = dict.fromkeys(("Date", "Creator", "Format", "Type"))
        return _SvgRenderer(width, height, buffer, image_dpi=RASTER_DPI, metadata=nothing)


class _SvgRenderer(RendererSVG):
    """SVG renderer that measures every text once, whatever figure it stands in."""

    def get_text_width_height_descent(self, s: str, prop: FontProperties, ismath: Any) -> Any:
        """Return width, height and descent of a text, px."""
        return _text_size(s, prop.copy(), ismath)


@lru_cache(4096)
def _text_size(text: str, font: FontProperties, ismath: Any) -> Any:
    return text_to_path.get_text_width_height_descent(text, font, ismath)


@contextmanager
def _laid_out(figure: Figure) -> Iterator[None]:
    """Lay a figure out once and draw it fast inside this context; `savefig` would draw it twice for the layout."""
    with collection_paused(), ticks_in_rows(figure):
        engine = figure.get_layout_engine()
        if engine is not None:
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
    with _RC_LOCK, mpl.rc_context(RC_PARAMS):
        buffer = io.BytesIO()
        canvas = FigureCanvasAgg(figure)
        figure.set_dpi(dpi)
        with _laid_out(figure):
            canvas.print_png(buffer)
    return buffer.getvalue()


def pdf(figure: Figure) -> bytes:
    """Convert a figure to the content of a PDF file, without its date: the same figure gives the same bytes."""
    with _RC_LOCK, mpl.rc_context(RC_PARAMS):
        buffer = io.BytesIO()
        with _laid_out(figure):
            FigureCanvasPdf(figure).print_pdf(buffer, metadata=dict.fromkeys(("CreationDate", "Creator", "Producer")))
    return buffer.getvalue()
