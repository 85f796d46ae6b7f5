"""Convert a fit to a prior for another set-up, apply a prior to a model, and compare the data with the priors of a fit.

The estimate p of a linear model with prior mean m and covariance C has covariance V, the inverse of the sum of both
precisions. If the prior is true, p - m is normal with covariance C - V. With the estimate d of the data alone and its
covariance D, this gives the same chi-squared: (p - m)' (C - V)^-1 (p - m) = (d - m)' (C + D)^-1 (d - m). Directions in
which the data say nothing are left out. Errors that noise does not cover (a missing force, slow errors of the tracking)
are added.

References
----------
Box, G. E. P. (1980). Sampling and Bayes' inference in scientific modelling and robustness. J. R. Stat. Soc. A 143, 383.

"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from frictrack.base.distributions import chi2_sf
from frictrack.base.errors import FrictrackError, UsageError
from frictrack.base.number_format import format_plus_minus
from frictrack.effects import Effect, Parameter, carries_over, scales_with_load
from frictrack.effects.models import Model
from frictrack.fit.least_squares import Solution, white_noise_covariance
from frictrack.fit.parameters import MASS
from frictrack.fit.penalties import prior_departure, prior_jacobian, prior_residual
from frictrack.fit.routes import FittedRuns
from frictrack.fit.uncertainty import reported_values_and_jacobian
from frictrack.fit.uncertainty.estimates import Estimates, Misfit, stated_error_changes
from frictrack.fit.uncertainty.reported import reported_names
from frictrack.records import GRAVITY, Array, Run
from frictrack.settings.priors import Prior

PRIOR_NEEDS_NOISE = (
    'expected domain = "displacement" with a prior but got "force", which gives the runs no weight against a prior; '
    "fit the displacement, or leave the prior out"
)
MIN_RELATIVE_EIGENVALUE = 1e-9  # of the correlation matrix of a prior; less is the rounding of the derivatives
MIN_INFORMATION = 1e-3  # of the data relative to the prior; directions with less are left to the prior
ALPHA_CONTRADICTION = 0.01
MAX_NAMED = 3  # parameters in the remark
GRAVITY_STD = (9.832 - 9.780) / np.sqrt(12)  # m/s^2 at an unknown place: from equator to pole, equally likely


def apply_prior(model: Model, prior: Prior, load: float | None, domain: str = "displacement") -> Model:
    """Give the parameters of a model the prior of another set-up, at the normal `load` (N) of this study, if known.

    Only parameters that carry over (`carries_over`) and are free take part. A parameter that has a prior of its own, is
    fixed or tied keeps its setting; the prior of the others is then the marginal distribution.

    Raises
    ------
    FrictrackError
        (usage) If no parameter of the prior is free in the model, one has another unit or a mean outside its bounds, or
        the domain is "force", whose residuals are not weighted by their noise.

    """
    if domain == "force":
        raise UsageError(PRIOR_NEEDS_NOISE)
    here = prior.at_load(None if load is None or not np.isfinite(load) else load)
    std, correlation, taken = here.std, here.correlation, list[int]()
    changes: dict[str, dict[str, Any]] = {}
    for i, name in enumerate(here.names):
        if (found := _free(model, name)) is None:
            continue
        effect, p = found
        _check(effect, p, here, i)
        correlated = tuple((here.names[j], float(correlation[i, j])) for j in taken if correlation[i, j])
        own = {"prior": (here.values[i], std[i]), "prior_correlation": correlated}
        changes.setdefault(effect.name, {})[p.name] = own
        taken.append(i)
    if not taken:
        raise UsageError(
            f"expected a model with a free parameter of the prior ({', '.join(here.names)}) but got "
            f"{', '.join(model.names)}; leave the prior out, or choose another model"
        )
    return replace(model, effects=tuple(e.adjusted(**changes.get(e.name, {})) for e in model.effects))


def with_stated_incline(model: Model, runs: Sequence[Run], mass: float) -> Model:
    """Make an incline that is stated with an error an unknown of the fit: `slope`, with that prior.

    Runs of one course share it; runs with different inclines have one each. Where a circle is lowest is known as well
    as its radius. `mass`: of the reference, kg.
    """
    errors = [np.hypot(r.sigma_incline, r.sigma_radius / abs(r.radius)) if r.radius else r.sigma_incline for r in runs]
    sigma = float(max(errors)) if any(r.has_incline for r in runs) else 0.0
    if not sigma:
        return model
    prior = (0.0, mass * GRAVITY * float(np.cos(runs[0].incline)) * sigma)
    return model.joined_by("slope", {"prior": prior, "per_run": len({(run.incline, run.radius) for run in runs}) > 1})


def with_known_gravity(model: Model, runs: Sequence[Run]) -> Model:
    """Add gravity along circles that stand upright, where it is not in the model, as well as it is known.

    An error of the radius, of the scale or of the clock acts as one of g.
    """
    if "gravity" in model or not all(run.radius and run.has_incline for run in runs):
        return model
    errors = [(r.sigma_radius / float(r.radius or 1.0), r.displacement.relative_scale_error) for r in runs]
    sigma = float(np.hypot(GRAVITY * np.max(np.hypot(*np.transpose(errors))), GRAVITY_STD))
    known = {"fixed": None, "prior": (GRAVITY, sigma), "per_run": len({run.radius for run in runs}) > 1}
    return model.joined_by("gravity", known)


def _free(model: Model, address: str) -> tuple[Effect, Parameter] | None:
    """Return effect and parameter of an address, if they are in the model and the prior of a file applies to them."""
    name, _, parameter = address.rpartition(".")
    for effect in (e for e in model.effects if e.name == name):
        for p in (p for p in effect.parameters if p.name == parameter):
            return (effect, p) if p.free and p.prior is None and carries_over(effect, p) else None
    return None


def _check(effect: Effect, p: Parameter, prior: Prior, i: int) -> None:
    """Raise FrictrackError (usage) for another unit or a mean outside the bounds."""
    if p.unit != prior.units[i]:
        raise UsageError(
            f"expected {prior.names[i]} of the prior in {p.unit} but got {prior.units[i]}; it is another effect"
        )
    low, high = (-np.inf, np.inf) if p.name in effect.quoted else p.bounds
    if not low <= prior.values[i] <= high:
        raise UsageError(
            f"expected a mean of {prior.names[i]} of the prior between {low:g} and {high:g} {p.unit} but got "
            f"{prior.values[i]:g}; widen the bounds, or leave the prior out"
        )


def prior_of(
    fitted: FittedRuns, estimates: Estimates, misfit: Misfit | None, *, from_motion: bool, study: str
) -> Prior:
    """Convert a fit to a prior: the parameters that carry over, with their full covariance.

    The covariance includes noise, the effect of a missing force on a rejected model, and the errors of scale and mass,
    which are common to all runs of a set-up. Forces scale with length and mass where they were computed `from_motion`.
    Raises FrictrackError if no parameter carries over.
    """
    problem, reference = fitted.solution.problem, fitted.reference
    layout, effects = problem.layout, {e.name: e for e in problem.model.effects if e.name != MASS}
    left_out = dict(_left_out(effects, estimates))
    names = [name for name in reported_names(layout) if name not in left_out and name.rpartition(".")[0] in effects]
    if not names:
        raise FrictrackError(
            "expected a parameter that carries over to another set-up (a shared, determined parameter of friction) but "
            f"the fit of {', '.join(effects)} has none"
        )
    parts = [name.rpartition(".") for name in names]
    own = [(effects[effect], effects[effect].parameter(parameter)) for effect, _, parameter in parts]
    values = np.array([estimates.parameters[name].value for name in names], dtype=np.float64)
    jacobian = reported_values_and_jacobian(problem, fitted.solution.p, names)[1]
    covariance = estimates.covariance + (0.0 if misfit is None else misfit.covariance)
    matrix = _regular(jacobian @ covariance @ jacobian.T)
    load_from_mass = all(r.normal_load is None for r in fitted.runs)  # a mass error then cancels in what goes with load
    of_mass = np.array(["N" in q.unit and not (load_from_mass and scales_with_load(e, q)) for e, q in own])
    changes = stated_error_changes(fitted, {name: q.unit for name, (_, q) in zip(names, own, strict=True)}, of_mass)
    matrix += changes.T @ changes
    load = reference.load
    load_known = np.isfinite(load) and (reference.mass != 1.0 or not from_motion or load != 1.0)
    return Prior(
        names=tuple(names),
        values=tuple(map(float, values)),
        covariance=tuple(tuple(map(float, row)) for row in matrix),
        units=tuple(q.unit for _, q in own),
        loaded=tuple(scales_with_load(e, q) for e, q in own),
        load=float(load) if load_known else None,
        study=study,
        model=tuple(effects),
        left_out=tuple(left_out.items()),
    )


def _left_out(effects: dict[str, Effect], estimates: Estimates) -> Iterator[tuple[str, str]]:
    """Yield the parameters that do not enter a prior, each with the reason."""
    for address, found in estimates.parameters.items():
        name, _, parameter = address.partition("[")[0].rpartition(".")
        if name not in effects:
            continue
        if "[" in address or not carries_over(effects[name], effects[name].parameter(parameter)):
            yield address, "it belongs to the set-up, the course or a run"
        elif found.value is None or not found.std:
            yield address, found.reason or "its standard deviation is zero"
        elif found.at_bound:
            yield address, "it lies at its bound"


def _regular(matrix: Array) -> Array:
    """Return a covariance that is positive definite in spite of rounding."""
    std = np.sqrt(np.diag(matrix))
    correlation = matrix / std / std[:, None]
    size, vectors = np.linalg.eigh((correlation + correlation.T) / 2)
    size = np.maximum(size, MIN_RELATIVE_EIGENVALUE)
    return np.asarray((vectors * size) @ vectors.T * std * std[:, None], dtype=np.float64)


@dataclass(frozen=True)
class PriorParameter:
    """One parameter with a prior: mean and standard deviation before, and what the data alone say."""

    mean: float
    std: float
    unit: str
    data: float | None  # None where the data do not determine the parameter
    data_std: float | None
    p: float | None  # p-value of its own disagreement


@dataclass(frozen=True)
class PriorAgreement:
    """How far data and priors disagree.

    Attributes
    ----------
    chi2, dof, p
        Disagreement, directions in which the data say something, and p-value; p is None without such directions.
    parameters
        Parameters with a prior, by address.
    shares
        Share of the precision of every reported parameter that comes from the priors, 0 to 1, by address.

    """

    chi2: float
    dof: int
    p: float | None
    parameters: dict[str, PriorParameter] = field(default_factory=dict)
    shares: dict[str, float] = field(default_factory=dict)

    @property
    def contradicted(self) -> bool:
        """Whether the data contradict the priors, at `ALPHA_CONTRADICTION`."""
        return self.p is not None and self.p < ALPHA_CONTRADICTION

    def summary(self) -> dict[str, Any]:
        """Return the JSON of the agreement."""
        parameters = {name: vars(one) for name, one in self.parameters.items()}
        head = {"chi2": self.chi2, "dof": self.dof, "p": self.p, "contradicted": self.contradicted}
        return head | {"parameters": parameters}

    def remarks(self) -> Iterator[str]:
        """Yield what a reader must know of the priors."""
        if self.contradicted and self.p is not None:
            p = {name: q.p for name, q in self.parameters.items() if q.p is not None}
            worst = sorted(p, key=lambda name: p[name])[:MAX_NAMED]
            named = [name for name in worst if p[name] < ALPHA_CONTRADICTION] or worst[:1]
            text = ", ".join(_contrast(name, self.parameters[name]) for name in named)
            yield (
                f"the runs contradict the prior: {text} (p = {self.p:.2g}); the values are a compromise of both and "
                "their standard deviations are too small. Fit without the prior, or widen it with prior_scale"
            )
        elif self.p is None:
            yield "the runs say nothing of the parameters with a prior; their values are those of the prior"


def _contrast(name: str, one: PriorParameter) -> str:
    """Return what the runs say of a parameter against its prior."""
    unit = "" if one.unit == "1" else f" {one.unit}"
    before = f"{format_plus_minus(one.mean, one.std)}{unit}"
    if one.data is None:
        return f"{name} against {before}"
    return f"{name} {format_plus_minus(one.data, one.data_std)}{unit} against {before}"


def prior_agreement(solution: Solution, covariance: Array) -> PriorAgreement | None:
    """Compare the data with the priors of a fit, whose unknowns have a covariance (P, P) with all known errors.

    None for a fit without priors.
    """
    layout, p = solution.problem.layout, solution.p
    if not layout.priors:
        return None
    noise, _ = white_noise_covariance(solution)
    rows = prior_jacobian(layout, p)
    explained = rows @ noise @ rows.T  # covariance of the estimate in standard deviations of the prior
    size, vectors = np.linalg.eigh((explained + explained.T) / 2)
    informed = 1 - size > MIN_INFORMATION
    gain = np.clip(1 - size[informed], MIN_INFORMATION, 1.0)
    to_informed = vectors[:, informed].T
    more = _other_errors(explained, rows @ covariance @ rows.T)
    expected = np.diag(gain) + to_informed @ more @ to_informed.T
    seen = to_informed @ prior_residual(layout, p)
    total = float(seen @ np.linalg.solve(expected, seen)) if informed.any() else 0.0
    dof = int(np.count_nonzero(informed))
    p_value = float(chi2_sf(total, dof)) if dof else None
    alone = _DataAlone(vectors[:, informed], vectors[:, ~informed], gain, expected, seen)
    parameters = dict(_parameters(solution, alone))
    return PriorAgreement(total, dof, p_value, parameters, _shares(solution, noise, rows, alone))


@dataclass(frozen=True)
class _DataAlone:
    """The priors' space, in independent standard deviations: directions that the data see, and those they do not."""

    informed: Array  # (m, d)
    blind: Array  # (m, m - d)
    gain: Array  # (d,), share of the precision that the data have
    expected: Array  # (d, d), covariance of the estimate about the mean if the prior is true
    seen: Array  # (d,), the estimate less the mean


