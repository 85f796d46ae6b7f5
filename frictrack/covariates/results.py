"""Hold the trends of parameters over a condition: coefficients, scatter between studies, predictions."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.optimize import brentq
from scipy.special import ndtr

from frictrack.distributions import student_ppf
from frictrack.errors import FrictrackError
from frictrack.records import Array

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True, eq=False)
class CovariateTrend:
    """How one parameter depends on a condition.

    Attributes
    ----------
    name, unit
        The parameter.
    terms
        What the coefficients are: "at 0" and "slope" for a number, the categories otherwise.
    coefficients, std
        Coefficients (q,) and their standard deviations.
    scatter, scatter_std
        Standard deviation tau between studies, and its own; None where tau is zero.
    scatter_interval
        95 % interval of tau.
    p
        p-value of no dependence.
    studies
        Number of studies.
    origin
        Value of the condition at which the fit is centred; None for categories.
    covariance
        Covariance (q, q) of the coefficients.
    mixture
        Fits of this parameter alone at possible values of tau, for predictions.

    """

    name: str
    unit: str
    terms: tuple[str, ...]
    coefficients: Array
    std: Array
    scatter: float
    scatter_std: float | None
    scatter_interval: tuple[float, float]
    p: float
    studies: int
    origin: float | None
    covariance: Array
    mixture: tuple[ScatterFit, ...]

    @property
    def degrees(self) -> int:
        """Degrees of freedom of the intervals."""
        return self.studies - len(self.terms)

    @property
    def intervals(self) -> Array:
        """95 % intervals of the coefficients, (q, 2)."""
        half = student_ppf(0.975, self.degrees) * self.std
        return np.stack([self.coefficients - half, self.coefficients + half], axis=1)

    def predict(self, at: float | str) -> Prediction:
        """Predict the parameter of a new study.

        Parameters
        ----------
        at
            Value of the condition there.

        Raises
        ------
        FrictrackError
            (usage) For a category that no study had.

        """
        if self.origin is not None:
            row = np.array([1.0, float(at)])
        elif at in self.terms:
            row = np.array([float(term == at) for term in self.terms])
        else:
            raise FrictrackError(f'expected one of {", ".join(self.terms)} but got "{at}"', usage=True)
        value, mean_std = float(row @ self.coefficients), float(np.sqrt(row @ self.covariance @ row))
        weight = np.array([one.weight for one in self.mixture])
        mean = np.array([row @ one.coefficients for one in self.mixture])
        std = np.array([np.sqrt(row @ one.covariance @ row + one.tau**2) for one in self.mixture])
        total = float(np.sqrt(weight @ (std**2 + (mean - weight @ mean) ** 2)))
        low, high = (_quantile_of_mixture(weight, mean, std, share) for share in (0.025, 0.975))
        return Prediction(value, mean_std, total, (low, high), self.unit)

    def summary(self) -> dict[str, Any]:
        """Return the trend as JSON."""
        rows = zip(self.terms, self.coefficients, self.std, self.intervals, strict=True)
        return {
            "name": self.name,
            "unit": self.unit,
            "coefficients": {
                term: {"value": float(value), "std": float(std), "interval": [float(end) for end in ends]}
                for term, value, std, ends in rows
            },
            "scatter": {"value": self.scatter, "std": self.scatter_std, "interval": list(self.scatter_interval)},
            "p": self.p,
            "studies": self.studies,
        }


@dataclass(frozen=True, eq=False)
class ScatterFit:
    """The fit of one parameter at a possible scatter `tau`, with its weight by the restricted likelihood."""

    tau: float
    weight: float
    coefficients: Array
    covariance: Array


@dataclass(frozen=True)
class Prediction:
    """A parameter that is expected in a new study.

    `mean_std` is the standard deviation of the trend itself; `std` and the 95 % `interval` include the scatter between
    studies.
    """

    value: float
    mean_std: float
    std: float
    interval: tuple[float, float]
    unit: str


@dataclass(frozen=True, eq=False)
class CovariateTrends:
    """The trends of all parameters over one condition.

    Attributes
    ----------
    condition
        Name of the condition.
    trends
        Trends by address of the parameter.
    load
        Normal load to which forces belong, N; None if it is not known.
    left_out
        Parameters that too few studies have, each with the reason.

    Examples
    --------
    >>> import frictrack as ft
    >>> laws = [ft.Prior(("drag.c",), (c,), ((1e-4,),), ("N s^2/m^2",), (False,)) for c in (0.1, 0.12, 0.2, 0.21)]
    >>> found = ft.trend(laws, ["steel", "steel", "brass", "brass"], "material")
    >>> found
    <CovariateTrends over material: drag.c>
    >>> [round(float(value), 3) for value in found["drag.c"].coefficients]
    [0.11, 0.205]

    """

    condition: str
    trends: Mapping[str, CovariateTrend]
    load: float | None
    left_out: Mapping[str, str]

    def __repr__(self) -> str:
        return f"<CovariateTrends over {self.condition}: {', '.join(self.trends)}>"

    def __getitem__(self, name: str) -> CovariateTrend:
        return self.trends[name]

    def to_dataframe(self) -> pd.DataFrame:
        """Return all coefficients as a pandas DataFrame, by parameter and term; the scatter is the term "scatter"."""
        import pandas as pd  # noqa: PLC0415 - half a second

        rows = {}
        for name, trend in self.trends.items():
            for term, value, std in zip(trend.terms, trend.coefficients, trend.std, strict=True):
                rows[name, term] = {"value": value, "std": std}
            rows[name, "scatter"] = {"value": trend.scatter, "std": trend.scatter_std}
        return pd.DataFrame.from_dict(rows, orient="index").astype(float).rename_axis(["parameter", "term"])

    def summary(self) -> dict[str, Any]:
        """Return the trends as JSON."""
        trends = [one.summary() for one in self.trends.values()]
        return {"condition": self.condition, "load": self.load, "trends": trends, "left_out": dict(self.left_out)}


def _quantile_of_mixture(weight: Array, mean: Array, std: Array, share: float) -> float:
    """Quantile of a mixture of normal distributions."""
    ends = (float(np.min(mean - 40 * std)), float(np.max(mean + 40 * std)))
    return float(brentq(lambda z: float(weight @ ndtr((z - mean) / std)) - share, *ends))
