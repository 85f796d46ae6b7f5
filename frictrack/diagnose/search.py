"""Search for the effects that a fitted model lacks.

Every effect is tried alone, then pairs, then sets of three, each size best first (`Explanations`). The search ends when
a set leaves no misfit, or when no larger set explains more.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from frictrack.costs import DEFAULT_COSTS, Costs
from frictrack.diagnose.admissible import objection
from frictrack.diagnose.auxiliary_signals import AuxiliarySignals, assess_accelerometer
from frictrack.diagnose.conclusion import Conclusion
from frictrack.diagnose.examination import Examination, examine, examine_again
from frictrack.diagnose.explanations import MAX_SIZE, Explanation, Explanations
from frictrack.diagnose.finished_search import FinishedSearch
from frictrack.diagnose.formulas import FormulaSearch, Shape, is_noise, shapes_of_functions
from frictrack.diagnose.hypothesis_tests import ALPHA
from frictrack.diagnose.model_selection import MAX_CHI2_NEAR, information_criterion
from frictrack.diagnose.refined_candidates import RefinedCandidate
from frictrack.diagnose.rivals import alternatives_of, find_rivals, names_in_place_of
from frictrack.diagnose.search_budget import describe_cut, search_budget
from frictrack.diagnose.subsampling import subsample, subsample_frames
from frictrack.diagnose.unsegmented import join_segments
from frictrack.diagnose.verdict import Diagnosis
from frictrack.effects import Effect
from frictrack.errors import FrictrackError
from frictrack.fit import Fit, GroupFits
from frictrack.fit.least_squares import Solution
from frictrack.fit.observations import observation_of
from frictrack.fit.stepwise import baseline_misfit, bic_penalty, refine_to_end
from frictrack.randomness import RNG, accepts_seed
from frictrack.threads import one_thread
from frictrack.verdicts import join_as_one

N_LISTED, MAX_P_LISTED = 2, 0.05  # effects that are always listed; p-value of the others
MIN_SIZE_IMITATING = 2  # of a set of effects that may imitate one formula
MIN_BIC_BEATEN = 40.0  # by which one formula explains more than the effects, so that no larger set is searched
MAX_UNKNOWNS_OF_FORMULA = 4

Progress = Callable[[int, int, str], None]


@accepts_seed
@one_thread()
def diagnose(  # noqa: PLR0913 - one function with named settings, all but the fit optional
    fit: Fit,
    *,
    own: Sequence[Effect] = (),
    functions: Sequence[str] = (),
    auxiliary: AuxiliarySignals | None = None,
    rng: RNG = 0,
    alpha: float = ALPHA,
    costs: Costs = DEFAULT_COSTS,
    progress: Progress | None = None,
    quick: bool = False,
    on_verdict: Callable[[Diagnosis], None] | None = None,
) -> Diagnosis:
    """Search the effect library for what a fitted model lacks.

    The search compares sets of effects, best first: every single effect, then pairs, then sets of three. It ends when a
    set leaves no misfit, or when no larger set explains more. Validation runs are not used.

    Parameters
    ----------
    fit
        One fit of all runs.
    own
        Further effects to try: the user's own, or library effects with bounds, priors or fixed values.
    functions
        Further functions of a dimensionless z for formulas of a force that no effect explains, such as "z^2*exp(-z)":
        tried with z = u/w and z = (u - c)/w over place, time and speed.
    auxiliary
        Other measurements, by run and name, one value per frame (n,): displacements of further targets in m, and
        "accelerometer" in m/s^2. Those that move with the residual are reported as evidence.
    rng
        Random numbers of the draws: a generator, a seed, or None for other numbers in every call.
    alpha
        Significance level: half for lack of fit, half for all candidates together. It bounds the probability that a
        complete model is said to lack something; a `Session` lowers it for models that are tried as alternatives.
    costs
        Costs of the next experiments, and what the set-up can do: they are rated by evidence over cost.
    progress
        Called with the size of the sets that are searched, the largest size, and the current step.
    quick
        Return the verdict and the candidates as soon as they are known, with `complete` False.
    on_verdict
        Called with that incomplete diagnosis as soon as the verdict is known; the verdict is not revised afterwards.

    Returns
    -------
    Diagnosis
        The verdict, the candidates with their evidence, the detection limits and the next experiment. p-values account
        for the whole search (999 draws).

    Raises
    ------
    FrictrackError
        If `fit` holds one fit per group, or `alpha` is not between 0 and 1.

    Examples
    --------
    >>> import frictrack as ft
    >>> ft.diagnose(ft.fit(["coulomb", "viscous"], ft.samples.runs()[1:2])).missing
    ['patch']

    """
    notify = progress or (lambda done, total, what: None)
    if isinstance(fit, GroupFits):
        raise FrictrackError("expected one fit of all runs to diagnose but got one per group; fit without --per first")
    _check_fit(fit)
    if not 0 < alpha < 1:
        raise FrictrackError(f"expected a significance level between 0 and 1 but got alpha = {alpha}")
    conclusion = _conclude(fit, (own, auxiliary), (rng, alpha / 2), notify, shapes_of_functions(functions))
    conclusion = replace(conclusion, costs=costs)
    if on_verdict is not None:
        on_verdict(conclusion.verdict)
    if quick:
        return conclusion.verdict
    diagnosis = conclusion.completed(auxiliary, lambda what: notify(MAX_SIZE, MAX_SIZE, what))
    notify(MAX_SIZE, MAX_SIZE, "diagnosed")
    return diagnosis


def _check_fit(given: object) -> None:
    """Raise an error for anything but a fit."""
    if not isinstance(given, Fit):
        raise FrictrackError(f"expected a fit, as ft.fit returns it, but got {type(given).__name__}", usage=True)


def _conclude(
    fit: Fit,
    signals: tuple[Sequence[Effect], AuxiliarySignals | None],
    chance: tuple[RNG, float],
    notify: Progress,
    shapes: tuple[Shape, ...],
) -> Conclusion:
    """Search and conclude; a fit in segments is searched in one piece first, if that explains everything.

    `chance` is (rng, significance level of each test); `shapes` are the user's own, for formulas.
    """
    rng, level = chance
    joined = join_segments(fit)
    if joined is not None:
        joined, remark = subsample_frames(joined)
        found = _search(fit, joined, signals, (np.random.default_rng(rng), level, notify), shapes)
        conclusion = Conclusion(fit, found, tuple(filter(None, [found.cut, remark])))
        if not found.last.leaves_misfit:
            notify(MAX_SIZE, MAX_SIZE, "comparing the effects found")
            if conclusion.verdict.verdict != "unexplained":
                return conclusion
    # the tests work on the displacement, whatever domain or search the fit used
    start = fit.solution if fit.route.is_default else refine_to_end(fit.solution)
    start, remarks = subsample(start)
    found = _search(fit, start, signals, (np.random.default_rng(rng), level, notify), shapes)
    notify(MAX_SIZE, MAX_SIZE, "comparing the effects found")
    return Conclusion(fit, found, tuple(filter(None, [found.cut, *remarks])))


def _search(
    fit: Fit,
    start: Solution,
    signals: tuple[Sequence[Effect], AuxiliarySignals | None],
    means: tuple[np.random.Generator, float, Progress],
    shapes: tuple[Shape, ...],
) -> FinishedSearch:
    """Search from one model; `signals` is (own, auxiliary), `means` is (rng, level, progress)."""
    (own, auxiliary), (rng, level, notify) = signals, means
    generators, budget = rng.spawn(2), search_budget(start.problem, MAX_SIZE)
    start = replace(start, problem=start.problem.with_budget(budget))
    observation, simulates = observation_of(start.problem), start.problem.simulates
    sensor = assess_accelerometer(start, fit.runs, auxiliary or {}) if simulates else None
    notify(0, MAX_SIZE, "testing the model for every effect of the library")
    first = last = examine(start, own, rng, level)
    scanned = sorted(first.tests.scanned, key=lambda s: -s.excess[0])
    space = Explanations(start, own, lambda e: 0.0 if sensor is None or e.acts_on == sensor.acts_on else MAX_CHI2_NEAR)
    best = space.begin(first, scanned if first.something_is_missing else scanned[:N_LISTED])
    formula = _FormulaInstead(FormulaSearch.of(start, shapes), simulates)
    beaten = False
    for size in range(1, MAX_SIZE + 1):
        beaten = last.something_is_missing and size > MIN_SIZE_IMITATING and formula.explains_more(best)
        if beaten or not last.something_is_missing:
            break
        notify(size, MAX_SIZE, _describe_step(best, size))
        space.grow(size)
        new = space.better(best, last)
        if new is not None:
            best = space.refine_fully(new)
            law = observation.weighted(best.law)
            space.rebase(best, law)
            last = examine_again(law, own, rng, first)
        elif size > 1 or not last.leaves_misfit:
            break
    if len(best.effects) == 1 and not last.something_is_missing:
        pair = space.pair_instead(best)
        if pair is not best:
            best = space.refine_fully(pair)
            last = examine_again(best.law, own, rng, first)
    misfit = baseline_misfit(first.draws.law)
    alone = [_tried(one, first, space.known[frozenset()], misfit) for one in space.of_size(1)]
    tried = [t for i, t in enumerate(alone) if i < N_LISTED or t.p < MAX_P_LISTED or t.solution is not None]
    found = _found(space, best, first)
    rivals = find_rivals(best, space.of_size(len(best.effects))) if found else []
    found = [replace(t, indistinguishable_from=names_in_place_of(t.effect.title, best, rivals)) for t in found]
    cut = describe_cut(budget, [one.names for one in space.known.values() if one.is_unrefined], found)
    budget.grant(np.inf)  # what follows from the search takes a bounded number of evaluations
    alternatives = alternatives_of(best, rivals)
    return FinishedSearch(
        start, first, last, tried, found, generators, formula.search, cut, alternatives, is_beaten=beaten
    )


def _describe_step(best: Explanation, size: int) -> str:
    if size == 1:
        return "refining every effect that may explain the misfit"
    if not best.effects:
        return f"no effect alone passes: trying sets of {size}"
    return f"{join_as_one([e.title for e in best.effects])} leaves misfit: trying sets of {size}"


def _tried(one: Explanation, first: Examination, empty: Explanation, misfit: float) -> RefinedCandidate:
    """An effect alone, with its evidence; `misfit` is what the model leaves without it along the measured motion."""
    assert one.trial is not None
    p = first.p_of_gain(one.last, one.gain(empty, one.last))
    passes = p < first.tests.level and one.is_law and first.confirms(one.law, one.last)
    share = (misfit - one.trial[1].misfit) / max(misfit - first.solution.problem.n_frames, 1e-300)
    return RefinedCandidate(
        one.last, one.solution, one.evidence(empty), p, (), one.objection, float(np.clip(share, 0.0, 1.0)), passes
    )


def _found(space: Explanations, best: Explanation, first: Examination) -> list[RefinedCandidate]:
    """The effects of the best explanation, each beside those before it, the strongest first."""
    found = []
    for before, after in pairwise(space.chain(best)):
        for effect in (e for e in best.effects if e.title in after.names - before.names):
            gain = after.gain(before, effect)
            p = first.tests.p_of_gain(effect.title, gain) if before.effects else first.p_of_gain(effect, gain)
            why = objection(best.law, effect)
            found.append(RefinedCandidate(effect, after.law, after.evidence(before), p, objection=why, passes=True))
    return found


@dataclass(frozen=True, eq=False)
class _FormulaInstead:
    """One formula in place of all effects: where it explains far more, no larger set of effects is searched."""

    search: FormulaSearch
    is_comparable: bool  # whether the residual is one that formulas are fitted to

    def explains_more(self, best: Explanation) -> bool:
        """Whether it leaves only noise, and the effects found explain far less by the BIC: they imitate it."""
        start, n = self.search.solution, self.search.solution.problem.n_frames
        if not self.is_comparable or not is_noise(self.search.least_misfit - n, n):
            return False
        fall = start.objective - self.search.least_misfit - bic_penalty(MAX_UNKNOWNS_OF_FORMULA, n)
        return bool(information_criterion(start) - fall < best.criterion + 2 * best.log_prior - MIN_BIC_BEATEN)
