"""Zero-normalised cross-correlation, and the placing of cut-outs."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from frictrack.records import Array, Mask

Rectangle = tuple[int, int, int, int]  # x, y, w, h in px
Patch = NDArray[Any]  # grey values


def nearest_corner(at: NDArray[Any], picture: tuple[int, ...], size: tuple[int, ...]) -> NDArray[np.int64]:
    """Round positions to whole pixels such that cut-outs lie in the picture.

    Parameters
    ----------
    at : array (n, 2)
        Positions (x, y) of the upper left corners, px.
    picture, size : tuple of int
        Height and width of the picture and of the cut-outs, px.

    Returns
    -------
    array of int (n, 2)
        Corners, px.

    Examples
    --------
    >>> nearest_corner(np.array([[3.4, 99.0]]), (50, 60), (10, 10)).tolist()
    [[3, 40]]

    """
    max_corner = np.array(picture[::-1]) - np.array(size[::-1])
    return np.asarray(np.rint(at).astype(np.int64).clip(0, max_corner))


def correlate(frame: Patch, patch: Patch, included: Mask | None = None) -> Patch:
    """Compute the zero-normalised cross-correlation of a patch at every position in a frame.

    Parameters
    ----------
    frame : array (H, W)
        Grey values.
    patch : array (h, w)
        Grey values of the template.
    included : array of bool (h, w), optional
        Pixels of the patch that are compared; all by default.

    Returns
    -------
    array (H - h + 1, W - w + 1)
        Scores from -1 to 1; 0 where the frame is flat.

    References
    ----------
    J. P. Lewis, "Fast template matching", Vision Interface 95 (1995), 120-123.

    Examples
    --------
    >>> frame = np.arange(48, dtype=np.float32).reshape(6, 8) ** 2 % 97
    >>> scores = correlate(frame, frame[2:5, 3:7])
    >>> np.unravel_index(scores.argmax(), scores.shape) == (2, 3)
    True

    """
    if frame.dtype != np.uint8 or included is not None:
        frame, patch = frame.astype(np.float32), patch.astype(np.float32)
    mask = None if included is None else included.astype(np.float32)
    scores = cv2.matchTemplate(frame, patch, cv2.TM_CCOEFF_NORMED, mask=mask)
    # In flat regions the norm is a rounding error, and OpenCV may return any value, infinity included.
    scores[~(np.abs(scores) <= 1.0001)] = 0
    return np.asarray(scores)


def best_match(frame: Patch, patch: Patch, included: Mask | None = None) -> tuple[Array, float]:
    """Locate the best match of a patch in a frame, between the pixels by a parabola along each axis.

    Parameters
    ----------
    frame, patch, included
        As in `correlate`.

    Returns
    -------
    corner : array (2,)
        Upper left corner (x, y), px.
    score : float
        Its score at the nearest pixel.

    """
    scores = correlate(frame, patch, included)
    _, score, _, (i, j) = cv2.minMaxLoc(scores)
    return np.array([i + parabola_vertex(scores[j], i), j + parabola_vertex(scores[:, i], j)]), float(score)


def parabola_vertex(scores: Array, i: int) -> float:
    """Locate the maximum of the parabola through a score and its two neighbours.

    Parameters
    ----------
    scores : array (n,)
        Scores along one axis.
    i : int
        Index of the largest score.

    Returns
    -------
    float
        Offset of the maximum from `i`, px; 0 at the ends and where the parabola has no maximum.

    Examples
    --------
    >>> parabola_vertex(np.array([0.5, 1.0, 0.75]), 1)
    0.16666666666666666

    """
    if i in (0, len(scores) - 1):
        return 0.0
    a, b, c = (float(s) for s in scores[i - 1 : i + 2])
    curvature = a - 2 * b + c
    return 0.5 * (a - c) / curvature if curvature < 0 else 0.0
