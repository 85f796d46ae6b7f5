"""Draw tracks: the contact sheet of a film, and the film once more with the tracked positions in it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import cache
from importlib.util import find_spec
from itertools import chain
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageColor, ImageDraw, ImageFont

from frictrack.base.errors import FrictrackError
from frictrack.base.files import atomic_write
from frictrack.base.polygons import Polygon, polygon
from frictrack.recording import Frame, Recording
from frictrack.records import Array, Track, stretches

SUBPIXEL_BITS = 4  # fractional bits of OpenCV's drawing coordinates
TICK_PX, LABEL_GAP_PX, MIN_TICK_PX = 4, 3, 50  # length, distance of its label, distance of the next tick
X_NAME, Y_NAME = "x / px", "y / px"
HATCH_STEP_PX = 7  # from one line to the next
FAST_COMPRESSION = 2  # of zlib: the file grows by a tenth, and the image takes a third less time
BLACK = "#000000"

Rectangle = tuple[float, float, float, float]  # left, top, width, height
Point = tuple[float, float]
N_FRAMES = 5  # and one panel for the target itself
WIDTH_PX, MIN_HEIGHT_PX, MAX_HEIGHT_PX = 1280, 400, 1280
# Around the panels, px: headline above, tick labels at the left, the line for the study file below.
TOP_PX, LEFT_PX, RIGHT_PX, BOTTOM_PX = 72, 45, 13, 80
COLUMN_GAP_PX, ROW_GAP_PX = 58, 48
TITLE_PX, LABEL_PX, LINE_PX, NAME_PX = 16, 13, 20, 12  # sizes of the texts
CHARACTER_WIDTH = 0.602  # of the fixed-width font over its size
TARGET_COLOUR, PATH_COLOUR, EXCLUDED_COLOUR = "#ff9f1c", "#2ec4ff", "#e63946"
OTHER_COLOURS = ("#78dc5a", "#ff78c8", "#ffe14d")  # reference and further targets
MAX_FRAMES = 400  # written, so that the file stays small
PLAYBACK_FPS = 30.0  # 1/s
CODECS = {".avi": "MJPG", ".mp4": "mp4v"}
MIN_WIDTH_PX = 640  # smaller pictures are enlarged
TEXT_BAR_PX = 22  # below the picture, for each track
COLOURS = (TARGET_COLOUR, PATH_COLOUR, *OTHER_COLOURS[:2])  # of the tracks


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

    def text(
        self, at: Point, text: str, size: float, anchor: str = "mm", colour: str = BLACK, name: str = "DejaVuSans"
    ) -> None:
        """Write a text above everything drawn; `anchor` is the point of it, as Pillow names them, that lies at `at`."""
        self._texts.append((at, text, _font(size, name), anchor, colour))

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
        self._pixels[:] = cv2.cvtColor(shown, cv2.COLOR_GRAY2RGB)

    def line(self, points: Array, colour: str, *, width: int = 1, closed: bool = True) -> None:
        """Draw a line through points (n, 2) of the picture, as far as they are in the view."""
        at = [_fixed_point(self._on_canvas(points) - self._corner)]
        cv2.polylines(self._pixels, at, closed, _rgb(colour), width, cv2.LINE_AA, SUBPIXEL_BITS)

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
def _font(size: float, name: str = "DejaVuSans") -> ImageFont.FreeTypeFont:
    """Return the font of the figures, which matplotlib brings."""
    return ImageFont.truetype(str(_font_folder() / f"{name}.ttf"), size)


@cache
def _font_folder() -> Path:
    """Return the folder of matplotlib's fonts; matplotlib is only loaded if it is not at its usual place."""
    found = find_spec("matplotlib")
    folder = Path(found.origin if found and found.origin else "").parent / "mpl-data" / "fonts" / "ttf"
    if not folder.is_dir():
        import matplotlib as mpl  # noqa: PLC0415 - see above

        folder = Path(mpl.get_data_path()) / "fonts" / "ttf"
    return folder


def target_line(track: Track) -> str:
    """Write the lines for the study file that repeat this track.

    Parameters
    ----------
    track : Track
        Track of the target.

    Returns
    -------
    str
        Rectangle or outline, frame if it is not the first, excluded parts and obstacles.

    """
    x, y, w, h = _rectangle(track)
    lines = [f"target = {_format_polygon(track.outline)}" if track.outline else f"target = [{x}, {y}, {w}, {h}]"]
    if track.template:
        lines.append(f"template = {track.template}")
    for name, several in (("exclude", track.exclude), ("obstacles", track.obstacles)):
        if several:
            lines.append(f"{name} = [{', '.join(_format_polygon(polygon) for polygon in several)}]")
    return "\n".join(lines)


