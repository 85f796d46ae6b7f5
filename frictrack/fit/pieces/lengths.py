"""Choose the length of the pieces of a run whose drive is measured, and cut it into these.

Unmodelled forces are integrated twice and soon exceed the camera's noise. A new piece forgets them, at the price of
its own start position and speed. For each of several lengths the model is solved by linear least squares along the
measured motion. With H the information and e the significant excess of chi-squared per piece, the covariance of the
coefficients is at most about

    (1 + e) H^-1

because the excess of a piece may all point along one coefficient (Cauchy-Schwarz; the usual sandwich with every
residual in the worst direction). The length with the smallest determinant is taken: the whole run if there is no
excess. A long record with reversals is cut into pieces of `REVERSAL_PIECE_FRAMES` frames, each with its memory of the
motion before.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import product

import numpy as np

from frictrack.effects import Effect, Span
from frictrack.effects.models import Model
from frictrack.fit.pieces.cutting import MIN_FRAMES
from frictrack.fit.pieces.piece import Piece, cut_rows, displacement_rows, spans_of, without_starts
from frictrack.measure.motion import noise_level
from frictrack.records import Array, Run

MIN_PIECE_FRAMES = 2 * MIN_FRAMES  # frames; in shorter pieces the start uses up a quarter of the information
EXCESS_STD = 2.33  # standard deviations of chi-squared: one-sided 1 % level
MIN_SINGULAR_VALUE = 1e-6  # relative; smaller singular values are left out
REVERSAL_PIECE_FRAMES = 512  # frames; computing time grows faster than the length
MIN_HISTORY_FRAMES = 100  # first frames of a record without known history; they determine the states of memory
SCAN_QUANTILES = (0.25, 0.5, 0.75)  # quantiles of a scan at which a non-linear parameter is held


def piece_frames(model: Model, pieces: Sequence[Piece], run: Run) -> int:
    """Choose the number of frames per piece of one run from its longest possible `pieces`; 0 leaves these whole."""
    whole = max(len(p.t) for p in pieces)
    if any(p.slack for p in pieces):  # friction of a swinging mass follows from the loss over many swings
        return 0
    if any(p.turns for p in pieces):
        return REVERSAL_PIECE_FRAMES if whole > 2 * REVERSAL_PIECE_FRAMES else 0
    lengths = [0, *(n for n in (whole >> k for k in range(1, 32)) if n >= MIN_PIECE_FRAMES)]
    if run.drive is None or len(lengths) == 1 or not any(_is_known_before_fit(e) for e in model.effects):
        return 0
    rows = [_linear_model(model, p) for p in pieces]
    keep = _distinguishable_directions(rows, pieces)
    rows = [np.column_stack([r[:, :-1] @ keep, r[:, -1]]) for r in rows]
    relative_noise_error = noise_level(run.displacement.x, run.displacement.valid, t=run.displacement.t)[1]
    return min(lengths, key=lambda n: _log_covariance(rows, pieces, n, relative_noise_error))


def cut_into_pieces(pieces: Sequence[Piece], n: int) -> list[Piece]:
    """Cut pieces of one run into shorter ones of about n frames; 0 leaves them whole."""
    if not n:
        return list(pieces)
    out = []
    for piece in pieces:
        first = MIN_HISTORY_FRAMES if piece.turns and not piece.slack and _history_is_unknown(piece) else 0
        cuts = [c + first for c in cut_rows(len(piece.t) - first, n)]
        out += [replace(piece.part(int(c[0]), int(c[-1]) + 1), cut=True) for c in cuts]
    return out


def has_known_history(piece: Piece) -> bool:
    """Return whether a piece begins at rest, or after enough motion to determine the states of effects with memory."""
    before = piece.path.before
    return bool(piece.path.s[0] == 0 or (before is not None and before.shape[1] >= MIN_HISTORY_FRAMES))


def _history_is_unknown(piece: Piece) -> bool:
    """Whether a piece moves from its first frame on and nothing is known of the motion before."""
    before = piece.path.before
    return bool(piece.path.s[0] != 0 and (before is None or before.shape[1] < 2))


def _linear_model(model: Model, piece: Piece) -> Array:
    """Displacement per unit coefficient, and measured minus known displacement last, (n, K + 1), in units of sigma."""
    nodes = piece.path_at_nodes(piece.x_hat, piece.v_hat, 1.0)
    span = spans_of([replace(piece, run=0)], 1, 1 / float(np.median(np.diff(piece.t))))[0]
    forces = [
        e.columns(nodes, held) for e in model.effects if _is_known_before_fit(e) for held in _values_before_fit(e, span)
    ]
    return displacement_rows(piece, np.column_stack(forces))


def _is_known_before_fit(effect: Effect) -> bool:
    """Whether the columns of an effect along the measured motion are known well enough before the fit."""
    return effect.acts_on == "force" and not effect.modifies and not any(p.role == "phase" for p in effect.parameters)


def _values_before_fit(effect: Effect, span: Span) -> list[dict[str, float]]:
    """Values of the non-linear parameters: fixed ones, and others at three quantiles of their scan."""
    each = [
        [p.fixed] if p.fixed is not None else list(np.quantile(p.scan(span), SCAN_QUANTILES)) if p.scan else [0.0]
        for p in effect.nonlinear
    ]
    return [dict(zip((p.name for p in effect.nonlinear), point, strict=True)) for point in product(*each)]


def _distinguishable_directions(rows: Sequence[Array], pieces: Sequence[Piece]) -> Array:
    """Combinations (K, K') of the coefficients that the run can distinguish."""
    jac = np.concatenate([without_starts(p, r[:, :-1])[0] for p, r in zip(pieces, rows, strict=True)])
    norm = np.linalg.norm(jac, axis=0)
    norm[norm == 0] = 1.0
    _, s, vt = np.linalg.svd(jac / norm, full_matrices=False)
    return np.asarray(vt[s > MIN_SINGULAR_VALUE * s[0]].T / norm[:, None])


def _log_covariance(rows: Sequence[Array], pieces: Sequence[Piece], n: int, relative_noise_error: float) -> float:
    """Logarithm of the determinant of the coefficients' covariance with pieces of n frames."""
    blocks = [window for own, piece in zip(rows, pieces, strict=True) for window in without_starts(piece, own, n)]
    # QR, because normal equations lose chi-squared to rounding where the displacement is large
    upper = np.abs(np.diag(np.linalg.qr(np.concatenate(blocks), mode="r")))
    k = len(upper) - 1  # the last column is the data: what is left of it is chi-squared
    degrees = sum(len(b) for b in blocks) - 2 * len(blocks) - k
    excess = excess_chi2(float(upper[k] ** 2), degrees, len(blocks), relative_noise_error)
    return k * float(np.log1p(excess)) - 2.0 * float(np.sum(np.log(np.maximum(upper[:k], 1e-300))))


def excess_chi2(chi2: float, degrees: int, pieces: int, relative_noise_error: float) -> float:
    """Compute the excess of chi-squared beyond its 99 % quantile, per piece; 0 if there is none.

    Examples
    --------
    >>> excess_chi2(100.0, 100, 4, 0.0)
    0.0

    """
    threshold = degrees + EXCESS_STD * float(np.sqrt(2 * degrees + (2 * relative_noise_error * degrees) ** 2))
    return max(chi2 - threshold, 0.0) / pieces
