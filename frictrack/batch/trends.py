"""Trends over a series of studies, in the order in which they were named.

A value y_i with its own standard deviation s_i scatters by more than that from study to study:

    y_i = a + b i + u_i + e_i,   u_i ~ N(0, tau^2),   e_i ~ N(0, s_i^2)

tau is where the weighted squares come to their expectation n - 2 (Paule & Mandel 1982, J. Res. NBS 87, 377, with a
slope), and b is tested by Student's t with n - 2 degrees of freedom.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.optimize import brentq
from scipy.stats import t as student

from frictrack.batch.tasks import StudyOutcome
from frictrack.records import Array

MIN_POINTS = 4  # points that a slope is told from
ALPHA = 0.01  # of all trends of one batch together


@dataclass(frozen=True, eq=False)
class Trend:
    """One quantity over the series."""

    name: str
    unit: str
    at: Array  # place in the series, from 1
    value: Array
    std: Array  # nan where none is known
    slope: float  # per place
    slope_std: float
    p: float  # of no slope; multiplied by the number of trends
    scatter: float  # tau
    axis: str = "study"  # what the places are of

    @property
    def holds(self) -> bool:
        """Whether there is a trend, at `ALPHA` for all quantities together."""
        return self.p < ALPHA

    @property
    def change(self) -> float:
        """From the first to the last place."""
        return self.slope * float(self.at[-1] - self.at[0])

    @property
    def change_std(self) -> float:
        """Standard deviation of the change."""
        return self.slope_std * float(self.at[-1] - self.at[0])

    def drawn(self) -> dict[str, Any]:
        """All of it, for the page."""
        told = ("holds", "change", "change_std")
        return {**vars(self), **{key: getattr(self, key) for key in told}}

    def summary(self) -> dict[str, Any]:
        """As JSON has it."""
        told = ("name", "unit", "along", "slope", "slope_std", "change", "change_std", "scatter", "p", "holds")
        return {"n": len(self.at), **{key: getattr(self, key) for key in told}}


def find_trends(done: Sequence[StudyOutcome]) -> list[Trend]:
    """Trends of every parameter and of the noise over the studies, and of the friction level over all their runs."""
    first = [next((row for row in one.rows if row.get("verdict")), {}) for one in done]
    units = {name: unit for one in done for name, unit in one.units.items()}
    found = [_trend(name, unit, _column(first, name), _deviations(first, name)) for name, unit in units.items()]
    noise = [_mean(_column(one.rows, "noise_um")) for one in done]
    found.append(_trend("noise of the displacement", "µm", np.array(noise)))
    fitted = [row for one in done for row in one.rows if row.get("role") == "fit"]
    found.append(_trend("friction level of the run", "1", _column(fitted, "level"), axis="run"))
    known = [one for one in found if one is not None]
    return [replace(one, p=min(1.0, one.p * len(known))) for one in known]


def _deviations(rows: Sequence[dict[str, Any]], name: str) -> Array:
    """Standard deviations of a parameter, with what the law misses where it was rejected."""
    wider = _column(rows, f"{name} std_misfit")
    return np.where(np.isfinite(wider), wider, _column(rows, f"{name} std"))


def _trend(name: str, unit: str, y: Array, s: Array | None = None, axis: str = "study") -> Trend | None:
    """The trend of values y (n,) with standard deviations s (n,); None for too few values, or for a constant."""
    known = np.isfinite(y)
    if np.count_nonzero(known) < MIN_POINTS or np.ptp(y[known]) == 0.0:
        return None
    s = np.full(len(y), np.nan) if s is None else s
    at, y, s = np.flatnonzero(known).astype(np.float64) + 1.0, y[known], s[known]
    slope, slope_std, scatter, p = fit_slope(at, y, np.nan_to_num(s))
    return Trend(name, unit, at, y, s, slope, slope_std, p, scatter, axis)


def fit_slope(at: Array, y: Array, s: Array) -> tuple[float, float, float, float]:
    """Slope of y (n,) with standard deviations s (n,) over `at`: slope, its standard deviation, scatter tau, p."""
    n = len(y)
    unit = float(np.std(y)) or 1.0
    z, e, x = (y - np.mean(y)) / unit, s / unit, (at - np.mean(at)) / float(np.std(at))
    floor = 1e-12

    def fitted(tau2: float) -> tuple[Array, Array, float]:
        w = 1.0 / (e**2 + tau2 + floor)
        a = np.column_stack([np.ones(n), x])
        cov = np.linalg.inv(a.T @ (w[:, None] * a))
        b = cov @ (a.T @ (w * z))
        return b, np.asarray(cov, dtype=np.float64), float(np.sum(w * (z - a @ b) ** 2)) - (n - 2)

    tau2 = 0.0 if fitted(0.0)[2] <= 0.0 else float(brentq(lambda v: fitted(v)[2], 0.0, 100.0))
    b, cov, _ = fitted(tau2)
    deviation = float(np.sqrt(cov[1, 1]))
    p = float(2.0 * student.sf(abs(b[1]) / deviation, n - 2))
    per_place = unit / float(np.std(at))
    return float(b[1]) * per_place, deviation * per_place, float(np.sqrt(tau2)) * unit, p


def _column(rows: Sequence[Mapping[str, Any]], key: str) -> Array:
    """The numbers of a column (n,), nan where there is none."""
    found = (row.get(key) for row in rows)
    return np.array([value if isinstance(value, int | float) else np.nan for value in found], dtype=np.float64)


def _mean(values: Array) -> float:
    """Mean of what is known; nan where nothing is."""
    known = values[np.isfinite(values)]
    return float(np.mean(known)) if len(known) else np.nan
