"""Choose the next experiments: those that separate the explanations of a diagnosis, and the one run to film now.

Candidate runs are simulated under each explanation, and the others are fitted to them. Direct checks need no run: a
mark at rest, a rule, a level, a clock, a sensor.

For the run to film now: a diagnosis leaves questions open. Which of several explanations is true: each is taken to be
true with the probability that its BIC gives it, and the others are fitted to all runs including the planned one. Or
whether an effect of a tenth of the friction would be seen. Every question has its evidence now and after each candidate
run; a run is worth the progress toward decisive evidence, weighted by probability, over its cost.

References
----------
Box & Hill (1967), Discrimination among mechanistic models, Technometrics 9, 57-71 (weights by probability).

"""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import combinations, permutations
from math import isfinite
from typing import Any

import numpy as np

from frictrack import effects
from frictrack.base.distributions import chi2_isf
from frictrack.base.errors import FrictrackError
from frictrack.base.workers import one_thread
from frictrack.diagnose.effect_description import FittedEffect
from frictrack.diagnose.experiments.candidates import candidate_experiments, candidate_runs, fitted_setup
from frictrack.diagnose.experiments.evidence import NormalMatrices, simulate_runs, tabulate_effect
from frictrack.diagnose.experiments.forecast import (
    EvidenceForecast,
    FittedExplanation,
    ModelDiscrimination,
    explain_by_axes,
    make_explanation,
)
from frictrack.diagnose.experiments.selection import detection_threshold, settled_by
from frictrack.diagnose.experiments.virtual_runs import RunConditions, RunDesign, last_settings
from frictrack.diagnose.formulas import FIRST_FORMULA
from frictrack.diagnose.model_selection import MAX_BIC_EQUAL, MIN_CHI2_SEPARATED
from frictrack.effects import ACCELEROMETER_CHECK, DirectCheck, Effect
from frictrack.fit import Fit
from frictrack.fit.least_squares import Solution
from frictrack.fit.parameters import MIN_RUNS_FOR_SCATTER
from frictrack.fit.stepwise import add_effect, refine_to_end
from frictrack.settings.costs import DEFAULT_COSTS, Costs, RunSettings

MAX_BIC_NEAR = 60.0  # from the best, within which a candidate is worth a run that excludes it
MAX_EXPLANATIONS = 3  # that are compared with each other
MAX_EXPERIMENTS = 5  # that are proposed
AXIS_RUN_KEYS = ("slower", "faster", "to a stop", "reversed", "double mass", "half mass")  # runs that separate axes
SOUGHT_SHARE = 0.10  # of the mean friction: size of an effect that the runs should show
MIN_WEIGHT_RATIO = 0.1  # to the likeliest explanation, from which on a prediction is stated if it is true
MAX_P_SUSPECTED = 0.05  # p-value above which an effect is no suspicion, whatever its delta BIC
MIN_GAIN = 0.05  # share of decisive evidence, over all questions, below which a run is not worth filming
MAX_EFFECTS = 4  # that are compared

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
            if a < b and min(self._expected(a, b), self._expected(b, a)) >= MIN_CHI2_SEPARATED
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
        separated = [e for e in explanations if any(e.name in pair for pair in pairs)]
        names = [e.name for e in separated]
        groups = _group_names(names, pairs)
        single = [e.fitted_effect for e in separated if not e.freed]  # a freed value has no invariant of its own
        kept = dict.fromkeys(effect.invariant for effect in single if effect.invariant)  # whatever the next run is like
        why = ", ".join(kept) if self.design else ""
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

    `explanations`: the explanations, best first; at most `MAX_EXPLANATIONS` are compared; `keys`: keys of the candidate
    runs to rate; all by default. Returns JSON entries. A pair that no run separates gets an entry that names other
    measurements.
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

    `solution`: the fitted model that leaves it. Returns JSON entries; empty for measured friction and for runs with
    reversals.
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

    `passing`: name, fit and difference of BIC of the passing candidates, best first; `rivals`: names of those that the
    runs cannot distinguish from the best. They are compared, and so are those within `MAX_BIC_NEAR` of it. Returns JSON
    entries.
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
    entries: Sequence[RunDesign],
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
        settings = conditions.settings(entry)
        cost = costs.of_run(settings, last)
        if not isfinite(cost):
            continue
        notify(f"weighing an experiment: {entry.key}")
        evidence: dict[Pair, EvidenceForecast] = {}
        for pair in pairs:
            reverse = evidence.get((pair.rival.name, pair.truth.name))
            if forecast is None and reverse is not None and reverse.expected < MIN_CHI2_SEPARATED:
                continue
            with suppress(FrictrackError):
                made = forecast(pair, entry) if forecast else pair.forecast_after(entry)
                evidence[pair.truth.name, pair.rival.name] = made
        yield RatedExperiment(entry.key, entry.words, evidence, cost, entry, settings)


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
                evidence[true.name, rival.name] = EvidenceForecast(max(chi2, 0.0), true.relative_size_std)
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
        "what": "; ".join(filter(None, [sentence, measurement])),
        "separates": [],
        "expected_delta_bic": 0.0,
        "expected_interval": None,
        "expected_if_true": {},
        "groups": [names],
        "tells": "",
        **dict.fromkeys(("kind", "key"), "none"),
        **dict.fromkeys(("cost", "settings")),
    }


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


