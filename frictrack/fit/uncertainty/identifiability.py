"""Describe what the runs do not determine: which parameters are confused, why, and which run would separate them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from frictrack.effects import Effect
from frictrack.errors import FrictrackError
from frictrack.fit.least_squares import MIN_SINGULAR_VALUE, NORMAL_QUANTILE_975, Solution, inverse_normal_matrix
from frictrack.fit.parameters import LEVEL, MASS, Slot
from frictrack.fit.uncertainty.profile_likelihood import PROBE_MIN_FALL, ProfileSearch
from frictrack.fit.uncertainty.reported_values import parse_quantity, reported_slots
from frictrack.models import Model
from frictrack.records import Array

# standard deviations of an amplitude from zero, and of a parameter from its bounds: certainly determined
MIN_EVIDENCE, MIN_DISTANCE_STD = 8.0, 20.0
UNDETERMINED_PHASE_STD = np.pi / NORMAL_QUANTILE_975  # rad; the 95 % interval covers the whole circle
MAX_INFLATION = 300.0  # ratio of standard deviations from which a model is called nearly unidentifiable
MAX_NAMES_LISTED = 6  # parameters listed of one group


def undetermined_reasons(solution: Solution, covariance: Array) -> dict[str, str]:
    """Find non-linear parameters, and F_s, whose profile is not bounded.

    F_s and v_s are reported together: only if the interval of F_s - F_c excludes zero and that of v_s is bounded on
    both sides.

    Parameters
    ----------
    solution : Solution
        The fit.
    covariance : array of shape (P, P)
        Covariance of the unknowns.

    Returns
    -------
    dict of str to str
        Address to reason.

    """
    out: dict[str, str] = {}
    for effect in solution.problem.model.effects:
        whole_address = effect.kind == "stribeck" and solution.problem.layout.are_shared_unknowns(
            effect.name, "F_s", "v_s"
        )
        why = _undetermined_stribeck(solution, covariance, effect) if whole_address else None
        if why:
            free = [p.name for p in effect.parameters if p.free]
            out |= {f"{effect.name}.{name}": why for name in free}
        elif effect.name != MASS:
            out |= dict(_unbounded_parameters(solution, covariance, effect))
    return out


def _undetermined_stribeck(solution: Solution, covariance: Array, effect: Effect) -> str | None:
    """Why F_s and v_s are not determined; None if they are."""
    layout = solution.problem.layout
    rise = layout.index(effect.name, "F_s")
    advice_text = f"the slowest speed seen is {layout.span.v_min:.2g} m/s: film a run that slows to a stop"
    std = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    speed = layout.index(effect.name, "v_s")
    if (
        solution.p[rise] > MIN_EVIDENCE * std[rise]
        and _distance_to_bounds(solution, speed) > MIN_DISTANCE_STD * std[speed]
    ):
        return None
    whole_address = f"{effect.name}.F_s"
    has_coulomb_level = layout.are_shared_unknowns("coulomb", "F_c")  # a fixed Coulomb level is not an unknown
    search = ProfileSearch(
        solution,
        parse_quantity(layout, f"{whole_address} - coulomb.F_c" if has_coulomb_level else whole_address),
        covariance,
        min_fall=PROBE_MIN_FALL,
    )
    level = 0.0 if has_coulomb_level else layout.reported_values(solution.p).get("coulomb.F_c", 0.0)
    if solution.p[rise] <= 0 or not search.excluded(level):
        return f"F_s - F_c is not distinguishable from zero; {advice_text}"
    why = _reason_unbounded(solution, covariance, speed)
    return f"v_s is not bounded on both sides: {why}; {advice_text}" if why else None


def _unbounded_parameters(solution: Solution, covariance: Array, effect: Effect) -> Iterator[tuple[str, str]]:
    """Yield the non-linear parameters of one effect that are not bounded on both sides, with the reason."""
    layout = solution.problem.layout
    std = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    sizes = {p.name for p in effect.parameters if p.linear or p.role == "depth"}
    mine = [i for i, s in enumerate(layout.slots) if s.effect == effect.name]
    for i in mine:
        slot = layout.slots[i]
        if slot.parameter in sizes:
            continue
        own = [k for k in mine if layout.slots[k].parameter in sizes and _same_wave(layout.slots[k], slot)]
        significance = [abs(solution.p[k]) / max(std[k], 1e-300) for k in own]
        if effect.parameter(slot.parameter).role == "phase":
            why = f"any phase fits (± {std[i]:.2g} rad)" if std[i] > UNDETERMINED_PHASE_STD else None
        elif (
            min(significance, default=0.0) > MIN_EVIDENCE
            and _distance_to_bounds(solution, i) > MIN_DISTANCE_STD * std[i]
        ):
            continue
        else:
            why = _reason_unbounded(solution, covariance, i)
        if why:
            yield layout.names[i], f"{why}; {as_clause(effect.confirm)}" if effect.confirm else why


def _same_wave(size: Slot, slot: Slot) -> bool:
    """Whether an amplitude belongs to the same run as a non-linear parameter, or one of them to all runs."""
    return size.run is None or slot.run is None or size.run == slot.run


def _distance_to_bounds(solution: Solution, i: int) -> float:
    """Distance of an unknown from its nearer bound."""
    low, high = solution.problem.layout.slots[i].bounds
    return float(min(solution.p[i] - low, high - solution.p[i]))


def _reason_unbounded(solution: Solution, covariance: Array, i: int) -> str | None:
    """Why the profile of one unknown is unbounded; None if it is bounded on both sides."""
    quantity = parse_quantity(solution.problem.layout, solution.problem.layout.names[i])
    search = ProfileSearch(solution, quantity, covariance, min_fall=PROBE_MIN_FALL)
    try:
        found = [search.bounded(side) for side in (-1, 1)]
    except (FrictrackError, np.linalg.LinAlgError):
        return "its misfit cannot be followed"
    return next((why for ends, why in found if not ends), None)


def as_clause(sentence: str) -> str:
    """Return a sentence in the form that it has after a semicolon.

    Examples
    --------
    >>> as_clause("Film a slower run.")
    'film a slower run'

    """
    return sentence[:1].lower() + sentence[1:].rstrip(".")


def correlated_partners(solution: Solution, i: int) -> str:
    """Explain why an unknown is not determined: what it is confused with, and which run would separate them."""
    layout, jac = solution.problem.layout, solution.few_rows
    norm = np.linalg.norm(jac, axis=0)
    if norm[i] == 0:
        return "the runs do not respond to it"
    norm[norm == 0] = 1.0
    _, s, vt = np.linalg.svd(jac / norm, full_matrices=False)
    null = vt[s <= MIN_SINGULAR_VALUE * s[0]]
    weight = np.max(np.abs(null), axis=0, initial=0.0)
    others = [int(j) for j in np.flatnonzero(weight > 0.05) if j != i and layout.slots[j].effect != LEVEL]
    text = (
        f"these runs cannot tell it from {join_words([layout.names[j] for j in others[:3]]) or 'the other parameters'}"
    )
    advice = deciding_experiment(layout.model, [layout.slots[j].effect for j in (i, *others)])
    return f"{text}; {as_clause(advice)}" if advice else text


def identifiability_remarks(
    solution: Solution, correlations: Sequence[tuple[str, str, float]], undetermined: Sequence[str]
) -> list[str]:
    """State which parameters are confused with each other, and what would separate them.

    Parameters
    ----------
    solution : Solution
        The fit.
    correlations : sequence of (str, str, float)
        Strongly correlated pairs.
    undetermined : sequence of str
        Addresses that have no value.

    Returns
    -------
    list of str
        Sentences for the report.

    """
    groups = _correlated_groups(correlations)
    remarks = [_trade_remark(solution.problem.model, group, correlations) for group in groups]
    return remarks + list(_near_degeneracy_remarks(inflation(solution), groups, undetermined))


def _near_degeneracy_remarks(
    inflation_factor: float, groups: Sequence[Sequence[str]], undetermined: Sequence[str]
) -> Iterator[str]:
    """Whether the model as a whole is nearly unidentifiable, and how that shows."""
    lost = [name for name in undetermined if any(name in group for group in groups)]
    linked = [n for g in groups if set(g) & set(lost) for n in g if n not in undetermined]
    if lost:
        with_it = f", and {_listed_few(linked)} {'goes' if len(linked) == 1 else 'go'} with it" if linked else ""
        why = f"{_listed_few(lost)} {'is' if len(lost) == 1 else 'are'} not determined{with_it}"
    elif inflation_factor > MAX_INFLATION:
        why = f"some of its parameters are known {inflation_factor:.0f} times worse together than each would be alone"
    else:
        return
    yield (
        f"This law is nearly unidentifiable from these runs: {why}. Other values predict the same motion: read none "
        "of them by itself; film more kinds of runs, or take a law with fewer parameters."
    )


def _listed_few(names: Sequence[str]) -> str:
    """Addresses as a list in a sentence, without runs; only the first few of many."""
    own = list(dict.fromkeys(name.split("[")[0] for name in names))
    return join_words(
        own if len(own) <= MAX_NAMES_LISTED else [*own[:MAX_NAMES_LISTED], f"{len(own) - MAX_NAMES_LISTED} more"]
    )


def inflation(solution: Solution) -> float:
    """Compute how many times the standard deviation of the worst unknown exceeds its value with all others known.

    Parameters
    ----------
    solution : Solution
        The fit.

    Returns
    -------
    float
        Square root of the largest variance inflation factor, friction levels left out.

    References
    ----------
    Belsley, D. A., Kuh, E. & Welsch, R. E. (1980). Regression Diagnostics, sec. 3.2. Wiley.

    """
    jac = solution.few_rows[:, reported_slots(solution.problem.layout)]
    covariance, _ = inverse_normal_matrix(jac)
    return float(np.max(np.sqrt(np.diag(covariance)) * np.linalg.norm(jac, axis=0), initial=0.0))


def _correlated_groups(correlations: Sequence[tuple[str, str, float]]) -> list[list[str]]:
    """Parameters that correlations link, directly or through others."""
    groups: list[list[str]] = []
    for a, b, _ in correlations:
        linked = [g for g in groups if a in g or b in g]
        merged = list(dict.fromkeys([*(n for g in linked for n in g), a, b]))
        groups = [g for g in groups if g not in linked] + [merged]
    return groups


def _trade_remark(model: Model, group: Sequence[str], correlations: Sequence[tuple[str, str, float]]) -> str:
    """Sentences about one group of confused parameters."""
    strongest = max((r for a, _, r in correlations if a in group), key=abs)
    own = list(dict.fromkeys(name.split("[")[0] for name in group))
    kinds = list(dict.fromkeys(name.split(".")[0] for name in own))
    confirming = _listed_few(group)
    how = f"(correlation up to {strongest:+.3f})".replace("-", "\N{MINUS SIGN}")
    if len(own) == 1:
        return f"{confirming} of different runs are correlated {how}."
    if len(kinds) == 1 and len(own) == 2 and _has_phase(model, own):
        return f"{confirming} are correlated {how}, because the phase is defined at release."
    why, advice = confusion_remark(model, kinds), deciding_experiment(model, kinds)
    each = "either" if len(own) == 2 else "each"
    text = f"{confirming} are hard to distinguish {how}: these runs determine a combination of them better than {each}"
    return f"{text}{f'; {why}' if why else ''}.{f' To separate them, {as_clause(advice)}.' if advice else ''}"


def confusion_remark(model: Model, names: Sequence[str]) -> str:
    """Return which of these effects is mistaken for another, as the effects themselves state."""
    pair = next(_confused_effects(model, names), None)
    return "" if pair is None else f"{pair[0].kind.replace('_', ' ')} is mistaken for {as_clause(pair[0].mistaken_for)}"


def _has_phase(model: Model, addresses: Sequence[str]) -> bool:
    effects = {e.name: e for e in model.effects}
    split = [address.split(".", 1) for address in addresses]
    return any(effects[e].parameter(p).role == "phase" for e, p in split)


def deciding_experiment(model: Model, names: Sequence[str]) -> str:
    """Return the run that would separate these effects.

    It comes from a pair that is known to be confused, or else from the last effect of the model that names one.
    """
    confused = list(_confused_effects(model, names))
    confirming = [a.confirm for a, b in confused if b.kind.replace("_", " ") in a.confirm.lower()]
    text = [e.confirm for e in model.effects if e.name in names and e.confirm]
    return next(iter((*confirming, *(a.confirm for a, _ in confused), *reversed(text))), "")


def _confused_effects(model: Model, names: Sequence[str]) -> Iterator[tuple[Effect, Effect]]:
    """Yield pairs of effects of which the first states that it is mistaken for the second; the last effect first."""
    mine = [e for e in model.effects if e.name in names]
    for first in reversed(mine):
        for second in mine:
            if first is not second and second.kind.replace("_", " ") in first.mistaken_for.lower():
                yield first, second


def join_words(words: Sequence[str]) -> str:
    """Join words as in a sentence.

    Examples
    --------
    >>> join_words(["a", "b", "c"])
    'a, b and c'

    """
    return f"{', '.join(words[:-1])} and {words[-1]}" if len(words) > 1 else "".join(words)
