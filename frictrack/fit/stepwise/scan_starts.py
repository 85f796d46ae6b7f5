"""Scan an effect added to a fitted model, and take start values from the best grid points, with their coefficients."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from frictrack.effects import Effect, Parameter, Tie, Within
from frictrack.fit.least_squares import Solution
from frictrack.fit.linearised import CandidateScan, LinearisedModel, ScannedSeries, candidate_grids, scan_candidates
from frictrack.fit.parameters import reported_value
from frictrack.fit.stepwise.order import EVENT_PARAMETERS, bic_penalty
from frictrack.records import Array

MAX_STARTS = 4  # grid points of one scan that are refined
MIN_GRID_STEPS_APART = 3  # grid steps; closer points count as the same
PRIOR_HALF_WIDTH_STD = 4.0  # range of a scan about a prior, standard deviations
MIN_GAIN_SHARE = 0.5  # share of the best gain

Pick = tuple[float, dict[str, float], Array]  # gain, grid point, coefficients (K,)
StartValues = dict[tuple[str, int | None], float]  # by parameter and run (None for all runs)


def effect_for_scan(solution: Solution, effect: Effect) -> Effect:
    """Prepare an effect for a scan added to a fitted model.

    Tied parameters are fixed at their current values; priors narrow the range of the scan.

    Parameters
    ----------
    solution : Solution
        The fitted model.
    effect : Effect
        The candidate.

    Returns
    -------
    Effect
        The effect to scan.

    """
    changes: dict[str, dict[str, Any]] = {}
    values, _ = solution.problem.layout.values(solution.p, 0)
    for p in effect.nonlinear:
        tie = Tie.read(p.tie) if p.tie else None
        if tie is not None and tie.effect != effect.name:
            leader = float(reported_value(solution.problem.model, values, tie.effect, tie.parameter))
            changes[p.name] = {"fixed": tie.factor * leader, "tie": None, "per_run": False}
        elif p.fixed is not None and p.per_run:
            changes[p.name] = {"per_run": False}
        elif p.prior is not None and p.scan is not None:
            changes[p.name] = {"scan": _scan_near_prior(p, p.prior)}
    return effect.adjusted(**changes)


def scan_effect(linearised: LinearisedModel, effect: Effect, series: ScannedSeries) -> list[CandidateScan]:
    """Scan an effect added to a fitted model; none if the runs lack what it needs.

    Parameters
    ----------
    linearised : LinearisedModel
        The fitted model.
    effect : Effect
        The candidate.
    series : ScannedSeries
        What it is fitted to, such as `measured_series(linearised)`.

    Returns
    -------
    list of CandidateScan
        One, or one of every run for an event of single runs.

    """
    found = scan_effects(linearised, [effect], series)
    return found[0][1] if found else []


def scan_effects(
    linearised: LinearisedModel, effects: Sequence[Effect], series: ScannedSeries
) -> list[tuple[Effect, list[CandidateScan]]]:
    """Scan several effects, each alone; those for which the runs lack what they need are left out."""
    grids = [candidate_grids(linearised, effect_for_scan(linearised.solution, effect)) for effect in effects]
    scans = iter(scan_candidates(linearised, [grid for own in grids for grid in own], series))
    series.kept.clear()  # tens of megabytes that only scans share
    return [(effect, [next(scans) for _ in own]) for effect, own in zip(effects, grids, strict=True) if own]


def starts_of_scans(
    linearised: LinearisedModel, effect: Effect, scans: list[CandidateScan], data: Array
) -> tuple[list[StartValues], frozenset[tuple[str, int]]]:
    """Return start values of an effect that is added to a fitted model, and the runs in which it is absent.

    Parameters
    ----------
    linearised : LinearisedModel
        The fitted model.
    effect : Effect
        The effect, with the parameters per run that it is to have.
    scans : list of CandidateScan
        Its scans: one, or one of every run for an event of single runs.
    data : array of shape (L,)
        Coordinates of the measured series in `linearised`.

    Returns
    -------
    starts : list of StartValues
        One start of several scans, up to `MAX_STARTS` of one.
    absent : frozenset of (str, int)
        Pairs (effect, run).

    """
    left = linearised.residual_projector(linearised.solution.tau)
    if len(scans) > 1:
        return _event_values(linearised, effect, [_best_forms(s, left, data, 1)[0] for s in scans])
    picks = _best_forms(scans[0], left, data, MAX_STARTS)
    if effect.single:
        return [_event_values(linearised, effect, [pick])[0][0] for pick in picks], frozenset()
    runs = range(len(linearised.solution.problem.layout.run_names))
    return [_start_values(effect, point, c, runs) for _, point, c in picks], frozenset()


def _best_forms(found: CandidateScan, left: Array, data: Array, most: int) -> list[Pick]:
    """Best grid points with coefficients within bounds, none within a few steps of a better one."""
    grid, gains = found.grid, found.gains.copy()
    steps = np.stack(np.unravel_index(np.arange(len(gains)), grid.shape), axis=1)
    out: list[Pick] = []
    while len(out) < most:
        g = int(np.argmax(gains))
        if out and not gains[g] > MIN_GAIN_SHARE * out[0][0]:
            break
        c = found.coefficients(g, left, data)
        if np.all((c >= grid.low) & (c <= grid.high)) or not np.any(np.delete(gains, g) > 0):
            low = np.where(np.isfinite(grid.low), grid.low + 1e-6, -np.inf)
            out.append((float(found.gains[g]), grid.point(g), np.clip(c, low, grid.high)))
            gains[np.all(np.abs(steps - steps[g]) <= MIN_GRID_STEPS_APART, axis=1)] = 0.0
        gains[g] = -1.0
        if not np.any(gains > 0):
            break
    return out


def _start_values(effect: Effect, point: dict[str, float], c: Array, runs: range) -> StartValues:
    """Start values of the effect's parameters at a grid point with its coefficients (K,)."""
    has_phases = any(p.role == "phase" and p.free for p in effect.parameters)
    sized = [p for p in effect.parameters if p.role == "depth" or (p.role == "amplitude" if has_phases else p.linear)]
    each: dict[str, Array] = {
        p.name: np.array([point[p.name]]) for p in effect.nonlinear if p.role not in ("phase", "depth")
    }
    if has_phases:
        sine, cosine = c.reshape(-1, 2).T
        each |= {p.name: np.hypot(sine, cosine) for p in sized}
        each |= {p.name: np.arctan2(cosine, sine) for p in effect.parameters if p.role == "phase"}
    elif sized:  # a modifier without amplitude, such as a lag, has none
        each |= {p.name: column for p, column in zip(sized, c.reshape(-1, len(sized)).T, strict=True)}
    out: StartValues = {}
    for name, values in each.items():
        out |= {(name, r): float(np.resize(values, len(runs))[r]) for r in runs}
        out[name, None] = float(values[0] if effect.parameter(name).role == "phase" else np.mean(values))
    return out


