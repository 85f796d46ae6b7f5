"""Fit every form of the grammar added to a linearised model: a grid on splines, then variable projection for the best.

Along an axis u every force is a spline through its values at a few hundred nodes. Chi-squared of model and force is
then a small quadratic form in these values, made once for a variable and shared by all shapes and settings over it.

The evidence of a form is its likelihood averaged over its coefficients and parameters (Laplace's approximation). Its
prior halves with every coefficient, parameter and further operator.

References
----------
Golub & Pereyra (1973), SIAM J. Numer. Anal. 10, 413-432; MacKay (1992), Neural Computation 4, 415-447;
Zellner (1986), in Bayesian Inference and Decision Techniques, 233-243.

"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property

import numpy as np
from scipy.interpolate import BSpline, make_interp_spline
from scipy.linalg import solve_triangular
from scipy.optimize import least_squares
from scipy.sparse import csr_array

from frictrack.diagnose.compressed import Axis, CompressedResidual
from frictrack.diagnose.formula_terms import Shape, Term, formula_axes, parameter_bounds, parameter_ranges
from frictrack.records import Array

N_NODES = 160  # per axis; more than three for a period of the fastest wave
MIN_LEAKAGE_RATIO = 3.0  # remaining share of a column's square over the leakage of the model projection
MIN_SQUARE_SHARE = 1e-8  # least remaining share of a column's square
MAX_COLUMN_VALUE = 1e9  # above it a shape has no value
RELATIVE_STEP = 1e-5  # of finite differences
MAX_EVALUATIONS = 25  # per refinement of a term
MIN_CHI2_FALL = 0.01  # of a step of it
MIN_GAIN_RATIO_REFINED = 0.4  # of the best gain on the grid that a form must reach to be refined
MAX_GAIN_BEHIND = 40.0  # times the reduced chi-squared: a form that gains so much less has no probability
N_STARTS = 2  # settings of the grid from which a form is refined
MIN_GAIN_RATIO_START = 0.8  # of the best setting of a form, for further starts
LOG_PRIOR_PER_UNKNOWN = float(np.log(0.5))
REACH, REACH_AGAIN = (30.0, 3.0), (1.5, 0.3)  # of both refinements: factor of a width, resolution cells of a place


@dataclass(frozen=True)
class Scan:
    """Refined forms, one per shape and variable, most probable first; sizes of all forms, which normalise the prior."""

    terms: list[Term]
    sizes: list[int]

    @property
    def power(self) -> float:
        """Fall of chi-squared by the best form."""
        return max(t.gain for t in self.terms)

    def evidence(self, unit: float) -> dict[str, float]:
        """Logarithm of the relative evidence of every form."""
        return {t.form: relative_evidence(t, self.power, unit) for t in self.terms}


def scan_forms(compressed: CompressedResidual, shapes: Sequence[Shape], n_refined: int, unit: float) -> Scan:
    """Fit all forms at the settings of a grid added to the model, and refine at most `n_refined` of the best.

    A variable over which even a free curve gains less than the best form is left out. The forms that may be probable
    are refined once more at all points; `unit` is the reduced chi-squared of the model.
    """
    variables = [_Variable(compressed, axis) for axis in formula_axes(compressed)]
    variables = sorted((v for v in variables if v.ends[1] > v.ends[0]), key=lambda v: -v.gain_of_free_curve)
    best, sizes, scanned = 0.0, [], []
    on_grid = cache(_columns_on_grid)  # the same for all variables over an axis
    for variable in variables:
        is_behind = variable.gain_of_free_curve < best - MAX_GAIN_BEHIND * unit
        for shape in shapes:
            form = Term(shape, variable.axis, (), variable.ends)
            if variable.axis.name in shape.axes and not form.is_excluded:
                sizes.append(form.size)
                scanned += [] if is_behind else [(variable, variable.best_settings(form, on_grid(shape, *form.ends)))]
        best = max([best, *(starts[0].gain for _, starts in scanned)])
    if not best > 0:  # no form fits in what the data determine
        return Scan([], sizes)
    tried = [pair for pair in scanned if pair[1][0].gain > MIN_GAIN_RATIO_REFINED * best]
    tried = sorted(tried, key=lambda pair: -pair[1][0].gain)[:n_refined]
    refined = [max((_refine(t, REACH, *v.at_nodes(t)) for t in starts), key=lambda t: t.gain) for v, starts in tried]
    power = max(t.gain for t in refined)
    refined = [
        _refine(t, REACH_AGAIN, *v.at_all_points(t)) if t.gain > power - MAX_GAIN_BEHIND * unit else t
        for (v, _), t in zip(tried, refined, strict=True)
    ]
    return Scan(sorted(refined, key=lambda t: -relative_evidence(t, power)), sizes)


Traces = Callable[[Array], Array]  # parameters (q,): traces (M, k) of the columns of a form


@dataclass(frozen=True, eq=False)
class _Variable:
    """A variable of formulas, and the traces of forces over it."""

    compressed: CompressedResidual
    axis: Axis

    @cached_property
    def u(self) -> Array:
        """The variable along all pieces, (N,)."""
        return self.compressed.concatenate(self.axis.of)

    @cached_property
    def factor(self) -> Array:
        """Factor on the force along all pieces, (N,)."""
        return self.compressed.concatenate(self.axis.times)

    @cached_property
    def ends(self) -> tuple[float, float]:
        """Ends of the axis."""
        return float(self.u.min()), float(self.u.max())

    @cached_property
    def products(self) -> tuple[Array, Array, Array]:
        """Squares (K, K) of traces of units at the nodes, a root (K, K) of what the model leaves, the residual (K,)."""
        compressed = self.compressed
        units = make_interp_spline(np.linspace(*self.ends, N_NODES), np.eye(N_NODES))
        forces = csr_array(BSpline.design_matrix(self.u, units.t, units.k).multiply(self.factor[:, None]))
        cuts = np.cumsum([0, *(len(path.t) for path in compressed.paths)])
        parts = zip(compressed.force_maps, cuts[:-1], cuts[1:], strict=True)
        traces = np.concatenate([m @ forces[a:b] for m, a, b in parts]) @ units.c
        squares, of_model = traces.T @ traces, compressed.model_directions.T @ traces
        removed = 1 - (1 - compressed.model_shares) ** 2
        ridge = np.diag(MIN_SQUARE_SHARE * np.diag(squares) + 1e-300)
        root = np.linalg.cholesky(squares - (of_model.T * removed) @ of_model + ridge)
        data = traces.T @ compressed.project_out_model(compressed.residual)
        return squares, np.asarray(root.T), np.asarray(solve_triangular(root, data, lower=True))

    @property
    def gain_of_free_curve(self) -> float:
        """Fall of chi-squared by any values at the nodes; no form over the variable gains more."""
        residual = self.products[2]
        return float(residual @ residual)

    def best_settings(self, form: Term, columns: Array) -> list[Term]:
        """The best setting of a form on its grid (K, G, k), and other local maxima that are nearly as good."""
        squares, root, residual = self.products
        flat = columns.reshape(len(columns), -1)
        # rounding may leave less of what no path reaches
        square = np.maximum(np.sum(flat * (squares @ flat), axis=0), 0.0)
        norm = np.sqrt(square).reshape(columns.shape[1:])
        min_share = max(MIN_LEAKAGE_RATIO * self.compressed.leakage, MIN_SQUARE_SHARE)
        gains = _gains((root @ flat).reshape(columns.shape), norm, residual, min_share)
        padded = np.concatenate([[-np.inf], gains, [-np.inf]])
        peaks = np.flatnonzero((gains >= padded[:-2]) & (gains >= padded[2:]))
        order = peaks[np.argsort(-gains[peaks], kind="stable")][:N_STARTS]
        kept = [k for k in order if gains[k] >= MIN_GAIN_RATIO_START * gains[order[0]]]
        settings = form.shape.settings(*self.ends)
        return [replace(form, parameters=tuple(settings[k].tolist()), gain=float(gains[k])) for k in kept]

    def at_nodes(self, form: Term) -> tuple[Traces, Array]:
        """The traces of the columns of a form from its values at the nodes, and the residual."""
        _, root, residual = self.products
        nodes = np.linspace(*self.ends, N_NODES)
        return lambda parameters: root @ _finite(form.shape.columns_at(nodes, parameters)), residual

    def at_all_points(self, form: Term) -> tuple[Traces, Array]:
        """The traces of the columns of a form from its values at all points of the paths, and the residual."""

        def traces(parameters: Array) -> Array:
            columns = _finite(form.shape.columns_at(self.u, parameters)) * self.factor[:, None]
            return self.compressed.traces_of(columns)

        return traces, self.compressed.residual


def _columns_on_grid(shape: Shape, low: float, high: float) -> Array:
    """Columns (K, G, k) of a shape at the nodes of an axis and its settings."""
    return _finite(shape.columns_at(np.linspace(low, high, N_NODES)[:, None], shape.settings(low, high).T))


def _finite(columns: Array) -> Array:
    """Columns with values that are not finite, or huge, set to zero."""
    return np.where(np.abs(columns) < MAX_COLUMN_VALUE, columns, 0.0)


def _gains(columns: Array, norm: Array, residual: Array, min_share: float) -> Array:
    """Fall of chi-squared (G,) with the best coefficients of columns (M, G, k).

    The norms (G, k) are those before the projection; columns of which it leaves less than a share gain nothing.
    """
    unit = columns / np.where(norm > 0, norm, np.inf)
    gram, data = np.einsum("mgi,mgj->gij", unit, unit), np.tensordot(residual, unit, 1)
    found = np.linalg.solve(gram + min_share * np.eye(columns.shape[2]), data[..., None])[..., 0]
    return np.asarray(np.sum(data * found, axis=1))


def _refine(term: Term, reach: tuple[float, float], traces: Traces, residual: Array) -> Term:
    """Refine the parameters of a term, with coefficients solved in every trial (variable projection)."""

    def solve(parameters: Array) -> tuple[Array, Array]:
        """What the best coefficients leave (M,), and these coefficients (k,)."""
        columns = traces(parameters)
        coefficients = np.asarray(np.linalg.lstsq(columns, residual, rcond=1e-9)[0], dtype=float)
        return residual - columns @ coefficients, coefficients

    parameters, jacobian = np.array(term.parameters), np.empty((len(residual), 0))
    if term.parameters:
        low, high = np.array(list(parameter_bounds(term, *reach).values())).T
        scale = np.minimum(high - low, np.maximum(np.abs(parameters), 1e-3 * (high - low)))

        def left_at(z: Array) -> Array:
            return solve(z * scale)[0]

        found = least_squares(
            left_at,
            np.clip(parameters, low, high) / scale,
            bounds=(low / scale - 1e-9, high / scale + 1e-9),
            diff_step=np.full(len(scale), RELATIVE_STEP),
            ftol=MIN_CHI2_FALL / max(float(residual @ residual), 1.0),
            max_nfev=MAX_EVALUATIONS,
        )
        parameters, jacobian = np.clip(found.x * scale, low, high), np.asarray(found.jac) / scale
    left, coefficients = solve(parameters)
    gain = float(residual @ residual - left @ left)
    refined = replace(term, parameters=tuple(parameters.tolist()), gain=gain, coefficients=tuple(coefficients.tolist()))
    return replace(refined, log_volume=log_volume(refined, jacobian))


def log_volume(term: Term, jacobian: Array) -> float:
    """Logarithm of the share of the prior range of its parameters that the data leave to a form.

    `jacobian` (M, q) is the derivative of the whitened residual. Parameters that the data do not determine keep all.
    """
    ranges, logarithmic = parameter_ranges(term)
    per_step = jacobian * np.where(logarithmic, np.abs(term.parameters), 1.0)
    precision = per_step.T @ per_step + np.diag(2 * np.pi / ranges**2)
    sign, log_det = np.linalg.slogdet(precision)
    whole = 0.5 * (len(ranges) * float(np.log(2 * np.pi)) - float(log_det)) - float(np.sum(np.log(ranges)))
    return min(whole, 0.0) if sign > 0 else 0.0


def relative_evidence(term: Term, power: float, unit: float = 1.0) -> float:
    """Logarithm of the evidence of a form times its relative prior, over that of no force.

    The prior of the size of a force is taken from `power`, the fall of chi-squared by the best form (Zellner 1986).
    `unit` is the reduced chi-squared, if it is above 1.
    """
    coefficients = 0.5 * len(term.shape.columns) * float(np.log1p(power / unit))
    return 0.5 * term.gain / unit - coefficients + term.log_volume + LOG_PRIOR_PER_UNKNOWN * term.size
