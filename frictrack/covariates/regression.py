"""Fit a multivariate regression with random effects of studies (meta-regression).

Study j of n has estimates y_j (K,) with covariance S_j (K, K), from its own fit, and the condition c_j:

    y_j = X_j beta + u_j + e_j,   u_j ~ N(0, diag(tau^2)),   e_j ~ N(0, S_j)

X_j holds 1 and c_j for a number, one column per category for a category; tau_k is the scatter of parameter k between
studies. The tau are estimated by restricted maximum likelihood (REML) with all covariances, beta by generalised least
squares. Standard deviations of beta are scaled by the weighted sum of squares of the parameter, or of all parameters if
that is larger, and intervals use Student's t with n less the number of coefficients (Knapp & Hartung), which keeps
their coverage in small campaigns. The interval of a new study averages over the restricted likelihood of tau, because
REML often gives zero for a small tau.

References
----------
Gasparrini, A., Armstrong, B. & Kenward, M. G. (2012). Multivariate meta-analysis. Stat. Med. 31, 3821-3839.
Knapp, G. & Hartung, J. (2003). Improved tests for a random effects meta-regression. Stat. Med. 22, 2693-2710.
Viechtbauer, W. (2007). Confidence intervals for the amount of heterogeneity. Stat. Med. 26, 37-52.

"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import brentq, minimize
from scipy.stats import chi2, f

from frictrack.covariates.results import CovariateTrend, ScatterFit
from frictrack.errors import FrictrackError
from frictrack.priors import Prior
from frictrack.records import Array

MAX_TAU_RATIO, N_TAUS = 5.0, 80  # possible values of tau, up to a multiple of the spread of the values
MAX_LOG_RATIO = 8.0  # of the scatter to the spread of the values, for the search
START_RATIOS = (0.02, 0.5)  # scatter over spread at which the search starts


@dataclass(frozen=True, eq=False)
class Design:
    """The condition: rows (n, q) per study, names of the columns, and the origin of a number."""

    rows: Array
    terms: tuple[str, ...]
    origin: float | None
    scale: float = 1.0


def design_of(at: Sequence[float | str], condition: str) -> Design:
    """Return one row per study: 1 and the centred number, or one column per category."""
    if all(isinstance(one, str) for one in at) and len(set(at)) > 1:
        terms = tuple(dict.fromkeys(map(str, at)))
        return Design(np.array([[float(one == term) for term in terms] for one in at]), terms, None)
    numbers = [one for one in at if isinstance(one, int | float | np.number) and np.isfinite(one)]
    if len(numbers) != len(at) or len(set(numbers)) < 2:
        raise FrictrackError(
            f"expected finite numbers or names of categories, at least two different, of {condition} but got "
            f"{list(at)}",
            usage=True,
        )
    values = np.array(numbers, dtype=np.float64)
    origin, scale = float(np.mean(values)), float(np.std(values))
    rows = np.column_stack([np.ones(len(values)), (values - origin) / scale])
    return Design(rows, ("at 0", "slope"), origin, scale)


class Regression:
    """Multivariate random-effects regression of the parameters `names` of several studies."""

    def __init__(self, priors: Sequence[Prior], design: Design, names: Sequence[str]) -> None:
        self.design, self.names = design, list(names)
        q, k = len(design.terms), len(names)
        self.unit = np.array([self._spread(priors, name) for name in names])  # values are fitted in these units
        self.blocks: list[tuple[Array, Array, Array, Array]] = []  # y, X, S, parameters of every study
        for one, row in zip(priors, design.rows, strict=True):
            which = [i for i, name in enumerate(names) if name in one.names]
            at = [one.names.index(names[i]) for i in which]
            if not which:
                continue
            x = np.zeros((len(which), k * q))
            for r, i in enumerate(which):
                x[r, i * q : (i + 1) * q] = row
            unit = self.unit[which]
            covariance = np.array(one.covariance)[np.ix_(at, at)] / unit / unit[:, None]
            self.blocks.append((np.array(one.values)[at] / unit, x, covariance, np.array(which)))
        self.tau = self._scatter()
        self.beta, self.covariance = self._coefficients(self.tau)

    @staticmethod
    def _spread(priors: Sequence[Prior], name: str) -> float:
        """Standard deviation of a parameter over the studies; its own where all are alike."""
        found = [(p.values[p.names.index(name)], p.std[p.names.index(name)]) for p in priors if name in p.names]
        return float(np.std([value for value, _ in found])) or float(np.mean([std for _, std in found]))

    def _weighted(self, tau: Array) -> Iterator[tuple[Array, Array, float]]:
        """Yield whitened values and rows of every study, and the log determinant of its covariance."""
        for y, x, s, which in self.blocks:
            factor = np.linalg.cholesky(s + np.diag(tau[which] ** 2))
            both = np.linalg.solve(factor, np.column_stack([y, x]))
            yield both[:, 0], both[:, 1:], 2.0 * float(np.sum(np.log(np.diag(factor))))

    def _coefficients(self, tau: Array) -> tuple[Array, Array]:
        """Generalised least squares at a given scatter: coefficients (k q,) and covariance."""
        parts = list(self._weighted(tau))
        x, y = np.vstack([b for _, b, _ in parts]), np.concatenate([a for a, _, _ in parts])
        covariance = np.linalg.inv(x.T @ x)
        return np.asarray(covariance @ (x.T @ y)), np.asarray(covariance)

    def _deviance(self, tau: Array) -> float:
        """Minus twice the restricted log likelihood."""
        parts = list(self._weighted(tau))
        x, y = np.vstack([b for _, b, _ in parts]), np.concatenate([a for a, _, _ in parts])
        normal = x.T @ x
        left = y - x @ np.linalg.solve(normal, x.T @ y)
        return float(left @ left) + sum(d for _, _, d in parts) + float(np.linalg.slogdet(normal)[1])

    def _scatter(self) -> Array:
        """The scatter tau (k,) of largest restricted likelihood, in units of the spread."""
        bounds = [(0.0, float(np.exp(MAX_LOG_RATIO)))] * len(self.names)
        starts = [np.full(len(self.names), ratio) for ratio in START_RATIOS]
        found = [minimize(self._deviance, start, bounds=bounds, method="L-BFGS-B") for start in starts]
        return np.asarray(min(found, key=lambda one: float(one.fun)).x, dtype=np.float64)

    def _marginal(self, k: int) -> tuple[Array, Array, Array]:
        """Values (n,), rows (n, q) and variances (n,) of one parameter."""
        q = len(self.design.terms)
        own = [(y, x, s, int(np.flatnonzero(w == k)[0])) for y, x, s, w in self.blocks if k in w]
        return (
            np.array([y[i] for y, _, _, i in own]),
            np.array([x[i, k * q : (k + 1) * q] for _, x, _, i in own]),
            np.array([s[i, i] for _, _, s, i in own]),
        )

    def _pooled_squares(self) -> float:
        """Weighted sum of squares of all parameters per degree of freedom."""
        total = sum(float(np.sum((y - x @ self.beta) ** 2)) for y, x, _ in self._weighted(self.tau))
        return total / (sum(len(y) for y, *_ in self.blocks) - len(self.beta))

    def trends(self, units: Mapping[str, str]) -> Iterator[tuple[str, CovariateTrend]]:
        """Yield the trend of every parameter, in its unit."""
        q = len(self.design.terms)
        for k, name in enumerate(self.names):
            own = slice(k * q, (k + 1) * q)
            y, x, s = self._marginal(k)
            left = y - x @ self.beta[own]
            degrees = len(y) - q
            own_squares = float(np.sum(left**2 / (s + self.tau[k] ** 2))) / degrees  # Knapp & Hartung
            factor = max(own_squares, self._pooled_squares())
            beta, covariance = self.beta[own], factor * self.covariance[own, own]
            p = _p_of_no_dependence(beta, covariance, degrees, is_number=self.design.origin is not None)
            back = self._back() * self.unit[k]
            covariance = back @ covariance @ back.T
            std = _scatter_std(x, s, float(self.tau[k]))
            low, high = _scatter_interval(y, x, s)
            yield (
                name,
                CovariateTrend(
                    name=name,
                    unit=units[name],
                    terms=self.design.terms,
                    coefficients=back @ beta,
                    std=np.sqrt(np.diag(covariance)),
                    scatter=float(self.tau[k] * self.unit[k]),
                    scatter_std=None if std is None else std * float(self.unit[k]),
                    scatter_interval=(low * float(self.unit[k]), high * float(self.unit[k])),
                    p=p,
                    studies=len(y),
                    origin=self.design.origin,
                    covariance=covariance,
                    mixture=tuple(_mixture(y, x, s, back, float(self.unit[k]))),
                ),
            )

    def _back(self) -> Array:
        """Matrix from coefficients of the centred condition to those of the condition itself."""
        if self.design.origin is None:
            return np.eye(len(self.design.terms))
        return np.array([[1.0, -self.design.origin / self.design.scale], [0.0, 1.0 / self.design.scale]])


def _p_of_no_dependence(beta: Array, covariance: Array, degrees: int, *, is_number: bool) -> float:
    """p-value by the F test: the slope is zero, or all categories are alike."""
    contrast = np.eye(len(beta))[1:] if is_number else np.eye(len(beta))[1:] - np.eye(len(beta))[:1]
    seen = contrast @ beta
    size = float(seen @ np.linalg.solve(contrast @ covariance @ contrast.T, seen)) / len(contrast)
    return float(f.sf(size, len(contrast), degrees))


def _mixture(y: Array, x: Array, s: Array, back: Array, unit: float) -> Iterator[ScatterFit]:
    """Yield fits at possible values of tau, equally likely before the data (Gelman 2006, Bayesian Anal. 1, 515)."""
    taus = np.linspace(0.0, MAX_TAU_RATIO * max(float(np.std(y)), float(np.sqrt(np.mean(s)))), N_TAUS)
    deviance, fits = np.zeros(N_TAUS), []
    for i, tau in enumerate(taus):
        w = 1 / (s + tau**2)
        covariance = np.linalg.inv(x.T @ (w[:, None] * x))
        beta = covariance @ (x.T @ (w * y))
        left = y - x @ beta
        deviance[i] = np.sum(w * left**2) - np.sum(np.log(w)) - np.linalg.slogdet(covariance)[1]
        fits.append((back @ beta, back @ covariance @ back.T))
    weights = np.exp(-(deviance - deviance.min()) / 2)
    for tau, weight, (beta, covariance) in zip(taus, weights / weights.sum(), fits, strict=True):
        yield ScatterFit(float(tau * unit), float(weight), beta, covariance)


def _scatter_std(x: Array, s: Array, tau: float) -> float | None:
    """Standard deviation of tau by the expected information of the restricted likelihood; None where tau is zero."""
    if tau < 1e-6:
        return None
    w = np.diag(1 / (s + tau**2))
    projector = w - w @ x @ np.linalg.solve(x.T @ w @ x, x.T @ w)
    return float(np.sqrt(2 / np.sum(projector**2)) / (2 * tau))


def _scatter_interval(y: Array, x: Array, s: Array) -> tuple[float, float]:
    """95 % interval of tau: where the weighted sum of squares is likely for chi-squared (Viechtbauer)."""

    def squares(tau: float) -> float:
        w = 1 / (s + tau**2)
        left = y - x @ np.linalg.solve(x.T @ (w[:, None] * x), x.T @ (w * y))
        return float(np.sum(w * left**2))

    degrees = len(y) - x.shape[1]
    return _crossing(squares, float(chi2.ppf(0.975, degrees))), _crossing(squares, float(chi2.ppf(0.025, degrees)))


def _crossing(falling: Callable[[float], float], level: float) -> float:
    """Where a falling function of a number above zero reaches a level; 0 if it starts below."""
    if falling(0.0) <= level:
        return 0.0
    high = 1.0
    while falling(high) > level and high < 1e6:
        high *= 2
    return float(brentq(lambda tau: falling(tau) - level, 0.0, high))
