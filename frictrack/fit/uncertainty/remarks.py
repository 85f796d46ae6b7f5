"""State what a reader must know of fitted parameters: confused ones, wrong signs, correlated noise, one odd run.

Each run has its own friction level, because surfaces scatter. A wrong frame rate or scale of one run changes its
accelerations by a factor, which the level absorbs exactly: the misfit does not show it, but the level does.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from frictrack.base.number_format import join_words, lower_first
from frictrack.effects import Effect
from frictrack.effects.models import Model
from frictrack.fit.least_squares import Solution, inverse_normal_matrix
from frictrack.fit.uncertainty.reported_values import reported_slots
from frictrack.records import Array

MAX_INFLATION = 300.0  # ratio of standard deviations from which a model is called nearly unidentifiable
MAX_NAMES_LISTED = 6  # parameters listed of one group
NEGATIVE_STD = 3.0  # standard deviations below zero: significantly negative
MIN_OTHER_RUNS = 2  # that agree with each other
MIN_RATIO = 1.3  # of friction levels; smaller differences are usual between repeats of a run
MIN_SPREADS = 5.0  # of the other runs, and standard deviations of the difference


def identifiability_remarks(
    solution: Solution, correlations: Sequence[tuple[str, str, float]], undetermined: Sequence[str]
) -> list[str]:
    """State which parameters are confused with each other, and what would separate them.

    `correlations` are strongly correlated pairs of addresses; `undetermined` addresses have no value.
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
    more = [f"{len(own) - MAX_NAMES_LISTED} more"] if len(own) > MAX_NAMES_LISTED else []
    return join_words([*own[:MAX_NAMES_LISTED], *more])


def inflation(solution: Solution) -> float:
    """Compute how many times the standard deviation of the worst unknown exceeds its value with all others known.

    It is the root of the largest variance inflation factor, friction levels left out (Belsley, Kuh & Welsch 1980,
    Regression Diagnostics, sec. 3.2).
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
    named = _listed_few(group)
    how = f"(correlation up to {strongest:+.3f})".replace("-", "\N{MINUS SIGN}")
    if len(own) == 1:
        return f"{named} of different runs are correlated {how}."
    phases = {f"{e.name}.{p.name}" for e in model.effects for p in e.parameters if p.role == "phase"}
    if len(kinds) == 1 and len(own) == 2 and phases & set(own):
        return f"{named} are correlated {how}, because the phase is defined at release."
    confused, advice = next(_confused(model, kinds), None), deciding_experiment(model, kinds)
    text = f"{named} are hard to distinguish {how}: these runs determine a combination of them better than "
    text += "either" if len(own) == 2 else "each"
    if confused:
        text += f"; {confused[0].kind.replace('_', ' ')} is mistaken for {lower_first(confused[0].mistaken_for)}"
    return f"{text}.{f' To separate them, {lower_first(advice)}.' if advice else ''}"


def deciding_experiment(model: Model, names: Sequence[str]) -> str:
    """Return the run that would separate these effects.

    It comes from a pair that is known to be confused, or else from the last effect of the model that names one.
    """
    confused = list(_confused(model, names))
    confirming = [a.confirm for a, b in confused if b.kind.replace("_", " ") in a.confirm.lower()]
    text = [e.confirm for e in model.effects if e.name in names and e.confirm]
    return next(iter((*confirming, *(a.confirm for a, _ in confused), *reversed(text))), "")


def _confused(model: Model, names: Sequence[str]) -> Iterator[tuple[Effect, Effect]]:
    """Yield pairs of effects of which the first states that it is mistaken for the second; the last effect first."""
    mine = [e for e in model.effects if e.name in names]
    for first in reversed(mine):
        for second in mine:
            if first is not second and second.kind.replace("_", " ") in first.mistaken_for.lower():
                yield first, second


def negative_force_remark(solution: Solution, found: Mapping[str, tuple[float | None, float | None]]) -> Iterator[str]:
    """State which coefficients of passive forces are significantly negative; `found` is value and std by address."""
    for effect in solution.problem.model.effects:
        for p in (p for p in effect.parameters if p.passive):
            value, std = found.get(f"{effect.name}.{p.name}", (None, None))
            if value is not None and std is not None and value < -NEGATIVE_STD * std:
                yield (
                    f"{effect.name}.{p.name} = {value:.3g} {p.unit} is negative: this force would drive the mass. "
                    "Dry friction that falls with the speed looks so, and so do an incline of the wrong sign and a "
                    "drive that was not given"
                )


def correlated_noise_remark(solution: Solution) -> Iterator[str]:
    """State that the noise of neighbouring frames is correlated, how strongly, and over how many frames."""
    pieces = [p for p in solution.problem.pieces if p.correlated]
    if pieces:
        rms, time = pieces[0].correlated
        frames = time / float(np.median(np.diff(pieces[0].t)))
        share = rms**2 / float(np.mean(pieces[0].noise ** 2))
        yield (
            f"the noise is not white: {100 * share:.0f} % of its variance is correlated over {frames:.2g} frames "
            f"({1e3 * time:.2g} ms), as a filter in a sensor, mains or air leave it; deviations and tests take it into "
            "account"
        )


def level_remarks(solution: Solution, covariance: Array, reduced_chi2: float) -> Iterator[str]:
    """State which run has another level of dry friction than all others, and what may cause that.

    The covariance (P, P) is for noise alone; a misfit widens the standard deviations by the root of `reduced_chi2`.
    """
    layout = solution.problem.layout
    at = np.asarray(layout.levels, dtype=int)
    levels = solution.p[at]
    within = covariance[np.ix_(at, at)] * max(1.0, reduced_chi2) / np.outer(levels, levels)
    yield from describe_level_outliers(layout.run_names, levels, within)


def describe_level_outliers(names: Sequence[str], levels: Array, covariance: Array) -> Iterator[str]:
    """Describe every run whose level (R,) differs from all others, which agree; the covariance is of log levels.

    Examples
    --------
    >>> import numpy as np
    >>> names = ["v3", "v5", "v7", "v9"]
    >>> found = describe_level_outliers(names, np.array([1.0, 1.02, 4.0, 0.99]), 1e-4 * np.eye(4))
    >>> next(found).split(":")[0]
    'dry friction in v7 is 3.99 times that in the other runs, which agree within 1.5 %'
    >>> list(describe_level_outliers(names, np.array([1.0, 1.1, 0.9, 1.2]), 1e-4 * np.eye(4)))
    []

    """
    logs = np.log(levels)
    for k, name in enumerate(names) if len(names) > MIN_OTHER_RUNS else ():
        contrast = np.where(np.arange(len(names)) == k, 1.0, -1.0 / (len(names) - 1))
        departure, sigma = float(contrast @ logs), float(np.sqrt(contrast @ covariance @ contrast))
        spread = float(np.std(np.delete(logs, k), ddof=1))
        if abs(departure) < max(np.log(MIN_RATIO), MIN_SPREADS * spread, MIN_SPREADS * sigma):
            continue
        ratio = float(np.exp(departure))
        agreement = f"the other runs, which agree within {100 * spread:.2g} %"
        yield (
            f"dry friction in {name} is {ratio:.3g} times that in {agreement}: check its frame rate "
            f"(one that is {ratio**0.5:.3g} times too high does this), its scale ({ratio:.3g} times), its normal load "
            "and its surface"
        )
