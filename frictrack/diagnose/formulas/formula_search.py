"""The simplest formulas that fit what a law leaves: a small search over known shapes, judged by exact fits.

Every shape of `shapes` is tried over place, time and speed, resisting motion (times s, or s and the load) or plainly,
at every setting of a grid beside the linearised law; the best are refined there, and the best of these are added to
the law and fitted in full. Where more than noise remains, a second term is looked for beside the first. What ranks is
the Bayesian information criterion (Schwarz 1978); among equals the simplest stands first.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.optimize import least_squares

from frictrack.diagnose.compressed import CompressedResidual, compress_residual
from frictrack.diagnose.formulas.formula_text import describe_formula
from frictrack.diagnose.formulas.shapes import SHAPES, Shape
from frictrack.diagnose.formulas.terms import (
    AXIS_SYMBOLS,
    EFFECT_NAME,
    FittedFormula,
    Term,
    build_effect,
    coefficient_names,
    parameter_bounds,
    parameter_names,
)
from frictrack.diagnose.model_selection import information_criterion
from frictrack.diagnose.smooth_forces import smooth_forces
from frictrack.errors import FrictrackError
from frictrack.fit.least_squares import Solution, fit_with_scatter
from frictrack.fit.stepwise import add_effect, entry_order, refine_to_end, remove_effect
from frictrack.models import Model
from frictrack.records import Array

ABSORBED, ROUND = 3.0, 1e-8  # share of a column's square that must remain beside the law: over the law's own, and least
LARGEST = 1e9  # of a column: beyond it a shape has no value
STEP = 1e-5  # relative, of a difference
TRIALS = 25  # of the numbers of a form
KEPT = 0.4  # of the best gain that a shape must reach on the grid to be refined
REFINED, FIRST, FITTED, SECOND, SHOWN = (
    12,
    2,
    5,
    2,
    6,
)  # forms refined, fitted in full at first, as rivals, as a second term, and told
MAX_DELTA_BIC_EQUAL = 6.0  # difference of the criterion within which formulas explain alike (Kass & Raftery 1995)
NEAR = 15.0  # of the criterion beside the law of the best formula within which another one is fitted in full
CLEAR = 5.0  # standard deviations of chi-squared that are no noise
LIKELY = 0.5  # of the best gain of a smooth force that an axis must reach for formulas over it


def search_formulas(solution: Solution, beside: Solution | None = None) -> list[dict[str, Any]]:
    """The formulas that fit what a law leaves, simplest first among equals: entries of the JSON.

    Started from the law itself, and where more than noise remains from the law with what was found so far, `beside`.
    """
    found = _found(solution, _Judge(information_criterion(solution), _excess(solution)), solution.problem.model)
    if beside is not None and beside is not solution and not any(_is_noise(f.solution) for f in found):
        found += _found(beside, _Judge(information_criterion(solution), _excess(solution)), None)
    return [describe_formula(f, solution) for f in _ranked(found)[:SHOWN]]


def _found(solution: Solution, judge: _Judge, law: Model | None) -> list[FittedFormula]:
    """Formulas of one term, and of two where one leaves more than noise.

    `law` is what may move beside them, where it may have been bent by what it lacks.
    """
    single = _rivals(judge, judge.added(solution, (), _terms(compress_residual(solution), FIRST)), law)
    if not single or _is_noise(single[0].solution):
        return single
    left = compress_residual(single[0].solution)
    return single + judge.added(single[0].solution, single[0].terms, _terms(left, SECOND))


def _rivals(judge: _Judge, tried: Sequence[FittedFormula], law: Model | None) -> list[FittedFormula]:
    """The best of what was tried, and what explains as well in its place, best first.

    Beside a law that lacks something the scan ranks but roughly; beside the law of the best formula it is right.
    """
    if not tried:
        return []
    best = max(tried, key=lambda f: f.delta_bic)
    if law is not None and not _is_noise(best.solution):
        best = judge.reseated(best, law)
    left = compress_residual(best.solution, EFFECT_NAME)
    terms = _terms(left, FITTED, (best.terms[0].along.name,))
    near = [t for t in terms if _worth(terms[0], left) - _worth(t, left) < NEAR]
    found = [best, *(f for t in near if (f := judge.exchanged(best, t)) is not None)]
    order = sorted(found, key=lambda f: -f.delta_bic)
    return list({_kind(f.terms[0]): f for f in reversed(order)}.values())[::-1]


def _kind(term: Term) -> tuple[str, str, str]:
    return term.shape.name, term.axis, term.factor


@dataclass(frozen=True)
class _Judge:
    """What a formula is measured against: the criterion of the bare law, and its chi-squared above the noise."""

    bare: float
    excess: float

    def of(self, terms: tuple[Term, ...], solution: Solution) -> FittedFormula:
        """A formula that was fitted."""
        gone = self.excess - _excess(solution)
        share = float(np.clip(gone / max(self.excess, 1e-300), 0.0, 1.0))
        return FittedFormula(terms, solution, self.bare - information_criterion(solution), share)

    def added(self, solution: Solution, first: tuple[Term, ...], terms: Sequence[Term]) -> list[FittedFormula]:
        """Each term added to a law and fitted in full, those that can be followed."""
        name = EFFECT_NAME if not first else f"{EFFECT_NAME}_{len(first) + 1}"
        out = []
        for term in terms:
            with suppress(FrictrackError):
                grown = add_effect(solution, build_effect(name, term))
                out.append(self.of((*first, term), grown if _is_noise(grown) else refine_to_end(grown)))
        return out

    def exchanged(self, best: FittedFormula, term: Term) -> FittedFormula | None:
        """Another term in the place of the only one of a formula, from the law as it stands."""
        old = best.solution.problem.layout
        layout = replace(old, model=old.model - EFFECT_NAME + build_effect(EFFECT_NAME, term))
        there = dict(zip(old.names, best.solution.p, strict=True))
        here = dict(zip(parameter_names(term), term.numbers, strict=True)) | dict(
            zip(coefficient_names(term), term.coefficients, strict=True)
        )
        own = {f"{EFFECT_NAME}.{name}": value for name, value in here.items()}
        p = np.array([(there | own)[name] for name in layout.names])
        problem = best.solution.problem.rebuild(layout, best.solution.problem.pieces)
        try:
            return self.of((term,), fit_with_scatter(problem, p, best.solution.starts, best.solution.tau or 0.03))
        except FrictrackError:
            return None

    def reseated(self, best: FittedFormula, law: Model) -> FittedFormula:
        """The same formula where an effect of the law stands better elsewhere now that the law is not bent any more."""
        solution = best.solution
        for effect in entry_order(law)[1]:
            with suppress(FrictrackError):
                moved = add_effect(remove_effect(solution, effect.name), effect)
                solution = moved if moved.objective < solution.objective else solution
        return self.of(best.terms, solution)


def _excess(solution: Solution) -> float:
    """Chi-squared above its expectation."""
    frames, free = solution.problem.n_frames, 2 * len(solution.responses) + len(solution.p)
    return solution.chi2 - (frames - free)


def _is_noise(solution: Solution) -> bool:
    return _excess(solution) < CLEAR * np.sqrt(2 * solution.problem.n_frames)


def _ranked(found: Sequence[FittedFormula]) -> list[FittedFormula]:
    """By criterion, those that explain as well as the best by simplicity; one of a kind."""
    order = sorted((f for f in found if f.delta_bic > 0), key=lambda f: -f.delta_bic)
    equal = [f for f in order if order[0].delta_bic - f.delta_bic < MAX_DELTA_BIC_EQUAL]
    return sorted(equal, key=lambda f: f.complexity) + order[len(equal) :]


def _terms(left: CompressedResidual, most: int, names: Sequence[str] = ()) -> list[Term]:
    """The best forms beside a law, refined there, one per shape and axis, best first; `names` of axes, or all."""
    seen = list(_scanned(left, names))
    if not seen:
        return []
    best = max(t.gain for t in seen)
    order = sorted((t for t in seen if t.gain > KEPT * best), key=lambda t: -_worth(t, left))[:REFINED]
    refined = sorted((_refined(left, t) for t in order), key=lambda t: -_worth(t, left))
    unique = {(t.shape.name, t.along): t for t in reversed(refined)}
    return sorted(unique.values(), key=lambda t: -_worth(t, left))[:most]


def _worth(term: Term, left: CompressedResidual) -> float:
    return term.gain - term.unknowns * float(np.log(left.n_frames))


def _scanned(left: CompressedResidual, names: Sequence[str] = ()) -> Iterator[Term]:
    """The best setting of every shape over every axis on which a smooth force explains something."""
    smooth = [s for s in smooth_forces(left) if s.axis.name in (names or AXIS_SYMBOLS)]
    for axis in (s.axis for s in smooth if s.gain > LIKELY * smooth[0].gain):
        u, factor = left.gathered(axis.of), left.gathered(axis.times)
        for shape in SHAPES:
            points = shape.grid(float(u.min()), float(u.max())) if axis.name in shape.axes else []
            if points:
                gains = _gains(left, shape, points, (u, factor))
                best = int(np.argmax(gains))
                yield Term(shape, axis, points[best], (float(u.min()), float(u.max())), float(gains[best]))


def _gains(
    left: CompressedResidual, shape: Shape, points: Sequence[tuple[float, ...]], along: tuple[Array, Array]
) -> Array:
    """Fall of chi-squared with the best coefficients at every setting, (G,)."""
    u, factor = along
    made = shape.on_grid(u, points)
    k = len(made)
    whole = np.stack([_finite(c) for c in made], axis=2) * factor[:, None, None]
    rows = np.concatenate([m @ c for m, c in zip(left.maps, left.cut(whole.reshape(len(u), -1)), strict=True)])
    beside = left.beside(rows)
    norm = np.linalg.norm(rows, axis=0)
    norm[norm == 0] = np.inf
    pull = (left.left @ beside / norm).reshape(-1, k)
    unit = (beside / norm).reshape(len(beside), -1, k).transpose(1, 0, 2)
    values, vectors = np.linalg.eigh(unit.transpose(0, 2, 1) @ unit)
    turned = np.einsum("gij,gi->gj", vectors, pull)
    least = max(ABSORBED * left.blur, ROUND)
    gains: Array = np.sum(np.where(values > least, turned**2 / np.maximum(values, least), 0.0), axis=1)
    return gains


def _finite(columns: Array) -> Array:
    """Columns without what is no number, or as good as infinite."""
    return np.where(np.abs(columns) < LARGEST, columns, 0.0)


def _refined(left: CompressedResidual, term: Term) -> Term:
    """The same form at its best numbers, coefficients solved for every trial (variable projection)."""
    if not term.numbers:
        return replace(term, coefficients=_solved(left, term, term.numbers)[1])
    limits = parameter_bounds(term, 30.0, 3.0)
    low, high = np.array([limits[q] for q in parameter_names(term)]).T
    scale = np.minimum(high - low, np.maximum(np.abs(np.array(term.numbers)), 1e-3 * (high - low)))

    start = np.clip(term.numbers, low, high) / scale
    ends = low / scale - 1e-9, high / scale + 1e-9

    def rest(z: Array) -> Array:
        return _solved(left, term, z * scale)[0]

    steps = np.full(len(start), STEP)
    found = least_squares(rest, start, bounds=ends, diff_step=steps, max_nfev=TRIALS)
    numbers = np.clip(found.x * scale, low, high)
    gone, coefficients = _solved(left, term, numbers)
    gain = float(left.left @ left.left - gone @ gone)
    return replace(term, numbers=tuple(map(float, numbers)), gain=gain, coefficients=coefficients)


def _solved(left: CompressedResidual, term: Term, numbers: Sequence[float] | Array) -> tuple[Array, tuple[float, ...]]:
    """What the best coefficients of a form leave, (M,), and these."""
    columns = left.trace([_finite(term.force(path, list(numbers))) for path in left.paths])
    solved = np.linalg.lstsq(columns, left.left, rcond=1e-9)[0]
    return np.asarray(left.left - columns @ solved), tuple(map(float, solved))
