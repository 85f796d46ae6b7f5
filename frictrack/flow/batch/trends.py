"""Test laws, noise and friction level for trends over a series of studies, and over the conditions that they state.

The studies are in the order in which the user named them. A value y_i with standard deviation s_i varies from study to
study by more than s_i:

    y_i = a + b i + u_i + e_i,   u_i ~ N(0, tau^2),   e_i ~ N(0, s_i^2)

tau is the value at which the weighted sum of squares equals its expectation n - 2, and b is tested by Student's t with
n - 2 degrees of freedom.

References
----------
Paule & Mandel (1982), J. Res. NBS 87, 377 (tau, here with a slope).

"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.optimize import brentq

from frictrack.base.distributions import student_sf
from frictrack.base.errors import FrictrackError
from frictrack.base.number_format import format_plus_minus
from frictrack.fit.covariates import CovariateTrend, CovariateTrends, trend
from frictrack.flow.batch.tasks import StudyOutcome
from frictrack.records import Array
from frictrack.settings.priors import Prior

MIN_POINTS = 4  # needed to fit a slope
ALPHA = 0.01  # for all trends over the series together, and for those over all conditions
_QUANTITY = re.compile(r"\s*([+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)\s*(.*?)\s*")
Condition = tuple[float | str, str]  # value and unit; a category has no unit


@dataclass(frozen=True, eq=False)
class Trend:
    """The trend of one quantity over the series.

    Attributes
    ----------
    name, unit
        The quantity.
    at
        Positions in the series, from 1, (n,).
    value, std
        Values and their standard deviations, NaN where unknown, (n,).
    slope, slope_std
        Change per position, and its standard deviation.
    p
        p-value of no slope, multiplied by the number of trends (Bonferroni).
    scatter
        Standard deviation tau from study to study.
    axis
        What a position is: "study" or "run".

    """

    name: str
    unit: str
    at: Array
    value: Array
    std: Array
    slope: float
    slope_std: float
    p: float
    scatter: float
    axis: str = "study"

    @property
    def holds(self) -> bool:
        """Whether there is a trend, at `ALPHA` for all quantities together."""
        return self.p < ALPHA

    @property
    def change(self) -> float:
        """Change from the first to the last position."""
        return self.slope * float(self.at[-1] - self.at[0])

    @property
    def change_std(self) -> float:
        """Standard deviation of the change."""
        return self.slope_std * float(self.at[-1] - self.at[0])

    def to_plot(self) -> dict[str, Any]:
        """Return everything that the page draws."""
        keys = ("holds", "change", "change_std")
        return {**vars(self), "along": self.axis, **{key: getattr(self, key) for key in keys}}

    def summary(self) -> dict[str, Any]:
        """Return the trend as JSON."""
        keys = ("slope", "slope_std", "change", "change_std", "scatter", "p", "holds")
        head = {"n": len(self.at), "name": self.name, "unit": self.unit, "along": self.axis}
        return {**head, **{key: getattr(self, key) for key in keys}}


def find_trends(outcomes: Sequence[StudyOutcome]) -> list[Trend]:
    """Test every parameter, the noise and the friction level for a trend.

    Parameters
    ----------
    outcomes
        The studies in order.

    Returns
    -------
    list of Trend
        Those of quantities with enough values; `p` is corrected for their number.

    """
    first = [next((row for row in one.rows if row.get("verdict")), {}) for one in outcomes]
    units = {name: unit for one in outcomes for name, unit in one.units.items()}
    found = [_trend(name, unit, _column(first, name), _deviations(first, name)) for name, unit in units.items()]
    noise = [_mean(_column(one.rows, "noise_um")) for one in outcomes]
    found.append(_trend("noise of the displacement", "µm", np.array(noise)))
    fitted = [row for one in outcomes for row in one.rows if row.get("role") == "fit"]
    found.append(_trend("friction level of the run", "1", _column(fitted, "level"), axis="run"))
    known = [one for one in found if one is not None]
    return [replace(one, p=min(1.0, one.p * len(known))) for one in known]


def _deviations(rows: Sequence[dict[str, Any]], name: str) -> Array:
    """Return standard deviations of a parameter; if the model was rejected, those that include the misfit."""
    wider = _column(rows, f"{name} std_misfit")
    return np.where(np.isfinite(wider), wider, _column(rows, f"{name} std"))


def _trend(name: str, unit: str, y: Array, s: Array | None = None, axis: str = "study") -> Trend | None:
    """Return the trend of values y (n,) with standard deviations s (n,); None for too few values or a constant."""
    known = np.isfinite(y)
    if np.count_nonzero(known) < MIN_POINTS or np.ptp(y[known]) == 0.0:
        return None
    s = np.full(len(y), np.nan) if s is None else s
    at, y, s = np.flatnonzero(known).astype(np.float64) + 1.0, y[known], s[known]
    slope, slope_std, scatter, p = fit_slope(at, y, np.nan_to_num(s))
    return Trend(name, unit, at, y, s, slope, slope_std, p, scatter, axis)


def fit_slope(at: Array, y: Array, s: Array) -> tuple[float, float, float, float]:
    """Fit a straight line to values that scatter by more than their standard deviations.

    Parameters
    ----------
    at
        Positions, (n,).
    y, s
        Values and their standard deviations, (n,).

    Returns
    -------
    slope, slope_std, tau, p : float
        The slope, its standard deviation, the additional scatter, and the p-value of no slope.

    References
    ----------
    Paule & Mandel (1982), J. Res. NBS 87, 377.

    Examples
    --------
    >>> slope, _, tau, p = fit_slope(np.arange(6.0), np.array([0.0, 1.1, 1.9, 3.0, 4.1, 5.0]), np.full(6, 0.1))
    >>> round(slope, 2), tau, p < 0.001
    (1.0, 0.0, True)

    """
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
    p = float(2.0 * student_sf(abs(b[1]) / deviation, n - 2))
    per_place = unit / float(np.std(at))
    return float(b[1]) * per_place, deviation * per_place, float(np.sqrt(tau2)) * unit, p


def _column(rows: Sequence[Mapping[str, Any]], key: str) -> Array:
    """Return the numbers of a column (n,), NaN where there are none."""
    found = (row.get(key) for row in rows)
    return np.array([value if isinstance(value, int | float) else np.nan for value in found], dtype=np.float64)


def _mean(values: Array) -> float:
    """Return the mean of the finite values; NaN if there are none."""
    known = values[np.isfinite(values)]
    return float(np.mean(known)) if len(known) else np.nan


def read_condition(raw: float | str) -> Condition:
    """Read a condition: a number, a number with a unit, or the name of a category.

    Examples
    --------
    >>> read_condition("20 degC"), read_condition(3), read_condition("steel on brass")
    ((20.0, 'degC'), (3.0, ''), ('steel on brass', ''))

    """
    if not isinstance(raw, str):
        return float(raw), ""
    found = _QUANTITY.fullmatch(raw)
    return (float(found[1]), found[2]) if found else (raw.strip(), "")


def condition_trends(outcomes: Sequence[StudyOutcome]) -> list[dict[str, Any]]:
    """Fit the trends over every condition that studies state.

    A study takes part if it states the condition and has a law of its own: fitted without the prior of another study,
    with the model that most of these studies have.

    Parameters
    ----------
    outcomes
        The studies in order.

    Returns
    -------
    list of dict
        One entry per condition: trends, or the reason why there are none, and what to read as sentences.

    """
    names = list(dict.fromkeys(name for one in outcomes for name in one.conditions))
    entries = [_entry(name, outcomes) for name in names]
    count = max(sum(len(entry["trends"]) for entry in entries), 1)
    for entry in entries:
        for one in entry["trends"]:
            one["holds"] = one["p"] * count < ALPHA
    return entries


def _entry(name: str, outcomes: Sequence[StudyOutcome]) -> dict[str, Any]:
    """Return the JSON of one condition."""
    stated = [(one, read_condition(one.conditions[name])) for one in outcomes if name in one.conditions and one.law]
    laws = [Prior.from_toml(one.law, one.study) for one, _ in stated]
    usual = Counter(law.model for law in laws).most_common(1)
    same = [i for i, law in enumerate(laws) if law.model == usual[0][0]]
    left_out = [one.study for one in outcomes if name in one.conditions]
    used = [stated[i][0].study for i in same]
    unit = stated[same[0]][1][1] if same else ""
    head = {"condition": name, "unit": unit, "studies": used, "left_out": [s for s in left_out if s not in used]}
    units = {stated[i][1][1] for i in same}
    try:
        if len(units) > 1:
            raise FrictrackError(f"expected one unit of {name} but got {', '.join(sorted(units))}")
        found = trend([laws[i] for i in same], [stated[i][1][0] for i in same], name)
    except FrictrackError as e:
        return {**head, "load": None, "trends": [], "reason": str(e), "words": [f"no trend over {name}: {e}"]}
    return {
        **head,
        "load": found.load,
        "trends": [one.summary() for one in found.trends.values()],
        "reason": None,
        "words": list(_words(found, unit)),
    }


def _words(found: CovariateTrends, unit: str) -> Iterator[str]:
    """Yield one sentence per parameter."""
    for name, one in found.trends.items():
        own = "" if one.unit == "1" else f" {one.unit}"
        scatter = f"scatter between studies {one.scatter:.2g}{own}, p = {one.p:.2g}"
        yield f"over {found.condition}, {name} {_change(one, own, unit)}; {scatter}"
    if found.load is not None:
        yield f"forces of these trends belong to a load of {found.load:.4g} N"


def _change(one: CovariateTrend, own: str, unit: str) -> str:
    """Return the slope, or the value of every category."""
    rows: Mapping[str, str] = {
        term: f"{format_plus_minus(float(value), float(std))}{own}"
        for term, value, std in zip(one.terms, one.coefficients, one.std, strict=True)
    }
    if one.origin is not None:
        return f"changes by {rows['slope']} per {unit or 'unit'}"
    return "is " + ", ".join(f"{value} ({term})" for term, value in rows.items())
