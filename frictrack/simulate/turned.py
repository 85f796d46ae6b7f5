"""The block when it is turned: every Fourier term is still exact, the cut pixels are taken to first order.

With the block turned, its edges no longer follow the pixels. Texture averaged over whole pixels stays exact
(a turned wave is a wave); in a pixel that an edge cuts, the covered area and its first moment are exact and the
texture is taken as linear. Corners, four pixels of the picture, take the product of their two edges.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from frictrack.records import Array
from frictrack.simulate.texture import Series


class Pose(NamedTuple):
    """Centre of the block (px) and its angle (rad, from the x axis toward the y axis of the picture)."""

    x: float
    y: float
    angle: float


def turned_block(
    series: Series, size: tuple[float, float], pose: Pose, x: NDArray[np.int_], y: NDArray[np.int_]
) -> tuple[Array, Array]:
    """Light of the block and the area it covers in the pixels x (nx,) and y (ny,): two (ny, nx)."""
    dx, dy = x - pose.x, y - pose.y
    cos, sin = math.cos(pose.angle), math.sin(pose.angle)
    # One pixel more on every side, for the slopes.
    padded = _pixel_mean(series, pose.angle, _pad(dx), _pad(dy))
    slope_x = (padded[1:-1, 2:] - padded[1:-1, :-2]) / 2
    slope_y = (padded[2:, 1:-1] - padded[:-2, 1:-1]) / 2
    area_u, moment_u = _between(cos * dx + sin * dy[:, None], size[0] / 2, (abs(cos), abs(sin)))
    area_v, moment_v = _between(cos * dy[:, None] - sin * dx, size[1] / 2, (abs(cos), abs(sin)))
    light = padded[1:-1, 1:-1] * area_u * area_v
    light += (cos * slope_x + sin * slope_y) * moment_u * area_v
    light += (cos * slope_y - sin * slope_x) * moment_v * area_u
    return light, area_u * area_v


def _pad(place: NDArray[Any]) -> Array:
    return np.concatenate([[place[0] - 1], place, [place[-1] + 1]])


def _pixel_mean(series: Series, angle: float, dx: Array, dy: Array) -> Array:
    """Texture averaged over whole pixels; each turned wave is an outer product of its x and y parts."""
    cos, sin = math.cos(angle), math.sin(angle)
    q_x, q_y = np.broadcast_arrays(series.q_x, series.q_y[:, None])
    keep = np.abs(series.c) > 1e-7 * np.abs(series.c).max()
    q_x, q_y = q_x[keep], q_y[keep]
    q_x, q_y = cos * q_x - sin * q_y, sin * q_x + cos * q_y
    c = series.c[keep] * np.sinc(q_x / (2 * np.pi)) * np.sinc(q_y / (2 * np.pi))
    rows, columns = c[:, None] * _wave(q_x, dx), _wave(q_y, dy)
    return columns.real.T @ rows.real - columns.imag.T @ rows.imag


def _wave(q: Array, place: Array) -> NDArray[np.complex128]:
    """exp(i q place) at neighbouring pixels (k, n): each is the one before, turned; exponentials would cost most."""
    out = np.empty((len(q), len(place)), complex)
    out[:, 0], out[:, 1:] = np.exp(1j * q * place[0]), np.exp(1j * q)[:, None]
    return np.multiply.accumulate(out, axis=1)


def _between(place: Array, half: float, sides: tuple[float, float]) -> tuple[Array, Array]:
    """Area and first moment of the part of a pixel at `place` (along the axis) that lies within +-half."""
    area_high, moment_high = _below(half - place, sides)
    area_low, moment_low = _below(half + place, sides)
    return area_high + area_low - 1, moment_high - moment_low


def _below(d: Array, sides: tuple[float, float]) -> tuple[Array, Array]:
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
