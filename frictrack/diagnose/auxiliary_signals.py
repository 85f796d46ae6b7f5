"""Compare other measurements with the residual of a model: vertical motion, further targets and an accelerometer.

They are compared with the residual displacement, where the noise is white, with the model projected out. A series u
enters as a force m u'' and m u' that resists motion (a changing load) or pushes, or as a shift u and u' of the picture;
the first derivative compensates a lag. The p-value comes from random paths (see `surrogates`). A series that explains
much less than the best candidate is no evidence, unless it explains more beside all that was found.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from scipy.fft import dct
from scipy.integrate import cumulative_trapezoid
from scipy.interpolate import CubicSpline

from frictrack.diagnose.compressed import CompressedResidual, compress_residual
from frictrack.diagnose.model_selection import MIN_CHI2_SEPARATED
from frictrack.diagnose.surrogates import SmoothedSignal, detrend, surrogate_p_value
from frictrack.distributions import normal_sf
from frictrack.fit.least_squares import PieceResponse, Solution
from frictrack.motion import derivatives, low_pass, noise_level
from frictrack.records import Array, Displacement, Run

MIN_GAIN_RATIO = 0.9  # of the best candidate's gain that a series must reach
COEFFICIENTS_PER_SIGNAL = 2  # the series and its derivative
MAX_P = 0.01  # significance level of a match
MIN_KNOWN_SHARE = 0.8  # of frames in which a series must be known
MIN_SENSED_SHARE, MIN_SENSED_DIFFERENCE = (
    0.25,
    0.3,
)  # of the residual motion: below is "not sensed"; closer to one is "all sensed"
MIN_CHI2_PER_FREQUENCY = 15.0  # mean over three frequencies, above which the residual is clear
MIN_WEIGHT = 0.1  # of a frequency at which the sensor is informative
MIN_SIGMAS = 5.0  # standard deviations between "all" and "nothing" for a verdict

AuxiliarySignals = Mapping[
    str, Mapping[str, Array]
]  # run -> name -> series at its frames; "accelerometer" in m/s^2, else m
ACTIONS = {  # how a series may act: columns of the force, or of the picture
    "load": "the normal load changes with it",
    "push": "it pushes along the course in either direction of motion",
    "picture": "it moves the picture, not the mass",
}


@dataclass(frozen=True)
class Evidence:
    """A measurement that matches the residual.

    Parameters
    ----------
    kind
        "vertical", "track" or "accelerometer".
    words
        The finding as a sentence.
    share
        Share of the chi-squared above its expectation.
    p
        p-value.
    acts_on
        "force" or "measurement": where the cause must act.
    run
        Name of the run; None for all runs.
    name
        Name of the target.
    curve
        t s, residual and explained displacement m, in the run that shows it best.
    shown
        That run.

    """

    kind: str  # vertical, track or accelerometer
    words: str
    share: float
    p: float
    acts_on: str  # force or measurement: where it puts the cause
    run: str | None = None  # None for all runs together
    name: str = ""
    curve: Mapping[str, Array] = field(default_factory=dict)  # of the run that shows it best
    shown: str = ""  # that run

    def summary(self) -> dict[str, Any]:
        """Return the entry of the JSON."""
        return {key: value for key, value in vars(self).items() if key != "curve"}


@dataclass(frozen=True)
class KnownFindings:
    """What the search found: delta BIC of its best candidate, and the model with all effects found."""

    delta_bic: float = 0.0
    law: Solution | None = None
    names: Sequence[str] = ()


def assess_auxiliary_signals(
    solution: Solution,
    runs: Sequence[Run],
    rng: np.random.Generator,
    auxiliary: AuxiliarySignals | None = None,
    known: KnownFindings | None = None,
) -> list[Evidence]:
    """Find the measurements that match the residual of a fit.

    Parameters
    ----------
    solution
        The fit.
    runs
        Its runs.
    rng
        Random generator.
    auxiliary
        Series of further targets (m) and accelerometers (m/s^2), by run and name.
    known
        What the search found; a series must explain nearly as much, or more beside it.

    Returns
    -------
    list of Evidence
        Largest share first.

    """
    known = known or KnownFindings()
    found, conditional = [], []
    for kind, name, series in _list_signals(runs, auxiliary or {}):
        if match := _significant_match(solution, runs, series, rng, MIN_GAIN_RATIO * known.delta_bic):
            found.append(_to_evidence(kind, name, match, "the model leaves"))
        elif known.law is not None and (match := _significant_match(known.law, runs, series, rng, MIN_CHI2_SEPARATED)):
            conditional.append(_to_evidence(kind, name, match, f"is left beside {' and '.join(known.names)}"))
    sensed = assess_accelerometer(solution, runs, auxiliary or {})
    found += [sensed] if sensed else []
    return [*sorted(found, key=lambda e: -e.share), *sorted(conditional, key=lambda e: -e.share)]


def _significant_match(
    solution: Solution, runs: Sequence[Run], series: Sequence[Array], rng: np.random.Generator, min_gain: float
) -> _SignalMatch | None:
    """Match of a series with the residual; None if it is not significant or gains too little."""
    match = _match_signal(solution, runs, series, rng, min_gain)
    return match if match is not None and match.p <= MAX_P else None


def evidence_curves(found: Sequence[Evidence]) -> dict[str, dict[str, Array]]:
    """Curves for the figures, by index of the evidence."""
    return {f"evidence_{i}": dict(e.curve) for i, e in enumerate(found) if e.curve}


def _list_signals(runs: Sequence[Run], auxiliary: AuxiliarySignals) -> list[tuple[str, str, list[Array]]]:
    """Kind, name and series (n,) per run of everything that was measured in enough frames."""
    out = [("vertical", "the vertical motion of the mass", [run.displacement.y for run in runs])]
    names = dict.fromkeys(n for own in auxiliary.values() for n in own if n != "accelerometer")
    for name in names:
        none = [np.full(len(run.displacement), np.nan) for run in runs]
        series = [auxiliary.get(run.name, {}).get(name, n) for run, n in zip(runs, none, strict=True)]
        out.append(("track", name, series))
    return [(k, n, s) for k, n, s in out if any(np.mean(np.isfinite(u)) > MIN_KNOWN_SHARE for u in s)]


@dataclass(frozen=True)
class _SignalMatch:
    """Best match of a series with the residual."""

    share: float
    p: float
    action: str
    size: float  # of the load: N per kg and m/s^2
    frequency: float  # Hz, where it moves most
    shown: str  # the run in which it shows best
    curve: dict[str, Array]


def _match_signal(
    solution: Solution, runs: Sequence[Run], series: Sequence[Array], rng: np.random.Generator, min_gain: float
) -> _SignalMatch | None:
    """Best mode of action of a series and its p-value; None if it gains less than `min_gain`."""
    smooth = [_smooth_signal(r, runs[r.piece.run], series[r.piece.run]) for r in solution.responses]
    known_series = [s for s in smooth if s is not None]
    if not known_series:
        return None
    compressed = compress_residual(solution)

    def columns(paths: Sequence[Array | None]) -> dict[str, Array]:
        return _signal_traces(compressed, solution, paths)

    traces = {
        action: made[:, :, 0]
        for action, made in columns([None if s is None else s.u[:, :, None] for s in smooth]).items()
    }
    gained = {action: _best_gain(compressed, made) for action, made in traces.items()}
    best = max(gain for gain, _ in gained.values())
    if best - COEFFICIENTS_PER_SIGNAL * np.log(compressed.n_frames) < min_gain:
        return None
    action = next(w for w in ACTIONS if gained[w][0] > best - MIN_CHI2_SEPARATED)
    gain, coefficients = gained[action]
    piece, curve = _largest_piece_curve(compressed, solution, traces[action] @ coefficients)
    return _SignalMatch(
        share=float(np.clip(gain / max(compressed.excess, gain, 1e-300), 0.0, 1.0)),
        p=surrogate_p_value(best, smooth, columns, compressed.residual, rng),
        action=action,
        size=float(coefficients[0]),
        frequency=_dominant_frequency(known_series),
        shown=runs[solution.responses[piece].piece.run].name,
        curve=curve,
    )


def _largest_piece_curve(
    compressed: CompressedResidual, solution: Solution, explained: Array
) -> tuple[int, dict[str, Array]]:
    """Piece in which a trace (M,) is largest, and its residual and explained displacement, m."""
    ends = np.cumsum([len(m) for m in compressed.force_maps])[:-1]
    parts = np.split(explained, ends)
    k = int(np.argmax([float(part @ part) for part in parts]))
    piece = solution.responses[k].piece
    basis = piece.coloured(compressed.components[k])
    return k, {"t": piece.t, "left": basis @ np.split(compressed.residual, ends)[k], "told": basis @ parts[k]}


def _smooth_signal(response: PieceResponse, run: Run, series: Array) -> SmoothedSignal | None:
    """Series of a run along one of its pieces, with derivatives; None if mostly unknown."""
    rows, n = response.piece.frames, len(series)
    u = np.asarray(series, dtype=float)
    known = np.isfinite(u)
    if np.mean(known[rows]) < MIN_KNOWN_SHARE:
        return None
    t, nan = run.displacement.t, np.full(n, np.nan)
    noise = np.full(n, max(float(noise_level(u, known)[0]), 1e-12))
    measured = Displacement(t, np.where(known, u, np.nan), nan, nan, noise, nan, known)
    motion = derivatives(low_pass(measured, method="kalman")).T[rows]
    return SmoothedSignal(response.piece.t, response.model_y, detrend(response.piece.t, motion))


def _signal_traces(
    compressed: CompressedResidual, solution: Solution, series: Sequence[Array | None]
) -> dict[str, Array]:
    """Traces (M, 2, D) of series (n_i, 3, D) in each mode of action, with the model projected out."""
    count = next(u.shape[2] for u in series if u is not None)
    parts: dict[str, list[Array]] = {action: [] for action in ACTIONS}
    for i, (response, u) in enumerate(zip(solution.responses, series, strict=True)):
        if u is None:
            for blocks in parts.values():
                blocks.append(np.zeros((len(compressed.force_maps[i]), 2 * count)))
            continue
        force = response.piece.mass * u[compressed.rows[i], :0:-1].reshape(-1, 2 * count)
        parts["load"].append(compressed.force_maps[i] @ (compressed.paths[i].s[:, None] * force))
        parts["push"].append(compressed.force_maps[i] @ force)
        shift = response.piece.whitened(u[:, :2].reshape(-1, 2 * count))
        parts["picture"].append(compressed.components[i].T @ shift)
    return {
        action: compressed.project_out_model(np.concatenate(blocks)).reshape(-1, 2, count)
        for action, blocks in parts.items()
    }


def _best_gain(compressed: CompressedResidual, columns: Array) -> tuple[float, Array]:
    """Fall of chi-squared with the best coefficients, and these coefficients."""
    norm_ = np.linalg.norm(columns, axis=0)
    norm_[norm_ == 0] = np.inf
    solved = np.linalg.lstsq(columns / norm_, compressed.residual, rcond=1e-6)[0]
    return float(
        compressed.residual @ compressed.residual - np.sum((compressed.residual - columns / norm_ @ solved) ** 2)
    ), solved / norm_


def _dominant_frequency(series: Sequence[SmoothedSignal]) -> float:
    """Frequency of largest power, Hz, in the run with the largest motion."""
    best = max(series, key=lambda m: float(np.sum(m.u[:, 0] ** 2)))
    power = np.abs(np.fft.rfft(best.u[:, 0])) ** 2
    return float(np.fft.rfftfreq(len(best.u), float(np.median(np.diff(best.t))))[int(np.argmax(power))])


def _to_evidence(kind: str, name: str, match: _SignalMatch, what: str) -> Evidence:
    """Describe a match as evidence."""
    words = f"{name} matches {100 * match.share:.0f} % of what {what} (p = {match.p:.2g}): {ACTIONS[match.action]}"
    if match.action == "load" and kind == "vertical":
        words += f", by {abs(match.size):.2g} of its vertical inertia; measured_load takes it into the law"
    if np.isfinite(match.frequency) and match.frequency > 0:
        words += f"; it moves most near {match.frequency:.3g} Hz"
    return Evidence(
        kind=kind,
        words=words,
        share=match.share,
        p=match.p,
        acts_on="measurement" if match.action == "picture" else "force",
        name="" if kind == "vertical" else name,
        curve=match.curve,
        shown=match.shown,
    )


def assess_accelerometer(solution: Solution, runs: Sequence[Run], auxiliary: AuxiliarySignals) -> Evidence | None:
    """Test whether an accelerometer on the mass measures the residual motion.

    The residual displacement is the doubly integrated acceleration beyond the model; the sensor's bias and gain are
    free. If the sensor measures it, the mass moves; if not, the picture does.

    Parameters
    ----------
    solution
        The fit.
    runs
        Its runs.
    auxiliary
        Series by run and name; "accelerometer" in m/s^2.

    Returns
    -------
    Evidence or None
        None without an accelerometer, or if it cannot decide.

    """
    parts, curves, chi2 = [], [], 0.0
    for r in solution.responses:
        run = runs[r.piece.run]
        none = np.full(len(run.displacement), np.nan)
        a = np.asarray(auxiliary.get(run.name, {}).get("accelerometer", none), dtype=float)
        known = np.isfinite(a)
        if np.mean(known[r.piece.frames]) < MIN_KNOWN_SHARE:
            continue
        noise = float(noise_level(a, known)[0])
        t = run.displacement.t
        a = np.interp(t, t[known], a[known])
        parts.append(_by_frequency(r, a, noise))
        columns = _sensor_columns(r, a[r.piece.frames])
        rest = columns[:, 1:] @ np.linalg.lstsq(columns[:, 1:], columns[:, 0] - r.r, rcond=None)[0]
        sensed_displacement = r.piece.coloured(columns[:, 0] - rest)
        curves.append((run.name, {"t": r.piece.t, "left": r.piece.coloured(r.r), "told": sensed_displacement}))
        chi2 += float(r.r @ r.r) - len(r.r)
    if not parts:
        return None
    sensed, observed, noise_of = (np.concatenate(q) for q in zip(*parts, strict=True))
    weight = 1 / (1 + noise_of)
    power = float(weight @ (observed**2 - 1))
    if not power > 0:
        return None
    share = float(weight @ (sensed * observed)) / power
    sigma = float(np.sqrt(weight**2 @ (observed**2 * (noise_of + share**2)))) / power
    judged = _accelerometer_verdict(
        share, sigma, float(np.sum((observed**2 - 1)[weight > MIN_WEIGHT])) / max(chi2, 1e-300)
    )
    shown, curve = max(curves, key=lambda c: float(np.sum(c[1]["left"] ** 2)))
    return None if judged is None else replace(judged, curve=curve, shown=shown)


def _by_frequency(response: PieceResponse, a: Array, noise: float) -> tuple[Array, Array, Array]:
    """Sensed and observed displacement of one piece where the residual is clear, and the sensor's variance there.

    Doubly integrated white noise falls with the fourth power of the frequency.
    """
    columns = _sensor_columns(response, a[response.piece.frames])
    basis, _ = np.linalg.qr(columns[:, 1:])
    both = np.stack([columns[:, 0], response.r], axis=1)
    sensed, observed = dct(both - basis @ (basis.T @ both), axis=0, norm="ortho").T
    t = response.piece.t
    omega = np.pi * np.maximum(np.arange(len(t)), 1) / (t[-1] - t[0])
    visible = np.convolve(observed**2, np.ones(3) / 3, mode="same") > MIN_CHI2_PER_FREQUENCY
    return sensed[visible], observed[visible], ((noise / omega**2 / np.median(response.piece.noise)) ** 2)[visible]


def _sensor_columns(response: PieceResponse, a: Array) -> Array:
    """Displacements of one piece (n, 3) in units of sigma: sensor minus model, sensor gain and sensor bias."""
    piece = response.piece
    model_acceleration = CubicSpline(piece.panels.t, response.motion.a)(piece.t)
    inputs = np.stack([a - model_acceleration, model_acceleration, np.ones_like(model_acceleration)], axis=1)
    speed = cumulative_trapezoid(inputs, piece.t, axis=0, initial=0)
    moved = piece.whitened(cumulative_trapezoid(speed, piece.t, axis=0, initial=0))
    return np.asarray(moved - response.q @ (response.q.T @ moved))


def _accelerometer_verdict(share: float, sigma: float, of_all: float) -> Evidence | None:
    """Verdict of an accelerometer that measures a share of the residual motion; None if it cannot decide."""
    sentence = f"the accelerometer measures {share:.2f} ± {sigma:.2g} of the residual motion that the camera shows"
    if sigma * MIN_SIGMAS > 1:
        return None
    if abs(share - 1) < max(MIN_SENSED_DIFFERENCE, 3 * sigma):
        size, p = float(np.clip(share * of_all, 0.0, 1.0)), float(2 * normal_sf(abs(share) / sigma))
        return Evidence("accelerometer", f"{sentence}: the mass itself moves, no camera shake", size, p, "force")
    if abs(share) < max(MIN_SENSED_SHARE, 3 * sigma):
        size, p = float(np.clip((1 - share) * of_all, 0.0, 1.0)), float(2 * normal_sf(abs(share - 1) / sigma))
        return Evidence("accelerometer", f"{sentence}: the picture shakes, not the mass", size, p, "measurement")
    return None
