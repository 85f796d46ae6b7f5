"""Painted surfaces as band-limited Fourier series, integrated exactly over any rectangle.

A surface is T(u, v) = Re sum_k c_k exp(i (q_x u + q_y v)). Its integral over a cell is the second difference
of the antiderivative at the cell's corners, which every term has in closed form. A pixel that the block's
edge cuts is a smaller cell, so the product of texture and mask needs no approximation.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from frictrack.errors import gather
from frictrack.records import Array

Complex = NDArray[np.complex128]

OVERSAMPLE = 4  # points per pixel on which a pattern is drawn before it is cut to its band
HIGHEST = 0.45  # cycles/px: below Nyquist, so that the films hold no aliased texture
OPTICS = 1.5  # FWHM of the lens, px
FWHM = 2.3548200450309493  # full width at half maximum over the standard deviation of a Gaussian


@dataclass(frozen=True, eq=False)
class Series:
    """A real periodic function of the plane: half spectrum with the weight of both halves inside `c`."""

    c: Complex  # (ky, kx)
    q_x: Array  # rad/px, >= 0
    q_y: Array  # rad/px, both signs

    def cells(self, x_edges: Array, y_edges: Array, weight: Array) -> Array:
        """Integrals over the cells between edges (q, nx + 1) and (q, ny + 1), px^2: (ny, nx).

        Each of the q grids counts with its `weight` (q,); this is the sum over an exposure.
        """
        e_x = np.diff(_antiderivative(self.q_x, x_edges), axis=-1)  # (kx, q, nx)
        e_y = np.diff(_antiderivative(self.q_y, y_edges), axis=-1) * weight[:, None]  # (ky, q, ny)
        n_x, n_y = e_x.shape[-1], e_y.shape[-1]
        rows = (self.c @ e_x.reshape(len(self.q_x), -1)).reshape(-1, n_x)  # (ky q, nx)
        columns = e_y.reshape(-1, n_y).T  # (ny, ky q)
        # Only the real part is needed: two real products instead of one complex one.
        return columns.real @ rows.real - columns.imag @ rows.imag

    def shifted(self, cells: tuple[Complex, Complex], weight: Array, shift: tuple[Array, Array]) -> Array:
        """Light of a fixed `grid` of pixels when the surface lies at the shifts (q,), px, with weights (q,)."""
        e_x, e_y = cells
        turn_x = np.exp(-1j * np.outer(self.q_x, shift[0]))
        turn_y = np.exp(-1j * np.outer(self.q_y, shift[1])) * weight
        rows = (self.c * (turn_y @ turn_x.T)) @ e_x
        return e_y.real.T @ rows.real - e_y.imag.T @ rows.imag

    def grid(self, x_edges: Array, y_edges: Array) -> tuple[Complex, Complex]:
        """Integrals of all waves over the pixels between the borders: (kx, nx) and (ky, ny)."""
        return np.diff(_antiderivative(self.q_x, x_edges)), np.diff(_antiderivative(self.q_y, y_edges))


def _antiderivative(q: Array, x: Array) -> Complex:
    """Integral of exp(i q x) for every wavenumber and place: (k, *x.shape)."""
    q = q.reshape(-1, *([1] * x.ndim))
    safe = np.where(q == 0, 1.0, q)
    return np.where(q == 0, x, np.exp(1j * safe * x) / (1j * safe))


@dataclass(frozen=True)
class Surface:
    """What a surface looks like: reflectance level + contrast * pattern, pattern within about +-1.

    `size` is the FWHM of a speckle or dot, or the side of a checker square, in px; white reflects 1.
    """

    kind: str = "speckle"  # or "dots", "checker"
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
        gather(faults, "surface")

    def series(self, width: float, height: float) -> Series:
        """The surface as a Fourier series that does not repeat within width x height px."""
        period = tuple(self._period(side) for side in (width, height))
        n_x, n_y = (fft.next_fast_len(int(np.ceil(OVERSAMPLE * side)), real=True) for side in period)
        x = np.arange(n_x) * period[0] / n_x
        y = np.arange(n_y) * period[1] / n_y
        pattern = PATTERNS[self.kind](x, y[:, None], self.size, np.random.default_rng(self.seed))
        return _cut(self.level + self.contrast * pattern, period, self._band())

    def _period(self, side: float) -> float:
        """A margin keeps the pattern's two ends apart; a checker must close on itself."""
        unit = 2 * self.size if self.kind == "checker" else 1.0
        return float(unit * np.ceil((side + 4 * self.size) / unit))

    def _band(self) -> float:
        """Highest frequency kept, cycles/px; coarse speckle needs fewer terms."""
        return HIGHEST if self.kind == "checker" else min(HIGHEST, 1.6 / self.size)


def _cut(picture: Array, period: tuple[float, ...], band: float) -> Series:
    """Fourier series of a periodic picture (ny, nx) up to `band`, blurred by the lens."""
    spectrum = fft.rfft2(picture) / picture.size
    f_x = np.arange(spectrum.shape[1]) / period[0]
    f_y = fft.fftfreq(picture.shape[0]) * picture.shape[0] / period[1]
    keep_x, keep_y = f_x <= band, np.abs(f_y) <= band
    c = spectrum[np.ix_(keep_y, keep_x)] * _gauss(f_x[keep_x], f_y[keep_y, None], OPTICS)
    c[:, 1:] *= 2  # the half that rfft2 leaves out
    return Series(c, 2 * np.pi * f_x[keep_x], 2 * np.pi * f_y[keep_y])


def _gauss(f_x: Array, f_y: Array, fwhm: float) -> Array:
    """Transfer function of a Gaussian of unit area."""
    return np.exp(-2 * (np.pi * fwhm / FWHM) ** 2 * (f_x**2 + f_y**2))


def _blur(picture: Array, x: Array, y: Array, fwhm: float) -> Array:
    f_x, f_y = fft.rfftfreq(x.size, x[1]), fft.fftfreq(y.size, y[1, 0])
    return fft.irfft2(fft.rfft2(picture) * _gauss(f_x, f_y[:, None], fwhm), s=picture.shape)


def _speckle(x: Array, y: Array, size: float, rng: np.random.Generator) -> Array:
    """Sprayed paint: smoothed white noise, pushed toward black and white."""
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
    odd = np.arange(1, max(2, 2 * HIGHEST * size), 2)[:, None, None]
    wave_x, wave_y = (np.sum(4 / (np.pi * odd) * np.sin(odd * np.pi * z / size), axis=0) for z in (x, y))
    return wave_x * wave_y


PATTERNS: dict[str, Callable[[Array, Array, float, np.random.Generator], Array]] = {
    "speckle": _speckle,
    "dots": _dots,
    "checker": _checker,
}
