"""Find start values for a model that passes stops and reversals: the best point of a grid along the smoothed motion.

A static model gives no motion through a reversal, about which a scan could be made. Along the smoothed motion the model
with memory is linear in its coefficients for all other parameters. Integrated twice, it is compared with the
displacement (variable projection).

References
----------
Golub, G. H. & Pereyra, V. (1973). SIAM J. Numer. Anal. 10, 413-432.

"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from itertools import product

import numpy as np
from scipy.optimize import least_squares

from frictrack.effects import Effect
from frictrack.errors import FrictrackError
from frictrack.fit.least_squares import LeastSquaresProblem, refine
from frictrack.fit.pieces import Piece, cut_into_pieces
from frictrack.models import Model
from frictrack.records import Array

MAX_SETTINGS_TRIED = 600  # grid points tried
MIN_WINDOW_FRAMES = 32  # frames per window; its start uses two degrees of freedom
MAX_REFINEMENTS = 30  # function evaluations beyond the grid
FIRST_SEGMENT_FRAMES = 128  # frames of the first, shortest stretches
STEPS_PER_LENGTH = 6  # Gauss-Newton steps per length


def split_start_effects(model: Model) -> tuple[list[Effect], list[Effect]]:
    """Split effects into those that start together and those that are added later.

    Effects without a scan start together, with modifiers and what they modify.

    Parameters
    ----------
    model : Model
        The model.

    Returns
    -------
    first, later : list of Effect
        The two groups.

    """
    reshaped = frozenset[str]().union(*(e.modifies for e in model.effects if e.turns))
    start_effects = [e for e in model.effects if e.turns or e.kind in reshaped or not any(p.free for p in e.nonlinear)]
    return start_effects, [e for e in model.effects if e not in start_effects]


def best_on_grid(problem: LeastSquaresProblem) -> Array:
    """Find the best grid point of the non-linear parameters, refined along the smoothed motion.

    A force that depends on position, such as a spring, turns position errors into slow errors after two integrations.
    Stretches are therefore compared whole and in windows, at the length at which the model explains most.

    Parameters
    ----------
    problem : LeastSquaresProblem
        The problem.

    Returns
    -------
    array of shape (P,)
        Start values.

    """
    layout = problem.layout
    scanned = [i for i, s in enumerate(layout.slots) if not s.linear and s.effect != "level"]
    points = list(product(*(_grid(problem, i) for i in scanned)))
    lengths = _lengths(problem)
    best, smallest_share, length = np.ones(len(layout.slots)), np.inf, 0
    for point in points[:: -(-len(points) // MAX_SETTINGS_TRIED)]:
        p = np.where([s.effect == "level" for s in layout.slots], 1.0, 0.0)
        p[scanned] = point
        for n, columns, right in _windowed(problem, p, lengths):
            basis_vectors, residual = _solve_coefficients(problem, p, columns, right)
            unexplained_share = float(residual @ residual) / max(float(right @ right), 1e-300)
            if unexplained_share < smallest_share:
                best, smallest_share, length = basis_vectors, unexplained_share, n
    return _refined(problem, best, scanned, length) if scanned else best


def _lengths(problem: LeastSquaresProblem) -> list[int]:
    """Window lengths to try, in frames; 0 leaves stretches whole."""
    longest = max(len(p.t) for p in problem.pieces)
    return [0, *(n for n in (longest >> k for k in range(1, 32)) if n >= MIN_WINDOW_FRAMES)]


def _refined(problem: LeastSquaresProblem, p: Array, scanned: list[int], length: int) -> Array:
    """Unknowns (P,) refined from the grid, the coefficients solved for every trial."""
    low, high = (bound[scanned] for bound in problem.layout.bounds)
    scale = np.maximum(np.abs(p[scanned]), 1e-12)

    def residual(theta: Array) -> Array:
        return solved(theta)[1]

    def solved(theta: Array) -> tuple[Array, Array]:
        basis_vectors = p.copy()
        basis_vectors[scanned] = np.clip(theta * scale, low, high)
        ((_, columns, right),) = _windowed(problem, basis_vectors, [length])
        return _solve_coefficients(problem, basis_vectors, columns, right)

    inside = np.clip(p[scanned], low + 1e-9 * scale, high - 1e-9 * scale) / scale
    found = least_squares(residual, inside, bounds=(low / scale, high / scale), x_scale=1.0, max_nfev=MAX_REFINEMENTS)
    return solved(found.x)[0]


def shoot_lengthening(problem: LeastSquaresProblem) -> Array:
    """Find start values for swinging masses: fit short stretches first, then longer and longer ones.

    Over a whole record a slightly wrong model is soon out of phase, and no step leads back. In short stretches with
    their own starts it is nearly linear (multiple shooting).

    Parameters
    ----------
    problem : LeastSquaresProblem
        The problem.

    Returns
    -------
    array of shape (P,)
        Start values.

    References
    ----------
    Bock, H. G. (1983). Recent advances in parameter identification techniques for O.D.E. Progress in Scientific
    Computing 2, 95-121.

    """
    p = best_on_grid(_cut_problem(problem, FIRST_SEGMENT_FRAMES))
    length, whole = FIRST_SEGMENT_FRAMES, max(len(piece.t) for piece in problem.pieces)
    while length < whole:
        part = _cut_problem(problem, length)
        with suppress(FrictrackError):  # a longer stretch may converge where this one does not
            p = refine(part, p, part.first_starts(), max_steps=STEPS_PER_LENGTH).p
        length *= 2
    return p


def _cut_problem(problem: LeastSquaresProblem, length: int) -> LeastSquaresProblem:
    """The same problem over stretches of about `length` frames."""
    pieces = [part for piece in problem.pieces for part in cut_into_pieces([piece], length)]
    return problem.rebuild(problem.layout, pieces)


def _grid(problem: LeastSquaresProblem, i: int) -> Array:
    """Values of one unknown to try."""
    slot = problem.layout.slots[i]
    effect = next(e for e in problem.model.effects if e.name == slot.effect)
    scan = effect.parameter(slot.parameter).scan
    return np.array([np.mean(slot.bounds)]) if scan is None else scan(problem.layout.span)


def _solve_coefficients(problem: LeastSquaresProblem, p: Array, columns: Array, right: Array) -> tuple[Array, Array]:
    """Unknowns (P,) with the best coefficients, and the residual (n,)."""
    linear = [i for i, s in enumerate(problem.layout.slots) if s.linear]
    low, high = (bound[linear] for bound in problem.layout.bounds)
    out = p.copy()
    out[linear] = np.clip(np.linalg.lstsq(columns, right, rcond=1e-10)[0], low, high)
    return out, np.asarray(right - columns @ out[linear])


def _windowed(problem: LeastSquaresProblem, p: Array, lengths: list[int]) -> Iterator[tuple[int, Array, Array]]:
    """Yield, for every window length, columns (n, K) per unit coefficient and data (n,), starts projected out."""
    linear = [i for i, s in enumerate(problem.layout.slots) if s.linear]
    rows = [(piece, _compared(problem, piece, p, linear)) for piece in problem.pieces]
    for n in lengths:
        cut = np.concatenate([basis_vectors for piece, white in rows for basis_vectors in _unstarted(piece, white, n)])
        yield n, cut[:, :-1], cut[:, -1]


def _unstarted(piece: Piece, white: Array, n: int) -> list[Array]:
    """Windows of about n frames of columns (n, k), start position and speed projected out."""
    out = []
    start = piece.whitened(np.column_stack([np.ones_like(piece.t), piece.t - piece.t[0]]))
    for rows in np.array_split(np.arange(len(white)), max(1, round(len(white) / n)) if n else 1):
        basis_vectors, _ = np.linalg.qr(start[rows])
        out.append(white[rows] - basis_vectors @ (basis_vectors.T @ white[rows]))
    return out


def _compared(problem: LeastSquaresProblem, piece: Piece, p: Array, linear: list[int]) -> Array:
    """Displacement (n, K) per unit coefficient, then the measured one, in units of sigma."""
    values, level = problem.layout.values(p, piece.run)
    force_columns = problem.model.force_columns(piece.path_at_nodes(piece.x_hat, piece.v_hat, level), values)
    inputs = [piece.known]
    for i in linear:
        slot = problem.layout.slots[i]
        has_column = slot.effect in force_columns and slot.run in (None, piece.run)
        column = (
            force_columns[slot.effect][:, problem.column(slot.effect, slot.parameter)]
            if has_column
            else np.zeros_like(piece.known)
        )
        inputs.append(-column / piece.mass)
    displacement = np.column_stack([piece.panels.integrate(g, 0.0, 0.0)[2][piece.at] for g in inputs])
    return piece.whitened(np.column_stack([displacement[:, 1:], piece.y - displacement[:, 0]]))
