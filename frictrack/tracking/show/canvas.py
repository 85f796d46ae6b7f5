"""Draw pictures with scales, lines and texts into one image. A plotting library would take half a second to load."""

from __future__ import annotations

from functools import cache
from importlib.util import find_spec
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageColor, ImageDraw, ImageFont

from frictrack.records import Array

SUBPIXEL_BITS = 4  # fractional bits of OpenCV's drawing coordinates
TICK_PX, LABEL_GAP_PX, MIN_TICK_PX = 4, 3, 50  # length, distance of its label, distance of the next tick
X_NAME, Y_NAME = "x / px", "y / px"
HATCH_STEP_PX = 7  # from one line to the next
FAST_COMPRESSION = 2  # of zlib: the file grows by a tenth, and the image takes a third less time
BLACK = "#000000"

Rectangle = tuple[float, float, float, float]  # left, top, width, height
Point = tuple[float, float]


class Canvas:
    """A white image to draw on; positions in px from its upper left corner.

    Parameters
    ----------
    width, height : int
        Size, px.

    Attributes
    ----------
    pixels : array of shape (height, width, 3)
        Red, green, blue.

    """

    def __init__(self, width: int, height: int) -> None:
        self.width, self.height = width, height
        self.pixels: NDArray[np.uint8] = np.full((height, width, 3), 255, np.uint8)
        self._texts: list[tuple[Point, str, ImageFont.FreeTypeFont, str, str]] = []

    def text(self, at: Point, text: str, size: float, anchor: str = "mm", colour: str = BLACK) -> None:
        """Write a text above everything drawn; `anchor` is the point of it, as Pillow names them, that lies at `at`."""
        self._texts.append((at, text, _font(size), anchor, colour))

    def code(self, at: Point, text: str, size: float) -> None:
        """Write a text centred at a point, in a font of fixed width."""
        self._texts.append((at, text, _font(size, fixed_width=True), "mm", BLACK))

    def line(self, start: Point, end: Point) -> None:
        """Draw a thin black line."""
        at = [_fixed_point(np.array([start, end]))]
        cv2.polylines(self.pixels, at, False, _rgb(BLACK), 1, cv2.LINE_AA, SUBPIXEL_BITS)

    def png(self) -> bytes:
        """Return the content of a PNG file."""
        image = Image.fromarray(self.pixels)
        draw = ImageDraw.Draw(image)
        for at, text, font, anchor, colour in self._texts:
            draw.text(at, text, fill=colour, font=font, anchor=anchor)
        bgr = cv2.cvtColor(np.asarray(image), cv2.COLOR_RGB2BGR)
        return bytes(cv2.imencode(".png", bgr, [cv2.IMWRITE_PNG_COMPRESSION, FAST_COMPRESSION])[1])


