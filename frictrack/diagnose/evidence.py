"""First evidence: what else was seen moving in step with what the law leaves.

The vertical motion of the mass, the motion of another target (a beam), and an accelerometer are held against the
residual displacement, where the noise is white, beside the law. A series u enters as a force, m u'' and m u', resisting
motion (a changing load) or plainly (a push), and as a shift of the picture, u and u': the first derivative of each
makes up for a lag. Whether the likeness is chance is told by the same series stretched in time and shifted round in
every run (surrogates: Schreiber & Schmitz 2000, Physica D 142), which keep what the series looks like and nothing else.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from scipy.fft import dct
from scipy.integrate import cumulative_trapezoid
from scipy.interpolate import CubicSpline
from scipy.stats import norm

from frictrack.diagnose.reduced import Reduced, reduced
from frictrack.diagnose.rivals import SAME
from frictrack.fit.simulated.problem import Response
from frictrack.fit.simulated.solve import Solution
from frictrack.motion import differentiate, low_pass, noise_level
from frictrack.records import Array, Displacement, Run

DRAWS = 499
STRETCH = 2.0  # largest factor by which a surrogate is stretched
SURE = 0.01  # p below which a likeness is no chance
KNOWN = 0.8  # share of frames in which a series must be known
SILENT, ALIKE = 0.25, 0.3  # share of the residual's motion: an accelerometer sees less, or differs from all by less
CLEAR = 15.0  # chi-squared per frequency, of three together, from which something is surely seen
WORTH = 0.1  # weight of a frequency at which the sensor tells something
STANDARD = 5.0  # deviations by which it must tell all of it from none

Beside = Mapping[str, Mapping[str, Array]]  # run -> name -> series at its frames; "accelerometer" in m/s^2, else m
WAYS = {  # how a series may act: columns of the force, or of the picture
    "load": "the normal load changes with it",
    "push": "it pushes along the course whichever way the mass goes",
    "picture": "the picture moves with it, not the friction",
}


@dataclass(frozen=True)
class Evidence:
    """Something seen in step with the residual: share of the chi-squared above the noise, and chance."""

    kind: str  # vertical, track or accelerometer
    words: str
    share: float
    p: float
    acts_on: str  # force or measurement: where it puts the cause
    run: str | None = None  # None for all runs together
    name: str = ""
    curve: Mapping[str, Array] = field(default_factory=dict)  # of the run that shows it best: t (s), left and told (m)
    shown: str = ""  # that run

    def summary(self) -> dict[str, Any]:
        """Entry of the JSON."""
        return {key: value for key, value in vars(self).items() if key != "curve"}


def evidence(
    solution: Solution, runs: Sequence[Run], rng: np.random.Generator, beside: Beside | None = None
) -> list[Evidence]:
    """What was seen in step with what a fitted law leaves, the largest share first."""
    found = []
    for kind, name, series in _witnesses(runs, beside or {}):
        seen = _in_step(solution, runs, series, rng)
        if seen is not None and seen.p <= SURE:
            run = runs[solution.responses[seen.piece].piece.run].name
            found.append(replace(_told(kind, name, seen), curve=seen.curve, shown=run))
    felt = sensed(solution, runs, beside or {})
    return sorted([*found, *([felt] if felt else [])], key=lambda e: -e.share)


def curves_of(found: Sequence[Evidence]) -> dict[str, dict[str, Array]]:
    """What a picture of each is drawn from, under the place of each."""
    return {f"evidence_{i}": dict(e.curve) for i, e in enumerate(found) if e.curve}


def _witnesses(runs: Sequence[Run], beside: Beside) -> list[tuple[str, str, list[Array]]]:
    """Kind, name and series (n,) per run of everything that may be in step."""
    out = [("vertical", "the vertical motion of the mass", [run.displacement.y for run in runs])]
    names = dict.fromkeys(n for own in beside.values() for n in own if n != "accelerometer")
    for name in names:
        none = [np.full(len(run.displacement), np.nan) for run in runs]
        series = [beside.get(run.name, {}).get(name, n) for run, n in zip(runs, none, strict=True)]
        out.append(("track", name, series))
    return [(k, n, s) for k, n, s in out if any(np.mean(np.isfinite(u)) > KNOWN for u in s)]


@dataclass(frozen=True)
class _Seen:
    """How a series goes with the residual."""

    share: float
    p: float
    way: str
    size: float  # of the load: N per kg and m/s^2
    frequency: float  # Hz, where it moves most
    piece: int  # the one in which it shows best
    curve: dict[str, Array]


def _in_step(
    solution: Solution, runs: Sequence[Run], series: Sequence[Array], rng: np.random.Generator
) -> _Seen | None:
    """The best of all ways in which a series may act, and its chance among surrogates."""
    smooth = [_smoothed(r, runs[r.piece.run], series[r.piece.run]) for r in solution.responses]
    if all(s is None for s in smooth):
        return None
    left = reduced(solution)
    own = {way: _gain(left, _traces(left, solution, smooth, None)[way]) for way in WAYS}
    best = max(gain for gain, _ in own.values())
    way = next(w for w in WAYS if own[w][0] > best - SAME)
    stretches = np.exp(rng.uniform(-np.log(STRETCH), np.log(STRETCH), DRAWS))
    null = []
    for stretch in stretches:
        traces = _traces(left, solution, smooth, (float(stretch), rng.uniform(size=len(runs))))
        null.append(max(_gain(left, columns)[0] for columns in traces.values()))
    gain, coefficients = own[way]
    piece, curve = _curve(left, solution, _traces(left, solution, smooth, None)[way] @ coefficients)
    chance = float((1 + np.sum(np.array(null) >= best)) / (DRAWS + 1))
    return _Seen(
        share=float(np.clip(gain / max(left.excess, gain, 1e-300), 0.0, 1.0)),
        p=chance,
        way=way,
        size=float(coefficients[0]),
        frequency=_loudest([s for s in smooth if s is not None]),
        piece=piece,
        curve=curve,
    )


def _curve(left: Reduced, solution: Solution, told: Array) -> tuple[int, dict[str, Array]]:
    """The piece in which a trace (M,) is largest: what is left there and what is told, as displacement, m."""
    ends = np.cumsum([len(m) for m in left.maps])[:-1]
    parts = np.split(told, ends)
    k = int(np.argmax([float(part @ part) for part in parts]))
    piece = solution.responses[k].piece
    back = (left.shifts[k] * piece.sigma).T * piece.sigma[:, None]
    return k, {"t": piece.t, "left": back @ np.split(left.left, ends)[k], "told": back @ parts[k]}


@dataclass(frozen=True)
class _Moves:
    """A series along one piece, smoothed: times, and the series with two derivatives, (n, 3); no trend, no mean."""

    t: Array
    u: Array

    def at(self, moved: tuple[float, float] | None) -> Array:
        """At its own times (n, 3), or as a surrogate: stretched, and shifted round by a share of its length."""
        if moved is None:
            return self.u
        length = self.t[-1] - self.t[0]
        there = self.t[0] + ((self.t - self.t[0]) * moved[0] + moved[1] * length) % length
        return np.stack([np.interp(there, self.t, column) for column in self.u.T], axis=1)


def _smoothed(response: Response, run: Run, series: Array) -> _Moves | None:
    """The series of a run along one of its pieces, with derivatives; None where most of it is unknown or still."""
    rows, n = response.piece.frames, len(series)
    u = np.asarray(series, dtype=float)
    known = np.isfinite(u)
    if np.mean(known[rows]) < KNOWN:
        return None
    t, nan = run.displacement.t, np.full(n, np.nan)
    noise = np.full(n, max(float(noise_level(u, known)[0]), 1e-12))
    seen = Displacement(t, np.where(known, u, np.nan), nan, nan, noise, nan, known)
    motion = differentiate(low_pass(seen, method="kalman"))
    both = np.stack([motion.x, motion.v, motion.a], axis=1)[rows]
    trend = np.polynomial.Polynomial.fit(response.piece.t, both[:, 0], 1)
    both[:, 0] -= trend(response.piece.t)
    both[:, 1] -= trend.deriv()(response.piece.t)
    return _Moves(response.piece.t, both)


def _traces(
    left: Reduced, solution: Solution, smooth: Sequence[_Moves | None], moved: tuple[float, Array] | None
) -> dict[str, Array]:
    """What the series leaves in each of its ways beside the law, (M, 2); `moved`: stretch, and shift of every run."""
    parts: dict[str, list[Array]] = {way: [] for way in WAYS}
    for i, (response, u) in enumerate(zip(solution.responses, smooth, strict=True)):
        piece, path = response.piece, left.paths[i]
        count = len(left.maps[i])
        if u is None:
            for way in WAYS:
                parts[way].append(np.zeros((count, 2)))
            continue
        here = u.at(None if moved is None else (moved[0], float(moved[1][piece.run])))
        force = piece.mass * here[left.rows[i]][:, :0:-1]
        parts["load"].append(left.maps[i] @ (path.s[:, None] * force))
        parts["push"].append(left.maps[i] @ force)
        parts["picture"].append(left.shifts[i] @ here[:, :2])
    return {way: left.beside(np.concatenate(blocks)) for way, blocks in parts.items()}


def _gain(left: Reduced, columns: Array) -> tuple[float, Array]:
    """Fall of chi-squared with the best coefficients, and these."""
    norm_ = np.linalg.norm(columns, axis=0)
    norm_[norm_ == 0] = np.inf
    solved = np.linalg.lstsq(columns / norm_, left.left, rcond=1e-6)[0]
    return float(left.left @ left.left - np.sum((left.left - columns / norm_ @ solved) ** 2)), solved / norm_


def _loudest(series: Sequence[_Moves]) -> float:
    """Frequency at which a series moves most, Hz, of the run in which it moves most."""
    best = max(series, key=lambda m: float(np.sum(m.u[:, 0] ** 2)))
    power = np.abs(np.fft.rfft(best.u[:, 0])) ** 2
    return float(np.fft.rfftfreq(len(best.u), float(np.median(np.diff(best.t))))[int(np.argmax(power))])


def _told(kind: str, name: str, seen: _Seen) -> Evidence:
    words = f"{name} goes with {100 * seen.share:.0f} % of what the model leaves (p = {seen.p:.2g}): {WAYS[seen.way]}"
    if seen.way == "load" and kind == "vertical":
        words += f", by {abs(seen.size):.2g} of its vertical inertia; measured_load takes it into the law"
    if np.isfinite(seen.frequency) and seen.frequency > 0:
        words += f"; it moves most near {seen.frequency:.3g} Hz"
    acts_on = "measurement" if seen.way == "picture" else "force"
    return Evidence(kind, words, seen.share, seen.p, acts_on, name="" if kind == "vertical" else name)


def sensed(solution: Solution, runs: Sequence[Run], beside: Beside) -> Evidence | None:
    """Whether an accelerometer on the mass feels what the camera sees beside the model.

    The residual displacement is what acceleration there is beside the model's, integrated twice; the sensor's bias and
    gain are free. Felt: the mass moves so. Not felt: the picture does.
    """
    parts, curves, chi2 = [], [], 0.0
    for r in solution.responses:
        run = runs[r.piece.run]
        none = np.full(len(run.displacement), np.nan)
        a = np.asarray(beside.get(run.name, {}).get("accelerometer", none), dtype=float)
        known = np.isfinite(a)
        if np.mean(known[r.piece.frames]) < KNOWN:
            continue
        noise = float(noise_level(a, known)[0])
        t = run.displacement.t
        a = np.interp(t, t[known], a[known])
        parts.append(_by_frequency(r, a, noise))
        columns = _felt(r, a[r.piece.frames])
        rest = columns[:, 1:] @ np.linalg.lstsq(columns[:, 1:], columns[:, 0] - r.r, rcond=None)[0]
        felt_there = (columns[:, 0] - rest) * r.piece.sigma
        curves.append((run.name, {"t": r.piece.t, "left": r.r * r.piece.sigma, "told": felt_there}))
        chi2 += float(r.r @ r.r) - len(r.r)
    if not parts:
        return None
    felt, seen, noise_of = (np.concatenate(q) for q in zip(*parts, strict=True))
    weight = 1 / (1 + noise_of)
    power = float(weight @ (seen**2 - 1))
    if not power > 0:
        return None
    share = float(weight @ (felt * seen)) / power
    sigma = float(np.sqrt(weight**2 @ (seen**2 * (noise_of + share**2)))) / power
    judged = _judged(share, sigma, float(np.sum((seen**2 - 1)[weight > WORTH])) / max(chi2, 1e-300))
    shown, curve = max(curves, key=lambda c: float(np.sum(c[1]["left"] ** 2)))
    return None if judged is None else replace(judged, curve=curve, shown=shown)


def _by_frequency(response: Response, a: Array, noise: float) -> tuple[Array, Array, Array]:
    """Felt and seen displacement of one piece at the frequencies where something is seen, and the sensor's variance.

    White noise of an acceleration integrated twice falls with the fourth power of the frequency.
    """
    columns = _felt(response, a[response.piece.frames])
    basis, _ = np.linalg.qr(columns[:, 1:])
    both = np.stack([columns[:, 0], response.r], axis=1)
    felt, seen = dct(both - basis @ (basis.T @ both), axis=0, norm="ortho").T
    t = response.piece.t
    omega = np.pi * np.maximum(np.arange(len(t)), 1) / (t[-1] - t[0])
    clear = np.convolve(seen**2, np.ones(3) / 3, mode="same") > CLEAR
    return felt[clear], seen[clear], ((noise / omega**2 / np.median(response.piece.sigma)) ** 2)[clear]


def _felt(response: Response, a: Array) -> Array:
    """Displacement of one piece (n, 3) in units of sigma, start removed: beside the model, of its gain, of its bias."""
    piece = response.piece
    own = CubicSpline(piece.panels.t, response.motion.a)(piece.t)
    inputs = np.stack([a - own, own, np.ones_like(own)], axis=1)
    speed = cumulative_trapezoid(inputs, piece.t, axis=0, initial=0)
    moved = cumulative_trapezoid(speed, piece.t, axis=0, initial=0) / piece.sigma[:, None]
    return np.asarray(moved - response.q @ (response.q.T @ moved))


def _judged(share: float, sigma: float, of_all: float) -> Evidence | None:
    """The verdict of an accelerometer that feels a share of the residual's motion; None where it cannot tell."""
    how = f"the accelerometer feels {share:.2f} ± {sigma:.2g} of the motion that the camera sees beside the model"
    if sigma * STANDARD > 1:
        return None
    if abs(share - 1) < max(ALIKE, 3 * sigma):
        size, p = float(np.clip(share * of_all, 0.0, 1.0)), float(2 * norm.sf(abs(share) / sigma))
        return Evidence("accelerometer", f"{how}: the mass itself moves so, no camera shake", size, p, "force")
    if abs(share) < max(SILENT, 3 * sigma):
        size, p = float(np.clip((1 - share) * of_all, 0.0, 1.0)), float(2 * norm.sf(abs(share - 1) / sigma))
        return Evidence("accelerometer", f"{how}: the picture shakes, not the mass", size, p, "measurement")
    return None
