"""Search the simplest formulas that fit what a model leaves: known shapes over one variable, judged by full fits.

Every shape of `shapes` is tried over place, time and speed, resisting motion or not, at every setting of a grid beside
the linearised model. The best are refined there, and the best of these are added to the model and fitted in full. If
significant misfit remains, a second term is fitted. Formulas are ranked by BIC (Schwarz 1978); among equals the
simplest is first.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from scipy.optimize import least_squares

from frictrack.diagnose.compressed import CompressedResidual, compress_residual
from frictrack.diagnose.formulas.formula_text import describe_formula
from frictrack.diagnose.formulas.probability import LOG_PRIOR_PER_UNKNOWN, family_probabilities
from frictrack.diagnose.formulas.shapes import SHAPES, Shape
from frictrack.diagnose.formulas.terms import (
    EFFECT_NAME,
    FittedFormula,
    Term,
    build_effect,
    coefficient_names,
    parameter_bounds,
    parameter_names,
)
from frictrack.diagnose.formulas.variables import formula_axes, is_excluded
from frictrack.diagnose.model_selection import MIN_CHI2_SEPARATED, information_criterion
from frictrack.diagnose.smooth_forces import ResidualForces
from frictrack.errors import FrictrackError
from frictrack.fit.least_squares import Solution, fit_with_scatter
from frictrack.fit.stepwise import add_effect, entry_order, refine_to_end, remove_effect
from frictrack.models import Model
from frictrack.records import Array

MIN_LEAKAGE_RATIO = 3.0  # remaining share of a column's square over the leakage of the model projection
MIN_SQUARE_SHARE = 1e-8  # least remaining share of a column's square
MAX_COLUMN_VALUE = 1e9  # above it a shape has no value
RELATIVE_STEP = 1e-5  # of finite differences
MAX_EVALUATIONS = 25  # per refinement of a term
MIN_GAIN_RATIO_REFINED = 0.4  # of the best gain that a shape must reach on the grid
N_REFINED = 40  # forms refined beside the linearised model
N_FIRST_FITTED, N_RIVALS_FITTED, N_SECOND_FITTED = 3, 10, 2  # first terms, rivals and second terms fitted in full
N_SHOWN = 6  # formulas reported
MAX_DELTA_BIC_EQUAL = 6.0  # within which formulas explain equally (Kass & Raftery 1995)
MAX_DELTA_BIC_FITTED = 15.0  # from the best formula, within which another is fitted in full
MAX_CHI2_SCREENED = 60.0  # expected difference at the settings of the grid, above which a form is not refined
MAX_EQUIVALENTS_TRIED = 60
MIN_SIGMAS_MISFIT = 5.0  # standard deviations of chi-squared above which misfit is significant


def search_formulas(
    forces: ResidualForces, extended: Solution | None = None, functions: Sequence[Shape] = ()
) -> list[dict[str, Any]]:
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
    list of dict
        JSON entries, best first.

    """
    solution = forces.solution
    fitter = _FormulaFitter(
        information_criterion(solution), _excess_chi2(solution), solution.tau or 0.0, (*SHAPES, *functions)
    )
    found = _find_formulas(forces, fitter, solution.problem.model)
    if extended is not None and extended is not solution and not any(_is_noise(f.solution) for f in found):
        found += _find_formulas(ResidualForces(extended), fitter, None)
    ranked = _rank(found)
    if not ranked:
        return []
    probabilities = family_probabilities(ranked, fitter.scanned, fitter.unfitted, forces.smooth[0].gain)
    shown = ranked[:N_SHOWN]
    entries = [describe_formula(f, solution) for f in shown]
    alike = _equivalent_forms(shown[0], fitter)
    for probability, found_one, entry in zip(probabilities, shown, entries, strict=False):
        own = found_one.form
        entry |= {
            "probability": probability,
            "equivalents": alike if found_one is shown[0] else [shown[0].form] * (own in alike),
        }
    return entries


def _equivalent_forms(best: FittedFormula, fitter: _FormulaFitter) -> list[str]:
    """Forms of the first term that these data cannot tell from it, best first.

    If the formula is true, the fit of such a form is expected to be worse by less than `MIN_CHI2_SEPARATED`.
    """
    compressed = fitter.compress_without(best.solution)
    term, values = best.terms[0], best.solution.problem.layout.values(best.solution.p, 0)[0][EFFECT_NAME]
    own = replace(term, parameters=tuple(values[q] for q in parameter_names(term)))
    force = np.concatenate([own.force(path, own.parameters) for path in compressed.paths])
    trace = compressed.traces_of(compressed.split_by_piece(force)) @ [values[c] for c in coefficient_names(term)]
    ideal = replace(compressed, residual=trace)
    power = float(trace @ trace)
    unit = max(best.solution.chi2 / best.solution.problem.n_frames, 1.0)
    near = [
        t
        for t in _scan_shapes(ideal, fitter.shapes)
        if _key(t) != _key(term) and power - t.gain < MAX_CHI2_SCREENED * unit
    ]
    near = sorted(near, key=lambda t: (t.size, -t.gain))[:MAX_EQUIVALENTS_TRIED]
    refined = [_refine_term(ideal, t) for t in near]
    alike = [t for t in refined if power - t.gain < MIN_CHI2_SEPARATED * unit]
    return [t.form for t in sorted(alike, key=lambda t: (t.size, -t.gain))]