class Panel:
    """A part of a canvas that shows a part of a picture, as large as it fits.

    Parameters
    ----------
    canvas : Canvas
        The canvas.
    place : (left, top, width, height)
        Where it is on the canvas, px.
    view : (left, top, width, height)
        Which pixels of the picture it shows.

    """

    def __init__(self, canvas: Canvas, place: Rectangle, view: tuple[int, int, int, int]) -> None:
        self.canvas, self._view = canvas, view
        left, top, width, height = place
        self._scale = min(width / view[2], height / view[3])
        self._size = max(round(view[2] * self._scale), 1), max(round(view[3] * self._scale), 1)
        self._corner = round(left + (width - self._size[0]) / 2), round(top + (height - self._size[1]) / 2)

    def show(self, picture: NDArray[np.uint8]) -> None:
        """Show a picture of grey values (rows, columns); white where the view goes beyond it."""
        x, y, width, height = self._view
        above, left = max(-y, 0), max(-x, 0)
        part = picture[max(y, 0) : y + height, max(x, 0) : x + width]
        grey = np.full((height, width), 255, np.uint8)
        grey[above : above + part.shape[0], left : left + part.shape[1]] = part
        shown = cv2.resize(grey, self._size, interpolation=cv2.INTER_AREA if self._scale < 1 else cv2.INTER_NEAREST)
        self._pixels[:] = shown[:, :, None]

    def line(self, points: Array, colour: str, *, width: int = 1, closed: bool = True) -> None:
        """Draw a line through points (n, 2) of the picture, as far as they are in the view."""
        inside = np.ascontiguousarray(self._pixels)
        at = [_fixed_point(self._on_canvas(points) - self._corner)]
        cv2.polylines(inside, at, closed, _rgb(colour), width, cv2.LINE_AA, SUBPIXEL_BITS)
        self._pixels[:] = inside

    def hatch(self, polygon: Array, colour: str) -> None:
        """Hatch a polygon (n, 2) of the picture, and draw its outline."""
        inside = np.zeros(self._pixels.shape[:2], np.uint8)
        cv2.fillPoly(inside, [_fixed_point(self._on_canvas(polygon) - self._corner)], 1, cv2.LINE_8, SUBPIXEL_BITS)
        rows, columns = np.nonzero(inside)
        striped = (rows + columns) % HATCH_STEP_PX == 0
        self._pixels[rows[striped], columns[striped]] = _rgb(colour)
        self.line(polygon, colour)

    def name(self, at: Array, text: str, colour: str, size: float) -> None:
        """Write a text with its lower left corner at a point (2,) of the picture, further left if it has no space."""
        x, y = self._on_canvas(at[None])[0]
        right = self._corner[0] + self._size[0]
        self.canvas.text((min(float(x), right - _font(size).getlength(text)), float(y)), text, size, "ld", colour)

    def title(self, text: str, size: float) -> None:
        """Write a text above the middle of the panel, or from near its left edge if it is wider than the panel."""
        is_wide = _font(size).getlength(text) > self._size[0]
        middle = 2.0 * LABEL_GAP_PX if is_wide else self._size[0] / 2  # clear of the name of the vertical axis
        self.canvas.text((self._corner[0] + middle, self._corner[1] - 6), text, size, "ld" if is_wide else "md")

    def label_edges(self, size: float) -> None:
        """Draw a frame, and label columns below and rows at the left, each axis with its name and unit."""
        (left, top), (width, height) = self._corner, self._size
        cv2.rectangle(self.canvas.pixels, (left - 1, top - 1), (left + width, top + height), _rgb(BLACK))
        below = top + height + TICK_PX + LABEL_GAP_PX
        self.canvas.text((left + width, below), X_NAME, size, "ra")
        self.canvas.text((left - TICK_PX - _font(size).getlength(Y_NAME), top - 2 * LABEL_GAP_PX), Y_NAME, size, "ld")
        name_begins = left + width - _font(size).getlength(X_NAME)
        for axis in (0, 1):
            for place in _ticks(self._view[axis], self._view[2 + axis], MIN_TICK_PX / self._scale):
                x, y = self._on_canvas(np.full((1, 2), float(place)))[0].tolist()
                start = (x, top + height) if axis == 0 else (left - 1 - TICK_PX, y)
                end = (x, top + height + TICK_PX) if axis == 0 else (left - 1, y)
                self.canvas.line(start, end)
                at = (x, below) if axis == 0 else (start[0] - LABEL_GAP_PX, y)
                if axis == 1 or x + _font(size).getlength(str(place)) < name_begins:
                    self.canvas.text(at, str(place), size, "ma" if axis == 0 else "rm")

    @property
    def _pixels(self) -> NDArray[np.uint8]:
        """The part of the canvas that shows the picture."""
        (column, row), (width, height) = self._corner, self._size
        return self.canvas.pixels[row : row + height, column : column + width]

    def _on_canvas(self, points: Array) -> Array:
        """Positions (n, 2) on the canvas of positions in the picture; centres of pixels are integers in both."""
        return np.asarray((points - self._view[:2] + 0.5) * self._scale - 0.5 + self._corner)


def _ticks(first: int, length: int, min_distance: float) -> list[int]:
    """Round numbers of pixels from `first` on, at least a distance apart."""
    step = next(s for k in range(9) for s in (10**k, 2 * 10**k, 5 * 10**k) if s >= min_distance)
    return list(range(-(-first // step) * step, first + length, step))


def _fixed_point(points: Array) -> NDArray[np.int32]:
    """Positions (n, 2) as OpenCV takes them."""
    return np.rint(np.asarray(points) * 2**SUBPIXEL_BITS).astype(np.int32)


def _rgb(colour: str) -> tuple[int, ...]:
    return ImageColor.getrgb(colour)


@cache
def _font(size: float, *, fixed_width: bool = False) -> ImageFont.FreeTypeFont:
    """Return the font of the figures, which matplotlib brings."""
    name = "DejaVuSansMono.ttf" if fixed_width else "DejaVuSans.ttf"
    return ImageFont.truetype(str(_font_folder() / name), size)


@cache
def _font_folder() -> Path:
    """Return the folder of matplotlib's fonts; matplotlib is only loaded if it is not at its usual place."""
    found = find_spec("matplotlib")
    folder = Path(found.origin if found and found.origin else "").parent / "mpl-data" / "fonts" / "ttf"
    if not folder.is_dir():
        import matplotlib as mpl  # noqa: PLC0415 - see above

        folder = Path(mpl.get_data_path()) / "fonts" / "ttf"
    return folder
