"""Whether a failure repeats: at the same place, the same time since release, the same velocity, or the same phase.

Of every axis it is asked how much of the misfit of a run is foretold by one common curve over this axis that only the
other runs have drawn: a smooth one, over the place also a wave. The curve is a force, its trace in the displacement is
compared (where the noise is white), beside all that the law could take up of it. A failure that repeats at a place
belongs to the course, at a time to what happens since release, at a velocity to the law of friction, at a phase to
something that vibrates.

Chance: signs of every run's residual in a cosine basis are drawn anew, which leaves each run its own misfit and noise
but nothing common; for the phase, every run is given another frequency.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.fft import dct, idct

from frictrack.compare.beside import Beside, beside, traces
from frictrack.compare.deconvolve import hats, matern
from frictrack.compare.lines import scanned, seen, waves
from frictrack.compare.looks import Nodes, course, nodes
from frictrack.effects.texture import periods
from frictrack.fit.simulated.solve import Solution
from frictrack.records import Array

DRAWS = 199
KNOTS = {"x": 120, "t": 80, "v": 40}
REACHES = (2.0, 6.0, 20.0)  # of a curve, in knots
SIZES = (0.3, 3.0, 30.0)  # of a curve, over what its runs just show
ALPHA = 0.01
FORETOLD = 0.25  # of a run's misfit that the other runs must foretell for it to repeat there
SAME = 0.1  # of the misfit, within which two axes are as good

WHERE = {
    "x": ("at the same place", "it belongs to the course"),
    "t": ("at the same time since release", "it belongs to what happens since release, not to the place"),
    "v": ("at the same velocity", "it belongs to the law of friction itself"),
    "phase": ("with one frequency, each run at a phase of its own", "something vibrates"),
}


@dataclass(frozen=True)
class Axis:
    """How well the failure repeats along one axis: share of the misfit foretold, p, and in how many of the runs."""

    axis: str
    share: float
    p: float
    runs: int
    of: int
    frequency: float | None = None  # Hz, of the phase

    @property
    def holds(self) -> bool:
        """Whether it repeats beyond chance."""
        return self.p <= ALPHA and self.share > 0

    def summary(self) -> dict[str, Any]:
        """JSON of one axis."""
        found = {"axis": self.axis, "share": round(self.share, 4), "p": self.p, "runs": self.runs, "of": self.of}
        return found | ({} if self.frequency is None else {"frequency": self.frequency})


@dataclass(frozen=True)
class Repeats:
    """The axes, best first, what is to be said, and the common curve over every axis: (k,) each."""

    axes: list[Axis] = field(default_factory=list)
    words: str = ""
    curves: dict[str, dict[str, Array]] = field(default_factory=dict)

    @property
    def best(self) -> Axis | None:
        """The axis along which the failure repeats, if it does along any."""
        return next((a for a in self.axes if a.holds), None)

    def summary(self) -> list[dict[str, Any]]:
        """JSON `repeats`."""
        return [a.summary() for a in self.axes]


@dataclass(frozen=True)
class _Fold:
    """What the runs see of a curve through knots: Gram matrices (R, K, K) and data (R, K, D), D = 1 + draws."""

    knots: Array
    gram: Array
    data: Array


def repeats(solution: Solution, rng: np.random.Generator, draws: int = DRAWS) -> Repeats:
    """Along which axis the failure of a fitted law repeats from run to run."""
    law = beside(solution)
    runs = sorted({r.piece.run for r in law.responses})
    at = [nodes(solution, r) for r in law.responses]
    excess = _excess(law, runs)
    if len(runs) < 2:
        return Repeats(words="One run cannot tell whether a failure repeats: film another one, best at another speed.")
    series = _drawn(law, rng, draws)
    found, curves = [], {}
    for axis in KNOTS:
        gains, curves[axis] = _smooth([_fold(law, at, runs, axis, dry, series) for dry in (True, False)])
        if axis == "x":
            gains = _better(gains, _wave(law, at, runs, series))
        made = _judged(axis, gains, excess)
        found.append(made)
    phase = _phase(law, runs, excess, rng, draws)
    found = sorted([*found, phase], key=lambda a: (not a.holds, -a.share))
    return Repeats(found, told(found), curves)


def _excess(law: Beside, runs: Sequence[int]) -> Array:
    """Misfit of every run beyond its noise, of chi-squared, at least its uncertainty, (R,)."""
    out = np.zeros((len(runs), 2))
    for rows, response in zip(law.rows, law.responses, strict=True):
        r = law.r[rows]
        out[runs.index(response.piece.run)] += float(r @ r), len(r) - float(np.sum(law.u[rows] ** 2))
    return np.asarray(np.maximum(out[:, 0] - out[:, 1], np.sqrt(2 * out[:, 1])))


def _drawn(law: Beside, rng: np.random.Generator, draws: int) -> Array:
    """The residual, and draws in which every run keeps its misfit but nothing is common, (N + m, 1 + draws)."""
    out = np.zeros((len(law.r), 1 + draws))
    out[:, 0] = law.r
    for rows in law.rows:
        wave = dct(law.r[rows], norm="ortho")[:, None] * rng.choice([-1.0, 1.0], (rows.stop - rows.start, draws))
        out[rows, 1:] = idct(wave, axis=0, norm="ortho")
    out[:, 1:] -= law.u @ (law.u.T @ out[:, 1:])
    for rows in law.rows:
        left = np.linalg.norm(out[rows, 1:], axis=0)
        out[rows, 1:] *= np.linalg.norm(law.r[rows]) / np.maximum(left, 1e-300)
    return out


def _knots(at: Sequence[Nodes], law: Beside, axis: str) -> Array:
    if axis == "x":
        low, high = course(law.responses)
    elif axis == "t":
        low, high = min(float(n.t[0]) for n in at), max(float(n.t[-1]) for n in at)
    else:
        speeds = [np.abs(n.v) for n in at]
        low, high = min(float(s.min()) for s in speeds), max(float(s.max()) for s in speeds)
    return np.linspace(low, high, KNOTS[axis])


def _fold(law: Beside, at: Sequence[Nodes], runs: Sequence[int], axis: str, dry: bool, series: Array) -> _Fold:
    """A curve over an axis as every run sees it beside the law; a dry force goes with load, level and direction."""
    knots = _knots(at, law, axis)
    made = np.zeros((len(law.r), len(knots)))
    for rows, response, n in zip(law.rows, law.responses, at, strict=True):
        along = {"x": n.x, "t": n.t, "v": np.abs(n.v)}[axis]
        carried = n.dry if dry else np.sign(n.dry) if axis == "v" else np.ones_like(n.dry)
        made[rows] = traces(response, hats(along, knots) * carried[:, None])
    made -= law.u @ (law.u.T @ made)
    gram, data = np.zeros((len(runs), len(knots), len(knots))), np.zeros((len(runs), len(knots), series.shape[1]))
    for rows, response in zip(law.rows, law.responses, strict=True):
        k = runs.index(response.piece.run)
        gram[k] += made[rows].T @ made[rows]
        data[k] += made[rows].T @ series[rows]
    return _Fold(knots, gram, data)


def _smooth(tried: Sequence[_Fold]) -> tuple[Array, dict[str, Array]]:
    """Fall of every run's chi-squared at the best of all smooth curves, (R, D), and that curve for the data."""
    best: Array | None = None
    curve: dict[str, Array] = {}
    for fold in tried:
        scale = float(np.trace(fold.gram.sum(axis=0)) / len(fold.knots))
        for reach in REACHES:
            prior = np.linalg.inv(matern(np.arange(float(len(fold.knots))), reach) + 1e-8 * np.eye(len(fold.knots)))
            for size in SIZES:
                held = np.asarray(prior * (scale / size**2), dtype=np.float64)
                gains = _gains(fold, held)
                if best is None or gains[:, 0].sum() > best[:, 0].sum():
                    curve = _curve(fold, held)
                best = gains if best is None else _better(best, gains)
    return np.asarray(best), curve


