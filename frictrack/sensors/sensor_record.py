"""The record of a sensor on its own clock: interpolation, averages, noise, clipping and gaps."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy

from frictrack.errors import FrictrackError
from frictrack.motion.noise import noise_level
from frictrack.records import Array, Mask, stretches

MAX_GAP_INTERVALS = 2.5  # sample intervals without a sample; over a longer gap the sensor was not running
MIN_CLIPPED_SAMPLES = 3  # equal samples in a row at the extreme
MAX_HELD_SHARE = 0.05  # of all samples equal to the one before; in a coarser record clipping cannot be recognised
MAX_CLIPPED_SHARE = 0.2  # of the record; an extreme that more samples share is a level, not clipping
MIN_SAMPLES = 2
MAX_MISSING_SHARE = 0.5  # of the samples


@dataclass(frozen=True, eq=False)
class SensorRecord:
    """Samples of a sensor.

    Parameters
    ----------
    t : array (m,)
        Times on the sensor's own clock, s.
    values : array (m,)
        Samples in SI units; NaN where there is none.
    name : str
        Name for messages.

    Raises
    ------
    FrictrackError
        For fewer than two samples, times that do not rise, more than half of the values missing, or arrays of different
        length.

    Examples
    --------
    >>> SensorRecord(np.arange(5) / 1000, np.array([0.0, 1.0, 4.0, 9.0, 16.0])).interval
    0.001

    """

    t: Array
    values: Array
    name: str = "sensor"

    def __post_init__(self) -> None:
        if fault := _record_fault(self.t, self.values):
            raise FrictrackError(f"{self.name}: {fault}")

    @cached_property
    def interval(self) -> float:
        """Median time between two samples, s."""
        return float(np.median(np.diff(self.t)))

    @cached_property
    def clipped(self) -> Mask:
        """Samples (m,) at the end of the sensor's range: several in a row equal to the largest or smallest."""
        v = self.values
        out = np.zeros(len(v), dtype=bool)
        for extreme in (np.nanmax(v), np.nanmin(v)):
            at = v == extreme
            if extreme != 0.0 and np.mean(at) < MAX_CLIPPED_SHARE and np.mean(np.diff(v[~at]) == 0.0) < MAX_HELD_SHARE:
                out |= _long_runs(at, MIN_CLIPPED_SAMPLES)
        return out

    @cached_property
    def known(self) -> Mask:
        """Samples (m,) that are neither missing nor clipped."""
        return np.asarray(np.isfinite(self.values) & ~self.clipped)

    @cached_property
    def constant(self) -> bool:
        """Whether all samples are equal."""
        return bool(np.ptp(self.values[self.known]) == 0.0)

    @cached_property
    def sigma(self) -> float:
        """White noise of a sample from fifth differences, at least that of its rounding."""
        v = self.values[self.known]
        steps = np.abs(np.diff(v))
        rounding = float(np.min(steps[steps > 0], initial=np.inf)) / np.sqrt(12.0)
        sigma = float(np.nan_to_num(noise_level(self.values, self.known)[0]))
        return max(sigma, rounding) if np.isfinite(rounding) and np.mean(steps == 0.0) > MAX_HELD_SHARE else sigma

    @cached_property
    def density(self) -> float:
        """Spectral density of the white noise, unit^2 s: the variance of an average is this over its duration."""
        return self.sigma**2 * self.interval

    @cached_property
    def curves(self) -> tuple[scipy.interpolate.BSpline, scipy.interpolate.BSpline, scipy.interpolate.BSpline]:
        """Spline through the samples, across gaps, and its first and second integral over `t` - t[0]."""
        known = self.known
        degree = 3 if np.sum(known) > 3 else 1
        curve = scipy.interpolate.make_interp_spline(self.t[known] - self.t[0], self.values[known], k=degree)
        return curve, curve.antiderivative(1), curve.antiderivative(2)

    def integral(self, at: Array, order: int) -> Array:
        """Evaluate the spline or its integrals; outside the record it keeps its end value.

        Parameters
        ----------
        at : array
            Times on the sensor's clock, s.
        order : int
            0 for the spline, 1 or 2 for its integrals.

        Returns
        -------
        array
            In the shape of `at`.

        """
        end = float(self.t[-1] - self.t[0])
        u = at - self.t[0]
        inside = np.clip(u, 0.0, end)
        outside = u - inside
        curves_inside = [curve(inside) for curve in self.curves[: order + 1]]
        return np.asarray(sum(curves_inside[order - k] * outside**k / max(k, 1) for k in range(order + 1)))

    def average(self, at: Array, width: float) -> Array:
        """Average the record about given times, so that frequencies above the frame rate are not aliased.

        Parameters
        ----------
        at : array (k,)
            Times on the sensor's clock, s.
        width : float
            Duration of the average, s. Where the samples are further apart, the spline itself is returned.

        Returns
        -------
        array (k,)
            NaN where the sensor was not running, had a gap or was clipped over more than half of the width.

        """
        covered = self.covers(at - width / 2.0, at + width / 2.0)
        if self.interval >= width:
            return np.where(covered, self.integral(at, 0), np.nan)
        last = np.clip(at + width / 2.0, self.t[0], self.t[-1])
        first = np.clip(at - width / 2.0, self.t[0], self.t[-1])
        span = np.where(last > first, last - first, 1.0)
        mean = (self.integral(last, 1) - self.integral(first, 1)) / span
        return np.where(covered & (last > first), mean, np.nan)

    def covers(self, start: Array, end: Array) -> Mask:
        """Test whether the sensor was running without a gap.

        Parameters
        ----------
        start, end : array (k,)
            Begin and end of each interval on the sensor's clock, s.

        Returns
        -------
        array of bool (k,)
            Half of an interval, or half a sample, may lie outside the record.

        """
        slack = 0.5 * np.maximum(end - start, self.interval) * (1.0 + 1e-9)
        inside = (start >= self.t[0] - slack) & (end <= self.t[-1] + slack)
        lost = np.diff(self.t) > MAX_GAP_INTERVALS * self.interval
        lost |= ~self.known[1:] | ~self.known[:-1]
        count = np.concatenate(([0], np.cumsum(lost)))
        tiny = 1e-6 * self.interval
        first = np.clip(np.searchsorted(self.t, start + tiny, side="right") - 1, 0, len(count) - 1)
        last = np.clip(np.searchsorted(self.t, end - tiny, side="left"), 0, len(count) - 1)
        return np.asarray(inside & (count[np.maximum(last, first)] == count[first]))


def _record_fault(t: Array, values: Array) -> str:
    """Describe what is wrong with a record; "" where it is valid."""
    if np.shape(t) != np.shape(values) or np.ndim(t) != 1:
        return f"expected one value per time but got {np.shape(values)} values at {np.shape(t)} times"
    not_rising = np.flatnonzero(~(np.diff(t) > 0))
    if len(not_rising):
        i = int(not_rising[0])
        return f"expected rising time but got {t[i + 1]:g} s after {t[i]:g} s in row {i + 2}; mend its clock"
    if len(t) < MIN_SAMPLES:
        return f"expected at least {MIN_SAMPLES} samples but got {len(t)}"
    lost = int(np.sum(~np.isfinite(values)))
    if lost > MAX_MISSING_SHARE * len(t):
        return f"expected numbers but {lost} of {len(t)} samples are none; leave the sensor out, or mend the record"
    return ""


def _long_runs(mask: Mask, least: int) -> Mask:
    """Mask without stretches shorter than `least`."""
    out = np.zeros(len(mask), dtype=bool)
    for s in stretches(mask):
        out[s] = s.stop - s.start >= least
    return out
