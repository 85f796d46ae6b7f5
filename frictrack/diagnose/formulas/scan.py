"""Fit every form of the grammar beside a linearised model: grid of settings, variable projection, and evidence.

References
----------
Golub & Pereyra (1973), SIAM J. Numer. Anal. 10, 413-432.

"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import least_squares

from frictrack.diagnose.compressed import CompressedResidual
from frictrack.diagnose.formulas.probability import log_volume, relative_evidence
from frictrack.diagnose.formulas.shapes import Shape
from frictrack.diagnose.formulas.terms import Term, parameter_bounds, parameter_names
from frictrack.diagnose.formulas.variables import formula_axes, is_excluded
from frictrack.diagnose.smooth_forces import Axis
from frictrack.records import Array

MIN_LEAKAGE_RATIO = 3.0  # remaining share of a column's square over the leakage of the model projection
MIN_SQUARE_SHARE = 1e-8  # least remaining share of a column's square
MAX_COLUMN_VALUE = 1e9  # above it a shape has no value
RELATIVE_STEP = 1e-5  # of finite differences
MAX_EVALUATIONS = 25  # per refinement of a term
MIN_GAIN_RATIO_REFINED = 0.4  # of the best gain on the grid that a form must reach to be refined
N_STARTS = 2  # settings of the grid from which a form is refined
MIN_GAIN_RATIO_START = 0.8  # of the best setting of a form, for further starts
REFINED_WIDTH_FACTOR, REFINED_CELLS = 30.0, 3.0  # reach of a refinement: factor of a width, resolution cells of a place


@dataclass(frozen=True)
class Scan:
    """Forms of the grammar beside one linearised model.

    Parameters
    ----------
    terms
        Refined forms, one per shape and variable, highest evidence first.
    sizes
        Size of every form of the grammar, by which the prior is normalised.

    """

    terms: list[Term]
    sizes: list[int]


def scan_forms(compressed: CompressedResidual, shapes: Sequence[Shape], n_refined: int) -> Scan:
    """Fit all forms at the settings of a grid, and refine the best.

    Parameters
    ----------
    compressed
        The compressed residual of the model, without the formula.
    shapes
        Shapes of the grammar.
    n_refined
        Number of forms that are refined at most.

    Returns
    -------
    Scan

    """
    scanned = list(_scan_shapes(compressed, shapes))
    sizes = [starts[0].size for starts in scanned]
    best = max((starts[0].gain for starts in scanned), default=0.0)
    if not best > 0:  # no form fits in what the data determine
        return Scan([], sizes)
    tried = sorted((s for s in scanned if s[0].gain > MIN_GAIN_RATIO_REFINED * best), key=lambda s: -s[0].gain)
    refined = [max((_refine_term(compressed, t) for t in s), key=lambda t: t.gain) for s in tried[:n_refined]]
    power = max(t.gain for t in refined)
    return Scan(sorted(refined, key=lambda t: -relative_evidence(t, power)), sizes)


def _scan_shapes(compressed: CompressedResidual, shapes: Sequence[Shape]) -> Iterator[list[Term]]:
    """The best settings of every shape over every variable, best first."""
    axes = formula_axes(compressed)
    for name in dict.fromkeys(axis.name for axis in axes):
        variables = [axis for axis in axes if axis.name == name]
        u = compressed.concatenate(variables[0].of)
        ends = float(u.min()), float(u.max())
        for shape in shapes:
            allowed = [axis for axis in variables if name in shape.axes and not is_excluded(shape, axis)]
            points = shape.grid(*ends) if allowed else []
            if points:
                columns = np.stack([_finite(c) for c in shape.on_grid(u, points)], axis=2)
                for axis in allowed:
                    gains = _grid_gains(compressed, columns, compressed.concatenate(axis.times))
                    yield _best_settings(shape, axis, points, ends, gains)


def _best_settings(
    shape: Shape, axis: Axis, points: Sequence[tuple[float, ...]], ends: tuple[float, float], gains: Array
) -> list[Term]:
    """The best setting of a form and other local maxima along the grid that are nearly as good."""
    padded = np.concatenate([[-np.inf], gains, [-np.inf]])
    peaks = np.flatnonzero((gains >= padded[:-2]) & (gains >= padded[2:]))
    order = peaks[np.argsort(-gains[peaks])][:N_STARTS]
    kept = [k for k in order if gains[k] >= MIN_GAIN_RATIO_START * gains[order[0]]]
    return [Term(shape, axis, points[k], ends, float(gains[k])) for k in kept]


def _grid_gains(compressed: CompressedResidual, columns: Array, factor: Array) -> Array:
    """Fall of chi-squared with the best coefficients at every setting, (G,), of columns (n, G, k) times a factor."""
    n, _, k = columns.shape
    whole = (columns * factor[:, None, None]).reshape(n, -1)
    rows = np.concatenate([m @ c for m, c in zip(compressed.force_maps, compressed.split_by_piece(whole), strict=True)])
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
    limits = parameter_bounds(term, REFINED_WIDTH_FACTOR, REFINED_CELLS)
    low, high = np.array([limits[q] for q in parameter_names(term)]).T
    scale = np.minimum(high - low, np.maximum(np.abs(np.array(term.parameters)), 1e-3 * (high - low)))

    start = np.clip(term.parameters, low, high) / scale
    ends = low / scale - 1e-9, high / scale + 1e-9

    def residual(z: Array) -> Array:
        return _solve_coefficients(compressed, term, z * scale, at)[0]

    steps = np.full(len(start), RELATIVE_STEP)
    found = least_squares(residual, start, bounds=ends, diff_step=steps, max_nfev=MAX_EVALUATIONS)
    parameters = tuple(map(float, np.clip(found.x * scale, low, high)))
    remaining, coefficients = _solve_coefficients(compressed, term, parameters, at)
    gain = float(compressed.residual @ compressed.residual - remaining @ remaining)
    refined = replace(term, parameters=parameters, gain=gain, coefficients=coefficients)
    return replace(refined, log_volume=log_volume(refined, np.asarray(found.jac) / scale))


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
