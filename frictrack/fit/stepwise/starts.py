"""Start values of an effect that is added to a fitted model: scan it, and take the best grid points.

Also the order in which effects enter a fit from scratch, and the penalty that each must outweigh.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from frictrack.effects import Effect, Parameter, Tie, Within
from frictrack.effects.models import Model
from frictrack.fit.least_squares import Solution
from frictrack.fit.linearised import CandidateScan, LinearisedModel, ScannedSeries, candidate_grids, scan_candidates
from frictrack.fit.parameters import reported_value
from frictrack.records import Array

EVENT_PARAMETERS = 2.0  # as which an event in one run counts, its moment in addition to its size
MAX_STARTS = 4  # grid points of one scan that are refined
MIN_GRID_STEPS_APART = 3  # grid steps; closer points count as the same
PRIOR_HALF_WIDTH_STD = 4.0  # range of a scan about a prior, standard deviations
MIN_GAIN_SHARE = 0.5  # share of the best gain
Pick = tuple[float, dict[str, float], Array]  # gain, grid point, coefficients (K,)
StartValues = dict[tuple[str, int | None], float]  # by parameter and run (None for all runs)


def bic_penalty(count: float, frames: int) -> float:
    """Return the fall of chi-squared that `count` further parameters must exceed to lower the BIC.

    Parameters
    ----------
    count : float
        Number of further parameters.
    frames : int
        Number of frames that are fitted.

    Returns
    -------
    float
        Natural logarithm of the frames for every parameter.

    Examples
    --------
    >>> round(bic_penalty(2, 1000), 2)  # 2 ln 1000
    13.82

    References
    ----------
    Schwarz (1978), Annals of Statistics 6, 461-464.

    """
    return count * float(np.log(frames))


def entry_order(model: Model) -> tuple[list[Effect], list[Effect]]:
    """Split the effects of a model into those to start from and those to add later.

    Parameters
    ----------
    model : Model
        The model.

    Returns
    -------
    first : list of Effect
        Effects without scanned parameters.
    later : list of Effect
        The others; none is tied to an effect that comes after it, if possible.

    """
    without_scan: list[Effect] = []
    plain = [e for e in model.effects if e.clock is None and not any(p.free for p in e.nonlinear)]
    while ready := [e for e in plain if e not in without_scan and ties_are_resolved(e, without_scan)]:
        without_scan += ready
    later: list[Effect] = []
    while left := [e for e in model.effects if e not in without_scan and e not in later]:
        later.append(next((e for e in left if ties_are_resolved(e, [*without_scan, *later])), left[0]))
    return [e for e in model.effects if e in without_scan], later


def ties_are_resolved(effect: Effect, known_values: Sequence[Effect]) -> bool:
    """Return whether all effects that an effect is tied to are present."""
    leaders = {Tie.read(p.tie).effect for p in effect.parameters if p.tie}
    return leaders <= {effect.name, *(e.name for e in known_values)}


def reversed_ties(model: Model) -> list[Model]:
    """Return the same model with each tie between two scanned effects reversed, one model per tie.

    A scan sees the leading effect first and alone, so the other direction may find a better start.
    """
    out = []
    for e in model.effects:
        for p in (p for p in e.nonlinear if p.tie):
            tie = Tie.read(str(p.tie))
            leader = next(other for other in model.effects if other.name == tie.effect)
            leader_parameter = leader.parameter(tie.parameter)
            if leader is e or not leader_parameter.free or leader_parameter.scan is None or tie.factor == 0:
                continue
            reversed_tie = f"{1 / tie.factor!r}*{e.name}.{p.name}"
            reversed_effects = {
                leader.name: leader.adjusted(**{leader_parameter.name: {"tie": reversed_tie, "prior": None}}),
                e.name: e.adjusted(**{p.name: {"tie": None}}),
            }
            out.append(Model(tuple(reversed_effects.get(o.name, o) for o in model.effects)))
    return out


def model_without(solution: Solution, name: str) -> Model:
    """Return the model without one effect; parameters tied to it are fixed at their current values."""
    model = solution.problem.model
    values, _ = solution.problem.layout.values(solution.p, 0)
    return Model(
        tuple(
            e.adjusted(
                **{
                    p.name: {"tie": None, "fixed": float(reported_value(model, values, e.name, p.name))}
                    for p in e.parameters
                    if p.tie and Tie.read(p.tie).effect == name
                }
            )
            for e in (model - name).effects
        )
    )


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
