"""The block when it is turned: every Fourier term is still exact, the cut pixels are taken to first order.

With the block turned, its edges no longer follow the pixels. Texture averaged over whole pixels stays exact
(a turned wave is a wave); in a pixel that an edge cuts, the covered area and its first moment are exact and the
texture is taken as linear. Corners, four pixels of the picture, take the product of their two edges.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from frictrack.records import Array
from frictrack.simulate.texture import Series


class Pose(NamedTuple):
    """Centre of the block (px) and its angle (rad, from the x axis toward the y axis of the picture)."""

    x: float
    y: float
    angle: float


def turned_block(series: Series, size: tuple[float, float], pose: Pose, x: Array, y: Array) -> tuple[Array, Array]:
    """Light of the block and the area it covers in the pixels centred at x (nx,) and y (ny,): two (ny, nx)."""
    dx, dy = x - pose.x, (y - pose.y)[:, None]
    cos, sin = np.cos(pose.angle), np.sin(pose.angle)
    mean = _pixel_mean(series, pose.angle, dx, dy[:, 0])
    slope_y, slope_x = np.gradient(mean)
    sides = (abs(cos), abs(sin))
    area_u, moment_u = _between(cos * dx + sin * dy, size[0] / 2, sides)
    area_v, moment_v = _between(cos * dy - sin * dx, size[1] / 2, sides)
    slope_u, slope_v = cos * slope_x + sin * slope_y, cos * slope_y - sin * slope_x
    cover = area_u * area_v
    return mean * cover + slope_u * moment_u * area_v + slope_v * moment_v * area_u, cover


def _pixel_mean(series: Series, angle: float, dx: Array, dy: Array) -> Array:
    """Texture averaged over whole pixels; each turned wave is an outer product of its x and y parts."""
    cos, sin = np.cos(angle), np.sin(angle)
    q_x, q_y = np.broadcast_arrays(series.q_x, series.q_y[:, None])
    keep = np.abs(series.c) > 1e-7 * np.abs(series.c).max()
    q_x, q_y = q_x[keep], q_y[keep]
    q_x, q_y = cos * q_x - sin * q_y, sin * q_x + cos * q_y
    c = series.c[keep] * np.sinc(q_x / (2 * np.pi)) * np.sinc(q_y / (2 * np.pi))
    rows = c[:, None] * np.exp(1j * np.outer(q_x, dx))
    columns = np.exp(1j * np.outer(dy, q_y))
    return columns.real @ rows.real - columns.imag @ rows.imag


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
    area = sum(sign * np.maximum(z, 0) ** 2 for z, sign in steps) / (2 * a * b)
    integral = sum(sign * np.maximum(z, 0) ** 3 for z, sign in steps) / (6 * a * b)
    return area, d * area - integral
