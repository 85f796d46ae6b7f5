"""Find local forces that a fitted model lacks: their place or time, width, size and significance.

A local force is a Gaussian bump: at one place of the course, of one size for all runs, or at one moment of one run.
Bumps are effects like any other, added to the model along the measured motion, where a misfit of any size leaves places
and times as they are: the most significant one is scanned, all are refined together, and so on in what they leave.

The size z(c) of a bump at c, in standard deviations, is a smooth random process. The probability that |z| exceeds a
level u somewhere is at most that of beginning above u, plus the expected number of upcrossings: the Gaussian tail
factor of u times the length of the curve that the normalised columns draw on the unit sphere, over pi. That length is
the variation of z from one c to the next, over its mean in noise (Davies). Bumps of one width are one such curve;
curves add up (Bonferroni). An estimated noise level makes the tail that of Student's t.

References
----------
Davies (1987), Biometrika 74, 33-43.
Denoyelle, Duval, Peyre & Soubies (2020), Inverse Problems 36, 014001.

"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from frictrack.base.distributions import student_sf
from frictrack.base.errors import FrictrackError
from frictrack.effects import LIBRARY, Effect, Nonlinear, Path, Span
from frictrack.effects.models import Model
from frictrack.fit.least_squares import Solution, fit_with_scatter, hold
from frictrack.fit.linearised import LinearisedModel, linearise
from frictrack.fit.parameters import ParameterLayout
from frictrack.fit.pieces import Piece
from frictrack.fit.separable.projected import ProjectedProblem, SeparableSolution
from frictrack.fit.separable.varpro import ScanGains, ScanItem, VariableProjection
from frictrack.fit.stepwise import TiedSeparableModel
from frictrack.records import Array
from frictrack.sampling import CORRELATION_COST

ALPHA = 0.01  # significance level of the whole search
MAX_ROUNDS = 4  # of adding bumps
MAX_STEPS, MIN_FALL = 6, 1e-4  # of refining them: steps, and the predicted fall of one as a share of the misfit
MIN_REDUCED_CHI2_FAR = 1.5  # above it the friction levels, and the model's other parameters, may absorb misfit
MIN_SHARE_LOCAL = 0.5  # of the misfit that bumps explain together, above which the model is refitted with them
MAX_REFIT_STEPS = 6
MIN_LEVEL_SCATTER = 1e-3  # relative; with less, all runs have one friction level
MIN_SHARE_PER_BUMP = 0.02  # of the chi-squared that all bumps explain
MIN_CHI2_GAIN_PLACE = 10.0  # by which one place must gain more than a bump in time of one run
MIN_WIDTH_FRAMES = 2.0  # frames; a narrower bump leaves the same trace
MAX_WIDTH_DURATION_SHARE = 1 / 12  # of a run's duration; a wider bump is no local force
MIN_WIDTH_COURSE_SHARE, MAX_WIDTH_COURSE_SHARE = 1 / 120, 1 / 8  # of the course, for bumps in place
WIDTH_RATIO = 2.5  # between two widths of the search
MAX_CENTRES = 120  # along a run or along the course
MIN_SPACING_FRAMES = 4.0  # frames between two centres; a displacement has no sharper bend


@dataclass(frozen=True)
class Bump:
    """A Gaussian force: at a place of the course, or at a moment of one run."""

    run: int | None  # None at a place, common to all runs
    centre: float  # m, or s since release
    width: float  # standard deviation
    size: float  # peak force, N; for a place at the reference load
    z: float  # the same over its standard deviation

    @property
    def at_place(self) -> bool:
        """Whether it is a bump at a place of the course."""
        return self.run is None

    def acts_in(self, run: int) -> bool:
        """Whether it acts in a run."""
        return self.run in (None, run)

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

    length: float  # of all curves that the normalised columns of a family draw on the unit sphere
    families: int
    dof: float  # degrees of freedom of the noise estimate

    def __call__(self, z: float) -> float:
        """Return an upper bound on the probability that noise alone reaches |z| standard deviations anywhere."""
        rising = self.length / np.pi * float(np.exp(-(self.dof - 1) / 2 * np.log1p(z**2 / self.dof)))
        begun = 2 * self.families * float(student_sf(abs(z), self.dof))
        return float(min(1.0, max(rising + begun, np.finfo(float).tiny)))

    @classmethod
    def of_scans(cls, scans: Sequence[ScanGains], dof: float) -> GlobalSignificance:
        """The significance of some scans over centre and width."""
        sizes = [np.sqrt(np.maximum(scan.gains.reshape(scan.grid.shape), 0.0)) for scan in scans]
        variation = sum(float(np.sum(np.abs(np.diff(z, axis=0)))) for z in sizes)
        return cls(variation * np.sqrt(np.pi / 2), sum(z.shape[1] for z in sizes), dof)


@dataclass(frozen=True, eq=False)
class LocalForces:
    """State of a search for local forces: the model along the measured motion, with the bumps found so far."""

    model: LinearisedModel
    search: VariableProjection  # of the model with bumps that may be added
    bare: SeparableSolution  # without bumps
    state: SeparableSolution
    items: tuple[ScanItem, ...] = ()  # the bumps in it

    @property
    def problem(self) -> ProjectedProblem:
        """What is fitted."""
        return self.search.problem(self.search.separable.data)

    @property
    def solution(self) -> Solution:
        """The fit, or the model refitted together with the bumps, without them."""
        return self.model.solution

    @cached_property
    def bumps(self) -> list[Bump]:
        """The bumps found so far."""
        return [self._bump(item) for item in self.items]

    def _bump(self, item: ScanItem) -> Bump:
        (size,) = self.state.coefficients[item.coefficients].tolist()
        centre, width = (float(self.state.nonlinear_values[slots[0]]) for slots in item.slots)
        rise = self.problem.without(self.state, item.coefficients).misfit - self.state.misfit
        return Bump(item.run, centre, width, size, float(np.sqrt(max(rise, 0.0))))

    def gains(self, item: ScanItem) -> ScanGains:
        """What one more bump like an item gains, wherever it is."""
        return self.search.one_more(self.problem, self.state, item)

    @cached_property
    def significance(self) -> GlobalSignificance:
        """Significance of the whole search."""
        frames = self.search.separable.size / len(self.search.separable.blocks)
        kinds = {item.kind: item for item in self.search.items}
        return GlobalSignificance.of_scans([self.gains(i) for i in kinds.values()], max(frames / CORRELATION_COST, 3.0))

    def p(self, bump: Bump) -> float:
        """p-value of a bump in the whole search."""
        return self.significance(bump.z)

    def p_of_gain(self, gain: float) -> float:
        """p-value of the largest gain of a bump more."""
        return self.significance(float(np.sqrt(max(gain, 0.0))))

    @cached_property
    def complete(self) -> bool:
        """Whether no significant bump remains."""
        return all(self.p_of_gain(self.gains(item).largest) >= ALPHA for item in self.free_items())

    @property
    def explained(self) -> float:
        """Chi-squared that the bumps explain."""
        return self.bare.misfit - self.state.misfit

    def free_items(self) -> list[ScanItem]:
        """One bump of every kind that can be added."""
        return list({i.kind: i for i in reversed(self.search.items) if i not in self.items}.values())

    def with_bumps(self, values: Mapping[ScanItem, Array]) -> LocalForces:
        """The same with more bumps, centre and width (2,) each."""
        state = self.search.with_items_at(self.problem, self.state, values)
        return replace(self, state=state, items=(*self.items, *values))

    def refined(self, below: float = np.inf) -> LocalForces:
        """The same with centres and widths of all bumps refined, and the model with them, if it may fall `below`."""
        groups = self.search.groups_without(self.search.items) | {i.g for i in self.items}
        state = self.problem.refine(self.state, groups, steps=MAX_STEPS, enough=MIN_FALL, below=below)
        return replace(self, state=state)


def _pulse(path: Path, nonlinear: Nonlinear) -> Array:
    """Pulse of size one at `time`, standard deviation `width`, shape (n, 1)."""
    return np.asarray(np.exp(-(((path.t - nonlinear["time"]) / nonlinear["width"]) ** 2) / 2)[:, None])


def _widths(narrowest: float, widest: float) -> Array:
    count = 1 + int(np.floor(np.log(max(widest / narrowest, 1.0)) / np.log(WIDTH_RATIO)))
    return np.asarray(narrowest * WIDTH_RATIO ** np.arange(count))


def _moments(span: Span) -> Array:
    """Centres in time of a run, s."""
    edge = min(MIN_SPACING_FRAMES / span.fps, span.duration / 2)
    apart = max(MIN_SPACING_FRAMES / span.fps, span.duration / MAX_CENTRES)
    return np.linspace(edge, span.duration - edge, max(2, round(span.duration / apart)))


def _durations(span: Span) -> Array:
    """Widths in time, s."""
    return _widths(MIN_WIDTH_FRAMES / span.fps, MAX_WIDTH_DURATION_SHARE * span.duration)


def _places(span: Span) -> Array:
    """Centres on the course, m."""
    return np.linspace(span.x_min, span.x_max, MAX_CENTRES)


def _lengths(span: Span) -> Array:
    """Widths on the course, m."""
    course = span.x_max - span.x_min
    return _widths(MIN_WIDTH_COURSE_SHARE * course, MAX_WIDTH_COURSE_SHARE * course)


def _bump_effects(layout: ParameterLayout) -> list[Effect]:
    """Effects for all bumps that may be added to a model, their centres and widths scanned."""
    blow = replace(LIBRARY["collision"], columns=_pulse)
    kinds = {"place": (LIBRARY["patch"], _places, _lengths), "moment": (blow, _moments, _durations)}
    out = []
    for kind, (effect, *scans) in kinds.items():
        parameters = [replace(p, per_run=effect.single) for p in effect.linear]
        for p, scan in zip(effect.nonlinear, scans, strict=True):
            ends = np.concatenate([scan(span) for span in (layout.span, *layout.spans)])
            bounds = float(ends.min()), float(ends.max())
            parameters.append(replace(p, per_run=effect.single, scan=scan, bounds=bounds))
        for k in range(MAX_ROUNDS):
            out.append(replace(effect, name=f"{kind}:{k + 1}", replaces=frozenset(), parameters=tuple(parameters)))
    return out


def start_search(model: LinearisedModel, without: str = "", tau: float | None = None) -> LocalForces:
    """Prepare a search for local forces in the residual of a fit, without one of its effects if that is named.

    `tau`: scatter of the friction levels; default that of the fit.
    """
    solution, old = model.solution, model.solution.problem.layout
    kept = tuple(e for e in old.model.effects if e.name != without)
    bumps = _bump_effects(old)
    absent = frozenset(pair for pair in old.absent if pair[0] != without)
    layout = replace(old, model=Model((*kept, *bumps)), absent=absent)
    search = VariableProjection(TiedSeparableModel(layout, model.blocks), tau or solution.tau or 0.03)
    names = {e.name for e in bumps}
    search.items = [i for i in search.items if i.effect.name in names]
    problem = search.problem(search.separable.data)
    for item in search.items:  # a bump stays within its run
        for slots, axis in zip(item.slots, item.grid.axes, strict=True):
            problem.low[slots], problem.high[slots] = axis[0], axis[-1]
    groups = search.groups_without(search.items)
    p = layout.unknowns(old.by_address(solution.p), search.start_values())
    state = problem.refine(problem.at(p, groups=groups), groups, steps=MAX_STEPS, enough=MIN_FALL)
    return LocalForces(model, search, state, state)


def find_local_forces(solution: Solution) -> LocalForces:
    """Find the local forces in the residual of a fit.

    Friction levels absorb misfit too: without a strong effect, a run may seem to have a twentieth of the friction. A
    large misfit is therefore first searched where all runs have one level. If the forces found explain most of it, the
    model and the scatter of the levels are refitted together with them. If significant forces remain, the misfit is not
    local, and the search starts at the scatter of the fit.
    """
    model = linearise(solution)
    start = start_search(model)
    if start.bare.misfit <= MIN_REDUCED_CHI2_FAR * start.search.separable.size:
        return continue_search(start)
    random = solution.levels_are_random
    found = continue_search(start_search(model, tau=MIN_LEVEL_SCATTER) if random else start)
    if found.items and found.explained > MIN_SHARE_LOCAL * found.bare.misfit:
        found = continue_search(_refitted(found))
    return found if found.complete or not random else continue_search(start)


def _refitted(found: LocalForces) -> LocalForces:
    """The search in the model refitted together with the bumps; the same where no motion can be integrated."""
    solution, whole = found.solution, found.search.separable.layout
    old, problem = solution.problem.layout, solution.problem
    if not all(type(p) is Piece for p in problem.pieces):
        return found
    names = {i.effect.name for i in found.items}
    used = [e for e in whole.model.effects if e.name in names]
    absent = {(i.effect.name, i.run) for i in found.search.items if i.run is not None and i not in found.items}
    absent = {pair for pair in absent if pair[0] in names}
    layout = replace(old, model=Model((*old.model.effects, *used)), absent=old.absent | absent)
    p = found.search.separable.law(found.state.nonlinear_values, found.state.coefficients)
    p = layout.unknowns(whole.by_address(p))
    try:
        fit = fit_with_scatter(problem.rebuild(layout), p, solution.starts, solution.tau, max_steps=MAX_REFIT_STEPS)
        bare = hold(problem, old.unknowns(layout.by_address(fit.p)), fit.starts, max(fit.tau, MIN_LEVEL_SCATTER))
        start = start_search(linearise(bare))
    except FrictrackError:
        return found
    values = start.search.separable.layout.unknowns(layout.by_address(fit.p), start.state.nonlinear_values)
    pairs = {(i.effect.name, i.run): i for i in start.search.items}
    again = [pairs[i.effect.name, i.run] for i in found.items]
    return _prune(start.with_bumps({i: values[[s[0] for s in i.slots]] for i in again}).refined())


def continue_search(found: LocalForces) -> LocalForces:
    """Add bumps while significant ones remain."""
    for _ in range(MAX_ROUNDS):
        starts = _strongest_bumps(found)
        if not starts:
            break
        tried = found.with_bumps(starts[0]).refined()
        for more in starts[1:]:
            other = found.with_bumps(more).refined(below=tried.state.misfit)
            tried = min(tried, other, key=lambda f: f.state.misfit)
        found = _prune(tried)
    return found


def _strongest_bumps(found: LocalForces) -> list[dict[ScanItem, Array]]:
    """Return the most significant bumps as sets to start from, the best one first; none if none is significant.

    The sets hold one place for all runs, at the best centre of every width, or a moment of every run that has one.
    """
    scans = {i: found.gains(i) for i in found.free_items()}
    moments = {i: scan for i, scan in scans.items() if i.run is not None and found.p_of_gain(scan.largest) < ALPHA}
    most = max((scan.largest for scan in moments.values()), default=0.0)
    for place, scan in scans.items():
        if place.run is None and scan.largest > most + MIN_CHI2_GAIN_PLACE:
            heights = scan.gains.reshape(scan.grid.shape)
            points = np.ravel_multi_index((np.argmax(heights, axis=0), np.arange(heights.shape[1])), heights.shape)
            best_first = sorted(points.tolist(), key=lambda g: -scan.gains[g])
            return [{place: scan.grid.values[g]} for g in best_first if found.p_of_gain(float(scan.gains[g])) < ALPHA]
    return [{i: scan.grid.values[scan.best] for i, scan in moments.items()}] if moments else []


def _prune(found: LocalForces) -> LocalForces:
    """Remove bumps that are no longer significant, or that carry almost none of the misfit."""
    pairs = zip(found.items, found.bumps, strict=True)
    kept = [i for i, b in pairs if found.p(b) < ALPHA and b.z**2 > MIN_SHARE_PER_BUMP * found.explained]
    if len(kept) == len(found.items) or not kept:
        return found
    removed = np.concatenate([i.coefficients for i in found.items if i not in kept])
    state = found.problem.without(found.state, removed)
    return _prune(replace(found, state=state, items=tuple(kept)).refined())
