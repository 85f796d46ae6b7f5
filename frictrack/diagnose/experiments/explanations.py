"""Explanations of the present runs that the next run should separate: fitted effects, freed values, and free curves."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from frictrack.diagnose.compressed import compress_residual
from frictrack.diagnose.experiments.virtual_runs import RunDesign, VirtualRun, expected_scatter, simulate_run
from frictrack.diagnose.formulas import AXIS_SYMBOLS
from frictrack.diagnose.model_selection import information_criterion
from frictrack.diagnose.smooth_forces import Axis, SmoothForce, smooth_forces
from frictrack.effects import PLANNED_SHARE, Effect, Nonlinear, Parameter, Path
from frictrack.errors import FrictrackError
from frictrack.fit.least_squares import Solution, refine, white_noise_covariance
from frictrack.fit.smooth_functions import linear_interpolation_matrix
from frictrack.fit.stepwise import add_effect
from frictrack.motion_axes import AXES
from frictrack.records import Array

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
MAX_STEPS_CURVE = 8  # Gauss-Newton steps
MIN_CHI2_FALL = 0.1  # of a step; less does not change which runs separate two explanations


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

    @property
    def is_open(self) -> bool:
        """Whether the runs leave the size of the effect open."""
        return self.conservative is not self.solution

    @cached_property
    def _covariance(self) -> Array:
        return white_noise_covariance(self.conservative)[0]

    @cached_property
    def relative_size_std(self) -> float:
        """Relative standard deviation of the size of the effect; infinite where the runs leave its size open."""
        if self.is_open:
            return np.inf
        sizes = {p.name for p in self.fitted_effect.parameters if p.linear or p.role in SIZE_ROLES}
        slots, p = self.solution.problem.layout.slots, self.solution.p
        own = [i for i, slot in enumerate(slots) if slot.effect == self.effect and slot.parameter in sizes]
        std = np.sqrt(np.maximum(np.diag(self._covariance)[own], 0.0))
        return float(np.min(std / np.maximum(np.abs(p[own]), 1e-300), initial=np.inf)) if own else 0.0

    def predicted_run(self, design: RunDesign, fine: int) -> VirtualRun:
        """Predict a planned run with at least `fine` panels per frame; the result is kept."""
        key = design, max([fine, *(e.fine for e in self.conservative.problem.model.effects)])
        if key not in self._simulated:
            self._simulated[key] = simulate_run(self.conservative, design, fine)
        return self._simulated[key]

    def scatter_with(self, run: VirtualRun) -> float:
        """Scatter of the friction levels with a planned run."""
        return expected_scatter(self.conservative, run.piece.run + 1)

    def uncertain_directions(self, run: VirtualRun) -> Array:
        """Whitened change (n, k) of a planned run for one standard deviation along each axis of what is uncertain.

        Uncertain are the unknowns of the fit, by their covariance, and the friction level of the run, by its scatter.
        """
        old = {name: i for i, name in enumerate(self.conservative.problem.layout.names)}
        active = run.response.active
        names = [run.layout.names[i] for i in active]
        covariance = np.diag([self.scatter_with(run) ** 2 * (i in run.layout.levels) for i in active])
        known = [k for k, name in enumerate(names) if name in old]
        before = [old[names[k]] for k in known]
        covariance[np.ix_(known, known)] = self._covariance[np.ix_(before, before)]
        variances, axes = np.linalg.eigh(covariance)
        return np.asarray(run.response.jac @ (axes * np.sqrt(np.maximum(variances, 0.0))))


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
    for smooth in smooth_forces(compress_residual(solution)):
        likeliest.setdefault(smooth.axis.name, smooth)
    found = []
    for name in [name for name in likeliest if name in AXIS_SYMBOLS][:MAX_AXES]:
        try:
            made = _fit_free_curve(solution, likeliest[name], PRIOR_STD_RATIO * friction)
        except FrictrackError:  # a curve under which no motion can be integrated
            continue
        found.append(FittedExplanation(AXES[name].name, made, max(solution.objective - made.objective, 0.0), made))
    return sorted(found, key=lambda e: -e.gain)


def _fit_free_curve(solution: Solution, smooth: SmoothForce, prior_std: float) -> Solution:
    """Fit the model with a free curve over one axis, starting from the smooth force."""
    knots = np.linspace(smooth.at[0], smooth.at[-1], N_HATS)
    effect = _free_curve_effect(AXES[smooth.axis.name].name, smooth.axis, knots, prior_std)
    old = solution.problem.layout
    layout = replace(old, model=replace(old.model, effects=(*old.model.effects, effect)))
    first = dict(zip(old.names, solution.p, strict=True))
    first |= {f"{effect.name}.h{k}": float(h) for k, h in enumerate(np.interp(knots, smooth.at, smooth.force))}
    problem, p = solution.problem.rebuild(layout, solution.problem.pieces), np.array([first[n] for n in layout.names])
    tau = solution.tau_of_other_runs
    return refine(problem, p, solution.starts, tau=tau, max_steps=MAX_STEPS_CURVE, min_fall=MIN_CHI2_FALL)


def _free_curve_effect(name: str, axis: Axis, knots: Array, prior_std: float) -> Effect:
    """An effect that is any piecewise linear curve over an axis, constant beyond its knots (K,)."""

    def columns(path: Path, nonlinear: Nonlinear) -> Array:
        hats = linear_interpolation_matrix(np.clip(axis.of(path), knots[0], knots[-1]), knots)
        return np.asarray(axis.times(path)[:, None] * hats)

    return Effect(
        name=name,
        acts_on="force",
        equation=f"any curve over {name}",
        parameters=tuple(Parameter(f"h{k}", "N", linear=True, prior=(0.0, prior_std)) for k in range(len(knots))),
        columns=columns,
        invariant=INVARIANTS[axis.name],
    )
