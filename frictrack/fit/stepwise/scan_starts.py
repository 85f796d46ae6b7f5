"""Scan an effect beside a fitted model, and take start values from the best grid points, with their coefficients."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from frictrack.effects import Effect
from frictrack.fit.linearised import CandidateScan, LinearisedModel, ScannedSeries, candidate_grids, scan_candidates
from frictrack.fit.stepwise.order import effect_for_scan
from frictrack.fit.stepwise.penalties import EVENT_PARAMETERS, bic_penalty
from frictrack.records import Array

MAX_STARTS = 4  # grid points of one scan that are refined
MIN_GRID_STEPS_APART = 3  # grid steps; closer points count as the same
MIN_GAIN_SHARE = 0.5  # share of the best gain

Pick = tuple[float, dict[str, float], Array]  # gain, grid point, coefficients (K,)
# values by parameter and run (None for all runs), and (effect, run) where the effect is absent
Start = tuple[dict[tuple[str, int | None], float], frozenset[tuple[str, int]]]


def scan_effect(linearised: LinearisedModel, effect: Effect, series: ScannedSeries) -> list[CandidateScan]:
    """Scan an effect beside a fitted model; none if the runs lack what it needs.

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
    return [(effect, [next(scans) for _ in own]) for effect, own in zip(effects, grids, strict=True) if own]


def starts_of_scans(
    linearised: LinearisedModel, effect: Effect, scans: list[CandidateScan], data: Array
) -> list[Start]:
    """Return start values of an effect that is added to a fitted model.

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
    list of Start
        One start of several scans, up to `MAX_STARTS` of one.

    """
    left = linearised.residual_projector(linearised.solution.tau)
    return [_start_values(linearised, effect, picks) for picks in _starts_of_grids(scans, left, data)]


def _starts_of_grids(scans: list[CandidateScan], left: Array, data: Array) -> list[list[Pick]]:
    """Start positions: the best of every grid, or several of a single grid."""
    if len(scans) > 1:
        return [[_best_forms(s, left, data, 1)[0] for s in scans]]
    return [[pick] for pick in _best_forms(scans[0], left, data, MAX_STARTS)]


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


def _start_values(linearised: LinearisedModel, effect: Effect, picks: list[Pick]) -> Start:
    """Start values of the effect's parameters by (name, run), and the runs in which it is absent."""
    runs = range(len(linearised.solution.problem.layout.run_names))
    if effect.single:
        return _event_values(linearised, effect, picks)
    _, point, c = picks[0]
    out: dict[tuple[str, int | None], float] = {}
    for p in effect.nonlinear:
        if p.role not in ("phase", "depth"):
            out |= {(p.name, r): point[p.name] for r in (runs if p.per_run else [None])}
    if not any(p.role == "phase" and p.free for p in effect.parameters):
        return out | _scan_coefficients(effect, c, len(runs)), frozenset()
    size = np.hypot(*c.reshape(-1, 2).T)
    phase = np.arctan2(*c.reshape(-1, 2).T[::-1])
    for p in effect.parameters:
        if p.role == "phase":
            each = phase
        elif p.role in ("amplitude", "depth"):
            each = size if p.per_run else np.mean(size, keepdims=True)
        else:
            continue
        places: list[int | None] = [*runs] if p.per_run else [None]
        out |= {(p.name, r): float(np.resize(each, len(places))[i]) for i, r in enumerate(places)}
    return out, frozenset()


def _scan_coefficients(effect: Effect, c: Array, runs: int) -> dict[tuple[str, int | None], float]:
    """Coefficients of a scan without phases, for every run and for all."""
    amplitudes = [p for p in effect.parameters if p.linear or p.role == "depth"]
    out: dict[tuple[str, int | None], float] = {}
    if not amplitudes:  # a modifier without amplitude, such as a lag
        return out
    for p, column in zip(amplitudes, c.reshape(-1, len(amplitudes)).T, strict=True):
        out |= {(p.name, r): float(v) for r, v in enumerate(np.resize(column, runs))}
        out[p.name, None] = float(np.mean(column))
    return out


def _event_values(linearised: LinearisedModel, effect: Effect, picks: list[Pick]) -> Start:
    """Events of single runs: kept where they gain more than their penalty, at least in the best run."""
    penalty = bic_penalty(EVENT_PARAMETERS, linearised.solution.problem.n_frames)
    gains = np.array([g for g, _, _ in picks])
    kept = np.flatnonzero((gains > penalty) | (gains == gains.max()))
    out: dict[tuple[str, int | None], float] = {}
    for p in effect.parameters:
        if p.linear:
            out |= {(p.name, int(r)): float(picks[r][2][0]) for r in kept}
        elif p.per_run:
            out |= {(p.name, int(r)): picks[r][1][p.name] for r in kept}
        else:
            out[p.name, None] = picks[int(np.argmax(gains))][1][p.name]
    absent = frozenset((effect.name, r) for r in range(len(picks)) if r not in kept)
    return out, absent
