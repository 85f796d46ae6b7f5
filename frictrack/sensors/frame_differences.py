"""Compute second differences of the displacement, and the exact covariance of their noise.

    (x_{i+1} - x_i) / h  -  (x_i - x_{i-1}) / h   =   integral of a(t) over two frame intervals under a triangle

holds exactly for any motion. Camera and accelerometer are therefore compared without a filter: the sensor is integrated
twice and differenced over the same frames, the unknown x0 and v0 cancel, and both noises have a known covariance of a
few diagonals: that of the camera's white noise, and that of the sensor's under the triangle.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from frictrack.motion.noise import noise_level
from frictrack.records import Array, Displacement, Mask
from frictrack.sensors.sensor_record import SensorRecord

SPLINE_REACH_SAMPLES = 16  # samples on either side from which the spline of one sample is made
SPLINE_TAIL_SAMPLES = 4  # samples beyond the triangle in which a spline still acts: it falls to 0.27 per sample
GAP_RESOLUTION = 0.02  # of the frame interval; gaps that differ by less share one table
POINTS_PER_SAMPLE = 32  # of the table of a sample's effect, per sample or frame, whichever is shorter
MAX_FRAME_GAP = 4.5  # frame intervals between two frames; no difference is taken over a longer gap


@dataclass(frozen=True, eq=False)
class FrameDifferences:
    """Second differences of the displacement.

    Attributes
    ----------
    t : array (n,)
        Times of all frames, s.
    z : array (r,)
        Differences over the interval, m/s^2.
    centre : array of int (r,)
        Frames about which they are taken.
    map : sparse array (r, n)
        Map from positions to differences.
    camera : sparse array (r, r)
        Covariance of the camera's noise in z.

    """

    t: Array  # of all frames, s
    z: Array
    centre: NDArray[np.int64]
    map: scipy.sparse.csr_array
    camera: scipy.sparse.csr_array  # covariance of the camera's noise in z

    @property
    def interval(self) -> float:
        """Frame interval, s."""
        return float(np.median(np.diff(self.t)))

    def select(self, rows: Mask) -> FrameDifferences:
        """Only some of the rows."""
        i = np.flatnonzero(rows)
        return FrameDifferences(self.t, self.z[i], self.centre[i], self.map[i], self.camera[i][:, i])

    def ends(self) -> tuple[Array, Array]:
        """First and last time (r,) that a difference reaches to."""
        first, last = self.map.indices.reshape(-1, 3)[:, [0, 2]].T
        return self.t[first], self.t[last]

    def sensor_differences(self, series: SensorRecord, lags: Array, order: int = 2) -> Array:
        """The sensor's differences (r, k) when its clock is `lags` (k,) or (n, k) s behind the camera's."""
        return np.asarray(self.map @ series.integral(self.t[:, None] - lags, order))

    def noise(self, series: SensorRecord, offset: float) -> scipy.sparse.csr_array:
        """Compute the covariance of the differences for a sensor with white noise of unit variance.

        Every sample acts through its own spline, which decays within a few samples.

        Parameters
        ----------
        series : SensorRecord
            Clock of the sensor.
        offset : float
            Offset of this clock, s.

        Returns
        -------
        sparse array (r, r)
            Covariance per unit variance of a sample.

        """
        d, centre = series.interval, self.t[self.centre]
        first, last = self.ends()
        reach = int(np.ceil(float(np.max(last - first)) / 2.0 / d)) + SPLINE_TAIL_SAMPLES
        nearest = np.rint((centre - offset - series.t[0]) / d)
        column = nearest[:, None] + np.arange(-reach, reach + 1)
        distance = (centre - offset - series.t[0])[:, None] - column * d
        gaps = np.rint(np.stack([centre - first, last - centre], axis=1) / self.interval / GAP_RESOLUTION).astype(
            np.int64
        )
        effect = np.empty_like(distance)
        gap_kinds, gap_kind = np.unique(gaps, axis=0, return_inverse=True)
        for k in range(len(gap_kinds)):
            rows = gap_kind.ravel() == k
            effect[rows] = np.interp(
                distance[rows], *_sample_effect(d, reach, gap_kinds[k] * GAP_RESOLUTION * self.interval)
            )
        column = (column - np.min(column)).astype(np.int64)
        row = np.broadcast_to(np.arange(len(self.z))[:, None], column.shape)
        effects = scipy.sparse.csr_array((effect.ravel(), (row.ravel(), column.ravel())))
        return scipy.sparse.csr_array(effects @ effects.T)


def _sample_effect(d: float, reach: int, gaps: Array) -> tuple[Array, Array]:
    """Effect of one sample in a regular series on a difference at distance u: u and the effect.

    `gaps` (2,) are the times between the three frames of the difference, s.
    """
    samples = np.arange(-SPLINE_REACH_SAMPLES, SPLINE_REACH_SAMPLES + 1.0)
    unit_sample = SensorRecord(d * samples, np.where(samples == 0.0, 1.0, 0.0))
    width = (reach + 1) * d
    u = np.linspace(-width, width, int(2.0 * width * POINTS_PER_SAMPLE / min(d, *gaps)) + 1)
    before, at_frame, after = (unit_sample.integral(u + at, 2) for at in (-gaps[0], 0.0, gaps[1]))
    return u, ((after - at_frame) / gaps[1] - (at_frame - before) / gaps[0]) / np.mean(gaps)


def second_differences(displacement: Displacement) -> FrameDifferences:
    """Compute second differences over each three neighbouring valid frames.

    Parameters
    ----------
    displacement : Displacement
        Displacement of the slider, m.

    Returns
    -------
    FrameDifferences
        The noise is white, at the level that the displacement shows; `sigma_x` gives relative weights.

    """
    known = displacement.valid & np.isfinite(displacement.x)
    at, t = np.flatnonzero(known), displacement.t
    h = np.diff(t[at])
    rows = np.flatnonzero(np.maximum(h[1:], h[:-1]) < MAX_FRAME_GAP * np.median(np.diff(t))) + 1
    before, after = h[rows - 1], h[rows]
    half = (before + after) / 2.0
    weights = np.stack([1.0 / before, -1.0 / before - 1.0 / after, 1.0 / after], axis=1) / half[:, None]
    columns = np.stack([at[rows - 1], at[rows], at[rows + 1]], axis=1)
    place = np.repeat(np.arange(len(rows)), 3)
    mapping = scipy.sparse.csr_array((weights.ravel(), (place, columns.ravel())), shape=(len(rows), len(t)))
    x = np.where(known, displacement.x, 0.0)
    return FrameDifferences(
        t, mapping @ x, at[rows], mapping, _noise_covariance(mapping, _frame_noise(displacement, known))
    )


def _noise_covariance(mapping: scipy.sparse.csr_array, sigma: Array) -> scipy.sparse.csr_array:
    scaled = mapping.multiply(sigma[None, :])
    return scipy.sparse.csr_array(scaled @ scaled.T)


def _frame_noise(displacement: Displacement, known: Mask) -> Array:
    """White noise of every frame (n,), m."""
    stated = known & np.isfinite(displacement.sigma_x) & (displacement.sigma_x > 0)
    typical = float(np.sqrt(np.mean(displacement.sigma_x[stated] ** 2))) if np.any(stated) else 1.0
    level = float(noise_level(np.where(known, displacement.x, 0.0), known)[0])
    relative = np.where(stated, displacement.sigma_x, typical) / typical
    return np.asarray(relative * (level if level > 0 and np.isfinite(level) else typical))


class Whitener:
    """Transform correlated noise of differences to independent noise of variance 1 (banded Cholesky factor).

    Parameters
    ----------
    covariance : sparse array (r, r)
        Covariance with a few diagonals.

    """

    def __init__(self, covariance: scipy.sparse.csr_array) -> None:
        entries = covariance.tocoo()
        width = int(np.max(np.abs(entries.row - entries.col), initial=0))
        band = np.zeros((width + 1, covariance.shape[0]))
        for k in range(width + 1):
            band[k, : covariance.shape[0] - k] = covariance.diagonal(-k)
        self._factor = scipy.linalg.cholesky_banded(band, lower=True)

    @property
    def logdet(self) -> float:
        """Logarithm of the determinant of the covariance."""
        return 2.0 * float(np.sum(np.log(self._factor[0])))

    def __call__(self, columns: Array) -> Array:
        """Whiten columns (r, k) or (r,)."""
        out, _ = scipy.linalg.lapack.dtbtrs(self._factor, columns.reshape(len(columns), -1), uplo="L")
        return np.asarray(out).reshape(columns.shape)
