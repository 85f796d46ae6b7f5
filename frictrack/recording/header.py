"""What a file format says of a recording."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Header:
    """What a format knows of a recording before any frame is used.

    `ticks` counts frame intervals since the first frame (None: 0, 1, 2, ...), so that gaps stay gaps. `stamps`:
    the camera's own time of each frame, s, NaN where there is none. `exposure`: s. `trigger`: number of the frame
    at the trigger, 0 is the first of the film (may lie outside it). `camera`: rate and stamps are those of filming,
    not a container's, which may be those of showing.
    """

    n_frames: int
    shape: tuple[int, int]
    bit_depth: int
    fps: float | None = None
    ticks: NDArray[np.int64] | None = None
    notes: tuple[str, ...] = ()
    stamps: NDArray[np.float64] | None = None
    exposure: float | None = None
    trigger: int | None = None
    camera: bool = False