def _find_formulas(forces: ResidualForces, fitter: _FormulaFitter, law: Model | None) -> list[FittedFormula]:
    """Formulas of one term, and of two if misfit remains; effects of `law` may be refitted beside them."""
    first = _best_terms(forces.compressed, fitter)[:N_FIRST_FITTED]
    single = _competing_formulas(fitter, fitter.add_terms(forces.solution, (), first), law)
    if not single or _is_noise(single[0].solution):
        return single
    left = ResidualForces(single[0].solution)
    second = _best_terms(left.compressed, fitter)[:N_SECOND_FITTED]
    return single + fitter.add_terms(single[0].solution, single[0].terms, second)


def _competing_formulas(
    fitter: _FormulaFitter, tried: Sequence[FittedFormula], law: Model | None
) -> list[FittedFormula]:
    """The best formula tried and those that explain as much in its place, best first.

    The scan ranks only roughly beside a model that lacks something; beside the model with the best formula it is
    accurate.
    """
    if not tried:
        return []
    best = max(tried, key=lambda f: f.delta_bic)
    if law is not None and not _is_noise(best.solution):
        best = fitter.refit_model_effects(best, law)
    compressed = fitter.compress_without(best.solution)
    terms = _best_terms(compressed, fitter)
    behind = [_penalised_gain(terms[0], compressed) - _penalised_gain(t, compressed) for t in terms]
    n_near = min(sum(b < MAX_DELTA_BIC_FITTED for b in behind), N_RIVALS_FITTED)
    near = terms[:n_near]
    fitter.unfitted.extend((t, best.delta_bic - b) for t, b in zip(terms[n_near:], behind[n_near:], strict=True))
    found = [best, *(f for t in near if (f := fitter.exchange_term(best, t)) is not None)]
    order = sorted(found, key=lambda f: -f.delta_bic)
    return list({_key(f.terms[0]): f for f in reversed(order)}.values())[::-1]


def _key(term: Term) -> tuple[str, str, str]:
    return term.shape.name, term.axis, term.factor


@dataclass(frozen=True)
class _FormulaFitter:
    """Fits formulas and compares them with the bare model: its BIC and its excess chi-squared."""

    bare_bic: float
    excess: float
    scatter: float  # of the friction levels, of the bare model
    shapes: tuple[Shape, ...]
    scanned: list[Term] = field(default_factory=list)  # all forms of the first scan
    unfitted: list[tuple[Term, float]] = field(default_factory=list)  # rivals not fitted in full, expected fall of BIC

    def evaluate(self, terms: tuple[Term, ...], solution: Solution) -> FittedFormula:
        """Return a fitted formula with its gain."""
        explained = self.excess - _excess_chi2(solution)
        share = float(np.clip(explained / max(self.excess, 1e-300), 0.0, 1.0))
        return FittedFormula(terms, solution, self.bare_bic - information_criterion(solution), share)

    def compress_without(self, solution: Solution) -> CompressedResidual:
        """Compress the residual with the force of the formula in it.

        The formula may take up the scatter of few friction levels by chance; that of the bare model is kept.
        """
        return compress_residual(replace(solution, tau=max(solution.tau or 0.0, self.scatter)), EFFECT_NAME)

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
    return _excess_chi2(solution) < MIN_SIGMAS_MISFIT * np.sqrt(2 * solution.problem.n_frames)


def _rank(found: Sequence[FittedFormula]) -> list[FittedFormula]:
    """Rank by BIC, and those as good as the best by simplicity."""
    order = sorted((f for f in found if f.delta_bic > 0), key=lambda f: -f.delta_bic)
    equal = [f for f in order if order[0].delta_bic - f.delta_bic < MAX_DELTA_BIC_EQUAL]
    return sorted(equal, key=lambda f: f.complexity) + order[len(equal) :]


def _best_terms(compressed: CompressedResidual, fitter: _FormulaFitter) -> list[Term]:
    """The best forms beside a model, refined, one per shape and variable, best first."""
    scanned = list(_scan_shapes(compressed, fitter.shapes))
    fitter.scanned.extend(scanned if not fitter.scanned else ())
    if not scanned:
        return []
    best = max(t.gain for t in scanned)
    order = sorted(
        (t for t in scanned if t.gain > MIN_GAIN_RATIO_REFINED * best), key=lambda t: -_penalised_gain(t, compressed)
    )[:N_REFINED]
    refined = sorted((_refine_term(compressed, t) for t in order), key=lambda t: -_penalised_gain(t, compressed))
    unique = {(t.shape.name, t.variable): t for t in reversed(refined)}
    return sorted(unique.values(), key=lambda t: -_penalised_gain(t, compressed))


