"""Normalised correlation, and the cutting out of rectangles: what finding and following share."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from frictrack.records import Array, Mask

Rectangle = tuple[int, int, int, int]  # x, y, w, h in px
Patch = NDArray[Any]  # grey values


def nearest_corner(at: NDArray[Any], picture: tuple[int, ...], size: tuple[int, ...]) -> NDArray[np.int64]:
    """Upper left corners (n, 2) of whole pixels nearest to places (n, 2) px, so that rectangles lie in the picture.

    `picture` and `size` are the shapes (h, w) of the picture and of the rectangles.
    """
    max_corner = np.array(picture[::-1]) - np.array(size[::-1])
    return np.asarray(np.rint(at).astype(np.int64).clip(0, max_corner))


def correlate(frame: Patch, patch: Patch, included: Mask | None = None) -> Patch:
    """Zero-normalised cross-correlation of `patch` at every place in `frame`; flat places score 0.

    `included` are the pixels (h, w) of the patch that are compared; None for all.
    """
    if frame.dtype != np.uint8 or included is not None:
        frame, patch = frame.astype(np.float32), patch.astype(np.float32)
    mask = None if included is None else included.astype(np.float32)
    scores = cv2.matchTemplate(frame, patch, cv2.TM_CCOEFF_NORMED, mask=mask)
    # Where the picture is flat the norm is rounding error and OpenCV may return anything, infinity included.
    scores[~(np.abs(scores) <= 1.0001)] = 0
    return np.asarray(scores)


def parabola_vertex(scores: Array, i: int) -> float:
    """Vertex of the parabola through the best score and its neighbours, px from `i`."""
    if i in (0, len(scores) - 1):
        return 0.0
    a, b, c = (float(s) for s in scores[i - 1 : i + 2])
    curvature = a - 2 * b + c
    return 0.5 * (a - c) / curvature if curvature < 0 else 0.0
