"""Pixels -> metres: scale, course axis, and a fixed reference point to subtract."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from frictrack.errors import FrictrackError
from frictrack.records import Array, Displacement, Track
from frictrack.units import quantity

Scale = str | float | Mapping[str, Any]


def parse_scale(scale: Scale | None) -> tuple[float, float]:
    """Metres per pixel and its relative standard deviation.

    Accepts ``"0.5 mm/px"``, ``"0.500 +/- 0.002 mm/px"``, a number in m/px, or two points of known distance,
    ``{"points": [[x, y], [x, y]], "length": "100 +/- 0.1 mm"}``.
    """
    if scale is None:
        raise FrictrackError(
            'expected a scale but got none; give scale = "0.5 mm/px", or two points of known distance as '
            '{points = [[x, y], [x, y]], length = "100 mm"}'
        )
    if isinstance(scale, Mapping):
        value, std = _from_points(scale)
    else:
        value, std = quantity(scale, "m/px", "the scale")
    if not value > 0:
        raise FrictrackError(f"expected a scale above 0 m/px but got {value:g} m/px")
    return value, std / value


def _from_points(scale: Mapping[str, Any]) -> tuple[float, float]:
    try:
        points = np.asarray(scale["points"], dtype=np.float64)
        length, std = quantity(scale["length"], "m", "the length between the two points")
    except KeyError as error:
        raise FrictrackError(f"expected a scale with points and length but {error} is missing") from error
    except (TypeError, ValueError) as error:
        if isinstance(error, FrictrackError):
            raise
        raise FrictrackError(f"expected points as [[x, y], [x, y]] but got {scale['points']!r}") from error
    if points.shape != (2, 2):
        raise FrictrackError(f"expected two points [[x, y], [x, y]] but got {scale['points']!r}")
    distance = float(np.hypot(*(points[1] - points[0])))
    if not distance > 0:
        raise FrictrackError(f"expected two different points for the scale but got {scale['points']!r}")
    return length / distance, std / distance


def calibrate(
    track: Track,
    scale: Scale | None,
    *,
    axis: Sequence[float] | None = None,
    origin_px: Sequence[float] | None = None,
    x_offset: float = 0.0,
    reference: Track | None = None,
) -> Displacement:
    """Displacement along the course and across it, from a track in pixels.

    `scale` is what `parse_scale` takes. `axis` is the direction of +x in the picture, [dx, dy] px with y down
    (default image right); `origin_px` the pixel [x, y] where x = 0 and y = 0 (default the picture's corner,
    so that all runs of one camera share it); `x_offset` is added to x, m. `reference` is the track of
    something fixed: its movement is camera shake and is subtracted.

    x runs along the axis, y across it (upward in the picture), the angle counter-clockwise. Where the target
    or the reference was lost they are NaN and ``valid`` is false.
    """
    pitch, relative = parse_scale(scale)
    along, across = _directions(axis)
    at = np.stack([track.x_px, track.y_px], axis=1)  # (n, 2)
    variance = np.stack([track.sigma_px, track.sigma_y_px], axis=1) ** 2
    if reference is not None:
        shake, shake_variance = _movement(reference, len(track))
        at, variance = at - shake, variance + shake_variance
    at = at - np.asarray([0.0, 0.0] if origin_px is None else origin_px, dtype=np.float64)
    valid = np.all(np.isfinite(at), axis=1)
    gap = np.where(valid, 0.0, np.nan)
    return Displacement(
        t=track.t,
        x=at @ along * pitch + x_offset,
        y=at @ across * pitch,
        angle=-track.angle + gap,
        sigma_x=np.sqrt(variance @ along**2) * pitch + gap,
        sigma_y=np.sqrt(variance @ across**2) * pitch + gap,
        valid=valid,
        pixel_pitch=pitch,
        relative_scale_error=relative,
        notes=track.notes if reference is None else (*track.notes, *reference.notes),
    )


def _directions(axis: Sequence[float] | None) -> tuple[Array, Array]:
    """Unit vectors along the course and across it, the second pointing up in the picture (y is down)."""
    along = np.asarray([1.0, 0.0] if axis is None else axis, dtype=np.float64)
    if along.shape != (2,) or not np.all(np.isfinite(along)) or not np.any(along):
        raise FrictrackError(f"expected the course axis as [dx, dy] px but got {axis!r}")
    along = along / np.hypot(*along)
    across = np.array([along[1], -along[0]])
    return along, -across if across[1] > 0 else across


def _movement(reference: Track, n: int) -> tuple[Array, Array]:
    """Movement of the reference about its median place (n, 2) px, and its variance."""
    if len(reference) != n:
        raise FrictrackError(f"expected a reference track of {n} frames but got {len(reference)}")
    if not np.any(reference.found):
        raise FrictrackError(f'the reference "{reference.name}" was found in no frame; choose another one')
    at = np.stack([reference.x_px, reference.y_px], axis=1)
    variance = np.stack([reference.sigma_px, reference.sigma_y_px], axis=1) ** 2
    return at - np.nanmedian(at, axis=0), variance
