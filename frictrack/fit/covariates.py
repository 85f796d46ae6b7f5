"""Fit how the parameters of a law depend on a condition that differs between studies: temperature, load, material.

It is a regression with random effects of studies (meta-regression). Study j of n has an estimate y_j with standard
deviation s_j, from its own fit, and the condition c_j:

    y_j = x_j beta + u_j + e_j,   u_j ~ N(0, tau^2),   e_j ~ N(0, s_j^2)

x_j holds 1 and c_j for a number, one column per category for a category; tau is the scatter between studies. It is
estimated by restricted maximum likelihood (REML), beta by weighted least squares. All parameters have the same x_j, so
that their correlations within a study hardly matter (a joint fit of parameters that correlate by -0.9 is not more
accurate). Standard deviations of beta are scaled by the weighted sum of squares of the parameter, or of all parameters
if that is larger, and intervals use Student's t with n less the number of coefficients (Knapp & Hartung), which keeps
their coverage in small campaigns. The interval of a new study averages over the restricted likelihood of tau, because
REML often gives zero for a small tau.

References
----------
Knapp, G. & Hartung, J. (2003). Improved tests for a random effects meta-regression. Stat. Med. 22, 2693-2710.
Viechtbauer, W. (2007). Confidence intervals for the amount of heterogeneity. Stat. Med. 26, 37-52.
Gelman, A. (2006). Prior distributions for variance parameters in hierarchical models. Bayesian Anal. 1, 515-534.

"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.optimize import brentq, minimize_scalar
from scipy.special import ndtr

from frictrack.base.distributions import chi2_ppf, f_sf, student_ppf
from frictrack.base.errors import UsageError
from frictrack.records import Array
from frictrack.settings.priors import Prior

if TYPE_CHECKING:
    import pandas as pd

__all__ = ["CovariateTrend", "CovariateTrends", "Prediction", "trend"]
MIN_DEGREES = 2  # studies more than coefficients
MAX_TAU_RATIO, N_TAUS = 5.0, 80  # possible values of tau, up to a multiple of the spread of the values
MIN_TAU_RATIO = 1e-6  # of tau to the spread of the values; less is zero


def trend(laws: Sequence[Any], at: Sequence[float | str], condition: str = "condition") -> CovariateTrends:
    """Fit how the parameters of a law depend on a condition that differs between studies.

    Forces that scale with the load are converted to the load of the first study.

    Parameters
    ----------
    laws : sequence of Fit or Prior
        One law per study.
    at : sequence of float or str
        The condition of every study: numbers, or names of categories.
    condition : str
        Name of the condition.

    Returns
    -------
    CovariateTrends
        Coefficients, scatter between studies, and predictions of every parameter.

    Raises
    ------
    FrictrackError
        (usage) If there are too few studies, or all have the same condition.

    Examples
    --------
    >>> import frictrack as ft
    >>> def law(force):
    ...     return ft.Prior(("coulomb.F_c",), (force,), ((0.0001,),), ("N",), (True,), load=3.0)
    >>> found = ft.trend([law(f) for f in (1.0, 1.09, 1.21, 1.3, 1.41)], [20, 30, 40, 50, 60], "temperature")
    >>> slope = found["coulomb.F_c"]
    >>> round(float(slope.coefficients[1]), 4), slope.p < 0.01
    (0.0103, True)
    >>> round(slope.predict(45).value, 2)
    1.25

    """
    priors = [one if isinstance(one, Prior) else one.to_prior() for one in laws]
    if len(priors) != len(at):
        raise UsageError(f"expected one value of {condition} per law but got {len(at)} for {len(priors)}")
    design = design_of(at, condition)
    load = priors[0].load if priors else None
    converted = [one.at_load(load) for one in priors]
    names = list(dict.fromkeys(name for one in converted for name in one.names))
    left_out = {name: reason for name in names if (reason := _too_few(name, converted, design))}
    kept = [name for name in names if name not in left_out]
    if not kept:
        raise UsageError(
            f"expected a parameter that at least {len(design.terms) + MIN_DEGREES} studies determine, in every "
            f"category, but got {len(priors)} studies of {condition}"
        )
    units = {name: unit for one in converted for name, unit in zip(one.names, one.units, strict=True)}
    fitted = fit_trends(converted, design, kept, units)
    return CovariateTrends(condition, fitted, load, left_out)


def _too_few(name: str, priors: Sequence[Prior], design: Design) -> str:
    """Return why a parameter has no trend; "" if it has one."""
    rows = np.array([row for one, row in zip(priors, design.rows, strict=True) if name in one.names])
    q = len(design.terms)
    if len(rows) < q + MIN_DEGREES:
        return f"only {len(rows)} studies determine it; {q + MIN_DEGREES} are needed"
    return "" if np.linalg.matrix_rank(rows) == q else "the studies that determine it do not have all conditions"


@dataclass(frozen=True, eq=False)
class Design:
    """The condition of n studies as q columns."""

    rows: Array  # (n, q)
    terms: tuple[str, ...]  # names of the columns
    origin: float | None  # of a number, at which it is centred
    back: Array  # (q, q), converts coefficients of the centred condition to those of the condition itself


def design_of(at: Sequence[float | str], condition: str) -> Design:
    """Return one row per study: 1 and the centred number, or one column per category."""
    if all(isinstance(one, str) for one in at) and len(set(at)) > 1:
        terms = tuple(dict.fromkeys(map(str, at)))
        return Design(np.array([[float(one == term) for term in terms] for one in at]), terms, None, np.eye(len(terms)))
    numbers = [one for one in at if isinstance(one, int | float | np.number) and np.isfinite(one)]
    if len(numbers) != len(at) or len(set(numbers)) < 2:
        raise UsageError(
            f"expected finite numbers or names of categories, at least two different, of {condition} but got {list(at)}"
        )
    values = np.array(numbers, dtype=np.float64)
    origin, scale = float(np.mean(values)), float(np.std(values))
    rows = np.column_stack([np.ones(len(values)), (values - origin) / scale])
    return Design(rows, ("at 0", "slope"), origin, np.array([[1.0, -origin / scale], [0.0, 1.0 / scale]]))


@dataclass(frozen=True, eq=False)
class ParameterEstimates:
    """One parameter in the n studies that determine it: values, variances s^2 and rows x (n, q)."""

    y: Array
    variance: Array
    x: Array

    @property
    def degrees(self) -> int:
        """Degrees of freedom."""
        return len(self.y) - self.x.shape[1]

    @property
    def max_tau(self) -> float:
        """The largest scatter that is considered."""
        return MAX_TAU_RATIO * max(float(np.std(self.y)), float(np.sqrt(np.mean(self.variance))))

    def at_scatter(self, tau: float) -> tuple[Array, Array, float]:
        """Return coefficients (q,), their covariance (q, q) and the weighted sum of squares at a given tau."""
        w = 1 / (self.variance + tau**2)
        covariance: Array = np.asarray(np.linalg.inv(self.x.T @ (w[:, None] * self.x)), dtype=np.float64)
        beta = covariance @ (self.x.T @ (w * self.y))
        return beta, covariance, float(np.sum(w * (self.y - self.x @ beta) ** 2))

    def deviance(self, tau: float) -> float:
        """Return minus twice the restricted log likelihood of a given tau."""
        _, covariance, squares = self.at_scatter(tau)
        return squares + float(np.sum(np.log(self.variance + tau**2)) - np.linalg.slogdet(covariance)[1])

    def scatter(self) -> float:
        """Return the tau of largest restricted likelihood."""
        taus = np.linspace(0.0, self.max_tau, N_TAUS)
        best = int(np.argmin([self.deviance(tau) for tau in taus]))
        around = (float(taus[max(best - 1, 0)]), float(taus[min(best + 1, N_TAUS - 1)]))
        search = minimize_scalar(self.deviance, bounds=around, method="bounded", options={"xatol": 1e-9 * around[1]})
        found = float(search.x)
        return found if self.deviance(found) < self.deviance(0.0) and found > MIN_TAU_RATIO * self.max_tau else 0.0

    def scatter_std(self, tau: float) -> float | None:
        """Return the standard deviation of tau by the expected information; None where tau is zero."""
        if not tau:
            return None
        w = 1 / (self.variance + tau**2)
        left = w[:, None] * self.x
        projector = np.diag(w) - left @ np.linalg.solve(self.x.T @ left, left.T)
        return float(np.sqrt(2 / np.sum(projector**2)) / (2 * tau))

    def scatter_interval(self) -> tuple[float, float]:
        """Return the 95 % interval of tau: where its sum of squares is likely for chi-squared (Viechtbauer)."""
        return self.scatter_of(chi2_ppf(0.975, self.degrees)), self.scatter_of(chi2_ppf(0.025, self.degrees))

    def scatter_of(self, squares: float) -> float:
        """Return the tau at which the weighted sum of squares, which falls with tau, has a value; 0 if it is less."""
        if self.at_scatter(0.0)[2] <= squares:
            return 0.0
        high = self.max_tau
        while self.at_scatter(high)[2] > squares:
            high *= 2
        return float(brentq(lambda tau: self.at_scatter(tau)[2] - squares, 0.0, high))

    def mixture(self, back: Array) -> tuple[ScatterFit, ...]:
        """Return fits at possible values of tau, equally likely before the data (Gelman)."""
        taus = np.linspace(0.0, self.max_tau, N_TAUS)
        deviance = np.array([self.deviance(tau) for tau in taus])
        weights = np.exp(-(deviance - deviance.min()) / 2)
        fits = [self.at_scatter(tau) for tau in taus]
        return tuple(
            ScatterFit(float(tau), float(weight), back @ beta, back @ covariance @ back.T)
            for tau, weight, (beta, covariance, _) in zip(taus, weights / weights.sum(), fits, strict=True)
        )


def fit_trends(
    priors: Sequence[Prior], design: Design, names: Sequence[str], units: Mapping[str, str]
) -> dict[str, CovariateTrend]:
    """Fit the trend of every parameter, in its unit."""
    seen = {name: _estimates(priors, design, name) for name in names}
    scatter = {name: one.scatter() for name, one in seen.items()}
    squares = sum(one.at_scatter(scatter[name])[2] for name, one in seen.items())
    pooled = squares / sum(one.degrees for one in seen.values())
    return {name: _trend(name, units[name], one, scatter[name], design, pooled) for name, one in seen.items()}


def _estimates(priors: Sequence[Prior], design: Design, name: str) -> ParameterEstimates:
    """The values of one parameter in the studies that determine it."""
    seen = [(p, p.names.index(name), row) for p, row in zip(priors, design.rows, strict=True) if name in p.names]
    y = np.array([p.values[i] for p, i, _ in seen])
    variance = np.array([p.covariance[i][i] for p, i, _ in seen])
    return ParameterEstimates(y, variance, np.array([row for *_, row in seen]))


def _trend(name: str, unit: str, seen: ParameterEstimates, tau: float, design: Design, pooled: float) -> CovariateTrend:
    """The trend of one parameter; `pooled` is the weighted sum of squares per degree of freedom of all parameters."""
    beta, covariance, squares = seen.at_scatter(tau)
    covariance = max(squares / seen.degrees, pooled) * covariance  # Knapp & Hartung
    on_condition = design.back @ covariance @ design.back.T
    return CovariateTrend(
        name=name,
        unit=unit,
        terms=design.terms,
        coefficients=design.back @ beta,
        std=np.sqrt(np.diag(on_condition)),
        scatter=tau,
        scatter_std=seen.scatter_std(tau),
        scatter_interval=seen.scatter_interval(),
        p=_p_of_no_dependence(beta, covariance, seen.degrees, is_number=design.origin is not None),
        studies=len(seen.y),
        origin=design.origin,
        covariance=on_condition,
        mixture=seen.mixture(design.back),
    )


def _p_of_no_dependence(beta: Array, covariance: Array, degrees: int, *, is_number: bool) -> float:
    """p-value by the F test: the slope is zero, or all categories are alike."""
    contrast = np.eye(len(beta))[1:] if is_number else np.eye(len(beta))[1:] - np.eye(len(beta))[:1]
    seen = contrast @ beta
    size = float(seen @ np.linalg.solve(contrast @ covariance @ contrast.T, seen)) / len(contrast)
    return float(f_sf(size, len(contrast), degrees))


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
            raise UsageError(f'expected one of {", ".join(self.terms)} but got "{at}"')
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
