"""Areas that somebody has drawn: the target's outline, parts that are not of it, and what stands before it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from frictrack.errors import FrictrackError
from frictrack.polygons import Polygon, check_within, inside, polygon, polygons
from frictrack.records import Mask
from frictrack.tracking.correlation import Rectangle
from frictrack.tracking.fixed_pattern import FixedPattern

MIN_TARGET_PIXELS = 64  # of a target that its outline and exclusions must leave


@dataclass(frozen=True)
class Areas:
    """A target with what was drawn in and before it.

    Parameters
    ----------
    target
        Whatever `track` takes for a target; an outline [[x, y], ...] is a polygon of it.
    exclude
        Polygons or rectangles in the target's own frame that move with it and are no part of it, px.
    obstacles
        Polygons or rectangles fixed in the picture, behind which the target passes, px.

    Raises
    ------
    FrictrackError
        For what is no polygon, see `frictrack.polygons.polygon`.

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
        """Corners of the target, where it is given by them."""
        return polygon(self.target) if is_polygon(self.target) else ()

    def check(self, shape: tuple[int, int]) -> None:
        """Raise `FrictrackError` where a polygon leaves the picture (h, w)."""
        if self.outline:
            check_within(self.outline, shape, "a target")
        for what, areas in (("an area to exclude", self.exclude), ("an obstacle", self.obstacles)):
            for area in areas:
                check_within(area, shape, what)

    def target_mask(self, rectangle: Rectangle) -> Mask | None:
        """Pixels (h, w) of the target's rectangle that belong to it; None where all do."""
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
        """Pixels (H, W) of the picture before which an obstacle stands; None without any."""
        if not self.obstacles:
            return None
        return np.any([inside(area, shape) for area in self.obstacles], axis=0)


def is_polygon(target: Any) -> bool:
    """Whether a target is given as corners [[x, y], ...]: no numbers, no path, no picture."""
    if isinstance(target, np.ndarray):
        return target.ndim == 2 and target.shape[1] == 2
    return isinstance(target, list | tuple) and len(target) > 0 and all(isinstance(c, list | tuple) for c in target)


def bounding_rectangle(outline: Polygon) -> tuple[int, int, int, int]:
    """The rectangle (x, y, w, h) of the pixels whose centres can lie within an outline."""
    at = np.array(outline)
    low, high = np.ceil(at.min(axis=0)).astype(int), np.floor(at.max(axis=0)).astype(int)
    return int(low[0]), int(low[1]), int(high[0] - low[0]) + 1, int(high[1] - low[1]) + 1


def with_obstacles(pattern: FixedPattern | None, obstacle_mask: Mask | None) -> FixedPattern | None:
    """What stands still before the target, with the obstacles that were drawn."""
    if obstacle_mask is None:
        return pattern
    free = (~obstacle_mask).astype(np.float32)
    if pattern is None:
        return FixedPattern(np.ones_like(free), np.zeros_like(free), free)
    return FixedPattern(pattern.slope, pattern.level, np.minimum(pattern.share, free))