def _better(one: Array, other: Array) -> Array:
    """The gains (R, D) of whichever gains more, for the data and for every draw."""
    return np.where(other.sum(axis=0) > one.sum(axis=0), other, one)


def _judged(axis: str, gains: Array, excess: Array) -> Axis:
    """Share of the misfit that is foretold, its p among the draws, and in how many runs."""
    share = gains.sum(axis=0) / excess.sum()
    p = float((1 + np.sum(share[1:] >= share[0])) / len(share))
    runs = int(np.sum(gains[:, 0] > FORETOLD * excess))
    return Axis(axis, float(np.clip(share[0], 0.0, 1.0)), p, runs, len(excess))


def _wave(law: Beside, at: Sequence[Nodes], runs: Sequence[int], series: Array) -> Array:
    """Fall of every run's chi-squared (R, D) with a dry force that waves over the place, all told by the other runs."""
    f = 1 / periods(law.solution.problem.layout.span)
    gram, data = np.zeros((len(runs), len(f), 2, 2)), np.zeros((len(runs), len(f), 2, series.shape[1]))
    on = np.zeros((law.u.shape[1], 2 * len(f)))
    made = []
    for rows, response, n in zip(law.rows, law.responses, at, strict=True):
        made.append(traces(response, waves(n.x, f) * n.dry[:, None]))
        on += law.u[rows].T @ made[-1]
    for rows, response, columns in zip(law.rows, law.responses, made, strict=True):
        clean = columns - law.u[rows] @ on
        k = runs.index(response.piece.run)
        cube = clean.reshape(len(clean), len(f), 2)
        gram[k] += np.einsum("nfi,nfj->fij", cube, cube)
        data[k] += (clean.T @ series[rows]).reshape(len(f), 2, -1)
    out = np.zeros((len(runs), series.shape[1]))
    each = np.arange(series.shape[1])
    for k in range(len(runs)):
        others = data.sum(axis=0) - data[k]
        inverse = np.linalg.pinv(gram.sum(axis=0) - gram[k], rcond=1e-6, hermitian=True)
        size = inverse @ others
        best = np.argmax(np.sum(size * others, axis=1), axis=0)
        c = size[best, :, each]
        own = np.einsum("di,dij,dj->d", c, gram[k][best], c)
        out[k] = 2 * np.sum(c * data[k][best, :, each], axis=1) - own
    return out


