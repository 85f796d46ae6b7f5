"""Rate experiments by the evidence expected of them, and propose those that separate the present explanations.

Candidate runs are simulated under each explanation, and the others are fitted to them. Direct checks need no run: a
mark at rest, a rule, a level, a clock, a sensor.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import combinations, permutations
from math import isfinite
from typing import Any

from frictrack.costs import DEFAULT_COSTS, Costs, RunSettings
from frictrack.diagnose.effect_description import FittedEffect
from frictrack.diagnose.experiments.candidates import Experiment, candidate_experiments
from frictrack.diagnose.experiments.discrimination import EvidenceForecast, ModelDiscrimination
from frictrack.diagnose.experiments.explanations import FittedExplanation, explain_by_axes, make_explanation
from frictrack.diagnose.experiments.virtual_runs import RunConditions, RunDesign, last_settings
from frictrack.effects import ACCELEROMETER_CHECK, DirectCheck, Effect
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
    evidence: dict[Pair, EvidenceForecast]
    cost: float = 1.0
    design: RunDesign | None = None  # of a film; None for a direct check
    settings: RunSettings | None = None

    def separated_pairs(self) -> list[Pair]:
        """Pairs of explanations that it separates, whichever is true."""
        return [
            (a, b)
            for a, b in self.evidence
            if a < b and min(self._expected(a, b), self._expected(b, a)) >= MIN_BIC_SEPARATED
        ]

    def weakest(self) -> EvidenceForecast:
        """Forecast of the smallest evidence over the pairs that it separates, whichever is true."""
        each = (self.evidence[pair] for a, b in self.separated_pairs() for pair in ((a, b), (b, a)))
        return min(each, key=lambda e: e.expected, default=EvidenceForecast(0.0))

    def _expected(self, true: str, other: str) -> float:
        """Expected evidence of one explanation over another; 0 if there is none."""
        return self.evidence[true, other].expected if (true, other) in self.evidence else 0.0

    def summary(self, explanations: Sequence[FittedExplanation]) -> dict[str, Any]:
        """Entry of the JSON of `frictrack diagnose`."""
        pairs, weakest = self.separated_pairs(), self.weakest()
        told = [e for e in explanations if any(e.name in pair for pair in pairs)]
        names = [e.name for e in told]
        groups = _group_names(names, pairs)
        single = [e.fitted_effect for e in told if not e.freed]  # a freed value has no invariant of its own
        why = explain_separation(single) if self.design else ""
        return {
            "what": f"{self.words}: {why}" if why else self.words,
            "separates": names,
            "expected_delta_bic": weakest.expected,
            "expected_interval": list(weakest.interval()),
            "expected_if_true": {
                n: min(self._expected(n, b) for b in names if tuple(sorted((n, b))) in pairs) for n in names
            },
            "groups": groups,
            "tells": describe_separation(groups),
            "kind": "film" if self.design else "measurement",
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
    # runs that are followed in one piece show how a similar run goes
    coasting = not any(p.turns or p.cut for e in explanations for p in e.solution.problem.pieces)
    entries = candidate_experiments(explanations[0].solution, costs) if coasting else []
    kept = [e for e in entries if not keys or e.key in keys]
    rated = [*rate_runs(compare_all(explanations), kept, costs, notify), *rate_direct_checks(explanations, costs)]
    rated = [experiment for experiment in rated if experiment.separated_pairs()]
    separated = {pair for experiment in rated for pair in experiment.separated_pairs()}
    open_pairs = [p for p in combinations(explanations, 2) if tuple(sorted((p[0].name, p[1].name))) not in separated]
    out = [experiment.summary(explanations) for experiment in _rank(rated)[:MAX_EXPERIMENTS]]
    return out + [_inseparable_entry(pair) for pair in open_pairs if coasting]


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
    explanations = [make_explanation(n, s, bare) for n, s, _ in close[:MAX_EXPLANATIONS]]
    return propose_experiments(explanations, notify, costs=costs)


def _rank(rated: Sequence[RatedExperiment]) -> list[RatedExperiment]:
    """Order experiments: first the one that separates most open pairs for its cost (greedy set cover: Chvatal 1979)."""
    remaining, out = list(rated), []
    open_pairs: set[Pair] = set()

    def worth(o: RatedExperiment) -> tuple[float, float]:
        return len(open_pairs.intersection(o.separated_pairs())) / o.cost, o.weakest().expected / o.cost

    while remaining:
        if not any(open_pairs.intersection(o.separated_pairs()) for o in remaining):
            open_pairs = {pair for o in remaining for pair in o.separated_pairs()}
        best = max(remaining, key=worth)
        open_pairs = open_pairs.difference(best.separated_pairs())
        remaining.remove(best)
        out.append(best)
    return out


def compare_all(explanations: Sequence[FittedExplanation]) -> list[ModelDiscrimination]:
    """Every ordered pair of explanations but those of which the rival can be the truth, and predicts the same."""
    pairs = permutations(explanations, 2)
    return [ModelDiscrimination(a, b) for a, b in pairs if a.fitted_effect.kind not in b.fitted_effect.special_cases]


def rate_runs(
    pairs: Sequence[ModelDiscrimination],
    entries: Sequence[Experiment],
    costs: Costs = DEFAULT_COSTS,
    notify: Progress = lambda what: None,
    forecast: Callable[[ModelDiscrimination, RunDesign], EvidenceForecast] | None = None,
) -> Iterator[RatedExperiment]:
    """Rate candidate runs by a forecast for every pair of explanations; by default only while they may separate it.

    Runs that the set-up cannot do are left out. Pairs for which a run cannot be simulated have no evidence.
    """
    if not (pairs and entries):
        return
    solution = pairs[0].truth.solution
    conditions, last = RunConditions.of_fit(solution), last_settings(solution)
    for entry in entries:
        settings = conditions.settings(entry.design)
        cost = costs.of_run(settings, last)
        if not isfinite(cost):
            continue
        notify(f"weighing an experiment: {entry.key}")
        evidence: dict[Pair, EvidenceForecast] = {}
        for pair in pairs:
            reverse = evidence.get((pair.rival.name, pair.truth.name))
            if forecast is None and reverse is not None and reverse.expected < MIN_BIC_SEPARATED:
                continue
            with suppress(FrictrackError):
                made = forecast(pair, entry.design) if forecast else pair.forecast_after(entry.design)
                evidence[pair.truth.name, pair.rival.name] = made
        yield RatedExperiment(entry.key, entry.words, evidence, cost, entry.design, settings)


def rate_direct_checks(
    explanations: Sequence[FittedExplanation], costs: Costs = DEFAULT_COSTS
) -> Iterator[RatedExperiment]:
    """Rate the direct checks that need no further run."""
    made: dict[str, RatedExperiment] = {}
    for one, other in combinations(explanations, 2):
        for check, *expected in direct_checks(one, other):
            plain = RatedExperiment(check.key, check.instruction, {}, costs.of_check(check.key))
            evidence = made.setdefault(check.key, plain).evidence
            for true, rival, chi2 in zip((one, other), (other, one), expected, strict=True):
                evidence[true.name, rival.name] = EvidenceForecast.of_size(chi2, true.relative_size_std)
    yield from (experiment for experiment in made.values() if isfinite(experiment.cost))


def direct_checks(one: FittedExplanation, other: FittedExplanation) -> list[tuple[DirectCheck, float, float]]:
    """List measurements without a film that separate two explanations, with the chi-squared if either is true.

    If the cause is present, an explanation without it is refuted by the whole signal S. If it is absent, an
    explanation with it may shrink the effect by a share a, which costs part of the evidence G that the runs give it.
    The least of (1 - a)^2 G + a^2 S is G S/(G + S).
    """
    out = []
    for explained, rival in ((one, other), (other, one)):
        effect, alternative = explained.fitted_effect, rival.fitted_effect
        if effect.kind == alternative.kind:
            continue
        checks = [effect.direct_check] if effect.direct_check is not None else []
        if effect.acts_on == "force" and alternative.acts_on == "measurement":
            checks.append(ACCELEROMETER_CHECK)
        for check in checks:
            signal = check.signal(FittedEffect(explained.effect, explained.solution))
            absent = explained.gain * signal / max(explained.gain + signal, 1e-12)
            out.append((check, signal, absent) if explained is one else (check, absent, signal))
    return out


def _inseparable_entry(pair: Sequence[FittedExplanation]) -> dict[str, Any]:
    """JSON entry of a pair that no run separates, which says what other measurement would tell of the effects."""
    names, effects = [e.name for e in pair], [e.fitted_effect for e in pair]
    sentence = (
        f"No candidate run separates {' and '.join(names)}: they change the motion in the same way at every speed, "
        "mass and direction"
    )
    measurement = settled_by(effects) or "; ".join(e.confirm.rstrip(".").replace("`", "") for e in effects if e.confirm)
    return {
        "what": f"{sentence}; {measurement}" if measurement else sentence,
        "separates": [],
        "expected_delta_bic": 0.0,
        "expected_interval": None,
        "expected_if_true": {},
        "groups": [names],
        "tells": "",
        "kind": "none",
        "key": "none",
        "cost": None,
        "settings": None,
    }


def explain_separation(effects: Sequence[Effect]) -> str:
    """Return what each of the separated effects keeps when a run is made differently, joined by commas.

    Examples
    --------
    >>> from frictrack import effects
    >>> explain_separation([effects.get("drag"), effects.get("spring")])
    'drag is proportional to the square of the speed, a spring pulls by place, in either direction of motion'

    """
    return ", ".join(dict.fromkeys(effect.invariant for effect in effects if effect.invariant))


def settled_by(effects: Sequence[Effect]) -> str:
    """Return what to do instead of a film to separate some effects; "" where none of them says it.

    Examples
    --------
    >>> from frictrack import effects
    >>> settled_by([effects.get("slope"), effects.get("spring")])
    'lay a level on the course, and take the cable off'

    """
    return ", and ".join(effect.settled_by for effect in effects if effect.settled_by)


def describe_separation(groups: Sequence[Sequence[str]]) -> str:
    """Say which causes are separated: "a, b and c apart", or "a from b or c" where some stay together.

    Examples
    --------
    >>> describe_separation([["drag"], ["spring"]])
    'drag and spring apart'
    >>> describe_separation([["lens"], ["drag", "timebase"]])
    'lens from drag or timebase'

    """
    if all(len(group) == 1 for group in groups):
        *most, last = (group[0] for group in groups)
        return f"{', '.join(most)} and {last} apart"
    return " from ".join(" or ".join(group) for group in groups)
