"""Compute the axes of the video program Tracker, which are a scale, a direction and an origin, from a measured run."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from frictrack.records import Array, Displacement, Track

PIXEL_CENTRE = 0.5  # px: in Tracker the corner of the picture is (0, 0), in frictrack the centre of the first pixel
MAX_TIME_DIFFERENCE_S = 1e-9  # between the track and the displacement of a frame
MIN_TRAVEL_PX = 1.0  # a target that moves less shows no direction


@dataclass(frozen=True)
class TrackerAxes:
    """Axes in the picture, as Tracker stores them.

    Attributes
    ----------
    scale
        px/m.
    angle
        Direction of +x, counter-clockwise from the right, degrees.
    origin
        Point with x = y = 0, px, from the corner of the picture, y down.
    is_mirrored
        Whether y of Tracker has the opposite sign: its y lies always to the left of x.
    difference
        Largest distance of a measured position from the one that Tracker computes, m.

    """

    scale: float
    angle: float
    origin: tuple[float, float]
    is_mirrored: bool
    difference: float


def tracker_axes(track: Track, displacement: Displacement) -> TrackerAxes | None:
    """Compute the axes that map the positions in the picture to the measured displacement.

    They are fitted by least squares: exact for one scale over the whole picture, else the best that Tracker can hold.

    Parameters
    ----------
    track
        Track of the target.
    displacement
        Its displacement, at all or some of the frames.

    Returns
    -------
    TrackerAxes or None
        None for a target that does not move.

    Notes
    -----
    With picture points z = x_px - i y_px and places w = x + i y, the map is w = c z + d: the scale is 1/abs(c), the
    angle that of 1/c, and the origin -d/c. Source: ``ImageCoordSystem.updateTransforms`` of
    github.com/OpenSourcePhysics/osp.

    """
    rows = np.searchsorted(track.t, displacement.t - MAX_TIME_DIFFERENCE_S)
    z = track.x_px[rows] + PIXEL_CENTRE - 1j * (track.y_px[rows] + PIXEL_CENTRE)
    known = displacement.known & np.isfinite(displacement.y) & np.isfinite(z)
    z = z[known]
    if len(z) < 2 or np.max(np.abs(z - z[0])) < MIN_TRAVEL_PX:
        return None
    x, y = displacement.x[known], displacement.y[known]
    fits = [_fit(z, x + side * y) for side in (1j, -1j)]
    is_mirrored = fits[1][2] < fits[0][2]
    c, d, difference = fits[is_mirrored]
    origin = -d / c
    angle = float(np.degrees(np.angle(1 / c)))
    return TrackerAxes(float(1 / np.abs(c)), angle, (float(origin.real), float(-origin.imag)), is_mirrored, difference)


def _fit(z: Array, w: Array) -> tuple[complex, complex, float]:
    """Fit w = c z + d; return c, d and the largest residual."""
    middle = z.mean()
    (c, d), *_ = np.linalg.lstsq(np.column_stack([z - middle, np.ones(len(z))]), w, rcond=None)
    return complex(c), complex(d - c * middle), float(np.max(np.abs(c * (z - middle) + d - w)))
