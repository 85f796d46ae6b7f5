"""Search the most probable formulas of what a model leaves: known shapes over one variable, judged by their evidence.

Every shape of `shapes` is tried over place, time and speed, resisting motion or not, added to the linearised model. The
best are added to the model and fitted in full. Beside the model with the best formula all forms are then compared by
their evidence, and the most probable are fitted in full. If significant misfit remains, a second term is fitted.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.special import logsumexp

from frictrack.diagnose.compressed import CompressedResidual, compress_residual, is_far_from_data
from frictrack.diagnose.formulas.probability import (
    PRIOR_NONE,
    credible_forms,
    form_probabilities,
    log_prior,
    relative_evidence,
    remaining_evidence,
    smooth_evidence,
)
from frictrack.diagnose.formulas.scan import Scan, scan_forms
from frictrack.diagnose.formulas.shapes import SHAPES, Shape
from frictrack.diagnose.formulas.terms import (
    EFFECT_NAME,
    FittedFormula,
    Term,
    build_effect,
    coefficient_names,
    describe_formula,
)
from frictrack.diagnose.model_selection import information_criterion
from frictrack.diagnose.smooth_forces import ResidualForces, forces_of
from frictrack.errors import FrictrackError
from frictrack.fit.least_squares import Solution, fit_with_scatter
from frictrack.fit.observations import keep_compared_frames
from frictrack.fit.stepwise import add_effect, entry_order, refine_to_end, remove_effect

N_FIRST_FITTED, N_SECOND_FITTED = 3, 2  # first and second terms fitted in full, unless one leaves only noise
N_REFINED_FIRST, N_REFINED = 16, 300  # forms refined for the bare model, and for the model with a formula
N_SHOWN = 6  # formulas reported
MIN_RISE_COMPARED_AGAIN = 2.0  # of the fall of BIC by a better formula, for which all forms are compared again
MIN_SIGMAS_MISFIT = 5.0  # standard deviations of chi-squared above which misfit is significant
MAX_EVIDENCE_BEHIND = 15.0  # of the logarithm of the evidence; a form further behind is not probable
MAX_GAIN_ERROR = 0.01  # of a gain in the linearised model, where the rest of the model moves far
MIN_CHI2_FALL = 0.01  # of a step of a formula that is compared with the best one


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
    forces
        Smooth forces in the residual of the fitted model.
    functions
        Further shapes, of the user's own functions.
    bare
        The model with which formulas are compared, if it is not that of `forces`.

    """

    forces: ResidualForces
    functions: tuple[Shape, ...] = ()
    bare: Solution | None = None

    @classmethod
    def of(cls, solution: Solution, functions: tuple[Shape, ...] = ()) -> FormulaSearch:
        """The search in the frames of a fit that are compared."""
        return cls(forces_of(keep_compared_frames(solution)), functions)

    @property
    def solution(self) -> Solution:
        """The fitted model."""
        return self.forces.solution

    @cached_property
    def least_misfit(self) -> float:
        """Misfit that is left by the best formula of one term, fitted in full; at most that of the model."""
        return min([self.solution.objective, *(one.solution.objective for one in self._firsts)])

    def found(self, extended: Solution | None = None) -> list[FittedFormula]:
        """Return the formulas that fit what the model leaves, most probable first.

        Where all leave significant misfit, they are also added to `extended`, the model with the effects found.
        """
        found = self._found
        if extended is not None and not any(_is_noise(one.solution) for one in found.fitted.values()):
            found = found.joined(FormulaSearch(forces_of(extended), self.functions, self.solution)._found)
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
        return self._fit_next(self.solution, (), self.forces, N_FIRST_FITTED)

    @cached_property
    def _found(self) -> _Found:
        """Formulas of one term, and of two if misfit remains."""
        if not self._firsts:
            return _Found({}, {}, 0.0)
        best = max(self._firsts, key=lambda one: one.delta_bic)
        best = self._evaluated(best.terms, refine_to_end(best.solution))
        if self.bare is None and not _is_noise(best.solution):
            best = self._refit_model_effects(best)
        single, best, sizes = self._compare_forms(best)
        if _is_noise(best.solution):
            return single
        pairs = self._fit_next(best.solution, best.terms, forces_of(best.solution), N_SECOND_FITTED)
        if not pairs:
            return single
        leader = max(pairs, key=lambda one: one.delta_bic).solution
        base, unit = max(single.weights.values()), _unit(leader)
        weights = {
            one.form: base + (one.delta_bic - best.delta_bic) / (2 * unit) + log_prior(one.terms[-1].size, sizes)
            for one in pairs
        }
        both = single.joined(_Found({one.form: one for one in pairs}, weights, -np.inf))
        left = float(logsumexp(list(both.weights.values()))) + remaining_evidence(leader)
        return replace(both, none=max(single.free, float(np.log(PRIOR_NONE)) + left))

    def _compare_forms(self, best: FittedFormula) -> tuple[_Found, FittedFormula, list[int]]:
        """Compare all forms of one term with the best one, each added to the model, and fit those that may be probable.

        Where one of them proves better, all are compared with that one once more.
        """
        for is_last in (False, True):
            compressed, unit = self._compress_without_formula(best.solution), _unit(best.solution)
            scan = scan_forms(compressed, self._shapes, N_REFINED, unit)
            if not scan.terms:
                return _Found({best.form: best}, {best.form: best.delta_bic / 2}, 0.0), best, scan.sizes
            power = max(t.gain for t in scan.terms)
            evidence = {t.form: relative_evidence(t, power, unit) for t in scan.terms}
            least = max(evidence.values()) - MAX_EVIDENCE_BEHIND - MAX_GAIN_ERROR * power / (2 * unit)
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
        excess = _excess_chi2(bare)
        share = float(np.clip((excess - _excess_chi2(solution)) / max(excess, 1e-300), 0.0, 1.0))
        return FittedFormula(terms, solution, information_criterion(bare) - information_criterion(solution), share)

    def _compress_without_formula(self, solution: Solution) -> CompressedResidual:
        """Compress the residual with the force of the formula in it.

        The formula may take up the scatter of few friction levels by chance; that of the bare model is kept.
        """
        scattered = replace(solution, tau=max(solution.tau or 0.0, (self.bare or self.solution).tau or 0.0))
        return compress_residual(scattered, EFFECT_NAME, about_measurement=is_far_from_data(solution))

    def _fit_next(
        self, solution: Solution, first: tuple[Term, ...], forces: ResidualForces, count: int
    ) -> list[FittedFormula]:
        """Add the most probable terms to a model and fit each in full, up to the first one that leaves only noise.

        Terms that cannot be integrated are left out.
        """
        name = EFFECT_NAME if not first else f"{EFFECT_NAME}_{len(first) + 1}"
        scan = scan_forms(forces.compressed, self._shapes, N_REFINED_FIRST, _unit(solution))
        out: list[FittedFormula] = []
        for term in scan.terms[:count]:
            with suppress(FrictrackError):
                fitted = add_effect(solution, build_effect(name, term))
                out.append(self._evaluated((*first, term), fitted if _is_noise(fitted) else refine_to_end(fitted)))
                if _is_noise(fitted):
                    break
        return out

    def _exchange_term(self, best: FittedFormula, term: Term) -> FittedFormula | None:
        """Replace the only term of a formula, starting from its fit; None if it cannot be integrated."""
        solution = best.solution
        old = solution.problem.layout
        layout = replace(old, model=old.model - EFFECT_NAME + build_effect(EFFECT_NAME, term))
        names = [f"{EFFECT_NAME}.{name}" for name in (*term.shape.parameters, *coefficient_names(term))]
        values = dict(zip(old.names, solution.p, strict=True))
        values |= dict(zip(names, (*term.parameters, *term.coefficients), strict=True))
        problem = solution.problem.rebuild(layout, solution.problem.pieces).beginning_at(solution.responses)
        p = np.array([values[name] for name in layout.names])
        with suppress(FrictrackError):
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
    unit = _unit(best.solution)
    gains = {t.form: t.gain for t in scan.terms}
    power = max(gains.values())
    evidence = {t.form: relative_evidence(t, power, unit) for t in scan.terms}
    base = best.delta_bic / (2 * unit) - max(evidence.values())
    weights = {form: base + one for form, one in evidence.items()}
    for form, one in fitted.items():
        gain = gains.get(best.form, power) + best.solution.objective - one.solution.objective
        weights[form] += (gain - gains[form]) / (2 * unit)
    outside = float(np.log(PRIOR_NONE))
    free = outside + base + smooth_evidence(compressed, power, unit) - log_prior(0, scan.sizes)
    left = outside + float(logsumexp(list(weights.values()))) + remaining_evidence(best.solution)
    return _Found(fitted, weights, max(free, left), free)


def _unit(solution: Solution) -> float:
    """Reduced chi-squared, if it is above 1."""
    return max(solution.chi2 / max(solution.problem.n_frames - len(solution.p), 1), 1.0)


def _excess_chi2(solution: Solution) -> float:
    """Chi-squared above its expectation."""
    frames, free = solution.problem.n_frames, 2 * len(solution.responses) + len(solution.p)
    return solution.chi2 - (frames - free)


def _is_noise(solution: Solution) -> bool:
    return is_noise(_excess_chi2(solution), solution.problem.n_frames)


def is_noise(excess: float, frames: int) -> bool:
    """Return whether chi-squared exceeds its expectation by no more than noise does.

    Examples
    --------
    >>> is_noise(100.0, 1000), is_noise(300.0, 1000)  # the standard deviation is 45
    (True, False)

    """
    return bool(excess < MIN_SIGMAS_MISFIT * np.sqrt(2 * frames))
