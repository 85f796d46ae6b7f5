"""Read the tracks in projects of video programs: Tracker (Open Source Physics) and Kinovea (format 2.0 and later).

Tracker: .trk, or .trz, a ZIP file with a .trk; its point masses are read.

A .trk is the XML of the panel: ``videoclip`` (first frame, step size, number of steps, start time in ms),
``clipcontrol`` (``delta_t``, duration of a frame in ms), ``coords`` (origin in px, angle in degrees, scale in px per
unit of length, for frame 0 and each frame from which on they differ), and ``tracks``. A point mass has a position in px
for each frame.

World coordinates follow ``ImageCoordSystem.updateTransforms`` and times ``StepperClipControl.getStepTime``, both of
github.com/OpenSourcePhysics/osp; tracks ``PointMass.Loader`` of github.com/OpenSourcePhysics/tracker.

Kinovea: .kva. It is XML: tracks of points ``x;y;time stamp`` in px, time stamps per frame, the frame rate of the
camera, and the calibration: a quadrilateral in the picture that is a rectangle of known size, or a line of known
length. Coordinates follow ``CalibratorPlane`` (``ReadPlaneXml``, ``ReadLineXml``, ``MakeQuad``,
``GridToWorldWithOffset``), times ``Metadata.GetNumericalTime`` of github.com/Kinovea/Kinovea; there they are shown
rounded to milliseconds.
"""

from __future__ import annotations

import re
import zipfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from frictrack.records import Array
from frictrack.study.table_layout import MAX_UNPACKED_BYTES, TableFile, read_xml
from frictrack.study.track_formats.picture_tracks import FRAMES, SECONDS, TargetPositions, table_of_tracks

if TYPE_CHECKING:
    from xml.etree.ElementTree import Element

POINT_MASS = "org.opensourcephysics.cabrillo.tracker.PointMass"
COORDINATES = {"xorigin": 0.0, "yorigin": 0.0, "angle": 0.0, "xscale": 1.0, "yscale": 1.0}  # of a frame, with defaults
DEFAULT_UNIT = "m"  # that of Tracker, if the file states none
MAX_FRAMES = 1 << 24
_INDEX = re.compile(r"\[(\d{1,8})\]")


def read_tracker_project(path: Path) -> TableFile:
    """Read the point masses of a project of Tracker as columns t, x and y, as its data tables show them."""
    panel = read_xml(_project(path))
    if moving := _text(panel, "referenceframe"):
        raise ValueError(
            f'its coordinates move with the track "{moving}"; choose the default ones in Tracker, and save'
        )
    parts = {name: panel.find(f"./property[@name='{name}']/object") for name in ("videoclip", "clipcontrol", "coords")}
    clip, control = _numbers(parts["videoclip"]), _numbers(parts["clipcontrol"])
    interval = control.get("delta_t", np.nan) / 1000.0
    if not interval > 0:
        raise ValueError("it states no duration of a frame (delta_t of its clipcontrol)")
    unit, coordinates = _text(panel, "length_unit") or DEFAULT_UNIT, _key_frames(parts["coords"])
    if all(one["xscale"] == one["yscale"] == 1.0 for one in coordinates.values()):
        unit = "px"  # a scale of 1 px per unit is that of a film without calibration
    tracks = []
    for mass in (found for found in panel.iter("object") if found.get("class") == POINT_MASS):
        marked = {n: _numbers(one) for n, one in _elements(mass, "framedata") if _is_in_clip(n, clip)}
        frames = np.array(sorted(marked), dtype=float)
        px, py = (np.array([marked[int(n)].get(axis, np.nan) for n in frames]) for axis in "xy")
        x, y = _world(frames, px, py, coordinates)
        at = clip.get("starttime", 0.0) / 1000.0 + (frames - clip.get("startframe", 0.0)) * interval
        pixels = {"pixelx (px)": px, "pixely (px)": py}
        tracks.append(TargetPositions(_text(mass, "name"), at, x, y, unit=unit, y_down=False, further=pixels))
    return table_of_tracks("Tracker", tracks, SECONDS)


def _project(path: Path) -> bytes:
    """Return the XML of a project, perhaps from its ZIP file."""
    if not zipfile.is_zipfile(path):
        return path.read_bytes()
    with zipfile.ZipFile(path) as packed:
        names = [name for name in packed.namelist() if name.lower().endswith(".trk")]
        if len(names) != 1:
            raise ValueError(f"expected one .trk in it but got {len(names)}")
        with packed.open(names[0]) as file:
            return file.read(MAX_UNPACKED_BYTES)


def _text(parent: Element, name: str) -> str:
    found = parent.find(f"./property[@name='{name}']")
    return "" if found is None else (found.text or "").strip()