@dataclass(frozen=True)
class Question:
    """One question: whether `true` differs from `rival` ("": from nothing), with its weight and threshold.

    Evidence adds up: `now` is what the runs say already (without a rival: what they are expected to say).
    """

    true: str
    rival: str
    weight: float
    decisive: float
    now: float
    pair: ModelDiscrimination | None = None

    def progress(self, after: float) -> float:
        """Weighted progress toward decisive evidence."""
        return self.weight * float(np.diff(np.clip([self.now / self.decisive, after / self.decisive], 0.0, 1.0))[0])

    def gain(self, after: float) -> float:
        """Weighted share of decisive evidence that is added, also where little was left to add."""
        return self.weight * float(np.clip((after - self.now) / self.decisive, 0.0, 1.0))

    def prediction(self, after: EvidenceForecast) -> dict[str, Any]:
        """Entry of the JSON `predictions`: the evidence of the present runs is known only if there is a rival."""
        measured = self.now if self.rival else 0.0
        low, high = after.shifted(-measured).interval()
        return {
            "true": self.true,
            "rival": self.rival or None,
            "now": self.now,
            "expected": after.expected,
            "interval": [low + measured, None if high is None else high + measured],
            "decisive": self.decisive,
        }


def _after(experiment: RatedExperiment, question: Question) -> EvidenceForecast:
    """Evidence on a question after a run; what it is now if a motion cannot be integrated."""
    return experiment.evidence.get((question.true, question.rival), EvidenceForecast(question.now))


def _value(experiment: RatedExperiment, questions: Sequence[Question]) -> tuple[float, float]:
    """Progress over cost; then the plain gain of evidence over cost, where no run makes progress."""
    pairs = [(q, _after(experiment, q).expected) for q in questions]
    gain = sum(q.weight * (after - q.now) for q, after in pairs)
    return sum(q.progress(after) for q, after in pairs) / experiment.cost, gain / experiment.cost


def _added_to_measured(pair: ModelDiscrimination, design: RunDesign) -> EvidenceForecast:
    """Evidence after a planned run: what the present runs give, and what the run is expected to add."""
    measured = pair.truth.gain - pair.rival.gain
    return pair.forecast_after(design).shifted(measured - pair.expected_delta_bic_now)


@one_thread()
def next_run(fit: Fit, diagnosis: Mapping[str, Any], costs: Costs = DEFAULT_COSTS) -> dict[str, Any] | None:
    """Choose the run to film now.

    Parameters
    ----------
    fit
        The fit that was diagnosed.
    diagnosis
        Its diagnosis: JSON of `frictrack diagnose`, or `Diagnosis.summary()`.
    costs
        Costs of the next run, and what the set-up can do.

    Returns
    -------
    dict or None
        "what", "key", "settings" (speed m/s with sign, mass kg, incline_deg, fps), "cost", "separates",
        "expected_delta_bic", "expected_interval" (95 %) and "predictions", one for every
        question that the run is expected to answer if a likely explanation is true. None if nothing is
        open, or if no run that the set-up can do helps.

    Examples
    --------
    >>> import frictrack as ft
    >>> fit = ft.fit("tustin", ft.samples.runs()[:2])
    >>> next_run(fit, ft.diagnose(fit, quick=True).summary()) is None  # one effect is named, without a rival
    True

    """
    questions, options = _open_questions(fit, diagnosis, costs)
    options = [o for o in options if max(_value(o, questions)) > 0]
    if not options:
        return None
    best = max(options, key=lambda o: _value(o, questions))
    open_now = [q for q in questions if q.now < q.decisive]
    if sum(q.gain(_after(best, q).expected) for q in open_now) < MIN_GAIN * sum(q.weight for q in questions):
        return None
    likely = [q for q in open_now if q.weight >= MIN_WEIGHT_RATIO * max(q.weight for q in open_now)]
    predicted = [(q, q.prediction(_after(best, q))) for q in likely]
    separated = [(q, p) for q, p in predicted if p["expected"] >= MIN_CHI2_SEPARATED] or predicted
    weightiest = max(q.weight for q, _ in separated)
    weakest = min((p for q, p in separated if q.weight == weightiest), key=lambda p: p["expected"])
    assert best.settings is not None
    return {
        "what": best.words,
        "key": best.key,
        "settings": best.settings.summary(),
        "cost": best.cost,
        "separates": list(dict.fromkeys(name for q, _ in separated for name in (q.true, q.rival) if name)),
        "expected_delta_bic": weakest["expected"],
        "expected_interval": weakest["interval"],
        "predictions": [p for _, p in separated],
    }


