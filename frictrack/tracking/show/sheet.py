"""Draw the contact sheet: frames with the tracked target, and the line that repeats the track."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from frictrack.files import atomic_write
from frictrack.recording import Frame, Recording
from frictrack.records import Track
from frictrack.tracking.show.canvas import Canvas, Panel, Rectangle
from frictrack.tracking.show.overlay import box, corners, drawn_areas

N_FRAMES = 5  # and one panel for the target itself
WIDTH_PX, MIN_HEIGHT_PX, MAX_HEIGHT_PX = 1280, 400, 1280
# Around the panels, px: headline above, tick labels at the left, the line for the study file below.
TOP_PX, LEFT_PX, RIGHT_PX, BOTTOM_PX = 72, 45, 13, 80
COLUMN_GAP_PX, ROW_GAP_PX = 58, 48
TITLE_PX, LABEL_PX, LINE_PX, NAME_PX = 16, 13, 20, 12  # sizes of the texts
CHARACTER_WIDTH = 0.602  # of the fixed-width font over its size
TARGET_COLOUR, PATH_COLOUR, EXCLUDED_COLOUR = "#ff9f1c", "#2ec4ff", "#e63946"
OTHER_COLOURS = ("#78dc5a", "#ff78c8", "#ffe14d")  # reference and further targets


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
    canvas.code((WIDTH_PX / 2, canvas.height - 18), line, size)
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
    panel.show(_grey(picture, bit_depth))
    panel.label_edges(LABEL_PX)
    return panel


def _draw_frame(panel: Panel, track: Track, i: int) -> None:
    """Draw the path, the target in frame i and what is excluded there."""
    found = np.flatnonzero(track.found)
    path = np.stack([track.x_px, track.y_px], axis=1)
    for part in np.split(found, np.flatnonzero(np.diff(found) > 1) + 1):
        panel.line(path[part], PATH_COLOUR, closed=False)
    panel.line(corners(track, i), TARGET_COLOUR, width=2)
    for polygon in drawn_areas(track, i):
        panel.hatch(np.asarray(polygon), EXCLUDED_COLOUR)
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
    panel.show(_grey(*film))
    panel.line(np.asarray(track.outline or box(track), dtype=float), TARGET_COLOUR, width=2)
    for polygon in (*track.exclude, *track.obstacles):
        panel.hatch(np.asarray(polygon, dtype=float), EXCLUDED_COLOUR)
    panel.label_edges(LABEL_PX)
    sigma = float(np.nanmedian(track.sigma_px))
    panel.title(f"target, sigma {sigma:.4f} px, frame {track.template}", TITLE_PX)


def _grey(picture: Frame, bit_depth: int) -> NDArray[np.uint8]:
    """Grey values from 0 to 255."""
    low, high = np.percentile(picture, [0.5, 99.5])
    high = max(high, low + 2 ** (bit_depth - 6))  # a flat picture stays flat
    return np.clip((picture.astype(np.float32) - low) * (255 / (high - low)), 0, 255).astype(np.uint8)
