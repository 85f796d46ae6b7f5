"""The ideal detector: how well the best possible analysis of a study could see a hidden effect.

It knows the form of the base law, the noise, the scatter of the friction levels and the form of the effect. It does not
know the starts, the parameters of the law, the levels and the coefficients of the effect, and it scans as many forms as
the diagnosis does. With the sensitivities J of the displacement to all unknowns (levels restrained by their scatter)
and the trace d of the effect, the likelihood ratio is chi-squared with the non-centrality

    rise = min_b |d/noise - J b|^2

The detection limit is the rise that exceeds the threshold of the whole scan in 95 of 100 repeats. Detection limits that
a diagnosis states are compared with it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np
from scipy.special import chndtrinc

from frictrack.base.distributions import chi2_isf
from frictrack.effects import Effect, Path
from frictrack.effects.models import Model
from frictrack.records import Array, Mask
from frictrack.simulate import Trajectory
from frictrack.simulate.dynamics import LinearResponse, Panels, solve_motion
from frictrack.validation.blind.truth import EffectValues, RunTruth, Truth, effect_named

RunValues = list[EffectValues]  # of one effect, run by run; empty in a run without it
ALPHA = 0.005  # false-alarm probability of the candidates' half of a diagnosis
N_CANDIDATES = 25  # effects that are tried; they share alpha equally
FORMS_PER_CELL = 4  # forms of a scan per independent one: its steps are a quarter of a resolution cell
POWER = 0.95
MIN_SPEED = 0.02  # m/s; a slower run counts as stuck
LAW_STEP = 1e-6  # relative step of a parameter of the law
EFFECT_STEP = 1e-3  # relative step of a non-linear parameter of an effect
MIN_SCATTER, MAX_SCATTER, N_SCATTERS = 1e-4, 0.5, 40  # relative; grid on which the likeliest scatter is found
N_PHASES = 8  # tried to find the least favourable one


@cache
def noncentrality_limit(degrees_of_freedom: int, forms: int = 1) -> float:
    """Non-centrality of chi-squared that exceeds the detection threshold in 95 of 100 repeats.

    `forms`: independent forms that are scanned; the threshold is corrected for them (Bonferroni). Returns the rise of
    chi-squared at the detection limit.

    Examples
    --------
    >>> noncentrality_limit(1) < noncentrality_limit(2) < noncentrality_limit(2, forms=100)
    True

    """
    return float(chndtrinc(detection_threshold(degrees_of_freedom, forms), degrees_of_freedom, 1 - POWER))


def detection_threshold(degrees_of_freedom: int, forms: int = 1) -> float:
    """Fall of chi-squared that chance exceeds in a scan with the probability that one candidate may use up."""
    return float(chi2_isf(ALPHA / N_CANDIDATES / forms, degrees_of_freedom))


def degrees_of_freedom(effect: Effect, runs: int) -> int:
    """Count the free coefficients of an effect in a scan.

    `effect`: the effect. A phase doubles a coefficient, and a phase per run does so in each run; `runs`: number of
    runs. Events in single runs are tested one by one, so they count once. Returns at least 1.
    """
    if is_event(effect):
        return 1
    phases = [p for p in effect.parameters if p.role == "phase"]
    sizes = sum(p.linear or p.role == "depth" for p in effect.parameters)
    if not phases:
        return max(sizes, 1)
    return 2 * (runs if phases[0].per_run else 1)


def is_event(effect: Effect) -> bool:
    """Whether the effect is an event at a separate time in each run."""
    return any(p.per_run and p.scan is not None for p in effect.parameters)


@dataclass(frozen=True)
class _LinearisedRun:
    """One run under the base law: motion, moving frames (m of n), paths, response to forces and sensitivities.

    `sensitivity` (m, 2 + P + 1) is the change of x per unit of start, law parameters and level.
    """

    truth: RunTruth
    trajectory: Trajectory
    moving: Mask
    path: Path  # at the nodes
    at_frames: Path
    linear: LinearResponse
    mass: float
    sensitivity: Array


class IdealDetector:
    """Ideal detector of one study.

    Parameters
    ----------
    base_study
        Truth of the study without hidden effects.

    """

    def __init__(self, base_study: Truth) -> None:
        self.base_study = base_study
        self._runs = [_linearise_run(base_study, run) for run in base_study.runs]

    @property
    def trajectories(self) -> list[Trajectory]:
        """Motions of all runs without hidden effects."""
        return [linearised.trajectory for linearised in self._runs]

    def limit(self, effect: Effect) -> float:
        """Rise of chi-squared at which an effect is seen in 95 of 100 repeats; see `noncentrality_limit`."""
        return noncentrality_limit(degrees_of_freedom(effect, len(self.base_study.runs)), self._forms(effect))

    def threshold(self, effect: Effect) -> float:
        """Fall of chi-squared from which an effect counts as seen."""
        return detection_threshold(degrees_of_freedom(effect, len(self.base_study.runs)), self._forms(effect))

    def _forms(self, effect: Effect) -> int:
        """Independent forms of an effect in a scan."""
        span, runs = self.base_study.span(self.trajectories), len(self.base_study.runs)
        scans = [len(p.scan(span)) for p in effect.parameters if p.scan is not None and p.fixed is None]
        forms = int(np.prod(scans)) * (runs if is_event(effect) else 1)
        return max(1, forms // FORMS_PER_CELL)

    def trace_and_rise(self, truth: Truth) -> tuple[Array, float]:
        """Compute the trace of the hidden effects by simulation.

        Returns `trace`, the part of their whitened displacement that law, levels and starts cannot explain, (N +
        runs,). Its squared norm is the rise of chi-squared; `rise`, the rise if the scatter of the levels is not known
        but estimated.
        """
        changes, both_move = [], []
        for linearised, run in zip(self._runs, truth.runs, strict=True):
            full = truth.trajectory(run) if run.values else linearised.trajectory
            changes.append(full.x + full.shift - linearised.trajectory.x)
            both_move.append(linearised.moving & _moving_frames(full))
        split = self._remove_starts(changes, both_move)
        return self._unexplained(*split), self._rise_with_unknown_scatter(*split)

    def linear_trace(self, effect: Effect, values: RunValues) -> Array:
        """Compute the trace of an effect to first order in its size.

        `values`: its parameter values in each run; empty in runs without it. Returns the trace as in `trace_and_rise`,
        (N + runs,).
        """
        moved = [self._response(linearised, effect, own) for linearised, own in zip(self._runs, values, strict=True)]
        return self._unexplained(*self._remove_starts(moved, [linearised.moving for linearised in self._runs]))

    def trace_derivatives(self, effect: Effect, values: RunValues) -> Array:
        """Derivative of the linear trace with respect to each free parameter of an effect, (N + runs, k)."""
        trace, out = self.linear_trace(effect, values), []
        there = [i for i, own in enumerate(values) if own]
        for p in (p for p in effect.parameters if p.fixed is None):
            for rows in [[i] for i in there] if p.per_run else [there]:
                step = 1.0 if p.linear else EFFECT_STEP * max(abs(values[rows[0]][effect.name][p.name]), EFFECT_STEP)
                moved = list(values)
                for i in rows:
                    own = values[i][effect.name]
                    moved[i] = {effect.name: own | {p.name: own[p.name] + step}}
                out.append((self.linear_trace(effect, moved) - trace) / step)
        return np.column_stack(out)

    def sensitivities(self, effect: Effect, values: RunValues) -> list[tuple[Trajectory, Mask, Array, Array]]:
        """For each run: motion, moving frames (n,), and derivatives of x at those m frames.

        The derivatives are with respect to start, law and level, (m, 2 + P + 1), and to the effect, (m,); m per unit.
        """
        pairs = zip(self._runs, values, strict=True)
        return [(s.trajectory, s.moving, s.sensitivity, self._response(s, effect, own)[s.moving]) for s, own in pairs]

    def force_share(self, effect: Effect, values: RunValues) -> float:
        """Root mean square of a hidden force over that of the base law, along the motion of the base law."""
        linearised = self._runs
        more = [self._force(run, effect, own) for run, own in zip(linearised, values, strict=True)]
        whole = [self.base_study.base.force(run.path, self.base_study.law) for run in linearised]
        return float(np.linalg.norm(np.concatenate(more)) / np.linalg.norm(np.concatenate(whole)))

    def _force(self, linearised: _LinearisedRun, effect: Effect, own: EffectValues) -> Array:
        """Force that an effect adds at the nodes, N, (3 p,)."""
        if not own or effect.acts_on == "measurement":
            return np.zeros(len(linearised.path.t))
        more = (self.base_study.base + effect).force(linearised.path, self.base_study.law | own)
        return np.asarray(more - self.base_study.base.force(linearised.path, self.base_study.law))

    def _response(self, linearised: _LinearisedRun, effect: Effect, own: EffectValues) -> Array:
        """Change of the recorded x (n,), m, by an effect to first order."""
        out = np.zeros(len(linearised.trajectory.t))
        if own and effect.acts_on == "measurement":
            coefficients = [own[effect.name][p.name] for p in effect.linear]
            out[linearised.moving] = effect.columns(linearised.at_frames, own[effect.name]) @ coefficients
        elif own:
            g = -self._force(linearised, effect, own)[:, None] / linearised.mass
            out[linearised.moving] = linearised.linear.respond(g, np.zeros((2, 1)))[1][:, 0, 0]
        return out

    def _unexplained(self, a: Array, d: Array) -> Array:
        """Part of whitened changes d (N,) that law and levels with sensitivities a (N, P + runs) cannot explain."""
        n = len(self._runs)
        prior = np.zeros((n, a.shape[1]))
        prior[:, -n:] = np.eye(n) / max(self.base_study.scatter, MIN_SCATTER)
        return unexplained_part(np.append(d, np.zeros(n)), np.vstack([a, prior]))

    def _rise_with_unknown_scatter(self, a: Array, d: Array) -> float:
        """Rise by whitened changes d (N,) at the likeliest scatter of the levels (REML; Harville 1977, JASA 72)."""
        n = len(self._runs)
        norm = np.linalg.norm(a[:, :-n], axis=0)
        law, _ = np.linalg.qr(a[:, :-n] / np.where(norm > 0, norm, 1.0))
        levels, d = (q - law @ (law.T @ q) for q in (a[:, -n:], d))
        gram, on_levels = levels.T @ levels, levels.T @ d
        known = max(self.base_study.scatter, MIN_SCATTER)

        def deviance(tau: float) -> float:
            left = float(d @ d - on_levels @ np.linalg.solve(gram + np.eye(n) / tau**2, on_levels))
            return left + float(np.linalg.slogdet(np.eye(n) + tau**2 * gram)[1])

        min_deviance = min(deviance(tau) for tau in np.geomspace(known, max(MAX_SCATTER, 2 * known), N_SCATTERS))
        return max(min_deviance - float(np.linalg.slogdet(np.eye(n) + known**2 * gram)[1]), 0.0)

    def _remove_starts(self, moved: list[Array], use: list[Mask]) -> tuple[Array, Array]:
        """Whitened sensitivities to law and levels (N, P + runs) and changes of x (N,), with starts projected out.

        `moved` (n,) are the changes of each run, and `use` (n,) its frames that count; the others are zero.
        """
        blocks, n = [], len(self._runs)
        for i, (linearised, change, frames) in enumerate(zip(self._runs, moved, use, strict=True)):
            columns = np.zeros((len(change), 1 + linearised.sensitivity.shape[1]))  # start, law, level, then the change
            columns[linearised.moving, :-1] = linearised.sensitivity
            columns[:, -1] = change
            white = columns[frames] / self.base_study.noise
            q, _ = np.linalg.qr(white[:, :2])
            left = white[:, 2:] - q @ (q.T @ white[:, 2:])
            laws = left.shape[1] - 2
            block = np.zeros((len(frames), laws + n + 1))
            block[np.ix_(frames, [*range(laws), laws + i, laws + n])] = left
            blocks.append(block)
        every = np.vstack(blocks)
        return every[:, :-1], every[:, -1]


def unexplained_part(trace: Array, columns: Array) -> Array:
    """Residual of a trace after a least-squares fit of columns.

    `trace`: values to explain, (N,); `columns`: columns that may explain them, (N, k). Returns the residual, (N,).
    """
    norm = np.linalg.norm(columns, axis=0)
    columns = columns / np.where(norm > 0, norm, 1.0)
    return np.asarray(trace - columns @ np.linalg.lstsq(columns, trace, rcond=1e-11)[0])


def _moving_frames(trajectory: Trajectory) -> Mask:
    """Frames (n,) from the first motion to the first stop."""
    rows = np.flatnonzero(np.abs(trajectory.v) > MIN_SPEED)
    out: Mask = np.zeros(len(trajectory.t), dtype=bool)
    if len(rows):
        stops = np.flatnonzero(np.diff(rows) > 1)
        out[rows[: stops[0] + 1] if len(stops) else rows] = True
    return out


def _linearise_run(truth: Truth, run: RunTruth) -> _LinearisedRun:
    """Simulate one run under the base law and linearise it."""
    trajectory, conditions, base = truth.trajectory(run, hidden=False), truth.conditions(run), truth.base
    moving, s = _moving_frames(trajectory), float(np.sign(run.speed))
    t, x, v = trajectory.t[moving], trajectory.x[moving], trajectory.v[moving]
    push = conditions.drive or np.zeros_like

    def law(x: Array, v: Array, t: Array) -> Array:
        return (push(t) - base.force(conditions.path(x, v, t, s), truth.law)) / conditions.mass

    panels = Panels(t)
    start, a = (float(x[0]), float(v[0])), np.interp(panels.t, trajectory.t, trajectory.a)
    motion, linear = solve_motion(law, panels, start, a)
    path = conditions.path(motion.x, motion.v, panels.t, s)
    inputs = np.column_stack([*_force_sensitivities(base, truth.law, path)]) / -conditions.mass
    _, edges = linear.respond(np.column_stack([np.zeros((len(inputs), 2)), inputs]), np.eye(2, inputs.shape[1] + 2))
    at_frames = conditions.path(x, v, t, s)
    return _LinearisedRun(run, trajectory, moving, path, at_frames, linear, conditions.mass, edges[:, 0, :])


def _force_sensitivities(base: Model, law: EffectValues, path: Path) -> list[Array]:
    """Derivative of the force at the nodes (3 p,) with respect to each free parameter of the law, then to the level."""
    force = base.force(path, law)
    out = []
    for effect in base.effects:
        for p in effect.parameters:
            if p.fixed is None:
                step = LAW_STEP * abs(law[effect.name][p.name])
                own = law[effect.name] | {p.name: law[effect.name][p.name] + step}
                out.append((base.force(path, law | {effect.name: own}) - force) / step)
    heavier = replace(path, load=path.load * (1 + LAW_STEP))
    return [*out, (base.force(heavier, law) - force) / LAW_STEP]


def limits_over_ideal(truth: Truth, limits: Mapping[str, Mapping[str, Any]]) -> dict[str, float]:
    """Divide stated detection limits by those of the ideal detector.

    `truth`: truth of a study without hidden effect; `limits`: `detection_limits` of its diagnosis: value and setting
    ("at") by effect. Returns the ratio by effect; only effects whose size can be compared.
    """
    detector = IdealDetector(truth)
    out = {}
    for name, stated in limits.items():
        if stated["value"] is None or ":" in name or not _comparable(effect_named(name), truth):
            continue
        ideal = ideal_detection_limit(detector, effect_named(name), dict(stated["at"]))
        if ideal is not None:
            out[name] = float(stated["value"]) / ideal
    return out


def _comparable(effect: Effect, truth: Truth) -> bool:
    """Whether an effect has one size, no memory, and needs no signal that the truth lacks.

    A film yields a vertical motion and an angle of each target even where the truth has neither.
    """
    available = {"drive": truth.push, "lift": truth.lift, "clamp_x": truth.clamp, "angle": truth.turn}
    available |= {"earlier": truth.paused}
    known = all(available.get(need, True) for need in effect.needs)
    return known and effect.sized and not effect.memory and not is_event(effect)


def ideal_detection_limit(detector: IdealDetector, effect: Effect, at: dict[str, float]) -> float | None:
    """Smallest size that the ideal detector sees in 95 of 100 repeats.

    Phases and further coefficients take their least favourable values.

    Returns the size in the unit of the effect's first coefficient; None if it can never be seen.
    """
    runs = len(detector.base_study.runs)
    phases = [p.name for p in effect.parameters if p.role == "phase"]
    tried = np.arange(N_PHASES) * np.pi / N_PHASES if phases else [0.0]
    forms = [unit_values(effect, at, dict.fromkeys(phases, float(q)), runs) for q in tried]
    rise = min(_rise(detector, effect, form) for form in forms)
    return float(np.sqrt(detector.limit(effect) / rise)) if rise > 1e-12 else None


def _rise(detector: IdealDetector, effect: Effect, form: RunValues) -> float:
    """Rise of chi-squared by an effect of size one that its further coefficients cannot compensate."""
    first, *others = [p.name for p in effect.linear] or [""]
    left = detector.linear_trace(effect, form)
    for name in others:
        swapped = [{effect.name: values[effect.name] | {first: 0.0, name: 1.0}} for values in form]
        other = detector.linear_trace(effect, swapped)
        left = left - other * float(other @ left) / max(float(other @ other), 1e-300)
    return float(left @ left)


def unit_values(effect: Effect, at: dict[str, float], phases: Mapping[str, float], runs: int) -> RunValues:
    """Parameter values of an effect of size one in each run; its first coefficient is the size.

    `at`, `phases`: values of non-linear parameters and of phases, by name. Returns the values by effect and parameter,
    the same for each run.
    """
    size = next(p.name for p in effect.parameters if p.role in ("amplitude", "depth") or p.linear)
    own = {p.name: p.fixed or 0.0 for p in effect.parameters} | at | dict(phases) | {size: 1.0}
    return [{effect.name: own} for _ in range(runs)]