def _gains(fold: _Fold, held: Array) -> Array:
    """Fall of every run's chi-squared with the curve of the other runs, (R, D)."""
    gram, data = fold.gram.sum(axis=0) + held, fold.data.sum(axis=0)
    out = np.zeros((len(fold.gram), data.shape[1]))
    for k, (g, b) in enumerate(zip(fold.gram, fold.data, strict=True)):
        c = np.linalg.solve(gram - g, data - b)
        out[k] = 2 * np.einsum("kd,kd->d", c, b) - np.einsum("kd,kd->d", c, g @ c)
    return out


def _curve(fold: _Fold, held: Array) -> dict[str, Array]:
    """The common curve of all runs, N, with its standard deviation."""
    inverse = np.linalg.inv(fold.gram.sum(axis=0) + held)
    force = inverse @ fold.data.sum(axis=0)[:, 0]
    return {"at": fold.knots, "F": force, "sigma_F": np.sqrt(np.maximum(np.diag(inverse), 0.0))}


def _phase(law: Beside, runs: Sequence[int], excess: Array, rng: np.random.Generator, draws: int) -> Axis:
    """One frequency for all runs: its amplitude from the other runs, the phase of a run from its even frames.

    Foretold are the odd frames; they stand for all.
    """
    f = scanned(law)
    halves = [_halves(law, run, f) for run in runs]
    gains, total = _waved(halves)
    best = int(np.argmax(total))
    null = []
    for _ in range(draws):
        shifts = rng.integers(0, len(f), len(halves))
        moved = [_rolled(h, int(by)) for h, by in zip(halves, shifts, strict=True)]
        drawn, total = _waved(moved)
        null.append(float(drawn[:, int(np.argmax(total))].sum()))
    mine = float(gains[:, best].sum())
    p = float((1 + np.sum(np.array(null) >= mine)) / (1 + draws))
    share = float(np.clip(mine / excess.sum(), 0.0, 1.0))
    return Axis("phase", share, p, int(np.sum(gains[:, best] > FORETOLD * excess)), len(runs), float(f[best]))


