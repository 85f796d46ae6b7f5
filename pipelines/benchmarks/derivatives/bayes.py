"""Reference methods that state standard deviations: a Kalman smoother and a Gaussian process."""

from __future__ import annotations

import math
from itertools import product

import numpy as np
from scipy.linalg import cho_solve, cholesky, solve_triangular
from scipy.optimize import minimize

from .estimate import Array, Estimate, Method, lowest

START_VARIANCES = 1e10 * 100.0 ** np.arange(4)  # variances of the first state, in units of noise and record
RATIOS = 1e-4, 1e22  # process noise over measurement noise, in units of the record, searched
LENGTHS, SIZES = (0.01, 0.02, 0.04, 0.08, 0.16, 0.32), (1e2, 1e4, 1e6, 1e8, 1e10)  # of the records, of the noise


class Chain:
    """x and its n - 1 derivatives, the n-th is white noise; time in units of the record, variances of the noise."""

    def __init__(self, order: int, ratio: float, interval: float) -> None:
        i, j = np.indices((order, order))
        factorial = np.vectorize(math.factorial)
        self.step = np.where(j >= i, interval ** np.maximum(j - i, 0) / factorial(np.maximum(j - i, 0)), 0.0)
        power = 2 * order - 1 - i - j
        size = power * factorial(order - 1 - i) * factorial(order - 1 - j)
        self.process = ratio * interval**power / size
        self.order = order

    def forward(self, y: Array) -> tuple[float, float, list[tuple[Array, Array, Array, Array]]]:
        """Twice the negative log-likelihood, the noise variance that goes with it, predicted and filtered states.

        The first frames, which a vague start fits whatever they are, do not count.
        """
        mean, spread = np.zeros(self.order), np.diag(START_VARIANCES[: self.order])
        squares, logs, kept = 0.0, 0.0, []
        for k, value in enumerate(y):
            if k:
                mean, spread = self.step @ mean, self.step @ spread @ self.step.T + self.process
            variance = spread[0, 0] + 1.0
            gain, surprise = spread[:, 0] / variance, value - mean[0]
            after = mean + gain * surprise
            narrow = spread - variance * np.outer(gain, gain)
            kept.append((mean, spread, after, narrow))
            if k >= self.order:
                squares, logs = squares + surprise**2 / variance, logs + math.log(variance)
            mean, spread = after, narrow
        degrees = len(y) - self.order
        return degrees * math.log(squares) + logs, squares / degrees, kept

    def smooth(self, y: Array) -> tuple[Array, Array]:
        """Means (n, order) and deviations of the smoothed states."""
        _, noise, kept = self.forward(y)
        *_, mean, spread = kept[-1]
        out = [(mean, np.diag(spread))]
        for (*_, after, narrow), (ahead, wide, _, _) in zip(kept[-2::-1], kept[:0:-1], strict=True):
            gain = np.linalg.solve(wide, self.step @ narrow).T
            mean = after + gain @ (mean - ahead)
            spread = narrow + gain @ (spread - wide) @ gain.T
            out.append((mean, np.diag(spread)))
        means, variances = (np.array(column[::-1]) for column in zip(*out, strict=True))
        return means, np.sqrt(np.maximum(variances, 0.0) * noise)


def kalman(order: int) -> Method:
    """Rauch-Tung-Striebel smoother, process noise by maximum likelihood."""

    def estimate(t: Array, y: Array) -> Estimate:
        span, unit = t[-1] - t[0], float(np.std(np.diff(y, 4))) / math.sqrt(70)
        z, interval = (y - y[0]) / unit, 1.0 / (len(t) - 1)
        ratio = lowest(lambda q: Chain(order, q, interval).forward(z)[0], *RATIOS, 14, 0.05)
        means, deviations = Chain(order, ratio, interval).smooth(z)
        scale = unit / span ** np.arange(order)
        (x, v, a), sigmas = (means * scale).T[:3], (deviations * scale).T[:3]
        return Estimate(x + y[0], v, a, *sigmas)

    return estimate


def gaussian_process(t: Array, y: Array) -> Estimate:
    """Squared-exponential kernel on what a line leaves; length, size and noise by maximum likelihood.

    Derivatives of the posterior: Rasmussen and Williams, Gaussian Processes for Machine Learning, section 9.4.
    """
    span, n = t[-1] - t[0], len(t)
    line = np.polynomial.Polynomial.fit(t, y, 1)
    z, lag = y - line(t), (t[:, None] - t) / span

    def solve(length: float, size: float) -> tuple[Array, Array, Array]:
        kernel = size * np.exp(-0.5 * (lag / length) ** 2)
        lower = cholesky(kernel + np.eye(n), lower=True)
        return kernel, lower, cho_solve((lower, True), z)

    def cost(logs: Array) -> float:
        _, lower, weights = solve(*np.exp(logs))
        return n * math.log(z @ weights) + 2 * float(np.sum(np.log(np.diag(lower))))

    start = min((np.log(s) for s in product(LENGTHS, SIZES)), key=cost)
    best = minimize(cost, start, method="Nelder-Mead", options={"xatol": 0.02, "fatol": 0.02})
    length, size = np.exp(best.x)
    kernel, lower, weights = solve(length, size)
    u = lag / length
    crossed = (kernel, -u * kernel / length, (u**2 - 1) * kernel / length**2)
    made, sigmas = [], []
    for k, (cross, own) in enumerate(zip(crossed, (1.0, 1.0, 3.0), strict=True)):
        known = np.sum(solve_triangular(lower, cross.T, lower=True) ** 2, axis=0)
        variance = np.maximum(own * size / length ** (2 * k) - known, 0.0) * (z @ weights) / n
        made.append(cross @ weights / span**k + line.deriv(k)(t))
        sigmas.append(np.sqrt(variance) / span**k)
    return Estimate(*made, *sigmas)


def methods() -> dict[str, Method]:
    """By name."""
    return {
        "Kalman, white jerk, ML": kalman(3),
        "Kalman, white snap, ML": kalman(4),
        "Gaussian process, ML": gaussian_process,
    }
