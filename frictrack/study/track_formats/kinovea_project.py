"""Read the tracks of the annotations of Kinovea (.kva, format 2.0 and later).

A .kva is XML: tracks of points ``x;y;time stamp`` in px, time stamps per frame, the frame rate of the camera, and the
calibration: a quadrilateral in the picture that is a rectangle of known size, or a line of known length. Coordinates
follow ``CalibratorPlane`` (``ReadPlaneXml``, ``ReadLineXml``, ``MakeQuad``, ``GridToWorldWithOffset``), times
``Metadata.GetNumericalTime`` of github.com/Kinovea/Kinovea; there they are shown rounded to milliseconds.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from frictrack.records import Array
from frictrack.study.table_cells import TableFile, read_limited, read_xml
from frictrack.study.track_formats.track_table import FRAMES, SECONDS, TargetPositions, table_of_tracks

if TYPE_CHECKING:
    from xml.etree.ElementTree import Element

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
    """Read the tracks of annotations of Kinovea as columns t, x and y, in the unit of its calibration.

    Parameters
    ----------
    path
        A .kva file, or .xml.

    Raises
    ------
    ValueError
        If it is damaged, of an older format, or corrected for the distortion of the lens.

    """
    with path.open("rb") as file:
        root = read_xml(read_limited(file))
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
    tracks = []
    for one in root.iterfind("./Tracks/Track"):
        points = np.array([_numbers(point.text, 3) for point in one.iterfind("./TrackPointList/TrackPoint")])
        if len(points):
            _, first = np.unique(points[:, 2], return_index=True)
            x, y = _world(points[first, :2], root, calibration).T
            at = np.round((points[first, 2] - origin) / stamps) / (rate if rate > 0 else 1.0)
            tracks.append(TargetPositions(_name(one), at, x, y, unit=_unit(calibration), y_down=False))
    return table_of_tracks("Kinovea", tracks, SECONDS if rate > 0 else FRAMES)


def _name(track: Element) -> str:
    """Return the name of a track; older versions only have it in the label."""
    label = track.find("MainLabel")
    return track.get("name") or (label.get("Text") if label is not None else None) or ""


def _unit(calibration: Element | None) -> str:
    """Return the unit of length; px if nothing is calibrated."""
    unit = None if calibration is None else calibration.find("Unit")
    return "px" if unit is None or unit.text == "Pixels" else unit.get("Abbreviation", "px").strip() or "px"


def _world(points: Points, root: Element, calibration: Element | None) -> Points:
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
        corners = np.array([_numbers(plane.findtext(f"Quadrilateral/{corner}"), 2) for corner in "ABCD"])
        size = _numbers(plane.findtext("Size"), 2)
        return corners, size, _pair(plane, "Origin", (0.0, size[1])), _pair(plane, "Offset")
    if line is not None and line.find("Scale") is None:
        start, end = (_numbers(line.findtext(f"Segment/{end}"), 2) for end in "AB")
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
    return np.array(default) if written is None else _numbers(written, 2)


def _numbers(written: str | None, count: int) -> Array:
    """Return the first numbers of a text such as ``1.5;2;3``."""
    parts = (written or "").split(";")[:count]
    if len(parts) < count:
        raise ValueError(f"expected {count} numbers separated by ; but got {(written or '')[:40]!r}")
    return np.array([float(part) for part in parts])