_Halves = tuple[Array, Array, Array, Array]  # even and odd: Gram (G, 2, 2), (G, 2, 2), data (G, 2), (G, 2)


def _rolled(h: _Halves, by: int) -> _Halves:
    """The same run with its frequencies shifted."""
    return np.roll(h[0], by, 0), np.roll(h[1], by, 0), np.roll(h[2], by, 0), np.roll(h[3], by, 0)


def _halves(law: Beside, run: int, f: Array) -> _Halves:
    out: list[Array] = [
        np.zeros((len(f), 2, 2)),
        np.zeros((len(f), 2, 2)),
        np.zeros((len(f), 2)),
        np.zeros((len(f), 2)),
    ]
    for rows, response in zip(law.rows, law.responses, strict=True):
        if response.piece.run == run:
            made = seen(response, f)
            made -= law.u[rows] @ (law.u[rows].T @ made)
            cube = made.reshape(len(made), len(f), 2)
            for k in (0, 1):
                out[k] += np.einsum("nfi,nfj->fij", cube[k::2], cube[k::2])
                out[2 + k] += np.einsum("nfi,n->fi", cube[k::2], law.r[rows][k::2])
    return out[0], out[1], out[2], out[3]


def _waved(halves: Sequence[_Halves]) -> tuple[Array, Array]:
    """Fall of every run's chi-squared with the amplitude of the others (R, G), and what free amplitudes gain (G,)."""
    own, inverses = [], []
    total = np.zeros(len(halves[0][0]))
    for even, odd, b_even, b_odd in halves:
        inverse = np.linalg.pinv(even + odd, rcond=1e-6, hermitian=True)
        wave = np.einsum("fij,fj->fi", inverse, b_even + b_odd)
        own.append(wave)
        inverses.append(np.einsum("fii->f", inverse))
        total += np.einsum("fi,fi->f", wave, b_even + b_odd)
    power = np.array([np.sum(w**2, axis=1) - i for w, i in zip(own, inverses, strict=True)])
    weight = 1 / np.maximum(np.array(inverses), 1e-300) ** 2
    gains = np.zeros_like(power)
    for k, (even, odd, b_even, b_odd) in enumerate(halves):
        others = np.arange(len(halves)) != k
        a = np.sqrt(np.maximum(np.sum((weight * power)[others], axis=0) / np.sum(weight[others], axis=0), 0.0))
        way = np.einsum("fij,fj->fi", np.linalg.pinv(even, rcond=1e-6, hermitian=True), b_even)
        way *= (a / np.maximum(np.linalg.norm(way, axis=1), 1e-300))[:, None]
        gains[k] = 2 * (2 * np.sum(way * b_odd, axis=1) - np.einsum("fi,fij,fj->f", way, odd, way))
    return gains, total


def told(axes: Sequence[Axis]) -> str:
    """What it means, for a person."""
    held = [a for a in axes if a.holds]
    if not held:
        return "The failure does not repeat from run to run: no place, time, velocity or frequency is common to it."
    best = held[0]
    where, why = WHERE[best.axis]
    if best.axis == "phase" and best.frequency is not None:
        where = f"{where} ({best.frequency:.3g} Hz)"
    words = f"The failure repeats {where} in {best.runs} of {best.of} runs: {why}."
    like = [a.axis for a in held[1:] if best.share - a.share < SAME]
    if like:
        names = {"x": "place", "t": "time since release", "v": "velocity", "phase": "phase"}
        words += (
            f" These runs hardly tell this from the same {' or '.join(names[a] for a in like)}; another speed would."
        )
    return words