Options = tuple[list[Question], list[RatedExperiment]]


def _open_questions(fit: Fit, diagnosis: Mapping[str, Any], costs: Costs) -> Options:
    """Questions that a diagnosis leaves open, and the runs that may answer them."""
    if fit.measured or any(p.turns or p.cut for p in fit.solution.problem.pieces):
        return [], []
    verdict = diagnosis["verdict"]
    if verdict not in {"undetermined", "complete"}:
        found = list_explanations(fit.solution, diagnosis)
        return _rival_questions(found, costs, further=verdict == "unexplained") if len(found) > 1 else ([], [])
    if suspected := _suspected_effects(diagnosis):
        return _power_questions(fit, list(suspected), costs, suspected)
    questions, options = _power_questions(fit, _unseen_effects(diagnosis), costs)
    if verdict == "complete":  # only what one of the runs answers
        questions = [q for q in questions if any(_after(o, q).expected >= q.decisive for o in options)]
    return questions, options


# --- which explanation is true


@dataclass(frozen=True)
class Weighted:
    """An explanation and its probability among those listed."""

    explanation: FittedExplanation
    probability: float


def list_explanations(solution: Solution, diagnosis: Mapping[str, Any]) -> list[Weighted]:
    """List the explanations of what a diagnosis leaves open.

    Returns the free curves over place, time or speed where nothing explains the misfit; else the effect with rivals,
    these, and a formula that may be the cause in place of one effect. Empty if the effects found have no rival.
    """
    if diagnosis["verdict"] == "unexplained":
        return _weighted(explain_by_axes(solution), None)
    listed = {c["effect"]: c for c in diagnosis["candidates"]}
    missing = diagnosis["missing"]
    formula = _rival_formula(diagnosis) if len(missing) == 1 else None
    doubtful = next((n for n in missing if listed[n]["indistinguishable_from"]), missing[0] if formula else None)
    if doubtful is None:
        return []
    for name in missing:
        if name != doubtful:
            solution = refine_to_end(add_effect(solution, effects.get(name)))
    kept = _effects_near(solution, listed, doubtful)
    fitted = list(_fitted(solution, [formula])) if formula else []
    probability = float(diagnosis["unexplained"]["probability"]) if fitted else None
    return _weighted([*fitted, *kept], probability)


def _effects_near(solution: Solution, listed: Mapping[str, Any], doubtful: str) -> list[FittedExplanation]:
    """The effect with rivals, and the best of its rivals and of all candidates near it."""
    rivals, best = listed[doubtful]["indistinguishable_from"], listed[doubtful]["delta_bic"]
    near = [n for n, c in listed.items() if c["delta_bic"] is not None and best - c["delta_bic"] < MAX_BIC_NEAR]
    names = [n for n in dict.fromkeys([doubtful, *rivals, *near]) if n not in solution.problem.model]
    known = [effects.get(n) for n in names[: 2 * MAX_EFFECTS] if n.partition(":")[0] in effects.LIBRARY]
    return sorted(_fitted(solution, known), key=lambda e: (e.effect != doubtful, -e.gain))[:MAX_EFFECTS]


def _weighted(found: Sequence[FittedExplanation], probability: float | None) -> list[Weighted]:
    """Explanations with their probabilities from BIC; a formula comes first, with its own because of its prior."""
    gains = np.array([e.gain for e in found])
    shares = np.exp((gains - gains.max(initial=0.0)) / 2)
    if probability is not None and len(found) > 1:
        shares[0] = shares[1:].sum() * probability / max(1.0 - probability, 1e-3)
    shares /= max(float(shares.sum()), 1e-300)
    return [Weighted(e, float(share)) for e, share in zip(found, shares, strict=True)]


def _rival_formula(diagnosis: Mapping[str, Any]) -> Effect | None:
    """The formula that may be the cause in place of the effect found, as an effect; None if there is none."""
    unexplained = diagnosis["unexplained"] or {}
    if not unexplained.get("rival"):
        return None
    settings = effects.read_settings(tomllib.loads(unexplained["formulas"][0]["toml"])["effect"][0])
    return replace(settings.applied(effects.definitions([settings])[0]), name=FIRST_FORMULA)


