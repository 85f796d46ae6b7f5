"""Define the repair of some frames of a run, and the codes with which repaired frames are marked."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from itertools import pairwise
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BeforeValidator, ConfigDict, Field, TypeAdapter, ValidationError

from frictrack.base.errors import FrictrackError, describe_invalid
from frictrack.base.polygons import Polygon, polygon
from frictrack.records import INTERPOLATED

How = Literal["track", "interpolate", "leave_out"]
# Codes of the column `repaired`; 0 is a frame that was measured and left as it was.
TRACKED_AGAIN, LEFT_OUT = 1, 3
CODES: dict[str, int] = {"track": TRACKED_AGAIN, "interpolate": INTERPOLATED, "leave_out": LEFT_OUT}
MEANINGS = {"track": "tracked again", "interpolate": "interpolated", "leave_out": "left out"}
_EXAMPLE = 'repair = [{from = 120, to = 160, how = "track", target = [x, y, width, height]}]'


def _read_target(raw: Any) -> tuple[float, ...] | Polygon:
    """Read a rectangle, which stays four numbers, or an outline."""
    corners = polygon(raw)
    return tuple(float(v) for v in raw) if np.ndim(raw) == 1 else corners


Frame = Annotated[int, Field(ge=0, strict=True)]  # number of a frame
Target = Annotated[tuple[float, ...] | Polygon, BeforeValidator(_read_target)]


@dataclass(frozen=True)
class Repair:
    """Repair of the frames `first` to `last` of a film, both included.

    Examples
    --------
    >>> Repair(120, 160, "track", target=(400.0, 80.0, 60.0, 40.0)).place
    (429.5, 99.5)

    """

    __pydantic_config__: ClassVar = ConfigDict(extra="forbid")
    first: Annotated[Frame, Field(alias="from")]  # first, last: numbers of the first and the last frame
    last: Annotated[Frame, Field(alias="to")]
    # "track": find the target again from `target`; "interpolate": bridge the frames by the smoothed motion;
    # "leave_out": treat them as lost
    how: How
    frame: Frame | None = None  # frame in which `target` is given; by default the first one
    # corners [[x, y], ...] or rectangle [x, y, w, h], px, that tells where the target is; only for "track"
    target: Target | None = None

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

    @property
    def fault(self) -> str:
        """What is wrong with frames and target; empty if nothing is."""
        first, last = self.first, self.last
        if last < first:
            return f"expected a repair whose last frame follows the first but got {first} to {last}"
        if self.how != "track" and not (self.target is None and self.frame is None):
            return f'expected target and frame only in a repair with how = "track" but got them with "{self.how}"'
        if self.how == "track" and self.target is None:
            return (
                f'expected target = [x, y, width, height] in the repair of frames {first} to {last} with how = "track" '
                "but got none; draw the target in one of these frames"
            )
        inside = first <= self.start_frame <= last
        expected = f"expected the target of a repair in a frame from {first} to {last}"
        return "" if inside else f"{expected} but got frame {self.frame}"

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


_REPAIRS = TypeAdapter(list[Repair])


def read_repairs(raw: Any) -> tuple[Repair, ...]:
    """Read the repairs of a run, as a study file has them, in order of their frames.

    `raw`: tables with the keys from, to, how, frame and target. Raises FrictrackError
    for unknown keys, frames that are no numbers, repairs that overlap, and a missing or superfluous target.

    Examples
    --------
    >>> read_repairs([{"from": 20, "to": 24, "how": "leave_out"}])
    (Repair(first=20, last=24, how='leave_out', frame=None, target=None),)

    """
    try:
        found = sorted(_REPAIRS.validate_python(raw), key=lambda one: one.first)
    except ValidationError as e:
        raise FrictrackError(f"expected {_EXAMPLE}; in repair: {describe_invalid(e)}") from e
    for one in found:
        if fault := one.fault:
            raise FrictrackError(fault)
    for one, other in pairwise(found):
        if other.first <= one.last:
            raise FrictrackError(
                f"expected repairs that do not overlap but {one.frames_text} and {other.frames_text} have frames in "
                "common; shorten one of them"
            )
    return tuple(found)


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