def _numbers(parent: Element | None) -> dict[str, float]:
    """Return the finite numbers among the properties of an object."""
    numbers = {}
    for one in () if parent is None else parent.findall("./property"):
        if one.get("type") in ("int", "double"):
            value = float(one.text or "nan")
            if np.isfinite(value):
                numbers[one.get("name", "")] = value
    return numbers


def _elements(parent: Element | None, name: str) -> Iterator[tuple[int, Element]]:
    """Yield the numbers and objects of an array, in which other places are empty."""
    for one in () if parent is None else parent.findall(f"./property[@name='{name}']/property"):
        place, inner = _INDEX.fullmatch(one.get("name", "")), one.find("object")
        if place is not None and inner is not None and int(place[1]) < MAX_FRAMES:
            yield int(place[1]), inner


def _is_in_clip(frame: int, clip: Mapping[str, float]) -> bool:
    """Return whether a frame is a step of the clip; Tracker shows only these."""
    step = max(clip.get("stepsize", 1.0), 1.0)
    number = (frame - clip.get("startframe", 0.0)) / step
    return number == round(number) and 0 <= number < clip.get("stepcount", np.inf)


def _key_frames(coords: Element | None) -> dict[int, dict[str, float]]:
    """Return origin, angle and scale from each frame on in which they change; what is fixed is that of the last one."""
    found = {n: COORDINATES | _numbers(one) for n, one in _elements(coords, "framedata")} or {0: dict(COORDINATES)}
    last = found[max(found)]
    for kind, keys in (("origin", ("xorigin", "yorigin")), ("angle", ("angle",)), ("scale", ("xscale", "yscale"))):
        if coords is not None and _text(coords, f"fixed{kind}") == "true":
            for one in found.values():
                one |= {key: last[key] for key in keys}
    if any(one[key] == 0 for one in found.values() for key in ("xscale", "yscale")):
        raise ValueError("expected a scale other than 0 px per unit of length")
    return found


def _world(frames: Array, px: Array, py: Array, coordinates: Mapping[int, dict[str, float]]) -> tuple[Array, Array]:
    """Transform pixels into world coordinates, (n,) each; y points up."""
    starts = np.array(sorted(coordinates))
    latest = starts[np.maximum(np.searchsorted(starts, frames, side="right") - 1, 0)]
    at = {key: np.array([coordinates[int(n)][key] for n in latest]) for key in COORDINATES}
    right, up = (px - at["xorigin"]) / at["xscale"], -(py - at["yorigin"]) / at["yscale"]
    cos, sin = np.cos(np.radians(at["angle"])), np.sin(np.radians(at["angle"]))
    return right * cos + up * sin, up * cos - right * sin


ROOT = "KinoveaVideoAnalysis"
MIN_VERSION = 2.0
MAX_HEAD_BYTES = 4096  # in which the root element begins
TIME_ORIGINS = ("TimeOrigin", "SelectionStart", "FirstTimeStamp")  # the first one that is there
DEFAULT_LINE_PX = 100.0  # length of the line that stands for a calibration that states only a scale
Points = NDArray[np.float64]  # (n, 2)


def is_kinovea_project(path: Path) -> bool:
    """Return whether a file holds annotations of Kinovea, which may also be saved as .xml."""
    with path.open("rb") as file:
        return f"<{ROOT}".encode() in file.read(MAX_HEAD_BYTES).replace(b"\0", b"")


def read_kinovea_project(path: Path) -> TableFile:
    """Read the tracks of annotations of Kinovea as columns t, x and y, in the unit of its calibration."""
    root = read_xml(path.read_bytes())
    if root.tag != ROOT or (version := _number(root, "FormatVersion", 0.0)) < MIN_VERSION:
        got = f"version {version:g}" if root.tag == ROOT else f"<{root.tag[:40]}>"
        raise ValueError(f"expected annotations of Kinovea, format {MIN_VERSION} or later, but got {got}")
    calibration = root.find("Calibration")
    if calibration is not None and calibration.find("CameraCalibration") is not None:
        raise ValueError("it corrects the distortion of the lens; export a spreadsheet from Kinovea")
    stamps, rate = _number(root, "AverageTimeStampsPerFrame"), _number(root, "CaptureFramerate", 0.0)
    if not stamps > 0:
        raise ValueError(f"expected time stamps per frame above 0 but got {stamps:g}")
    origin = next((_number(root, key) for key in TIME_ORIGINS if root.find(key) is not None), 0.0)
    length = None if calibration is None else calibration.find("Unit")
    abbreviated = "" if length is None or length.text == "Pixels" else length.get("Abbreviation", "").strip()
    unit = abbreviated or "px"
    tracks = []
    for one in root.iterfind("./Tracks/Track"):
        points = np.array([_numbers_in(point.text, 3) for point in one.iterfind("./TrackPointList/TrackPoint")])
        if len(points):
            _, first = np.unique(points[:, 2], return_index=True)
            x, y = _kinovea_world(points[first, :2], root, calibration).T
            at = np.round((points[first, 2] - origin) / stamps) / (rate if rate > 0 else 1.0)
            label = one.find("MainLabel")  # where older versions have the name
            name = one.get("name") or (label.get("Text") if label is not None else None) or ""
            tracks.append(TargetPositions(name, at, x, y, unit=unit, y_down=False))
    return table_of_tracks("Kinovea", tracks, SECONDS if rate > 0 else FRAMES)


