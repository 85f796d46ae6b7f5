"""Compute the expected evidence of a planned run: one explanation is true, and the other is fitted to all runs.

This is the criterion of T-optimal designs for discriminating between two rival models.

References
----------
Hunter & Reiner (1965), Technometrics 7, 307-323.
Atkinson & Fedorov (1975), Biometrika 62, 57-70.

"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from frictrack.diagnose.experiments.evidence_forecast import EvidenceForecast, forecast_directions
from frictrack.diagnose.experiments.rival_runs import (
    MIN_CHI2_FALL,
    RivalOfAllRuns,
    RivalOfPlannedRun,
    compress_response,
    refine_rival,
    start_rival,
)
from frictrack.diagnose.experiments.virtual_runs import RunDesign, expected_scatter, extend_layout, simulate_run
from frictrack.diagnose.model_selection import MIN_CHI2_SEPARATED, information_criterion
from frictrack.effects import Effect
from frictrack.errors import FrictrackError
from frictrack.fit.least_squares import PieceResponse, Solution, refine, white_noise_covariance
from frictrack.fit.linearised import has_per_run_coefficients
from frictrack.fit.parameters import ParameterLayout, penalty_residual
from frictrack.fit.pieces import Piece, spans_of
from frictrack.fit.stepwise import add_effect, bic_penalty, is_unconstrained, remove_effect
from frictrack.records import Array

SIZE_ROLES = ("amplitude", "depth")
SMALL_FORCE_RATIO = 0.05  # of friction: size of an effect that the runs do not determine
MAX_CHI2_UNDETERMINED = 10.0  # rise below which the runs do not determine a size


@dataclass(frozen=True)
class FittedExplanation:
    """A fitted model with one effect added, or one parameter of it freed, and its evidence on the present runs.

    Parameters
    ----------
    effect
        Name of the effect in the model.
    solution
        The fit with it.
    gain
        Fall of BIC on the present runs.
    conservative
        The same fit with the effect small where the runs leave its size open; it predicts new runs.
    freed
        Address of the parameter that is freed; empty for an effect that is added.

    """

    effect: str
    solution: Solution
    gain: float
    conservative: Solution
    freed: str = ""
    _simulated: dict[tuple[RunDesign, int], _PredictedRun] = field(default_factory=dict, repr=False, compare=False)

    @property
    def name(self) -> str:
        """Name of the effect, or address of what is freed."""
        return self.freed or self.effect

    @property
    def fitted_effect(self) -> Effect:
        """The effect as it was fitted."""
        return next(e for e in self.solution.problem.model.effects if e.name == self.effect)

    @cached_property
    def relative_size_std(self) -> float:
        """Relative standard deviation of the size of the effect; infinite where the runs leave its size open."""
        if self.conservative is not self.solution:
            return np.inf
        std = np.sqrt(np.maximum(np.diag(white_noise_covariance(self.solution)[0]), 0.0))
        sizes = {p.name for p in self.fitted_effect.parameters if p.linear or p.role in SIZE_ROLES}
        own = [
            std[i] / max(abs(self.solution.p[i]), 1e-300)
            for i, slot in enumerate(self.solution.problem.layout.slots)
            if slot.effect == self.effect and slot.parameter in sizes
        ]
        return float(min(own, default=0.0))

    def predicted_run(self, design: RunDesign, fine: int) -> _PredictedRun:
        """Predict a planned run without noise, with at least `fine` panels per frame; the result is cached."""
        key = design, max([fine, *(e.fine for e in self.conservative.problem.model.effects)])
        if key not in self._simulated:
            self._simulated[key] = _PredictedRun(self.conservative, design, fine)
        return self._simulated[key]


class _PredictedRun:
    """A planned run as an explanation predicts it, and how uncertain that is.

    Attributes
    ----------
    piece : Piece
        The run without noise.
    span : Span
        Duration, course and speeds of the run.
    layout : ParameterLayout
        The unknowns of the explanation with those of the run.
    p : array of shape (P,)
        Their values.
    tau : float
        Scatter of the friction levels with that run.

    """

    def __init__(self, truth: Solution, design: RunDesign, fine: int) -> None:
        self._truth, self._design = truth, design
        self.piece = simulate_run(truth, design, fine)
        fps = truth.problem.layout.spans[0].fps * design.rate
        self.span = spans_of([replace(self.piece, run=0)], 1, fps)[0]
        self.tau = expected_scatter(truth, self.piece.run + 1)
        self.layout, self.p = extend_layout(truth, self.span, design.phase)

    @property
    def constraint(self) -> Array:
        """Residuals of the penalties of the truth."""
        return penalty_residual(self.layout, self.p, self.tau)

    @cached_property
    def uncertain_directions(self) -> Array:
        """Whitened change (n, k) of the run for one standard deviation along each principal axis of the unknowns."""
        start = np.array(self._design.start)
        response = RivalOfPlannedRun(self.layout, self.piece, start).respond(self.p, start)
        variances, axes = np.linalg.eigh(self._covariance[np.ix_(response.active, response.active)])
        return np.asarray(response.jac @ (axes * np.sqrt(np.maximum(variances, 0.0))))

    @property
    def _covariance(self) -> Array:
        """Covariance (P, P) of the unknowns: of the fit, and of the friction level of the run."""
        old = {name: i for i, name in enumerate(self._truth.problem.layout.names)}
        shared = [i for i, name in enumerate(self.layout.names) if name in old]
        before = [old[self.layout.names[i]] for i in shared]
        out = np.zeros((len(self.p), len(self.p)))
        out[np.ix_(shared, shared)] = white_noise_covariance(self._truth)[0][np.ix_(before, before)]
        for i in set(self.layout.levels) - set(shared):
            out[i, i] = self.tau**2
        return out


def make_explanation(name: str, solution: Solution, bare: Solution) -> FittedExplanation:
    """Make an explanation from a fit with one effect added, or one parameter freed.

    A size that the runs do not determine (a constant pull beside Coulomb friction) may be fitted absurdly large. It
    would promise absurd evidence for other runs, so it is held small for predictions.

    Parameters
    ----------
    name
        Name of the effect, or address of the parameter.
    solution
        The fit with it.
    bare
        The fit without it.

    Returns
    -------
    FittedExplanation

    """
    gain = max(information_criterion(bare) - information_criterion(solution), 0.0)
    if name in solution.problem.model:
        return FittedExplanation(name, solution, gain, _conservative_solution(name, solution, bare))
    return FittedExplanation(name.partition(".")[0], solution, gain, solution, name)


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

    truth: FittedExplanation
    rival: FittedExplanation

    @cached_property
    def fitted_rival(self) -> Solution:
        """The rival fitted to what the truth predicts of the present runs, without noise."""
        rival, tau = self.rival.solution, self.truth.conservative.tau_of_other_runs
        true_y = {(r.piece.run, int(r.piece.frames[0])): r.model_y for r in self.truth.conservative.responses}
        pieces = [replace(p, y=true_y[p.run, int(p.frames[0])]) for p in rival.problem.pieces]
        predicted = [_with_measurement(r, p.y) for r, p in zip(rival.responses, pieces, strict=True)]
        start = refine_rival(RivalOfAllRuns((rival, predicted), rival.problem.layout), rival.p, rival.starts, tau)
        problem = rival.problem.rebuild(rival.problem.layout, pieces)
        found = refine_rival(problem, start.p, rival.starts, tau)
        if found.objective < MIN_CHI2_SEPARATED:
            return found
        return min(found, refine_rival(problem, rival.p, rival.starts, tau), key=lambda s: s.objective)

    @cached_property
    def _present(self) -> tuple[Solution, list[PieceResponse]]:
        """The fitted rival, and its compressed responses in the present runs."""
        return self.fitted_rival, [compress_response(r) for r in self.fitted_rival.responses]

    @property
    def expected_delta_bic_now(self) -> float:
        """Expected difference of BIC on the present runs, positive for the truth."""
        truth = self.truth.conservative
        constraint = penalty_residual(truth.problem.layout, truth.p, truth.tau_of_other_runs)
        return self._bic(self.fitted_rival, constraint, count_unknowns(truth.problem.layout))

    def forecast_after(self, design: RunDesign, *, refit: bool = False) -> EvidenceForecast:
        """Forecast the difference of BIC once a planned run is filmed too, positive for the truth.

        Parameters
        ----------
        design
            The planned run.
        refit
            Fit the rival by simulation, too: slower, and right where the rival is far from the truth.

        Returns
        -------
        EvidenceForecast

        Raises
        ------
        FrictrackError
            If the run is too short, or if its motion cannot be integrated under the rival.

        """
        rival = self.rival.solution
        run = self.truth.predicted_run(design, max(e.fine for e in rival.problem.model.effects))
        layout, p = extend_layout(self.fitted_rival, run.span, design.phase, free=True)
        planned = RivalOfPlannedRun(layout, run.piece, np.array(design.start))
        p, start = start_rival(planned, p, run.tau)
        starts = [*self.fitted_rival.starts, start]
        found = refine_rival(RivalOfAllRuns(self._present, layout, planned), p, starts, run.tau)
        untied = self._with_amplitude_per_run(found, planned, run.tau)
        simulated = list(self._simulated_fits(layout, run.piece, (found, untied), run.tau)) if refit else []
        count = count_unknowns(run.layout)
        best = min(simulated or [found, untied], key=lambda s: self._bic(s, run.constraint, count))
        slopes, curvatures = forecast_directions(best, run.uncertain_directions)
        open_above = self.truth.conservative is not self.truth.solution
        return EvidenceForecast(self._bic(best, run.constraint, count), slopes, curvatures, open_above)

    def _simulated_fits(
        self, layout: ParameterLayout, piece: Piece, starts: Sequence[Solution], tau: float
    ) -> Iterator[Solution]:
        """The rival fitted to all runs by simulation, from several starts.

        They are the linearised fits, the present fit, and a new scan: with the planned run, the parameters that fit
        best may be far from the present ones.
        """
        pieces = [*self.fitted_rival.problem.pieces, piece]
        present = replace(starts[0], p=extend_layout(self.fitted_rival, layout.spans[-1], 0.0, free=True)[1])
        all_starts = [*starts, present]
        with suppress(FrictrackError):
            all_starts.append(self._scanned_fit(layout, pieces, starts[0]))
        for start in all_starts:
            with suppress(FrictrackError):  # a motion that cannot be integrated from there
                problem = self.rival.solution.problem.rebuild(start.problem.layout, pieces)
                yield refine(problem, start.p, start.starts, tau=tau, min_fall=MIN_CHI2_FALL)

    def _scanned_fit(self, layout: ParameterLayout, pieces: Sequence[Piece], near: Solution) -> Solution:
        """The rival with its effect removed and added again, where the scan finds that it explains most."""
        problem = self.rival.solution.problem.rebuild(layout, pieces)
        solution = refine(problem, near.p, near.starts, tau=near.tau, max_steps=1)
        return add_effect(remove_effect(solution, self.rival.effect), self.rival.fitted_effect)

    def _bic(self, rival: Solution, constraint: Array, count: int) -> float:
        """Difference of BIC between a rival and a truth that explains everything, with the penalty of its levels."""
        fixed = count_unknowns(self.truth.solution.problem.layout) - count_unknowns(
            self.truth.conservative.problem.layout
        )
        more = count_unknowns(rival.problem.layout) - count - fixed
        return rival.objective - float(constraint @ constraint) + bic_penalty(more, rival.problem.n_frames)

    def _with_amplitude_per_run(self, tied: Solution, planned: RivalOfPlannedRun, tau: float) -> Solution:
        """The rival with an amplitude per run, if that lowers the BIC."""
        layout, effect = tied.problem.layout, self.rival.effect
        old = next(e for e in layout.model.effects if e.name == effect)
        sizes = {
            p.name: {"per_run": True}
            for p in old.parameters
            if p.role in SIZE_ROLES and is_unconstrained(p) and not p.per_run
        }
        needed = bic_penalty(len(sizes) * (len(layout.run_names) - 1), tied.problem.n_frames)
        if not (sizes and has_per_run_coefficients(old)) or tied.objective < needed:
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
            untied = refine_rival(RivalOfAllRuns(self._present, free, planned.with_layout(free)), p, tied.starts, tau)
        except FrictrackError:
            return tied
        return untied if tied.objective - untied.objective > needed else tied


def _with_measurement(response: PieceResponse, y: Array) -> PieceResponse:
    """The same response to other measured positions y (n,)."""
    change = response.piece.whitened(y - response.piece.y)
    return replace(response, r=response.r + change - response.q @ (response.q.T @ change))


def count_unknowns(layout: ParameterLayout) -> int:
    """Number of parameters without the friction levels."""
    return len(layout.slots) - len(layout.levels)
