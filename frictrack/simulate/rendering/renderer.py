"""Render a textured block that slides over a course; light is integrated over each pixel and each exposure.

The picture is a static background, uniform within each pixel, and in front of it the block, whose texture is
integrated exactly over the covered part of each pixel (`surface`). An exposure is cut wherever an edge of the
block passes a pixel border; between two cuts the light on every pixel is smooth in time and a Gauss-Legendre
rule integrates it. A rod may stand in front of the block, and a highlight on the window adds its light to all.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from frictrack.base.errors import FrictrackError
from frictrack.records import Array
from frictrack.simulate.rendering.camera import Camera, Highlight, Oscillation, Rod
from frictrack.simulate.rendering.surface import BlockPose, MovingCells, Surface, render_rotated_block

PositionFunction = Callable[[Array], tuple[Array, ...]]  # times (n,), s -> x, y, px and, if it rotates, angle, rad

Pixels = NDArray[np.int_]

WALL = Surface(size=5.0, level=0.25, contrast=0.05, seed=2)
COURSE_STEP = 0.22  # light of the course above that of the wall behind it; 1 = white
COURSE_EDGE_PX = 1.2  # softness of the upper edge of the course
FRAMES_AT_ONCE = 256  # frames whose exposures are computed together
EXPOSURE_POINTS = 17  # instants of an exposure between which an edge of the block is taken to move evenly
GAUSS_3, GAUSS_5 = (np.polynomial.legendre.leggauss(n) for n in (3, 5))  # sufficient for 0.25 and 1 px of travel


@dataclass(frozen=True)
class Target:
    """Painted block in front of a static background; the course is the light band under its lower edge.

    Attributes
    ----------
    width, height
        Size of the block, px.
    surface, background
        Paint of the block and of the wall behind it.
    course
        Whether the course is drawn.
    rotation
        Rotation of the block about its centre, rad, in addition to the angle of its path.
    rod, highlight
        Objects in front of everything.

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
    position_px: PositionFunction, camera: Camera, target: Target, rng: np.random.Generator, n_frames: int
) -> Iterator[NDArray[Any]]:
    """Render the frames that a camera records.

    Pixel centres are integers and y points down.

    Parameters
    ----------
    position_px
        Centre of the block without camera shake: a function of times (n,), s, that gives x, y (px) and, if the block
        rotates, the angle (rad); called for times half an exposure before the first and after the last frame, too.
    camera, target
        What records, and what is recorded.
    rng
        Source of the noise.
    n_frames
        Number of frames.

    Yields
    ------
    NDArray
        Frame (height, width): uint8 at 8 bit, else uint16.

    """
    for clean in render_clean(position_px, camera, target, n_frames):
        yield camera.record(clean, rng)


def render_clean(position_px: PositionFunction, camera: Camera, target: Target, n_frames: int) -> Iterator[Array]:
    """Render frames (height, width) of light without noise, 1 = white; see `render` for the arguments."""
    renderer = _Renderer(position_px, camera, target)
    times = np.split(np.arange(n_frames) / camera.fps, range(FRAMES_AT_ONCE, n_frames, FRAMES_AT_ONCE))
    return (renderer.frame(moments) for some in times for moments in renderer.exposures(some))


@dataclass(frozen=True)
class _ExposureSamples:
    """Instants of one exposure: weights that sum to the mean light, pose of the block and shake, each (q,)."""

    weight: Array  # (q,)
    x: Array
    y: Array
    angle: Array
    shake_x: Array
    shake_y: Array


