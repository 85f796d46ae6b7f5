"""Compute the expected evidence of a planned run: one explanation is true, and the other is fitted to all runs.

This is the criterion of T-optimal designs for discriminating between two rival models.

References
----------
Hunter & Reiner (1965), Technometrics 7, 307-323.
Atkinson & Fedorov (1975), Biometrika 62, 57-70.

"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from frictrack.diagnose.experiments.virtual_runs import RunDesign, expected_scatter, extend_layout, simulate_run
from frictrack.diagnose.model_selection import information_criterion
from frictrack.distributions import chi2_isf
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

START_PHASES = np.arange(4) * np.pi / 2  # starting phases of the planned run, rad
START_TIMES = np.linspace(0.1, 0.9, 7)  # starting times of a rival's event, as shares of the planned run
SIZE_ROLES = ("amplitude", "depth")
SMALL_FORCE_RATIO = 0.05  # of friction: size of an effect that the runs do not determine
MAX_CHI2_UNDETERMINED = 10.0  # rise below which the runs do not determine a size
N_STARTS_REFINED = 2  # best starting values that are refined
MAX_CHI2_LINEAR = 1000.0  # above it a rival is too far away for linearised runs
MAX_STEPS_OWN, MAX_STEPS = 4, 12  # Gauss-Newton steps: planned run alone, all runs


@dataclass(frozen=True)
class Explanation:
    """A fitted model with one effect added, and its evidence on the present runs.

    Parameters
    ----------
    effect
        Name of the effect.
    solution
        The fit with it.
    gain
        Fall of BIC on the present runs.
    conservative
        The same fit with the effect small where the runs leave its size open; it predicts new runs.

    """

    effect: str
    solution: Solution
    gain: float
    conservative: Solution
    _simulated: dict[tuple[RunDesign, int], Piece] = field(default_factory=dict, repr=False, compare=False)

    @property
    def fitted_effect(self) -> Effect:
        """The effect as it was fitted."""
        return next(e for e in self.solution.problem.model.effects if e.name == self.effect)

    def simulated_run(self, design: RunDesign, fine: int) -> Piece:
        """Simulate a planned run without noise, with at least `fine` panels per frame; the result is cached."""
        key = design, max([fine, *(e.fine for e in self.conservative.problem.model.effects)])
        if key not in self._simulated:
            self._simulated[key] = simulate_run(self.conservative, design, fine)
        return self._simulated[key]


def make_explanation(effect: str, solution: Solution, bare: Solution) -> Explanation:
    """Make an explanation from a fit with one effect added.

    A size that the runs do not determine (a constant pull beside Coulomb friction) may be fitted absurdly large. It
    would promise absurd evidence for other runs, so it is held small for predictions.

    Parameters
    ----------
    effect
        Name of the effect.
    solution
        The fit with it.
    bare
        The fit without it.

    Returns
    -------
    Explanation

    """
    gain = max(information_criterion(bare) - information_criterion(solution), 0.0)
    return Explanation(effect, solution, gain, _conservative_solution(effect, solution, bare))


def _conservative_solution(effect: str, solution: Solution, bare: Solution) -> Solution:
    """The fit, or the one with its effect held small if it exceeds friction and the runs do not require that."""
    old = next(e for e in solution.problem.layout.model.effects if e.name == effect)
    linear = [p for p in old.linear if p.free and p.prior is None and not p.per_run]
    if old.acts_on != "force" or old.modifies or not linear:
        return solution
    sizes = _friction_sizes(solution, old)
    values = solution.problem.layout.values(solution.p, 0)[0][effect]
    implausible = {p.name: float(np.sign(values[p.name])) for p in linear if abs(values[p.name]) > sizes[p.name]}
    if not implausible:
        return solution
    try:
        constrained = add_effect(
            bare, old.adjusted(**{n: {"fixed": s * SMALL_FORCE_RATIO * sizes[n]} for n, s in implausible.items()})
        )
    except FrictrackError:
        return solution
    return constrained if constrained.objective - solution.objective < MAX_CHI2_UNDETERMINED else solution


def _friction_sizes(solution: Solution, effect: Effect) -> dict[str, float]:
    """For each coefficient of an effect, the value at which its force equals friction (rms over the runs)."""
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
class ModelDiscrimination:
    """Two explanations of the same runs, the first of which is taken to be true."""

    truth: Explanation
    rival: Explanation

    @cached_property
    def noise_free_pieces(self) -> list[Piece]:
        """The present runs as the true explanation predicts them, without noise."""
        model_y = {(r.piece.run, float(r.piece.t[0])): r.model_y for r in self.truth.conservative.responses}
        return [replace(p, y=model_y[p.run, float(p.t[0])]) for p in self.rival.solution.problem.pieces]

    @cached_property
    def fitted_rival(self) -> Solution:
        """The rival fitted to what the truth predicts of the present runs."""
        rival = self.rival.solution
        problem = rival.problem.rebuild(rival.problem.layout, self.noise_free_pieces)
        return refine(problem, rival.p, rival.starts, tau=max(self.truth.conservative.tau, 1e-3), max_steps=MAX_STEPS)

    @property
    def expected_delta_bic_now(self) -> float:
        """Expected difference of BIC on the present runs, positive for the truth."""
        truth = self.truth.conservative
        constraint = penalty_residual(truth.problem.layout, truth.p, max(truth.tau, 1e-3))
        return self._bic(self.fitted_rival, constraint, count_unknowns(truth.problem.layout))

    def expected_delta_bic_after(self, design: RunDesign) -> float:
        """Expected difference of BIC once a planned run is filmed too, positive for the truth.

        Parameters
        ----------
        design
            The planned run.

        Returns
        -------
        float

        Raises
        ------
        FrictrackError
            If the run is too short, or if its motion cannot be integrated under the rival.

        """
        truth, rival = self.truth.conservative, self.rival.solution
        piece = self.truth.simulated_run(design, max(e.fine for e in rival.problem.model.effects))
        span = spans_of([replace(piece, run=0)], 1, truth.problem.layout.spans[0].fps * design.rate)[0]
        tau = expected_scatter(truth, piece.run + 1)
        layout, p = extend_layout(self.fitted_rival, span, design.phase, free=True)
        p, start = _initialise_planned_run(rival, layout, piece, (p, np.array(design.start), tau))
        starts = [*self.fitted_rival.starts, start]
        found = refine(_LinearisedRuns(self.fitted_rival, layout, piece), p, starts, tau=tau, max_steps=MAX_STEPS)
        if found.objective > MAX_CHI2_LINEAR:
            found = refine(
                rival.problem.rebuild(layout, [*self.noise_free_pieces, piece]), p, starts, tau=tau, max_steps=MAX_STEPS
            )
        truth_layout, q = extend_layout(truth, span, design.phase)
        constraint, count = penalty_residual(truth_layout, q, tau), count_unknowns(truth_layout)
        return min(
            self._bic(s, constraint, count) for s in (found, _with_amplitude_per_run(found, self.rival.effect, tau))
        )

    def _bic(self, rival: Solution, constraint: Array, count: int) -> float:
        """Difference of BIC between a rival and a truth that explains everything, with the penalty of its levels."""
        fixed = count_unknowns(self.truth.solution.problem.layout) - count_unknowns(
            self.truth.conservative.problem.layout
        )
        penalty = count_unknowns(rival.problem.layout) - count - fixed
        return rival.objective - float(constraint @ constraint) + penalty * float(np.log(rival.problem.n_frames))


class _LinearisedRuns(LeastSquaresProblem):
    """A planned run and the present runs; the latter answer linearly about a fit and are not simulated again."""

    def __init__(self, fitted_rival: Solution, layout: ParameterLayout, piece: Piece) -> None:
        super().__init__(layout.model, layout, [*fitted_rival.problem.pieces, piece])
        self._fitted_rival = fitted_rival
        position_by_name = {name: i for i, name in enumerate(layout.names)}
        self._positions = [position_by_name[name] for name in fitted_rival.problem.layout.names]
        self._compressed = [_compress_response(r) for r in fitted_rival.responses]

    def _respond(self, i: int, p: Array, start: Array) -> PieceResponse:
        if i == len(self._fitted_rival.responses):
            return super()._respond(i, p, start)
        linear = self._compressed[i]
        active = [self._positions[k] for k in linear.active]
        residual = linear.r - linear.jac @ (p[active] - self._fitted_rival.p[linear.active])
        return replace(linear, active=active, r=residual, r_full=residual)


def _compress_response(response: PieceResponse) -> PieceResponse:
    """The same linear response in as many rows as it has unknowns (QR)."""
    upper = np.asarray(np.linalg.qr(np.column_stack([response.jac, response.r]), mode="r"))
    none = np.zeros((len(upper), response.q.shape[1]))  # the start is in neither
    return replace(response, jac=upper[:, :-1], r=upper[:, -1], r_full=upper[:, -1], q=none)


def _with_amplitude_per_run(tied: Solution, effect: str, tau: float) -> Solution:
    """The rival with an amplitude per run, if one common amplitude is significantly worse."""
    layout = tied.problem.layout
    old = next(e for e in layout.model.effects if e.name == effect)
    sizes = {
        p.name: {"per_run": True}
        for p in old.parameters
        if p.role in SIZE_ROLES and is_unconstrained(p) and not p.per_run
    }
    runs = len(layout.run_names)
    worse = float(chi2_isf(ALPHA_SHARED_AMPLITUDE, runs - 1))
    if not (sizes and has_per_run_coefficients(old)) or tied.objective < worse:
        return tied
    effects = tuple(old.adjusted(**sizes) if e is old else e for e in layout.model.effects)
    free = replace(layout, model=replace(layout.model, effects=effects))
    values_by_name = dict(zip(layout.names, tied.p, strict=True))
    p = np.array(
        [
            values_by_name.get(n, values_by_name.get(f"{s.effect}.{s.parameter}", 0.0))
            for n, s in zip(free.names, free.slots, strict=True)
        ]
    )
    try:
        untied = refine(tied.problem.rebuild(free, tied.problem.pieces), p, tied.starts, tau=tau, max_steps=MAX_STEPS)
    except FrictrackError:
        return tied
    return untied if tied.objective - untied.objective > worse else tied


def count_unknowns(layout: ParameterLayout) -> int:
    """Number of parameters without the friction levels."""
    return len(layout.slots) - len(layout.levels)


def _initialise_planned_run(
    rival: Solution, layout: ParameterLayout, piece: Piece, begin: tuple[Array, Array, float]
) -> tuple[Array, Array]:
    """Best values of the rival's own parameters in the planned run, and its initial conditions."""
    p, start, tau = begin
    problem = LeastSquaresProblem(layout.model, layout, [piece])
    own = np.array([s.run == piece.run for s in layout.slots])
    tried = []
    for trial in _start_values(rival, layout, p, piece):
        with suppress(FrictrackError):  # a start too wild to be integrated
            tried.append(predicted_objective(problem, trial, [start], tau=tau, free=own))
    tried.sort(key=lambda t: t[0])
    found = [refine_further(s, tau, free=own, max_steps=MAX_STEPS_OWN) for _, s in tried[:N_STARTS_REFINED]]
    best = min(found, key=lambda s: s.objective, default=None)
    return (p, start) if best is None else (best.p, best.starts[0])


def _start_values(rival: Solution, layout: ParameterLayout, p: Array, piece: Piece) -> Iterator[Array]:
    """Starting values (P,) for the parameters of the planned run: phases and times of events."""
    roles = {(e.name, q.name): q.role for e in rival.problem.model.effects for q in e.parameters}
    own = [i for i, s in enumerate(layout.slots) if s.run == piece.run and s.effect != LEVEL]
    phases = [i for i in own if roles[layout.slots[i].effect, layout.slots[i].parameter] == "phase"]
    moments = [i for i in own if not layout.slots[i].linear and layout.slots[i].unit == "s" and i not in phases]
    yield p
    for i in phases:
        for phase in START_PHASES:
            yield _with_value(p, i, float(phase))
    for i in moments:
        for share in START_TIMES:
            yield _with_value(p, i, float(piece.t[0] + share * (piece.t[-1] - piece.t[0])))


def _with_value(p: Array, i: int, value: float) -> Array:
    out = p.copy()
    out[i] = value
    return out
