"""Film of a textured block that slides over a course: every pixel and every exposure integrated, truth known.

The picture is a static background, uniform within each pixel, and in front of it the block, whose texture is
integrated exactly over the covered part of each pixel (`texture`). An exposure is cut wherever an edge of the
block passes a pixel border; between two cuts the light on every pixel is smooth in time and a Gauss-Legendre
rule integrates it. A rod may stand in front of the block, and a highlight on the window adds its light to all.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import make_interp_spline

from frictrack.errors import FrictrackError
from frictrack.records import Array
from frictrack.simulate.camera import Camera, Oscillation
from frictrack.simulate.foreground import Highlight, Rod
from frictrack.simulate.texture import Surface
from frictrack.simulate.turned import Pose, turned_block

Trajectory = Callable[[Array], tuple[Array, ...]]  # times (n,) in s -> x, y in px and, if it turns, angle in rad

Pixels = NDArray[np.int_]

WALL = Surface(size=5.0, level=0.25, contrast=0.05, seed=2)
COURSE_STEP = 0.22  # how much lighter the course is than the wall behind it
COURSE_EDGE = 1.2  # softness of the course's upper edge, px
FEW, MORE = (np.polynomial.legendre.leggauss(n) for n in (3, 5))  # enough for 0.25 and 1 px of travel


@dataclass(frozen=True)
class Target:
    """A painted block in front of a static background; the course is the light band under its foot.

    Sizes in px. `rotation` (rad) turns the block about its centre in addition to the path's own angle. `rod` and
    `highlight` lie in front of all.
    """

    width: float = 90.0
    height: float = 60.0
    surface: Surface = field(default_factory=Surface)
    background: Surface = WALL
    course: bool = True
    rotation: Oscillation | None = None
    rod: Rod | None = None
    highlight: Highlight | None = None

    def __post_init__(self) -> None:
        if not (self.width > 1 and self.height > 1):
            raise FrictrackError(
                f"target: expected a block larger than 1 x 1 px but got {self.width:g} x {self.height:g} px"
            )


def render(
    position_px: Trajectory | Array,
    camera: Camera,
    target: Target,
    rng: np.random.Generator,
    n_frames: int | None = None,
) -> Iterator[NDArray[Any]]:
    """Recorded frames (height, width), uint8 for 8 bit, else uint16.

    `position_px` is the centre of the block without camera shake: a function of times (n,) in s that returns
    x, y in px (and the angle in rad), or an array (n_frames, 2 or 3) at the frame times i / fps. Pixel centres
    are integers, y points down. A function needs `n_frames` and is also asked for times half an exposure
    before the first and after the last frame.
    """
    for clean in render_clean(position_px, camera, target, n_frames):
        yield camera.record(clean, rng)


def render_clean(
    position_px: Trajectory | Array, camera: Camera, target: Target, n_frames: int | None = None
) -> Iterator[Array]:
    """Frames (height, width) of light without noise, 1 = white; see `render` for the arguments."""
    path, n = _path(position_px, camera, n_frames)
    stage = _Stage(path, camera, target)
    return (stage.frame(i / camera.fps) for i in range(n))


def _path(position: Trajectory | Array, camera: Camera, n_frames: int | None) -> tuple[Trajectory, int]:
    """Positions as a function of time; an array is joined by a cubic spline through the frame times."""
    if callable(position):
        if n_frames is None:
            raise FrictrackError("render: expected n_frames with a position function but got none; say how many")
        return position, n_frames
    table = np.asarray(position, dtype=float)
    if table.ndim != 2 or table.shape[1] not in (2, 3) or len(table) < 4 or not np.all(np.isfinite(table)):
        raise FrictrackError(
            "render: expected finite positions of shape (frames, 2 or 3) for at least 4 frames "
            f"but got {table.shape}; give x, y (and angle) in px at every frame"
        )
    spline = make_interp_spline(np.arange(len(table)) / camera.fps, table, k=3)
    return lambda t: tuple(spline(t).T), min(len(table), n_frames or len(table))


@dataclass(frozen=True)
class _Moments:
    """Instants of one exposure with their weights (which sum to the mean light) and the scene at each."""

    weight: Array  # (q,)
    x: Array
    y: Array
    angle: Array
    shake_x: Array
    shake_y: Array


class _Stage:
    """What stays the same from frame to frame: Fourier series, path, and the background where it is still."""

    def __init__(self, path: Trajectory, camera: Camera, target: Target) -> None:
        self.path, self.camera, self.target = path, camera, target
        self.surface = target.surface.series(target.width, target.height)
        self.background = target.background.series(camera.width, camera.height)
        self.course_y = float(path(np.zeros(1))[1][0]) + target.height / 2
        self.turns = target.rotation is not None or len(path(np.zeros(1))) == 3
        self.shakes = camera.shake_x is not None or camera.shake_y is not None
        self.edges = _edges(np.arange(camera.width)), _edges(np.arange(camera.height))
        self.grid = self.background.grid(*self.edges)
        self.still = self._background(np.ones(1), np.zeros(1), np.zeros(1))
        self.glare = target.highlight.light(*self.edges) if target.highlight else None

    def frame(self, t: float) -> Array:
        """Light of the frame exposed round t (s): (height, width)."""
        moments = self._exposure(t)
        if self.shakes:
            picture = self._background(moments.weight, moments.shake_x, moments.shake_y)
        else:
            picture = self.still * moments.weight.sum()
        x, y = self._window(moments)
        if len(x) and len(y):
            block, cover = (self._turned if self.turns else self._straight)(moments, x, y)
            part = picture[y[0] : y[-1] + 1, x[0] : x[-1] + 1]
            part *= 1 - cover / moments.weight.sum()
            part += block
        self._in_front(picture, moments)
        return picture

    def _in_front(self, picture: Array, moments: _Moments) -> None:
        """Put the rod and the highlight on the picture."""
        rod, light = self.target.rod, moments.weight.sum()
        if rod is not None:
            cover = moments.weight @ rod.cover(self.edges[0] - moments.shake_x[:, None]) / light
            hidden = np.flatnonzero(cover)
            picture[:, hidden] += cover[hidden] * (rod.reflectance * light - picture[:, hidden])
        if self.glare is not None:
            picture += light * self.glare

    def _place(self, t: Array) -> tuple[Array, Array, Array]:
        """Centre of the block in the picture, shake included, and its angle, at times (n,)."""
        where = self.path(t)
        shake_x, shake_y = self.camera.shake(t)
        angle = where[2] if len(where) == 3 else np.zeros_like(t)
        if self.target.rotation is not None:
            angle = angle + self.target.rotation(t)
        return where[0] + shake_x, where[1] + shake_y, angle

    def _exposure(self, t: float) -> _Moments:
        """Gauss-Legendre instants between the cuts of one exposure."""
        span = self.camera.exposure / self.camera.fps
        times, weight = np.array([t]), np.ones(1)
        if span > 0:
            grid = t + span * np.linspace(-0.5, 0.5, 17)
            x, y, _ = self._place(grid)
            sides = [(x, self.target.width), (y, self.target.height)]
            cuts = [_crossings(grid, path + sign * side / 2) for path, side in sides for sign in (-1, 1)]
            times, weight = _gauss_legendre(np.unique(np.concatenate([grid[[0, -1]], *cuts])), np.ptp(x) + np.ptp(y))
        weight = weight * self.camera.light(times)
        return _Moments(weight, *self._place(times), *self.camera.shake(times))

    def _window(self, moments: _Moments) -> tuple[Pixels, Pixels]:
        """Columns and rows of the picture that the block touches during the exposure, and one more around."""
        half_x, half_y = self.target.width / 2, self.target.height / 2
        if self.turns:
            sin = np.abs(np.sin(moments.angle)).max()
            half_x, half_y = half_x + sin * half_y, half_y + sin * half_x
        return (
            _inside(moments.x, half_x, self.camera.width),
            _inside(moments.y, half_y, self.camera.height),
        )

    def _straight(self, moments: _Moments, x: Pixels, y: Pixels) -> tuple[Array, Array]:
        """Weighted sum over the exposure of the block's light and of the area that it covers."""
        x_edges = _clip(x, moments.x, self.target.width)
        y_edges = _clip(y, moments.y, self.target.height)
        weight = moments.weight[:, None]
        cover = (weight * np.diff(y_edges)).T @ np.diff(x_edges)
        return self.surface.cells(x_edges, y_edges, moments.weight), cover

    def _turned(self, moments: _Moments, x: Pixels, y: Pixels) -> tuple[Array, Array]:
        """The same for a block at an angle."""
        block, cover = np.zeros((2, len(y), len(x)))
        size = (self.target.width, self.target.height)
        for weight, *pose in zip(moments.weight, moments.x, moments.y, moments.angle, strict=True):
            light, area = turned_block(self.surface, size, Pose(*pose), x, y)
            block += weight * light
            cover += weight * area
        return block, cover

    def _background(self, weight: Array, shake_x: Array, shake_y: Array) -> Array:
        """Weighted sum over the exposure of wall and course, (height, width)."""
        picture = self.background.shifted(self.grid, weight, (shake_x, shake_y))
        if self.target.course:
            step = _soft_step(self.edges[1] - shake_y[:, None] - self.course_y)
            picture += COURSE_STEP * (weight @ np.diff(step))[:, None]
        return picture


