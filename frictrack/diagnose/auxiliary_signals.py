"""Compare other measurements with the residual of a model: vertical motion, further targets and an accelerometer.

They are compared with the residual displacement, where the noise is white, with the model projected out. A series u
enters as a force m u'' and m u' that resists motion (a changing load) or pushes, or as a shift u and u' of the picture;
the first derivative compensates a lag. A series that explains much less than the best candidate is no evidence, unless
it explains more than all that was found.

Series that drift resemble each other, so the p-value comes from random paths (surrogate data): sums of cosines with
random amplitudes and the power of the series in every octave. They are drawn anew for every run, and once for all runs
along time since release and along place, because whatever repeats with either is equal in all runs.

References
----------
Theiler et al. (1992), Physica D 58, 77-94.
Schreiber & Schmitz (2000), Physica D 142, 346-382.

"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from scipy.fft import dct
from scipy.integrate import cumulative_trapezoid
from scipy.interpolate import CubicSpline

from frictrack.base.distributions import normal_sf
from frictrack.diagnose.compressed import CompressedResidual, compress_residual
from frictrack.diagnose.examination import ALPHA, p_value
from frictrack.diagnose.model_selection import MIN_CHI2_SEPARATED
from frictrack.fit.least_squares import PieceResponse, Solution
from frictrack.measure.motion import derivatives, low_pass
from frictrack.records import Array, Displacement, Run
from frictrack.sampling import noise_level

MIN_GAIN_RATIO = 0.9  # of the best candidate's gain that a series must reach
COEFFICIENTS_PER_SIGNAL = 2  # the series and its derivative
MIN_KNOWN_SHARE = 0.8  # of frames in which a series must be known
N_DRAWS = 499
MAX_HALF_PERIODS = 127  # of the cosines over a run
MIN_INDEPENDENT_SHARE = 1e-9  # of a second column's square that is independent of the first
MIN_SENSED_SHARE = 0.25  # of the residual motion: less is "not sensed"
MIN_SENSED_DIFFERENCE = 0.3  # closer to one is "all sensed"
MIN_CHI2_PER_FREQUENCY = 15.0  # mean over three frequencies, above which the residual is clear
MIN_WEIGHT = 0.1  # of a frequency at which the sensor is informative
MIN_SIGMAS = 5.0  # standard deviations between "all" and "nothing" for a verdict

# run -> name -> series at its frames; "accelerometer" in m/s^2, else m
AuxiliarySignals = Mapping[str, Mapping[str, Array]]
Paths = Sequence[Array | None]  # series with two derivatives along every piece, (n, 3, D); None if not measured
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


@dataclass(frozen=True)
class SmoothedSignal:
    """A series along one piece, without trend: times s, positions m, (n,), and u with two derivatives, (n, 3)."""

    t: Array
    x: Array
    u: Array


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
        What the search found; a series must explain nearly as much, or some of what that leaves.

    Returns
    -------
    list of Evidence
        Largest share first.

    """
    known = known or KnownFindings()
    found, conditional = [], []
    for signal in _list_signals(runs, auxiliary or {}):
        match = _match_signal(solution, runs, signal, rng, MIN_GAIN_RATIO * known.delta_bic, "the model leaves")
        if match is not None:
            found.append(match)
        elif known.law is not None:
            left = f"is left beside {' and '.join(known.names)}"
            match = _match_signal(known.law, runs, signal, rng, MIN_CHI2_SEPARATED, left)
            conditional += [match] if match is not None else []
    sensed = assess_accelerometer(solution, runs, auxiliary or {})
    found += [sensed] if sensed else []
    return [*sorted(found, key=lambda e: -e.share), *sorted(conditional, key=lambda e: -e.share)]


def evidence_curves(found: Sequence[Evidence]) -> dict[str, dict[str, Array]]:
    """Curves for the figures, by index of the evidence."""
    return {f"evidence_{i}": dict(e.curve) for i, e in enumerate(found) if e.curve}


def _list_signals(runs: Sequence[Run], auxiliary: AuxiliarySignals) -> list[tuple[str, str, list[Array]]]:
    """Kind, name and series (n,) per run of everything that was measured in enough frames."""
    out = [("vertical", "the vertical motion of the mass", [run.displacement.y for run in runs])]
    for name in dict.fromkeys(n for own in auxiliary.values() for n in own if n != "accelerometer"):
        out.append(("track", name, [_series(run, auxiliary, name) for run in runs]))
    return [(k, n, s) for k, n, s in out if any(np.mean(np.isfinite(u)) > MIN_KNOWN_SHARE for u in s)]


def _series(run: Run, auxiliary: AuxiliarySignals, name: str) -> Array:
    """A series of a run, (n,); NaN where it was not measured."""
    series = auxiliary.get(run.name, {}).get(name)
    return np.full(len(run.displacement), np.nan) if series is None else np.asarray(series, dtype=float)


