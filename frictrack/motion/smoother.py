"""The smoother of Whittaker (1923) and Henderson (1924) with a third-difference penalty.

    minimise over x:   sum_i w_i (y_i - x_i)^2 + lambda sum_j (D x)_j^2,   D the third difference

Away from the ends it *is* the zero-phase (forward-backward) Butterworth filter of order 3,
|H(f)| = 1 / (1 + lambda (2 sin(pi f / fs))^6). Unlike that filter it needs no padding, has no end transient
and takes a missing frame as a weight of zero. It is also the posterior mean of a signal whose jerk is white
noise: hence a likelihood that chooses the cut-off (restricted maximum likelihood; Wahba 1985, Ann. Stat. 13)
and a covariance sigma^2 (W + lambda D'D)^-1 that covers noise and lost signal on average (Wahba 1983, J. R.
Stat. Soc. B 45).
"""

from __future__ import annotations

import numpy as np
from numpy.polynomial import Polynomial
from numpy.typing import NDArray
from scipy.linalg.lapack import dgbtrf, dgbtrs
from scipy.optimize import minimize_scalar

from frictrack.records import Array, Mask

MISSING = float("inf")  # m, standard deviation of a frame that was not measured
D3 = np.array([-1.0, 3.0, -3.0, 1.0])  # third difference
BAND = 3  # half bandwidth of the equations
BLOCK = 8  # frames per block of the covariance
STEP = 0.01  # of log lambda, for the derivative that parts noise from lost signal
NO_WEIGHT = 1e-10  # of a missing frame in the covariance, which keeps that of an extrapolation finite


def penalty(cutoff: float, interval: float) -> float:
    """Lambda for which |H(cutoff)| = 1/2; `cutoff` in Hz, frame `interval` in s."""
    return float((2.0 * np.sin(np.pi * cutoff * interval)) ** -6.0)


def weights(sigma: Array, known: Mask) -> Array:
    """Weights (n,) of mean 1 over the known frames, 0 elsewhere; frames of unknown sigma get the usual one."""
    stated = known & np.isfinite(sigma) & (sigma > 0)
    usual = float(np.median(sigma[stated])) if np.any(stated) else 1.0
    w = np.where(known, np.where(stated, sigma, usual), np.inf) ** -2.0
    return np.asarray(w / np.mean(w[known]))


def smooth(y: Array, w: Array, lam: float) -> Array:
    """Smoothed series (n,) of y (n,) with weights w (n,); y counts nowhere that w is 0."""
    trend = _trend(y, w)
    return np.asarray(_solve(y - trend, w, lam)[0] + trend)


def noise_variance(y: Array, w: Array, lam: float) -> float:
    """Restricted maximum likelihood estimate of the noise variance of a frame of weight 1."""
    return _likelihood(y - _trend(y, w), w, lam)[1]


def best_cutoff(y: Array, w: Array, interval: float) -> float:
    """Cut-off of the highest restricted likelihood, Hz: a coarse scan, then Brent's search beside its best."""
    rest = y - _trend(y, w)

    def loss(log_f: float) -> float:
        return _likelihood(rest, w, penalty(np.exp(log_f), interval))[0]

    lowest = max(0.1 / len(y), 1e-4) / interval
    scan = np.linspace(np.log(lowest), np.log(0.49 / interval), 30)
    best = int(np.argmin([loss(f) for f in scan]))
    around = scan[max(best - 1, 0)], scan[min(best + 1, len(scan) - 1)]
    return float(np.exp(minimize_scalar(loss, bounds=around, method="bounded", options={"xatol": 1e-2}).x))


def _trend(y: Array, w: Array) -> Array:
    """Weighted parabola (n,) through y: the smoother leaves it as it is, but it would cost digits."""
    u, known = np.linspace(-1.0, 1.0, len(y)), w > 0
    return np.asarray(Polynomial.fit(u[known], y[known], 2, domain=[-1, 1], w=np.sqrt(w[known]))(u))


def _equations(w: Array, lam: float) -> Array:
    """Equations of the smoother in LAPACK band storage (3 BAND + 1, 2 n), the top BAND rows left for fill-in.

    They are the augmented system [W, r D'; r D, -1] [x; s] = [W y; 0] with r = sqrt(lambda), x and s
    interleaved: its condition is the square root of that of W + lambda D'D, which a low cut-off would spoil.
    Frame i stands at place 2 i, difference j at 2 j + 3; the three odd places left over are idle.
    """
    n, r = len(w), np.sqrt(lam)
    band = np.zeros((3 * BAND + 1, 2 * n))
    band[2 * BAND, 0::2] = w
    band[2 * BAND, 1::2] = -1.0
    for k, c in enumerate(D3):  # frame j + k enters difference j: column 2 j + 2 k, row 2 j + 3
        offset = 3 - 2 * k
        band[2 * BAND + offset, 2 * k : 2 * (n - 3 + k) : 2] = r * c
        band[2 * BAND - offset, 3 : 2 * n - 3 : 2] = r * c
    return band


