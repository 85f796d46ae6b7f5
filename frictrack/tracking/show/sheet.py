"""Draw the contact sheet: frames with the tracked target, and the line that repeats the track."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Polygon

from frictrack.files import atomic_write
from frictrack.recording import Frame, Recording
from frictrack.records import Track
from frictrack.tick_rows import collection_paused, ticks_in_rows
from frictrack.tracking.show.overlay import box, corners, drawn_areas

LINE_FONT_SCALE = 1700.0  # points times characters: such a line fits the width
FAST_COMPRESSION = 2  # of zlib: the file grows by a tenth, and the sheet takes a third less time
N_FRAMES = 5  # and one panel for the target itself
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

    """
    with atomic_write(Path(path)) as part, collection_paused():
        figure = _sheet(recording, track, others)
        with ticks_in_rows(figure):
            FigureCanvasAgg(figure).print_png(str(part), pil_kwargs={"compress_level": FAST_COMPRESSION})
    return Path(path)


def _sheet(recording: Recording, track: Track, others: Sequence[Track]) -> Figure:
    """Draw the contact sheet."""
    found = np.flatnonzero(track.found)
    shown = np.unique(found[np.linspace(0, len(found) - 1, N_FRAMES).astype(int)])
    wanted = np.unique([*shown, track.template])
    pictures = dict(zip(wanted.tolist(), recording.pick(wanted.tolist()), strict=True))
    columns = 2 if recording.shape[1] > 2 * recording.shape[0] else 3
    figure = _figure(recording, columns)
    panels = np.ravel(figure.subplots(6 // columns, columns))
    _set_spacing(figure, 6 // columns)
    for panel, i in zip(panels, shown, strict=False):
        _draw_frame(panel, pictures[int(i)], track, int(i), recording.bit_depth)
        for colour, other in zip(OTHER_COLOURS, others, strict=False):
            _draw_other(panel, other, int(i), colour)
    for panel in panels[len(shown) : -1]:
        panel.set_axis_off()
    _draw_target(panels[-1], pictures[track.template], track, recording.bit_depth)
    figure.suptitle(_headline(recording, track), fontsize=14)
    line = target_line(track).replace("\n", "      ")
    figure.supxlabel(line, fontsize=min(18.0, LINE_FONT_SCALE / len(line)), family="monospace")
    return figure


def _figure(recording: Recording, columns: int) -> Figure:
    rows = 6 // columns
    height = rows * 16 / columns * recording.shape[0] / recording.shape[1] + 0.6 * rows + 1.3
    return Figure(figsize=(16, float(np.clip(height, 5, 16))), dpi=80)


def _set_spacing(figure: Figure, rows: int) -> None:
    """Set the spacing for titles and labels in inches; an automatic layout takes as long as all other drawing."""
    height, gap = figure.get_figheight(), 0.6
    panel = (height - 1.9 - gap * (rows - 1)) / rows
    figure.subplots_adjust(0.035, 1.0 / height, 0.99, 1 - 0.9 / height, wspace=0.1, hspace=gap / panel)


def _rectangle(track: Track) -> tuple[int, int, int, int]:
    if track.target is None:
        raise ValueError("expected a track that knows its target rectangle")
    x, y, w, h = (round(v) for v in track.target)
    return x, y, w, h


def _headline(recording: Recording, track: Track) -> str:
    why = "; ".join(f"{count} frames: {reason}" for reason, count in track.lost.most_common(3))
    return f"{recording.path.name}: {track.name} found in {track.found.sum()} of {len(track)} frames\n{why}".strip()


def _draw_frame(panel: Axes, picture: Frame, track: Track, i: int, bit_depth: int) -> None:
    _show_picture(panel, picture, bit_depth)
    panel.plot(track.x_px, track.y_px, color=PATH_COLOUR, lw=1.5)
    panel.add_patch(Polygon(corners(track, i), fill=False, ec=TARGET_COLOUR, lw=2.5))
    _draw_excluded(panel, track, i)
    panel.set_title(f"frame {i}, {1e3 * track.t[i]:.1f} ms, score {track.score[i]:.3f}", fontsize=14)


def _draw_excluded(panel: Axes, track: Track, i: int) -> None:
    """Hatch the areas that are excluded in frame i."""
    for polygon in drawn_areas(track, i):
        panel.add_patch(Polygon(polygon, fill=False, ec=EXCLUDED_COLOUR, lw=1.5, hatch="//"))


def _draw_other(panel: Axes, track: Track, i: int, colour: str) -> None:
    """Draw rectangle and name of a further track, where it was found."""
    if track.target is None or i >= len(track) or not track.found[i]:
        return
    panel.add_patch(Polygon(corners(track, i), fill=False, ec=colour, lw=2))
    x, y = corners(track, i)[0]
    panel.text(x, y - 2, track.name, color=colour, fontsize=11, va="bottom")


def _draw_target(panel: Axes, picture: Frame, track: Track, bit_depth: int) -> None:
    """Draw the target with some of its surroundings."""
    x, y, w, h = _rectangle(track)
    _show_picture(panel, picture, bit_depth)
    panel.add_patch(Polygon(track.outline or box(track), fill=False, ec=TARGET_COLOUR, lw=2.5))
    for polygon in (*track.exclude, *track.obstacles):
        panel.add_patch(Polygon(polygon, fill=False, ec=EXCLUDED_COLOUR, lw=1.5, hatch="//"))
    margin = 0.3 * max(w, h)
    panel.set_xlim(x - margin, x + w + margin)
    panel.set_ylim(y + h + margin, y - margin)
    sigma = float(np.nanmedian(track.sigma_px))
    panel.set_title(f"target, sigma {sigma:.4f} px, frame {track.template}", fontsize=14)


def _show_picture(panel: Axes, picture: Frame, bit_depth: int) -> None:
    low, high = np.percentile(picture, [0.5, 99.5])
    high = max(high, low + 2 ** (bit_depth - 6))  # a flat picture stays flat
    panel.imshow(picture, cmap="gray", vmin=low, vmax=high, interpolation="nearest")
    panel.set_xlim(-0.5, picture.shape[1] - 0.5)
    panel.set_ylim(picture.shape[0] - 0.5, -0.5)
    panel.tick_params(labelsize=12)
