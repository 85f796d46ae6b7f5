"""Local forces that a fitted law lacks: where, how wide, and how sure, solved jointly with the law itself.

A force that acts for a moment or at one place is a bump. Bumps are looked for at every time of every run, and at every
place of the course with one size for all runs, beside the linearised law, so that the law's bending is undone. What
stands out most is taken, all bumps taken so far are moved and widened together until they fit best, and the search goes
on in what is left (sliding Frank-Wolfe: Denoyelle, Duval, Peyre & Soubies 2020, Inverse Problems 36). The noise is
white in the displacement, so all of this happens there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from frictrack.compare.bump_dictionary import (
    Bump,
    Looks,
    Nodes,
    chances,
    families,
    limits,
    looks_of,
    nodes,
    norms,
    over,
)
from frictrack.compare.global_significance import Chance
from frictrack.errors import FrictrackError
from frictrack.fit.least_squares import (
    LeastSquaresProblem,
    ModelProjection,
    Solution,
    displacement_response,
    model_projection,
    refine,
)
from frictrack.fit.segments import Piece
from frictrack.records import Array

ALPHA = 0.01  # of the whole search for local forces
ROUNDS = 4
STRONG = 1.5  # reduced chi-squared from which a law is fitted again beside what it misses
REFITS, REFIT_STEPS = 2, 6
SHARE = 0.02  # of what all bumps explain that each must carry
PREFERRED = 10.0  # of chi-squared by which one place for all runs must gain more than a moment of one run
BRIEFER = 6.6  # of chi-squared that a longer moment must gain over a briefer one
LIKEWISE = 0.2  # chance in a run of its own below which one more moment is believed where other runs show theirs


@dataclass(frozen=True)
class Local:
    """What local forces explain: the bumps, the law beside them, and the chance of the whole search."""

    bumps: list[Bump]
    law: ModelProjection  # without the bumps
    left: ModelProjection  # with them
    nodes: list[Nodes]
    looks: Looks
    chance: Chance
    own: list[Chance]  # of the search in every piece alone
    rest: float = 1.0  # p of what still stands out most

    def p(self, bump: Bump) -> float:
        """Chance of a bump: of the whole search, or of that in its own piece alone, see `believes`."""
        whole = self.chance(bump.z)
        if bump.piece is None or whole < ALPHA or not self.believes(bump):
            return whole
        return min(whole, self.own[bump.piece](bump.z))

    def believes(self, bump: Bump) -> bool:
        """Whether noise alone rarely shows a bump.

        Where other pieces show a moment of their own, one more is believed by the search in its own piece alone.
        """
        if self.chance(bump.z) < ALPHA:
            return True
        others = {b.piece for b in self.bumps if not b.at_place} - {bump.piece}
        mine = [b for b in self.bumps if b.piece == bump.piece and abs(b.z) > abs(bump.z)]
        return bump.piece is not None and bool(others) and not mine and self.own[bump.piece](bump.z) < LIKEWISE

    @property
    def complete(self) -> bool:
        """Whether these bumps leave nothing local behind."""
        return self.rest >= ALPHA


def opened(law: ModelProjection) -> Local:
    """The search for local forces before anything is found."""
    at = [nodes(law.solution, r) for r in law.responses]
    looks = looks_of(law, at)
    return Local([], law, law, at, looks, *chances(law, looks))


def local_forces(solution: Solution) -> Local:
    """Search a fitted law's residual for local forces.

    Where a law misses much it has bent too far to be linear: it is fitted again beside the forces found, once or twice.
    """
    found = searched(opened(model_projection(solution)))
    for _ in range(REFITS):
        much = float(found.law.r @ found.law.r) > STRONG * len(found.law.r)
        if not (much and found.bumps and all(type(p) is Piece for p in solution.problem.pieces)):
            break
        found = searched(_refitted(found, solution.problem))
    return found


def searched(found: Local) -> Local:
    """The same search carried on as long as something stands out."""
    for _ in range(ROUNDS):
        starts, rest = _stand_out(found)
        found = replace(found, rest=rest)
        if not starts:
            return found
        tried = [_fitted(replace(found, bumps=[*found.bumps, *more])) for more in starts]
        found = _pruned(min(tried, key=lambda f: float(f.left.r @ f.left.r)))
    return replace(found, rest=_stand_out(found)[1])


def _refitted(found: Local, bare: LeastSquaresProblem) -> Local:
    """The same bumps beside the law as it is when it knows them; what they leave is put back into its residual."""
    solution = found.law.solution
    pieces = []
    for i, (piece, at) in enumerate(zip(bare.pieces, found.nodes, strict=True)):
        force = np.sum([b.size * at.force(b) for b in found.bumps if b.piece in (None, i)], axis=0)
        pieces.append(replace(piece, known=piece.known - force / piece.mass))
    problem = bare.over(bare.layout, pieces)
    try:
        law = model_projection(
            refine(problem, solution.p, solution.starts, tau=max(solution.tau, 1e-3), max_steps=REFIT_STEPS)
        )
    except FrictrackError:  # a law so wild that its motion cannot be integrated
        return found
    fresh = opened(law)
    trace = bump_columns(fresh, found.bumps, moved=False)[:, :, 0] @ np.array([b.size for b in found.bumps])
    law = replace(law, r=law.r + trace - law.u @ (law.u.T @ trace))
    return _pruned(_fitted(replace(fresh, law=law, left=law, bumps=found.bumps)))


def _stand_out(found: Local) -> tuple[list[list[Bump]], float]:
    """What stands out in what is left, as sets of bumps to start from, and the p of what stands out most.

    One place for all runs, at its best in every width; or moments, at most one per piece, taken one by one, each beside
    those before it, since the law bends in all runs for what one of them lacks.
    """
    left, taken, rest = found.left, list[Bump](), 1.0
    while True:
        here = replace(found, left=left, bumps=[*found.bumps, *taken])
        moment = _moment(here, {b.piece for b in taken})
        places = [] if taken or len(left.rows) < 2 else _in_places(here)
        best = max(places, key=lambda b: b.z, default=moment)
        if places and found.chance(best.z) < ALPHA and best.z**2 > moment.z**2 + PREFERRED:
            return [[b] for b in places if found.chance(b.z) < ALPHA], found.chance(best.z)
        rest = min(rest, here.chance(moment.z))
        if not here.believes(moment):
            return [taken] if taken else [], rest
        taken.append(moment)
        left = left.with_columns(bump_columns(found, [moment])[:, :, 0])


def _moment(found: Local, done: set[int | None]) -> Bump:
    """The moment of one piece that stands out most; the briefest of those that do so about as much."""
    own, _ = norms(found.left, found.looks)
    best = [Bump(0, 0.0, 1.0)]
    for i, rows in enumerate(found.left.rows):
        if i not in done:
            z = np.abs(over(found.looks.own[i].T @ found.left.r[rows], own[i]))
            k = int(np.argmax(z**2 >= np.max(z) ** 2 - BRIEFER))
            best.append(replace(found.looks.own_bumps[i][k], z=float(z[k])))
    return max(best, key=lambda b: b.z)


def _in_places(found: Local) -> list[Bump]:
    """The place that stands out most, for every width."""
    left, looks = found.left, found.looks
    _, common = norms(left, looks)
    dots = np.sum([c.T @ left.r[rows] for rows, c in zip(left.rows, looks.common, strict=True)], axis=0)
    z = np.abs(over(dots, common))
    best = [s.start + int(np.argmax(z[s])) for s in families(looks.common_bumps)]
    return [replace(looks.common_bumps[k], z=float(z[k])) for k in best]


def bump_columns(found: Local, bumps: Sequence[Bump], *, moved: bool = True) -> Array:
    """Traces of bumps and, where asked, of their changes with centre and width over all frames, (N + m, K, 1 or 3)."""
    law = found.law
    out = np.zeros((len(law.r), len(bumps), 3 if moved else 1))
    for i, (rows, response, at) in enumerate(zip(law.rows, law.responses, found.nodes, strict=True)):
        here = [k for k, b in enumerate(bumps) if b.piece in (None, i)]
        if here:
            force = [at.moved(bumps[k]) if moved else at.force(bumps[k])[:, None] for k in here]
            out[rows, here] = displacement_response(response, np.concatenate(force, axis=1)).reshape(
                -1, len(here), out.shape[2]
            )
    return out


def _fitted(found: Local, steps: int = 6) -> Local:
    """All bumps moved and widened together until they fit best, beside the law (Levenberg-Marquardt)."""
    bumps = found.bumps
    columns = bump_columns(found, bumps)
    sizes, chi2 = solved(found.law, columns[:, :, 0])
    damping = 1e-2
    for _ in range(steps):
        moved = _stepped(found, bumps, columns, sizes, damping)
        tried = bump_columns(found, moved)
        new_sizes, new = solved(found.law, tried[:, :, 0])
        if new < chi2:
            gained, damping = chi2 - new, damping / 10
            bumps, columns, sizes, chi2 = moved, tried, new_sizes, new
            if gained < 0.1:
                break
        else:
            damping *= 30
    left = found.law.with_columns(columns[:, :, 0])
    return replace(found, bumps=_weighed(found.law, columns[:, :, 0], bumps, sizes), left=left)


def solved(law: ModelProjection, columns: Array) -> tuple[Array, float]:
    """Best sizes (K,) beside the law, and chi-squared."""
    clean = columns - law.u @ (law.u.T @ columns)
    sizes, *_ = np.linalg.lstsq(clean, law.r, rcond=1e-10)
    left = law.r - clean @ sizes
    return np.asarray(sizes, dtype=np.float64), float(left @ left)


def _stepped(found: Local, bumps: Sequence[Bump], columns: Array, sizes: Array, damping: float) -> list[Bump]:
    """One damped step of sizes, centres and widths."""
    law, k = found.law, len(bumps)
    scale = np.array([b.width for b in bumps])
    jac = np.concatenate([columns[:, :, 0], columns[:, :, 1] * sizes * scale, columns[:, :, 2] * sizes], axis=1)
    jac -= law.u @ (law.u.T @ jac)
    left = law.r - jac[:, :k] @ sizes
    norm = np.linalg.norm(jac, axis=0)
    norm[norm == 0] = 1.0
    hold = np.concatenate([np.zeros(k), np.full(k, np.sqrt(damping)), np.full(k, np.sqrt(damping))])
    unit = np.vstack([jac / norm, np.diag(hold), np.diag(np.concatenate([np.zeros(2 * k), np.ones(k)]) / norm)])
    step = np.linalg.lstsq(unit, np.concatenate([left, np.zeros(6 * k)]), rcond=1e-12)[0] / norm
    out = []
    for j, b in enumerate(bumps):
        low, high = limits(found.law.responses, b)
        centre = b.centre + b.width * float(np.clip(step[k + j], -3, 3))
        width = b.width * float(np.exp(np.clip(step[2 * k + j], -0.7, 0.7)))
        out.append(replace(b, centre=centre, width=float(np.clip(width, low, high))))
    return out


def _weighed(law: ModelProjection, columns: Array, bumps: Sequence[Bump], sizes: Array) -> list[Bump]:
    """Bumps with their sizes, and by how many standard deviations each stands out beside all others."""
    clean = columns - law.u @ (law.u.T @ columns)
    inverse = np.linalg.pinv(clean.T @ clean)
    deviation = np.sqrt(np.maximum(np.diag(inverse), 0.0))
    z = np.divide(sizes, deviation, out=np.zeros(len(bumps)), where=deviation > 0)  # 0: the runs do not see it
    return [replace(b, size=float(s), z=float(q)) for b, s, q in zip(bumps, sizes, z, strict=True)]


def _pruned(found: Local) -> Local:
    """Without bumps that others made needless, or that carry next to nothing of the misfit."""
    if not found.bumps:
        return found
    total = float(found.law.r @ found.law.r - found.left.r @ found.left.r)
    kept = [b for b in found.bumps if found.believes(b) and b.z**2 > SHARE * total]
    if len(kept) == len(found.bumps) or not kept:
        return found
    return _pruned(_fitted(replace(found, bumps=kept), steps=3))


def uncertain(found: Local) -> tuple[list[Array], list[Array]]:
    """Force of all bumps at the frames of every piece (n,), N, and its variance by size, centre and width."""
    bumps, law, k = found.bumps, found.law, len(found.bumps)
    if not bumps:
        still = [np.zeros(len(r.piece.t)) for r in law.responses]
        return still, still
    sizes = np.array([b.size for b in bumps])
    scale = np.stack([np.ones(k), sizes, sizes], axis=1)
    columns = (bump_columns(found, bumps) * scale).reshape(len(law.r), -1)
    clean = columns - law.u @ (law.u.T @ columns)
    known = np.zeros(3 * k)
    known[2::3] = 1.0  # a width that the runs do not tell is known to a factor of e
    covariance = np.linalg.pinv(clean.T @ clean + np.diag(known), hermitian=True)
    forces, variances = [], []
    for i, (response, at) in enumerate(zip(law.responses, found.nodes, strict=True)):
        here = np.array([b.piece in (None, i) for b in bumps])
        moved = np.stack([at.moved(b) for b in bumps], axis=1) * here[:, None] * scale
        flat = np.stack([np.interp(response.piece.t, at.t, q) for q in moved.reshape(len(at.t), -1).T], axis=1)
        forces.append(flat[:, ::3] @ sizes)
        variances.append(np.einsum("nj,jk,nk->n", flat, covariance, flat))
    return forces, variances
