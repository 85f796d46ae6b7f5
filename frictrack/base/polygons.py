"""Read polygons in a picture, and mark the pixels inside. Pixel centres are integers, y points down."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from frictrack.base.errors import FrictrackError

MIN_CORNERS, MAX_CORNERS = 3, 1000
MAX_PX = 1e6  # beyond any picture

Polygon = tuple[tuple[float, float], ...]  # corners (x, y) px, in order


def polygon(raw: Any) -> Polygon:
    """Read a polygon from corners or a rectangle.

    Examples
    --------
    >>> polygon([[0, 0], [4, 0], [0, 4]])
    ((0.0, 0.0), (4.0, 0.0), (0.0, 4.0))
    >>> polygon([10, 20, 4, 2])
    ((9.5, 19.5), (13.5, 19.5), (13.5, 21.5), (9.5, 21.5))

    """
    if are_coordinates(raw, 4):
        return _rectangle(*(float(v) for v in raw))
    if not isinstance(raw, list | tuple | np.ndarray) or not all(are_coordinates(corner, 2) for corner in raw):
        raise FrictrackError(f"expected a polygon [[x, y], [x, y], [x, y], ...] in px but got {_shown(raw)}")
    if not MIN_CORNERS <= len(raw) <= MAX_CORNERS:
        raise FrictrackError(f"expected a polygon of {MIN_CORNERS} to {MAX_CORNERS} corners but got {len(raw)}")
    corners = tuple((float(x), float(y)) for x, y in raw)
    crossing = _crossing(np.array(corners))
    if crossing is not None:
        one, other = crossing
        raise FrictrackError(
            f"expected a polygon whose sides do not cross but side {one + 1} meets side {other + 1}; "
            "give its corners in the order in which they follow round it"
        )
    return corners


def polygons(raw: Any) -> tuple[Polygon, ...]:
    """Read several polygons.

    Parameters
    ----------
    raw : list or tuple
        Polygons or rectangles, each as in `polygon`.

    Returns
    -------
    tuple of polygons
        Corners (x, y), px.

    Raises
    ------
    FrictrackError
        As `polygon`, and for a single rectangle.

    """
    if not isinstance(raw, list | tuple) or are_coordinates(raw, 4):
        raise FrictrackError(f"expected a list of polygons [[[x, y], [x, y], [x, y]], ...] in px but got {_shown(raw)}")
    return tuple(polygon(one) for one in raw)


def inside(corners: Polygon, shape: tuple[int, ...], origin: tuple[int, int] = (0, 0)) -> NDArray[np.bool_]:
    """Mark the pixels whose centres lie inside a polygon.

    A ray from each pixel crosses the outline an odd number of times (Shimrat 1962, Commun. ACM 5:434).

    Examples
    --------
    >>> inside(polygon([1, 0, 2, 1]), (2, 4)).astype(int).tolist()
    [[0, 1, 1, 0], [0, 0, 0, 0]]

    """
    x, y = np.arange(shape[1]) + origin[0], (np.arange(shape[0]) + origin[1])[:, None]
    odd = np.zeros(shape[:2], np.bool_)
    for (x1, y1), (x2, y2) in zip(corners, (*corners[1:], corners[0]), strict=True):
        if y1 != y2:
            between = (y1 <= y) != (y2 <= y)
            odd ^= between & (x < x1 + (y - y1) * (x2 - x1) / (y2 - y1))
    return odd


def check_within(corners: Polygon, shape: tuple[int, int], what: str) -> None:
    """Check that a polygon lies in the picture, to within half a pixel.

    Parameters
    ----------
    corners : sequence of tuple of float
        Polygon, px.
    shape : tuple of int
        Height and width of the picture, px.
    what : str
        Name of the polygon for the message.

    Raises
    ------
    FrictrackError
        Where a corner lies outside.

    """
    h, w = shape
    for x, y in corners:
        if not (-0.5 <= x <= w - 0.5 and -0.5 <= y <= h - 0.5):
            raise FrictrackError(f"expected {what} inside the {w}x{h} px picture but got a corner at [{x:g}, {y:g}]")


def _rectangle(x: float, y: float, w: float, h: float) -> Polygon:
    """Outline of the pixels of a rectangle."""
    if min(w, h) <= 0:
        raise FrictrackError(
            f"expected a rectangle [x, y, width, height] with a size but got [{x:g}, {y:g}, {w:g}, {h:g}]"
        )
    return tuple((x - 0.5 + i * w, y - 0.5 + j * h) for i, j in ((0, 0), (1, 0), (1, 1), (0, 1)))


def are_coordinates(raw: Any, count: int) -> bool:
    """Return whether these are `count` numbers that can be pixel coordinates."""
    listed = isinstance(raw, list | tuple | np.ndarray) and len(raw) == count
    numbers = listed and all(isinstance(v, int | float | np.number) and not isinstance(v, bool) for v in raw)
    return bool(numbers and all(abs(v) < MAX_PX for v in raw))


def _shown(raw: Any) -> str:
    text = repr(raw)
    return text if len(text) <= 80 else f"{text[:77]}..."


def _crossing(at: NDArray[np.float64]) -> tuple[int, int] | None:
    """The first two sides of a closed polygon (n, 2) that meet without being neighbours, or overlap."""
    n = len(at)
    end = np.roll(at, -1, axis=0)
    for i in range(n):
        j = np.arange(i + 1, n)
        a, b = _side(at[i], end[i], at[j]), _side(at[i], end[i], end[j])
        c, d = _side(at[j], end[j], at[i]), _side(at[j], end[j], end[i])
        neighbours = (j == i + 1) | ((i == 0) & (j == n - 1))
        meets = np.where(neighbours, _folded(at[i], end[i], at[j], end[j]), (a * b <= 0) & (c * d <= 0) & (a != b))
        if meets.any():
            return i, int(j[np.argmax(meets)])
    return None


def _side(a: NDArray[np.float64], b: NDArray[np.float64], p: NDArray[np.float64]) -> NDArray[np.float64]:
    """Side of the line from a to b on which a point p lies: the sign of the cross product."""
    (ux, uy), (vx, vy) = (b - a).T, (p - a).T
    return np.asarray(ux * vy - uy * vx)


def _folded(a: NDArray[np.float64], b: NDArray[np.float64], c: NDArray[np.float64], d: NDArray[np.float64]) -> Any:
    """Whether neighbouring sides a-b and c-d (n, 2) overlap, or have no length."""
    u, v = b - a, d - c
    along = v @ u
    across = u[0] * v[:, 1] - u[1] * v[:, 0]
    return (across == 0) & (along <= 0)
