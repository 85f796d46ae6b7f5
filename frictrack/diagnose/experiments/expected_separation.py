"""Expected evidence of a planned run: one explanation is true and the other one is fitted to all runs."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from scipy.stats import chi2 as chi2_distribution

from frictrack.diagnose.experiments.virtual_runs import RunDesign, expected_scatter, extend_layout, simulate_run
from frictrack.diagnose.model_selection import information_criterion
from frictrack.effects import Effect
from frictrack.errors import FrictrackError
from frictrack.fit.least_squares import (
    LeastSquaresProblem,
    PieceResponse,
    Solution,
    predicted_objective,
    refine,
    refine_further,
)
from frictrack.fit.linearised import has_per_run_coefficients
from frictrack.fit.parameters import LEVEL, ParameterLayout, penalty_residual
from frictrack.fit.segments import Piece, spans_of
from frictrack.fit.stepwise import ALPHA_SHARED_AMPLITUDE, add_effect, is_unconstrained
from frictrack.records import Array

START_PHASES = np.arange(4) * np.pi / 2  # from which a phase of the planned run is sought
START_TIMES = np.linspace(0.1, 0.9, 7)  # of the planned run, at which a rival's event is sought
SIZE_ROLES = ("amplitude", "depth")
SMALL_FORCE_RATIO = 0.05  # of friction: size of a cause that the runs do not tell
MAX_CHI2_UNDETERMINED = 10.0  # rise of chi-squared below which the runs do not tell a size
N_STARTS_REFINED = 2  # of these starts that are refined
MAX_CHI2_LINEAR = 1000.0  # chi-squared beyond which a rival is too far away for the runs at hand to answer as they did
MAX_STEPS_OWN, MAX_STEPS = 4, 12  # of Gauss-Newton: on the planned run alone, and on all runs


@dataclass(frozen=True)
class Explanation:
    """A cause that was added to the law, and the fall of BIC that it brought on the runs at hand.

    `believed` is the same law with the cause small where the runs leave its size open: what a new run is foretold by.
    """

    effect: str
    solution: Solution
    gain: float
    believed: Solution
    _simulated: dict[tuple[RunDesign, int], Piece] = field(default_factory=dict, repr=False, compare=False)

    def simulated_run(self, film: RunDesign, fine: int) -> Piece:
        """What the camera would see of a planned run, with `fine` panels per frame at least; worked out once."""
        key = film, max([fine, *(e.fine for e in self.believed.problem.model.effects)])
        if key not in self._simulated:
            self._simulated[key] = simulate_run(self.believed, film, fine)
        return self._simulated[key]


def make_explanation(effect: str, solution: Solution, bare: Solution) -> Explanation:
    """An explanation beside the `bare` law, its cause small beside friction where the runs leave its size open.

    What runs do not tell (a cable's constant pull beside Coulomb friction) may have come out of the fit absurdly large,
    and would promise absurd evidence in a run of another kind.
    """
    gain = max(information_criterion(bare) - information_criterion(solution), 0.0)
    return Explanation(effect, solution, gain, _believed(effect, solution, bare))


def _believed(effect: str, solution: Solution, bare: Solution) -> Solution:
    """The explanation, or where its cause came out larger than friction itself, and need not, the same held small."""
    old = next(e for e in solution.problem.layout.model.effects if e.name == effect)
    linear = [p for p in old.linear if p.free and p.prior is None and not p.per_run]
    if old.acts_on != "force" or old.modifies or not linear:
        return solution
    sizes = _friction_sized(solution, old)
    values = solution.problem.layout.values(solution.p, 0)[0][effect]
    absurd = {p.name: float(np.sign(values[p.name])) for p in linear if abs(values[p.name]) > sizes[p.name]}
    if not absurd:
        return solution
    try:
        held = add_effect(
            bare, old.adjusted(**{n: {"fixed": s * SMALL_FORCE_RATIO * sizes[n]} for n, s in absurd.items()})
        )
    except FrictrackError:
        return solution
    return held if held.objective - solution.objective < MAX_CHI2_UNDETERMINED else solution


def _friction_sized(solution: Solution, effect: Effect) -> dict[str, float]:
    """Of every coefficient of an effect the size at which its force is as large as friction, rms over the runs."""
    columns, whole = [], []
    for r in solution.responses:
        problem, piece = solution.problem, r.piece
        values, level = problem.layout.values(solution.p, piece.run)
        path = piece.path_at_nodes(r.motion.x, r.motion.v, level)
        columns.append(effect.columns(path, values[effect.name]))
        whole.append(piece.mass * (piece.known - r.motion.a))
    of_one = np.sqrt(np.mean(np.concatenate(columns) ** 2, axis=0))
    friction = float(np.sqrt(np.mean(np.concatenate(whole) ** 2)))
    return {p.name: friction / one if one > 0 else np.inf for p, one in zip(effect.linear, of_one, strict=True)}


@dataclass(frozen=True)
class Contest:
    """Two explanations of the same runs, of which the first is taken to be true."""

    truth: Explanation
    rival: Explanation

    @cached_property
    def ideal(self) -> list[Piece]:
        """The runs at hand as the true explanation has them, without noise."""
        seen = {(r.piece.run, float(r.piece.t[0])): r.model_y for r in self.truth.believed.responses}
        return [replace(p, y=seen[p.run, float(p.t[0])]) for p in self.rival.solution.problem.pieces]

    @cached_property
    def fitted(self) -> Solution:
        """The rival fitted to what the truth predicts of the runs at hand."""
        rival = self.rival.solution
        problem = rival.problem.over(rival.problem.layout, self.ideal)
        return refine(problem, rival.p, rival.starts, tau=max(self.truth.believed.tau, 1e-3), max_steps=MAX_STEPS)

    @property
    def now(self) -> float:
        """Expected difference of BIC on the runs at hand, positive for the truth."""
        truth = self.truth.believed
        held = penalty_residual(truth.problem.layout, truth.p, max(truth.tau, 1e-3))
        return self._bic(self.fitted, held, count_unknowns(truth.problem.layout))

    def after(self, film: RunDesign) -> float:
        """Expected difference of BIC once the planned run is filmed too, positive for the truth.

        Raises FrictrackError where the run cannot be made, or its motion cannot be followed under the rival.
        """
        truth, rival = self.truth.believed, self.rival.solution
        piece = self.truth.simulated_run(film, max(e.fine for e in rival.problem.model.effects))
        span = spans_of([replace(piece, run=0)], 1, truth.problem.layout.spans[0].fps * film.rate)[0]
        tau = expected_scatter(truth, piece.run + 1)
        layout, p = extend_layout(self.fitted, span, film.phase, free=True)
        p, start = _placed(rival, layout, piece, (p, np.array(film.start), tau))
        starts = [*self.fitted.starts, start]
        found = refine(_LinearisedRuns(self.fitted, layout, piece), p, starts, tau=tau, max_steps=MAX_STEPS)
        if found.objective > MAX_CHI2_LINEAR:
            found = refine(rival.problem.over(layout, [*self.ideal, piece]), p, starts, tau=tau, max_steps=MAX_STEPS)
        told, q = extend_layout(truth, span, film.phase)
        held, count = penalty_residual(told, q, tau), count_unknowns(told)
        return min(self._bic(s, held, count) for s in (found, _loosened(found, self.rival.effect, tau)))

    def _bic(self, rival: Solution, held: Array, count: int) -> float:
        """Difference of BIC between a rival and a truth that explains all: its levels' restraint, its unknowns."""
        fixed = count_unknowns(self.truth.solution.problem.layout) - count_unknowns(self.truth.believed.problem.layout)
        price = count_unknowns(rival.problem.layout) - count - fixed
        return rival.objective - float(held @ held) + price * float(np.log(rival.problem.n_frames))


class _LinearisedRuns(LeastSquaresProblem):
    """A planned run beside the runs at hand, which answer as they do about a fitted law and are not followed again."""

    def __init__(self, fitted: Solution, layout: ParameterLayout, piece: Piece) -> None:
        super().__init__(layout.model, layout, [*fitted.problem.pieces, piece])
        self._fitted = fitted
        there = {name: i for i, name in enumerate(layout.names)}
        self._there = [there[name] for name in fitted.problem.layout.names]
        self._recalled = [_compress_response(r) for r in fitted.responses]

    def _respond(self, i: int, p: Array, start: Array) -> PieceResponse:
        if i == len(self._fitted.responses):
            return super()._respond(i, p, start)
        about = self._recalled[i]
        active = [self._there[k] for k in about.active]
        left = about.r - about.jac @ (p[active] - self._fitted.p[about.active])
        return replace(about, active=active, r=left, r_full=left)


def _compress_response(response: PieceResponse) -> PieceResponse:
    """The same linear answer in as few rows as it has unknowns: turned, and without those that are zero."""
    upper = np.asarray(np.linalg.qr(np.column_stack([response.jac, response.r]), mode="r"))
    none = np.zeros((len(upper), response.q.shape[1]))  # the start is in neither
    return replace(response, jac=upper[:, :-1], r=upper[:, -1], r_full=upper[:, -1], q=none)


def _loosened(tied: Solution, effect: str, tau: float) -> Solution:
    """The rival with an amplitude per run, where one amplitude is significantly worse: what a fit would make of it."""
    layout = tied.problem.layout
    old = next(e for e in layout.model.effects if e.name == effect)
    sizes = {
        p.name: {"per_run": True}
        for p in old.parameters
        if p.role in SIZE_ROLES and is_unconstrained(p) and not p.per_run
    }
    runs = len(layout.run_names)
    worse = float(chi2_distribution.isf(ALPHA_SHARED_AMPLITUDE, runs - 1))
    if not (sizes and has_per_run_coefficients(old)) or tied.objective < worse:
        return tied
    effects = tuple(old.adjusted(**sizes) if e is old else e for e in layout.model.effects)
    free = replace(layout, model=replace(layout.model, effects=effects))
    there = dict(zip(layout.names, tied.p, strict=True))
    p = np.array(
        [there.get(n, there.get(f"{s.effect}.{s.parameter}", 0.0)) for n, s in zip(free.names, free.slots, strict=True)]
    )
    try:
        loose = refine(tied.problem.over(free, tied.problem.pieces), p, tied.starts, tau=tau, max_steps=MAX_STEPS)
    except FrictrackError:
        return tied
    return loose if tied.objective - loose.objective > worse else tied


def count_unknowns(layout: ParameterLayout) -> int:
    """Unknowns that are paid for: all but the levels."""
    return len(layout.slots) - len(layout.levels)


def _placed(
    rival: Solution, layout: ParameterLayout, piece: Piece, begin: tuple[Array, Array, float]
) -> tuple[Array, Array]:
    """The rival's own unknowns of the planned run where they explain it best, and its start there."""
    p, start, tau = begin
    problem = LeastSquaresProblem(layout.model, layout, [piece])
    own = np.array([s.run == piece.run for s in layout.slots])
    tried = []
    for trial in _trials(rival, layout, p, piece):
        with suppress(FrictrackError):  # a start too wild to be integrated
            tried.append(predicted_objective(problem, trial, [start], tau=tau, free=own))
    tried.sort(key=lambda t: t[0])
    found = [refine_further(s, tau, free=own, max_steps=MAX_STEPS_OWN) for _, s in tried[:N_STARTS_REFINED]]
    best = min(found, key=lambda s: s.objective, default=None)
    return (p, start) if best is None else (best.p, best.starts[0])


def _trials(rival: Solution, layout: ParameterLayout, p: Array, piece: Piece) -> Iterator[Array]:
    """Values (P,) from which the unknowns of the planned run are sought: phases, and moments of events."""
    roles = {(e.name, q.name): q.role for e in rival.problem.model.effects for q in e.parameters}
    own = [i for i, s in enumerate(layout.slots) if s.run == piece.run and s.effect != LEVEL]
    phases = [i for i in own if roles[layout.slots[i].effect, layout.slots[i].parameter] == "phase"]
    moments = [i for i in own if not layout.slots[i].linear and layout.slots[i].unit == "s" and i not in phases]
    yield p
    for i in phases:
        for phase in START_PHASES:
            yield _with(p, i, float(phase))
    for i in moments:
        for share in START_TIMES:
            yield _with(p, i, float(piece.t[0] + share * (piece.t[-1] - piece.t[0])))


def _with(p: Array, i: int, value: float) -> Array:
    out = p.copy()
    out[i] = value
    return out