def _soft_step(z: Array) -> Array:
    """Antiderivative of a step from 0 to 1 that is COURSE_EDGE px soft."""
    return 0.5 * COURSE_EDGE * np.logaddexp(0.0, 2 * z / COURSE_EDGE)


def _edges(pixels: Pixels) -> Array:
    """Borders of neighbouring pixels: (n,) -> (n + 1,)."""
    return np.append(pixels - 0.5, pixels[-1] + 0.5)


def _clip(pixels: Pixels, centre: Array, side: float) -> Array:
    """Pixel borders seen from the block and cut to it: (q, n + 1)."""
    return np.clip(_edges(pixels) - centre[:, None], -side / 2, side / 2)


def _inside(centre: Array, half: float, n: int) -> Pixels:
    """Pixels of a picture of n that a block from centre - half to centre + half touches, and one more around."""
    low, high = np.floor(centre.min() - half + 0.5) - 1, np.ceil(centre.max() + half - 0.5) + 1
    return np.arange(max(int(low), 0), min(int(high), n - 1) + 1)


def _crossings(t: Array, edge: Array) -> Array:
    """Times at which an edge (at the times t) passes a pixel border."""
    if edge[-1] < edge[0]:
        t, edge = t[::-1], edge[::-1]
    borders = np.arange(np.ceil(edge[0] - 0.5), edge[-1] + 0.5) + 0.5
    return np.interp(borders[borders < edge[-1]], edge, t)


def _gauss_legendre(cuts: Array, travel: float) -> tuple[Array, Array]:
    """Instants and weights (sum 1) that integrate a function smooth between the cuts."""
    z, w = FEW if travel < 0.25 else MORE
    length = np.diff(cuts)
    times = cuts[:-1, None] + length[:, None] * (z + 1) / 2
    return times.ravel(), np.outer(length, w / 2).ravel() / (cuts[-1] - cuts[0])