def _format_polygon(corners: Sequence[tuple[float, float]]) -> str:
    """Format a polygon for the study file."""
    return "[" + ", ".join(f"[{x:g}, {y:g}]" for x, y in corners) + "]"


def contact_sheet(recording: Recording, track: Track, path: str | Path, others: Sequence[Track] = ()) -> Path:
    """Write a PNG of some frames with the tracked target and its path, and of the target itself.

    Parameters
    ----------
    recording : Recording
        Film.
    track : Track
        Track of the target.
    path : str or Path
        File to write.
    others : sequence of Track
        Reference and further targets, drawn with their names.

    Returns
    -------
    Path
        The file.

    Examples
    --------
    >>> import tempfile
    >>> import frictrack as ft
    >>> film = ft.open_recording(ft.samples.films_folder() / "fast.avi")
    >>> ft.contact_sheet(film, ft.track(film), Path(tempfile.mkdtemp()) / "fast.png").name
    'fast.png'

    """
    sheet = _sheet(recording, track, others)
    with atomic_write(Path(path)) as part:
        part.write_bytes(sheet.png())
    return Path(path)


def _sheet(recording: Recording, track: Track, others: Sequence[Track]) -> Canvas:
    """Draw the contact sheet."""
    found = np.flatnonzero(track.found)
    shown = np.unique(found[np.linspace(0, len(found) - 1, N_FRAMES).astype(int)])
    wanted = np.unique([*shown, track.template])
    pictures = dict(zip(wanted.tolist(), recording.pick(wanted.tolist()), strict=True))
    columns = 2 if recording.shape[1] > 2 * recording.shape[0] else 3
    canvas = Canvas(WIDTH_PX, _height(recording, columns))
    places = _places(canvas, columns)
    for place, i in zip(places, shown, strict=False):
        panel = _frame_panel(canvas, place, pictures[int(i)], recording.bit_depth)
        _draw_frame(panel, track, int(i))
        for colour, other in zip(OTHER_COLOURS, others, strict=False):
            _draw_other(panel, other, int(i), colour)
    _draw_target(canvas, places[-1], (pictures[track.template], recording.bit_depth), track)
    for k, line in enumerate(_headline(recording, track).split("\n")):
        canvas.text((WIDTH_PX / 2, 18 + 20 * k), line, TITLE_PX)
    line = target_line(track).replace("\n", "      ")
    size = min(float(LINE_PX), 0.98 * WIDTH_PX / (CHARACTER_WIDTH * len(line)))
    canvas.text((WIDTH_PX / 2, canvas.height - 18), line, size, name="DejaVuSansMono")
    return canvas


def _height(recording: Recording, columns: int) -> int:
    """Height of the sheet that lets the pictures fill its width, px."""
    rows, (height, width) = 6 // columns, recording.shape
    wanted = rows * WIDTH_PX / columns * height / width + ROW_GAP_PX * rows + 104
    return round(float(np.clip(wanted, MIN_HEIGHT_PX, MAX_HEIGHT_PX)))


def _places(canvas: Canvas, columns: int) -> list[Rectangle]:
    """Places of the six panels, row by row."""
    rows = 6 // columns
    width = (canvas.width - LEFT_PX - RIGHT_PX - COLUMN_GAP_PX * (columns - 1)) / columns
    height = (canvas.height - TOP_PX - BOTTOM_PX - ROW_GAP_PX * (rows - 1)) / rows
    return [
        (LEFT_PX + j * (width + COLUMN_GAP_PX), TOP_PX + i * (height + ROW_GAP_PX), width, height)
        for i in range(rows)
        for j in range(columns)
    ]


def _rectangle(track: Track) -> tuple[int, int, int, int]:
    if track.target is None:
        raise ValueError("expected a track that knows its target rectangle")
    x, y, w, h = (round(v) for v in track.target)
    return x, y, w, h


def _headline(recording: Recording, track: Track) -> str:
    why = "; ".join(f"{count} frames: {reason}" for reason, count in track.lost.most_common(3))
    return f"{recording.path.name}: {track.name} found in {track.found.sum()} of {len(track)} frames\n{why}".strip()


