"""One test of one law: draws, every candidate scanned, those that stand out refined, the best of them simulated."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from frictrack.diagnose.admissible import objection, physical_objection
from frictrack.diagnose.hypothesis_tests import ALPHA, ScannedCandidate, SearchTests, list_candidates, run_tests
from frictrack.diagnose.model_selection import (
    MAX_BIC_BARE_MENTION,
    MAX_CHI2_NEAR,
    MIN_CHI2_SEPARATED,
    expected_separation,
    information_criterion,
    parameter_penalty,
)
from frictrack.diagnose.null_distribution import Ensemble, draw_ensemble
from frictrack.effects import Effect
from frictrack.errors import FrictrackError
from frictrack.fit.least_squares import Solution
from frictrack.fit.linearised import LinearisedModel, candidate_grids, linearise, measured_series, scan_candidate
from frictrack.fit.parameters import ParameterLayout
from frictrack.fit.stepwise import (
    CandidateTrial,
    baseline_misfit,
    deepen_trials,
    effect_for_scan,
    misfit_left_by_other,
    refine_to_end,
    remove_effect,
    simulate_trial,
    try_effect,
)
from frictrack.fit.uncertainty import dispersion
from frictrack.records import Array

MAX_P_REFINED = 0.05  # p of a candidate that is refined; the best two are in any case
MAX_CHI2_PER_FRAME_TRUSTED = 1.2  # chi-squared per frame up to which a law is trusted to say what its parts are
MAX_CHI2_PER_FRAME_EXCHANGED = (
    10.0  # chi-squared per frame from which no effect of a law is exchanged: too much of it is wrong
)
MAX_CANDIDATES_SIMULATED = 6
MAX_UNKNOWNS_SIMPLE = 3  # unknowns of an effect that is no mixture of others
MAX_CANDIDATES_SPLIT = 6  # effects beside which a second one is looked for then
MIN_BIC_RATIO_SIMULATED = 0.95  # of the best evidence: what a candidate along the motion must promise to be simulated

Notify = Callable[[str], None]


@dataclass(frozen=True)
class RefinedCandidate:
    """A candidate refined on top of a law: in simulation, or, where it is far behind, along the motion alone."""

    effect: Effect
    solution: Solution | None
    delta_bic: float
    p: float
    indistinguishable_from: tuple[str, ...] = ()
    objection: str = ""  # why it cannot be the cause, whatever it explains
    linear_trial: tuple[LinearisedModel, CandidateTrial] | None = (
        None  # where it stands along the motion, beside what law
    )

    @property
    def law(self) -> Solution:
        """The law with it, simulated."""
        assert self.solution is not None
        return self.solution


@dataclass(frozen=True)
class Round:
    """One test of one model: the draws, the tests, and the candidates refined, best first."""

    solution: Solution
    draws: Ensemble
    tests: SearchTests
    tried: list[RefinedCandidate]
    barred: dict[str, str]  # effects that could not be tried, and why

    @property
    def leaves_misfit(self) -> bool:
        """Whether the law leaves more than noise."""
        return self.tests.p_lack_of_fit < ALPHA / 2

    @property
    def passing(self) -> list[RefinedCandidate]:
        """Plausible candidates that pass by themselves, simulated, best first."""
        return [t for t in self.tried if t.p < ALPHA / 2 and t.delta_bic > 0 and t.solution and not t.objection]


def run_round(solution: Solution, own: Sequence[Effect], rng: np.random.Generator, tell: Notify) -> Round:
    """Test a law for everything that it could lack."""
    tell("drawing what nothing missing looks like")
    draws = draw_ensemble(solution, rng)
    tell("trying every effect of the library")
    library, barred = list_candidates(solution, own)
    tests = run_tests(solution, draws, library)
    data = draws.series.coordinates[:, 0]
    tell("refining what stands out")
    trials = [try_effect(draws.law, s.effect, s.scans, data) for s in _standing(tests)]
    found = _simulated(draws.law, solution, deepen_trials(draws.law, trials), tests.p)
    return Round(solution, draws, tests, found, barred)


def _standing(tests: SearchTests) -> list[ScannedCandidate]:
    """Candidates that stand out by themselves, or rise nearly as high as the best; the best two in any case."""
    order = sorted(tests.scanned, key=lambda s: -s.excess[0])
    top = order[0].statistic[0] if order and tests.p[order[0].effect.name] < ALPHA / 2 else np.inf
    near = [
        s for s in order if tests.p[s.effect.name] < MAX_P_REFINED or s.statistic[0] > top - _near_margin(s.effect, top)
    ]
    return near if len(near) >= 2 else order[:2]


def _near_margin(effect: Effect, top: float) -> float:
    """How far below the best a candidate may rise and still explain as much: scans show some as less than they are."""
    return max(MAX_CHI2_NEAR, top / 2) if effect.memory or effect.modifies else MAX_CHI2_NEAR


def _simulated(
    law: LinearisedModel, solution: Solution, trials: list[CandidateTrial], p: dict[str, float], least: float = -np.inf
) -> list[RefinedCandidate]:
    """Trials in order of their evidence, simulated as far as they are near the best, or near the `least` of use."""
    own, misfit = information_criterion(solution), baseline_misfit(law)
    promised = {t.effect.name: misfit - t.misfit - _paid(law, t.layout) for t in trials}
    out: list[RefinedCandidate] = []
    for t in sorted(trials, key=lambda t: (p[t.effect.name] >= ALPHA / 2, -promised[t.effect.name])):
        name = t.effect.name
        candidate = RefinedCandidate(t.effect, None, promised[name], p[name], linear_trial=(law, t))
        candidate = replace(candidate, objection=physical_objection(t.layout, t.p, t.effect))
        if not candidate.objection and _is_worth(out, candidate, least):
            try:
                simulated = simulate_trial(law, t)
                candidate = replace(candidate, solution=simulated, delta_bic=own - information_criterion(simulated))
                candidate = replace(candidate, objection=objection(simulated, t.effect))
            except FrictrackError:  # along the motion it is a law, but not one that can be followed
                pass
        out.append(candidate)
    return sorted(out, key=lambda t: (t.p >= ALPHA / 2, bool(t.objection), -t.delta_bic))


def _is_worth(done: list[RefinedCandidate], new: RefinedCandidate, least: float) -> bool:
    """Whether a trial is worth a simulation: what may be as good as the best so far, and as the `least` of use."""
    known = [t.delta_bic for t in done if t.solution is not None and not t.objection]
    near = new.delta_bic > MIN_BIC_RATIO_SIMULATED * max([least, *known]) - MAX_CHI2_NEAR - 2 * MIN_CHI2_SEPARATED
    return near and new.p < ALPHA / 2 and len(known) < MAX_CANDIDATES_SIMULATED


def _paid(law: LinearisedModel, layout: ParameterLayout) -> float:
    """What the unknowns beyond those of the bare law cost."""
    return parameter_penalty(layout, law.solution.problem) - parameter_penalty(
        law.solution.problem.layout, law.solution.problem
    )


def find_rivals(best: RefinedCandidate, others: Sequence[RefinedCandidate]) -> tuple[str, ...]:
    """Name the effects whose best fit to what `best` predicts differs by less than `MIN_CHI2_SEPARATED`.

    One that needs decisively more parameters for it (an amplitude in every run) is no equal explanation. Whether one
    stands out by itself is not asked: the true cause may stand out less than its double.
    """
    true = next((t.linear_trial for t in others if t.effect.name == best.effect.name), None)
    unit = dispersion(best.law)
    near = [t for t in others if t.effect.name != best.effect.name and not t.objection]
    near = [t for t in near if best.delta_bic - t.delta_bic < 2 * MIN_CHI2_SEPARATED * unit]
    return tuple(t.effect.name for t in near if _stands_for(t, best, true, unit))


def _stands_for(
    other: RefinedCandidate, best: RefinedCandidate, true: tuple[LinearisedModel, CandidateTrial] | None, unit: float
) -> bool:
    """Whether another effect explains what the best one does, and would if that were true.

    `unit` is what a difference of chi-squared is counted in: while misfit remains, more than one.
    """
    if other.solution is not None:
        near = other.law.objective - best.law.objective < MAX_CHI2_NEAR * unit
        return near and (unit > 1 or expected_separation(best.law, other.law) < MIN_CHI2_SEPARATED)
    if true is None or other.linear_trial is None or not best.law.problem.simulates:
        return False
    (law, trial), rival = true, other.linear_trial[1]
    return rival.misfit - trial.misfit < MAX_CHI2_NEAR * unit and (
        unit > 1 or misfit_left_by_other(law, trial, rival) < MIN_CHI2_SEPARATED
    )


def review_found(
    start: Solution, found: list[RefinedCandidate], own: Sequence[Effect], tell: Notify
) -> list[RefinedCandidate]:
    """Effects found one after the other on top of the law at the `start`, each looked at again beside all the others.

    One that they made needless goes, one that was only a mixture of several makes way for what explains more, be it
    two plainer ones, and what could stand in its place is named. Several of one kind are found again as one: the
    first was placed while another effect was still missing. The law of the last one has them all. While a law leaves
    far more than noise, it only loses what is needless.
    """
    kept = list(found)
    for old in found:
        kin = [k.effect.name for k in kept if k.effect.kind == old.effect.kind]
        whole, name = kept[-1].law, old.effect.name
        if len(kept) < 2 and _unknowns(whole, name) <= MAX_UNKNOWNS_SIMPLE:
            break
        tell(f"looking at {name} again")
        try:
            rest = remove_effect(whole, name)
        except FrictrackError:  # without it there is no law that could be followed
            continue
        if rest.objective > start.objective + MIN_CHI2_SEPARATED:  # it has more to explain with: it has run away
            continue
        worth = information_criterion(rest) - information_criterion(whole)
        if worth <= 0 and len(kept) > 1:
            kept = _with_law([k for k in kept if k.effect.name != name], rest)
        elif whole.objective <= MAX_CHI2_PER_FRAME_EXCHANGED * whole.problem.n_frames and name == kin[-1]:
            kept = _replaced(kept, kin, rest, own)
    return kept


def _replaced(
    kept: list[RefinedCandidate], kin: list[str], rest: Solution, own: Sequence[Effect]
) -> list[RefinedCandidate]:
    """What was found, after everything was tried in the place of one effect, or of the several of its kind.

    `rest` is the law without the last of them.
    """
    whole, old = kept[-1].law, next(k for k in kept if k.effect.name == kin[0])
    try:
        for name in kin[:-1]:
            rest = remove_effect(rest, name)
    except FrictrackError:
        return kept
    worth = information_criterion(rest) - information_criterion(whole)
    tried_again = _alternatives(rest, own, old, least=worth)
    best = tried_again[0]
    if not _is_better(best, old, worth):
        if len(kin) > 1:
            return kept
        best = replace(old, solution=whole, delta_bic=worth)
    best = replace(best, indistinguishable_from=find_rivals(best, tried_again))
    pair = _split_in_two(best, tried_again, own)
    new = pair or [best]
    at = next(i for i, k in enumerate(kept) if k.effect.name == kin[0])
    later = [k for k in kept[at:] if k.effect.name not in kin]
    return _with_law([*kept[:at], *new, *later], new[-1].law)


def _is_better(best: RefinedCandidate, old: RefinedCandidate, worth: float) -> bool:
    """Whether what was found anew may stand for what was `worth` so much: at once where it is of the same kind."""
    if best.solution is None:
        return False
    if best.effect.kind == old.effect.kind:
        return best.delta_bic > worth + MAX_BIC_BARE_MENTION
    clearly = best.delta_bic >= worth + MIN_CHI2_SEPARATED
    return clearly and best.law.objective <= MAX_CHI2_PER_FRAME_TRUSTED * best.law.problem.n_frames


def _unknowns(law: Solution, name: str) -> int:
    """How many unknowns an effect brings into a law."""
    return sum(s.effect == name for s in law.problem.layout.slots)


def _split_in_two(
    best: RefinedCandidate, others: Sequence[RefinedCandidate], own: Sequence[Effect]
) -> list[RefinedCandidate]:
    """Two plain effects that explain decisively more than one that is not; none where there are none.

    An effect free in every run, such as a wave with its own phases, may imitate the sum of two that are not.
    """
    found: list[RefinedCandidate] = []
    if _unknowns(best.law, best.effect.name) <= MAX_UNKNOWNS_SIMPLE:
        return found
    top = information_criterion(best.law) - MIN_CHI2_SEPARATED
    runs = len(best.law.problem.layout.run_names)
    for one in [t for t in others if t.delta_bic > MIN_CHI2_SEPARATED and _is_simple(t.effect, runs)][
        :MAX_CANDIDATES_SPLIT
    ]:
        try:
            law = _simulated_law(one)
            pairs = _alternatives(law, own, one, lambda e: _is_simple(e, runs), information_criterion(law) - top)
        except FrictrackError:
            continue
        two = next((t for t in pairs if t.solution is not None), None)
        if two is not None and information_criterion(two.law) < top:
            top = information_criterion(two.law)
            found = [replace(one, solution=law), two]
    return found


def _is_simple(effect: Effect, runs: int) -> bool:
    """Whether an effect brings few unknowns, and none that remembers, whose motion takes long to follow."""
    return (
        not effect.memory and sum(runs if p.per_run else 1 for p in effect.parameters if p.free) <= MAX_UNKNOWNS_SIMPLE
    )


def _simulated_law(tried: RefinedCandidate) -> Solution:
    """The law with a candidate, which may have been left along the motion."""
    if tried.solution is None and tried.linear_trial is not None:
        return simulate_trial(*tried.linear_trial)
    return tried.law


def _with_law(found: list[RefinedCandidate], law: Solution) -> list[RefinedCandidate]:
    """The last of the effects found stands for the whole law."""
    return [*found[:-1], replace(found[-1], solution=law)]


def _alternatives(
    rest: Solution,
    own: Sequence[Effect],
    old: RefinedCandidate,
    which: Callable[[Effect], bool] = lambda effect: True,
    least: float = -np.inf,
) -> list[RefinedCandidate]:
    """Everything that could stand where an effect was taken out, best first; nothing is drawn again.

    What does not promise about the `least` evidence that is of use is not simulated.
    """
    law = linearise(rest)
    series = measured_series(law)
    data: Array = series.coordinates[:, 0]
    trials = []
    for effect in filter(which, list_candidates(rest, own)[0]):
        e = old.effect if effect.kind == old.effect.kind else effect
        scans = [scan_candidate(law, f, series) for f in candidate_grids(law, effect_for_scan(rest, e))]
        trials.append(try_effect(law, e, scans, data))
    p = dict.fromkeys((t.effect.name for t in trials), old.p)
    return _simulated(law, rest, deepen_trials(law, trials), p, least)


def refine_fully(best: RefinedCandidate) -> RefinedCandidate:
    """The same effect, its law refined to its end."""
    return replace(best, solution=refine_to_end(best.law))