class _Renderer:
    """Render frame by frame; keep the Fourier series and, where it does not move, the background."""

    def __init__(self, path: PositionFunction, camera: Camera, target: Target) -> None:
        self.path, self.camera, self.target = path, camera, target
        self.surface = target.surface.series(target.width, target.height)
        self.background = target.background.series(camera.width, camera.height)
        self.course_y = float(path(np.zeros(1))[1][0]) + target.height / 2
        self.rotates = target.rotation is not None or len(path(np.zeros(1))) == 3
        self.shakes = camera.shake_x is not None or camera.shake_y is not None
        self.edges = _edges(np.arange(camera.width)), _edges(np.arange(camera.height))
        self.waves = self.surface.waves(*self.edges)
        self.grid = self.background.grid(*self.edges)
        self.still_background = self._background(np.ones(1), np.zeros(1), np.zeros(1))
        self.glare = target.highlight.light(*self.edges) if target.highlight else None

    def frame(self, moments: _ExposureSamples) -> Array:
        """Light of the frame of one exposure, (height, width)."""
        if self.shakes:
            picture = self._background(moments.weight, moments.shake_x, moments.shake_y)
        else:
            picture = self.still_background * moments.weight.sum()
        x, y = self._window(moments)
        if len(x) and len(y):
            block, cover = (self._rotated_block if self.rotates else self._upright_block)(moments, x, y)
            part = picture[y[0] : y[-1] + 1, x[0] : x[-1] + 1]
            part *= 1 - cover / moments.weight.sum()
            part += block
        self._add_foreground(picture, moments)
        return picture

    def _add_foreground(self, picture: Array, moments: _ExposureSamples) -> None:
        """Draw the rod and the highlight over the picture."""
        rod, light = self.target.rod, moments.weight.sum()
        if rod is not None:
            cover = moments.weight @ rod.cover(self.edges[0] - moments.shake_x[:, None]) / light
            hidden = np.flatnonzero(cover)
            picture[:, hidden] += cover[hidden] * (rod.reflectance * light - picture[:, hidden])
        if self.glare is not None:
            picture += light * self.glare

    def _place(self, t: Array) -> tuple[Array, Array, Array]:
        """Centre of the block in the picture (px), shake included, and its angle (rad) at times t (n,)."""
        position = self.path(t)
        shake_x, shake_y = self.camera.shake(t)
        angle = position[2] if len(position) == 3 else np.zeros_like(t)
        if self.target.rotation is not None:
            angle = angle + self.target.rotation(t)
        return position[0] + shake_x, position[1] + shake_y, angle

    def exposures(self, t: Array) -> list[_ExposureSamples]:
        """Instants of the exposures about the times t (n,), s, each cut where the block's edges pass pixel borders."""
        instants = [(np.array([at]), np.ones(1)) for at in t]
        span = self.camera.exposure / self.camera.fps
        if span > 0:
            grid = t[:, None] + span * np.linspace(-0.5, 0.5, EXPOSURE_POINTS)
            x, y, _ = (at.reshape(grid.shape) for at in self._place(grid.ravel()))
            instants = [self._cut(*exposure) for exposure in zip(grid, x, y, strict=True)]
        times = np.concatenate([at for at, _ in instants])
        weight = np.concatenate([share for _, share in instants]) * self.camera.light(times)
        ends = np.cumsum([len(at) for at, _ in instants])[:-1]
        series = (weight, *self._place(times), *self.camera.shake(times))
        return [_ExposureSamples(*one) for one in zip(*(np.split(values, ends) for values in series), strict=True)]

    def _cut(self, t: Array, x: Array, y: Array) -> tuple[Array, Array]:
        """Gauss-Legendre instants and weights of one exposure, where the block's centre is at (x, y) at times t."""
        sides = [(x, self.target.width), (y, self.target.height)]
        cuts = [_crossings(t, path + sign * side / 2) for path, side in sides for sign in (-1, 1)]
        return _gauss_legendre(np.unique(np.concatenate([t[[0, -1]], *cuts])), np.ptp(x) + np.ptp(y))

    def _window(self, moments: _ExposureSamples) -> tuple[Pixels, Pixels]:
        """Columns and rows of the picture that the block touches during the exposure, with a margin of one pixel."""
        half_x, half_y = self.target.width / 2, self.target.height / 2
        if self.rotates:
            sin = np.abs(np.sin(moments.angle)).max()
            half_x, half_y = half_x + sin * half_y, half_y + sin * half_x
        return (
            _inside(moments.x, half_x, self.camera.width),
            _inside(moments.y, half_y, self.camera.height),
        )

    def _upright_block(self, moments: _ExposureSamples, x: Pixels, y: Pixels) -> tuple[Array, Array]:
        """Light of an upright block and area that it covers per pixel, summed over the exposure: two (ny, nx)."""
        columns = self._cells(0, x, moments.x, self.target.width)
        rows = self._cells(1, y, moments.y, self.target.height)
        cover = (moments.weight[:, None] * rows.lengths).T @ columns.lengths
        return self.surface.integrate_cells(columns, rows, moments.weight), cover

    def _cells(self, axis: int, pixels: Pixels, centre: Array, side: float) -> MovingCells:
        """Cells of the block along one axis of the picture (0: columns, 1: rows), at neighbouring pixels."""
        part = slice(pixels[0], pixels[-1] + 2)
        return MovingCells(self.edges[axis][part], self.waves[axis][:, part], centre, side)

    def _rotated_block(self, moments: _ExposureSamples, x: Pixels, y: Pixels) -> tuple[Array, Array]:
        """The same for a rotated block."""
        block, cover = np.zeros((2, len(y), len(x)))
        size = (self.target.width, self.target.height)
        for weight, *pose in zip(moments.weight, moments.x, moments.y, moments.angle, strict=True):
            light, area = render_rotated_block(self.surface, size, BlockPose(*pose), x, y)
            block += weight * light
            cover += weight * area
        return block, cover

    def _background(self, weight: Array, shake_x: Array, shake_y: Array) -> Array:
        """Light of wall and course, summed over the exposure, (height, width)."""
        picture = self.background.shifted(self.grid, weight, (shake_x, shake_y))
        if self.target.course:
            step = _soft_step(self.edges[1] - shake_y[:, None] - self.course_y)
            picture += COURSE_STEP * (weight @ np.diff(step))[:, None]
        return picture


