"""Find local forces that a fitted model lacks: their place or time, width, size and significance.

A local force is a Gaussian bump at one time of one run, or at one place of the course with one size for all runs.
The search is a sliding Frank-Wolfe algorithm on the linearised model. It adds the most significant bump, refines
centres and widths of all bumps together, and continues in the residual. It works on the displacement, where the noise
is white.

References
----------
Denoyelle, Duval, Peyre & Soubies (2020), Inverse Problems 36, 014001.

"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from frictrack.compare.bump_dictionary import (
    BumpDictionary,
    build_dictionary,
    families,
    quotients,
    search_significance,
    width_limits,
)
from frictrack.compare.bumps import Bump, NodeMotion, motion_at_nodes
from frictrack.compare.effect_forces import effect_force_at_nodes
from frictrack.compare.global_significance import GlobalSignificance
from frictrack.compare.refitting import fit_at_one_level, refit_with_forces
from frictrack.errors import FrictrackError
from frictrack.fit.least_squares import (
    LeastSquaresProblem,
    ModelProjection,
    Solution,
    displacement_response,
    model_projection,
)
from frictrack.fit.pieces import Piece
from frictrack.records import Array

ALPHA = 0.01  # significance level of the whole search
MAX_ROUNDS = 4  # of adding bumps
MIN_REDUCED_CHI2_REFITTED = 1.5  # above it the model is refitted together with the bumps
MAX_REFITS = 2
MIN_SHARE_PER_BUMP = 0.02  # of the chi-squared that all bumps explain
MIN_CHI2_GAIN_PLACE = 10.0  # by which one place must gain more than a bump in time of one run
MIN_CHI2_GAIN_LONGER = 6.6  # by which a longer bump must gain more than a shorter one
ALPHA_PIECE = 0.2  # level in its own piece for a bump in time if other pieces have one


@dataclass(frozen=True)
class LocalForces:
    """State of a search for local forces: the bumps found, the model with and without them, and their significance.

    Parameters
    ----------
    bumps
        Bumps found so far.
    law
        The model's residual and directions, without the bumps. Its `solution` is the fit, or the model refitted
        together with the bumps; its residual then contains their traces again.
    residual
        The same with the bumps.
    nodes
        Motion of every piece at its integration nodes.
    dictionary
        All bumps that may be added.
    significance, piece_significance
        Significance of the whole search, and of the search in each piece alone.
    p_remaining
        p-value of the most significant bump that remains.

    """

    bumps: list[Bump]
    law: ModelProjection  # without the bumps
    residual: ModelProjection  # with them
    nodes: list[NodeMotion]
    dictionary: BumpDictionary
    significance: GlobalSignificance
    piece_significance: list[GlobalSignificance]  # of the search in every piece alone
    p_remaining: float = 1.0  # p of what still stands out most

    def p(self, bump: Bump) -> float:
        """p-value of a bump: in the whole search, or in its piece alone where that suffices (see `is_credible`)."""
        global_p = self.significance(bump.z)
        if bump.piece is None or global_p < ALPHA or not self.is_credible(bump):
            return global_p
        return min(global_p, self.piece_significance[bump.piece](bump.z))

    def is_credible(self, bump: Bump) -> bool:
        """Whether noise alone rarely shows such a bump.

        Where other pieces have a bump in time too, one more is judged by the search in its own piece.
        """
        if self.significance(bump.z) < ALPHA:
            return True
        others = {b.piece for b in self.bumps if not b.at_place} - {bump.piece}
        stronger = [b for b in self.bumps if b.piece == bump.piece and abs(b.z) > abs(bump.z)]
        return (
            bump.piece is not None
            and bool(others)
            and not stronger
            and self.piece_significance[bump.piece](bump.z) < ALPHA_PIECE
        )

    @property
    def complete(self) -> bool:
        """Whether no significant bump remains."""
        return self.p_remaining >= ALPHA


def start_search(law: ModelProjection) -> LocalForces:
    """Prepare a search for local forces."""
    at = [motion_at_nodes(law.solution, r) for r in law.responses]
    dictionary = build_dictionary(law)
    return LocalForces([], law, law, at, dictionary, *search_significance(dictionary))


def find_local_forces(solution: Solution, explained: Solution | None = None) -> LocalForces:
    """Find the local forces in the residual of a fit.

    A model with a large misfit is far from its linearisation: it is refitted once or twice together with the forces
    found. Its friction levels absorb misfit too (a run may seem to have a twentieth of the friction). Therefore the
    search first starts where all runs have one level, and the scatter of the levels is estimated again with the forces.
    If significant forces remain, the misfit is not local, and the search starts at the fit.

    Parameters
    ----------
    solution
        The fit.
    explained
        The fit with forces more that explain everything; the model is then refitted together with these.

    Returns
    -------
    LocalForces
        The finished search.

    """
    if explained is not None and (refitted := _refitted_with_known_forces(solution, explained)) is not None:
        return continue_search(start_search(model_projection(refitted)))
    law = model_projection(solution)
    if _misfit(law) <= MIN_REDUCED_CHI2_REFITTED or not all(type(p) is Piece for p in solution.problem.pieces):
        return continue_search(start_search(law))
    found = _search_and_refit(model_projection(fit_at_one_level(solution)), solution.problem, estimate_scatter=True)
    return found if found.bumps and found.complete else _search_and_refit(law, solution.problem, estimate_scatter=False)


def _refitted_with_known_forces(solution: Solution, explained: Solution) -> Solution | None:
    """The model refitted together with the forces that a larger one adds; None where it differs in something else."""
    names = set(explained.problem.model.names) - set(solution.problem.model.names)
    added = [e for e in explained.problem.model.effects if e.name in names]
    if not added or any(e.acts_on != "force" or e.modifies or e.replaces for e in added):
        return None
    forces = [np.sum([effect_force_at_nodes(explained, r, e.name) for e in added], axis=0) for r in explained.responses]
    if any(len(f) != len(p.panels.t) for f, p in zip(forces, solution.problem.pieces, strict=True)):
        return None
    try:
        return refit_with_forces(solution, solution.problem, forces, estimate_scatter=True)
    except FrictrackError:
        return None


def _search_and_refit(law: ModelProjection, bare: LeastSquaresProblem, *, estimate_scatter: bool) -> LocalForces:
    """Search, refit the model together with what is found, and search on; see `refit_with_forces`."""
    found = continue_search(start_search(law))
    for _ in range(MAX_REFITS):
        if not found.bumps or _misfit(found.law) <= MIN_REDUCED_CHI2_REFITTED:
            break
        found = continue_search(_refit(found, bare, estimate_scatter=estimate_scatter))
    return found


def _misfit(law: ModelProjection) -> float:
    """Reduced chi-squared of the residual."""
    return float(law.r @ law.r) / len(law.r)


def continue_search(found: LocalForces) -> LocalForces:
    """Add bumps while significant ones remain."""
    for _ in range(MAX_ROUNDS):
        starts, p_remaining = _strongest_bumps(found)
        found = replace(found, p_remaining=p_remaining)
        if not starts:
            return found
        tried = [_fit_bumps(replace(found, bumps=[*found.bumps, *more])) for more in starts]
        found = _prune(min(tried, key=lambda f: float(f.residual.r @ f.residual.r)))
    return replace(found, p_remaining=_strongest_bumps(found)[1])


def _refit(found: LocalForces, bare: LeastSquaresProblem, *, estimate_scatter: bool) -> LocalForces:
    """Refit the model together with the bumps found, and search on in what both leave."""
    forces = [
        sum((b.size * at.force(b) for b in found.bumps if b.piece in (None, i)), np.zeros(len(at.t)))
        for i, at in enumerate(found.nodes)
    ]
    try:
        refitted = refit_with_forces(found.law.solution, bare, forces, estimate_scatter=estimate_scatter)
    except FrictrackError:  # a law so wild that its motion cannot be integrated
        return found
    return _prune(_fit_bumps(replace(start_search(model_projection(refitted)), bumps=found.bumps)))


def _strongest_bumps(found: LocalForces) -> tuple[list[list[Bump]], float]:
    """Return the most significant bumps as sets to start from, and the p-value of the most significant one.

    The sets hold one place for all runs, at the best centre of every width, or bumps in time, at most one per piece.
    Bumps in time are added one by one, because the model's error in one run affects all runs.
    """
    residual, moments, p_remaining = found.residual, list[Bump](), 1.0
    while True:
        present = replace(found, residual=residual, bumps=[*found.bumps, *moments])
        moment = _strongest_moment(present, {b.piece for b in moments})
        places = [] if moments or len(residual.rows) < 2 else _strongest_places(present)
        best = max(places, key=lambda b: b.z, default=moment)
        if places and found.significance(best.z) < ALPHA and best.z**2 > moment.z**2 + MIN_CHI2_GAIN_PLACE:
            return [[b] for b in places if found.significance(b.z) < ALPHA], found.significance(best.z)
        p_remaining = min(p_remaining, present.significance(moment.z))
        if not present.is_credible(moment):
            return [moments] if moments else [], p_remaining
        moments.append(moment)
        residual = residual.with_columns(bump_columns(found, [moment])[:, :, 0])


def _strongest_moment(found: LocalForces, done: set[int | None]) -> Bump:
    """The most significant bump in time over the pieces not yet done; the shortest of about equal ones."""
    time_norms = found.dictionary.time_norms(found.residual)
    best = [Bump(0, 0.0, 1.0)]
    for i, rows in enumerate(found.residual.rows):
        if i not in done:
            z = np.abs(quotients(found.dictionary.time_columns[i].T @ found.residual.r[rows], time_norms[i]))
            k = int(np.argmax(z**2 >= np.max(z) ** 2 - MIN_CHI2_GAIN_LONGER))
            best.append(replace(found.dictionary.time_bumps[i][k], z=float(z[k])))
    return max(best, key=lambda b: b.z)


def _strongest_places(found: LocalForces) -> list[Bump]:
    """The most significant place for every width."""
    residual, dictionary = found.residual, found.dictionary
    common = dictionary.place_norms(residual)
    dots = np.sum(
        [c.T @ residual.r[rows] for rows, c in zip(residual.rows, dictionary.place_columns, strict=True)], axis=0
    )
    z = np.abs(quotients(dots, common))
    best = [s.start + int(np.argmax(z[s])) for s in families(dictionary.place_bumps)]
    return [replace(dictionary.place_bumps[k], z=float(z[k])) for k in best]


def bump_columns(found: LocalForces, bumps: Sequence[Bump], *, derivatives: bool = True) -> Array:
    """Traces of bumps in the displacement.

    Parameters
    ----------
    found
        The search.
    bumps
        Its K bumps, or others.
    derivatives
        Whether to add derivatives by centre and by log width.

    Returns
    -------
    ndarray, shape (N + m, K, 1) or (N + m, K, 3)
        Traces per unit of size over all frames.

    """
    law = found.law
    out = np.zeros((len(law.r), len(bumps), 3 if derivatives else 1))
    for i, (rows, response, at) in enumerate(zip(law.rows, law.responses, found.nodes, strict=True)):
        present = [k for k, b in enumerate(bumps) if b.piece in (None, i)]
        if present:
            force = [at.force_derivatives(bumps[k]) if derivatives else at.force(bumps[k])[:, None] for k in present]
            out[rows, present] = displacement_response(response, np.concatenate(force, axis=1)).reshape(
                -1, len(present), out.shape[2]
            )
    return out


def _fit_bumps(found: LocalForces, steps: int = 6) -> LocalForces:
    """Refine sizes, centres and widths of all bumps together with the model (Levenberg-Marquardt)."""
    bumps = found.bumps
    columns = bump_columns(found, bumps)
    sizes, chi2 = solve_sizes(found.law, columns[:, :, 0])
    damping = 1e-2
    for _ in range(steps):
        candidate = _damped_step(found, bumps, columns, sizes, damping)
        tried = bump_columns(found, candidate)
        new_sizes, new = solve_sizes(found.law, tried[:, :, 0])
        if new < chi2:
            gained, damping = chi2 - new, damping / 10
            bumps, columns, sizes, chi2 = candidate, tried, new_sizes, new
            if gained < 0.1:
                break
        else:
            damping *= 30
    residual = found.law.with_columns(columns[:, :, 0])
    return replace(found, bumps=_with_sizes(found.law, columns[:, :, 0], bumps, sizes), residual=residual)


def solve_sizes(law: ModelProjection, columns: Array) -> tuple[Array, float]:
    """Fit sizes of columns together with the model by least squares.

    Parameters
    ----------
    law
        Residual and directions of the model.
    columns
        Traces, (N + m, K).

    Returns
    -------
    sizes : ndarray, shape (K,)
    chi2 : float

    """
    clean = columns - law.u @ (law.u.T @ columns)
    sizes, *_ = np.linalg.lstsq(clean, law.r, rcond=1e-10)
    residual = law.r - clean @ sizes
    return np.asarray(sizes, dtype=np.float64), float(residual @ residual)


def _damped_step(found: LocalForces, bumps: Sequence[Bump], columns: Array, sizes: Array, damping: float) -> list[Bump]:
    """Return the bumps after one damped step of sizes, centres and widths."""
    law, k = found.law, len(bumps)
    scale = np.array([b.width for b in bumps])
    jac = np.concatenate([columns[:, :, 0], columns[:, :, 1] * sizes * scale, columns[:, :, 2] * sizes], axis=1)
    jac -= law.u @ (law.u.T @ jac)
    residual = law.r - jac[:, :k] @ sizes
    norm = np.linalg.norm(jac, axis=0)
    norm[norm == 0] = 1.0
    hold = np.concatenate([np.zeros(k), np.full(k, np.sqrt(damping)), np.full(k, np.sqrt(damping))])
    unit = np.vstack([jac / norm, np.diag(hold), np.diag(np.concatenate([np.zeros(2 * k), np.ones(k)]) / norm)])
    step = np.linalg.lstsq(unit, np.concatenate([residual, np.zeros(6 * k)]), rcond=1e-12)[0] / norm
    out = []
    for j, b in enumerate(bumps):
        low, high = width_limits(found.law.responses, b)
        centre = b.centre + b.width * float(np.clip(step[k + j], -3, 3))
        width = b.width * float(np.exp(np.clip(step[2 * k + j], -0.7, 0.7)))
        out.append(replace(b, centre=centre, width=float(np.clip(width, low, high))))
    return out


def _with_sizes(law: ModelProjection, columns: Array, bumps: Sequence[Bump], sizes: Array) -> list[Bump]:
    """Return the bumps with their sizes and their joint significance."""
    clean = columns - law.u @ (law.u.T @ columns)
    inverse = np.linalg.pinv(clean.T @ clean)
    deviation = np.sqrt(np.maximum(np.diag(inverse), 0.0))
    z = np.divide(sizes, deviation, out=np.zeros(len(bumps)), where=deviation > 0)  # 0: the runs do not see it
    return [replace(b, size=float(s), z=float(q)) for b, s, q in zip(bumps, sizes, z, strict=True)]


def _prune(found: LocalForces) -> LocalForces:
    """Remove bumps that are no longer significant, or that carry almost none of the misfit."""
    if not found.bumps:
        return found
    total = float(found.law.r @ found.law.r - found.residual.r @ found.residual.r)
    kept = [b for b in found.bumps if found.is_credible(b) and b.z**2 > MIN_SHARE_PER_BUMP * total]
    if len(kept) == len(found.bumps) or not kept:
        return found
    return _prune(_fit_bumps(replace(found, bumps=kept), steps=3))


def bump_forces(found: LocalForces) -> tuple[list[Array], list[Array]]:
    """Force of all bumps, and its variance.

    Parameters
    ----------
    found
        A finished search.

    Returns
    -------
    forces : list of ndarray
        Force at the frames of every piece, N, (n,).
    variances : list of ndarray
        Its variance from size, centre and width, N^2, (n,).

    """
    bumps, law, k = found.bumps, found.law, len(found.bumps)
    if not bumps:
        zeros = [np.zeros(len(r.piece.t)) for r in law.responses]
        return zeros, zeros
    sizes = np.array([b.size for b in bumps])
    scale = np.stack([np.ones(k), sizes, sizes], axis=1)
    columns = (bump_columns(found, bumps) * scale).reshape(len(law.r), -1)
    clean = columns - law.u @ (law.u.T @ columns)
    prior = np.zeros(3 * k)
    prior[2::3] = 1.0  # a width that the runs do not determine is known within a factor of e
    covariance = np.linalg.pinv(clean.T @ clean + np.diag(prior), hermitian=True)
    forces, variances = [], []
    for i, (response, at) in enumerate(zip(law.responses, found.nodes, strict=True)):
        present = np.array([b.piece in (None, i) for b in bumps])
        derivatives = np.stack([at.force_derivatives(b) for b in bumps], axis=1) * present[:, None] * scale
        flat = np.stack([np.interp(response.piece.t, at.t, q) for q in derivatives.reshape(len(at.t), -1).T], axis=1)
        forces.append(flat[:, ::3] @ sizes)
        variances.append(np.einsum("nj,jk,nk->n", flat, covariance, flat))
    return forces, variances
