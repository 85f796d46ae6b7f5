"""Test whether a misfit repeats with one frequency: amplitude common to all runs, phase free in every run."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from frictrack.compare import WaveTraces, pair_products
from frictrack.fit.least_squares import ModelProjection
from frictrack.records import Array

MIN_PREDICTED_SHARE = 0.25  # of a run's misfit that counts as repeating there

_Halves = tuple[Array, Array, Array, Array]  # even and odd: Gram (G, 2, 2), (G, 2, 2), data (G, 2), (G, 2)


@dataclass(frozen=True)
class CommonFrequency:
    """Result for the best common frequency.

    Parameters
    ----------
    share
        Share of the misfit that the other runs predict.
    p
        p-value of that share.
    runs
        Number of runs in which it repeats.
    frequency
        Frequency, Hz.
    evidence
        Gain of the restricted likelihood.

    """

    share: float
    p: float
    runs: int
    frequency: float
    evidence: float


def restricted_likelihood_gain(gain: float, numbers: int, tried: int) -> float:
    """Twice the rise of the log restricted likelihood with waves of a given gain, at their most likely amplitude.

    Parameters
    ----------
    gain
        Fall of chi-squared.
    numbers
        Number of coefficients of all waves.
    tried
        Number of periods among which this is the best.

    Returns
    -------
    float

    Examples
    --------
    >>> restricted_likelihood_gain(2.0, 2, 1)
    0.0

    """
    each = max(gain / numbers, 1.0)
    return numbers * (each - 1 - float(np.log(each))) - 2 * float(np.log(tried))


def assess_common_frequency(
    law: ModelProjection, waves: WaveTraces, rng: np.random.Generator, draws: int
) -> CommonFrequency:
    """Test one frequency for all runs: amplitude from the other runs, phase from the even frames of a run.

    The odd frames are predicted. For the null distribution every run is given another frequency.

    Parameters
    ----------
    law
        Residual and directions of the model.
    waves
        Traces of the waves in time.
    rng
        Random generator.
    draws
        Number of draws.

    Returns
    -------
    CommonFrequency

    """
    f, runs = waves.f, sorted({r.piece.run for r in law.responses})
    excess = _excess_chi2(law, runs)
    statistics = np.array([_frequency_statistics(*_halves(law, run, waves)) for run in runs])
    gains, free = _predicted_gains(statistics)
    best = int(np.argmax(free))
    null = []
    for _ in range(draws):
        shifts = rng.integers(0, len(f), len(statistics))
        drawn, total = _predicted_gains(
            np.array([np.roll(t, int(by), -1) for t, by in zip(statistics, shifts, strict=True)])
        )
        null.append(float(drawn[:, int(np.argmax(total))].sum()))
    gain = float(gains[:, best].sum())
    p = float((1 + np.sum(np.array(null) >= gain)) / (1 + draws))
    share = float(np.clip(gain / excess.sum(), 0.0, 1.0))
    n_runs = int(np.sum(gains[:, best] > MIN_PREDICTED_SHARE * excess))
    return CommonFrequency(
        share, p, n_runs, float(f[best]), restricted_likelihood_gain(float(free[best]), 2 * len(statistics), len(f))
    )


def _excess_chi2(law: ModelProjection, runs: Sequence[int]) -> Array:
    """Misfit of every run above its noise under the model of all, at least its uncertainty, (R,)."""
    out = np.zeros((len(runs), 2))
    for rows, response in zip(law.rows, law.responses, strict=True):
        r = law.r[rows]
        out[runs.index(response.piece.run)] += float(r @ r), len(r) - float(np.sum(law.u[rows] ** 2))
    return np.asarray(np.maximum(out[:, 0] - out[:, 1], np.sqrt(2 * out[:, 1])))


def _halves(law: ModelProjection, run: int, waves: WaveTraces) -> _Halves:
    """Gram matrices and data of the waves in the even and the odd frames of a run."""
    count = len(waves.f)
    gram, data = np.zeros((2, count, 2, 2)), np.zeros((2, count, 2))
    for rows, response, traces in zip(law.rows, law.responses, waves.of_pieces, strict=True):
        if response.piece.run == run:
            u, r = law.u[rows].astype(np.float32), law.r[rows].astype(np.float32)
            clean = traces - (traces @ u) @ u.T
            for k in (0, 1):
                half = np.ascontiguousarray(clean[:, :, k::2])
                gram[k] += pair_products(half)
                data[k] += (half @ r[k::2]).T
    return gram[0], gram[1], data[0], data[1]


def _frequency_statistics(even: Array, odd: Array, b_even: Array, b_odd: Array) -> Array:
    """Statistics of one run at every frequency, (5, G).

    Gain of its own wave, power of the wave minus that of the noise, power of the noise; and for a wave of amplitude
    one with the phase of the even frames, its product with the odd frames and its square there.
    """
    inverse = np.linalg.pinv(even + odd, rcond=1e-6, hermitian=True)
    wave = np.einsum("fij,fj->fi", inverse, b_even + b_odd)
    gain, noise = np.sum(wave * (b_even + b_odd), axis=1), np.einsum("fii->f", inverse)
    direction = np.einsum("fij,fj->fi", np.linalg.pinv(even, rcond=1e-6, hermitian=True), b_even)
    direction /= np.maximum(np.linalg.norm(direction, axis=1), 1e-300)[:, None]
    product, square = np.sum(direction * b_odd, axis=1), np.einsum("fi,fij,fj->f", direction, odd, direction)
    return np.array([gain, np.sum(wave**2, axis=1) - noise, noise, product, square])


def _predicted_gains(statistics: Array) -> tuple[Array, Array]:
    """Fall of every run's chi-squared with the amplitude of the others (R, G), and the gain of free amplitudes (G,).

    `statistics` (R, 5, G) are those of `_frequency_statistics`.
    """
    gain, power, noise, product, square = statistics.transpose(1, 0, 2)
    weight = 1 / np.maximum(noise, 1e-300) ** 2
    others = (weight * power).sum(axis=0) - weight * power
    size = np.sqrt(np.maximum(others / np.maximum(weight.sum(axis=0) - weight, 1e-300), 0.0))
    return 2 * (2 * size * product - size**2 * square), gain.sum(axis=0)