def _frame_panel(canvas: Canvas, place: Rectangle, picture: Frame, bit_depth: int) -> Panel:
    """A panel that shows a whole frame."""
    height, width = picture.shape
    panel = Panel(canvas, place, (0, 0, width, height))
    panel.show(_grey(picture, _grey_limits(picture, bit_depth)))
    panel.label_edges(LABEL_PX)
    return panel


def _draw_path(panel: Panel, track: Track, colour: str, n_frames: int) -> None:
    """Draw the path in the first frames, interrupted where the target was lost."""
    path = np.stack([track.x_px, track.y_px], axis=1)
    for part in stretches(track.found[:n_frames]):
        panel.line(path[part], colour, closed=False)


def _draw_frame(panel: Panel, track: Track, i: int) -> None:
    """Draw the path, the target in frame i and what is excluded there."""
    _draw_path(panel, track, PATH_COLOUR, len(track))
    panel.line(corners(track, i), TARGET_COLOUR, width=2)
    for area in drawn_areas(track, i):
        panel.hatch(np.asarray(area), EXCLUDED_COLOUR)
    panel.title(f"frame {i}, {1e3 * track.t[i]:.1f} ms, score {track.score[i]:.3f}", TITLE_PX)


def _draw_other(panel: Panel, track: Track, i: int, colour: str) -> None:
    """Draw rectangle and name of a further track, where it was found."""
    if track.target is None or i >= len(track) or not track.found[i]:
        return
    around = corners(track, i)
    panel.line(around, colour)
    panel.name(around[0] - (0, 2), track.name, colour, NAME_PX)


def _draw_target(canvas: Canvas, place: Rectangle, film: tuple[Frame, int], track: Track) -> None:
    """Draw the target with some of its surroundings; `film` is the frame that shows it, and its bit depth."""
    x, y, w, h = _rectangle(track)
    margin = round(0.3 * max(w, h))
    panel = Panel(canvas, place, (x - margin, y - margin, w + 2 * margin, h + 2 * margin))
    panel.show(_grey(film[0], _grey_limits(*film)))
    panel.line(np.asarray(track.outline or box(track), dtype=float), TARGET_COLOUR, width=2)
    for area in (*track.exclude, *track.obstacles):
        panel.hatch(np.asarray(area, dtype=float), EXCLUDED_COLOUR)
    panel.label_edges(LABEL_PX)
    sigma = float(np.nanmedian(track.sigma_px))
    panel.title(f"target, sigma {sigma:.4f} px, frame {track.template}", TITLE_PX)


def _grey_limits(picture: Frame, bit_depth: int) -> tuple[float, float]:
    """Grey values shown black and white; a flat picture stays flat."""
    low, high = np.percentile(picture, [0.5, 99.5])
    return float(low), float(max(high, low + 2 ** (bit_depth - 6)))


def _grey(picture: Frame, limits: tuple[float, float]) -> NDArray[np.uint8]:
    """Grey values from 0 to 255."""
    low, high = limits
    return np.clip((picture.astype(np.float32) - low) * (255 / (high - low)), 0, 255).astype(np.uint8)


