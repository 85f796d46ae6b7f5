"""Render a textured block that slides over a course; light is integrated over each pixel and each exposure.

The paint of a surface is a band-limited Fourier series, integrated exactly over any rectangle: T(u, v) = Re sum_k c_k
exp(i (q_x u + q_y v)). Its integral over a cell is the second difference of the antiderivative at the cell's corners,
which every term has in closed form. A pixel that the block's edge cuts is a smaller cell, so the product of texture and
mask needs no approximation.

The edges of a rotated block do not follow the pixels. The texture averaged over a whole pixel stays exact, because a
rotated wave is a wave. In a pixel that an edge cuts, the covered area and its first moment are exact and the texture is
taken as linear. The four pixels with corners use the product of their two edges.

The picture is a static background, uniform within each pixel, and in front of it the block, whose texture is
integrated exactly over the covered part of each pixel. An exposure is cut wherever an edge of the
block passes a pixel border; between two cuts the light on every pixel is smooth in time and a Gauss-Legendre
rule integrates it. A rod may stand in front of the block, and a highlight on the window adds its light to all.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from frictrack.base.errors import FrictrackError, raise_faults
from frictrack.records import Array
from frictrack.simulate.rendering.camera import Camera, Highlight, Oscillation, Rod

Complex = NDArray[np.complex128]

OVERSAMPLING = 4  # points per pixel on which a pattern is drawn before it is band-limited
MAX_FREQUENCY = 0.45  # cycles/px, below Nyquist: films contain no aliased texture
LENS_FWHM_PX = 1.5  # blur of the lens
FWHM_PER_SIGMA = 2.3548200450309493  # full width at half maximum over the standard deviation of a Gaussian


class MovingCells(NamedTuple):
    """Cells along one axis that a block covers at q instants: pixels, cut where the block ends.

    Attributes
    ----------
    borders
        Borders of the pixels in the picture, px, (n + 1,).
    waves
        Waves exp(i q x) at the borders, for k wavenumbers, (k, n + 1).
    centre
        Centre of the block at every instant, px, (q,).
    side
        Length of the block, px.

    """

    borders: Array
    waves: Complex
    centre: Array
    side: float

    @property
    def lengths(self) -> Array:
        """Lengths of the cells, px, (q, n)."""
        return np.diff(self._places(slice(None)))

    def integrals(self, q: Array, share: Array) -> Complex:
        """Integrate the waves exp(i q u) over the cells, u from the centre, and sum over instants.

        Parameters
        ----------
        q
            Wavenumbers, rad/px, (k,).
        share
            Weights of the instants in each of m sums, (m, q).

        Returns
        -------
        Array
            Sums of the integrals, px, (k, m, n).

        """
        # A wave at a border in the block is a wave in the picture times one at the centre, so the sum over instants
        # is the same for all borders but those that an end of the block passes.
        turns = np.exp(-1j * np.outer(q, self.centre)) @ share.T
        waves = turns[:, :, None] * self.waves[:, None]
        inside = np.abs(self.borders - self.centre[:, None]) <= self.side / 2
        cut = np.flatnonzero(~inside.all(axis=0))
        waves[:, :, cut] = share @ np.exp(1j * q[:, None, None] * self._places(cut))
        out = np.diff(waves, axis=-1)
        out[q == 0] = share @ self.lengths
        out[q != 0] /= 1j * q[q != 0, None, None]
        return out

    def _places(self, which: slice | NDArray[np.int_]) -> Array:
        """Borders from the centre, at most at the ends of the block, (q, ...)."""
        return np.clip(self.borders[which] - self.centre[:, None], -self.side / 2, self.side / 2)


@dataclass(frozen=True, eq=False)
class FourierSurface:
    """Real periodic function of the plane as a half spectrum; `c` contains the weight of both halves.

    Attributes
    ----------
    c
        Coefficients, (ky, kx).
    q_x, q_y
        Wavenumbers, rad/px: q_x >= 0, (kx,); q_y of both signs, (ky,).

    """

    c: Complex
    q_x: Array
    q_y: Array

    def integrate_cells(self, x: MovingCells, y: MovingCells, weight: Array) -> Array:
        """Integrate over the cells of a block at q instants, and sum over the instants of one exposure.

        Parameters
        ----------
        x, y
            Columns and rows of cells.
        weight
            Weight of each instant, (q,).

        Returns
        -------
        Array
            Weighted sum of the integrals, px^2, (ny, nx).

        """
        each = np.eye(len(weight))
        if np.all(y.centre == y.centre[0]):  # the rows stay: the instants differ in x alone and are summed first
            weight, each, y = weight[None], np.ones((1, 1)), y._replace(centre=y.centre[:1])
        else:
            weight = np.diag(weight)
        e_x, e_y = x.integrals(self.q_x, weight), y.integrals(self.q_y, each)  # (kx, m, nx), (ky, m, ny)
        n_x, n_y = e_x.shape[-1], e_y.shape[-1]
        rows = (self.c @ e_x.reshape(len(self.q_x), -1)).reshape(-1, n_x)  # (ky m, nx)
        columns = e_y.reshape(-1, n_y).T  # (ny, ky m)
        # Only the real part is needed: two real products instead of one complex one.
        return columns.real @ rows.real - columns.imag @ rows.imag

    def shifted(self, integrate_cells: tuple[Complex, Complex], weight: Array, shift: tuple[Array, Array]) -> Array:
        """Light of the pixels of `grid` (ny, nx), summed over shifts of the surface (q,), px, with weights (q,)."""
        e_x, e_y = integrate_cells
        turn_x = np.exp(-1j * np.outer(self.q_x, shift[0]))
        turn_y = np.exp(-1j * np.outer(self.q_y, shift[1])) * weight
        rows = (self.c * (turn_y @ turn_x.T)) @ e_x
        return e_y.real.T @ rows.real - e_y.imag.T @ rows.imag

    def waves(self, x_edges: Array, y_edges: Array) -> tuple[Complex, Complex]:
        """Waves at borders of pixels, for `MovingCells`: (kx, nx + 1) and (ky, ny + 1)."""
        return np.exp(1j * np.outer(self.q_x, x_edges)), np.exp(1j * np.outer(self.q_y, y_edges))

    def grid(self, x_edges: Array, y_edges: Array) -> tuple[Complex, Complex]:
        """Integrals of all waves over the pixels between the borders, (kx, nx) and (ky, ny)."""
        return np.diff(_antiderivative(self.q_x, x_edges)), np.diff(_antiderivative(self.q_y, y_edges))


def _antiderivative(q: Array, x: Array) -> Complex:
    """Integral of exp(i q x) for every wavenumber and place: (k, *x.shape)."""
    q = q.reshape(-1, *([1] * x.ndim))
    safe = np.where(q == 0, 1.0, q)
    return np.where(q == 0, x, np.exp(1j * safe * x) / (1j * safe))


@dataclass(frozen=True)
class Surface:
    """Painted surface of reflectance level + contrast * pattern, with a pattern within about +-1.

    Attributes
    ----------
    kind
        "speckle", "dots" or "checker".
    size
        Full width at half maximum of a speckle or dot, or side of a checker square, px.
    level, contrast
        Mean reflectance and half its range; white reflects 1.
    seed
        Seed of the random pattern.

    """

    kind: str = "speckle"
    size: float = 4.0
    level: float = 0.5
    contrast: float = 0.35
    seed: int = 1

    def __post_init__(self) -> None:
        faults = []
        if self.kind not in PATTERNS:
            faults.append(f'expected kind {", ".join(PATTERNS)} but got "{self.kind}"')
        if not self.size >= 2:
            faults.append(f"expected a size of at least 2 px but got {self.size:g} px; the camera cannot see less")
        if not 0 <= self.contrast <= self.level:
            faults.append(f"expected a contrast between 0 and the level {self.level:g} but got {self.contrast:g}")
        raise_faults(faults, "surface")

    @lru_cache(maxsize=8)  # noqa: B019 - few surfaces are painted, and the films of a study share them
    def series(self, width: float, height: float) -> FourierSurface:
        """Fourier series of the surface, which does not repeat within width x height px."""
        period = tuple(self._period(side) for side in (width, height))
        n_x, n_y = (fft.next_fast_len(int(np.ceil(OVERSAMPLING * side)), real=True) for side in period)
        x = np.arange(n_x) * period[0] / n_x
        y = np.arange(n_y) * period[1] / n_y
        pattern = PATTERNS[self.kind](x, y[:, None], self.size, np.random.default_rng(self.seed))
        return _band_limited(self.level + self.contrast * pattern, period, self._band())

    def _period(self, side: float) -> float:
        """Period along one side, px: a margin separates the ends of the pattern; a checker must close on itself."""
        unit = 2 * self.size if self.kind == "checker" else 1.0
        return float(unit * np.ceil((side + 4 * self.size) / unit))

    def _band(self) -> float:
        """Highest frequency, cycles/px; coarse speckle needs fewer terms."""
        return MAX_FREQUENCY if self.kind == "checker" else min(MAX_FREQUENCY, 1.6 / self.size)


def _band_limited(picture: Array, period: tuple[float, ...], band: float) -> FourierSurface:
    """Fourier series of a periodic picture (ny, nx) up to `band`, blurred by the lens."""
    spectrum = fft.rfft2(picture) / picture.size
    f_x = np.arange(spectrum.shape[1]) / period[0]
    f_y = fft.fftfreq(picture.shape[0]) * picture.shape[0] / period[1]
    keep_x, keep_y = f_x <= band, np.abs(f_y) <= band
    c = spectrum[np.ix_(keep_y, keep_x)] * _gauss(f_x[keep_x], f_y[keep_y, None], LENS_FWHM_PX)
    c[:, 1:] *= 2  # the half that rfft2 omits
    return FourierSurface(c, 2 * np.pi * f_x[keep_x], 2 * np.pi * f_y[keep_y])


def _gauss(f_x: Array, f_y: Array, fwhm: float) -> Array:
    """Transfer function of a Gaussian of unit area at frequencies in cycles/px."""
    return np.exp(-2 * (np.pi * fwhm / FWHM_PER_SIGMA) ** 2 * (f_x**2 + f_y**2))


def _blur(picture: Array, x: Array, y: Array, fwhm: float) -> Array:
    """Convolve a periodic picture (ny, nx) with a Gaussian of the given width, px."""
    f_x, f_y = fft.rfftfreq(x.size, x[1]), fft.fftfreq(y.size, y[1, 0])
    return fft.irfft2(fft.rfft2(picture) * _gauss(f_x, f_y[:, None], fwhm), s=picture.shape)


def _speckle(x: Array, y: Array, size: float, rng: np.random.Generator) -> Array:
    """Sprayed paint: smoothed white noise, saturated toward black and white."""
    field = _blur(rng.standard_normal((y.size, x.size)), x, y, size)
    return np.tanh(field / field.std())


def _dots(x: Array, y: Array, size: float, rng: np.random.Generator) -> Array:
    """Dark round dots on a jittered grid, three sizes apart."""
    period = x.size * x[1], y.size * y[1, 0]
    n_x, n_y = (max(1, round(side / (3 * size))) for side in period)
    grid = np.stack(np.meshgrid(np.arange(n_x), np.arange(n_y)), axis=-1).reshape(-1, 2)
    place = (grid + 0.5 + rng.uniform(-0.25, 0.25, grid.shape)) / (n_x, n_y)
    column, row = (np.rint(place * (x.size, y.size)).astype(int) % (x.size, y.size)).T
    points = np.zeros((y.size, x.size))
    np.add.at(points, (row, column), 1.0)
    field = _blur(points, x, y, size)
    return 1 - 2 * field / field.max()


def _checker(x: Array, y: Array, size: float, rng: np.random.Generator) -> Array:
    """Black and white squares: a product of square waves without the harmonics above the band."""
    odd = np.arange(1, max(2, 2 * MAX_FREQUENCY * size), 2)[:, None, None]
    wave_x, wave_y = (np.sum(4 / (np.pi * odd) * np.sin(odd * np.pi * z / size), axis=0) for z in (x, y))
    return wave_x * wave_y


PATTERNS: dict[str, Callable[[Array, Array, float, np.random.Generator], Array]] = {
    "speckle": _speckle,
    "dots": _dots,
    "checker": _checker,
}


class BlockPose(NamedTuple):
    """Centre of the block (px) and its angle (rad, from the x axis toward the y axis of the picture)."""

    x: float
    y: float
    angle: float


def render_rotated_block(
    series: FourierSurface, size: tuple[float, float], pose: BlockPose, x: NDArray[np.int_], y: NDArray[np.int_]
) -> tuple[Array, Array]:
    """Render a rotated block into pixels.

    Parameters
    ----------
    series
        Paint of the block.
    size
        Width and height of the block, px.
    pose
        Centre and angle.
    x, y
        Columns (nx,) and rows (ny,) of the picture, consecutive.

    Returns
    -------
    tuple of arrays
        Light of the block and area that it covers in each pixel, both (ny, nx).

    """
    dx, dy = x - pose.x, y - pose.y
    cos, sin = math.cos(pose.angle), math.sin(pose.angle)
    # One more pixel on each side, for the slopes.
    padded = _pixel_mean(series, pose.angle, _pad(dx), _pad(dy))
    slope_x = (padded[1:-1, 2:] - padded[1:-1, :-2]) / 2
    slope_y = (padded[2:, 1:-1] - padded[:-2, 1:-1]) / 2
    area_u, moment_u = _area_within(cos * dx + sin * dy[:, None], size[0] / 2, (abs(cos), abs(sin)))
    area_v, moment_v = _area_within(cos * dy[:, None] - sin * dx, size[1] / 2, (abs(cos), abs(sin)))
    light = padded[1:-1, 1:-1] * area_u * area_v
    light += (cos * slope_x + sin * slope_y) * moment_u * area_v
    light += (cos * slope_y - sin * slope_x) * moment_v * area_u
    return light, area_u * area_v


def _pad(place: NDArray[Any]) -> Array:
    """Add one pixel at both ends."""
    return np.concatenate([[place[0] - 1], place, [place[-1] + 1]])


def _pixel_mean(series: FourierSurface, angle: float, dx: Array, dy: Array) -> Array:
    """Texture averaged over whole pixels (ny, nx); each rotated wave is an outer product of its x and y parts."""
    cos, sin = math.cos(angle), math.sin(angle)
    q_x, q_y = np.broadcast_arrays(series.q_x, series.q_y[:, None])
    keep = np.abs(series.c) > 1e-7 * np.abs(series.c).max()
    q_x, q_y = q_x[keep], q_y[keep]
    q_x, q_y = cos * q_x - sin * q_y, sin * q_x + cos * q_y
    c = series.c[keep] * np.sinc(q_x / (2 * np.pi)) * np.sinc(q_y / (2 * np.pi))
    rows, columns = c[:, None] * _wave(q_x, dx), _wave(q_y, dy)
    return columns.real.T @ rows.real - columns.imag.T @ rows.imag


def _wave(q: Array, place: Array) -> NDArray[np.complex128]:
    """exp(i q place) at consecutive pixels (k, n), each from the one before, because exponentials are slow."""
    out = np.empty((len(q), len(place)), complex)
    out[:, 0], out[:, 1:] = np.exp(1j * q * place[0]), np.exp(1j * q)[:, None]
    return np.multiply.accumulate(out, axis=1)


def _area_within(place: Array, half: float, sides: tuple[float, float]) -> tuple[Array, Array]:
    """Area and first moment of the part of a pixel at `place` along an axis that lies within +-half."""
    area_high, moment_high = _area_below(half - place, sides)
    area_low, moment_low = _area_below(half + place, sides)
    return area_high + area_low - 1, moment_high - moment_low


def _area_below(d: Array, sides: tuple[float, float]) -> tuple[Array, Array]:
    """Area and first moment of the part of a unit pixel below distance d of its centre along a slanted axis.

    Across a slanted axis a pixel is a trapezium, the convolution of two boxes of widths |cos| and |sin|;
    its integrals are second and third antiderivatives of four steps.
    """
    a, b = (max(side, 1e-6) for side in sides)
    d = np.clip(d, -(a + b) / 2, (a + b) / 2)
    steps = [(d + (a + b) / 2, 1), (d + (a - b) / 2, -1), (d - (a - b) / 2, -1), (d - (a + b) / 2, 1)]
    area, integral = (
        np.sum([sign * np.maximum(z, 0) ** power for z, sign in steps], axis=0) / (math.factorial(power) * a * b)
        for power in (2, 3)
    )
    return area, d * area - integral


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
        return _inside(moments.x, half_x, self.camera.width), _inside(moments.y, half_y, self.camera.height)

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
