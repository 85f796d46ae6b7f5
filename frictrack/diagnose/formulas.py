"""Search the most probable formulas of what a model leaves: known shapes over one variable, judged by their evidence.

Every shape of `shapes` is tried over place, time and speed, resisting motion or not, added to the linearised model. The
best are added to the model and fitted in full. Beside the model with the best formula all forms are then compared by
their evidence, and the most probable are fitted in full. If significant misfit remains, a second term is fitted.

"None of these" competes with the forms: a smooth force of any shape in their place, and what a smooth force still
explains after the best of them.

Formulas are compared with effects where a smooth force over one variable is about as likely as these, or where effects
with parameters of their own in every run, which imitate much, were found though the misfit repeats over one axis. Both
are compared by their evidence. Every form has a smaller prior probability than an effect of the library, because there
are more of them and a cause outside of the library is rarer. Of sets of effects there are even more, and several causes
at once are rarer, too.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy.optimize import least_squares
from scipy.special import expit, logsumexp

from frictrack.base.errors import FrictrackError
from frictrack.base.number_format import format_share
from frictrack.diagnose.compressed import (
    LENGTH_RATIOS,
    CompressedResidual,
    candidate_axes,
    compress_near_data,
    compress_residual,
    smooth_forces,
)
from frictrack.diagnose.formula_scan import LOG_PRIOR_PER_UNKNOWN, Scan, scan_forms
from frictrack.diagnose.formula_terms import (
    AXIS_SYMBOLS,
    EFFECT_NAME,
    SHAPES,
    FittedFormula,
    Shape,
    Term,
    build_effect,
    coefficient_names,
    describe_formula,
    formula_axes,
)
from frictrack.diagnose.friction_levels import law_with_likely_levels
from frictrack.diagnose.model_selection import (
    MAX_BIC_EQUAL,
    excess_chi2,
    information_criterion,
    leaves_only_noise,
    log_prior_of_set,
)
from frictrack.diagnose.repeatability import Repeatability
from frictrack.effects import Effect, Path
from frictrack.fit.least_squares import Solution, fit_with_scatter
from frictrack.fit.linearised import LinearisedModel, linearise
from frictrack.fit.observations import keep_compared_frames
from frictrack.fit.stepwise import add_effect, entry_order, refine_on_measured_motion, refine_to_end, remove_effect
from frictrack.records import Array
from frictrack.results.candidates import AXES

N_FIRST_FITTED, N_SECOND_FITTED = 3, 2  # first and second terms fitted in full, unless one leaves only noise
N_REFINED_FIRST, N_REFINED = 16, 300  # forms refined for the bare model, and for the model with a formula
N_SHOWN = 6  # formulas reported
MIN_RISE_COMPARED_AGAIN = 2.0  # of the fall of BIC by a better formula, for which all forms are compared again
MAX_EVIDENCE_BEHIND = 15.0  # of the logarithm of the evidence; a form further behind is not probable
MAX_GAIN_ERROR = 0.01  # of a gain in the linearised model, where the rest of the model moves far
MIN_CHI2_FALL = 0.01  # of a step of a formula that is compared with the best one
PRIOR_NONE = 0.1  # prior probability of a cause outside of the grammar, and of one outside of the library
FIRST_FORMULA = "formula:1"  # as in `frictrack add STUDY formula:1`
MAX_PROBABILITY_UNLIKELY, MIN_PROBABILITY_DECISIVE = 0.05, 0.95
MAX_RESIDUAL_SHARE = 1e-4  # of the force of a formula that a special case leaves; imitations leave more
CREDIBLE_PROBABILITY = 0.95  # that the right form is in the group, if the grammar has it


@dataclass(frozen=True)
class _Found:
    """Fitted formulas, and logarithms of the weights of all forms compared and of a cause outside of the grammar.

    `free` is the latter's weight as a smooth force of any shape, whatever the formulas leave.
    """

    fitted: dict[str, FittedFormula]
    weights: dict[str, float]
    none: float
    free: float = -np.inf

    def joined(self, other: _Found) -> _Found:
        """Both, of forms in both the one of the higher weight."""
        forms = self.weights | other.weights
        weights = {f: max(one.weights.get(f, -np.inf) for one in (self, other)) for f in forms}
        better = {f: one for f, one in self.fitted.items() if self.weights[f] == weights[f]}
        return _Found(other.fitted | better, weights, max(self.none, other.none), max(self.free, other.free))


@dataclass(frozen=True, eq=False)
class FormulaSearch:
    """Search of formulas in the residual of one model; what several steps of a diagnosis need is computed once.

    Parameters
    ----------
    solution
        The fitted model.
    functions
        Further shapes, of the user's own functions.
    bare
        The model with which formulas are compared, if it is not `solution`.

    """

    solution: Solution
    functions: tuple[Shape, ...] = ()
    bare: Solution | None = None

    @classmethod
    def of(cls, solution: Solution, functions: tuple[Shape, ...] = ()) -> FormulaSearch:
        """The search in the frames of a fit that are compared."""
        return cls(keep_compared_frames(solution), functions)

    @cached_property
    def compressed(self) -> CompressedResidual:
        """The compressed residual of the model."""
        return compress_near_data(self.solution)

    @cached_property
    def _linearised(self) -> LinearisedModel:
        """The model along the measured motion."""
        return linearise(self.solution)

    @cached_property
    def least_misfit(self) -> float:
        """Misfit that is left by the best formula of one term, fitted in full; at most that of the model."""
        return min([self.solution.objective, *(one.solution.objective for one in self._firsts)])

    @property
    def leaves_only_noise(self) -> bool:
        """Whether the best formula of one term leaves only noise."""
        return bool(self._firsts) and leaves_only_noise(self._leader.solution)

    @cached_property
    def leaves_nothing(self) -> bool:
        """Whether the best formula is more probable than that none of them has the right form."""
        found = self._found
        return max(found.weights.values(), default=-np.inf) > found.none

    def found(self, extended: Solution | None = None) -> list[FittedFormula]:
        """Return the formulas that fit what the model leaves, most probable first.

        Where all leave significant misfit, they are also added to `extended`, the model with the effects found.
        """
        found = self._found
        if extended is not None and not any(leaves_only_noise(one.solution) for one in found.fitted.values()):
            found = found.joined(FormulaSearch(extended, self.functions, self.solution)._found)
        probabilities = form_probabilities(found.weights, found.none)
        better = [one for one in found.fitted.values() if one.delta_bic > 0]
        shown = sorted(better, key=lambda one: -found.weights[one.form])[:N_SHOWN]
        group, out = credible_forms(probabilities), []
        for one in shown:
            first = shown[0].form
            others = [form for form in group if form != first] if one is shown[0] else [first] * (one.form in group)
            stated = {"probability": probabilities[one.form], "equivalents": others}
            out.append(replace(one, entry=describe_formula(one, self.solution) | stated))
        return out

    @cached_property
    def _firsts(self) -> list[FittedFormula]:
        """The most probable forms added to the model, fitted in full up to the first one that leaves only noise."""
        return self._fit_next(self.solution, (), self.compressed, N_FIRST_FITTED)

    @cached_property
    def _leader(self) -> FittedFormula:
        """The best of these."""
        return max(self._firsts, key=lambda one: one.delta_bic)

    @cached_property
    def _found(self) -> _Found:
        """Formulas of one term, and of two if misfit remains."""
        if not self._firsts:
            return _Found({}, {}, 0.0)
        best = self._leader
        best = self._evaluated(best.terms, refine_to_end(best.solution))
        if self.bare is None and not leaves_only_noise(best.solution):
            best = self._refit_model_effects(best)
        single, best, sizes = self._compare_forms(best)
        if leaves_only_noise(best.solution):
            return single
        left = compress_near_data(best.solution)
        pairs = self._fit_next(best.solution, best.terms, left, N_SECOND_FITTED)
        if not pairs:
            return single
        leader = max(pairs, key=lambda one: one.delta_bic).solution
        base, unit = max(single.weights.values()), _unit(leader)
        weights = {
            one.form: base + (one.delta_bic - best.delta_bic) / (2 * unit) + log_prior(one.terms[-1].size, sizes)
            for one in pairs
        }
        both = single.joined(_Found({one.form: one for one in pairs}, weights, -np.inf))
        rest = float(logsumexp(list(both.weights.values()))) + remaining_evidence(leader)
        return replace(both, none=max(single.free, float(np.log(PRIOR_NONE)) + rest))

    def _compare_forms(self, best: FittedFormula) -> tuple[_Found, FittedFormula, list[int]]:
        """Compare all forms of one term with the best one, each added to the model, and fit those that may be probable.

        Where one of them proves better, all are compared with that one once more.
        """
        for is_last in (False, True):
            compressed, unit = self._compress_without_formula(best.solution), _unit(best.solution)
            scan = scan_forms(compressed, self._shapes, N_REFINED, unit)
            if not scan.terms:
                return _Found({best.form: best}, {best.form: best.delta_bic / 2}, 0.0), best, scan.sizes
            evidence = scan.evidence(unit)
            least = max(evidence.values()) - MAX_EVIDENCE_BEHIND - MAX_GAIN_ERROR * scan.power / (2 * unit)
            fitted, leader = {}, best
            for term in sorted(scan.terms, key=lambda t: -evidence[t.form])[:N_SHOWN]:
                one = best if term.form == best.form else None
                if one is None and evidence[term.form] > least:
                    one = self._exchange_term(best, term)
                if one is not None:
                    fitted[one.form] = one
                    leader = max(leader, one, key=lambda f: f.delta_bic)
                if leader.delta_bic > best.delta_bic + MIN_RISE_COMPARED_AGAIN and not is_last:
                    break
            if is_last or leader.delta_bic <= best.delta_bic + MIN_RISE_COMPARED_AGAIN:
                break
            best = leader
        return _weighed(best, fitted, scan, compressed), leader, scan.sizes

    @property
    def _shapes(self) -> tuple[Shape, ...]:
        return (*SHAPES, *self.functions)

    def _evaluated(self, terms: tuple[Term, ...], solution: Solution) -> FittedFormula:
        """A fitted formula with its gain over the bare model."""
        bare = self.bare or self.solution
        excess = excess_chi2(bare)
        share = float(np.clip((excess - excess_chi2(solution)) / max(excess, 1e-300), 0.0, 1.0))
        return FittedFormula(terms, solution, information_criterion(bare) - information_criterion(solution), share)

    def _compress_without_formula(self, solution: Solution) -> CompressedResidual:
        """Compress the residual with the force of the formula in it.

        The formula may take up the scatter of few friction levels by chance; that of the bare model is kept.
        """
        scattered = replace(solution, tau=max(solution.tau or 0.0, (self.bare or self.solution).tau or 0.0))
        return compress_near_data(scattered, EFFECT_NAME)

    def _fit_next(
        self, solution: Solution, first: tuple[Term, ...], compressed: CompressedResidual, count: int
    ) -> list[FittedFormula]:
        """Add the most probable terms to a model and fit each in full, up to the first one that leaves only noise.

        Terms that cannot be integrated are left out.
        """
        name = EFFECT_NAME if not first else f"{EFFECT_NAME}_{len(first) + 1}"
        scan = scan_forms(compressed, self._shapes, N_REFINED_FIRST, _unit(solution))
        out: list[FittedFormula] = []
        for term in scan.terms[:count]:
            with suppress(FrictrackError):
                fitted = law_with_likely_levels(add_effect(solution, build_effect(name, term)))
                is_last = leaves_only_noise(fitted)
                out.append(self._evaluated((*first, term), fitted if is_last else refine_to_end(fitted)))
                if is_last:
                    break
        return out

    def _exchange_term(self, best: FittedFormula, term: Term) -> FittedFormula | None:
        """Replace the only term of a formula, starting from its fit; None if it cannot be integrated."""
        solution = best.solution
        old = solution.problem.layout
        (replaced,) = (e for e in old.model.effects if e.name == EFFECT_NAME)
        effect = build_effect(EFFECT_NAME, term)
        effect = effect.with_other_level() if replaced.level_is_chosen and effect.may_follow_level else effect
        layout = replace(old, model=old.model - EFFECT_NAME + effect)
        names = [f"{EFFECT_NAME}.{name}" for name in (*term.shape.parameters, *coefficient_names(term))]
        values = dict(zip(old.names, solution.p, strict=True))
        values |= dict(zip(names, (*term.parameters, *term.coefficients), strict=True))
        problem = solution.problem.rebuild(layout, solution.problem.pieces).beginning_at(solution.responses)
        p = np.array([values[name] for name in layout.names])
        with suppress(FrictrackError):
            p = refine_on_measured_motion(self._linearised, layout, p)  # the law makes up for the term that it had
            tau = solution.tau or 0.03
            fitted = fit_with_scatter(problem, p, solution.starts, tau, min_fall=MIN_CHI2_FALL)
            return self._evaluated((term,), fitted)
        return None

    def _refit_model_effects(self, best: FittedFormula) -> FittedFormula:
        """Refit effects of the model that fit better elsewhere together with the formula."""
        solution = best.solution
        for effect in entry_order(self.solution.problem.model)[1]:
            with suppress(FrictrackError):
                moved = add_effect(remove_effect(solution, effect.name), effect)
                solution = moved if moved.objective < solution.objective else solution
        return self._evaluated(best.terms, solution)


def _weighed(
    best: FittedFormula, fitted: dict[str, FittedFormula], scan: Scan, compressed: CompressedResidual
) -> _Found:
    """Weights of all forms, relative to the model without a formula.

    They are half the fall of BIC of the best formula and the differences of evidence to it, for forms fitted in
    full as they are there.
    """
    unit, gains = _unit(best.solution), {t.form: t.gain for t in scan.terms}
    evidence = scan.evidence(unit)
    base = best.delta_bic / (2 * unit) - max(evidence.values())
    weights = {form: base + one for form, one in evidence.items()}
    for form, one in fitted.items():
        gain = gains.get(best.form, scan.power) + best.solution.objective - one.solution.objective
        weights[form] += (gain - gains[form]) / (2 * unit)
    outside = float(np.log(PRIOR_NONE))
    free = outside + base + smooth_evidence(compressed, scan.power, unit) - log_prior(0, scan.sizes)
    left = outside + float(logsumexp(list(weights.values()))) + remaining_evidence(best.solution)
    return _Found(fitted, weights, max(free, left), free)


def _unit(solution: Solution) -> float:
    """Reduced chi-squared, if it is above 1."""
    return max(solution.chi2 / max(solution.problem.n_frames - len(solution.p), 1), 1.0)


def log_prior(size: int, sizes: Sequence[int]) -> float:
    """Logarithm of the prior probability of a form of a size among those of a grammar.

    Examples
    --------
    >>> round(log_prior(1, [1, 2, 2]), 3)
    -0.693

    """
    return LOG_PRIOR_PER_UNKNOWN * size - float(logsumexp(LOG_PRIOR_PER_UNKNOWN * np.array(sizes)))


def smooth_evidence(compressed: CompressedResidual, power: float, unit: float = 1.0) -> float:
    """Logarithm of the evidence of a smooth force of any shape over the best axis, as `relative_evidence` of a form."""
    smooth = compressed.smooth
    tried = float(np.log(len(smooth) * len(LENGTH_RATIOS)))
    return smooth[0].gain / (2 * unit) - tried - 0.5 * float(np.log1p(power / unit))


def remaining_evidence(solution: Solution) -> float:
    """Logarithm of the evidence that something is left by a model: a smooth force, or misfit of any kind."""
    n = solution.problem.n_frames
    ratio = max(solution.chi2 / max(n - 2 * len(solution.responses) - len(solution.p), 1), 1.0)
    misfit = 0.5 * (n * (ratio - 1 - float(np.log(ratio))) - float(np.log(n)))
    return max(smooth_evidence(compress_residual(solution), 0.0), misfit, 0.0)


def form_probabilities(weights: Mapping[str, float], none: float) -> dict[str, float]:
    """Probability of every form, highest first; what is missing to 1 belongs to none of them.

    The weights are logarithms, `none` that of a cause outside of the grammar.

    Examples
    --------
    >>> {form: round(p, 2) for form, p in form_probabilities({"a": 0.0, "b": 0.0}, 0.0).items()}
    {'a': 0.33, 'b': 0.33}

    """
    total = float(logsumexp([*weights.values(), none]))
    order = sorted(weights.items(), key=lambda pair: -pair[1])
    return {form: float(np.exp(weight - total)) for form, weight in order}


def credible_forms(probabilities: Mapping[str, float]) -> list[str]:
    """The most probable forms, which hold `CREDIBLE_PROBABILITY` of all forms of the grammar together.

    Examples
    --------
    >>> credible_forms({"a": 0.5, "b": 0.3, "c": 0.01})
    ['a', 'b']

    """
    forms = sorted(probabilities, key=lambda form: -probabilities[form])
    before = np.cumsum([0.0, *(probabilities[form] for form in forms)])
    return [form for form, p in zip(forms, before, strict=False) if p < CREDIBLE_PROBABILITY * before[-1]]


@dataclass(frozen=True)
class UnexplainedForce:
    """A force that no effect explains.

    Attributes
    ----------
    summary
        `axis`; `factor` that multiplies the curve along a run, as in a study file; `curve` [[axis, N], ...]; `band`, N;
        `share` of the excess chi-squared; `delta_bic`; `axes` compared; `formulas`; `probability_none` that none of
        them has the right form.
    formulas
        The formulas, with their fits.
    effects
        Effects of the library that are terms of the first formula, where that explains far more than those found.

    """

    summary: dict[str, Any]
    formulas: Sequence[FittedFormula]
    effects: Sequence[str] = ()

    def as_candidate(self) -> tuple[str, Solution, float] | None:
        """The first formula as a candidate: its name in `frictrack add`, its fit, and its fall of BIC.

        None if there is no formula, or if it is a sum of several terms.
        """
        if not self.formulas or len(self.formulas[0].terms) > 1:
            return None
        first = self.formulas[0]
        old = first.solution.problem
        known = f"the formula depends on {_names_of(first.terms[0].variables)} alone"
        effects = tuple(
            replace(e, name=FIRST_FORMULA, invariant=known) if e.name == EFFECT_NAME else e for e in old.model.effects
        )
        layout = replace(old.layout, model=replace(old.layout.model, effects=effects))
        return FIRST_FORMULA, replace(first.solution, problem=old.rebuild(layout, old.pieces)), first.delta_bic


def unexplained_force(search: FormulaSearch, extended: Solution | None = None) -> UnexplainedForce:
    """Describe what a fitted model leaves unexplained.

    `search`: the search of formulas added to the model; `extended`: the fit with the effects found so far; the curve is
    what that leaves. Formulas are added to the model itself if possible, and to effects with memory never: see
    `are_left_out`.
    """
    extended = None if extended is None or extended is search.solution else keep_compared_frames(extended)
    smooth = (search.compressed if extended is None else compress_near_data(extended)).smooth
    best = smooth[0]
    formulas = search.found(None if extended is None or are_left_out(search, extended) else extended)
    entries = [one.entry for one in formulas]
    summary = {
        "axis": best.axis.name,
        "factor": best.axis.factor,
        "curve": np.column_stack([best.at, best.force]).tolist(),
        "band": best.sigma.tolist(),
        "share": best.share,
        "delta_bic": best.gain,
        "axes": len(smooth),
        "probability_none": max(1.0 - sum(one["probability"] for one in entries), 0.0) if entries else None,
        "formulas": entries,
    }
    if formulas and leaves_only_noise(formulas[0].solution):
        summary["words"] = _words(entries[0])
    return UnexplainedForce(summary, formulas)


def are_left_out(search: FormulaSearch, extended: Solution) -> bool:
    """Whether no formulas are added to the effects found, because these alone have memory.

    Every fit with memory takes seconds, of hundreds, and the memory of a lead is itself no known part of the model.
    """
    return extended.problem.model.memory and not search.solution.problem.model.memory


def compare_with_formulas(
    search: FormulaSearch, found: Solution, repeats: Callable[[], Repeatability], rivals: Sequence[Solution] = ()
) -> UnexplainedForce | None:
    """Find formulas of one variable that explain as much as the effects found.

    `search`: the search of formulas added to the model without the effects; `found`: the model with the effects found;
    `rivals`: others that explain as much. A formula that one of these contains is no other cause. `repeats`: computes
    whether the misfit repeats, and over which axis; called only where that matters.

    The summary has besides `probability` that one of the formulas is the cause and the effects are not, `decisive` if
    that is at least `MIN_PROBABILITY_DECISIVE`, `rival` in words if it is neither that nor unlikely, and `words`. None
    if no formula explains as much.
    """
    start = search.solution
    evidence = information_criterion(start) - information_criterion(found)
    count = max(len(found.problem.model.names) - len(start.problem.model.names), 1)
    prior = _log_prior_odds(len(candidate_axes(search.compressed)), count)
    margin = MAX_BIC_EQUAL + 2 * max(prior, 0.0)  # with less evidence, a formula is unlikely
    if not _is_worth_searching(search, found, repeats, evidence - margin):
        return None
    unexplained = unexplained_force(search)
    formulas: list[FittedFormula] = []
    for one in unexplained.formulas:
        if any(all(effects_of_terms(one.solution, [own])) for own in (found, *rivals)):
            evidence = max(evidence, one.delta_bic)  # of the effects, which it is
        else:
            formulas.append(one)
    listed, advantages = [one.entry for one in formulas], np.array([one.delta_bic - evidence for one in formulas])
    if advantages.max(initial=-np.inf) < -margin:
        return None
    probability = _probability(advantages, np.array([entry["probability"] for entry in listed]), prior)
    decisive = probability > MIN_PROBABILITY_DECISIVE
    is_rival = MAX_PROBABILITY_UNLIKELY < probability <= MIN_PROBABILITY_DECISIVE
    compared = {
        "probability": probability,
        "decisive": decisive,
        "rival": f"a formula of {_names_of(listed[0]['variables'])}" if is_rival else None,
        "words": _words(listed[0], len(found.problem.layout.slots) - len(start.problem.layout.slots), probability),
    }
    effects = effects_of_terms(formulas[0].solution, [found, *rivals]) if decisive else []
    return UnexplainedForce(unexplained.summary | compared | {"formulas": listed}, formulas, [e for e in effects if e])


def _is_worth_searching(
    search: FormulaSearch, found: Solution, repeats: Callable[[], Repeatability], evidence: float
) -> bool:
    """Whether a smooth force of any variable of the formulas may explain more, or effects may imitate one."""
    gain = smooth_forces(search.compressed, formula_axes(search.compressed))[0].gain
    # near the evidence of the effects, the linear approximation does not decide: the fits of the best formulas do,
    # and beside these, others may still fit better
    near = evidence / (1 + MAX_GAIN_ERROR)
    if gain > evidence or min(gain, search.solution.objective - search.least_misfit) > near:
        return True
    own = {s.effect for s in found.problem.layout.slots if s.run is not None}
    start = search.solution.problem
    several = len({p.run for p in start.pieces}) > 1
    may_imitate = several and any(name in own for name in found.problem.model.names if name not in start.model)
    best_axis = repeats().best if may_imitate else None
    return best_axis is not None and best_axis.axis in AXIS_SYMBOLS


def _probability(advantages: Array, shares: Array, prior: float) -> float:
    """Probability that one of the forms is the cause and not the effects found.

    `advantages` (n,) are the BIC of the listed forms over that of the effects, `shares` (n,) the probabilities of these
    forms among all, and `prior` the logarithm of the prior odds of one form.
    """
    return float(expit(logsumexp(advantages / 2) - np.log(max(shares.sum(), 1e-300)) + prior))


def _log_prior_odds(axes: int, count: int) -> float:
    """Logarithm of the prior probability of one form over that of a set of `count` effects; all of a kind are alike."""
    forms = len(SHAPES) * len(AXIS_SYMBOLS) * max(axes, 1)
    return float(np.log(PRIOR_NONE / forms) - np.log(1 - PRIOR_NONE) - log_prior_of_set(count))


def _words(first: Mapping[str, Any], added: int | None = None, probability: float = 1.0) -> str:
    """Say what a formula explains, more or as much as effects with so many parameters where some were found."""
    count = "one parameter" if first["unknowns"] == 1 else f"{first['unknowns']} parameters"
    force = f"a force that depends only on {_names_of(first['variables'])} explains"
    if added is None:
        return f"{force} the misfit with {count}, common to all runs: {first['formula']}"
    decisive = probability > MIN_PROBABILITY_DECISIVE
    much, than = ("more", "than") if decisive else ("as much", "as")
    instead = f"; the probability that it is the cause instead is {format_share(max(probability, 1e-9))}"
    return (
        f"{force} {much} with {count}, common to all runs, {than} the effects found with {added}: "
        f"{first['formula']}{'' if decisive else instead}"
    )


def _names_of(variables: tuple[str, ...] | list[str]) -> str:
    return " and ".join(AXES[name].name for name in variables)


def effects_of_terms(formula: Solution, found: Sequence[Solution]) -> list[str]:
    """Return for every term of a formula the effect that is exactly this force, given the law; "" where none is.

    `formula`: the fit with a formula; `found`: fits with effects more than the law. Only effects whose force depends on
    the moment alone are compared; a phase of each run may be the same in all of them.
    """
    terms, law, runs = _forces_of_terms(formula)
    own = [(e, f) for f in found for e in f.problem.model.effects if e.name not in formula.problem.model]
    own = [(e, f) for e, f in own if _is_comparable(e)]
    return [next((e.title for e, f in own if _is_force_of(e, f, force, law, runs)), "") for force in terms]


def _is_force_of(effect: Effect, found: Solution, force: Array, law: Array, runs: Sequence[tuple[int, Path]]) -> bool:
    """Whether an effect can be exactly a force (n,) along the paths of runs, beside columns (n, k) of a law."""
    names, layout = {p.name for p in effect.nonlinear}, found.problem.layout
    moved = [i for i, s in enumerate(layout.slots) if s.effect == effect.name and s.parameter in names]

    def residual(z: Array) -> Array:
        p = found.p.copy()
        p[moved] = z
        columns = [effect.columns(path, layout.values(p, run)[0][effect.name]) for run, path in runs]
        return _unexplained_share(force, np.hstack([law, np.vstack(columns)]))

    best = found.p[moved]
    if moved:
        bounds, scale = np.array([layout.slots[i].bounds for i in moved]).T, np.maximum(np.abs(best), 1e-9)
        best = least_squares(residual, best, bounds=tuple(bounds), x_scale=scale, ftol=1e-12).x
    return float(np.linalg.norm(residual(best))) < MAX_RESIDUAL_SHARE


def _is_comparable(effect: Effect) -> bool:
    """Whether the force of an effect depends on the moment alone, with sizes that all runs share."""
    of_moment = effect.acts_on == "force" and not (effect.modifies or effect.memory or effect.counts_from_release)
    return of_moment and not (effect.single or any(p.per_run and p.role != "phase" for p in effect.parameters))


def _forces_of_terms(formula: Solution) -> tuple[Array, Array, list[tuple[int, Path]]]:
    """Forces (terms, n) of terms of a formula, columns (n, k) of the other effects; run and path of each piece."""
    model, layout = formula.problem.model, formula.problem.layout
    forces, columns, runs = [], [], []
    for r in formula.responses:
        values, _ = layout.values(formula.p, r.piece.run)
        path = r.piece.path_at_nodes(r.motion.x, r.motion.v, 1.0)  # whatever the friction levels multiply
        made: Mapping[str, Array] = model.force_columns(path, values)
        terms = [name for name in made if name.startswith(EFFECT_NAME)]
        forces.append([made[name] @ model.coefficients(name, values) for name in terms])
        columns.append(np.hstack([made[name] for name in made if name not in terms]))
        runs.append((r.piece.run, path))
    return np.hstack(forces), np.vstack(columns), runs


def _unexplained_share(target: Array, columns: Array) -> Array:
    """Residual (n,) of a force after a least-squares fit of columns (n, k), over the norm of the force."""
    norm = np.linalg.norm(columns, axis=0)
    unit = columns / np.where(norm > 0, norm, 1.0)
    fitted = unit @ np.linalg.lstsq(unit, target, rcond=None)[0]
    return np.asarray((target - fitted) / max(float(np.linalg.norm(target)), 1e-300))