def _match_signal(
    solution: Solution,
    runs: Sequence[Run],
    signal: tuple[str, str, list[Array]],
    rng: np.random.Generator,
    min_gain: float,
    what: str,
) -> Evidence | None:
    """The best mode of action of a series as evidence; None if it gains less than `min_gain` or is insignificant."""
    kind, name, series = signal
    smooth = [_smooth_signal(r, runs[r.piece.run], series[r.piece.run]) for r in solution.responses]
    known = [s for s in smooth if s is not None]
    if not known:
        return None
    compressed = compress_residual(solution)
    traces = _signal_traces(compressed, solution, [None if s is None else s.u[:, :, None] for s in smooth])
    gains = {action: float(_chi2_gains(made, compressed.residual)[0]) for action, made in traces.items()}
    best = max(gains.values())
    if best - COEFFICIENTS_PER_SIGNAL * np.log(compressed.n_frames) < min_gain:
        return None
    p = 0.0
    for paths in _random_paths(smooth, rng):  # the largest p-value over the ways of drawing
        drawn = _signal_traces(compressed, solution, paths).values()
        null = np.max([_chi2_gains(c, compressed.residual) for c in drawn], axis=0)
        p = max(p, p_value(null, best))
    if p > ALPHA:
        return None
    action = next(one for one in ACTIONS if gains[one] > best - MIN_CHI2_SEPARATED)
    columns = traces[action][:, :, 0]
    norm = np.linalg.norm(columns, axis=0)
    norm[norm == 0] = np.inf
    coefficients = np.linalg.lstsq(columns / norm, compressed.residual, rcond=1e-6)[0] / norm
    piece, curve = _largest_piece_curve(compressed, solution, columns @ coefficients)
    share = float(np.clip(gains[action] / max(compressed.excess, gains[action], 1e-300), 0.0, 1.0))
    words = f"{name} matches {100 * share:.0f} % of what {what} (p = {p:.2g}): {ACTIONS[action]}"
    if action == "load" and kind == "vertical":
        words += f", by {abs(coefficients[0]):.2g} of its vertical inertia; measured_load takes it into the law"
    if (frequency := _dominant_frequency(known)) > 0:
        words += f"; it moves most near {frequency:.3g} Hz"
    return Evidence(
        kind=kind,
        words=words,
        share=share,
        p=p,
        acts_on="measurement" if action == "picture" else "force",
        name="" if kind == "vertical" else name,
        curve=curve,
        shown=runs[solution.responses[piece].piece.run].name,
    )


def _smooth_signal(response: PieceResponse, run: Run, series: Array) -> SmoothedSignal | None:
    """Series of a run along one of its pieces, with derivatives; None if mostly unknown."""
    rows, n = response.piece.frames, len(series)
    u = np.asarray(series, dtype=float)
    known = np.isfinite(u)
    if np.mean(known[rows]) < MIN_KNOWN_SHARE:
        return None
    t, nan = run.displacement.t, np.full(n, np.nan)
    noise = np.full(n, max(noise_level(u, known)[0], 1e-12))
    measured = Displacement(t, np.where(known, u, np.nan), nan, nan, noise, nan, known)
    motion = derivatives(low_pass(measured, method="kalman")).T[rows]
    return SmoothedSignal(response.piece.t, response.model_y, _detrend(response.piece.t, motion))


def _detrend(t: Array, u: Array) -> Array:
    """A series with two derivatives in time, (n, 3, ...), without its mean and linear trend."""
    out = u.reshape(len(u), 3, -1).copy()
    line = np.stack([np.ones_like(t), t], axis=1)
    constant, slope = np.linalg.lstsq(line, out[:, 0], rcond=None)[0]
    out[:, 0] -= constant + t[:, None] * slope
    out[:, 1] -= slope
    return out.reshape(u.shape)


def _signal_traces(compressed: CompressedResidual, solution: Solution, series: Paths) -> dict[str, Array]:
    """Traces (M, 2, D) of series (n_i, 3, D) in each mode of action, with the model projected out."""
    count = next(u.shape[2] for u in series if u is not None)
    parts: dict[str, list[Array]] = {action: [] for action in ACTIONS}
    for i, (response, u) in enumerate(zip(solution.responses, series, strict=True)):
        of_force, of_shift = compressed.force_maps[i], compressed.components[i].T
        known = np.zeros((len(response.piece.t), 3, count)) if u is None else u
        force = response.piece.mass * known[compressed.rows[i], :0:-1].reshape(-1, 2 * count)
        parts["load"].append(of_force @ (compressed.paths[i].s[:, None] * force))
        parts["push"].append(of_force @ force)
        parts["picture"].append(of_shift @ response.piece.whitened(known[:, :2].reshape(-1, 2 * count)))
    return {
        action: compressed.project_out_model(np.concatenate(blocks)).reshape(-1, 2, count)
        for action, blocks in parts.items()
    }


def _chi2_gains(columns: Array, residual: Array) -> Array:
    """Fall of chi-squared with the best coefficients of pairs of columns (M, 2, D), (D,)."""
    size = np.linalg.norm(columns, axis=0)
    first, second = columns.transpose(1, 0, 2) / np.where(size > 0, size, np.inf)[:, None]
    a, b, correlation = residual @ first, residual @ second, np.sum(first * second, axis=0)
    free = 1 - correlation**2
    return np.where(
        free > MIN_INDEPENDENT_SHARE,
        a**2 + (b - correlation * a) ** 2 / np.maximum(free, MIN_INDEPENDENT_SHARE),
        np.maximum(a**2, b**2),
    )


