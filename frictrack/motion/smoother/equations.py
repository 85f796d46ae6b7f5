"""The equations of a structural smoother: a trend, lines and noise (Harvey 1989, Forecasting, ch. 4).

    minimise    sum_i w_i (y_i - x_i - sum_k z_ki)^2  +  sum_j lambda_j (D x)_j^2  +  sum_k mu_k sum_j (D_k z_k)_j^2

D is the fourth difference; D_k = 1 - 2 cos(omega_k) B + B^2 is the difference that a sine of frequency omega_k obeys.
What a difference maps to zero is not penalised: cubics, and sines of any amplitude and phase. Without lines and with
one lambda this is the smoother of Whittaker (1923) and Henderson (1924). Away from the ends it equals the zero-phase
Butterworth filter of order 4, |H(f)| = 1 / (1 + lambda (2 sin(pi f / fs))^8). Unlike that filter it needs no padding,
has no end transient and treats a missing frame as a weight of zero. It is also the posterior mean of a signal whose
differences are white noise, which Kalman's filter and the smoother of Rauch, Tung & Striebel (1965) find by recursion.
Hence it has a likelihood (restricted maximum likelihood; Wahba 1985, Ann. Stat. 13) and a covariance. Noise that is
correlated from frame to frame is one more component c with the difference c_j - rho c_(j-1), not part of the signal
(Harvey 1989, ch. 3).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
import scipy
from numpy.typing import NDArray

from frictrack.motion.smoother import selected_inverse
from frictrack.motion.smoother.smoother_data import (
    NO_LINES,
    TREND_ORDER,
    LineParameters,
    SmootherData,
    weighted_columns,
)
from frictrack.records import Array

FOURTH_DIFFERENCE, SECOND_DIFFERENCE = np.array([1.0, -4.0, 6.0, -4.0, 1.0]), np.array([1.0, -2.0, 1.0])
BLOCK_FRAMES = 8  # frames per block of the covariance
LOG_PENALTY_STEP = 0.01  # of the log of all penalties, for the derivative that separates noise from lost signal
MISSING_WEIGHT = 1e-10  # of a missing frame in the covariance: keeps that of an extrapolation finite
Index = NDArray[np.int64]


class EquationLayout:
    """Positions of all unknowns in the banded equations of n frames and K lines.

    The equations are the augmented ones, [A, P'; P, -1] [u; s] = [W y; p], with the weighted differences P and their
    expected values p. Their condition number is the square root of that of A + P'P, which is large for a low cut-off.
    The unknowns of one frame are adjacent.
    """

    def __init__(self, n: int, lines: int, has_sensor: bool, has_colour: bool) -> None:
        self.n, self.k = n, lines
        # Components and order of each difference.
        self.terms: list[tuple[tuple[int, ...], int]] = [((0,), TREND_ORDER), *[((k,), 2) for k in range(1, lines + 1)]]
        if has_colour:
            self.terms.append(((lines + 1,), 1))
        if has_sensor:
            self.terms.append((tuple(range(lines + 1)), 2))
        n_components = 1 + lines + has_colour  # components of the positions
        keys = [np.arange(n) + 0.01 * k for k in range(n_components)]
        keys += [np.arange(n - d) + d / 2 + 0.3 + 0.01 * k for k, (_, d) in enumerate(self.terms)]
        order = np.argsort(np.concatenate(keys), kind="stable")
        place = np.empty(len(order), dtype=np.int64)
        place[order] = np.arange(len(order))
        found = np.split(place, np.cumsum([len(k) for k in keys])[:-1])
        self.components, self.multiplier = found[:n_components], found[n_components:]
        self.frame = self.components[: 1 + lines]  # components of the signal
        self.size, self.group = len(order), n_components + len(self.terms)
        steps = [
            int(np.abs(m - self.components[k][i : len(m) + i]).max())
            for (components, d), m in zip(self.terms, self.multiplier, strict=True)
            for k in components
            for i in range(d + 1)
        ]
        self.band = max([*steps, n_components - 1])
        rows, columns = np.meshgrid(np.arange(n_components), np.arange(n_components), indexing="ij")
        self._of_weights = self._place(np.array(self.components)[rows], np.array(self.components)[columns])
        self._of_terms = [self._places_of_term(*term) for term in zip(self.terms, self.multiplier, strict=True)]
        self._constant = np.zeros(((3 * self.band + 1) * self.size,))
        self._constant[self._place(m := np.concatenate(self.multiplier), m)] = -1.0

    def _place(self, row: Index, column: Index) -> Index:
        """Positions of matrix elements in band storage, column after column."""
        return (3 * self.band + 1) * column + 2 * self.band + row - column

    def _places_of_term(self, term: tuple[tuple[int, ...], int], m: Index) -> Index:
        """Positions of the coefficients of one difference in rows and in columns, (2, components, order + 1, m)."""
        components, order = term
        x = np.array([[self.components[k][i : len(m) + i] for i in range(order + 1)] for k in components])
        rows = np.broadcast_to(m, x.shape)
        return np.array([self._place(rows, x), self._place(x, rows)])

    @property
    def block(self) -> int:
        """Unknowns per block; the last block must not be short, or trend and line would be degenerate in it."""
        sizes = range(BLOCK_FRAMES * self.group, 2 * BLOCK_FRAMES * self.group)
        return next(b for b in sizes if self.size % b == 0 or self.size % b >= b // 2)

    def equations(self, data: SmootherData, w: Array, lam: Array, lines: LineParameters) -> Array:
        """Equations in LAPACK band storage (3 band + 1, size) for weights w (n,); the top rows are for fill-in."""
        colour = data.colour
        flat = self._constant.copy()
        flat[self._of_weights] = w
        if colour:
            first = self.components[-1][:1]
            flat[self._place(first, first)] += 1.0 / colour.share
        for places, (strength, difference) in zip(self._of_terms, _differences(data, lam, lines), strict=True):
            flat[places] = difference[:, None] * strength
        return flat.reshape((3 * self.band + 1, self.size), order="F")


def _differences(data: SmootherData, lam: Array, lines: LineParameters) -> Iterator[tuple[Array | float, Array]]:
    """Yield the strength of each difference and its coefficients."""
    yield np.sqrt(lam), FOURTH_DIFFERENCE
    for omega, mu in zip(lines.omega, lines.mu, strict=True):
        yield np.sqrt(mu), np.array([1.0, -2.0 * np.cos(omega), 1.0])
    if data.colour:
        yield data.colour.shocks**-0.5, np.array([-data.colour.correlation, 1.0])
    if data.second_difference_weights is not None:
        yield np.sqrt(data.second_difference_weights), SECOND_DIFFERENCE


@lru_cache(maxsize=64)
def equation_layout(n: int, lines: int, has_sensor: bool, has_colour: bool) -> EquationLayout:
    """Layout for n frames, cached."""
    return EquationLayout(n, lines, has_sensor, has_colour)


@dataclass(frozen=True, eq=False)
class FactoredSmoother:
    """Equations of a smoother, factored at the first solution.

    Attributes
    ----------
    layout
        Positions of the unknowns.
    data
        Measurements of n frames.
    lam
        Penalties of the trend, (n - 4,).
    lines
        Frequencies and penalties of the lines.

    """

    layout: EquationLayout
    data: SmootherData
    lam: Array
    lines: LineParameters

    @cached_property
    def _lu(self) -> tuple[Array, Array]:
        """Factors in LAPACK band storage, and pivots."""
        s = self.layout
        equations = s.equations(self.data, self.data.precision, self.lam, self.lines)
        lu, pivots, _ = scipy.linalg.lapack.dgbtrf(equations, s.band, s.band, overwrite_ab=1)
        return lu, pivots

    def _solve(self, frames: Array, components: list[Index], sensor: Array | None = None) -> Array:
        """Solve for all unknowns (size, ...): right-hand side (n, ...) of components, (n - 2, ...) of the sensor."""
        s = self.layout
        full = np.zeros((s.size, *frames.shape[1:]))
        for row in components:
            full[row] = frames
        if sensor is not None:
            full[s.multiplier[-1]] = sensor
        out: Array = scipy.linalg.lapack.dgbtrs(self._lu[0], s.band, s.band, full, self._lu[1])[0]
        return out

    def signal(self, unknowns: Array) -> Array:
        """Sum of trend and lines, (n, ...)."""
        out: Array = np.sum([unknowns[row] for row in self.layout.frame], axis=0)
        return out

    def unknowns(self) -> Array:
        """Solution for the data, (size,)."""
        d = self.data
        if d.second_difference_weights is None or d.second_differences is None:
            return self._solve(d.precision * d.y, self.layout.components)
        sensor = np.sqrt(d.second_difference_weights) * d.second_differences
        return self._solve(d.precision * d.y, self.layout.components, sensor)

    def residual(self, unknowns: Array) -> Array:
        """Data minus signal and correlated noise, (n,); 0 in missing frames."""
        explained = np.sum([unknowns[row] for row in self.layout.components], axis=0)
        return np.where(self.data.w > 0, self.data.y - explained, 0.0)

    def shocks(self) -> Array:
        """Weighted fourth differences of the trend, (n - 4,): its innovations."""
        return np.asarray(self.unknowns()[self.layout.multiplier[0]])

    def smooth(self, y: Array) -> Array:
        """Smooth columns with the weights of the data, without the sensor.

        Parameters
        ----------
        y
            Columns, (n, ...); values in missing frames do not count.

        Returns
        -------
        Array
            Trend plus lines, (n, ...).

        """
        return self.signal(self.unknowns_of(y))

    def unknowns_of(self, y: Array) -> Array:
        """Solution (size, ...) for other positions y (n, ...), without the sensor."""
        return self._solve(weighted_columns(self.data.precision, y), self.layout.components)

    def posterior_covariance_times(self, frames: Array) -> Array:
        """Posterior covariance of the signal for unit noise times columns (n, ...)."""
        return self.signal(self._solve(frames, self.layout.frame))

    def covariance(self, rows: Index) -> Array:
        """Posterior covariance of the signal for unit noise.

        Parameters
        ----------
        rows
            Frames, (m,).

        Returns
        -------
        Array
            Covariance of all frames with those frames, (n, m).

        """
        unit = np.zeros((self.layout.n, len(rows)))
        unit[rows, np.arange(len(rows))] = 1.0
        return self.posterior_covariance_times(unit)

    def restricted_likelihood(self) -> tuple[float, float, Array]:
        """Compute the restricted likelihood (REML) of the data.

        Each of the two amplitudes of a line has a prior of the size of the noise, so the result does not depend on the
        unit.

        Returns
        -------
        tuple
            Twice the negative log-likelihood, the noise variance at its maximum, and all unknowns (size,).

        References
        ----------
        Wahba 1985, Ann. Stat. 13, 1378-1402.

        """
        s, d, lines = self.layout, self.data, self.lines
        unknowns = self.unknowns()
        residual = d.precision @ self.residual(unknowns) ** 2 + sum(
            float(np.sum(unknowns[m] ** 2)) for m in s.multiplier
        )
        if d.colour:
            residual += unknowns[s.components[-1][0]] ** 2 / d.colour.share
        degrees = d.count - TREND_ORDER - 2 * s.k
        variance = max(float(residual), np.finfo(float).tiny) / degrees
        logdet = float(np.sum(np.log(np.abs(self._lu[0][2 * s.band]))))
        penalties = float(np.sum(np.log(self.lam))) + (s.n - 2) * float(np.sum(np.log(lines.mu)))
        amplitudes = 2.0 * float(np.sum(np.log(np.sin(lines.omega))))
        noise = d.colour.log_likelihood_cost(int(np.sum(d.w > 0)), s.n) if d.colour else 0.0
        return (d.count - TREND_ORDER) * np.log(variance) + logdet - penalties + amplitudes + noise, variance, unknowns

    def variances(self, start: Index, stencils: Array) -> Array:
        """Posterior variance of linear combinations of neighbouring frames of the signal, for unit noise.

        Parameters
        ----------
        start
            First frame of each combination, (n,).
        stencils
            Weights, (..., n, m) with m at most `BLOCK_FRAMES`.

        Returns
        -------
        Array
            Variances, (..., n).

        """
        return variances_of([self], start, stencils)[0]

    def noise_variances(self, start: Index, stencils: Array) -> Array:
        """The part of those variances that is noise let through, not signal removed; arguments as in `variances`."""
        return self.posterior_and_noise_variance(start, stencils)[1]

    def posterior_and_noise_variance(self, start: Index, stencils: Array) -> tuple[Array, Array]:
        """Posterior variances, and the part of them that is noise let through.

        With V = (A + P'P)^-1 for all penalties times s, the noise that passes is V W V = V + s dV/ds.

        Parameters
        ----------
        start, stencils
            As in `variances`.

        Returns
        -------
        tuple of arrays
            Both variances for unit noise, (..., n) each.

        """
        neighbours = (self._stiffer(np.exp(d)) for d in (LOG_PENALTY_STEP, -LOG_PENALTY_STEP))
        posterior, up, down = variances_of([self, *neighbours], start, stencils)
        rounding = np.finfo(float).eps * np.sum(stencils**2, axis=-1)
        return posterior, np.asarray(np.maximum(posterior + (up - down) / (2.0 * LOG_PENALTY_STEP), rounding))

    def _stiffer(self, factor: float) -> FactoredSmoother:
        return factor_smoother(self.data, self.lam * factor, LineParameters(self.lines.omega, self.lines.mu * factor))

    def equations(self) -> Array:
        """Equations in bands (2 band + 1, size), with a small weight for missing frames."""
        w = np.maximum(self.data.precision, MISSING_WEIGHT)
        return self.layout.equations(self.data, w, self.lam, self.lines)[self.layout.band :]


def variances_of(factors: Sequence[FactoredSmoother], start: Index, stencils: Array) -> Array:
    """Posterior variances of several smoothers of the same frames at once.

    Parameters
    ----------
    factors
        F smoothers with the same layout.
    start, stencils
        As in `FactoredSmoother.variances`.

    Returns
    -------
    Array
        Variances for unit noise, (F, ..., n).

    """
    s = factors[0].layout
    m = stencils.shape[-1]
    place = np.concatenate([row[start[:, None] + np.arange(m)] for row in s.frame], axis=1)
    weights = np.concatenate([stencils.reshape(-1, *stencils.shape[-2:])] * len(s.frame), axis=-1)
    found = selected_inverse.selected_variances(np.stack([f.equations() for f in factors]), s.block, place, weights)
    rounding = np.finfo(float).eps * np.sum(stencils**2, axis=-1)  # a stiff cubic is that accurate
    return np.asarray(np.maximum(found.reshape(len(factors), *stencils.shape[:-1]), rounding))


def factor_smoother(data: SmootherData, lam: Array, lines: LineParameters = NO_LINES) -> FactoredSmoother:
    """Set up a smoother.

    Parameters
    ----------
    data
        Measurements of n frames.
    lam
        Penalties of the trend, (n - 4,).
    lines
        Frequencies and penalties of the lines.

    Returns
    -------
    FactoredSmoother
        The equations, factored at the first solution.

    """
    layout = equation_layout(
        len(data.w), len(lines.omega), data.second_difference_weights is not None, data.colour is not None
    )
    return FactoredSmoother(layout, data, lam, lines)
