"""Export films and tracks as projects of the video program Tracker (Open Source Physics), one per film.

A project is the XML that OSP's ``XMLControlElement`` writes for a ``TrackerPanel``: the video clip with its frame rate,
the axes with their scale, and one point mass per target. Source: the classes ``Loader`` of TrackerPanel, PointMass,
VideoClip, ClipControl and ImageCoordSystem in github.com/OpenSourcePhysics, and projects that Tracker 5 saved.

OSP reads its XML line by line: every tag stands in a line of its own, and entities are not resolved.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined

from frictrack.base.errors import UsageError
from frictrack.base.files import make_subfolder, replace_text
from frictrack.present.export import ExportedFiles
from frictrack.records import Array, Displacement, Track
from frictrack.results import BACKWARD, RecordingInfo, Results, RunResults

PIXEL_CENTRE = 0.5  # px: in Tracker the corner of the picture is (0, 0), in frictrack the centre of the first pixel
MAX_TIME_DIFFERENCE_S = 1e-9  # between the track and the displacement of a frame
MIN_TRAVEL_PX = 1.0  # a target that moves less shows no direction


@dataclass(frozen=True)
class TrackerAxes:
    """Axes in the picture, as Tracker stores them.

    Attributes
    ----------
    scale
        px/m.
    angle
        Direction of +x, counter-clockwise from the right, degrees.
    origin
        Point with x = y = 0, px, from the corner of the picture, y down.
    is_mirrored
        Whether y of Tracker has the opposite sign: its y lies always to the left of x.
    difference
        Largest distance of a measured position from the one that Tracker computes, m.

    """

    scale: float
    angle: float
    origin: tuple[float, float]
    is_mirrored: bool
    difference: float


def tracker_axes(track: Track, displacement: Displacement) -> TrackerAxes | None:
    """Compute the axes that map the positions in the picture to the measured displacement.

    They are fitted by least squares: exact for one scale over the whole picture, else the best that Tracker can hold.
    """
    rows = np.searchsorted(track.t, displacement.t - MAX_TIME_DIFFERENCE_S)
    z = track.x_px[rows] + PIXEL_CENTRE - 1j * (track.y_px[rows] + PIXEL_CENTRE)
    known = displacement.known & np.isfinite(displacement.y) & np.isfinite(z)
    z = z[known]
    if len(z) < 2 or np.max(np.abs(z - z[0])) < MIN_TRAVEL_PX:
        return None
    x, y = displacement.x[known], displacement.y[known]
    fits = [_fit(z, x + side * y) for side in (1j, -1j)]
    is_mirrored = fits[1][2] < fits[0][2]
    c, d, difference = fits[is_mirrored]
    origin = -d / c
    angle = float(np.degrees(np.angle(1 / c)))
    return TrackerAxes(float(1 / np.abs(c)), angle, (float(origin.real), float(-origin.imag)), is_mirrored, difference)


def _fit(z: Array, w: Array) -> tuple[complex, complex, float]:
    """Fit w = c z + d; return c, d and the largest residual."""
    middle = z.mean()
    (c, d), *_ = np.linalg.lstsq(np.column_stack([z - middle, np.ones(len(z))]), w, rcond=None)
    return complex(c), complex(d - c * middle), float(np.max(np.abs(c * (z - middle) + d - w)))


FOLDER = "tracker"


def write_txt(results: Results) -> ExportedFiles:
    """Write the texts into the folder `tracker`."""
    folder = make_subfolder(results.output, FOLDER)
    paths, lost = [], []
    for run in results.runs:
        paths.append(replace_text(folder / f"{run.name}.txt", _text(run)))
        if left_out := len(run.displacement) - int(np.count_nonzero(run.displacement.known)):
            lost.append(f"{left_out} frames of {run.name} without a valid position, which are left out")
        if further := [name for name in run.tracks if name != BACKWARD]:
            lost.append(f"further targets of {run.name} ({', '.join(further)}), whose positions --to trk writes")
    return ExportedFiles(tuple(paths), tuple(lost))


def _text(run: RunResults) -> str:
    """Return the text of one run; numbers have all digits."""
    d = run.displacement
    names = [name for name in ("t", "x", "y") if _is_measured(d, name)]
    rows = np.column_stack([getattr(d, name)[d.known] for name in names]).tolist()
    title = run.name.replace(" ", "_") + "\t" * (len(names) - 1)
    return "\n".join([title, "\t".join(names), *("\t".join(map(repr, row)) for row in rows), ""])


def _is_measured(displacement: Displacement, name: str) -> bool:
    return bool(np.all(np.isfinite(getattr(displacement, name)[displacement.known])))


MOVIES = (".mp4", ".mov", ".avi", ".m4v", ".mpg", ".wmv", ".flv", ".mkv", ".webm")
PICTURES = (".jpg", ".jpeg", ".png")
COLOURS = ((255, 0, 0), (0, 0, 255), (0, 160, 0), (200, 0, 200))  # red, green, blue of one target after the other
DEFAULT_MASS = 1.0  # kg, Tracker's own
MAX_UNEVENNESS_FRAMES = 1e-3  # of the times of frames
MAX_DIFFERENCE_PX = 1e-3  # between positions of frictrack and of Tracker
MS = 1000.0  # in a second; Tracker's times are in ms


def write_trk(results: Results) -> ExportedFiles:
    """Write the projects into the folder `tracker`."""
    films = [run for run in results.runs if run.film is not None and run.track is not None]
    if not films:
        raise UsageError(
            "expected a run with a film for --to trk but all runs are tables, which have no positions in a picture; "
            "export --to txt"
        )
    folder = make_subfolder(results.output, FOLDER)
    paths, lost = [], [f"{r.name}, which has no film (--to txt writes it)" for r in results.runs if r not in films]
    for run in films:
        project, missing = _project(run, results.path.parent, folder)
        paths.append(replace_text(folder / f"{run.name}.trk", project))
        lost += missing
    return ExportedFiles(tuple(paths), tuple(lost))


def _project(run: RunResults, study: Path, folder: Path) -> tuple[str, list[str]]:
    """Return the project of one run, and what was lost."""
    film, track = run.film, run.track
    assert film is not None
    assert track is not None
    axes, video = tracker_axes(track, run.displacement), _video(study / run.source, folder)
    pitch = run.displacement.pixel_pitch
    targets = {name: one for name, one in run.all_tracks.items() if name != BACKWARD}
    height, width = film.picture.shape
    loader = PackageLoader("frictrack", "present/export")
    pages = Environment(loader=loader, undefined=StrictUndefined, trim_blocks=True, keep_trailing_newline=True)
    # Tracker reads its files line by line: a text with characters of XML is marked as such
    pages.filters["text"] = lambda text: f"<![CDATA[{text}]]>" if set(text) & set("<>&") else text
    project = pages.get_template("tracker.trk.j2").render(
        width=width,
        height=height,
        about=f"{run.source}, tracked by frictrack",
        video=video,
        is_movie=video is not None and Path(video).suffix.lower() in MOVIES,
        n_frames=film.n_frames,
        start=MS * film.t[0],
        delta_t=MS / film.fps,
        # without a direction, the axes lie in the corner of the picture
        axes=axes or TrackerAxes(1 / pitch if pitch else 1.0, 0.0, (PIXEL_CENTRE, PIXEL_CENTRE), False, 0.0),
        targets=[
            {"name": one.name, "colour": COLOURS[k % len(COLOURS)], "places": _places(one)}
            | {"mass": DEFAULT_MASS if run.mass is None or one is not track else run.mass}
            for k, one in enumerate(targets.values())
        ],
    )
    return project, _lost(run, film, axes, video is None, targets)


def _places(track: Track) -> list[tuple[int, float, float]]:
    """Frame and position of every frame in which a target was found."""
    places = np.column_stack([track.x_px, track.y_px]) + PIXEL_CENTRE
    return [(i, *places[i].tolist()) for i in np.flatnonzero(track.found).tolist()]


def _lost(
    run: RunResults, film: RecordingInfo, axes: TrackerAxes | None, no_video: bool, targets: Mapping[str, Track]
) -> list[str]:
    """Return what a project of Tracker cannot hold of this run."""
    expected = film.t[0] + np.arange(len(film.t)) / film.fps
    unevenness = float(np.max(np.abs(film.t - expected)))
    is_uneven = unevenness * film.fps > MAX_UNEVENNESS_FRAMES
    interpolated = sum(int(np.count_nonzero(np.isfinite(t.x_px) & ~t.found)) for t in targets.values())
    pitch = run.displacement.pixel_pitch or np.inf
    away, is_mirrored = (axes.difference, axes.is_mirrored) if axes else (0.0, False)
    facts = {
        f"film of {run.name}: Tracker does not open {run.source}": no_video,
        f"uneven times of the frames of {run.name}, up to {MS * unevenness:.3g} ms from one frame rate": is_uneven,
        f"{interpolated} interpolated positions of {run.name}, which are left out": interpolated,
        f"direction and origin of the course in {run.name}, because the target does not move": axes is None,
        f"sign of y in {run.name}: it is the opposite in Tracker, whose y lies to the left of x": is_mirrored,
        f"corrections of lens, perspective, shake or rotation in {run.name}: positions differ by up to "
        f"{1e6 * away:.3g} µm": away > MAX_DIFFERENCE_PX * pitch,
        f"mass of {run.name}, which is unknown; Tracker shows {DEFAULT_MASS:g} kg": run.mass is None,
    }
    return [what for what, is_lost in facts.items() if is_lost]


def _video(film: Path, folder: Path) -> str | None:
    """Return the path of a video from its project; None for a film that Tracker cannot open."""
    pictures = sorted(p for p in film.iterdir() if p.suffix.lower() in PICTURES) if film.is_dir() else []
    first = pictures[0] if pictures else film
    if not film.exists() or first.suffix.lower() not in (*MOVIES, *PICTURES):
        return None
    try:
        path = os.path.relpath(first, folder)
    except ValueError:  # on another drive
        path = str(first)
    return path.replace(os.sep, "/")
