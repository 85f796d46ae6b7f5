"""Rate experiments by the evidence expected of them, and propose those that separate the present explanations.

Every candidate run is simulated under each explanation. The others are fitted to all runs including it, without noise.
The misfit that they leave is the expected evidence (T-optimality: Atkinson & Fedorov 1975, Biometrika 62, 57-70).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import combinations, permutations
from math import isfinite
from typing import Any

from frictrack.costs import DEFAULT_COSTS, Costs, RunSettings
from frictrack.diagnose.experiments.advice_text import describe_separation, describe_unseparated, explain_separation
from frictrack.diagnose.experiments.direct_checks import direct_checks
from frictrack.diagnose.experiments.evidence_forecast import EvidenceForecast
from frictrack.diagnose.experiments.expected_separation import FittedExplanation, ModelDiscrimination, make_explanation
from frictrack.diagnose.experiments.menu import Experiment, candidate_experiments
from frictrack.diagnose.experiments.settings import last_settings, settings_of
from frictrack.diagnose.experiments.unknown_cause import explain_by_axes
from frictrack.errors import FrictrackError
from frictrack.fit.least_squares import Solution

MAX_BIC_NEAR = 60.0  # from the best, within which a candidate is worth a run that excludes it
MIN_BIC_SEPARATED = 10.0  # expected difference that separates two explanations
MAX_EXPLANATIONS = 3  # that are compared with each other
MAX_EXPERIMENTS = 5  # that are proposed
AXIS_RUN_KEYS = ("slower", "faster", "to a stop", "reversed", "double mass", "half mass")  # runs that separate axes

Progress = Callable[[str], None]
Pair = tuple[str, str]  # true explanation, the other one


@dataclass(frozen=True)
class RatedExperiment:
    """One experiment with the evidence forecast (difference of BIC) for every (true, other) pair of explanations."""

    key: str
    words: str
    kind: str  # "film" or "measurement"
    evidence: dict[Pair, EvidenceForecast]
    cost: float = 1.0
    settings: RunSettings | None = None  # of a film

    def separated_pairs(self) -> list[Pair]:
        """Pairs of explanations that it separates, whichever is true."""
        return [
            (a, b)
            for a, b in self.evidence
            if a < b and min(self._expected(a, b), self._expected(b, a)) >= MIN_BIC_SEPARATED
        ]

    def min_evidence(self) -> float:
        """Smallest evidence over the pairs that it separates."""
        return min((e.expected for e in self._separating()), default=0.0)

    def _expected(self, true: str, other: str) -> float:
        """Expected evidence of one explanation over another; 0 if there is none."""
        return self.evidence[true, other].expected if (true, other) in self.evidence else 0.0

    def _separating(self) -> list[EvidenceForecast]:
        """Forecasts of the pairs that it separates, whichever is true."""
        return [self.evidence[pair] for a, b in self.separated_pairs() for pair in ((a, b), (b, a))]

    def evidence_per_cost(self) -> float:
        """Evidence over the cost that the user declared."""
        return self.min_evidence() / self.cost

    def least_interval(self) -> tuple[float, float | None]:
        """95 % interval of the smallest evidence over the pairs that it separates."""
        return min(self._separating(), key=lambda e: e.expected).interval()

    def summary(self, explanations: Sequence[FittedExplanation]) -> dict[str, Any]:
        """Entry of the JSON of `frictrack diagnose`."""
        pairs = self.separated_pairs()
        told = [e for e in explanations if any(e.name in pair for pair in pairs)]
        separated = [e.name for e in told]
        each = {n: min(self._expected(n, b) for b in separated if tuple(sorted((n, b))) in pairs) for n in separated}
        single = [e.fitted_effect for e in told if not e.freed]  # a freed value has no invariant of its own
        why = explain_separation(single) if self.kind == "film" else ""
        return {
            "what": f"{self.words}: {why}" if why else self.words,
            "separates": separated,
            "expected_delta_bic": self.min_evidence(),
            "expected_interval": list(self.least_interval()),
            "expected_if_true": each,
            "groups": _group_names(separated, pairs),
            "tells": describe_separation(_group_names(separated, pairs)),
            "kind": self.kind,
            "key": self.key,
            "cost": self.cost,
            "settings": None if self.settings is None else self.settings.summary(),
        }


def _group_names(names: Sequence[str], separated_pairs: Sequence[Pair]) -> list[list[str]]:
    """Group the names that stay inseparable; the largest group is last."""
    groups: list[list[str]] = []
    for name in names:
        joined = [g for g in groups if any(tuple(sorted((name, other))) not in separated_pairs for other in g)]
        groups = [g for g in groups if g not in joined] + [[*(other for g in joined for other in g), name]]
    return sorted(groups, key=len)


def propose_experiments(
    explanations: Sequence[FittedExplanation],
    notify: Progress = lambda what: None,
    keys: Sequence[str] = (),
    costs: Costs = DEFAULT_COSTS,
) -> list[dict[str, Any]]:
    """Propose experiments that separate explanations of the same runs, best first.

    Parameters
    ----------
    explanations
        The explanations, best first; at most `MAX_EXPLANATIONS` are compared.
    notify
        Called with the current step.
    keys
        Keys of the candidate runs to rate; all by default.
    costs
        Costs of the experiments.

    Returns
    -------
    list of dict
        JSON entries. A pair that no run separates gets an entry that names other measurements.

    """
    explanations = list(explanations)[:MAX_EXPLANATIONS]
    if len(explanations) < 2 or any(not e.solution.problem.simulates for e in explanations):
        return []
    names = [e.name for e in explanations]
    rated = [
        experiment
        for experiment in (
            *(rate_runs(explanations, notify, keys, costs) if _are_coasting(explanations) else ()),
            *rate_direct_checks(explanations, costs),
        )
        if experiment.separated_pairs()
    ]
    out = [experiment.summary(explanations) for experiment in _rank(rated)[:MAX_EXPERIMENTS]]
    remaining = [
        pair for pair in combinations(names, 2) if not any(tuple(sorted(pair)) in o.separated_pairs() for o in rated)
    ]
    return out + [_inseparable_entry(pair, explanations) for pair in remaining if _are_coasting(explanations)]


def plan_for_unexplained(
    solution: Solution, notify: Progress = lambda what: None, costs: Costs = DEFAULT_COSTS
) -> list[dict[str, Any]]:
    """Propose runs that tell whether an unexplained force depends on place, time or speed.

    Parameters
    ----------
    solution
        The fitted model that leaves it.
    notify
        Called with the current step.
    costs
        Costs of the experiments.

    Returns
    -------
    list of dict
        JSON entries; empty for measured friction and for runs with reversals.

    """
    if not solution.problem.simulates or any(p.turns or p.cut for p in solution.problem.pieces):
        return []
    return propose_experiments(explain_by_axes(solution), notify, AXIS_RUN_KEYS, costs)


def plan_for_candidates(
    bare: Solution,
    passing: Sequence[tuple[str, Solution, float]],
    rivals: Sequence[str],
    notify: Progress = lambda what: None,
    costs: Costs = DEFAULT_COSTS,
) -> list[dict[str, Any]]:
    """Propose experiments that separate the candidates of a diagnosis.

    Parameters
    ----------
    bare
        The model without any candidate.
    passing
        Name, fit and difference of BIC of the passing candidates, best first.
    rivals
        Names of those that the runs cannot distinguish from the best. They are compared, and so are those within
        `MAX_BIC_NEAR` of it.
    notify
        Called with the current step.
    costs
        Costs of the experiments.

    Returns
    -------
    list of dict
        JSON entries.

    """
    if not passing:
        return []
    best, _, best_gain = passing[0]
    close = [c for c in passing if c[0] == best or c[0] in rivals or best_gain - c[2] < MAX_BIC_NEAR]
    close.sort(key=lambda c: (c[0] != best, c[0] not in rivals, -c[2]))
    close = close[:MAX_EXPLANATIONS]
    return propose_experiments([make_explanation(n, s, bare) for n, s, _ in close], notify, costs=costs)


def _rank(rated: Sequence[RatedExperiment]) -> list[RatedExperiment]:
    """Order experiments: first the one that separates most pairs for its cost, then by the pairs that are left."""
    remaining, out = list(rated), []
    open_pairs: set[Pair] = set()
    while remaining:
        open_pairs = open_pairs or {pair for o in remaining for pair in o.separated_pairs()}
        best = max(remaining, key=lambda o: (_pairs_per_cost(o, open_pairs), o.evidence_per_cost()))
        open_pairs -= set(best.separated_pairs())
        if not any(open_pairs & set(o.separated_pairs()) for o in remaining):
            open_pairs = set()
        remaining.remove(best)
        out.append(best)
    return out


def _pairs_per_cost(rated: RatedExperiment, open_pairs: set[Pair]) -> float:
    """Open pairs that an experiment separates, over its cost (greedy set cover: Chvatal 1979)."""
    return len(open_pairs & set(rated.separated_pairs())) / rated.cost


def rate_runs(
    explanations: Sequence[FittedExplanation],
    notify: Progress = lambda what: None,
    keys: Sequence[str] = (),
    costs: Costs = DEFAULT_COSTS,
) -> Iterator[RatedExperiment]:
    """Rate every candidate run, or those with some keys.

    Parameters
    ----------
    explanations
        The explanations to separate.
    notify
        Called with the current step.
    keys
        Keys of the runs to rate; all by default.
    costs
        Costs of the runs; those that the set-up cannot do are left out.

    Yields
    ------
    RatedExperiment

    """
    discriminations = {(a.name, b.name): ModelDiscrimination(a, b) for a, b in permutations(explanations, 2)}
    solution = explanations[0].solution
    last = last_settings(solution)
    for entry in (e for e in candidate_experiments(solution, costs) if not keys or e.key in keys):
        settings = settings_of(solution, entry.design)
        cost = costs.of_run(settings, last)
        if isfinite(cost):
            notify(f"weighing an experiment: {entry.key}")
            evidence = _evidence_both_ways(discriminations, entry)
            yield RatedExperiment(entry.key, entry.words, "film", evidence, cost, settings)


def _evidence_both_ways(
    discriminations: dict[Pair, ModelDiscrimination], entry: Experiment
) -> dict[Pair, EvidenceForecast]:
    """Expected evidence of a run for every pair; the reverse is skipped once one direction is too weak."""
    out: dict[Pair, EvidenceForecast] = {}
    for (true, other), discrimination in discriminations.items():
        reverse = out.get((other, true))
        if reverse is None or reverse.expected >= MIN_BIC_SEPARATED:
            with suppress(FrictrackError):  # a run that cannot be simulated
                out[true, other] = discrimination.forecast_after(entry.design)
    return out


def rate_direct_checks(
    explanations: Sequence[FittedExplanation], costs: Costs = DEFAULT_COSTS
) -> Iterator[RatedExperiment]:
    """Rate the direct checks that need no further run."""
    made: dict[str, RatedExperiment] = {}
    for one, other in combinations(explanations, 2):
        for check, if_one, if_other in direct_checks(one, other):
            experiment = made.setdefault(
                check.key,
                RatedExperiment(check.key, check.instruction, "measurement", {}, costs.of_check(check.key)),
            )
            for true, rival, expected in ((one, other, if_one), (other, one, if_other)):
                forecast = EvidenceForecast.of_size(expected, true.relative_size_std)
                experiment.evidence[true.name, rival.name] = forecast
    yield from (experiment for experiment in made.values() if isfinite(experiment.cost))


def _are_coasting(explanations: Sequence[FittedExplanation]) -> bool:
    """Whether all runs are followed in one piece, so that similar runs can be predicted."""
    return not any(p.turns or p.cut for e in explanations for p in e.solution.problem.pieces)


def _inseparable_entry(pair: tuple[str, str], explanations: Sequence[FittedExplanation]) -> dict[str, Any]:
    """JSON entry of a pair that no run separates."""
    inseparable = [e for e in explanations if e.name in pair]
    return {
        "what": describe_unseparated([e.name for e in inseparable], [e.fitted_effect for e in inseparable]),
        "separates": [],
        "expected_delta_bic": 0.0,
        "expected_interval": None,
        "expected_if_true": {},
        "groups": [list(pair)],
        "tells": "",
        "kind": "none",
        "key": "none",
        "cost": None,
        "settings": None,
    }
