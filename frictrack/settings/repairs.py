"""Define the repair of some frames of a run, and the codes with which repaired frames are marked."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from itertools import pairwise
from typing import Any, Literal, cast, get_args

import numpy as np
from numpy.typing import NDArray

from frictrack.base.errors import FrictrackError
from frictrack.base.polygons import Polygon, polygon
from frictrack.records import INTERPOLATED

How = Literal["track", "interpolate", "leave_out"]
# Codes of the column `repaired`; 0 is a frame that was measured and left as it was.
TRACKED_AGAIN, LEFT_OUT = 1, 3
CODES: dict[str, int] = {"track": TRACKED_AGAIN, "interpolate": INTERPOLATED, "leave_out": LEFT_OUT}
MEANINGS = {"track": "tracked again", "interpolate": "interpolated", "leave_out": "left out"}
_EXAMPLE = 'repair = [{from = 120, to = 160, how = "track", target = [x, y, width, height]}]'


@dataclass(frozen=True)
class Repair:
    """Repair of the frames `first` to `last` of a film, both included.

    Examples
    --------
    >>> Repair(120, 160, "track", target=(400.0, 80.0, 60.0, 40.0)).place
    (429.5, 99.5)

    """

    first: int  # first, last: numbers of the first and the last frame
    last: int
    # "track": find the target again from `target`; "interpolate": bridge the frames by the smoothed motion;
    # "leave_out": treat them as lost
    how: How
    frame: int | None = None  # frame in which `target` is given; by default the first one
    # corners [[x, y], ...] or rectangle [x, y, w, h], px, that tells where the target is; only for "track"
    target: tuple[float, ...] | Polygon | None = None

    @property
    def rows(self) -> slice:
        """The frames as a slice."""
        return slice(self.first, self.last + 1)

    @property
    def start_frame(self) -> int:
        """Number of the frame in which `target` is given."""
        return self.first if self.frame is None else self.frame

    @property
    def place(self) -> tuple[float, float]:
        """Middle (x, y) of `target`, px."""
        x, y, w, h = self.box
        return x + w / 2, y + h / 2

    @property
    def box(self) -> tuple[float, float, float, float]:
        """Rectangle (x, y, w, h) round `target`, px."""
        assert self.target is not None
        corners = np.asarray(polygon(list(self.target)))
        (x, y), (right, bottom) = corners.min(axis=0), corners.max(axis=0)
        return float(x), float(y), float(right - x), float(bottom - y)

    @property
    def frames_text(self) -> str:
        """The frames, as "frames 120 to 160"."""
        return f"frame {self.first}" if self.first == self.last else f"frames {self.first} to {self.last}"

    def to_dict(self) -> dict[str, Any]:
        """Return the repair as the study file has it."""
        names = {"first": "from", "last": "to"}
        return {names.get(key, key): value for key, value in asdict(self).items() if value is not None}

    def check(self, n_frames: int, shape: tuple[int, int] | None = None) -> None:
        """Check that the repair lies in the film.

        `n_frames`: number of frames of the film, or of rows of a table; `shape`: height and width of the picture, px.
        Raises FrictrackError for frames beyond the end, or a target outside the picture.
        """
        if self.last >= n_frames:
            raise FrictrackError(
                f"expected a repair of frames from 0 to {n_frames - 1} but got {self.first} to {self.last}; "
                "the film has no more frames"
            )
        if shape is None or self.target is None:
            return
        x, y = self.place
        if not (0 <= x < shape[1] and 0 <= y < shape[0]):
            raise FrictrackError(
                f"expected the target of a repair inside the {shape[1]}x{shape[0]} px picture but its middle is at "
                f"[{x:g}, {y:g}]; draw it in frame {self.start_frame}"
            )


_KEYS = ("from", "to", *(f.name for f in fields(Repair) if f.name not in ("first", "last")))


def read_repairs(raw: Any) -> tuple[Repair, ...]:
    """Read the repairs of a run, as a study file has them, in order of their frames.

    `raw`: tables with the keys from, to, how, frame and target. Raises FrictrackError
    for unknown keys, frames that are no numbers, repairs that overlap, and a missing or superfluous target.

    Examples
    --------
    >>> read_repairs([{"from": 20, "to": 24, "how": "leave_out"}])
    (Repair(first=20, last=24, how='leave_out', frame=None, target=None),)

    """
    if isinstance(raw, str | Mapping) or not isinstance(raw, Sequence):
        raise FrictrackError(f"expected {_EXAMPLE} but got {raw!r}")
    found = sorted((one if isinstance(one, Repair) else _read_one(one) for one in raw), key=lambda one: one.first)
    for one, other in pairwise(found):
        if other.first <= one.last:
            raise FrictrackError(
                f"expected repairs that do not overlap but {one.frames_text} and {other.frames_text} have frames in "
                "common; shorten one of them"
            )
    return tuple(found)


def _read_one(raw: Any) -> Repair:
    """Read one repair from a table."""
    if not isinstance(raw, Mapping):
        raise FrictrackError(f"expected {_EXAMPLE} but got {raw!r}")
    for key in raw:
        if key not in _KEYS:
            raise FrictrackError(f'expected the keys {", ".join(_KEYS)} in repair but got "{key}"')
    first, last = (_frame_number(raw, key) for key in ("from", "to"))
    frame = _frame_number(raw, "frame") if raw.get("frame") is not None else None
    if last < first:
        raise FrictrackError(f"expected a repair whose last frame follows the first but got {first} to {last}")
    how, target = raw.get("how"), raw.get("target")
    if how not in get_args(How):
        known = ", ".join(f'"{name}"' for name in get_args(How))
        raise FrictrackError(f"expected how as one of {known} in repair but got {how!r}")
    if how != "track" and not (target is None and frame is None):
        raise FrictrackError(f'expected target and frame only in a repair with how = "track" but got them with "{how}"')
    if how == "track" and target is None:
        raise FrictrackError(
            f'expected target = [x, y, width, height] in the repair of frames {first} to {last} with how = "track" '
            "but got none; draw the target in one of these frames"
        )
    if frame is not None and not first <= frame <= last:
        raise FrictrackError(f"expected the target of a repair in a frame from {first} to {last} but got frame {frame}")
    return Repair(first, last, cast("How", how), frame, None if target is None else _read_target(target))


def _frame_number(raw: Mapping[str, Any], key: str) -> int:
    """Read the number of a frame."""
    value = raw.get(key)
    if isinstance(value, bool) or not isinstance(value, int) or value < 0:
        raise FrictrackError(f"expected {key} in repair as the number of a frame, from 0, but got {value!r}")
    return value


def _read_target(raw: Any) -> tuple[float, ...] | Polygon:
    """Read a rectangle, which stays four numbers, or an outline."""
    corners = polygon(raw)
    return tuple(float(v) for v in raw) if np.ndim(raw) == 1 else corners


def repair_codes(repairs: Sequence[Repair], n: int) -> NDArray[np.int8]:
    """Return the code of each frame.

    The codes are 0 measured and unchanged, 1 tracked again, 2 interpolated, 3 left out.

    Examples
    --------
    >>> repair_codes([Repair(1, 2, "interpolate")], 4).tolist()
    [0, 2, 2, 0]

    """
    codes = np.zeros(n, np.int8)
    for one in repairs:
        codes[one.rows] = CODES[one.how]
    return codes
