"""First evidence: what else was seen moving in step with what the law leaves.

The vertical motion of the mass, the motion of another target (a beam), and an accelerometer are held against the
residual displacement, where the noise is white, beside the law. A series u enters as a force, m u'' and m u', resisting
motion (a changing load) or plainly (a push), and as a shift of the picture, u and u': the first derivative of each
makes up for a lag. Whether the likeness is chance is told by random paths through the same octaves (`wander`), in the
manner of surrogate data (Schreiber & Schmitz 2000, Physica D 142). What tells much less than the best candidate of the
library is a likeness and no evidence, unless it tells more beside all that was found.
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

from frictrack.diagnose.compressed import CompressedResidual, compress_residual
from frictrack.diagnose.model_selection import MIN_CHI2_SEPARATED
from frictrack.diagnose.surrogates import SmoothedSignal, detrend, surrogate_p_value
from frictrack.fit.least_squares import PieceResponse, Solution
from frictrack.motion import differentiate, low_pass, noise_level
from frictrack.records import Array, Displacement, Run

MIN_GAIN_RATIO = 0.9  # of the worth of the best candidate: what a witness must tell
COEFFICIENTS_PER_SIGNAL = 2  # of a series that acts in one way
MAX_P = 0.01  # p below which a likeness is no chance
MIN_KNOWN_SHARE = 0.8  # share of frames in which a series must be known
MIN_FELT_SHARE, MIN_FELT_DIFFERENCE = (
    0.25,
    0.3,
)  # share of the residual's motion: an accelerometer sees less, or differs from all by less
MIN_CHI2_PER_FREQUENCY = 15.0  # chi-squared per frequency, of three together, from which something is surely seen
MIN_WEIGHT = 0.1  # weight of a frequency at which the sensor tells something
MIN_SIGMAS = 5.0  # deviations by which it must tell all of it from none

AuxiliarySignals = Mapping[
    str, Mapping[str, Array]
]  # run -> name -> series at its frames; "accelerometer" in m/s^2, else m
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


@dataclass(frozen=True)
class KnownFindings:
    """What a diagnosis found by itself: worth of its best candidate (delta BIC), and the law with all that it found."""

    worth: float = 0.0
    law: Solution | None = None
    names: Sequence[str] = ()


def assess_auxiliary_signals(
    solution: Solution,
    runs: Sequence[Run],
    rng: np.random.Generator,
    beside: AuxiliarySignals | None = None,
    known: KnownFindings | None = None,
) -> list[Evidence]:
    """What was seen in step with what a fitted law leaves, the largest share first.

    It tells about as much as the best candidate does, or tells more beside all that was found.
    """
    known = known or KnownFindings()
    found, more = [], []
    for kind, name, series in _list_signals(runs, beside or {}):
        if seen := _significant_match(solution, runs, series, rng, MIN_GAIN_RATIO * known.worth):
            found.append(_to_evidence(kind, name, seen, "the model leaves"))
        elif known.law is not None and (seen := _significant_match(known.law, runs, series, rng, MIN_CHI2_SEPARATED)):
            more.append(_to_evidence(kind, name, seen, f"is left beside {' and '.join(known.names)}"))
    felt = assess_accelerometer(solution, runs, beside or {})
    found += [felt] if felt else []
    return [*sorted(found, key=lambda e: -e.share), *sorted(more, key=lambda e: -e.share)]


def _significant_match(
    solution: Solution, runs: Sequence[Run], series: Sequence[Array], rng: np.random.Generator, least: float
) -> _SignalMatch | None:
    """How a series goes with what a law leaves, where it is no chance and worth so much."""
    seen = _match_signal(solution, runs, series, rng, least)
    return seen if seen is not None and seen.p <= MAX_P else None


def evidence_curves(found: Sequence[Evidence]) -> dict[str, dict[str, Array]]:
    """What a picture of each is drawn from, under the place of each."""
    return {f"evidence_{i}": dict(e.curve) for i, e in enumerate(found) if e.curve}


def _list_signals(runs: Sequence[Run], beside: AuxiliarySignals) -> list[tuple[str, str, list[Array]]]:
    """Kind, name and series (n,) per run of everything that may be in step."""
    out = [("vertical", "the vertical motion of the mass", [run.displacement.y for run in runs])]
    names = dict.fromkeys(n for own in beside.values() for n in own if n != "accelerometer")
    for name in names:
        none = [np.full(len(run.displacement), np.nan) for run in runs]
        series = [beside.get(run.name, {}).get(name, n) for run, n in zip(runs, none, strict=True)]
        out.append(("track", name, series))
    return [(k, n, s) for k, n, s in out if any(np.mean(np.isfinite(u)) > MIN_KNOWN_SHARE for u in s)]


@dataclass(frozen=True)
class _SignalMatch:
    """How a series goes with the residual."""

    share: float
    p: float
    way: str
    size: float  # of the load: N per kg and m/s^2
    frequency: float  # Hz, where it moves most
    shown: str  # the run in which it shows best
    curve: dict[str, Array]


def _match_signal(
    solution: Solution, runs: Sequence[Run], series: Sequence[Array], rng: np.random.Generator, least: float
) -> _SignalMatch | None:
    """The best of all ways in which a series may act, and its chance; None where it is worth less than `least`."""
    smooth = [_smoothed(r, runs[r.piece.run], series[r.piece.run]) for r in solution.responses]
    there = [s for s in smooth if s is not None]
    if not there:
        return None
    left = compress_residual(solution)

    def columns(paths: Sequence[Array | None]) -> dict[str, Array]:
        return _traces(left, solution, paths)

    own = {
        way: made[:, :, 0] for way, made in columns([None if s is None else s.u[:, :, None] for s in smooth]).items()
    }
    gained = {way: _gain(left, made) for way, made in own.items()}
    best = max(gain for gain, _ in gained.values())
    if best - COEFFICIENTS_PER_SIGNAL * np.log(left.n_frames) < least:
        return None
    way = next(w for w in WAYS if gained[w][0] > best - MIN_CHI2_SEPARATED)
    gain, coefficients = gained[way]
    piece, curve = _curve(left, solution, own[way] @ coefficients)
    return _SignalMatch(
        share=float(np.clip(gain / max(left.excess, gain, 1e-300), 0.0, 1.0)),
        p=surrogate_p_value(best, smooth, columns, left.left, rng),
        way=way,
        size=float(coefficients[0]),
        frequency=_dominant_frequency(there),
        shown=runs[solution.responses[piece].piece.run].name,
        curve=curve,
    )


def _curve(left: CompressedResidual, solution: Solution, told: Array) -> tuple[int, dict[str, Array]]:
    """The piece in which a trace (M,) is largest: what is left there and what is told, as displacement, m."""
    ends = np.cumsum([len(m) for m in left.maps])[:-1]
    parts = np.split(told, ends)
    k = int(np.argmax([float(part @ part) for part in parts]))
    piece = solution.responses[k].piece
    back = left.curves[k]
    return k, {"t": piece.t, "left": back @ np.split(left.left, ends)[k], "told": back @ parts[k]}


def _smoothed(response: PieceResponse, run: Run, series: Array) -> SmoothedSignal | None:
    """The series of a run along one of its pieces, with derivatives; None where most of it is unknown."""
    rows, n = response.piece.frames, len(series)
    u = np.asarray(series, dtype=float)
    known = np.isfinite(u)
    if np.mean(known[rows]) < MIN_KNOWN_SHARE:
        return None
    t, nan = run.displacement.t, np.full(n, np.nan)
    noise = np.full(n, max(float(noise_level(u, known)[0]), 1e-12))
    seen = Displacement(t, np.where(known, u, np.nan), nan, nan, noise, nan, known)
    motion = differentiate(low_pass(seen, method="kalman"))
    both = np.stack([motion.x, motion.v, motion.a], axis=1)[rows]
    return SmoothedSignal(response.piece.t, response.model_y, detrend(response.piece.t, both))


def _traces(left: CompressedResidual, solution: Solution, series: Sequence[Array | None]) -> dict[str, Array]:
    """What series (n_i, 3, D) along every piece leave in each of their ways beside the law, (M, 2, D)."""
    count = next(u.shape[2] for u in series if u is not None)
    parts: dict[str, list[Array]] = {way: [] for way in WAYS}
    for i, (response, u) in enumerate(zip(solution.responses, series, strict=True)):
        if u is None:
            for blocks in parts.values():
                blocks.append(np.zeros((len(left.maps[i]), 2 * count)))
            continue
        force = response.piece.mass * u[left.rows[i], :0:-1].reshape(-1, 2 * count)
        parts["load"].append(left.maps[i] @ (left.paths[i].s[:, None] * force))
        parts["push"].append(left.maps[i] @ force)
        parts["picture"].append(left.shifts[i] @ u[:, :2].reshape(-1, 2 * count))
    return {way: left.beside(np.concatenate(blocks)).reshape(-1, 2, count) for way, blocks in parts.items()}


def _gain(left: CompressedResidual, columns: Array) -> tuple[float, Array]:
    """Fall of chi-squared with the best coefficients, and these."""
    norm_ = np.linalg.norm(columns, axis=0)
    norm_[norm_ == 0] = np.inf
    solved = np.linalg.lstsq(columns / norm_, left.left, rcond=1e-6)[0]
    return float(left.left @ left.left - np.sum((left.left - columns / norm_ @ solved) ** 2)), solved / norm_


def _dominant_frequency(series: Sequence[SmoothedSignal]) -> float:
    """Frequency at which a series moves most, Hz, of the run in which it moves most."""
    best = max(series, key=lambda m: float(np.sum(m.u[:, 0] ** 2)))
    power = np.abs(np.fft.rfft(best.u[:, 0])) ** 2
    return float(np.fft.rfftfreq(len(best.u), float(np.median(np.diff(best.t))))[int(np.argmax(power))])


def _to_evidence(kind: str, name: str, seen: _SignalMatch, what: str) -> Evidence:
    words = f"{name} goes with {100 * seen.share:.0f} % of what {what} (p = {seen.p:.2g}): {WAYS[seen.way]}"
    if seen.way == "load" and kind == "vertical":
        words += f", by {abs(seen.size):.2g} of its vertical inertia; measured_load takes it into the law"
    if np.isfinite(seen.frequency) and seen.frequency > 0:
        words += f"; it moves most near {seen.frequency:.3g} Hz"
    return Evidence(
        kind=kind,
        words=words,
        share=seen.share,
        p=seen.p,
        acts_on="measurement" if seen.way == "picture" else "force",
        name="" if kind == "vertical" else name,
        curve=seen.curve,
        shown=seen.shown,
    )


def assess_accelerometer(solution: Solution, runs: Sequence[Run], beside: AuxiliarySignals) -> Evidence | None:
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
        if np.mean(known[r.piece.frames]) < MIN_KNOWN_SHARE:
            continue
        noise = float(noise_level(a, known)[0])
        t = run.displacement.t
        a = np.interp(t, t[known], a[known])
        parts.append(_by_frequency(r, a, noise))
        columns = _sensor_columns(r, a[r.piece.frames])
        rest = columns[:, 1:] @ np.linalg.lstsq(columns[:, 1:], columns[:, 0] - r.r, rcond=None)[0]
        felt_there = r.piece.coloured(columns[:, 0] - rest)
        curves.append((run.name, {"t": r.piece.t, "left": r.piece.coloured(r.r), "told": felt_there}))
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
    judged = _judged(share, sigma, float(np.sum((seen**2 - 1)[weight > MIN_WEIGHT])) / max(chi2, 1e-300))
    shown, curve = max(curves, key=lambda c: float(np.sum(c[1]["left"] ** 2)))
    return None if judged is None else replace(judged, curve=curve, shown=shown)


def _by_frequency(response: PieceResponse, a: Array, noise: float) -> tuple[Array, Array, Array]:
    """Felt and seen displacement of one piece at the frequencies where something is seen, and the sensor's variance.

    White noise of an acceleration integrated twice falls with the fourth power of the frequency.
    """
    columns = _sensor_columns(response, a[response.piece.frames])
    basis, _ = np.linalg.qr(columns[:, 1:])
    both = np.stack([columns[:, 0], response.r], axis=1)
    felt, seen = dct(both - basis @ (basis.T @ both), axis=0, norm="ortho").T
    t = response.piece.t
    omega = np.pi * np.maximum(np.arange(len(t)), 1) / (t[-1] - t[0])
    clear = np.convolve(seen**2, np.ones(3) / 3, mode="same") > MIN_CHI2_PER_FREQUENCY
    return felt[clear], seen[clear], ((noise / omega**2 / np.median(response.piece.noise)) ** 2)[clear]


def _sensor_columns(response: PieceResponse, a: Array) -> Array:
    """Displacement of one piece (n, 3) in units of sigma, start removed: beside the model, of its gain, of its bias."""
    piece = response.piece
    own = CubicSpline(piece.panels.t, response.motion.a)(piece.t)
    inputs = np.stack([a - own, own, np.ones_like(own)], axis=1)
    speed = cumulative_trapezoid(inputs, piece.t, axis=0, initial=0)
    moved = piece.whitened(cumulative_trapezoid(speed, piece.t, axis=0, initial=0))
    return np.asarray(moved - response.q @ (response.q.T @ moved))


def _judged(share: float, sigma: float, of_all: float) -> Evidence | None:
    """The verdict of an accelerometer that feels a share of the residual's motion; None where it cannot tell."""
    how = f"the accelerometer feels {share:.2f} ± {sigma:.2g} of the motion that the camera sees beside the model"
    if sigma * MIN_SIGMAS > 1:
        return None
    if abs(share - 1) < max(MIN_FELT_DIFFERENCE, 3 * sigma):
        size, p = float(np.clip(share * of_all, 0.0, 1.0)), float(2 * norm.sf(abs(share) / sigma))
        return Evidence("accelerometer", f"{how}: the mass itself moves so, no camera shake", size, p, "force")
    if abs(share) < max(MIN_FELT_SHARE, 3 * sigma):
        size, p = float(np.clip((1 - share) * of_all, 0.0, 1.0)), float(2 * norm.sf(abs(share - 1) / sigma))
        return Evidence("accelerometer", f"{how}: the picture shakes, not the mass", size, p, "measurement")
    return None