def _random_paths(series: Sequence[SmoothedSignal | None], rng: np.random.Generator) -> Iterator[list[Array | None]]:
    """Random paths along every piece, (n, 3, D): new for each run, common in time, common in place."""
    known = [s for s in series if s is not None]
    for axis, is_common in (("t", False), ("t", True), ("x", True)):
        along: list[Array] = [getattr(s, axis) for s in known]
        whole = np.concatenate(along)
        scaled = [_scaled(at, whole if is_common else at) for at in along]
        longest = int(np.argmax([np.ptp(at) for at in along]))
        common = _amplitudes(scaled[longest], known[longest].u[:, 0], rng) if is_common else None
        drawn = iter(
            _random_path(at, s.t, _amplitudes(at, s.u[:, 0], rng) if common is None else common)
            for at, s in zip(scaled, known, strict=True)
        )
        yield [None if s is None else next(drawn) for s in series]


def _scaled(values: Array, whole: Array) -> Array:
    """Values scaled to 0 ... 1 over the whole range."""
    return (values - whole.min()) / max(float(np.ptp(whole)), 1e-12)


def _amplitudes(at: Array, u: Array, rng: np.random.Generator) -> Array:
    """Random amplitudes of cosines (W, D) with the power of a series in every octave along an axis."""
    order = np.argsort(at)
    even = np.interp(np.linspace(at.min(), at.max(), max(len(at), 2 * MAX_HALF_PERIODS)), at[order], u[order])
    power = dct(even - even.mean(), norm="ortho")[1 : MAX_HALF_PERIODS + 1] ** 2
    octave = np.log2(np.arange(1, MAX_HALF_PERIODS + 1)).astype(int)
    mean = np.bincount(octave, power) / np.bincount(octave)
    return np.sqrt(mean[octave])[:, None] * rng.standard_normal((MAX_HALF_PERIODS, N_DRAWS))


def _random_path(at: Array, t: Array, amplitudes: Array) -> Array:
    """Random paths (n, 3, D) along an axis that a piece passes as `at` (n,), with derivatives in time."""
    speed = np.gradient(at, t)
    bend = np.gradient(speed, t)
    wave = np.pi * np.arange(1, MAX_HALF_PERIODS + 1)
    cosine, sine = np.cos(np.outer(at, wave)), np.sin(np.outer(at, wave))
    first = -(sine * wave) @ amplitudes
    second = -(cosine * wave**2) @ amplitudes
    u = np.stack(
        [cosine @ amplitudes, speed[:, None] * first, speed[:, None] ** 2 * second + bend[:, None] * first], axis=1
    )
    return _detrend(t, u)


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


def _dominant_frequency(series: Sequence[SmoothedSignal]) -> float:
    """Frequency of largest power, Hz, in the run with the largest motion."""
    best = max(series, key=lambda m: float(np.sum(m.u[:, 0] ** 2)))
    power = np.abs(np.fft.rfft(best.u[:, 0])) ** 2
    return float(np.fft.rfftfreq(len(best.u), float(np.median(np.diff(best.t))))[int(np.argmax(power))])


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
        a = _series(run, auxiliary, "accelerometer")
        known, t = np.isfinite(a), run.displacement.t
        if np.mean(known[r.piece.frames]) < MIN_KNOWN_SHARE:
            continue
        columns = _sensor_columns(r, np.interp(t, t[known], a[known])[r.piece.frames])
        parts.append(_by_frequency(r, columns, noise_level(a, known)[0]))
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
    of_all = float(np.sum((observed**2 - 1)[weight > MIN_WEIGHT])) / max(chi2, 1e-300)
    judged = _accelerometer_verdict(share, sigma, of_all)
    shown, curve = max(curves, key=lambda c: float(np.sum(c[1]["left"] ** 2)))
    return None if judged is None else replace(judged, curve=curve, shown=shown)


def _by_frequency(response: PieceResponse, columns: Array, noise: float) -> tuple[Array, Array, Array]:
    """Sensed and observed displacement of one piece where the residual is clear, and the sensor's variance there.

    Doubly integrated white noise falls with the fourth power of the frequency.
    """
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
    if sigma * MIN_SIGMAS > 1:
        return None
    sentence = f"the accelerometer measures {share:.2f} ± {sigma:.2g} of the residual motion that the camera shows"
    if abs(share - 1) < max(MIN_SENSED_DIFFERENCE, 3 * sigma):
        meaning, acts_on, explained, departure = "the mass itself moves, no camera shake", "force", share, share
    elif abs(share) < max(MIN_SENSED_SHARE, 3 * sigma):
        meaning, acts_on = "the picture shakes, not the mass", "measurement"
        explained, departure = 1 - share, share - 1
    else:
        return None
    size, p = float(np.clip(explained * of_all, 0.0, 1.0)), float(2 * normal_sf(abs(departure) / sigma))
    return Evidence("accelerometer", f"{sentence}: {meaning}", size, p, acts_on)
