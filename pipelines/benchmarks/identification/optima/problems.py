"""Define the identification problems with numpy alone, so that every optimiser gets the same numbers.

A force series of 652 samples at 4 kHz along a slide from 5.4 to 0.05 m/s, white force noise of 1 N; truths are drawn at
random, frequencies off every grid. Points are rows (P, d) in the order of `Law.names`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
FPS, FRAMES, MASS, NOISE = 4000.0, 652, 0.35, 1.0
MAX_SSE_RATIO, CLOSE_PAIR_CELLS = (
    1.001,
    0.5,
)  # success: SSE over the reference; distance of a close pair, Rayleigh cells


def slide() -> tuple[Array, Array, Array]:
    """Time (s), position (m) and speed (m/s) of a slide under 8 + 6 exp(-v/0.4) + 1.2 v newtons, (652,) each."""
    steps = 50
    h, v, x = 1 / (FPS * steps), 5.4, 0.0
    out = np.zeros((FRAMES, 2))
    for i in range(FRAMES):
        out[i] = x, v
        for _ in range(steps):
            v -= h * (8 + 6 * np.exp(-v / 0.4) + 1.2 * v) / MASS
            x += h * v
    return np.arange(FRAMES) / FPS, out[:, 0], out[:, 1]


T, X, V = slide()


@dataclass(frozen=True)
class Law:
    """A law over the whole population, its box, and how its truths are drawn."""

    model: str  # as frictrack calls it
    names: tuple[str, ...]
    box: Array  # (d, 2)
    force: Callable[[Array], Array]  # (P, d) to (P, n)
    truth: Callable[[np.random.Generator], Array]


def _tustin(p: Array) -> Array:
    fc, fs, fv, vs = (p[:, i, None] for i in range(4))
    return fc + (fs - fc) * np.exp(-V / vs) + fv * V


def _atm1(p: Array) -> Array:
    out = _tustin(p)
    for i in range(4, p.shape[1], 3):
        out = out + p[:, i, None] * np.sin(2 * np.pi * p[:, i + 1, None] * T + p[:, i + 2, None])
    return out


def _atm2(p: Array) -> Array:
    fc, fs, fv, vs = (p[:, i, None] for i in range(4))
    wave = [np.sin(2 * np.pi * p[:, i, None] * T + p[:, i + 1, None]) for i in range(4, p.shape[1], 2)]
    half = len(wave) // 2
    decay = np.exp(-V / vs)
    return fc * sum(wave[:half]) * (1 - decay) + fs * decay + fv * sum(wave[half:]) * V


def _levels(rng: np.random.Generator) -> list[float]:
    fc = rng.uniform(3, 15)
    return [fc, fc + rng.uniform(1, 12), rng.uniform(0.3, 3), rng.uniform(0.15, 1.2)]


def _lines(count: int, close: bool = False) -> Callable[[np.random.Generator], Array]:
    def truth(rng: np.random.Generator) -> Array:
        p, f = _levels(rng), rng.uniform(8, 390, count)
        if close:
            f[0] = rng.uniform(20, 380)
            f[1] = f[0] + CLOSE_PAIR_CELLS / T[-1]
        for frequency in f:
            p += [rng.uniform(0.3, 4), frequency, rng.uniform(-np.pi, np.pi)]
        return np.array(p)

    return truth


def _slow_and_fast(rng: np.random.Generator) -> Array:
    """ATM2 with a slow and a faster sine in either sum, as the first paper prints them."""
    p = _levels(rng)
    for _ in range(2):
        p += [rng.uniform(1.5, 10), rng.uniform(-np.pi, np.pi), rng.uniform(15, 190), rng.uniform(-np.pi, np.pi)]
    return np.array(p)


BASE = ("F_c", "F_s", "F_v", "v_s")
BASE_BOX = ((0.0, 40.0), (0.0, 80.0), (0.0, 20.0), (0.05, 3.0))


def _law(model: str, count: int, *, close: bool = False) -> Law:
    names = tuple(f"{q}{i}" for i in range(1, count + 1) for q in ("F", "f", "phase"))
    box = np.array([*BASE_BOX, *(((0.0, 20.0), (5.0, 400.0), (-np.pi, np.pi)) * count)])
    return Law(model, BASE + names, box, _atm1, _lines(count, close))


def _printed() -> Law:
    names = tuple(f"{q}{i}" for i in range(1, 5) for q in ("f", "phase"))
    box = np.array([*BASE_BOX, *(((0.0, 200.0), (-np.pi, np.pi)) * 4)])
    return Law("atm2:2", BASE + names, box, _atm2, _slow_and_fast)


PROBLEMS: dict[str, Law] = {
    "TM": _law("tustin", 0),
    "ATM1 n=2": _law("atm1:2", 2),
    "ATM1 n=3": _law("atm1:3", 3),
    "close pair": _law("atm1:2", 2, close=True),
    "ATM2 n=2": _printed(),
}


@dataclass(frozen=True)
class Case:
    """One problem of one seed: data (n,), the truth, and the SSE of least squares started there."""

    law: Law
    seed: int
    data: Array
    truth: Array
    reference: float

    @property
    def target(self) -> float:
        """SSE from which on the global optimum counts as found."""
        return MAX_SSE_RATIO * self.reference

    def sse(self, points: Array) -> Array:
        """Sum of squared residuals (P,) of points (P, d)."""
        residual = self.data - self.law.force(points)
        out: Array = np.einsum("pn,pn->p", residual, residual)
        return out


def case(name: str, seed: int) -> Case:
    """The problem of that name with truth and noise of one seed."""
    from scipy.optimize import least_squares  # noqa: PLC0415 - the only use

    law, rng = PROBLEMS[name], np.random.default_rng(seed)
    truth = law.truth(rng)
    data = law.force(truth[None])[0] + rng.normal(0, NOISE, len(T))
    low, high = law.box.T
    best = least_squares(
        lambda p: data - law.force(p[None])[0],
        np.clip(truth, low + 1e-9, high - 1e-9),
        bounds=(low, high),
        x_scale="jac",
    )
    return Case(
        law, seed, data, truth, min(2 * float(best.cost), float(np.sum((data - law.force(truth[None])[0]) ** 2)))
    )
