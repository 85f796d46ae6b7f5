"""Forecast the evidence of an experiment that has not been made: its expected value and its 95 % interval.

The evidence is the chi-squared r'r of the residual r that the rival leaves. The prediction of the true explanation is
uncertain: its parameters have the covariance of the present fit, and the friction level scatters from run to run. A
change u of the parameters changes the planned run by J u. The rival can fit a part of J u; the rest is added to r.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from frictrack.fit.least_squares import Solution
from frictrack.records import Array

QUANTILES_95 = (0.025, 0.975)
N_DEVIATES = 10_000  # of every quantity that is uncertain
MIN_SINGULAR_VALUE = 1e-10  # relative, of a direction in which a rival can follow


@dataclass(frozen=True)
class EvidenceForecast:
    """The evidence that an experiment is expected to give if one explanation is true.

    With z standard normal, the evidence is ``expected + 2 slopes'z + curvatures'z^2``. The noise of the new data adds
    a normal deviation, whose variance is four times the evidence.

    Parameters
    ----------
    expected
        Difference of BIC if the fitted values are true.
    slopes
        Half of its derivative with respect to each component of z, (k,).
    curvatures
        Half of its second derivative, (k,).
    open_above
        Whether the size of the effect is unknown: `expected` is computed for a small one.

    Examples
    --------
    >>> low, high = EvidenceForecast(100.0).interval()
    >>> round(low), round(high)
    (61, 139)
    >>> low, high = EvidenceForecast.of_size(100.0, 0.1).interval()
    >>> round(low), round(high)
    (49, 159)

    """

    expected: float
    slopes: Array = field(default_factory=lambda: np.zeros(0))
    curvatures: Array = field(default_factory=lambda: np.zeros(0))
    open_above: bool = False

    @classmethod
    def of_size(cls, expected: float, relative_std: float) -> EvidenceForecast:
        """Forecast of evidence that grows with the square of a size, known to `relative_std` (infinite: unknown)."""
        if not np.isfinite(relative_std):
            return cls(expected, open_above=True)
        mean = max(expected, 0.0)
        return cls(expected, np.array([mean * relative_std]), np.array([mean * relative_std**2]))

    def shifted(self, by: float) -> EvidenceForecast:
        """Return the forecast with a known amount of evidence added."""
        return replace(self, expected=self.expected + by)

    def interval(self) -> tuple[float, float | None]:
        """95 % interval, from a fixed sample of z and of the noise.

        It includes the interval that the noise alone gives at the fitted values, because a parameter may be too
        uncertain for a linear model of its effect.

        Returns
        -------
        low : float
        high : float or None
            None if the size of the effect is unknown.

        """
        deviates = np.random.default_rng(0).standard_normal((N_DEVIATES, len(self.slopes) + 1))
        noise, z = deviates[:, 0], deviates[:, 1:]
        without_noise = np.array([np.full(N_DEVIATES, self.expected), self.expected + self._change(z)])
        evidence = without_noise + 2 * np.sqrt(np.maximum(without_noise, 0.0)) * noise
        low, high = np.quantile(evidence, QUANTILES_95, axis=1)
        return float(low.min()), None if self.open_above else float(high.max())

    def _change(self, z: Array) -> Array:
        """Change of the evidence if the uncertain quantities deviate by z (n, k) standard deviations."""
        return np.asarray(2 * z @ self.slopes + z**2 @ self.curvatures)


def forecast_directions(rival: Solution, planned: Array) -> tuple[Array, Array]:
    """Compute how the evidence of a planned run changes with the uncertain quantities of its prediction.

    Parameters
    ----------
    rival
        The rival, fitted to all runs; the planned run is its last response.
    planned
        Whitened change (n, k) of the planned run for one standard deviation of each uncertain quantity.

    Returns
    -------
    slopes, curvatures : ndarray, shape (k,)

    """
    last, count = rival.responses[-1], len(rival.p)
    rows, right = replace(rival, responses=rival.responses[:-1]).penalised_rows_and_residual
    jac = np.vstack([np.zeros((len(last.jac), count)), rows])
    jac[: len(last.jac), last.active] = last.jac
    jac = jac[:, ~rival.held]
    left = np.zeros((len(jac), planned.shape[1] + 1))
    left[: len(planned), :-1] = planned - last.q @ (last.q.T @ planned)  # its start is free
    left[:, -1] = np.concatenate([last.r, right])
    norm = np.linalg.norm(jac, axis=0)
    u, s, _ = np.linalg.svd(jac / np.where(norm > 0, norm, 1.0), full_matrices=False)
    u = u[:, s > MIN_SINGULAR_VALUE * s[0]]
    for _ in range(2):  # once more, since what is left is far smaller than what was there
        left -= u @ (u.T @ left)
    moved, residual = left[:, :-1], left[:, -1]
    curvatures, axes = np.linalg.eigh(moved.T @ moved)
    return axes.T @ (moved.T @ residual), np.maximum(curvatures, 0.0)
