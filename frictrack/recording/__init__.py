"""Open a high-speed recording: frames on demand with true times."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from frictrack.base.errors import FrictrackError
from frictrack.base.remote import RemoteFile, trim_cache
from frictrack.recording.base import Frame, FrameRange, Header, Recording
from frictrack.recording.byte_ranges import find_ranges
from frictrack.recording.phantom import Phantom
from frictrack.recording.photron import Photron
from frictrack.recording.raw import random_access
from frictrack.recording.tiff import Tiff
from frictrack.recording.timebase import Stamps, read_stamps
from frictrack.recording.video import Folder, Video

__all__ = [
    "FORMATS",
    "Frame",
    "FrameRange",
    "Header",
    "Recording",
    "Stamps",
    "open_recording",
    "random_access",
    "read_stamps",
]

FORMATS: tuple[type[Recording], ...] = (Video, Tiff, Photron, Phantom)  # a new format is one file and its name here


def open_recording(path: str | Path | RemoteFile, fps: Annotated[float, "Hz"] | None = None) -> Recording:
    """Open a recording.

    Parameters
    ----------
    path : str, Path or RemoteFile
        Photron (.mraw with .cih or .cihx, named by either), Phantom (.cine), TIFF with many pages (BigTIFF included), a
        video (.avi, .mp4, .mov, .mkv, .m4v), or a folder with one numbered picture per frame; gaps in the numbers are
        gaps in time. Of a remote Photron or Phantom film only the parts that are needed are fetched, if its store
        states a checksum, a version or an ETag; other remote films are fetched first.
    fps : float, optional
        Frame rate of the camera, 1/s; it overrides that of the file. `Recording.timebase` shows what was found.

    Returns
    -------
    Recording
        Uncompressed recordings are `direct`: any part of any frame can be read at once (`Recording.cut`).

    Raises
    ------
    FrictrackError
        For a recording that is missing, of another format, truncated to nothing, or one frame long, and where neither
        `fps` nor the file gives a credible frame rate.

    Examples
    --------
    >>> import frictrack as ft
    >>> film = ft.open_recording(ft.samples.films_folder() / "fast.avi", fps=4000)
    >>> film.n_frames, film.frame(0).shape
    (150, (72, 512))

    """
    if isinstance(path, RemoteFile):
        return _open_remote(path, fps)
    path = Path(path)
    if path.is_dir():
        return Folder(path, fps)
    if not path.exists():
        raise FrictrackError(f"{path}: expected a recording but there is no such file; check the path")
    if path.stat().st_size == 0:
        raise FrictrackError(f"{path.name}: expected a film but the file is empty")
    for kind in FORMATS:
        if path.suffix.lower() in kind.suffixes:
            return kind(path, fps)
    known = ", ".join(s for kind in FORMATS for s in kind.suffixes)
    raise FrictrackError(f'{path.name}: expected a film ({known}, or a folder of pictures) but got "{path.suffix}"')


def _open_remote(file: RemoteFile, fps: float | None) -> Recording:
    """Open a remote recording in parts where its format and its store allow it, else fetch it."""
    kind = next((kind for kind in FORMATS if kind.reads_ranges and file.suffix.lower() in kind.suffixes), None)
    if kind is not None and (found := find_ranges(file)) is not None:
        trim_cache()
        return kind(found, fps)
    return open_recording(file.fetch(), fps)