def _fitted(solution: Solution, tried: Sequence[Effect]) -> Iterator[FittedExplanation]:
    """Explanation by every effect under which a motion can be integrated."""
    for effect in tried:
        with suppress(FrictrackError):
            yield make_explanation(effect.name, refine_to_end(add_effect(solution, effect)), solution)


def _rival_questions(found: Sequence[Weighted], costs: Costs, *, further: bool) -> Options:
    """One question for every ordered pair of explanations, weighted by the probability of the first.

    With `further`, evidence that is decisive already must be found once more: the runs are not explained yet.
    """
    pairs = compare_all([w.explanation for w in found])
    probability = {w.explanation.name: w.probability / (len(found) - 1) for w in found}
    questions = []
    for pair in pairs:
        true, now = pair.truth.name, pair.truth.gain - pair.rival.gain
        decisive = MIN_CHI2_SEPARATED + (now if further and now >= MIN_CHI2_SEPARATED else 0.0)
        questions.append(Question(true, pair.rival.name, probability[true], decisive, now, pair))
    entries = candidate_experiments(found[0].explanation.solution, costs, combined=True)
    return questions, list(rate_runs(pairs, entries, costs, forecast=_added_to_measured))


# --- what the runs could show


def _unseen_effects(diagnosis: Mapping[str, Any]) -> list[str]:
    """Effects that the runs leave open: those of an undetermined verdict; else forces absorbed whatever their size."""
    if diagnosis["verdict"] == "undetermined":
        parts = [part for one in diagnosis["undetermined"] for part in one["what"].split(" and ")]
        return list(dict.fromkeys(part.split(".")[0] for part in parts))
    limits = diagnosis["detection_limits"]
    named = [n for n, limit in limits.items() if limit["value"] is None and n in effects.LIBRARY]
    return [n for n in named if effects.get(n).acts_on == "force" and effects.get(n).sized]


def _suspected_effects(diagnosis: Mapping[str, Any]) -> dict[str, float]:
    """Effects with much evidence that is nearly significant, the best first, and their evidence as chi-squared."""
    ordered = sorted(diagnosis["candidates"], key=lambda c: -(c["delta_bic"] or 0.0))
    likely = (c for c in ordered if (c["delta_bic"] or 0.0) > MAX_BIC_EQUAL and not c["implausible"])
    suspected = (c for c in likely if c["p"] < MAX_P_SUSPECTED and c["effect"] in effects.LIBRARY)
    return {c["effect"]: float(chi2_isf(c["p"], 1)) for c in suspected}


def _power_questions(
    fit: Fit, names: Sequence[str], costs: Costs, suspected: Mapping[str, float] | None = None
) -> Options:
    """One question for every effect that the runs cannot show at `SOUGHT_SHARE` of the friction.

    Of `suspected` effects, the evidence is measured; it grows with further runs as that of such an effect would, if the
    friction levels scatter as they do with the first of them in the model.
    """
    if not names:
        return [], []
    try:
        setup = fitted_setup(fit, costs)
        if suspected:
            grown = refine_to_end(add_effect(fit.solution, effects.get(next(iter(suspected)))))
            setup = replace(setup, scatter=grown.tau_of_other_runs)
        runs = simulate_runs(setup, [*setup.completed, *candidate_runs(setup)])
    except FrictrackError:  # a drive, or a law without Coulomb friction
        return [], []
    done = {design.key for design in setup.completed}
    count = sum(r.design.key in done for r in runs)
    tables = {n: t for n in names if (t := tabulate_effect(runs, n, SOUGHT_SHARE, setup.scatter))}
    times = max(1, MIN_RUNS_FOR_SCATTER - count)  # with fewer runs, friction levels are free

    def evidence(name: str, *further: NormalMatrices) -> float:
        together = NormalMatrices.of_runs([*tables[name][:count], *further])
        return float(together.unexplained_chi2(scatter_known=not suspected)[0])

    expected = {n: evidence(n) for n in tables}
    # if the runs say less than is expected of such an effect, it is smaller, and further runs say less, too
    scale = {n: suspected[n] / max(one, suspected[n]) if suspected else 1.0 for n, one in expected.items()}
    decisive = detection_threshold(forms=1) if suspected else detection_threshold()
    questions = [Question(n, "", 1.0 / len(scale), decisive, scale[n] * one) for n, one in expected.items()]
    last, options = last_settings(fit.solution), []
    for i, run in enumerate(runs[count:], count):
        settings = setup.conditions.settings(run.design)
        cost = costs.of_run(settings, last)
        if np.isfinite(cost):
            after = {(n, ""): EvidenceForecast(scale[n] * evidence(n, *[t[i]] * times)) for n, t in tables.items()}
            words = f"Film {run.design.words}"
            options.append(RatedExperiment(run.design.key, words, after, cost, run.design, settings))
    return questions, options