def _kinovea_world(points: Points, root: Element, calibration: Element | None) -> Points:
    """Transform points of the picture, px, (n, 2), into coordinates of the calibration; y points up."""
    corners, size, origin, offset = _calibration(root, calibration)
    to_grid = _homography(corners, np.array([[0.0, 0.0], [size[0], 0.0], size, [0.0, size[1]]]))
    projected = np.c_[points, np.ones(len(points))] @ to_grid.T
    grid: Points = projected[:, :2] / projected[:, 2:]
    return (grid - origin) * [1.0, -1.0] + offset


def _calibration(root: Element, calibration: Element | None) -> tuple[Points, Array, Array, Array]:
    """Return the corners in the picture, clockwise from the upper left, size, origin in the rectangle, and offset."""
    plane, line = (
        None if calibration is None else calibration.find(f"Calibration{kind}") for kind in ("Plane", "Line")
    )
    if plane is not None:
        corners = np.array([_numbers_in(plane.findtext(f"Quadrilateral/{corner}"), 2) for corner in "ABCD"])
        size = _numbers_in(plane.findtext("Size"), 2)
        return corners, size, _pair(plane, "Origin", (0.0, size[1])), _pair(plane, "Offset")
    if line is not None and line.find("Scale") is None:
        start, end = (_numbers_in(line.findtext(f"Segment/{end}"), 2) for end in "AB")
        corners = _square(start, end, line.findtext("Axis"))
        length = _number(line, "Length")
        return corners, np.full(2, length), _pair(line, "Origin", (0.0, length)), _pair(line, "Offset")
    if line is not None:  # until 0.8.22: the origin in the picture, and units of length per px
        start = np.nan_to_num(_pair(line, "Origin"))
        length = DEFAULT_LINE_PX * _number(line, "Scale")
    else:  # nothing is calibrated: px from the middle of the picture
        start, length = _pair(root, "ImageSize") / 2.0, DEFAULT_LINE_PX
    corners = _square(start, start + np.array([DEFAULT_LINE_PX, 0.0]), None)
    return corners, np.full(2, length), np.array([0.0, length]), np.zeros(2)


def _square(start: Array, end: Array, axis: str | None) -> Points:
    """Return the corners of the square over a line: its lower edge, its left edge, or one as long and level."""
    dx, dy = end - start
    if axis == "LineVertical":
        dx, dy = -dy, dx
    elif axis == "ImageAxes":
        dx, dy = np.hypot(dx, dy), 0.0
    up, along = np.array([dy, -dx]), np.array([dx, dy])
    return np.array([start + up, start + up + along, start + along, start])


def _homography(points: Points, places: Points) -> Points:
    """Return the matrix that projects four points of the picture to four places (Hartley & Zisserman 2004, 4.1)."""
    rows = [
        row
        for (x, y), (u, v) in zip(points, places, strict=True)
        for row in ([x, y, 1, 0, 0, 0, -u * x, -u * y], [0, 0, 0, x, y, 1, -v * x, -v * y])
    ]
    try:
        return np.append(np.linalg.solve(np.array(rows, dtype=float), places.ravel()), 1.0).reshape(3, 3)
    except np.linalg.LinAlgError as e:
        raise ValueError("its calibration has no area") from e


def _number(parent: Element, name: str, default: float = np.nan) -> float:
    return float(parent.findtext(name) or default)


def _pair(parent: Element, name: str, default: tuple[float, float] = (0.0, 0.0)) -> Array:
    written = parent.findtext(name)
    return np.array(default) if written is None else _numbers_in(written, 2)


def _numbers_in(written: str | None, count: int) -> Array:
    """Return the first numbers of a text such as ``1.5;2;3``."""
    parts = (written or "").split(";")[:count]
    if len(parts) < count:
        raise ValueError(f"expected {count} numbers separated by ; but got {(written or '')[:40]!r}")
    return np.array([float(part) for part in parts])
