"""Search for the effects that a fitted model lacks.

Each round tests the model, adds the best effect and tests again. The search ends when no misfit is left, or when no
effect reduces it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from frictrack.costs import DEFAULT_COSTS, Costs
from frictrack.diagnose.admissible import objection
from frictrack.diagnose.auxiliary_signals import AuxiliarySignals, Evidence
from frictrack.diagnose.compressed import MIN_REDUCED_CHI2_FAR
from frictrack.diagnose.conclusion import Conclusion, FinishedSearch
from frictrack.diagnose.formulas import Shape, is_noise, least_misfit, shapes_of_functions
from frictrack.diagnose.hypothesis_tests import ALPHA
from frictrack.diagnose.joint_search import AlternativeSet, exchange_effects, with_rivals_of_sets
from frictrack.diagnose.model_selection import MAX_CHI2_NEAR, information_criterion
from frictrack.diagnose.parsimony import simplest_candidate, stronger_of_smooth_pair
from frictrack.diagnose.refined_candidates import RefinedCandidate, refine_fully
from frictrack.diagnose.residual_kinds import residual_kind
from frictrack.diagnose.rivals import find_rivals
from frictrack.diagnose.rounds import Round, run_later_round, run_round
from frictrack.diagnose.search_budget import describe_cut, search_budget
from frictrack.diagnose.smooth_forces import forces_of
from frictrack.diagnose.subsampling import subsample_frames
from frictrack.diagnose.unsegmented import join_segments
from frictrack.diagnose.verdict import Diagnosis
from frictrack.effects import Effect
from frictrack.errors import FrictrackError
from frictrack.fit import Fit, GroupFits
from frictrack.fit.least_squares import Solution
from frictrack.fit.stepwise import bic_penalty, refine_to_end
from frictrack.randomness import RNG, accepts_seed
from frictrack.threads import one_thread

MAX_EFFECTS = 4  # that are added
MAX_ROUNDS = 8  # of testing, adding and reviewing
MIN_RATIO_BEATEN = 10.0  # of the misfit that effects leave to that which one formula leaves in place of all of them
MIN_EFFECTS_IMITATING = 3  # effects found, from which on they may imitate one formula
MIN_BIC_BEATEN = 40.0  # by which one formula explains more than the effects, so that no other set is searched
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

    The search is a forward selection. It adds the best effect while one passes the test, and drops effects that a
    later one makes unnecessary. Validation runs are not used.

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
        Called with the number of rounds done, their total, and the current step.
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
    diagnosis = conclusion.completed(auxiliary, lambda what: notify(MAX_ROUNDS, MAX_ROUNDS, what))
    notify(MAX_ROUNDS, MAX_ROUNDS, "diagnosed")
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
        conclusion = Conclusion(fit, found, tuple(filter(None, [found.cut, remark])), shapes)
        if not found.last.leaves_misfit:
            notify(MAX_ROUNDS, MAX_ROUNDS, "comparing the effects found")
            if conclusion.verdict.verdict != "unexplained":
                return conclusion
    # the tests work on the displacement, whatever domain or search the fit used
    start = fit.solution if fit.route.is_default else refine_to_end(fit.solution)
    start, remarks = residual_kind(start.problem).prepare(start)
    found = _search(fit, start, signals, (np.random.default_rng(rng), level, notify), shapes)
    notify(MAX_ROUNDS, MAX_ROUNDS, "comparing the effects found")
    return Conclusion(fit, found, tuple(filter(None, [found.cut, *remarks])), shapes)


def _search(
    fit: Fit,
    start: Solution,
    signals: tuple[Sequence[Effect], AuxiliarySignals | None],
    means: tuple[np.random.Generator, float, Progress],
    shapes: tuple[Shape, ...],
) -> FinishedSearch:
    """Run the rounds of a search from one model; `signals` is (own, auxiliary), `means` is (rng, level, progress)."""
    (own, auxiliary), (rng, level, notify) = signals, means
    generators, budget = rng.spawn(2), search_budget(start.problem, MAX_EFFECTS)
    start = replace(start, problem=start.problem.with_budget(budget))
    kind = residual_kind(start.problem)
    sensor = kind.accelerometer(start, fit.runs, auxiliary)
    first = last = run_round(start, own, rng, lambda what: notify(0, MAX_ROUNDS, what), level)
    tested, unrefined, found = [first.tested], first.unrefined, list[RefinedCandidate]()
    formula = _FormulaInstead(start, shapes, kind.imitates)
    compared: list[str] = []  # effects of which other sets were compared, and these sets
    alternatives: list[AlternativeSet] = []
    for done in range(1, MAX_ROUNDS + 1):

        def notify_round(what: str, done: int = done) -> None:
            notify(done, MAX_ROUNDS, what)

        if last.passing and len(found) < MAX_EFFECTS:
            best = refine_fully(_choose_candidate(last, sensor))
            found.append(
                replace(best, indistinguishable_from=find_rivals(best, _consistent_with_sensor(last.tried, sensor)))
            )
        elif formula.explains_more(found):
            break
        else:
            before = [t.effect.name for t in found]
            found = kind.review(tested, found, own, notify_round)
            if [t.effect.name for t in found] == before != compared and not last.leaves_misfit:
                notify_round("comparing sets of effects")
                found, alternatives = exchange_effects(first, tested, found, lambda e: _agrees_with_sensor(e, sensor))
                compared = [t.effect.name for t in found]
            if [t.effect.name for t in found] == before:
                break
        notify_round(f"{', '.join(t.effect.name for t in found)} added, testing again")
        law = found[-1].law if found else start
        last = run_later_round(kind.before_round(law), own, rng, notify_round, level, formula.beats)
        tested, unrefined = [*tested, last.tested], unrefined + last.unrefined
    found = with_rivals_of_sets(found, alternatives)  # at the end: a review names its own rivals
    found = [replace(t, objection=objection(found[-1].law, t.effect)) for t in found]
    cut = describe_cut(budget, unrefined, found)
    budget.grant(np.inf)  # what follows from the search takes a bounded number of evaluations
    return FinishedSearch(start, first, last, found, generators, cut, alternatives)


@dataclass(frozen=True, eq=False)
class _FormulaInstead:
    """One formula in place of all effects: where it explains far more, these are neither completed nor exchanged."""

    start: Solution
    shapes: tuple[Shape, ...]
    is_comparable: bool  # whether the residual is one that formulas are fitted to

    @cached_property
    def misfit(self) -> float:
        """Misfit that the best formula of one term leaves in the model without any effect found."""
        return least_misfit(forces_of(self.start), self.shapes)

    def beats(self, misfit: float) -> bool:
        """Whether it leaves far less than a misfit, which is far above the noise itself."""
        is_far = misfit > MIN_REDUCED_CHI2_FAR * self.start.problem.n_frames
        return self.is_comparable and is_far and MIN_RATIO_BEATEN * self.misfit < misfit

    def explains_more(self, found: Sequence[RefinedCandidate]) -> bool:
        """Whether it leaves only noise, and several effects found explain far less by the BIC: they imitate it.

        Other sets of effects need not be searched then, because the few parameters of a formula suffice.
        """
        start, n = self.start, self.start.problem.n_frames
        if not self.is_comparable or len(found) < MIN_EFFECTS_IMITATING or not is_noise(self.misfit - n, n):
            return False
        fall = start.objective - self.misfit - bic_penalty(MAX_UNKNOWNS_OF_FORMULA, n)
        return bool(information_criterion(start) - fall < information_criterion(found[-1].law) - MIN_BIC_BEATEN)


def _consistent_with_sensor(tried: Sequence[RefinedCandidate], sensor: Evidence | None) -> list[RefinedCandidate]:
    """Keep the candidates that agree with the accelerometer, which separates a moving mass from a moving picture."""
    return [t for t in tried if _agrees_with_sensor(t.effect, sensor)]


def _agrees_with_sensor(effect: Effect, sensor: Evidence | None) -> bool:
    return sensor is None or effect.acts_on == sensor.acts_on


def _choose_candidate(tested: Round, sensor: Evidence | None) -> RefinedCandidate:
    """Return the simplest of the best passing candidates.

    Candidates that agree with the accelerometer come first if they explain nearly as much. While much misfit remains,
    one of two simple effects comes before a flexible effect that imitates their sum.
    """
    passing = tested.passing
    near = [t for t in _consistent_with_sensor(passing, sensor) if passing[0].delta_bic - t.delta_bic < MAX_CHI2_NEAR]
    best = simplest_candidate(near or passing)
    return stronger_of_smooth_pair(tested, best) or best
