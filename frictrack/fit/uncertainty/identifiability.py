"""Find parameters that the runs do not determine: the data do not respond to them, or their profile is not bounded."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from frictrack.effects import Effect
from frictrack.errors import FrictrackError
from frictrack.fit.least_squares import MIN_SINGULAR_VALUE, NORMAL_QUANTILE_975, Solution
from frictrack.fit.parameters import LEVEL, MASS
from frictrack.fit.uncertainty.profile_likelihood import PROBE_MIN_FALL, ProfileSearch
from frictrack.fit.uncertainty.remarks import as_clause, deciding_experiment, join_words
from frictrack.fit.uncertainty.reported_values import parse_quantity, reported_slots
from frictrack.records import Array

# standard deviations of an amplitude from zero, and of a parameter from its bounds: certainly determined
MIN_EVIDENCE, MIN_DISTANCE_STD = 8.0, 20.0
UNDETERMINED_PHASE_STD = np.pi / NORMAL_QUANTILE_975  # rad; the 95 % interval covers the whole circle


def unseen_reasons(solution: Solution, unseen: Array) -> dict[str, str]:
    """Return by address why the linearised model does not determine some unknowns, `unseen` (P,)."""
    layout = solution.problem.layout
    at = reported_slots(layout)
    out = {layout.names[i]: _confused_with(solution, i) for i in at if unseen[i]}
    if MASS in layout.model and unseen[layout.index(MASS, "m")]:
        why = "these runs do not determine the mass, and no force without it"
        out = {layout.names[i]: why for i in at if layout.slots[i].linear} | out
    return out


def _confused_with(solution: Solution, i: int) -> str:
    """Why an unknown is not determined: what it is confused with, and which run would separate them."""
    layout, jac = solution.problem.layout, solution.few_rows
    norm = np.linalg.norm(jac, axis=0)
    if norm[i] == 0:
        return "the runs do not respond to it"
    norm[norm == 0] = 1.0
    _, s, vt = np.linalg.svd(jac / norm, full_matrices=False)
    weight = np.max(np.abs(vt[s <= MIN_SINGULAR_VALUE * s[0]]), axis=0, initial=0.0)
    others = [int(j) for j in np.flatnonzero(weight > 0.05) if j != i and layout.slots[j].effect != LEVEL]
    named = join_words([layout.names[j] for j in others[:3]]) or "the other parameters"
    advice = deciding_experiment(layout.model, [layout.slots[j].effect for j in (i, *others)])
    return f"these runs cannot tell it from {named}{f'; {as_clause(advice)}' if advice else ''}"


def undetermined_reasons(solution: Solution, covariance: Array, *, profiles: bool) -> dict[str, str]:
    """Find non-linear parameters, and F_s, whose profile is not bounded.

    F_s and v_s are reported together: only if the interval of F_s - F_c excludes zero and that of v_s is bounded on
    both sides.

    Parameters
    ----------
    solution : Solution
        The fit.
    covariance : array of shape (P, P)
        Covariance of the unknowns.
    profiles : bool
        Whether profiles are computed. Without them, F_s and v_s alone are judged, by their standard deviations.

    Returns
    -------
    dict of str to str
        Address to reason.

    """
    out: dict[str, str] = {}
    std = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    for effect in solution.problem.model.effects:
        is_whole = effect.kind == "stribeck" and solution.problem.layout.are_shared_unknowns(effect.name, "F_s", "v_s")
        if is_whole and (why := _stribeck_reason(solution, covariance, std, effect, profiles)):
            out |= {f"{effect.name}.{p.name}": why for p in effect.parameters if p.free}
        elif profiles and effect.name != MASS:
            out |= dict(_unbounded_parameters(solution, covariance, std, effect))
    return out


def _stribeck_reason(solution: Solution, covariance: Array, std: Array, effect: Effect, profiles: bool) -> str | None:
    """Why F_s and v_s are not determined; None if they are."""
    layout, p = solution.problem.layout, solution.p
    rise, speed = layout.index(effect.name, "F_s"), layout.index(effect.name, "v_s")
    advice = f"the slowest speed seen is {layout.span.v_min:.2g} m/s: film a run that slows to a stop"
    no_rise, no_speed = "F_s - F_c is not distinguishable from zero", "v_s is not bounded on both sides"
    why: str | None = None
    if not profiles:
        is_rise = p[rise] >= NORMAL_QUANTILE_975 * std[rise]
        is_speed = p[speed] >= NORMAL_QUANTILE_975 * std[speed]
    elif p[rise] > MIN_EVIDENCE * std[rise] and _is_far_from_bounds(solution, std, speed):
        return None
    else:
        has_level = layout.are_shared_unknowns("coulomb", "F_c")  # a fixed Coulomb level is not an unknown
        address = f"{effect.name}.F_s - coulomb.F_c" if has_level else f"{effect.name}.F_s"
        level = 0.0 if has_level else layout.reported_values(p).get("coulomb.F_c", 0.0)
        is_rise = p[rise] > 0 and _probe(solution, covariance, address).excluded(level)
        why = _reason_unbounded(solution, covariance, speed) if is_rise else None
        is_speed = not why
    if is_rise and is_speed:
        return None
    return "; ".join([": ".join(filter(None, [no_speed, why])) if is_rise else no_rise, advice])


def _unbounded_parameters(
    solution: Solution, covariance: Array, std: Array, effect: Effect
) -> Iterator[tuple[str, str]]:
    """Yield the non-linear parameters of one effect that are not bounded on both sides, with the reason."""
    layout = solution.problem.layout
    mine = [(i, s) for i, s in enumerate(layout.slots) if s.effect == effect.name]
    sizes = {p.name for p in effect.parameters if p.linear or p.role == "depth"}
    for i, slot in mine:
        if slot.parameter in sizes:
            continue
        # amplitudes of the same run, or of all runs
        own = [k for k, s in mine if s.parameter in sizes and (None in (s.run, slot.run) or s.run == slot.run)]
        evidence = min((abs(solution.p[k]) / max(std[k], 1e-300) for k in own), default=0.0)
        if effect.parameter(slot.parameter).role == "phase":
            why = f"any phase fits (± {std[i]:.2g} rad)" if std[i] > UNDETERMINED_PHASE_STD else None
        elif evidence > MIN_EVIDENCE and _is_far_from_bounds(solution, std, i):
            continue
        else:
            why = _reason_unbounded(solution, covariance, i)
        if why:
            yield layout.names[i], f"{why}; {as_clause(effect.confirm)}" if effect.confirm else why


def _is_far_from_bounds(solution: Solution, std: Array, i: int) -> bool:
    """Whether an unknown is certainly determined, so far is it from both bounds."""
    low, high = solution.problem.layout.slots[i].bounds
    return bool(min(solution.p[i] - low, high - solution.p[i]) > MIN_DISTANCE_STD * std[i])


def _probe(solution: Solution, covariance: Array, address: str) -> ProfileSearch:
    """A rough profile."""
    quantity = parse_quantity(solution.problem.layout, address)
    return ProfileSearch(solution, quantity, covariance, min_fall=PROBE_MIN_FALL)


def _reason_unbounded(solution: Solution, covariance: Array, i: int) -> str | None:
    """Why the profile of one unknown is unbounded; None if it is bounded on both sides."""
    search = _probe(solution, covariance, solution.problem.layout.names[i])
    try:
        found = [search.bounded(side) for side in (-1, 1)]
    except (FrictrackError, np.linalg.LinAlgError):
        return "its misfit cannot be followed"
    return next((why for is_bounded, why in found if not is_bounded), None)
