"""Is anything missing, and is it this? p-values for the whole search, from the draws."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.fft import dct

from frictrack import effects
from frictrack.diagnose.null_distribution import Ensemble
from frictrack.effects import Effect
from frictrack.fit.least_squares import Solution
from frictrack.fit.linearised import CandidateScan, candidate_grids, scan_candidate
from frictrack.fit.measured_friction import is_measured_friction
from frictrack.fit.stepwise import EVENT_PENALTY, effect_for_scan, ties_are_resolved
from frictrack.models import Model
from frictrack.records import Array
from frictrack.threads import map_in_threads

ALPHA = 0.01  # half for lack of fit, half for candidates
COMMON_SCALE_QUANTILE = 0.99  # quantile of its own null at which every candidate is put on the common scale


@dataclass(frozen=True)
class ScannedCandidate:
    """One candidate effect scanned over data and draws: its statistic above its own null quantile, (D,)."""

    effect: Effect
    scans: list[CandidateScan]
    statistic: Array
    quantile: float

    @property
    def excess(self) -> Array:
        """Statistic on the common scale."""
        return self.statistic - self.quantile


@dataclass(frozen=True)
class SearchTests:
    """Lack of fit and every candidate, calibrated for the whole search."""

    p_lack_of_fit: float
    scanned: list[ScannedCandidate]
    p: dict[str, float]
    critical: float  # excess that one search in 1/ALPHA * 2 exceeds by chance


def list_candidates(solution: Solution, own: Iterable[Effect] = ()) -> tuple[list[Effect], dict[str, str]]:
    """Every effect that could enter the model, under the name it would have there; and by name why another cannot.

    `own` are effects beside the library's, or some of these as a study sets them. One that takes the place of others,
    such as LuGre, is another law and no missing cause.
    """
    own = list(own)
    model, paths = solution.problem.model, [p.path for p in solution.problem.pieces]
    taken = frozenset().union(*(e.replaces for e in model.effects))
    kinds = {e.kind for e in model.effects}
    found, barred = [], {}
    for kind in effects.known(own).values():
        if kind.name != kind.kind or kind.replaces or kind.kind in taken:
            continue
        if (kind.name in model and not _may_repeat(kind)) or (kind.modifies and not kinds & kind.modifies):
            continue
        if kind.acts_on == "measurement" and is_measured_friction(solution.problem):
            continue
        effect = effects.get(model.next_instance(kind.name), own)
        if why := effect.lacks(paths) or _loose_end(effect, model) or _one_way(effect, solution):
            barred[effect.name] = why
        else:
            found.append(effect)
    return found, barred


def _loose_end(effect: Effect, model: Model) -> str:
    """Why an effect cannot enter a model alone: it is tied to one that is not there; "" where it can."""
    if ties_are_resolved(effect, model.effects):
        return ""
    return f"{effect.name} follows an effect that the model does not have"


def _one_way(effect: Effect, solution: Solution) -> str:
    """Why a memory that stands for itself cannot be told: along one way it is a spring, or a running-in."""
    if effect.modifies or not (effect.memory and effect.turns):
        return ""
    pieces = solution.problem.pieces
    ways = {(p.run, float(s)) for p in pieces for s in np.sign(p.v_hat if p.turns else p.path.s[-1:])}
    if len({w for w in ways if w[1]}) > len({run for run, s in ways if s}):
        return ""
    return f"{effect.name} needs a run that reverses; let the mass swing to and fro"


def _may_repeat(effect: Effect) -> bool:
    """Whether a second cause of the kind would be another one: a line, a moment or a place on the course of its own."""
    places = any(p.signed and p.unit == "m" for p in effect.parameters) and effect.acts_on == "force"
    own = any(p.role == "phase" or p.per_run for p in effect.parameters)
    return (own or places) and any(p.scan is not None and p.free for p in effect.parameters)


def run_tests(solution: Solution, draws: Ensemble, library: Sequence[Effect]) -> SearchTests:
    """Test the fitted model for lack of fit and for every effect of the library."""
    made = map_in_threads(lambda e: _scan(solution, draws, e), library)
    scanned = [s for s in made if s is not None]
    tallest = np.max([s.excess for s in scanned], axis=0) if scanned else np.zeros(draws.series.data.shape[1])
    p = {s.effect.name: _p_value(tallest[1:], s.excess[0]) for s in scanned}
    return SearchTests(
        p_lack_of_fit=lack_of_fit(draws),
        scanned=scanned,
        p=p,
        critical=float(np.quantile(tallest[1:], 1 - ALPHA / 2)),
    )


def _scan(solution: Solution, draws: Ensemble, effect: Effect) -> ScannedCandidate | None:
    made = candidate_grids(draws.law, effect_for_scan(solution, effect))
    if not made:
        return None
    scans = [scan_candidate(draws.law, family, draws.series) for family in made]
    tops = np.stack([s.max_gains for s in scans])
    if len(made) > 1:  # events of single runs: each must pay its price
        price = EVENT_PENALTY * np.log(solution.problem.n_frames)
        statistic = np.maximum(np.sum(np.maximum(tops - price, 0.0), axis=0), tops.max(axis=0) - price)
    else:
        statistic = tops[0]
    quantile = float(np.quantile(statistic[1:], COMMON_SCALE_QUANTILE))
    return ScannedCandidate(effect, scans, statistic, quantile)


def _p_value(null: Array, value: float) -> float:
    return float((1 + np.sum(null >= value)) / (len(null) + 1))


def lack_of_fit(draws: Ensemble) -> float:
    """Adaptive Neyman smooth test of the residuals against the measured noise (Fan 1996), calibrated by the draws.

    The residual of every piece is cosine-transformed; energies are summed up to a growing order, and the order
    that stands out most is taken, in data and draws alike.
    """
    residual = draws.residuals()
    energy = []
    at = 0
    for r in draws.law.solution.responses:
        n = len(r.r)
        energy.append(dct(residual[at : at + n], axis=0, norm="ortho") ** 2)
        at += n
    orders = [2**k for k in range(2, 20) if 2**k < max(len(e) for e in energy)]
    orders.append(max(len(e) for e in energy))
    sums = np.stack([np.sum([e[:order].sum(axis=0) for e in energy], axis=0) for order in orders])
    center, spread = sums[:, 1:].mean(axis=1), sums[:, 1:].std(axis=1)
    statistic = np.max((sums - center[:, None]) / spread[:, None], axis=0)
    return _p_value(statistic[1:], float(statistic[0]))
