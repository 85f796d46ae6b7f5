"""Convert fitted unknowns to estimates: value, standard deviation, and the reason where no value is given.

A parameter has no value if the data do not respond to it, or if its profile is not bounded.

The standard deviations of a fit hold if only noise is left. A rejected model misses a force, which biases its
parameters by far more than noise does. The missing force is modelled as a Gaussian process: independent in every run,
or a function of position or speed that all runs share. Its size and length have the highest restricted likelihood.
Its effect on the least-squares parameters is the sandwich

    (J'J)^-1 J'T S T'J (J'J)^-1

with T the trace of the force in the data and S its covariance. The part of the force that looks like the model cannot
be seen in the residual, but it is as large as the part that can.

Propagate the stated errors of scale and mass, which all runs share, to the reported parameters.

The fit is made in measured lengths and with the stated mass. With a true length (1 + e) times the measured one and a
true mass (1 + d) times the stated one, the measured motion obeys

    m x'' = (K - e K - d D) - F / ((1 + e) (1 + d)),     K = D - m g sin(incline)

to first order. A force is therefore (1 + e) (1 + d) times the fitted one, and the model also fits its parameters to the
acceleration -(e K + d D) / m as if it were friction. An error of the incline is an unknown of the fit: `slope`.

References
----------
Kennedy, M. C. & O'Hagan, A. (2001). Bayesian calibration of computer models. J. R. Stat. Soc. B 63, 425-464.
Rasmussen, C. E. & Williams, C. K. I. (2006). Gaussian Processes for Machine Learning, ch. 5. MIT Press.
White, H. (1982). Maximum likelihood estimation of misspecified models. Econometrica 50, 1-25.

"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from difflib import get_close_matches
from typing import Any, NoReturn

import numpy as np

from frictrack.base.errors import FrictrackError
from frictrack.base.number_format import format_plus_minus, join_words, lower_first
from frictrack.effects import Effect
from frictrack.fit.least_squares import PieceResponse, Solution, displacement_response, white_noise_covariance
from frictrack.fit.least_squares.solution import (
    MIN_SINGULAR_VALUE,
    NORMAL_QUANTILE_975,
    covariance_of,
    model_projection,
)
from frictrack.fit.parameters import LEVEL, MASS
from frictrack.fit.penalties import prior_jacobian
from frictrack.fit.pieces import consecutive_slices
from frictrack.fit.routes import FittedRuns
from frictrack.fit.smooth_functions import (
    correlation_time_frames,
    linear_interpolation_matrix,
    matern_root,
    most_likely_process,
)
from frictrack.fit.uncertainty.profile_likelihood import NO_RESPONSE, PROBE_MIN_FALL, ProfileSearch
from frictrack.fit.uncertainty.reported import (
    correlated_noise_remark,
    deciding_experiment,
    drive_noise_remark,
    identifiability_remarks,
    negative_force_remark,
    parse_quantity,
    reported_names,
    reported_slots,
    reported_values_and_jacobian,
    standard_deviations,
)
from frictrack.records import Array

MIN_CORRELATION = 0.95  # stronger correlations are reported
# standard deviations of an amplitude from zero, and of a parameter from its bounds: certainly determined
MIN_EVIDENCE, MIN_DISTANCE_STD = 8.0, 20.0
UNDETERMINED_PHASE_STD = np.pi / NORMAL_QUANTILE_975  # rad; the 95 % interval covers the whole circle
KNOTS = {"x": 60, "v": 40}  # knots of a force that all runs share
MAX_KNOTS, MIN_KNOTS, KNOTS_A_RUN = 400, 3, 32  # knots of independent forces: over all pieces; per piece
CORRELATION_LENGTHS = (4.0, 1.5, 0.5, 0.2, 0.08)  # correlation lengths of the force, share of the axis
SMOOTHNESS = 1.5  # of the force: its slope may jump, as at an edge; a smoother one would promise too much
MAX_TRACE = 100.0  # standard deviations of noise; a larger force would not leave the motion as it was linearised
MIN_EVIDENCE_SHARE = 0.5  # share of the best evidence; less plausible axes are ignored
MIN_MISFIT_EVIDENCE = 10.0  # twice the rise of the log likelihood from which a misfit is reported
MIN_AXIS_RANGE = 1e-6  # share of the largest value; narrower axes are ignored
REJECTION_REMARK = (
    "the model is rejected: it misses a force. A standard deviation of noise alone means nothing then; the wider one "
    "holds for a missing force of the size that the residual shows"
)
MAX_NOISE_CHI2 = 1.2  # chi-squared per degree of freedom up to which a residual counts as noise
_Forces = list[tuple[slice, Array]]  # per piece: which of all K forces act there, and their values (m, k) at its nodes


@dataclass(frozen=True)
class Estimate:
    """The estimate of one parameter: value and standard deviation in `unit`, or None with the reason.

    If the friction level scatters over few runs, +-1.96 `std` covers 95 % (Student's t with runs - 1 degrees).

    Examples
    --------
    >>> print(Estimate(0.09986, 0.00012, "m"))
    0.09986 ± 0.00012 m

    """

    value: float | None
    std: float | None
    unit: str
    at_bound: bool = False
    reason: str | None = None
    interval: tuple[float | None, float | None] | None = None  # 95 %, from a profile or bootstrap; None: unbounded
    std_misfit: float | None = None  # including the missing force of a rejected model

    def __str__(self) -> str:
        return f"{format_plus_minus(self.value, self.reported_std)} {'' if self.unit == '1' else self.unit}".strip()

    @property
    def reported_std(self) -> float | None:
        """Standard deviation to report alone: with the effect of a missing force where the model is rejected."""
        return self.std if self.std_misfit is None else self.std_misfit

    def is_significant(self, times: float) -> bool:
        """Return whether the value exceeds so many of its own standard deviations."""
        std = self.reported_std
        return self.value is not None and std is not None and abs(self.value) > times * std

    def json(self) -> dict[str, Any]:
        """Return JSON; `interval` and `std_misfit` only where they are known."""
        out = {k: v for k, v in vars(self).items() if v is not None or k not in ("interval", "std_misfit")}
        return out | ({} if self.interval is None else {"interval": list(self.interval)})


class UnknownParameterError(FrictrackError, KeyError):
    """The address is no parameter of the fit; the message lists the nearest ones."""

    __str__ = FrictrackError.__str__  # that of KeyError adds quotes


class Parameters(dict[str, Estimate]):
    """The estimates of a fit by address; an unknown address raises `UnknownParameterError`, which is a `KeyError`."""

    def __missing__(self, address: str) -> NoReturn:
        by_folded = {key.lower(): name for name in self for key in (name, name.rpartition(".")[2])}  # F_c, f_c
        nearest = [by_folded[found] for found in get_close_matches(str(address).lower(), by_folded, 3, 0.5)]
        what = f"did you mean {', '.join(dict.fromkeys(nearest))}?" if nearest else f"it has {', '.join(self)}"
        raise UnknownParameterError(f'expected a parameter of the fit but got "{address}"; {what}', usage=True)

    def __repr__(self) -> str:
        return "\n".join(f"{address}  {estimate}" for address, estimate in self.items())


@dataclass(frozen=True)
class Estimates:
    """All estimates by address, the covariance (P, P) of the unknowns, strong correlations, and remarks."""

    parameters: Parameters
    covariance: Array
    correlations: list[tuple[str, str, float]]
    remarks: list[str]

    def with_intervals(self, found: dict[str, tuple[float | None, float | None]]) -> Estimates:
        """Return the same estimates with intervals, by address."""
        changed = {name: replace(e, interval=found[name]) for name, e in self.parameters.items() if name in found}
        return replace(self, parameters=Parameters(self.parameters | changed))


def estimate_parameters(solution: Solution, *, profile: bool = True) -> Estimates:
    """Compute estimates from a fit; `profile` tests by further fits whether non-linear parameters are bounded."""
    covariance, unseen = covariance_of(solution)
    reasons = undetermined_reasons(solution, covariance, profiles=True) if profile else {}
    return _estimates(solution, covariance, unseen_reasons(solution, unseen) | reasons)


def linear_estimates(solution: Solution, covariance: Array | None = None) -> Estimates:
    """Compute estimates from the model linearised where it stands; by default with the covariance of its noise."""
    own, unseen = covariance_of(solution)
    covariance = own if covariance is None else covariance
    reasons = unseen_reasons(solution, unseen) | undetermined_reasons(solution, covariance, profiles=False)
    return _estimates(solution, covariance, reasons)


def with_misfit(found: Estimates, solution: Solution, covariance: Array) -> Estimates:
    """Add what a missing force adds to the covariance (P, P) to the standard deviations of fitted parameters."""
    parameters = Parameters(found.parameters)
    _, jacobian = reported_values_and_jacobian(solution.problem, solution.p)
    added = standard_deviations(jacobian, covariance)
    for name, more in zip(reported_names(solution.problem.layout), added, strict=True):
        if (std := parameters[name].std) is not None:
            parameters[name] = replace(parameters[name], std_misfit=float(np.hypot(std, more)))
    return replace(found, parameters=parameters)


def _estimates(solution: Solution, covariance: Array, reasons: dict[str, str]) -> Estimates:
    """Estimates of fitted, fixed and tied parameters; those with a reason (by address) get no value."""
    layout, names, p = solution.problem.layout, solution.problem.layout.names, solution.p
    values, jacobian = reported_values_and_jacobian(solution.problem, p)
    std = standard_deviations(jacobian, covariance)
    low, high = layout.bounds
    tolerance = 1e-6 * np.maximum(1.0, np.abs(p))
    at_bound = (p <= low + tolerance) | (p >= high - tolerance)
    out = Parameters()
    for i, value, deviation in zip(reported_slots(layout), values, std, strict=True):
        reason = reasons.get(names[i])
        shown, std_shown = (None, None) if reason else (float(value), float(deviation))
        out[names[i]] = Estimate(shown, std_shown, layout.slots[i].unit, bool(at_bound[i]), reason)
    for (effect, parameter), value in layout.fixed.items():
        unit = layout.effect(effect).parameter(parameter).unit
        out[f"{effect}.{parameter}"] = Estimate(value, 0.0, unit, False, "fixed")
    out |= _tied_estimates(solution, covariance, out)
    correlated = correlations(names, reported_slots(layout), covariance)
    remarks = [
        *identifiability_remarks(solution, correlated, list(reasons)),
        *negative_force_remark(solution, {name: (e.value, e.std) for name, e in out.items()}),
        *correlated_noise_remark(solution),
        *drive_noise_remark(solution),
    ]
    return Estimates(out, covariance, correlated, remarks)


def _tied_estimates(solution: Solution, covariance: Array, known: dict[str, Estimate]) -> dict[str, Estimate]:
    """Estimates of tied parameters, from those that they follow."""
    tied = solution.problem.layout.tied_parameters()
    values, jacobian = reported_values_and_jacobian(solution.problem, solution.p, [address for address, *_ in tied])
    out: dict[str, Estimate] = {}
    for (address, tie, unit), value, std in zip(tied, values, standard_deviations(jacobian, covariance), strict=True):
        leader = known.get(f"{tie.effect}.{tie.parameter}")
        if leader is not None and leader.value is None:
            out[address] = Estimate(None, None, unit, False, f"tied to {tie}, which these runs do not determine")
        else:
            out[address] = Estimate(float(value), float(std), unit, False, f"tied to {tie}")
    return out


def correlations(names: list[str], at: list[int], covariance: Array) -> list[tuple[str, str, float]]:
    """Return pairs of the unknowns `at` that are strongly correlated: both addresses and the correlation."""
    d = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
    r = covariance / d[:, None] / d
    pairs = [(a, b) for k, a in enumerate(at) for b in at[k + 1 :]]
    return [(names[a], names[b], round(float(r[a, b]), 4)) for a, b in pairs if abs(r[a, b]) > MIN_CORRELATION]


def unseen_reasons(solution: Solution, unseen: Array) -> dict[str, str]:
    """Return by address why the linearised model does not determine some unknowns, `unseen` (P,)."""
    layout = solution.problem.layout
    at = reported_slots(layout)
    out = {layout.names[i]: _confused_with(solution, i) for i in at if unseen[i]}
    if MASS in layout.model and unseen[layout.index(MASS, "m")]:
        why = "these runs do not determine the mass, and no force without it"
        out = {layout.names[i]: why for i in at if layout.slots[i].linear} | out
    return out


def _confused_with(solution: Solution, i: int) -> str:
    """Why an unknown is not determined: what it is confused with, and which run would separate them."""
    layout, jac = solution.problem.layout, solution.few_rows
    norm = np.linalg.norm(jac, axis=0)
    if norm[i] == 0:
        return NO_RESPONSE
    norm[norm == 0] = 1.0
    _, s, vt = np.linalg.svd(jac / norm, full_matrices=False)
    weight = np.max(np.abs(vt[s <= MIN_SINGULAR_VALUE * s[0]]), axis=0, initial=0.0)
    others = [int(j) for j in np.flatnonzero(weight > 0.05) if j != i and layout.slots[j].effect != LEVEL]
    named = join_words([layout.names[j] for j in others[:3]]) or "the other parameters"
    advice = deciding_experiment(layout.model, [layout.slots[j].effect for j in (i, *others)])
    return f"these runs cannot tell it from {named}{f'; {lower_first(advice)}' if advice else ''}"


def undetermined_reasons(solution: Solution, covariance: Array, *, profiles: bool) -> dict[str, str]:
    """Find non-linear parameters, and F_s, whose profile is not bounded.

    F_s and v_s are reported together: only if the interval of F_s - F_c excludes zero and that of v_s is bounded on
    both sides. Without profiles these two alone are judged, by their standard deviations.
    """
    out: dict[str, str] = {}
    std = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    for effect in solution.problem.model.effects:
        is_whole = effect.kind == "stribeck" and solution.problem.layout.are_shared_unknowns(effect.name, "F_s", "v_s")
        if is_whole and (why := _stribeck_reason(solution, covariance, std, effect, profiles)):
            out |= {f"{effect.name}.{p.name}": why for p in effect.parameters if p.free}
        elif profiles and effect.name != MASS:
            out |= dict(_unbounded_parameters(solution, covariance, std, effect))
    return out


def _stribeck_reason(solution: Solution, covariance: Array, std: Array, effect: Effect, profiles: bool) -> str | None:
    """Why F_s and v_s are not determined; None if they are."""
    layout, p = solution.problem.layout, solution.p
    rise, speed = layout.index(effect.name, "F_s"), layout.index(effect.name, "v_s")
    advice = f"the slowest speed seen is {layout.span.v_min:.2g} m/s: film a run that slows to a stop"
    no_rise, no_speed = "F_s - F_c is not distinguishable from zero", "v_s is not bounded on both sides"
    why: str | None = None
    if not profiles:
        is_rise = p[rise] >= NORMAL_QUANTILE_975 * std[rise]
        is_speed = p[speed] >= NORMAL_QUANTILE_975 * std[speed]
    elif p[rise] > MIN_EVIDENCE * std[rise] and _is_far_from_bounds(solution, std, speed):
        return None
    else:
        has_level = layout.are_shared_unknowns("coulomb", "F_c")  # a fixed Coulomb level is not an unknown
        address = f"{effect.name}.F_s - coulomb.F_c" if has_level else f"{effect.name}.F_s"
        level = 0.0 if has_level else layout.reported_values(p).get("coulomb.F_c", 0.0)
        is_rise = p[rise] > 0 and _probe(solution, covariance, address).excluded(level)
        why = _reason_unbounded(solution, covariance, speed) if is_rise else None
        is_speed = not why
    if is_rise and is_speed:
        return None
    return "; ".join([": ".join(filter(None, [no_speed, why])) if is_rise else no_rise, advice])


def _unbounded_parameters(
    solution: Solution, covariance: Array, std: Array, effect: Effect
) -> Iterator[tuple[str, str]]:
    """Yield the non-linear parameters of one effect that are not bounded on both sides, with the reason."""
    layout = solution.problem.layout
    mine = [(i, s) for i, s in enumerate(layout.slots) if s.effect == effect.name]
    sizes = {p.name for p in effect.parameters if p.linear or p.role == "depth"}
    for i, slot in mine:
        if slot.parameter in sizes:
            continue
        # amplitudes of the same run, or of all runs
        own = [k for k, s in mine if s.parameter in sizes and (None in (s.run, slot.run) or s.run == slot.run)]
        evidence = min((abs(solution.p[k]) / max(std[k], 1e-300) for k in own), default=0.0)
        if effect.parameter(slot.parameter).role == "phase":
            why = f"any phase fits (± {std[i]:.2g} rad)" if std[i] > UNDETERMINED_PHASE_STD else None
        elif evidence > MIN_EVIDENCE and _is_far_from_bounds(solution, std, i):
            continue
        else:
            why = _reason_unbounded(solution, covariance, i)
        if why:
            yield layout.names[i], f"{why}; {lower_first(effect.confirm)}" if effect.confirm else why


def _is_far_from_bounds(solution: Solution, std: Array, i: int) -> bool:
    """Whether an unknown is certainly determined, so far is it from both bounds."""
    low, high = solution.problem.layout.slots[i].bounds
    return bool(min(solution.p[i] - low, high - solution.p[i]) > MIN_DISTANCE_STD * std[i])


def _probe(solution: Solution, covariance: Array, address: str) -> ProfileSearch:
    """A rough profile."""
    quantity = parse_quantity(solution.problem.layout, address)
    return ProfileSearch(solution, quantity, covariance, min_fall=PROBE_MIN_FALL)


def _reason_unbounded(solution: Solution, covariance: Array, i: int) -> str | None:
    """Why the profile of one unknown is unbounded; None if it is bounded on both sides."""
    search = _probe(solution, covariance, solution.problem.layout.names[i])
    try:
        found = [search.bounded(side) for side in (-1, 1)]
    except (FrictrackError, np.linalg.LinAlgError):
        return "its misfit cannot be followed"
    return next((why for is_bounded, why in found if not is_bounded), None)


def with_stated_errors(found: Estimates, fitted: FittedRuns) -> Estimates:
    """Add the stated errors of scale and mass to the standard deviations and intervals of fitted parameters."""
    units = {name: one.unit for name, one in found.parameters.items() if one.std}
    added = np.sqrt(np.sum(stated_error_changes(fitted, units) ** 2, axis=0))
    wider = {name: _wider(found.parameters[name], float(more)) for name, more in zip(units, added, strict=True)}
    return replace(found, parameters=Parameters(found.parameters | wider))


def _wider(one: Estimate, more: float) -> Estimate:
    """An estimate with one more independent standard deviation."""
    if not more or one.value is None:
        return one
    std, misfit = (None if s is None else float(np.hypot(s, more)) for s in (one.std, one.std_misfit))
    low, high = (
        None if end is None else one.value + sign * float(np.hypot(end - one.value, NORMAL_QUANTILE_975 * more))
        for sign, end in zip((-1, 1), one.interval or (None, None), strict=True)
    )
    return replace(one, std=std, std_misfit=misfit, interval=one.interval and (low, high))


def stated_error_changes(fitted: FittedRuns, units: Mapping[str, str], of_mass: Array | None = None) -> Array:
    """Compute by how much one standard deviation of each stated error changes reported parameters, (sources, A).

    `units`: of the parameters by address; `of_mass` (A,): whether each is proportional to the mass, by default forces.
    """
    solution, problem = fitted.solution, fitted.solution.problem
    scale = max((run.displacement.relative_scale_error for run in fitted.runs), default=0.0)
    mass = max((run.sigma_mass / run.mass for run in fitted.runs if run.mass), default=0.0)
    if not units or not (scale or (mass and problem.simulates)):
        return np.zeros((0, len(units)))
    values, jacobian = reported_values_and_jacobian(problem, solution.p, list(units))
    lengths, forces = _powers(units.values(), force_has_length=problem.simulates)
    if not problem.simulates:
        return (scale * lengths * values)[None]
    as_friction = [jacobian @ shift for shift in _shifts(solution)]
    own = (lengths * values, (forces if of_mass is None else of_mass) * values)
    return np.array([size * (o - f) for size, o, f in zip((scale, mass), own, as_friction, strict=True)])


def _powers(units: Iterable[str], *, force_has_length: bool) -> tuple[Array, Array]:
    """Powers of length and of mass (A,) in values of these units."""
    lengths = [length_power(unit, force_has_length=force_has_length) for unit in units]
    return np.array(lengths), np.array(["N" in unit for unit in units], dtype=float)


def _shifts(solution: Solution) -> Iterator[Array]:
    """Yield the changes (P,) of the unknowns per relative error of the scale, and of the mass."""
    # a prior is of the true values, and so it takes a part of their error
    layout = solution.problem.layout
    covariance, priors = white_noise_covariance(solution)[0], prior_jacobian(layout, solution.p)
    values = layout.reported_values(solution.p)
    held = np.array([values[q.address] for q in layout.priors])
    powers = _powers([layout.slots[layout.names.index(q.address)].unit for q in layout.priors], force_has_length=True)
    known = [r.piece.mass * r.piece.known for r in solution.responses]
    drives = [np.zeros_like(r.piece.known) if (d := r.piece.path.drive) is None else d for r in solution.responses]
    for power, forces in zip(powers, (known, drives), strict=True):
        pairs = zip(solution.responses, forces, strict=True)
        rows = [displacement_response(r, force[:, None]).T @ r.jac for r, force in pairs]
        pull = solution.stacked(rows).sum(axis=0)
        if layout.priors:
            pull += priors.T @ (layout.prior_whitening @ (power * held))
        yield covariance @ pull


def length_power(unit: str, *, force_has_length: bool) -> float:
    """Return the power of length in a unit: 1 of m/s; 0 of N s/m, where forces were computed from the motion.

    Examples
    --------
    >>> [length_power(unit, force_has_length=True) for unit in ("N", "m/s", "N s/m", "N s^2/m^2", "1")]
    [1.0, 1.0, 0.0, -1.0, 0.0]

    """
    power = 0.0
    for sign, part in zip((1, -1), unit.partition("/")[::2], strict=True):
        for factor in part.split():
            symbol, _, exponent = factor.partition("^")
            if symbol == "m" or (symbol == "N" and force_has_length):
                power += sign * float(exponent or 1)
    return power


@dataclass(frozen=True)
class Misfit:
    """The missing force of a rejected model."""

    axis: str  # what the force is a function of: "t" (independent in every run), "x" or "v"
    evidence: float  # twice the rise of the log restricted likelihood
    covariance: Array  # what it adds to the covariance of the unknowns, (P, P)

    def summary(self) -> dict[str, Any]:
        """Return the JSON `misfit` of a fit."""
        return {"axis": self.axis, "evidence": self.evidence, "words": REJECTION_REMARK}


def misfit_of(solution: Solution) -> Misfit | None:
    """Find the most likely missing force of a model, and its effect on the unknowns; None for noise alone."""
    if len(solution.responses) * MIN_KNOTS > MAX_KNOTS:
        return None
    projection = model_projection(solution)
    inverse_hessian, _ = white_noise_covariance(solution)
    candidates = []
    for axis, forces, roots in _force_bases(solution):
        gram, data, gradient = _trace_products(solution, projection, forces)
        force = most_likely_process(gram, data, roots, MAX_TRACE)
        moved = inverse_hessian @ gradient @ force.prior
        candidates.append(Misfit(axis, force.gain, moved @ moved.T))
    best = max(candidates, key=lambda m: m.evidence)
    plausible = [m for m in candidates if m.evidence > MIN_EVIDENCE_SHARE * best.evidence]
    return _widest_covariance(best, plausible) if best.evidence > MIN_MISFIT_EVIDENCE else None


def _trace_products(solution: Solution, projection: tuple[Array, Array], forces: _Forces) -> tuple[Array, Array, Array]:
    """Inner products of the traces of K unit forces in the data."""
    # they are those of what the model cannot follow of them with itself (K, K), with the residual (K,), and those of
    # the whole traces with the Jacobian (P, K)
    (u, r), size = projection, max(columns.stop for columns, _ in forces)
    slices = consecutive_slices(len(response.r) for response in solution.responses)
    gram, data = np.zeros((size, size)), np.zeros(size)
    on_model, gradient = np.zeros((u.shape[1], size)), np.zeros((len(solution.p), size))
    for rows, response, (columns, values) in zip(slices, solution.responses, forces, strict=True):
        trace = displacement_response(response, values)
        gram[columns, columns] += trace.T @ trace
        data[columns] += r[rows] @ trace
        on_model[:, columns] += u[rows].T @ trace
        gradient[response.active, columns] += response.jac.T @ trace
    return gram - on_model.T @ on_model, data, gradient


def _widest_covariance(best: Misfit, plausible: list[Misfit]) -> Misfit:
    """The most likely force, its covariance scaled to the largest standard deviation under any plausible force."""
    # the axis of the missing force is uncertain, and the standard deviations must hold for each plausible one
    own = np.sqrt(np.maximum(np.diag(best.covariance), 1e-300))
    largest = np.sqrt(np.max([np.diag(m.covariance) for m in plausible], axis=0))
    scale = np.maximum(largest / own, 1.0)
    return Misfit(best.axis, best.evidence, best.covariance * scale[:, None] * scale)


def dispersion(solution: Solution) -> float:
    """Compute the factor by which differences of chi-squared are divided while a model leaves more than noise.

    It is chi-squared per degree of freedom times the correlation time of the residual in frames, at least 1
    (quasi-likelihood; Wedderburn 1974, Biometrika 61, 439-447).
    """
    free = max(solution.problem.n_frames - len(solution.p) - 2 * len(solution.responses), 1)
    chi2_per_frame = solution.chi2 / free
    if chi2_per_frame < MAX_NOISE_CHI2:
        return 1.0
    return max(chi2_per_frame * max(1.0, *(correlation_time_frames(r.r) for r in solution.responses)), 1.0)


def _force_bases(solution: Solution) -> Iterator[tuple[str, _Forces, list[Array]]]:
    """Yield axis, unit forces through knots along every piece, and roots of their covariances for every length."""
    motions = [_motion_at_nodes(solution, r) for r in solution.responses]
    count = int(np.clip(MAX_KNOTS // len(motions), MIN_KNOTS, KNOTS_A_RUN))
    own: _Forces = [
        (slice(i * count, (i + 1) * count), linear_interpolation_matrix(t, np.linspace(t[0], t[-1], count)))
        for i, (t, *_) in enumerate(motions)
    ]
    yield "t", own, [np.asarray(np.kron(np.eye(len(motions)), root)) for root in _roots(count)]
    for axis, values in (("x", [x for _, x, _, _ in motions]), ("v", [np.abs(v) for _, _, v, _ in motions])):
        low, high = min(float(u.min()) for u in values), max(float(u.max()) for u in values)
        if not high - low > MIN_AXIS_RANGE * max(abs(low), abs(high)):
            continue
        knots = np.linspace(low, high, KNOTS[axis])
        dry = [factor for *_, factor in motions]
        for factors in (dry, [np.sign(f) if axis == "v" else np.ones_like(f) for f in dry]):
            pairs = zip(values, factors, strict=True)
            shared = [(slice(0, len(knots)), linear_interpolation_matrix(u, knots) * f[:, None]) for u, f in pairs]
            yield axis, shared, _roots(len(knots))


def _roots(count: int) -> list[Array]:
    return [matern_root(np.linspace(0.0, 1.0, count), length, SMOOTHNESS) for length in CORRELATION_LENGTHS]


def _motion_at_nodes(solution: Solution, response: PieceResponse) -> tuple[Array, Array, Array, Array]:
    """Time, position, velocity, and load times direction at the nodes of one piece, (m,) each."""
    piece = response.piece
    _, level = solution.problem.layout.values(solution.p, piece.run)
    path = piece.path_at_nodes(response.motion.x, response.motion.v, level)
    return piece.panels.t, path.x, path.v, path.load * path.s
