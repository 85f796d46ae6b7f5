"""Render a rotated block: exact inside whole pixels, to first order in pixels that its edges cut.

The edges of a rotated block do not follow the pixels. The texture averaged over a whole pixel stays exact, because a
rotated wave is a wave. In a pixel that an edge cuts, the covered area and its first moment are exact and the texture is
taken as linear. The four pixels with corners use the product of their two edges.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from frictrack.records import Array
from frictrack.simulate.rendering.surface import FourierSurface


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
