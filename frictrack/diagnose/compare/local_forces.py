"""Find local forces that a fitted model lacks: their place or time, width, size and significance.

A local force is a Gaussian bump at one time of one run, or at one place of the course with one size for all runs.
The search is a sliding Frank-Wolfe algorithm on the model linearised about the measured motion, where a misfit of any
size leaves places and times as they are. It adds the most significant bump, refines centres and widths of all bumps
together, and continues in the residual. It works on the displacement, where the noise is white.

Tests along a continuous setting, such as the place of a bump, form a smooth random process. The probability that it
exceeds a level u is at most the probability that it starts above u, plus the expected number of upcrossings. The latter
is the Gaussian tail factor of u times the length of the curve that the normalised traces draw on the unit sphere, over
pi. Bumps of one width are one such curve; curves add up (Bonferroni). An estimated noise level makes the tail that of
Student's t.

References
----------
Denoyelle, Duval, Peyre & Soubies (2020), Inverse Problems 36, 014001.
Kaufman (1975), BIT 15, 49-57 (variable projection).
Hotelling (1939), Am. J. Math. 61, 440-460.
Knowles & Siegmund (1989), Int. Statist. Rev. 57, 205-220.

"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.optimize import least_squares

from frictrack.base.distributions import student_sf
from frictrack.base.errors import FrictrackError
from frictrack.effects import Path
from frictrack.fit.least_squares import (
    ModelProjection,
    Solution,
    fit_with_scatter,
    hold,
    model_projection,
    position_and_velocity,
)
from frictrack.fit.linearised import LinearisedModel, LinearisedPiece, linearise
from frictrack.fit.pieces import Piece
from frictrack.measure.motion import CORRELATION_COST
from frictrack.records import Array

ALPHA = 0.01  # significance level of the whole search
MAX_ROUNDS = 4  # of adding bumps
MAX_STEPS = 6  # of refining bumps
MIN_CHI2_FALL = 0.1  # of a step of refining them
MIN_REDUCED_CHI2_FAR = 1.5  # above it the friction levels, and the model's other parameters, may absorb misfit
MIN_SHARE_LOCAL = 0.5  # of the misfit that bumps explain together, above which the model is refitted with them
MAX_REFIT_STEPS = 6
MIN_LEVEL_SCATTER = 1e-3  # relative; with less, all runs have one friction level
MIN_SHARE_PER_BUMP = 0.02  # of the chi-squared that all bumps explain
MIN_CHI2_GAIN_PLACE = 10.0  # by which one place must gain more than a bump in time of one run
MIN_CHI2_GAIN_LONGER = 6.6  # by which a longer bump must gain more than a shorter one


@dataclass(frozen=True, eq=False)
class LocalForces:
    """State of a search for local forces: the bumps found, and the model with and without them."""

    bumps: list[Bump]  # found so far
    law: ModelProjection  # residual and directions of the model without the bumps, about the measured motion
    residual: ModelProjection  # the same with the bumps
    solution: Solution  # the fit, or the model refitted together with the bumps, without them
    model: LinearisedModel  # its linearisation, with maps from forces along the measured motion to traces
    grids: list[BumpGrid]  # bumps that may be added: in time of every piece, and in place
    p_remaining: float = 1.0  # of the most significant bump that remains

    @cached_property
    def significance(self) -> GlobalSignificance:
        """Significance of the whole search."""
        parts = [grid.significance for grid in self.grids]
        return GlobalSignificance(sum(p.length for p in parts), sum(p.families for p in parts), parts[-1].dof)

    def p(self, bump: Bump) -> float:
        """p-value of a bump in the whole search."""
        return self.significance(bump.z)

    @property
    def complete(self) -> bool:
        """Whether no significant bump remains."""
        return self.p_remaining >= ALPHA

    @property
    def explained(self) -> float:
        """Chi-squared that the bumps explain."""
        return float(self.law.r @ self.law.r - self.residual.r @ self.residual.r)


def start_search(solution: Solution, kept: Sequence[int] | None = None) -> LocalForces:
    """Prepare a search for local forces in the residual of a fit, with all of its unknowns or those `kept`."""
    model = linearise(solution)
    law = model_projection(model.solution, kept)
    return LocalForces([], law, law, solution, model, bump_grids(law, model.pieces))


def find_local_forces(solution: Solution) -> LocalForces:
    """Find the local forces in the residual of a fit.

    Friction levels absorb misfit too: without a strong effect, a run may seem to have a twentieth of the friction. A
    large misfit is therefore first searched where all runs have one level. If the forces found explain most of it, the
    model and the scatter of the levels are refitted together with them. If significant forces remain, the misfit is not
    local, and the search starts at the scatter of the fit.
    """
    start = start_search(solution)
    if start.law.r @ start.law.r <= MIN_REDUCED_CHI2_FAR * len(start.law.r):
        return continue_search(start)
    found = continue_search(_with_scatter(start, MIN_LEVEL_SCATTER) if solution.levels_are_random else start)
    if found.bumps and found.explained > MIN_SHARE_LOCAL * float(found.law.r @ found.law.r):
        found = continue_search(_refitted(found))
    return found if found.complete or not solution.levels_are_random else continue_search(start)


def _with_scatter(start: LocalForces, tau: float) -> LocalForces:
    """The same start of a search at another scatter of the friction levels."""
    model = replace(start.model, solution=start.model.solution.with_scatter(tau))
    law = model_projection(model.solution)
    grids = [replace(grid, model=law) for grid in start.grids]
    return LocalForces([], law, law, start.solution.with_scatter(tau), model, grids)


def _refitted(found: LocalForces) -> LocalForces:
    """The search in the model refitted together with the bumps; the same where no motion can be integrated."""
    solution = found.solution
    if not all(type(p) is Piece for p in solution.problem.pieces):
        return found
    pieces = []
    for i, (piece, along) in enumerate(zip(solution.problem.pieces, found.model.pieces, strict=True)):
        force = sum((b.size * b.derivatives(along.path)[0] for b in found.bumps if b.acts_in(i)), 0.0 * along.path.t)
        known = piece.known - np.interp(piece.panels.t, along.path.t, force) / piece.mass
        pieces.append(replace(piece, known=known))
    bare = solution.problem
    try:
        fit = fit_with_scatter(
            bare.rebuild(bare.layout, pieces), solution.p, solution.starts, solution.tau, max_steps=MAX_REFIT_STEPS
        )
        start = start_search(hold(bare, fit.p, fit.starts, max(fit.tau, MIN_LEVEL_SCATTER)))
    except FrictrackError:
        return found
    return _prune(_fit_bumps(replace(start, bumps=found.bumps)))


def continue_search(found: LocalForces) -> LocalForces:
    """Add bumps while significant ones remain."""
    for _ in range(MAX_ROUNDS):
        starts, p_remaining = _strongest_bumps(found)
        found = replace(found, p_remaining=p_remaining)
        if not starts:
            return found
        tried = [_fit_bumps(replace(found, bumps=[*found.bumps, *more])) for more in starts]
        found = _prune(max(tried, key=lambda f: f.explained))
    return replace(found, p_remaining=_strongest_bumps(found)[1])


def _strongest_bumps(found: LocalForces) -> tuple[list[list[Bump]], float]:
    """Return the most significant bumps as sets to start from, and the p-value of the most significant one.

    The sets hold one place for all runs, at the best centre of every width, or bumps in time, at most one per piece.
    Bumps in time are added one by one, because the model's error in one run affects all runs.
    """
    places = [] if len(found.law.rows) < 2 else _strongest_places(found)
    moments, p_remaining = list[Bump](), 1.0
    while True:
        moment = _strongest_moment(found, {b.piece for b in moments})
        best = max(places, key=lambda b: b.z, default=moment)
        if places and found.p(best) < ALPHA and best.z**2 > moment.z**2 + MIN_CHI2_GAIN_PLACE:
            return [[b] for b in places if found.p(b) < ALPHA], found.p(best)
        p_remaining = min(p_remaining, found.p(moment))
        if found.p(moment) >= ALPHA:
            return [moments] if moments else [], p_remaining
        moments.append(moment)
        columns = bump_columns(found, [moment], derivatives=False)[:, :, 0]
        found = replace(found, residual=found.residual.with_columns(columns), bumps=[*found.bumps, moment])
        places = []


def _strongest_moment(found: LocalForces, done: set[int | None]) -> Bump:
    """The most significant bump in time over the pieces not yet done; the shortest of about equal ones."""
    best = [Bump(0, 0.0, 1.0)]
    for i, grid in enumerate(found.grids[:-1]):
        if i not in done:
            z = np.abs(grid.significances(found.residual))
            k = int(np.argmax(z**2 >= np.max(z) ** 2 - MIN_CHI2_GAIN_LONGER))
            best.append(replace(grid.bumps[k], z=float(z[k])))
    return max(best, key=lambda b: b.z)


def _strongest_places(found: LocalForces) -> list[Bump]:
    """The most significant place for every width."""
    grid = found.grids[-1]
    z = np.abs(grid.significances(found.residual))
    best = [s.start + int(np.argmax(z[s])) for s in grid.families]
    return [replace(grid.bumps[k], z=float(z[k])) for k in best]


def bump_columns(found: LocalForces, bumps: Sequence[Bump], *, derivatives: bool = True) -> Array:
    """Traces of K bumps per unit of size over all frames, with derivatives by centre and log width, (N + m, K, 3)."""
    count = 3 if derivatives else 1
    out = np.zeros((len(found.law.r), len(bumps), count))
    for i, (rows, piece) in enumerate(zip(found.law.rows, found.model.pieces, strict=True)):
        acting = [k for k, b in enumerate(bumps) if b.acts_in(i)]
        if acting:
            forces = np.concatenate([bumps[k].derivatives(piece.path)[:count] for k in acting])
            out[rows, acting] = piece.data_of(forces, is_measurement=False).T.reshape(-1, len(acting), count)
    return out


def _fit_bumps(found: LocalForces) -> LocalForces:
    """Refine centres and widths of all bumps; sizes and model are solved for each (variable projection)."""
    law, bumps, k = found.law, found.bumps, len(found.bumps)
    narrowest, widest = np.array([width_limits(law, b) for b in bumps]).T
    first = np.array([b.width for b in bumps])
    varies = narrowest < widest
    limits = np.log([narrowest[varies], widest[varies]])
    computed: dict[bytes, tuple[Array, Array]] = {}

    def moved(theta: Array) -> list[Bump]:  # centres in first widths, then log widths
        widths = first.copy()
        widths[varies] = np.exp(theta[k:])
        pairs = zip(bumps, theta[:k] * first, widths, strict=True)
        return [replace(b, centre=b.centre + float(shift), width=float(width)) for b, shift, width in pairs]

    def traces(theta: Array) -> tuple[Array, Array]:
        if theta.tobytes() not in computed:
            columns = bump_columns(found, moved(theta))
            columns = without_model(law, columns.reshape(len(columns), -1)).reshape(columns.shape)
            computed[theta.tobytes()] = columns, solve_sizes(law, columns[:, :, 0])
        return computed[theta.tobytes()]

    def residual(theta: Array) -> Array:
        columns, sizes = traces(theta)
        return law.r - columns[:, :, 0] @ sizes

    def jacobian(theta: Array) -> Array:
        columns, sizes = traces(theta)
        q, _ = np.linalg.qr(columns[:, :, 0])
        slopes = np.concatenate([columns[:, :, 1] * sizes * first, (columns[:, :, 2] * sizes)[:, varies]], axis=1)
        return np.asarray(q @ (q.T @ slopes) - slopes)

    start = np.concatenate([np.zeros(k), np.clip(np.log(first[varies]), *limits)])
    free = np.full(k, np.inf)
    bounds = np.concatenate([-free, limits[0]]), np.concatenate([free, limits[1]])
    theta = least_squares(
        residual, start, jacobian, bounds, ftol=MIN_CHI2_FALL / float(law.r @ law.r), xtol=None, gtol=None,
        max_nfev=MAX_STEPS + 1,
    ).x  # fmt: skip
    columns, sizes = traces(theta)
    z = joint_significance(law, columns[:, :, 0])
    fitted = [replace(b, size=float(s), z=float(q)) for b, s, q in zip(moved(theta), sizes, z, strict=True)]
    return replace(found, bumps=fitted, residual=law.with_columns(columns[:, :, 0]))


def solve_sizes(law: ModelProjection, columns: Array) -> Array:
    """Fit sizes (K,) of columns (N + m, K) together with the model."""
    return np.asarray(np.linalg.lstsq(without_model(law, columns), law.r, rcond=1e-10)[0], dtype=np.float64)


def joint_significance(law: ModelProjection, columns: Array) -> Array:
    """Significance of each column (N + m, k) with model and other columns free, in standard deviations.

    It is 0 for a column that the runs do not see.
    """
    clean = without_model(law, columns)
    inverse = np.linalg.pinv(clean.T @ clean, hermitian=True)
    deviation = np.sqrt(np.maximum(np.diag(inverse), 0.0))
    return np.divide(inverse @ (clean.T @ law.r), deviation, out=np.zeros(len(inverse)), where=deviation > 0)


def without_model(law: ModelProjection, columns: Array) -> Array:
    """Project the model out of columns (N + m, k)."""
    return np.asarray(columns - law.u @ (law.u.T @ columns))


def _prune(found: LocalForces) -> LocalForces:
    """Remove bumps that are no longer significant, or that carry almost none of the misfit."""
    kept = [b for b in found.bumps if found.p(b) < ALPHA and b.z**2 > MIN_SHARE_PER_BUMP * found.explained]
    if len(kept) == len(found.bumps) or not kept:
        return found
    return _prune(_fit_bumps(replace(found, bumps=kept)))


MIN_WIDTH_FRAMES = 2.0  # frames; a narrower bump leaves the same trace
MAX_WIDTH_DURATION_SHARE = 1 / 12  # of a piece's duration; a wider bump is no local force
MIN_WIDTH_COURSE_SHARE, MAX_WIDTH_COURSE_SHARE = 1 / 120, 1 / 8  # of the course, for bumps in place
WIDTH_RATIO = 2.5  # between two widths of the search
MAX_CENTRES = 250  # along a piece or along the course
MIN_SPACING_FRAMES = 4.0  # frames between two centres; a displacement has no sharper bend
MIN_VISIBLE_SHARE = 1e-3  # of a trace's square that must remain outside the model


@dataclass(frozen=True)
class Bump:
    """A Gaussian force in time or in place."""

    piece: int | None  # index of its piece for a bump in time; None for a bump at a place, common to all runs
    centre: float  # s since release, or m
    width: float  # standard deviation
    size: float = 0.0  # peak force, N; for a place at the reference load
    z: float = 0.0  # size in units of its standard deviation

    @property
    def at_place(self) -> bool:
        """Whether it is a bump at a place of the course."""
        return self.piece is None

    def acts_in(self, piece: int) -> bool:
        """Whether it acts in a piece."""
        return self.piece in (None, piece)

    def derivatives(self, path: Path) -> Array:
        """Force of a bump of size one along a path, and its derivatives by centre and by log width, (3, m)."""
        u = ((path.x if self.at_place else path.t) - self.centre) / self.width
        force = np.exp(-(u**2) / 2) * (path.load * path.s if self.at_place else 1.0)
        return np.stack([force, force * u / self.width, force * u**2])


@dataclass(frozen=True)
class GlobalSignificance:
    """Significance of a whole search.

    Examples
    --------
    >>> single = GlobalSignificance(length=0.0, families=1, dof=1e6)
    >>> round(single(3.0), 4)
    0.0027

    """

    length: float  # of all curves that the normalised traces of a family draw on the unit sphere
    families: int
    dof: float  # degrees of freedom of the noise estimate

    def __call__(self, z: float) -> float:
        """Return an upper bound on the probability that noise alone reaches |z| standard deviations anywhere."""
        rising = self.length / np.pi * float(np.exp(-(self.dof - 1) / 2 * np.log1p(z**2 / self.dof)))
        begun = 2 * self.families * float(student_sf(abs(z), self.dof))
        return float(min(1.0, max(rising + begun, np.finfo(float).tiny)))


@dataclass(frozen=True, eq=False)
class BumpGrid:
    """Bumps at all times of one piece, or at all places of the course, with their traces, a model projected out."""

    bumps: list[Bump]  # one width after the other
    traces: list[tuple[slice, Array]]  # by piece in which they act: its rows, and the traces (K, n) there
    model: ModelProjection

    def products(self, columns: Array) -> Array:
        """Inner products (K, c) of the traces with columns (N + m, c)."""
        return np.asarray(np.sum([traces @ columns[rows] for rows, traces in self.traces], axis=0))

    @cached_property
    def _on_model(self) -> Array:
        return self.products(self.model.u)

    @cached_property
    def _squares(self) -> Array:
        return np.asarray(np.sum([np.einsum("kn,kn->k", traces, traces) for _, traces in self.traces], axis=0))

    def norms(self, law: ModelProjection) -> Array:
        """Norms (K,) of the traces outside a model with further columns, `law`; 0 where little is left of a trace."""
        further = self.products(law.u[:, self.model.u.shape[1] :])
        left = self._squares - np.sum(self._on_model**2, axis=1) - np.sum(further**2, axis=1)
        return np.where(left > MIN_VISIBLE_SHARE * self._squares, np.sqrt(np.maximum(left, 0.0)), 0.0)

    def significances(self, law: ModelProjection) -> Array:
        """Sizes (K,) of all bumps added to a model, each alone, in standard deviations."""
        norms = self.norms(law)
        dots = self.products(law.r[:, None])[:, 0]
        return np.divide(dots, norms, out=np.zeros_like(dots), where=norms > 0)

    @property
    def families(self) -> list[slice]:
        """Slices of consecutive bumps of equal width."""
        cuts = [k for k in range(1, len(self.bumps)) if self.bumps[k].width != self.bumps[k - 1].width]
        return [slice(a, b) for a, b in itertools.pairwise([0, *cuts, len(self.bumps)])]

    @cached_property
    def significance(self) -> GlobalSignificance:
        """Significance of a search over these bumps."""
        norms = self.norms(self.model)
        parts = [(traces, 1.0) for _, traces in self.traces] + [(self._on_model, -1.0)]
        length = sum(curve_length([(p[s], sign) for p, sign in parts], norms[s]) for s in self.families)
        frames = float(np.mean([rows.stop - rows.start for rows in self.model.rows]))
        return GlobalSignificance(length, len(self.families), max(frames / CORRELATION_COST, 3.0))


def curve_length(parts: Sequence[tuple[Array, float]], norms: Array) -> float:
    """Length of the curve that normalised traces draw on the unit sphere: the sum of angles between neighbours, rad.

    The traces consist of blocks (k, n_i), each with the sign with which it enters the inner products; those of norm 0
    are left out.

    Examples
    --------
    >>> round(curve_length([(np.eye(2), 1.0)], np.ones(2)), 4)
    1.5708

    """
    kept = np.flatnonzero(norms > 0)
    inner = sum(sign * np.einsum("kn,kn->k", rows[kept[1:]], rows[kept[:-1]]) for rows, sign in parts)
    return float(np.sum(np.arccos(np.clip(inner / (norms[kept[1:]] * norms[kept[:-1]]), -1.0, 1.0))))


def bump_grid(law: ModelProjection, pieces: Sequence[LinearisedPiece], bumps: list[Bump]) -> BumpGrid:
    """Trace bumps of one kind, in time of one piece or in place."""
    traces, place = [], bumps[0].at_place
    centre, width = np.array([[b.centre, b.width] for b in bumps]).T[:, :, None]
    for i, (rows, piece) in enumerate(zip(law.rows, pieces, strict=True)):
        if bumps[0].acts_in(i):
            shapes = np.exp(-((((piece.path.x if place else piece.path.t) - centre) / width) ** 2) / 2)
            traces.append(
                (
                    rows,
                    piece.data_of(shapes * (piece.path.load * piece.path.s) if place else shapes, is_measurement=False),
                )
            )
    return BumpGrid(bumps, traces, law)


def bump_grids(law: ModelProjection, pieces: Sequence[LinearisedPiece]) -> list[BumpGrid]:
    """Make the grids of bumps at all times of every piece, and after them that of bumps at all places."""
    in_time = [_bumps_in_time(i, piece.response.piece.t) for i, piece in enumerate(pieces)]
    return [bump_grid(law, pieces, bumps) for bumps in (*in_time, _bumps_in_place(*course_ends(law)))]


def _widths(narrowest: float, widest: float) -> list[float]:
    count = max(1, 1 + int(np.floor(np.log(max(widest / narrowest, 1.0)) / np.log(WIDTH_RATIO))))
    return [narrowest * WIDTH_RATIO**k for k in range(count)]


def _bumps_in_time(i: int, t: Array) -> list[Bump]:
    """Bumps at all times of a piece of frames at t (n,), at several widths."""
    step, length = float(np.median(np.diff(t))), float(t[-1] - t[0])
    out = []
    for width in _widths(MIN_WIDTH_FRAMES * step, MAX_WIDTH_DURATION_SHARE * length):
        apart = max(width, MIN_SPACING_FRAMES * step, length / MAX_CENTRES)
        inside = t[0] + MIN_SPACING_FRAMES * step, t[-1] - MIN_SPACING_FRAMES * step
        out += [Bump(i, float(c), width) for c in np.arange(*inside, apart)]
    return out or [Bump(i, float(t[0] + t[-1]) / 2, MIN_WIDTH_FRAMES * step)]  # a piece of a few frames


def _bumps_in_place(low: float, high: float) -> list[Bump]:
    """Bumps at all places of the course, at several widths."""
    widths = _widths(MIN_WIDTH_COURSE_SHARE * (high - low), MAX_WIDTH_COURSE_SHARE * (high - low))
    spacing = (high - low) / MAX_CENTRES
    return [Bump(None, float(c), width) for width in widths for c in np.arange(low, high, max(width, spacing))]


def course_ends(law: ModelProjection) -> tuple[float, float]:
    """Smallest and largest position of all runs, m."""
    x = np.concatenate([position_and_velocity(r)[0] for r in law.responses])
    return float(x.min()), float(x.max())


def width_limits(law: ModelProjection, bump: Bump) -> tuple[float, float]:
    """Smallest and largest width to which a bump may be refined; the same in a piece of few frames."""
    if bump.piece is None:
        low, high = course_ends(law)
        return MIN_WIDTH_COURSE_SHARE * (high - low), MAX_WIDTH_COURSE_SHARE * (high - low)
    t = law.responses[bump.piece].piece.t
    narrowest = MIN_WIDTH_FRAMES * float(np.median(np.diff(t)))
    return narrowest, max(narrowest, 2 * MAX_WIDTH_DURATION_SHARE * float(t[-1] - t[0]))
