"""Read the point masses of a project of Tracker (Open Source Physics): .trk, or .trz, a ZIP file with a .trk.

A .trk is the XML of the panel: ``videoclip`` (first frame, step size, number of steps, start time in ms),
``clipcontrol`` (``delta_t``, duration of a frame in ms), ``coords`` (origin in px, angle in degrees, scale in px per
unit of length, for frame 0 and each frame from which on they differ), and ``tracks``. A point mass has a position in px
for each frame.

World coordinates follow ``ImageCoordSystem.updateTransforms`` and times ``StepperClipControl.getStepTime``, both of
github.com/OpenSourcePhysics/osp; tracks ``PointMass.Loader`` of github.com/OpenSourcePhysics/tracker.
"""

from __future__ import annotations

import re
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from frictrack.records import Array
from frictrack.study.table_cells import TableFile, read_limited, read_xml
from frictrack.study.track_formats.track_table import SECONDS, TargetPositions, table_of_tracks

if TYPE_CHECKING:
    from xml.etree.ElementTree import Element

POINT_MASS = "org.opensourcephysics.cabrillo.tracker.PointMass"
COORDINATES = {"xorigin": 0.0, "yorigin": 0.0, "angle": 0.0, "xscale": 1.0, "yscale": 1.0}  # of a frame, with defaults
DEFAULT_UNIT = "m"  # that of Tracker, if the file states none
MAX_FRAMES = 1 << 24
ZIP_FAULTS = (zipfile.BadZipFile, zlib.error, EOFError, RuntimeError)  # RuntimeError: a password, or unknown packing
_INDEX = re.compile(r"\[(\d{1,8})\]")


def read_tracker_project(path: Path) -> TableFile:
    """Read the point masses of a project of Tracker as columns t, x and y, as its data tables show them.

    Parameters
    ----------
    path
        A .trk or .trz file.

    Raises
    ------
    ValueError
        If it is damaged, or states no duration of a frame.

    """
    panel = read_xml(_project(path))
    if moving := _text(panel, "referenceframe"):
        raise ValueError(
            f'its coordinates move with the track "{moving}"; choose the default ones in Tracker, and save'
        )
    parts = {name: _object(panel, name) for name in ("videoclip", "clipcontrol", "coords")}
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
        with path.open("rb") as file:
            return read_limited(file)
    try:
        with zipfile.ZipFile(path) as packed:
            names = [name for name in packed.namelist() if name.lower().endswith(".trk")]
            if len(names) != 1:
                raise ValueError(f"expected one .trk in it but got {len(names)}")
            with packed.open(names[0]) as file:
                return read_limited(file)
    except ZIP_FAULTS as e:
        raise ValueError(str(e)) from e


def _object(parent: Element, name: str) -> Element | None:
    """Return the object that a property holds."""
    return parent.find(f"./property[@name='{name}']/object")


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
