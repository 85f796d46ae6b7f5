"""Explanations of the present runs, and the evidence between two of them that a planned run is expected to give.

An explanation is a fitted effect, a freed value, or a free curve. One is taken to be true, and a rival is fitted to all
runs without noise.

This is the criterion of T-optimal designs. The misfit r that the rival leaves gives the evidence r'r. It grows with the
square of the size of the true effect, which the present runs know only to its standard deviation.

The present runs answer linearly to the forces of the fitted rival: to every coefficient, times the friction level of
the run if it carries the load. In the planned run the rival is linearised along the motion that it would have to
reproduce, so that no motion is integrated.

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

from frictrack.base.errors import FrictrackError
from frictrack.diagnose.compressed import Axis, SmoothForce, compress_residual
from frictrack.diagnose.experiments.virtual_runs import (
    LinearisedRun,
    RunDesign,
    VirtualRun,
    expected_scatter,
    extend_layout,
    roles_of,
    simulate_run,
)
from frictrack.diagnose.formula_terms import AXIS_SYMBOLS
from frictrack.diagnose.model_selection import (
    MAX_STEPS,
    MIN_CHI2_FALL,
    fitted_to_predictions,
    fitted_without_noise,
    information_criterion,
)
from frictrack.effects import PLANNED_SHARE, Effect, Nonlinear, Parameter, Path
from frictrack.fit.least_squares import (
    LeastSquaresProblem,
    PieceResponse,
    Solution,
    predicted_objective,
    refine,
    white_noise_covariance,
)
from frictrack.fit.linearised import LinearisedModel, has_per_run_coefficients, linearise
from frictrack.fit.parameters import LEVEL, ParameterLayout
from frictrack.fit.penalties import penalty_residual
from frictrack.fit.smooth_functions import linear_interpolation_matrix
from frictrack.fit.stepwise import add_effect, bic_penalty, is_unconstrained, refine_on_measured_motion
from frictrack.records import Array
from frictrack.results.candidates import AXES

SIZE_ROLES = ("amplitude", "depth")
MAX_CHI2_UNDETERMINED = 10.0  # rise below which the runs do not determine a size
INVARIANTS = {  # by axis: what a force over it keeps when a run is made differently
    "x": "what depends on the place comes again at the same place",
    "t": "what depends on the time comes again equally long after release",
    "v": "what depends on the speed comes again at the same speed",
}
N_HATS = 14  # knots of a free curve
PRIOR_STD_RATIO = 0.5  # of friction: prior standard deviation of a height
MAX_AXES = 2  # over which an unexplained force is compared
START_TIMES = np.linspace(0.1, 0.9, 7)  # starting times of a rival's event, as shares of the planned run
QUANTILES_95 = (0.025, 0.975)
N_DEVIATES = 10_000  # of every quantity that is uncertain


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
    _simulated: dict[tuple[RunDesign, int], VirtualRun] = field(default_factory=dict, repr=False, compare=False)

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
        own, p = self.solution.problem.layout.sizes(self.fitted_effect), self.solution.p
        std = np.sqrt(np.maximum(np.diag(white_noise_covariance(self.conservative)[0])[own], 0.0))
        return float(np.min(std / np.maximum(np.abs(p[own]), 1e-3 * std + 1e-300), initial=np.inf)) if own else 0.0

    def predicted_run(self, design: RunDesign, fine: int) -> VirtualRun:
        """Predict a planned run with at least `fine` panels per frame; the result is kept."""
        key = design, max([fine, *(e.fine for e in self.conservative.problem.model.effects)])
        if key not in self._simulated:
            self._simulated[key] = simulate_run(self.conservative, design, fine)
        return self._simulated[key]


def make_explanation(name: str, solution: Solution, bare: Solution) -> FittedExplanation:
    """Make an explanation from a fit with one effect added, or one parameter freed.

    A size that the runs do not determine (a constant pull with Coulomb friction) may be fitted absurdly large. It
    would promise absurd evidence for other runs, so it is held small for predictions.
    """
    gain = max(information_criterion(bare) - information_criterion(solution), 0.0)
    if name in solution.problem.model:
        return FittedExplanation(name, solution, gain, _conservative_solution(name, solution, bare))
    return FittedExplanation(name.partition(".")[0], solution, gain, solution, name)


def _conservative_solution(name: str, solution: Solution, bare: Solution) -> Solution:
    """The fit, or the one with its effect held small if it exceeds friction and the runs do not require that."""
    effect = next(e for e in solution.problem.model.effects if e.name == name)
    if effect.acts_on != "force" or effect.modifies:
        return solution
    values = solution.problem.layout.values(solution.p, 0)[0][name]
    small = {}
    for p, size in zip(effect.linear, _friction_sizes(solution, effect), strict=True):
        if p.free and p.prior is None and not p.per_run and abs(values[p.name]) > size:
            small[p.name] = {"fixed": float(np.sign(values[p.name])) * PLANNED_SHARE * size}
    if not small:
        return solution
    try:
        constrained = add_effect(bare, effect.adjusted(**small))
    except FrictrackError:
        return solution
    return constrained if constrained.objective - solution.objective < MAX_CHI2_UNDETERMINED else solution


def _friction_sizes(solution: Solution, effect: Effect) -> Array:
    """For each coefficient of an effect, the value at which its force equals friction (rms over the runs)."""
    columns, friction = [], []
    for r in solution.responses:
        values, level = solution.problem.layout.values(solution.p, r.piece.run)
        columns.append(effect.columns(r.piece.path_at_nodes(r.motion.x, r.motion.v, level), values[effect.name]))
        friction.append(r.piece.mass * (r.piece.known - r.motion.a))
    with np.errstate(divide="ignore"):
        return np.sqrt(np.mean(np.concatenate(friction) ** 2) / np.mean(np.concatenate(columns) ** 2, axis=0))


def explain_by_axes(solution: Solution) -> list[FittedExplanation]:
    """Explain the residual of a fit by a free curve over each of its most likely axes, the largest gain first.

    The curve over place, time since release or speed is piecewise linear with free heights.
    """
    friction = float(np.median(np.abs(np.concatenate([r.piece.mass * r.motion.a for r in solution.responses]))))
    likeliest: dict[str, SmoothForce] = {}  # by axis, over its factors
    for smooth in compress_residual(solution).smooth:
        likeliest.setdefault(smooth.axis.name, smooth)
    found, linearised = [], linearise(solution)
    for name in [name for name in likeliest if name in AXIS_SYMBOLS][:MAX_AXES]:
        with suppress(FrictrackError):  # a curve under which no motion can be integrated
            made = _fit_free_curve(solution, linearised, likeliest[name], PRIOR_STD_RATIO * friction)
            found.append(FittedExplanation(AXES[name].name, made, max(solution.objective - made.objective, 0.0), made))
    return sorted(found, key=lambda e: -e.gain)


def _fit_free_curve(solution: Solution, linearised: LinearisedModel, smooth: SmoothForce, prior_std: float) -> Solution:
    """Fit the model with a free curve over one axis, on the knots that the smooth force spans."""
    knots = np.linspace(smooth.at[0], smooth.at[-1], N_HATS)
    effect = _free_curve_effect(AXES[smooth.axis.name].name, smooth.axis, knots, prior_std)
    old = solution.problem.layout
    layout = replace(old, model=replace(old.model, effects=(*old.model.effects, effect)))
    # from no curve: the smooth force itself holds parts that the model takes up, with other values of its parameters
    p, tau = layout.unknowns(old.by_address(solution.p), np.zeros(len(layout.slots))), solution.tau_of_other_runs
    p = refine_on_measured_motion(linearised, layout, p)
    problem = solution.problem.rebuild(layout)
    return refine(problem, p, solution.starts, tau=tau, max_steps=MAX_STEPS, min_fall=MIN_CHI2_FALL)


def _free_curve_effect(name: str, axis: Axis, knots: Array, prior_std: float) -> Effect:
    """An effect that is any piecewise linear curve over an axis, constant beyond its knots (K,)."""

    def columns(path: Path, nonlinear: Nonlinear) -> Array:
        hats = linear_interpolation_matrix(axis.of(path), knots)
        return np.asarray(axis.times(path)[:, None] * hats)

    return Effect(
        name=name,
        acts_on="force",
        equation=f"any curve over {name}",
        parameters=tuple(Parameter(f"h{k}", "N", linear=True, prior=(0.0, prior_std)) for k in range(len(knots))),
        columns=columns,
        invariant=INVARIANTS[axis.name],
    )


@dataclass(frozen=True)
class EvidenceForecast:
    """The evidence that an experiment is expected to give if one explanation is true.

    With z standard normal, the evidence is ``known + growing * (1 + relative_std z)^2``. The noise of the new data adds
    a normal deviation, whose variance is four times the evidence.

    Parameters
    ----------
    growing
        Evidence that grows with the square of the size of the true effect, at the fitted size.
    relative_std
        Relative standard deviation of that size; infinite where it is unknown, and `growing` is that of a small one.
    known
        Evidence that does not depend on it.

    Examples
    --------
    >>> low, high = EvidenceForecast(100.0).interval()
    >>> round(low), round(high)
    (61, 139)
    >>> low, high = EvidenceForecast(100.0, 0.1).interval()
    >>> round(low), round(high)
    (50, 160)

    """

    growing: float
    relative_std: float = 0.0
    known: float = 0.0

    @property
    def expected(self) -> float:
        """Expected difference of BIC if the fitted values are true."""
        return self.growing + self.known

    def shifted(self, by: float) -> EvidenceForecast:
        """Return the forecast with a known amount of evidence added."""
        return replace(self, known=self.known + by)

    def interval(self) -> tuple[float, float | None]:
        """95 % interval, from a fixed sample of z and of the noise; None above if the size of the effect is unknown.

        It includes the interval that the noise alone gives at the fitted values.
        """
        noise, z = np.random.default_rng(0).standard_normal((2, N_DEVIATES))
        is_open = not np.isfinite(self.relative_std)
        size = 1 + (0.0 if is_open else self.relative_std) * z
        evidence = (
            self.known + max(self.growing, 0.0) * np.array([np.ones(N_DEVIATES), size**2]) + min(self.growing, 0.0)
        )
        evidence = evidence + 2 * np.sqrt(np.maximum(evidence, 0.0)) * noise
        low, high = np.quantile(evidence, QUANTILES_95, axis=1)
        return float(low.min()), None if is_open else float(high.max())


@dataclass(frozen=True)
class ModelDiscrimination:
    """Two explanations of the same runs, the first of which is taken to be true."""

    truth: FittedExplanation
    rival: FittedExplanation

    @cached_property
    def fitted_rival(self) -> Solution:
        """The rival fitted to what the truth predicts of the present runs, without noise."""
        return fitted_to_predictions(self.rival.solution, self.truth.conservative)

    @cached_property
    def _compressed(self) -> list[PieceResponse]:
        """The present runs under the fitted rival, in few rows."""
        return [compress_response(r) for r in self.fitted_rival.responses]

    @cached_property
    def expected_delta_bic_now(self) -> float:
        """Expected difference of BIC on the present runs, positive for the truth."""
        truth = self.truth.conservative
        return self._bic(self.fitted_rival, truth.problem.layout, truth.p, truth.tau_of_other_runs)

    def forecast_after(self, design: RunDesign) -> EvidenceForecast:
        """Forecast the difference of BIC once a planned run is filmed too, positive for the truth.

        Raises FrictrackError if the run is too short, or if its motion cannot be integrated under the rival.
        """
        run = self.truth.predicted_run(design, max(e.fine for e in self.rival.solution.problem.model.effects))
        tau = expected_scatter(self.truth.conservative, run.piece.run + 1)
        layout, p = extend_layout(self.fitted_rival, run.layout.spans[-1], design.phase, free=True)
        planned = LinearisedRun(layout, run.piece, design.start)
        tied = self._fit(planned, start_rival(planned, p, tau), tau)
        found = [tied, *self._with_amplitude_per_run(tied, planned)]
        least = min(self._bic(rival, run.layout, run.p, tau) for rival in found)
        return EvidenceForecast(least, self.truth.relative_size_std)

    def _fit(self, planned: LinearisedRun, p: Array, tau: float) -> Solution:
        """The rival fitted to all runs from unknowns p (P,)."""
        problem = RivalOfAllRuns(self.fitted_rival, self._compressed, planned)
        starts = [*self.fitted_rival.starts, planned.first_start]
        return fitted_without_noise(problem, p, starts, tau)

    def _bic(self, rival: Solution, layout: ParameterLayout, p: Array, tau: float) -> float:
        """Difference of BIC between a rival and a truth that explains everything but the penalties of its unknowns."""
        truth, constraint = self.truth, penalty_residual(layout, p, tau)
        held = count_unknowns(truth.solution.problem.layout) - count_unknowns(truth.conservative.problem.layout)
        more = count_unknowns(rival.problem.layout) - count_unknowns(layout) - held
        return rival.objective - float(constraint @ constraint) + bic_penalty(more, rival.problem.n_frames)

    def _with_amplitude_per_run(self, tied: Solution, planned: LinearisedRun) -> Iterator[Solution]:
        """The rival with an amplitude per run, if it may have one and its misfit exceeds the penalty of BIC."""
        layout = tied.problem.layout
        old = next(e for e in layout.model.effects if e.name == self.rival.effect)
        sizes = [p for p in old.parameters if p.role in SIZE_ROLES and is_unconstrained(p) and not p.per_run]
        needed = bic_penalty(len(sizes) * (len(layout.run_names) - 1), tied.problem.n_frames)
        if not (sizes and has_per_run_coefficients(old)) or tied.objective < needed:
            return
        per_run = old.adjusted(**{p.name: {"per_run": True} for p in sizes})
        effects = tuple(per_run if e is old else e for e in layout.model.effects)
        free = replace(layout, model=replace(layout.model, effects=effects))
        values = {(s.effect, s.parameter, s.run): value for s, value in zip(layout.slots, tied.p, strict=True)}
        shared = [values.get((s.effect, s.parameter, None), 0.0) for s in free.slots]
        p = [values.get((s.effect, s.parameter, s.run), one) for s, one in zip(free.slots, shared, strict=True)]
        with suppress(FrictrackError):
            yield self._fit(LinearisedRun(free, planned.pieces[0], planned.first_start), np.array(p), tied.tau)


def count_unknowns(layout: ParameterLayout) -> int:
    """Number of parameters without the friction levels."""
    return len(layout.slots) - len(layout.levels)


class RivalOfAllRuns(LeastSquaresProblem):
    """The present runs, which answer linearly to the forces of the fitted rival, and a planned run."""

    def __init__(self, about: Solution, responses: Sequence[PieceResponse], planned: LinearisedRun) -> None:
        layout = planned.layout
        super().__init__(layout.model, layout, [*(r.piece for r in responses), *planned.pieces])
        self._present, self._planned = [PresentRun(r, about, layout) for r in responses], planned

    def evaluate(self, p: Array, starts: Sequence[Array]) -> list[PieceResponse]:
        """Residuals and sensitivities of all runs at unknowns p (P,)."""
        return [*(run.at(p) for run in self._present), *self._planned.evaluate(p, starts[-1:])]


class PresentRun:
    """Response of one present run about a fitted rival, under a layout that may have further unknowns.

    The friction level L multiplies the coefficients that carry the load, so that the run answers linearly to a change
    d of the unknowns and to the products of these with that of L: r = r0 - J d - (d_L / L) J_loaded d_loaded.
    """

    def __init__(self, response: PieceResponse, about: Solution, layout: ParameterLayout) -> None:
        active = layout.active(response.piece.run)
        slots = [layout.slots[i] for i in active]
        known = {(e.name, q.name): q for e in layout.model.effects for q in e.parameters}
        parameters = [known.get((s.effect, s.parameter)) for s in slots]
        self._loaded = np.array([q is not None and q.loaded for q in parameters], dtype=float)
        self._phases = np.array([q is not None and q.role == "phase" for q in parameters], dtype=bool)
        self._levels = [k for k, s in enumerate(slots) if s.effect == LEVEL]
        old = [about.problem.layout.slots[i] for i in response.active]
        column = {(s.effect, s.parameter): k for k, s in enumerate(old)}
        place = [column.get((s.effect, s.parameter), -1) for s in slots]
        self._p = np.append(about.p[response.active], 1.0)[place]
        self._jac = np.column_stack([response.jac, np.zeros(len(response.jac))])[:, place]
        if -1 in place:  # a friction level, which was one
            self._jac[:, place.index(-1)] = self._jac @ (self._loaded * self._p)
        on_start = np.zeros((len(response.on_start), len(active)))
        self._response = replace(response, active=active, on_start=on_start)

    def at(self, p: Array) -> PieceResponse:
        """The response at other unknowns p (P,)."""
        change = p[self._response.active] - self._p
        change[self._phases] = (change[self._phases] + np.pi) % (2 * np.pi) - np.pi  # less than half a turn
        scale = 1.0 + self._loaded * np.sum(change[self._levels] / self._p[self._levels])
        jac = self._jac * scale
        jac[:, self._levels] += (self._jac @ (self._loaded * change))[:, None] / self._p[self._levels]
        residual = self._response.r - self._jac @ (change * scale)
        return replace(self._response, jac=jac, r=residual, r_full=residual)


def compress_response(response: PieceResponse) -> PieceResponse:
    """The same linear response in as many rows as it has unknowns (QR)."""
    upper = np.asarray(np.linalg.qr(np.column_stack([response.jac, response.r]), mode="r"))
    none = np.zeros((len(upper), response.q.shape[1]))  # the start is in neither
    return replace(response, jac=upper[:, :-1], r=upper[:, -1], r_full=upper[:, -1], q=none)


def start_rival(planned: LinearisedRun, p: Array, tau: float) -> Array:
    """First unknowns (P,) of a rival: with the phases and event times in the planned run that fit it best."""
    layout, roles, run = planned.layout, roles_of(planned.layout), planned.pieces[0].run
    slots = [(i, s, roles[s.effect, s.parameter]) for i, s in enumerate(layout.slots) if s.effect != LEVEL]
    p = p.copy()
    for i, phase, role in slots:
        sizes = [k for k, s, size in slots if s.effect == phase.effect and size in SIZE_ROLES and s.run in (None, run)]
        if role == "phase" and phase.run == run and sizes:
            p[i] += _phase_shift(planned.respond(p), layout, sizes[0], i, p)
    times = [i for i, s, role in slots if s.run == run and not s.linear and s.unit == "s" and role != "phase"]
    if not times:
        return p
    t, own = planned.pieces[0].t, np.array([s.run == run for s in layout.slots])
    tried = []
    started = ((i, t[0] + share * (t[-1] - t[0])) for i in times for share in START_TIMES)
    for trial in [p, *(np.where(np.arange(len(p)) == i, time, p) for i, time in started)]:
        with suppress(FrictrackError):  # a start too wild to be integrated
            tried.append((predicted_objective(planned, trial, [planned.first_start], tau=tau, free=own)[0], trial))
    return min(tried, key=lambda one: one[0], default=(0.0, p))[1]


def _phase_shift(response: PieceResponse, layout: ParameterLayout, size: int, phase: int, p: Array) -> float:
    """Change of a phase that fits a run best while the size of the oscillation is free.

    The sensitivities to size A and phase are its two quadratures: A + dA and A dphi are the new ones.
    """
    effect, run = layout.slots[phase].effect, layout.slots[phase].run
    slots = [(k, i, layout.slots[i]) for k, i in enumerate(response.active)]
    others = [k for k, _, s in slots if s.run == run and s.effect != effect]
    pair = [response.active.index(i) for i in (size, phase)]
    step = np.linalg.lstsq(response.jac[:, [*others, *pair]], response.r, rcond=None)[0]
    return float(np.arctan2(p[size] * step[-1], p[size] + step[-2]))