def _soft_step(z: Array) -> Array:
    """Antiderivative of a step from 0 to 1 with a soft edge of COURSE_EDGE_PX."""
    return 0.5 * COURSE_EDGE_PX * np.logaddexp(0.0, 2 * z / COURSE_EDGE_PX)


def _edges(pixels: Pixels) -> Array:
    """Borders of neighbouring pixels: (n,) -> (n + 1,)."""
    return np.append(pixels - 0.5, pixels[-1] + 0.5)


def _inside(centre: Array, half: float, n: int) -> Pixels:
    """Of n pixels those that a block from centre - half to centre + half touches, with a margin of one."""
    low, high = np.floor(centre.min() - half + 0.5) - 1, np.ceil(centre.max() + half - 0.5) + 1
    return np.arange(max(int(low), 0), min(int(high), n - 1) + 1)


def _crossings(t: Array, edge: Array) -> Array:
    """Times at which an edge, given at the times t, passes a pixel border."""
    if edge[-1] < edge[0]:
        t, edge = t[::-1], edge[::-1]
    borders = np.arange(np.ceil(edge[0] - 0.5), edge[-1] + 0.5) + 0.5
    return np.interp(borders[borders < edge[-1]], edge, t)


def _gauss_legendre(cuts: Array, travel: float) -> tuple[Array, Array]:
    """Instants and weights (sum 1) that integrate a function smooth between the cuts."""
    z, w = GAUSS_3 if travel < 0.25 else GAUSS_5
    length = np.diff(cuts)
    times = cuts[:-1, None] + length[:, None] * (z + 1) / 2
    return times.ravel(), np.outer(length, w / 2).ravel() / (cuts[-1] - cuts[0])
