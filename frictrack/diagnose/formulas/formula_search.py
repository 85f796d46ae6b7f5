"""Search the most probable formulas of what a model leaves: known shapes over one variable, judged by their evidence.

Every shape of `shapes` is tried over place, time and speed, resisting motion or not, beside the linearised model. The
best are added to the model and fitted in full. Beside the model with the best formula all forms are then compared by
their evidence, and the most probable are fitted in full. If significant misfit remains, a second term is fitted.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from scipy.special import logsumexp

from frictrack.diagnose.compressed import CompressedResidual, compress_residual, is_far_from_data
from frictrack.diagnose.formulas.formula_text import describe_formula
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
    parameter_names,
)
from frictrack.diagnose.model_selection import information_criterion
from frictrack.diagnose.smooth_forces import ResidualForces, forces_of
from frictrack.errors import FrictrackError
from frictrack.fit.least_squares import Solution, fit_with_scatter
from frictrack.fit.stepwise import add_effect, entry_order, refine_to_end, remove_effect
from frictrack.models import Model

N_FIRST_FITTED, N_SECOND_FITTED = 3, 2  # first and second terms fitted in full beside the bare model
N_REFINED_FIRST, N_REFINED = 40, 300  # forms refined beside the bare model, and beside the model with a formula
N_SHOWN = 6  # formulas reported
MIN_RISE_COMPARED_AGAIN = 2.0  # of the fall of BIC by a better formula, for which all forms are compared again
MAX_COMPARISONS = 2  # of all forms with each other, each time beside the best formula so far
MIN_SIGMAS_MISFIT = 5.0  # standard deviations of chi-squared above which misfit is significant


@dataclass(frozen=True)
class FoundFormulas:
    """Formulas that fit what a model leaves, most probable first: JSON entries, and the fits."""

    entries: list[dict[str, Any]] = field(default_factory=list)
    fitted: list[FittedFormula] = field(default_factory=list)

    @property
    def first(self) -> FittedFormula | None:
        """The fit of the first one; None if there is none."""
        return self.fitted[0] if self.fitted else None

    def without(self, others: Sequence[FittedFormula]) -> FoundFormulas:
        """All but some of the formulas."""
        pairs = zip(self.entries, self.fitted, strict=True)
        kept = [pair for pair in pairs if not any(pair[1] is one for one in others)]
        return FoundFormulas([entry for entry, _ in kept], [one for _, one in kept])


def search_formulas(
    forces: ResidualForces, extended: Solution | None = None, functions: Sequence[Shape] = ()
) -> FoundFormulas:
    """Search formulas that fit what a model leaves.

    Parameters
    ----------
    forces
        Smooth forces in the residual of the fitted model.
    extended
        The model with the effects found so far; used if a formula beside the model leaves significant misfit.
    functions
        Further shapes, of the user's own functions.

    Returns
    -------
    FoundFormulas

    """
    solution = forces.solution
    fitter = _FormulaFitter.of(solution, functions)
    found = _find_formulas(forces, fitter, solution.problem.model)
    if extended is not None and extended is not solution and not any(_is_noise(f.solution) for f in found.formulas):
        found = found.joined(_find_formulas(forces_of(extended), fitter, None))
    probabilities = found.probabilities()
    shown = sorted((f for f in found.formulas if f.delta_bic > 0), key=lambda f: -found.weights[f.form])[:N_SHOWN]
    if not shown:
        return FoundFormulas()
    group = credible_forms(probabilities)
    first = shown[0].form
    entries = []
    for one in shown:
        others = [form for form in group if form != first] if one is shown[0] else [first] * (one.form in group)
        entry = describe_formula(one, solution)
        entries.append(entry | {"probability": probabilities[one.form], "equivalents": others})
    return FoundFormulas(entries, shown)


def least_misfit(forces: ResidualForces, functions: Sequence[Shape] = ()) -> float:
    """Misfit that is left by the best formula of one term over one of the axes, fitted in full.

    Parameters
    ----------
    forces
        Smooth forces in the residual of the fitted model.
    functions
        Further shapes, of the user's own functions.

    Returns
    -------
    float
        At most that of the model.

    """
    fitter = _FormulaFitter.of(forces.solution, functions)
    terms = scan_forms(forces.compressed, fitter.shapes, N_REFINED_FIRST).terms
    best_by_axis = {t.axis: t for t in reversed(terms)}
    tried = fitter.add_terms(forces.solution, (), list(best_by_axis.values()))
    return min([forces.solution.objective, *(f.solution.objective for f in tried)])


@dataclass(frozen=True)
class _Found:
    """Fitted formulas, and logarithms of the weights of all forms compared and of a cause outside of the grammar.

    `free` is the latter's weight as a smooth force of any shape, whatever the formulas leave.
    """

    formulas: list[FittedFormula]
    weights: dict[str, float]
    none: float
    free: float = -np.inf

    def joined(self, other: _Found) -> _Found:
        """Both, of forms in both the one of the higher weight."""
        formulas = {f.form: f for f in (*self.formulas, *other.formulas)}
        weights = self.weights | {
            form: max(weight, self.weights.get(form, -np.inf)) for form, weight in other.weights.items()
        }
        better = {f.form: f for f in self.formulas if weights[f.form] == self.weights[f.form]}
        none, free = max(self.none, other.none), max(self.free, other.free)
        return _Found(list((formulas | better).values()), weights, none, free)

    def probabilities(self) -> dict[str, float]:
        """Probability of every form, highest first."""
        return form_probabilities(self.weights, self.none)


def _find_formulas(forces: ResidualForces, fitter: _FormulaFitter, law: Model | None) -> _Found:
    """Formulas of one term, and of two if misfit remains; effects of `law` may be refitted beside them."""
    first = scan_forms(forces.compressed, fitter.shapes, N_REFINED_FIRST).terms[:N_FIRST_FITTED]
    tried = fitter.add_terms(forces.solution, (), first)
    if not tried:
        return _Found([], {}, 0.0)
    best = max(tried, key=lambda f: f.delta_bic)
    if law is not None and not _is_noise(best.solution):
        best = fitter.refit_model_effects(best, law)
    single, best, scan = _compare_forms(fitter, best)
    if _is_noise(best.solution):
        return single
    second = scan_forms(forces_of(best.solution).compressed, fitter.shapes, N_REFINED_FIRST)
    pairs = fitter.add_terms(best.solution, best.terms, second.terms[:N_SECOND_FITTED])
    if not pairs:
        return single
    leader = max(pairs, key=lambda f: f.delta_bic).solution
    unit, own = _unit(leader), max(single.weights.values())
    more = {
        f.form: own + (f.delta_bic - best.delta_bic) / (2 * unit) + log_prior(f.terms[-1].size, scan.sizes)
        for f in pairs
    }
    both = single.joined(_Found(pairs, more, -np.inf))
    left = float(logsumexp(list(both.weights.values()))) + remaining_evidence(leader)
    return replace(both, none=max(single.free, float(np.log(PRIOR_NONE)) + left))


def _compare_forms(fitter: _FormulaFitter, best: FittedFormula) -> tuple[_Found, FittedFormula, Scan]:
    """Compare all forms beside the model with the best formula, where the linearised model is accurate.

    Where a form that is fitted in full proves better than that one, they are compared beside it once more.
    """
    for comparison in range(MAX_COMPARISONS):
        compressed = fitter.compress_without(best.solution)
        scan = scan_forms(compressed, fitter.shapes, N_REFINED)
        if not scan.terms:
            return _Found([best], {best.form: best.delta_bic / 2}, 0.0), best, scan
        new, is_last = fitter.exchange_term(best, scan.terms[0]), comparison == MAX_COMPARISONS - 1
        if new is not None and _is_better(new, best):
            best = new
            if not is_last:
                continue
        found = _weigh_forms(fitter, best, scan, compressed)
        leader = max(found.formulas, key=lambda f: f.delta_bic, default=best)
        if is_last or not _is_better(leader, best):
            break
        best = leader
    return found, best, scan


def _is_better(new: FittedFormula, old: FittedFormula) -> bool:
    return new.delta_bic >= old.delta_bic + MIN_RISE_COMPARED_AGAIN


def _weigh_forms(fitter: _FormulaFitter, best: FittedFormula, scan: Scan, compressed: CompressedResidual) -> _Found:
    """Weigh the forms that were refined beside the model with the best formula, and fit the most probable in full.

    The weights are relative to the model without a formula: half the fall of BIC of the best formula and the
    differences of evidence beside it, for forms fitted in full as they are there.
    """
    unit = _unit(best.solution)
    power = max(t.gain for t in scan.terms)
    evidence = {t.form: relative_evidence(t, power, unit) for t in scan.terms}
    base = best.delta_bic / (2 * unit) - max(evidence.values())
    weights = {form: base + one for form, one in evidence.items()}
    gains = {t.form: t.gain for t in scan.terms}
    order = sorted(scan.terms, key=lambda t: -weights[t.form])[:N_SHOWN]
    fitted = [f for t in order if (f := fitter.exchange_term(best, t)) is not None]
    for one in fitted:
        gain = gains.get(best.form, max(gains.values())) + best.solution.objective - one.solution.objective
        weights[one.form] += (gain - gains[one.form]) / (2 * unit)
    outside = float(np.log(PRIOR_NONE))
    free = outside + base + smooth_evidence(compressed, power, unit) - log_prior(0, scan.sizes)
    left = outside + float(logsumexp(list(weights.values()))) + remaining_evidence(best.solution)
    return _Found(fitted, weights, max(free, left), free)


def _unit(solution: Solution) -> float:
    """Reduced chi-squared, if it is above 1."""
    return max(solution.chi2 / max(solution.problem.n_frames - len(solution.p), 1), 1.0)


@dataclass(frozen=True)
class _FormulaFitter:
    """Fits formulas and compares them with the bare model: its BIC and its excess chi-squared."""

    bare_bic: float
    excess: float
    scatter: float  # of the friction levels, of the bare model
    shapes: tuple[Shape, ...]

    @classmethod
    def of(cls, bare: Solution, functions: Sequence[Shape]) -> _FormulaFitter:
        """The fitter of formulas in the residual of a model, with further shapes."""
        return cls(information_criterion(bare), _excess_chi2(bare), bare.tau or 0.0, (*SHAPES, *functions))

    def evaluate(self, terms: tuple[Term, ...], solution: Solution) -> FittedFormula:
        """Return a fitted formula with its gain."""
        explained = self.excess - _excess_chi2(solution)
        share = float(np.clip(explained / max(self.excess, 1e-300), 0.0, 1.0))
        return FittedFormula(terms, solution, self.bare_bic - information_criterion(solution), share)

    def compress_without(self, solution: Solution) -> CompressedResidual:
        """Compress the residual with the force of the formula in it.

        The formula may take up the scatter of few friction levels by chance; that of the bare model is kept.
        """
        bare = replace(solution, tau=max(solution.tau or 0.0, self.scatter))
        return compress_residual(bare, EFFECT_NAME, about_measurement=is_far_from_data(solution))

    def add_terms(self, solution: Solution, first: tuple[Term, ...], terms: Sequence[Term]) -> list[FittedFormula]:
        """Add each term to a model and fit it in full; skip those that cannot be integrated."""
        name = EFFECT_NAME if not first else f"{EFFECT_NAME}_{len(first) + 1}"
        out = []
        for term in terms:
            with suppress(FrictrackError):
                fitted = add_effect(solution, build_effect(name, term))
                out.append(self.evaluate((*first, term), fitted if _is_noise(fitted) else refine_to_end(fitted)))
        return out

    def exchange_term(self, best: FittedFormula, term: Term) -> FittedFormula | None:
        """Replace the only term of a formula, starting from its fit; None if it cannot be integrated."""
        old = best.solution.problem.layout
        layout = replace(old, model=old.model - EFFECT_NAME + build_effect(EFFECT_NAME, term))
        old_values = dict(zip(old.names, best.solution.p, strict=True))
        term_values = dict(zip(parameter_names(term), term.parameters, strict=True)) | dict(
            zip(coefficient_names(term), term.coefficients, strict=True)
        )
        new_values = {f"{EFFECT_NAME}.{name}": value for name, value in term_values.items()}
        p = np.array([(old_values | new_values)[name] for name in layout.names])
        problem = best.solution.problem.rebuild(layout, best.solution.problem.pieces)
        if problem.simulates:
            problem = problem.beginning_at(best.solution.responses)
        try:
            return self.evaluate((term,), fit_with_scatter(problem, p, best.solution.starts, best.solution.tau or 0.03))
        except FrictrackError:
            return None

    def refit_model_effects(self, best: FittedFormula, law: Model) -> FittedFormula:
        """Refit effects of the model that fit better elsewhere beside the formula."""
        solution = best.solution
        for effect in entry_order(law)[1]:
            with suppress(FrictrackError):
                moved = add_effect(remove_effect(solution, effect.name), effect)
                solution = moved if moved.objective < solution.objective else solution
        return self.evaluate(best.terms, solution)


def _excess_chi2(solution: Solution) -> float:
    """Chi-squared above its expectation."""
    frames, free = solution.problem.n_frames, 2 * len(solution.responses) + len(solution.p)
    return solution.chi2 - (frames - free)


def _is_noise(solution: Solution) -> bool:
    return is_noise(_excess_chi2(solution), solution.problem.n_frames)


def is_noise(excess: float, frames: int) -> bool:
    """Return whether chi-squared exceeds its expectation by no more than noise does.

    Parameters
    ----------
    excess
        Chi-squared above its expectation.
    frames
        Number of frames.

    Returns
    -------
    bool

    Examples
    --------
    >>> is_noise(100.0, 1000), is_noise(300.0, 1000)  # the standard deviation is 45
    (True, False)

    """
    return bool(excess < MIN_SIGMAS_MISFIT * np.sqrt(2 * frames))
