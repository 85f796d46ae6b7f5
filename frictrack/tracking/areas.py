"""Read areas that the user has drawn: the target's outline, excluded parts of it, and obstacles before it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from frictrack.base.errors import FrictrackError
from frictrack.base.polygons import Polygon, check_within, inside, polygon, polygons
from frictrack.records import Mask
from frictrack.tracking.correlation import Rectangle
from frictrack.tracking.template import FixedPattern

MIN_TARGET_PIXELS = 64  # that outline and exclusions must leave


@dataclass(frozen=True)
class Areas:
    """Target together with areas that were drawn in and before it.

    Parameters
    ----------
    target
        Any target that `track` accepts; an outline [[x, y], ...] is a polygon.
    exclude
        Polygons or rectangles, px, that move with the target but do not belong to it.
    obstacles
        Polygons or rectangles, px, fixed in the picture, behind which the target passes.

    Raises
    ------
    FrictrackError
        For areas that are not polygons, see `frictrack.base.polygons.polygon`.

    Examples
    --------
    >>> Areas([40, 30, 64, 48], obstacles=[[90, 0, 12, 128]]).obstacles
    (((89.5, -0.5), (101.5, -0.5), (101.5, 127.5), (89.5, 127.5)),)

    """

    target: Any = None
    exclude: Sequence[Any] = ()
    obstacles: Sequence[Any] = ()

    def __post_init__(self) -> None:
        for name in ("exclude", "obstacles"):
            object.__setattr__(self, name, polygons(getattr(self, name)))

    @property
    def outline(self) -> Polygon:
        """Corners of the target's outline; empty if the target is not a polygon."""
        return polygon(self.target) if is_polygon(self.target) else ()

    def check(self, shape: tuple[int, int]) -> None:
        """Check that every polygon lies in the picture.

        Parameters
        ----------
        shape : tuple of int
            Height and width of the picture, px.

        Raises
        ------
        FrictrackError
            Where a polygon leaves the picture.

        """
        if self.outline:
            check_within(self.outline, shape, "a target")
        for what, areas in (("an area to exclude", self.exclude), ("an obstacle", self.obstacles)):
            for area in areas:
                check_within(area, shape, what)

    def target_mask(self, rectangle: Rectangle) -> Mask | None:
        """Mark the pixels of the target's rectangle that belong to the target.

        Parameters
        ----------
        rectangle : tuple of int
            x, y, w, h in px.

        Returns
        -------
        array of bool (h, w) or None
            None where all pixels belong to the target.

        Raises
        ------
        FrictrackError
            Where fewer than `MIN_TARGET_PIXELS` pixels remain.

        """
        if not (self.outline or self.exclude):
            return None
        x, y, w, h = rectangle
        mask = inside(self.outline, (h, w), (x, y)) if self.outline else np.ones((h, w), np.bool_)
        for area in self.exclude:
            mask &= ~inside(area, (h, w), (x, y))
        n_left = int(np.count_nonzero(mask))
        if n_left < MIN_TARGET_PIXELS:
            raise FrictrackError(
                f"expected a target of at least {MIN_TARGET_PIXELS} pixels but its outline and exclusions leave "
                f"{n_left}; draw the target larger or exclude less"
            )
        return mask

    def obstacle_mask(self, shape: tuple[int, int]) -> Mask | None:
        """Mark the pixels of the picture that obstacles cover.

        Parameters
        ----------
        shape : tuple of int
            Height and width of the picture, px.

        Returns
        -------
        array of bool (H, W) or None
            None without obstacles.

        """
        if not self.obstacles:
            return None
        return np.any([inside(area, shape) for area in self.obstacles], axis=0)


def is_polygon(target: Any) -> bool:
    """Whether a target is given as corners.

    Parameters
    ----------
    target
        Any target that `track` accepts.

    Returns
    -------
    bool
        True for [[x, y], ...] and arrays (n, 2); false for numbers, paths and pictures.

    Examples
    --------
    >>> is_polygon([[0, 0], [9, 0], [9, 9]]), is_polygon([3, 4, 20, 10])
    (True, False)

    """
    if isinstance(target, np.ndarray):
        return target.ndim == 2 and target.shape[1] == 2
    return isinstance(target, list | tuple) and len(target) > 0 and all(isinstance(c, list | tuple) for c in target)


def bounding_rectangle(outline: Polygon) -> tuple[int, int, int, int]:
    """Compute the rectangle (x, y, w, h) px of the pixels whose centres can lie within an outline.

    Examples
    --------
    >>> bounding_rectangle(((0.5, 0.5), (4.5, 0.5), (4.5, 2.5)))
    (1, 1, 4, 2)

    """
    at = np.array(outline)
    low, high = np.ceil(at.min(axis=0)).astype(int), np.floor(at.max(axis=0)).astype(int)
    return int(low[0]), int(low[1]), int(high[0] - low[0]) + 1, int(high[1] - low[1]) + 1


def with_obstacles(pattern: FixedPattern | None, obstacle_mask: Mask | None) -> FixedPattern | None:
    """Combine a fixed pattern with the obstacles (H, W) that the user has drawn: weight 0 where one stands."""
    if obstacle_mask is None:
        return pattern
    free = (~obstacle_mask).astype(np.float32)
    if pattern is None:
        return FixedPattern(np.ones_like(free), np.zeros_like(free), free)
    return FixedPattern(pattern.slope, pattern.level, np.minimum(pattern.share, free))
