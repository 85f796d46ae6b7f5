"""Targets sharper than the sensor resolves: a picture with waves shorter than two pixels, learnt along a smooth path.

One frame cannot tell such waves from longer ones; many frames at many shifts can (Stark & Oskoui 1989, J. Opt. Soc.
Am. A 6:1715). But pictures alone would let the places within a pixel be renamed, the template along with them: so it
is learnt where a smooth path has the target (Anderson & King 2000, PASP 112:1360, average over shifts likewise).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import comb

import numpy as np
from numpy.typing import NDArray

from frictrack.records import Array, Mask
from frictrack.tracking.refine import Fine
from frictrack.tracking.template import Template
from frictrack.tracking.waves import BAND, FINER

STRETCH = 8.0  # px, over which errors that repeat from pixel to pixel average out
LEAST, LONGEST = 12, 160  # frames to either side, and from first to last, of a stretch that a parabola follows
MANY = 100  # frames, from which short waves can be learnt
WORSE = 2.0  # times the usual misfit of a parabola: there the path is not smooth
ORDER, NOISELESS = 5, 5e-4  # of the differences that tell the noise of places, and px of it that any film has
ENOUGH = 2000  # frames whose places tell how far all are drawn to the pixels
SHOWN = 3.0  # condition of the pixel's waves up to which every shift was seen
SHARE = 0.5  # of the frames in which the path must be smooth
SURER = 0.95  # times the standard deviation that comes out with them, for them to be kept
ELSEWHERE = 0.4  # standard deviations by which half of the places move, for the same


@dataclass(frozen=True, eq=False)
class SmoothPath:
    """Where the target was in some frames (n, 2), px: not a number where no parabola follows it over `STRETCH`."""

    frames: NDArray[np.int64]
    at: Array

    @property
    def axes(self) -> Mask:
        """Axes (x, y) along which the path is smooth and shows every shift."""
        known = np.isfinite(self.at)
        return np.asarray((known.mean(axis=0) > SHARE) & (known.sum(axis=0) >= MANY))

    def again(self, at: Array) -> SmoothPath:
        """The same from better places (n, 2), px, where these stand close enough to each other."""
        better = smoothed(self.frames, at, self.frames).at
        return replace(self, at=np.where(np.isfinite(better), better, self.at))

    def placed(self, fine: Fine, corner: NDArray[np.int64], template: Template) -> Fine:
        """The places at which a template is learnt: the smooth path's along the axes of its short waves."""
        short = np.array(template.bands[::-1]) > BAND
        return replace(fine, at=np.where(short & np.isfinite(self.at), self.at - corner, fine.at))

    def widened(self, template: Template) -> Template:
        """The template with room for short waves along the path's axes."""
        x, y = (FINER if axis else BAND for axis in self.axes)
        return template.widened((y, x))


def matters(sharp: Fine, fine: Fine, axes: Mask) -> bool:
    """Whether places found with short waves are surer, or stand elsewhere by more than noise would move them."""
    one, other = (float(np.median(np.hypot(*f.sigma[:, :2].T))) for f in (sharp, fine))
    moved = (sharp.at - fine.at)[:, axes] / fine.sigma[:, :2][:, axes]
    return one < SURER * other or float(np.median(np.abs(moved - np.median(moved, axis=0)))) > ELSEWHERE


def smoothed(frames: NDArray[np.int64], at: Array, wanted: NDArray[np.int64]) -> SmoothPath:
    """Parabolas through stretches of places (n, 2), px, in these frames, where one fits as well as elsewhere.

    The path is given in the `wanted` ones of the frames.
    """
    rows = np.searchsorted(frames, wanted)
    each = [_smooth(frames, at[:, axis], rows) for axis in range(2)]
    return SmoothPath(wanted, np.stack(each, axis=1))


def _smooth(frames: NDArray[np.int64], at: Array, rows: NDArray[np.int64]) -> Array:
    """Parabolas through places (n,) in some rows (m,); not a number where more than noise and pixels is about them."""
    series = np.column_stack([at, _waves(at)])
    path = _parabolas(frames, at, series, rows)
    rough = series[rows] - path
    rough = rough[np.isfinite(rough[:, 0])]
    shaken = len(rough) > rough.shape[1] and not _is_noise(_left(rough), at)
    return np.full(len(rows), np.nan) if shaken else path[:, 0]


