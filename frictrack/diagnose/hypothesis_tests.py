"""Test whether a model lacks anything, and which effect: p-values for the whole search from null draws."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.fft import dct

from frictrack import effects
from frictrack.diagnose.null_distribution import NullEnsemble
from frictrack.effects import Effect
from frictrack.fit.least_squares import Solution
from frictrack.fit.linearised import (
    CandidateScan,
    LinearisedModel,
    measured_series,
)
from frictrack.fit.stepwise import EVENT_PARAMETERS, bic_penalty, scan_effects, ties_are_resolved
from frictrack.models import Model
from frictrack.records import Array

ALPHA = 0.01  # significance level of one diagnosis: half for lack of fit, half for candidates
COMMON_SCALE_QUANTILE = 0.99  # of each candidate's null distribution, subtracted for a common scale


@dataclass(frozen=True)
class ScannedCandidate:
    """One candidate effect scanned over data and draws.

    Parameters
    ----------
    effect
        The effect.
    scans
        Its scans; one per run for events.
    statistic
        Best gain of chi-squared for data and draws, (D,).
    quantile
        Quantile of its own null distribution, which puts candidates on a common scale.

    """

    effect: Effect
    scans: list[CandidateScan]
    statistic: Array
    quantile: float

    @property
    def excess(self) -> Array:
        """Statistic above its own null quantile, (D,)."""
        return self.statistic - self.quantile


@dataclass(frozen=True)
class SearchTests:
    """Lack of fit and all candidates, calibrated for the whole search.

    Parameters
    ----------
    p_lack_of_fit
        p-value of the lack-of-fit test.
    scanned
        The scanned candidates.
    null
        Largest excess of any candidate in every draw of the null hypothesis, (D - 1,).
    level
        Significance level of each of the two tests: lack of fit, and all candidates together.
    quantiles
        Quantile of every candidate's own null distribution.
    gains
        What every candidate gains in its scan.

    """

    p_lack_of_fit: float
    scanned: list[ScannedCandidate]
    null: Array
    level: float
    quantiles: Mapping[str, float]
    gains: Mapping[str, float]

    @cached_property
    def p(self) -> dict[str, float]:
        """p-value of every candidate."""
        return {name: self.p_of_gain(name, gain) for name, gain in self.gains.items()}

    @property
    def critical(self) -> float:
        """Excess that a search exceeds by chance with probability `level`."""
        return float(np.quantile(self.null, 1 - self.level))

    @property
    def something_is_missing(self) -> bool:
        """Whether the lack of fit or any candidate is significant."""
        return min(self.p_lack_of_fit, *self.p.values(), 1.0) < self.level

    def p_of_gain(self, name: str, gain: float) -> float:
        """p-value of a gain of chi-squared by an effect; one that was not scanned gains by chance what any does."""
        return _p_value(self.null, gain - self.quantiles.get(name, max(self.quantiles.values(), default=0.0)))


def list_candidates(solution: Solution, own: Iterable[Effect] = ()) -> tuple[list[Effect], dict[str, str]]:
    """List the effects that could enter a model.

    An effect that replaces others, such as LuGre, is another model and no candidate; see `effects.laws_in_place_of`.

    Parameters
    ----------
    solution
        The fitted model.
    own
        Effects beside the library's, or library effects with settings of the study.

    Returns
    -------
    found : list of Effect
        Under the names that they would have in the model.
    excluded : dict of str
        Why other effects cannot enter, by name.

    """
    own = list(own)
    model, paths = solution.problem.model, [p.path for p in solution.problem.pieces]
    replaced = frozenset().union(*(e.replaces for e in model.effects))
    kinds = {e.kind for e in model.effects}
    found, excluded = [], {}
    for kind in effects.known(own).values():
        if kind.name != kind.kind or kind.replaces or kind.kind in replaced:
            continue
        if (kind.name in model and not _can_occur_twice(kind)) or (kind.modifies and not kinds & kind.modifies):
            continue
        if kind.acts_on == "measurement" and not solution.problem.simulates:
            continue
        effect = effects.get(model.next_instance(kind.name), own)
        if why := effect.lacks(paths) or _missing_tie(effect, model) or _needs_reversal(effect, solution):
            excluded[effect.name] = why
        else:
            found.append(effect)
    return [*found, *_freed(solution)], excluded


def _freed(solution: Solution) -> list[Effect]:
    """The effects of the model with one parameter freed: one that is fixed, or a place that all runs share."""
    several = len(solution.problem.layout.run_names) > 1
    return [
        e.freed(p.name)
        for e in solution.problem.model.effects
        for p in e.parameters
        if (p.fixed is not None and p.known is None)
        or (several and p.free and p.unit == "m" and not p.per_run and (p.signed or p.linear))
    ]


def _missing_tie(effect: Effect, model: Model) -> str:
    """Why an effect cannot enter alone: it is tied to one that the model lacks; "" if it can."""
    if ties_are_resolved(effect, model.effects):
        return ""
    return f"{effect.name} follows an effect that the model does not have"


def _needs_reversal(effect: Effect, solution: Solution) -> str:
    """Why an effect with memory is not identifiable: in one direction it equals a spring or running-in; "" if it is."""
    if effect.modifies or not (effect.memory and effect.turns):
        return ""
    pieces = solution.problem.pieces
    directions = {(p.run, float(s)) for p in pieces for s in np.sign(p.v_hat if p.turns else p.path.s[-1:])}
    if len({w for w in directions if w[1]}) > len({run for run, s in directions if s}):
        return ""
    return f"{effect.name} needs a run that reverses; let the mass swing to and fro"


def _can_occur_twice(effect: Effect) -> bool:
    """Whether a second effect of the kind is a different cause: another line, time or place."""
    in_place = any(p.signed and p.unit == "m" for p in effect.parameters) and effect.acts_on == "force"
    per_run = any(p.role == "phase" or p.per_run for p in effect.parameters)
    return (per_run or in_place) and any(p.scan is not None and p.free for p in effect.parameters)


def run_tests(
    solution: Solution, draws: NullEnsemble, library: Sequence[Effect], level: float = ALPHA / 2
) -> SearchTests:
    """Test a fitted model for lack of fit and for every candidate.

    Parameters
    ----------
    solution
        The fitted model.
    draws
        Data and draws of the null hypothesis.
    library
        The candidates.
    level
        Significance level of each of the two tests.

    Returns
    -------
    SearchTests

    """
    scanned = []
    for effect, scans in scan_effects(draws.law, library, draws.series):
        statistic = _statistic(draws.law, scans)
        quantile = float(np.quantile(statistic[1:], COMMON_SCALE_QUANTILE))
        scanned.append(ScannedCandidate(effect, scans, statistic, quantile))
    n_draws = draws.series.residuals.shape[1] - 1
    null = np.max([s.excess for s in scanned], axis=0)[1:] if scanned else np.zeros(n_draws)
    quantiles = {s.effect.title: s.quantile for s in scanned}
    gains = {s.effect.title: float(s.statistic[0]) for s in scanned}
    return SearchTests(lack_of_fit(draws), scanned, null, level, quantiles, gains)


def gains_of_library(law: LinearisedModel, library: Sequence[Effect]) -> dict[str, float]:
    """Compute what every candidate gains of the measured series, without draws."""
    scanned = scan_effects(law, library, measured_series(law))
    return {effect.title: float(_statistic(law, scans)[0]) for effect, scans in scanned}


def _statistic(law: LinearisedModel, scans: Sequence[CandidateScan]) -> Array:
    """Best gain of a candidate for every series, (D,). Events of single runs each pay a penalty."""
    tops = np.stack([s.max_gains for s in scans])
    if len(scans) == 1:
        return np.asarray(tops[0])
    left = tops - bic_penalty(EVENT_PARAMETERS, law.solution.problem.n_frames)
    return np.maximum(np.sum(np.maximum(left, 0.0), axis=0), left.max(axis=0))


def _p_value(null: Array, value: float) -> float:
    """Share of the null values, this one included, that reach a value."""
    return float((1 + np.sum(null >= value)) / (len(null) + 1))


def lack_of_fit(draws: NullEnsemble) -> float:
    """Test the residuals for lack of fit against the measured noise.

    The residual of every piece is cosine-transformed. Energies are summed up to growing orders, and the order that
    deviates most is taken, in data and draws alike.

    Parameters
    ----------
    draws
        Data and draws of the null hypothesis.

    Returns
    -------
    float
        p-value.

    References
    ----------
    Fan (1996), J. Am. Stat. Assoc. 91, 674-688: adaptive Neyman test.

    """
    longest = max(rows.stop - rows.start for rows in draws.law.rows)
    orders = [*[2**k for k in range(2, 20) if 2**k < longest], longest]
    sums = np.zeros((len(orders), draws.series.residuals.shape[1]))
    for rows in draws.law.rows:
        energy = dct(draws.series.residuals[rows], axis=0, norm="ortho") ** 2
        sums += np.stack([energy[:order].sum(axis=0) for order in orders])
    center, spread = sums[:, 1:].mean(axis=1), sums[:, 1:].std(axis=1)
    statistic = np.max((sums - center[:, None]) / spread[:, None], axis=0)
    return _p_value(statistic[1:], float(statistic[0]))
