"""Where Gauss-Newton sets out for a law that passes stops and reversals: the best of a grid along the smoothed motion.

A static law has no motion through a reversal beside which a scan could be made. Along the smoothed motion the law with
its memory is linear in its coefficients for every setting of the others, and integrated twice it is compared with the
displacement (Golub & Pereyra 1973).
"""

from __future__ import annotations

from contextlib import suppress
from itertools import product

import numpy as np

from frictrack.effects import Effect
from frictrack.errors import FrictrackError
from frictrack.fit.simulated.pieces import Piece
from frictrack.fit.simulated.problem import Problem
from frictrack.fit.simulated.segments import divided
from frictrack.fit.simulated.solve import refine
from frictrack.models import Model
from frictrack.records import Array

MOST = 600  # settings tried
SHORTEST = 128  # frames of the first stretches
STEPS = 6  # of a refinement of one length


def bent(model: Model) -> tuple[list[Effect], list[Effect]]:
    """The effects that start together: all without a scan, and what bends or is bent; and those that enter later."""
    reshaped = frozenset[str]().union(*(e.modifies for e in model.effects if e.turns))
    together = [e for e in model.effects if e.turns or e.kind in reshaped or not any(p.free for p in e.nonlinear)]
    return together, [e for e in model.effects if e not in together]


def first_law(problem: Problem) -> Array:
    """The unknowns (P,) of the best setting on the grid."""
    layout = problem.layout
    scanned = [i for i, s in enumerate(layout.slots) if not s.linear and s.effect != "level"]
    grids = [_grid(problem, i) for i in scanned]
    points = list(product(*grids))
    best, least = np.ones(len(layout.slots)), np.inf
    for point in points[:: -(-len(points) // MOST)]:
        p = np.where([s.effect == "level" for s in layout.slots], 1.0, 0.0)
        p[scanned] = point
        misfit = _solved(problem, p)
        if misfit < least:
            best, least = p, misfit
    return best


def lengthened(problem: Problem) -> Array:
    """The unknowns (P,) of a law of swinging masses: fitted to short stretches first, then to longer and longer ones.

    Over a whole record a slightly wrong law is soon out of phase, and no step leads on from there. In short stretches
    with starts of their own it is nearly linear (multiple shooting; Bock 1983, Progress in Scientific Computing 2).
    """
    p = first_law(_divided(problem, SHORTEST))
    length, whole = SHORTEST, max(len(piece.t) for piece in problem.pieces)
    while length < whole:
        part = _divided(problem, length)
        with suppress(FrictrackError):  # a longer stretch may lead on where this one does not
            p = refine(part, p, part.first_starts(), max_steps=STEPS).p
        length *= 2
    return p


def _divided(problem: Problem, length: int) -> Problem:
    """The same problem over stretches of about so many frames."""
    pieces = [part for piece in problem.pieces for part in divided([piece], length)]
    return problem.over(problem.layout, pieces)


def _grid(problem: Problem, i: int) -> Array:
    slot = problem.layout.slots[i]
    effect = next(e for e in problem.model.effects if e.name == slot.effect)
    scan = effect.parameter(slot.parameter).scan
    return np.array([np.mean(slot.bounds)]) if scan is None else scan(problem.layout.span)


def _solved(problem: Problem, p: Array) -> float:
    """Squared misfit with the best coefficients, which are written into p (P,)."""
    linear = [i for i, s in enumerate(problem.layout.slots) if s.linear]
    blocks = [_compared(problem, piece, p, linear) for piece in problem.pieces]
    columns, right = (np.concatenate(q) for q in zip(*blocks, strict=True))
    low, high = (bound[linear] for bound in problem.layout.bounds)
    p[linear] = np.clip(np.linalg.lstsq(columns, right, rcond=1e-10)[0], low, high)
    return float(np.sum((right - columns @ p[linear]) ** 2))


def _compared(problem: Problem, piece: Piece, p: Array, linear: list[int]) -> tuple[Array, Array]:
    """Displacement (n, K) per unit coefficient and the measured one (n,), in units of sigma, starts removed."""
    values, level = problem.layout.values(p, piece.run)
    made = problem.model.force_columns(piece.along(piece.x_hat, piece.v_hat, level), values)
    inputs = [piece.known]
    for i in linear:
        slot = problem.layout.slots[i]
        mine = slot.effect in made and slot.run in (None, piece.run)
        column = (
            made[slot.effect][:, problem.column(slot.effect, slot.parameter)] if mine else np.zeros_like(piece.known)
        )
        inputs.append(-column / piece.mass)
    moved = np.column_stack([piece.panels.integrate(g, 0.0, 0.0)[2][piece.at] for g in inputs])
    white = np.column_stack([moved[:, 1:], piece.y - moved[:, 0]]) / piece.sigma[:, None]
    q, _ = np.linalg.qr(np.column_stack([np.ones_like(piece.t), piece.t]) / piece.sigma[:, None])
    white = white - q @ (q.T @ white)
    return white[:, :-1], white[:, -1]