def _penalised_gain(term: Term, compressed: CompressedResidual) -> float:
    """Gain minus the BIC penalty of the term's parameters, and that of the prior for its size."""
    return term.gain - term.unknowns * float(np.log(compressed.n_frames)) + 2 * LOG_PRIOR_PER_UNKNOWN * term.size


def _scan_shapes(compressed: CompressedResidual, shapes: Sequence[Shape]) -> Iterator[Term]:
    """The best setting of every shape over every variable; the same form is tried once."""
    axes = formula_axes(compressed)
    values = {axis.name: compressed.concatenate(axis.of) for axis in axes if not axis.factor or axis.factor == "L * s"}
    ends = {name: (float(u.min()), float(u.max())) for name, u in values.items()}
    for axis in axes:
        u, factor = values[axis.name], compressed.concatenate(axis.times)
        for rank, shape in enumerate(shapes):
            points = shape.grid(*ends[axis.name]) if axis.name in shape.axes and not is_excluded(shape, axis) else []
            if points:
                gains = _grid_gains(compressed, shape, points, (u, factor))
                best = int(np.argmax(gains))
                yield Term(shape, axis, points[best], ends[axis.name], float(gains[best]), rank=rank)


def _grid_gains(
    compressed: CompressedResidual, shape: Shape, points: Sequence[tuple[float, ...]], axis_values: tuple[Array, Array]
) -> Array:
    """Fall of chi-squared with the best coefficients at every setting, (G,)."""
    u, factor = axis_values
    made = shape.on_grid(u, points)
    k = len(made)
    whole = np.stack([_finite(c) for c in made], axis=2) * factor[:, None, None]
    rows = np.concatenate(
        [
            m @ c
            for m, c in zip(compressed.force_maps, compressed.split_by_piece(whole.reshape(len(u), -1)), strict=True)
        ]
    )
    projected = compressed.project_out_model(rows)
    norm = np.linalg.norm(rows, axis=0)
    norm[norm == 0] = np.inf
    projections = (compressed.residual @ projected / norm).reshape(-1, k)
    unit = (projected / norm).reshape(len(projected), -1, k).transpose(1, 0, 2)
    values, vectors = np.linalg.eigh(unit.transpose(0, 2, 1) @ unit)
    rotated = np.einsum("gij,gi->gj", vectors, projections)
    min_eigenvalue = max(MIN_LEAKAGE_RATIO * compressed.leakage, MIN_SQUARE_SHARE)
    gains: Array = np.sum(
        np.where(values > min_eigenvalue, rotated**2 / np.maximum(values, min_eigenvalue), 0.0), axis=1
    )
    return gains


def _finite(columns: Array) -> Array:
    """Columns with values that are not finite, or huge, set to zero."""
    return np.where(np.abs(columns) < MAX_COLUMN_VALUE, columns, 0.0)


def _refine_term(compressed: CompressedResidual, term: Term) -> Term:
    """Refine the parameters of a term, with coefficients solved in every trial (variable projection)."""
    at = compressed.concatenate(term.variable.of), compressed.concatenate(term.variable.times)
    if not term.parameters:
        return replace(term, coefficients=_solve_coefficients(compressed, term, term.parameters, at)[1])
    limits = parameter_bounds(term, 30.0, 3.0)
    low, high = np.array([limits[q] for q in parameter_names(term)]).T
    scale = np.minimum(high - low, np.maximum(np.abs(np.array(term.parameters)), 1e-3 * (high - low)))

    start = np.clip(term.parameters, low, high) / scale
    ends = low / scale - 1e-9, high / scale + 1e-9

    def residual(z: Array) -> Array:
        return _solve_coefficients(compressed, term, z * scale, at)[0]

    steps = np.full(len(start), RELATIVE_STEP)
    found = least_squares(residual, start, bounds=ends, diff_step=steps, max_nfev=MAX_EVALUATIONS)
    parameters = np.clip(found.x * scale, low, high)
    remaining, coefficients = _solve_coefficients(compressed, term, parameters, at)
    gain = float(compressed.residual @ compressed.residual - remaining @ remaining)
    return replace(term, parameters=tuple(map(float, parameters)), gain=gain, coefficients=coefficients)


def _solve_coefficients(
    compressed: CompressedResidual, term: Term, parameters: Sequence[float] | Array, at: tuple[Array, Array]
) -> tuple[Array, tuple[float, ...]]:
    """What the best coefficients of a term leave, (M,), and these coefficients.

    `at` are the values of its axis and the factor on its force along all pieces.
    """
    u, factor = at
    made = np.stack(term.shape.columns_at(u, list(parameters)), axis=1) * factor[:, None]
    columns = compressed.traces_of(compressed.split_by_piece(_finite(made)))
    coefficients = np.linalg.lstsq(columns, compressed.residual, rcond=1e-9)[0]
    return np.asarray(compressed.residual - columns @ coefficients), tuple(map(float, coefficients))
