"""The header of a recording, as each file format reads it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Header:
    """Facts about a recording before any frame is used.

    Attributes
    ----------
    n_frames : int
        Number of frames in the file.
    shape : tuple of int
        Height and width, px.
    bit_depth : int
        Bits of a grey value.
    fps : float or None
        Frame rate in the file, 1/s.
    ticks : array of int (n_frames,) or None
        Frame intervals since the first frame; gaps are kept. None for 0, 1, 2, ...
    notes : tuple of str
        Findings about the file.
    stamps : array (n_frames,) or None
        Time stamp of each frame, s; NaN where there is none.
    exposure : float or None
        Exposure time, s.
    trigger : int or None
        Number of the frame at the trigger, counted from the first of the film; it may lie outside.
    camera : bool
        Whether rate and stamps are those of the camera; those of a container may be for playback.

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