def _event_values(
    linearised: LinearisedModel, effect: Effect, picks: list[Pick]
) -> tuple[list[StartValues], frozenset[tuple[str, int]]]:
    """Events of single runs: kept where they gain more than their penalty, at least in the best run."""
    penalty = bic_penalty(EVENT_PARAMETERS, linearised.solution.problem.n_frames)
    gains = np.array([g for g, _, _ in picks])
    kept = np.flatnonzero((gains > penalty) | (gains == gains.max())).tolist()
    out: StartValues = {}
    for p in effect.parameters:
        if p.linear:
            out |= {(p.name, r): float(picks[r][2][0]) for r in kept}
        elif p.per_run:
            out |= {(p.name, r): picks[r][1][p.name] for r in kept}
        else:
            out[p.name, None] = picks[int(np.argmax(gains))][1][p.name]
    return [out], frozenset((effect.name, r) for r in range(len(picks)) if r not in kept)


def _scan_near_prior(p: Parameter, prior: tuple[float, float]) -> Within:
    """The scan of a parameter within `PRIOR_HALF_WIDTH_STD` standard deviations of its prior."""
    mean, std = prior
    low, high = max(p.bounds[0], mean - PRIOR_HALF_WIDTH_STD * std), min(p.bounds[1], mean + PRIOR_HALF_WIDTH_STD * std)
    return Within((float(low), float(np.nextafter(max(high, low), np.inf))), p.scan)