def _parameters(solution: Solution, alone: _DataAlone) -> Iterator[tuple[str, PriorParameter]]:
    """Yield the parameters with a prior."""
    layout = solution.problem.layout
    back = np.linalg.inv(layout.prior_whitening)
    informed, blind = back @ alone.informed, back @ alone.blind
    departure = prior_departure(layout, solution.p)
    units = {name: s.unit for name, s in zip(layout.names, layout.slots, strict=True)}
    data = informed @ (alone.seen / alone.gain)
    variance = (informed / alone.gain) @ alone.expected @ (informed / alone.gain).T - informed @ informed.T
    expected = np.einsum("id,de,ie->i", informed, alone.expected, informed)
    for i, q in enumerate(layout.priors):
        known = np.sum(blind[i] ** 2) < MIN_INFORMATION * q.std**2
        own = float(chi2_sf(departure[i] ** 2 / expected[i], 1)) if expected[i] > MIN_INFORMATION * q.std**2 else None
        value = q.mean + float(data[i]) if known else None
        deviation = float(np.sqrt(max(variance[i, i], 0.0))) if known else None
        yield q.address, PriorParameter(q.mean, q.std, units[q.address], value, deviation, own)


def _shares(solution: Solution, noise: Array, rows: Array, alone: _DataAlone) -> dict[str, float]:
    """Share of the precision of every reported parameter that is due to the priors: 1 - variance / variance without."""
    layout = solution.problem.layout
    _, jacobian = reported_values_and_jacobian(solution.problem, solution.p)
    towards = jacobian @ noise @ rows.T
    own = np.einsum("ai,ij,aj->a", jacobian, noise, jacobian)
    added = np.sum((towards @ alone.informed) ** 2 / alone.gain, axis=1)
    unseen = np.sum((towards @ alone.blind) ** 2, axis=1) > MIN_INFORMATION * np.maximum(own, 1e-300)
    share = np.where(unseen, 1.0, added / np.maximum(own + added, 1e-300))
    return dict(zip(reported_names(layout), map(float, share), strict=True))


def _other_errors(explained: Array, total: Array) -> Array:
    """What errors beyond white noise add to the covariance of the estimate, in units of the prior, (m, m)."""
    # a factor that is common to all variances (Student's t, as the noise level is estimated) is applied to the share of
    # the data alone: the standard deviations of the prior are known
    factor = np.linalg.cholesky(explained + 1e-12 * np.eye(len(explained)))
    ratio = np.linalg.solve(factor, np.linalg.solve(factor, total).T)
    wider = max(float(np.linalg.eigvalsh((ratio + ratio.T) / 2)[0]), 1.0)
    return _positive(total - wider * explained) + _positive((wider - 1) * (explained - explained @ explained))


def _positive(matrix: Array) -> Array:
    """Return the part of a symmetric matrix with positive eigenvalues."""
    size, vectors = np.linalg.eigh((matrix + matrix.T) / 2)
    return np.asarray((vectors * np.maximum(size, 0.0)) @ vectors.T)