def overlay_video(
    recording: Recording, track: Track, path: str | Path, *, others: Sequence[Track] = (), frames: int = MAX_FRAMES
) -> Path:
    """Write an AVI or MP4 of the film with target, trail and numbers of every frame.

    Parameters
    ----------
    recording : Recording
        Film.
    track : Track
        Track of the target.
    path : str or Path
        File to write, ending in .avi or .mp4.
    others : sequence of Track
        Reference and further targets, drawn in other colours.
    frames : int
        Approximate number of frames to write, spread over the film.

    Returns
    -------
    Path
        The file; it appears complete or not at all.

    Raises
    ------
    FrictrackError
        For another file type, a folder that cannot be written, or a film without readable frames.

    """
    path = Path(path)
    if path.suffix.lower() not in CODECS:
        raise FrictrackError(f'{path.name}: expected an overlay ending in .avi or .mp4 but got "{path.suffix}"')
    pictures = _overlay_frames(recording, (track, *others), max(1, -(-recording.n_frames // max(frames, 1))))
    first = next(pictures, None)
    if first is None:
        raise FrictrackError("expected frames to draw on but none can be read")
    with atomic_write(path) as part:
        code = cv2.VideoWriter.fourcc(*CODECS[path.suffix.lower()])
        writer = cv2.VideoWriter(str(part), code, PLAYBACK_FPS, (first.shape[1], first.shape[0]))
        if not writer.isOpened():
            raise FrictrackError(f"{path.name}: the overlay cannot be written here; check the folder, or try .avi")
        try:
            for picture in chain((first,), pictures):
                writer.write(picture)
        finally:
            writer.release()
    return path


def _overlay_frames(recording: Recording, tracks: Sequence[Track], stride: int) -> Iterator[NDArray[Any]]:
    """Yield every `stride`-th frame with its targets."""
    zoom, limits = max(1, -(-MIN_WIDTH_PX // recording.shape[1])), None
    for k, frame in enumerate(recording.frames(step=stride)):
        limits = limits or _grey_limits(frame, recording.bit_depth)  # of the whole film, so that flicker stays visible
        yield _overlay_frame(_grey(frame, limits), tracks, k * stride, zoom)


def _overlay_frame(grey: NDArray[np.uint8], tracks: Sequence[Track], i: int, zoom: int) -> NDArray[Any]:
    """Draw all tracks of frame i, with a line of text for each; blue, green, red and of even sides."""
    height, width = grey.shape
    bars = TEXT_BAR_PX * len(tracks)
    canvas = Canvas(2 * (-(-width * zoom // 2)), 2 * (-(-(height * zoom + bars) // 2)))
    canvas.pixels[:] = 0
    panel = Panel(canvas, (0, 0, width * zoom, height * zoom), (0, 0, width, height))
    panel.show(grey)
    for k, track in enumerate(tracks):
        colour = COLOURS[k % len(COLOURS)]
        _draw_path(panel, track, colour, i + 1)
        if i < len(track) and track.found[i] and track.target is not None:
            panel.line(corners(track, i), colour, width=2)
            for area in drawn_areas(track, i):
                panel.line(area, EXCLUDED_COLOUR)
        at, font = (6, height * zoom + TEXT_BAR_PX * k + 16), cv2.FONT_HERSHEY_SIMPLEX
        cv2.putText(canvas.pixels, _caption(track, i), at, font, 0.45, _rgb(colour), 1, cv2.LINE_AA)
    return cv2.cvtColor(canvas.pixels, cv2.COLOR_RGB2BGR)


def corners(track: Track, i: int) -> Array:
    """Compute the corners of the target's outline in a frame.

    Parameters
    ----------
    track : Track
        Track of the target.
    i : int
        Number of the frame.

    Returns
    -------
    array (n, 2)
        Corners (x, y), rotated by the target's angle, px.

    """
    return _place_polygon(track, track.outline or box(track), i)


def box(track: Track) -> Polygon:
    """Return the corners of the target's rectangle in its own frame: the outer edges of its pixels, px."""
    assert track.target is not None
    return polygon(list(track.target))


def drawn_areas(track: Track, i: int) -> list[Array]:
    """Compute the corners of excluded parts and obstacles in a frame.

    Parameters
    ----------
    track : Track
        Track of the target.
    i : int
        Number of the frame.

    Returns
    -------
    list of array (n, 2)
        Corners (x, y), px; excluded parts move with the target.

    """
    return [_place_polygon(track, one, i) for one in track.exclude] + [np.array(one) for one in track.obstacles]


def _place_polygon(track: Track, outline: Polygon, i: int) -> Array:
    """Polygon of the target's own frame as it appears in frame i, (n, 2) px."""
    assert track.target is not None
    x, y, w, h = track.target
    angle = float(np.nan_to_num(track.angle[i]))
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    off = np.array(outline) - (x + (w - 1) / 2, y + (h - 1) / 2)
    return np.asarray(off @ turn.T + (track.x_px[i], track.y_px[i]), dtype=np.float64)


def _caption(track: Track, i: int) -> str:
    if i >= len(track):
        return track.name
    head = f"{track.name}  frame {i}  {1e3 * track.t[i]:.2f} ms  "
    if not track.found[i]:
        return f"{head}lost: {track.reason[i]}"
    sigma = "" if track.sigma_angle is None else f" +/- {np.degrees(track.sigma_angle[i]):.2g}"
    turned = f"  {np.degrees(track.angle[i]):+.2f}{sigma} deg" if np.isfinite(track.angle[i]) else ""
    return (
        f"{head}x {track.x_px[i]:.3f}  y {track.y_px[i]:.3f} px  sigma {track.sigma_px[i]:.4f}  "
        f"score {track.score[i]:.3f}{turned}"
    )
