"""Draw all ticks of an axis with one tick, while a figure is written.

matplotlib makes one tick of six artists for every place on an axis, and computes the texts of all of them up to eight
times per axis and drawing: that is most of the time that a figure takes. Here the first tick of each axis is moved
from place to place, so that its style holds for all, and the sizes of the labels are computed once. The picture is the
same.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
from matplotlib.axis import Axis, Tick, XAxis
from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator
from matplotlib.transforms import Bbox

from frictrack.records import Array

END_TOLERANCE = 1e-10  # of an axis, by which rounding may place a tick beyond its end, as in matplotlib


class _Row:
    """The major or minor ticks of one axis: places, labels and the tick that draws them."""

    def __init__(self, axis: Axis, tick: Tick, places: Array, labels: Sequence[str]) -> None:
        self.axis, self.tick, self.places, self.labels = axis, tick, places, labels
        self._sizes: Array | None = None  # corners of the labels about their anchors, (k, 2, 2), px

    def draw(self, renderer: Any) -> None:
        """Draw grid lines, marks and labels."""
        tick = self.tick
        if tick.gridline.get_visible():
            for place in self.places:
                tick.update_position(place)
                tick.gridline.draw(renderer)
        for mark in (tick.tick1line, tick.tick2line):
            if mark.get_visible():
                self._draw_marks(mark, renderer)
        for text in (tick.label1, tick.label2):
            for _ in self._moved(text):
                text.draw(renderer)

    def _draw_marks(self, mark: Any, renderer: Any) -> None:
        fixed = np.full(len(self.places), (mark.get_ydata() if self._is_x else mark.get_xdata())[0])
        mark.set_data(*((self.places, fixed) if self._is_x else (fixed, self.places)))
        mark.draw(renderer)

    def boxes(self, renderer: Any) -> tuple[list[Bbox], list[Bbox]]:
        """Box around the labels on either side of the axes, px; none without labels."""
        return self._boxes(self.tick.label1, renderer), self._boxes(self.tick.label2, renderer)

    def _boxes(self, text: Any, renderer: Any) -> list[Bbox]:
        if not (text.get_visible() and text.get_in_layout()):
            return []
        places = np.array([text.get_unitless_position() for _ in self._moved(text)])
        if not len(places):
            return []
        anchors = text.get_transform().transform(places)[:, None]
        if self._sizes is None:
            self._sizes = np.array([text.get_window_extent(renderer).get_points() for _ in self._moved(text)]) - anchors
        corners = self._sizes + anchors
        return [Bbox([corners.min(axis=(0, 1)), corners.max(axis=(0, 1))])]

    def _moved(self, text: Any) -> Iterator[None]:
        """Move a label to every place that has one, if it is visible at all."""
        if not text.get_visible():
            return
        move = text.set_x if self._is_x else text.set_y
        for place, label in zip(self.places, self.labels, strict=True):
            if label:
                move(place)
                text.set_text(label)
                yield

    @property
    def _is_x(self) -> bool:
        return isinstance(self.axis, XAxis)


@contextmanager
def ticks_in_rows(figure: Figure) -> Iterator[None]:
    """Draw the ticks of a figure in rows inside this context; the figure must not be changed there."""
    several = [_AxisInRows(axis) for ax in figure.axes for axis in (ax.xaxis, ax.yaxis)]
    try:
        yield
    finally:
        for one in several:
            one.restore()


class _AxisInRows:
    """An axis whose ticks are drawn in rows; these are made again when its limits or its length change."""

    def __init__(self, axis: Axis) -> None:
        self._axis, self._rows = axis, dict[Tick, _Row]()
        self._key: Any = None
        # Axis draws and measures its ticks by these two methods alone; a matplotlib without them draws as usual.
        vars(axis).update(_update_ticks=self._ticks, _get_ticklabel_bboxes=self._boxes)

    def restore(self) -> None:
        """Let the axis draw each tick by itself again."""
        for name in ("_update_ticks", "_get_ticklabel_bboxes"):
            vars(self._axis).pop(name)
        self._forget()

    def _ticks(self) -> list[Tick]:
        """Return the first tick of each row; it draws the whole row."""
        key = (*self._axis.get_view_interval(), *np.round(self._axis.axes.bbox.size, 3))
        if self._key != key:
            self._forget()
            self._key, self._rows = key, {row.tick: row for row in _rows(self._axis)}
            for tick, row in self._rows.items():
                vars(tick)["draw"] = row.draw
        return [*self._rows]

    def _boxes(self, ticks: Sequence[Tick], renderer: Any) -> tuple[list[Bbox], list[Bbox]]:
        """Boxes of all labels of some rows on either side of the axes."""
        both = [self._rows[tick].boxes(renderer) for tick in ticks]
        return [box for first, _ in both for box in first], [box for _, second in both for box in second]

    def _forget(self) -> None:
        for tick in self._rows:
            vars(tick).pop("draw")
        self._key, self._rows = None, {}


def _rows(axis: Axis) -> Iterator[_Row]:
    """Rows of major and minor ticks that lie in the view."""
    for kind in ("major", "minor"):
        if isinstance(getattr(axis, f"get_{kind}_locator")(), NullLocator):
            continue
        found = np.atleast_1d(np.asarray(getattr(axis, f"get_{kind}ticklocs")(), dtype=np.float64))
        labels = getattr(axis, f"get_{kind}_formatter")().format_ticks(found)
        shown = _in_view(axis, found)
        if np.any(shown):
            kept = [text for text, show in zip(labels, shown, strict=True) if show]
            yield _Row(axis, getattr(axis, f"get_{kind}_ticks")(1)[0], found[shown], kept)


def _in_view(axis: Axis, places: Array) -> Array:
    """Whether each place (n,) lies between the ends of the axis."""
    transform = axis.get_transform().transform
    with np.errstate(invalid="ignore", divide="ignore"):
        ends, at = np.sort(transform(np.array(axis.get_view_interval()))), transform(places)
    margin = END_TOLERANCE * (ends[1] - ends[0])
    return np.asarray((at >= ends[0] - margin) & (at <= ends[1] + margin))
