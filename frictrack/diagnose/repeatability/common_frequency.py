"""Whether a failure repeats with one frequency: its size common to all runs, every run at a phase of its own."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from frictrack.compare import scan_frequencies, time_wave_traces
from frictrack.fit.least_squares import ModelProjection
from frictrack.records import Array

MIN_PREDICTED_SHARE = 0.25  # of a run's misfit that the other runs must foretell for it to repeat there

_Halves = tuple[Array, Array, Array, Array]  # even and odd: Gram (G, 2, 2), (G, 2, 2), data (G, 2), (G, 2)


@dataclass(frozen=True)
class CommonFrequency:
    """Share of the misfit that the other runs foretell, its p, in how many runs, the frequency, Hz; the evidence."""

    share: float
    p: float
    runs: int
    frequency: float
    evidence: float


def restricted_likelihood_gain(gain: float, numbers: int, tried: int) -> float:
    """Twice the rise of the log restricted likelihood with waves that gain so much, at the size that is most likely.

    `numbers` are those of all waves together, as well known each; `tried` the periods among which this is the best.
    """
    each = max(gain / numbers, 1.0)
    return numbers * (each - 1 - float(np.log(each))) - 2 * float(np.log(tried))


def assess_common_frequency(
    law: ModelProjection, runs: Sequence[int], rng: np.random.Generator, draws: int
) -> CommonFrequency:
    """One frequency for all runs: its amplitude from the other runs, the phase of a run from its even frames.

    Foretold are the odd frames; they stand for all. For chance every run is given another frequency.
    """
    f, excess = scan_frequencies(law), _beyond(law, runs)
    told = np.array([_told(*_halves(law, run, f)) for run in runs])
    gains, free = _waved(told)
    best = int(np.argmax(free))
    null = []
    for _ in range(draws):
        shifts = rng.integers(0, len(f), len(told))
        drawn, total = _waved(np.array([np.roll(t, int(by), -1) for t, by in zip(told, shifts, strict=True)]))
        null.append(float(drawn[:, int(np.argmax(total))].sum()))
    mine = float(gains[:, best].sum())
    p = float((1 + np.sum(np.array(null) >= mine)) / (1 + draws))
    share = float(np.clip(mine / excess.sum(), 0.0, 1.0))
    told_in = int(np.sum(gains[:, best] > MIN_PREDICTED_SHARE * excess))
    return CommonFrequency(
        share, p, told_in, float(f[best]), restricted_likelihood_gain(float(free[best]), 2 * len(told), len(f))
    )


def _beyond(law: ModelProjection, runs: Sequence[int]) -> Array:
    """Misfit of every run beyond its noise under the law of all, at least its uncertainty, (R,)."""
    out = np.zeros((len(runs), 2))
    for rows, response in zip(law.rows, law.responses, strict=True):
        r = law.r[rows]
        out[runs.index(response.piece.run)] += float(r @ r), len(r) - float(np.sum(law.u[rows] ** 2))
    return np.asarray(np.maximum(out[:, 0] - out[:, 1], np.sqrt(2 * out[:, 1])))


def _halves(law: ModelProjection, run: int, f: Array) -> _Halves:
    out: list[Array] = [
        np.zeros((len(f), 2, 2)),
        np.zeros((len(f), 2, 2)),
        np.zeros((len(f), 2)),
        np.zeros((len(f), 2)),
    ]
    for rows, response in zip(law.rows, law.responses, strict=True):
        if response.piece.run == run:
            made = time_wave_traces(response, f)
            made -= law.u[rows] @ (law.u[rows].T @ made)
            cube = made.reshape(len(made), len(f), 2)
            for k in (0, 1):
                out[k] += np.einsum("nfi,nfj->fij", cube[k::2], cube[k::2])
                out[2 + k] += np.einsum("nfi,n->fi", cube[k::2], law.r[rows][k::2])
    return out[0], out[1], out[2], out[3]


def _told(even: Array, odd: Array, b_even: Array, b_odd: Array) -> Array:
    """What one run tells of every frequency, (5, G).

    What its own wave gains, the wave's power less the noise's, that noise; and of a wave of size one with the phase of
    the even frames its product with the odd frames and its square there.
    """
    inverse = np.linalg.pinv(even + odd, rcond=1e-6, hermitian=True)
    wave = np.einsum("fij,fj->fi", inverse, b_even + b_odd)
    gain, noise = np.sum(wave * (b_even + b_odd), axis=1), np.einsum("fii->f", inverse)
    way = np.einsum("fij,fj->fi", np.linalg.pinv(even, rcond=1e-6, hermitian=True), b_even)
    way /= np.maximum(np.linalg.norm(way, axis=1), 1e-300)[:, None]
    time_wave_traces = np.sum(way * b_odd, axis=1), np.einsum("fi,fij,fj->f", way, odd, way)
    return np.array([gain, np.sum(wave**2, axis=1) - noise, noise, *time_wave_traces])


def _waved(told: Array) -> tuple[Array, Array]:
    """Fall of every run's chi-squared with the amplitude of the others (R, G), and what free amplitudes gain (G,).

    `told` (R, 5, G) as `_told` has it.
    """
    gain, power, noise, product, square = told.transpose(1, 0, 2)
    weight = 1 / np.maximum(noise, 1e-300) ** 2
    others = (weight * power).sum(axis=0) - weight * power
    size = np.sqrt(np.maximum(others / np.maximum(weight.sum(axis=0) - weight, 1e-300), 0.0))
    return 2 * (2 * size * product - size**2 * square), gain.sum(axis=0)
