"""Draw the overlay video: the film with the tracked targets."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from frictrack.errors import FrictrackError
from frictrack.files import atomic_write
from frictrack.polygons import Polygon, polygon
from frictrack.recording import Frame, Recording
from frictrack.records import Array, Track

MAX_FRAMES = 400  # written, so that the file stays small
PLAYBACK_FPS = 30.0  # 1/s
CODECS = {".avi": "MJPG", ".mp4": "mp4v"}
MIN_WIDTH_PX = 640  # smaller pictures are enlarged
TEXT_BAR_PX = 22  # below the picture, for each track
# Blue, green, red: orange for the target, then blue, green and pink.
COLOURS = ((28, 159, 255), (255, 196, 46), (90, 220, 120), (200, 120, 255))
EXCLUDED_COLOUR = (60, 60, 230)  # red
SUBPIXEL_BITS = 4  # fractional bits of OpenCV's drawing coordinates

Canvas = NDArray[np.uint8]


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
    tracks = (track, *others)
    stride = max(1, -(-recording.n_frames // max(frames, 1)))
    zoom = max(1, -(-MIN_WIDTH_PX // recording.shape[1]))
    with atomic_write(path) as part:
        _write_video(part, recording.frames(step=stride), (zoom, stride), tracks)
    return path


def _write_video(path: Path, frames: Iterator[Frame], steps: tuple[int, int], tracks: Sequence[Track]) -> None:
    """Write every frame with its targets; `steps` are the zoom and the number of frames from one to the next."""
    zoom, stride = steps
    writer: cv2.VideoWriter | None = None
    low, high = 0.0, 1.0
    try:
        for k, frame in enumerate(frames):
            if writer is None:
                low, high = _grey_limits(frame)
                rows, columns = frame.shape[:2]
                size = (_even(columns * zoom), _even(rows * zoom + TEXT_BAR_PX * len(tracks)))
                writer = _writer(path, size)
            picture = _draw_frame(_canvas(frame, (low, high), zoom), tracks, k * stride, zoom)
            writer.write(_pad_even(picture, size))
    finally:
        if writer is not None:
            writer.release()
    if writer is None:
        raise FrictrackError("expected frames to draw on but none can be read")


def _even(length: int) -> int:
    return length + length % 2


def _writer(path: Path, size: tuple[int, int]) -> cv2.VideoWriter:
    code = cv2.VideoWriter.fourcc(*CODECS[path.suffix.lower()])
    writer = cv2.VideoWriter(str(path), code, PLAYBACK_FPS, size)
    if not writer.isOpened():
        raise FrictrackError(f"{path.name}: the overlay cannot be written here; check the folder, or try .avi")
    return writer


def _grey_limits(frame: Frame) -> tuple[float, float]:
    """Grey values shown black and white, the same for the whole film, so that flicker stays visible."""
    low, high = np.percentile(frame, [0.2, 99.8])
    return float(low), float(max(high, low + 1))


def _canvas(frame: Frame, limits: tuple[float, float], zoom: int) -> Canvas:
    low, high = limits
    grey = np.clip((frame.astype(np.float32) - low) * (255 / (high - low)), 0, 255).astype(np.uint8)
    if zoom > 1:
        grey = np.repeat(np.repeat(grey, zoom, axis=0), zoom, axis=1)
    return np.asarray(cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR), dtype=np.uint8)


def _pad_even(picture: Canvas, size: tuple[int, int]) -> Canvas:
    """Pad to even sides, which codecs require."""
    right, below = size[0] - picture.shape[1], size[1] - picture.shape[0]
    return np.asarray(np.pad(picture, ((0, below), (0, right), (0, 0))))


def _draw_frame(picture: Canvas, tracks: Sequence[Track], i: int, zoom: int) -> Canvas:
    """Draw all tracks of frame i, with a line of text for each."""
    bar = np.zeros((TEXT_BAR_PX * len(tracks), picture.shape[1], 3), np.uint8)
    for k, track in enumerate(tracks):
        colour = COLOURS[k % len(COLOURS)]
        _trail(picture, track, i, zoom, colour)
        if i < len(track) and track.found[i] and track.target is not None:
            cv2.polylines(picture, [_to_opencv(corners(track, i), zoom)], True, colour, 2, cv2.LINE_AA, SUBPIXEL_BITS)
            areas = [_to_opencv(one, zoom) for one in drawn_areas(track, i)]
            cv2.polylines(picture, areas, True, EXCLUDED_COLOUR, 1, cv2.LINE_AA, SUBPIXEL_BITS)
        cv2.putText(
            bar, _caption(track, i), (6, TEXT_BAR_PX * k + 16), cv2.FONT_HERSHEY_SIMPLEX, 0.45, colour, 1, cv2.LINE_AA
        )
    return np.vstack([picture, bar])


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


def _trail(picture: Canvas, track: Track, i: int, zoom: int, colour: tuple[int, int, int]) -> None:
    """Draw the path up to frame i, interrupted where the target was lost."""
    at = np.stack([track.x_px, track.y_px], axis=1)[: i + 1]
    found = np.flatnonzero(track.found[: i + 1])
    for part in np.split(found, np.flatnonzero(np.diff(found) > 1) + 1):
        if len(part) > 1:
            cv2.polylines(picture, [_to_opencv(at[part], zoom)], False, colour, 1, cv2.LINE_AA, SUBPIXEL_BITS)


def _to_opencv(at: Array, zoom: int) -> NDArray[Any]:
    """Positions (n, 2) px in OpenCV's fixed-point coordinates of the enlarged picture; pixel centres are integers."""
    return np.rint(((at + 0.5) * zoom - 0.5) * 2**SUBPIXEL_BITS).astype(np.int32)


def _angle_sigma(track: Track, i: int) -> str:
    """Standard deviation of the angle in frame i, degrees."""
    return "" if track.sigma_angle is None else f" +/- {np.degrees(track.sigma_angle[i]):.2g}"


def _caption(track: Track, i: int) -> str:
    if i >= len(track):
        return track.name
    head = f"{track.name}  frame {i}  {1e3 * track.t[i]:.2f} ms  "
    if not track.found[i]:
        return f"{head}lost: {track.reason[i]}"
    turned = f"  {np.degrees(track.angle[i]):+.2f}{_angle_sigma(track, i)} deg" if np.isfinite(track.angle[i]) else ""
    return (
        f"{head}x {track.x_px[i]:.3f}  y {track.y_px[i]:.3f} px  sigma {track.sigma_px[i]:.4f}  "
        f"score {track.score[i]:.3f}{turned}"
    )