def _solve(y: Array, w: Array, lam: float) -> tuple[Array, float, float]:
    """Smoothed series, the minimum reached, and log det(W + lambda D'D)."""
    n = len(w)
    lu, pivots, _ = dgbtrf(_equations(w, lam), BAND, BAND)
    right = np.zeros(2 * n)
    right[0::2] = w * y
    solution, _ = dgbtrs(lu, BAND, BAND, right, pivots)
    x, s = solution[0::2], solution[3 : 2 * n - 3 : 2]
    minimum = float(np.sum(w * (y - x) ** 2) + np.sum(s**2))
    return x, minimum, float(np.sum(np.log(np.abs(lu[2 * BAND]))))


def _likelihood(y: Array, w: Array, lam: float) -> tuple[float, float]:
    """Twice the negative restricted log-likelihood of lambda, and the noise variance that goes with it."""
    _, minimum, logdet = _solve(y, w, lam)
    degrees = int(np.sum(w > 0)) - BAND
    variance = max(minimum, np.finfo(float).tiny) / degrees
    return degrees * np.log(variance) + logdet - (len(w) - BAND) * np.log(lam), variance


def lost_share(x: Array, lam: float, variance: float) -> float:
    """Lost signal of the smoothed series x (n,) over what white jerk would lose, in variance.

    White jerk is more ragged than most slides, so the covariance that it implies would be too wide, mostly
    for the acceleration. What smoothing takes from the smoothed series once more (Tukey's twicing) shows the
    signal near the cut-off: its power is H^2 (1 - H)^2 of that of signal and noise, and that of white jerk is
    H / (1 - H) of the noise.
    """
    taken = float(np.mean((x - smooth(x, np.ones(len(x)), lam)) ** 2)) / variance
    h = 1.0 / (1.0 + lam * (2.0 * np.sin(np.pi * (np.arange(4096) + 0.5) / 8192)) ** 6)
    from_noise, from_white_jerk = np.mean(h**2 * (1 - h) ** 2), np.mean(h**3 * (1 - h))
    return max(float((taken - from_noise) / from_white_jerk), 0.0)


def deviations(w: Array, lam: float, lost: float, start: NDArray[np.int64], stencils: Array) -> Array:
    """Standard deviation of linear combinations of neighbouring smoothed frames, for unit noise.

    Combination i takes the frames from start[i] (n,) on with the weights stencils[..., i, :], at most BLOCK
    of them; the result has the shape of stencils without its last axis. With A = W + lambda D'D, the variance
    A^-1 of white jerk is noise A^-1 W A^-1 plus lost signal -dA^-1/dlog(lambda); the latter counts `lost`
    times.
    """
    both, up, down = (_variances(w, lam * np.exp(d), start, stencils) for d in (0.0, STEP, -STEP))
    rounding = np.finfo(float).eps * np.sum(stencils**2, axis=-1)  # a stiff parabola is known that well
    return np.asarray(np.sqrt(np.maximum(both + (1.0 - lost) * (up - down) / (2.0 * STEP), rounding)))


def _variances(w: Array, lam: float, start: NDArray[np.int64], stencils: Array) -> Array:
    """Variances under A^-1 of the combinations."""
    window = np.minimum(start // BLOCK, max(-(-len(w) // BLOCK) - 2, 0))
    covariance = _window_covariances(w, lam)
    inside = (start - window * BLOCK)[:, None] + np.arange(stencils.shape[-1])
    near = covariance[window[:, None, None], inside[:, :, None], inside[:, None, :]]
    return np.asarray(np.einsum("...ij,ijk,...ik->...i", stencils, near, stencils))


def _window_covariances(w: Array, lam: float) -> Array:
    """Covariances A^-1 (m, 2 BLOCK, 2 BLOCK) of the frames of each two neighbouring blocks, exact, in O(n).

    Eliminating all frames to one side of a block alters only the corner of its equations that they couple to;
    with the corners from both sides, the inverse of two blocks is that part of the whole inverse.
    """
    pairs, size = _block_pairs(np.maximum(w, NO_WEIGHT), lam), 2 * BLOCK
    links = pairs[:, size : size + BAND, size - BAND : size]
    before = np.zeros((len(pairs), BAND, BAND))
    after = np.zeros_like(before)
    for k in range(1, len(pairs)):
        block = pairs[k - 1, :size, :size].copy()
        block[:BAND, :BAND] += before[k - 1]
        before[k] = -links[k - 1] @ np.linalg.inv(block)[-BAND:, -BAND:] @ links[k - 1].T
        block = pairs[-k, size:, size:].copy()
        block[-BAND:, -BAND:] += after[-k]
        after[-k - 1] = -links[-k].T @ np.linalg.inv(block)[:BAND, :BAND] @ links[-k]
    pairs[:, :BAND, :BAND] += before
    pairs[:, -BAND:, -BAND:] += after
    return np.asarray(np.linalg.inv(pairs)[:, ::2, ::2])


def _block_pairs(w: Array, lam: float) -> Array:
    """Equations (m, 4 BLOCK, 4 BLOCK) of each two neighbouring blocks of frames, the last one padded."""
    size = 2 * BLOCK
    band = _equations(w, lam)[BAND:]
    m = max(-(-len(w) // BLOCK), 2)
    padded = np.zeros((2 * BAND + 1, m * size))
    padded[BAND] = 1.0
    padded[:, : band.shape[1]] = band
    row, column = np.indices((2 * size, 2 * size))
    offset = row - column
    values = padded[np.clip(BAND + offset, 0, 2 * BAND), size * np.arange(m - 1)[:, None, None] + column]
    return np.where(np.abs(offset) <= BAND, values, 0.0)