def drawn_to_pixels(frames: NDArray[np.int64], at: Array) -> tuple[Array, Array]:
    """By how much places (n, 2), px, are off towards the pixels, and the amplitude of that along x and y, px.

    What repeats from pixel to pixel along a smooth path is no motion; it is taken as far as it stands out of the noise
    (James & Stein 1961). Zero along an axis without one.
    """
    rows = np.arange(0, len(frames), -(-len(frames) // ENOUGH))
    off, size = np.zeros_like(at), np.zeros(2)
    for axis in range(2):
        series = np.column_stack([at[:, axis], _waves(at[:, axis])])
        rough = series[rows] - _parabolas(frames, at[:, axis], series, rows)
        rough = rough[np.isfinite(rough[:, 0])]
        told = len(rough) >= max(MANY, SHARE * len(rows)) and np.linalg.cond(rough[:, 1:]) < SHOWN
        if told and _is_noise(_left(rough), at[:, axis]):
            found = _sure(rough[:, 1:], rough[:, 0])
            off[:, axis], size[axis] = series[:, 1:] @ found, np.hypot(*found[:2])
    return off, size


def _left(rough: Array) -> Array:
    """What its waves, the further columns, leave of what is rough, the first (n,)."""
    return np.asarray(rough[:, 0] - rough[:, 1:] @ np.linalg.lstsq(rough[:, 1:], rough[:, 0], rcond=None)[0])


def _is_noise(left: Array, at: Array) -> bool:
    """Whether hardly more than the noise of places (n,) is left about a path: no shake of target or camera."""
    noise = np.median(np.abs(np.diff(at, ORDER))) / (0.6745 * np.sqrt(comb(2 * ORDER, ORDER)))
    return bool(np.std(left) < WORSE * max(noise, NOISELESS))


def _sure(waves: Array, rough: Array) -> Array:
    """Least squares of what is rough (n,) on waves (n, k), shrunk by the chance that it is all noise."""
    found = np.linalg.lstsq(waves, rough, rcond=None)[0]
    told = waves @ found
    strength = float(told @ told) * (len(rough) - len(found)) / max(float(np.sum((rough - told) ** 2)), 1e-300)
    return np.asarray(found * max(1 - len(found) / max(strength, 1e-300), 0.0))


def _parabolas(frames: NDArray[np.int64], at: Array, series: Array, rows: NDArray[np.int64]) -> Array:
    """Series (n, k) in some rows (m, k), by parabolas in time through `STRETCH` px of the places `at` (n,).

    Not a number where the stretch is not there, or where the first series follows no parabola: a blow or a start.
    """
    out, left = np.full((len(rows), series.shape[1]), np.nan), np.full(len(rows), np.inf)
    way = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(at)))])
    first = np.minimum(np.searchsorted(way, way[rows] - STRETCH / 2, side="right") - 1, rows - LEAST)
    last = np.maximum(np.searchsorted(way, way[rows] + STRETCH / 2), rows + LEAST)
    inside = np.flatnonzero((first >= 0) & (last < len(at)))
    for i in inside[frames[last[inside]] - frames[first[inside]] < LONGEST]:
        part = slice(first[i], last[i] + 1)
        powers = np.vander((frames[part] - frames[rows[i]]) / LONGEST, 3)
        parabola = np.linalg.lstsq(powers, series[part], rcond=None)[0]
        out[i], left[i] = parabola[2], np.std(series[part, 0] - powers @ parabola[:, 0])
    found = np.isfinite(left)
    if found.any():
        out[left > WORSE * np.median(left[found])] = np.nan
    return out


def _waves(at: Array) -> Array:
    """Two harmonics of the pixel, (n, 4)."""
    turns = [2 * np.pi * k * at for k in (1, 2)]
    return np.column_stack([f(u) for u in turns for f in (np.sin, np.cos)])
