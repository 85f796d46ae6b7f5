"""Convert a fit to a prior for another set-up, and apply a prior to a model."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from frictrack.effects import Effect, Parameter, carries_over, scales_with_load
from frictrack.errors import FrictrackError
from frictrack.fit.parameters import MASS
from frictrack.fit.routes import FittedRuns
from frictrack.fit.uncertainty import Estimates, Misfit, reported_slots, reported_values_and_jacobian
from frictrack.models import Model
from frictrack.priors import Prior
from frictrack.records import Array

PRIOR_NEEDS_NOISE = (
    'expected domain = "displacement" with a prior but got "force", which gives the runs no weight against a prior; '
    "fit the displacement, or leave the prior out"
)
MIN_RELATIVE_EIGENVALUE = 1e-9  # of the correlation matrix of a prior; less is the rounding of the derivatives


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
        raise FrictrackError(PRIOR_NEEDS_NOISE, usage=True)
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
        raise FrictrackError(
            f"expected a model with a free parameter of the prior ({', '.join(here.names)}) but got "
            f"{', '.join(model.names)}; leave the prior out, or choose another model",
            usage=True,
        )
    return Model(tuple(e.adjusted(**changes[e.name]) if e.name in changes else e for e in model.effects))


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
        raise FrictrackError(
            f"expected {prior.names[i]} of the prior in {p.unit} but got {prior.units[i]}; it is another effect",
            usage=True,
        )
    low, high = (-np.inf, np.inf) if p.name in effect.quoted else p.bounds
    if not low <= prior.values[i] <= high:
        raise FrictrackError(
            f"expected a mean of {prior.names[i]} of the prior between {low:g} and {high:g} {p.unit} but got "
            f"{prior.values[i]:g}; widen the bounds, or leave the prior out",
            usage=True,
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
    at = [(k, i) for k, i in enumerate(reported_slots(layout)) if layout.names[i] not in left_out]
    at = [(k, i) for k, i in at if layout.slots[i].effect in effects]
    if not at:
        raise FrictrackError(
            "expected a parameter that carries over to another set-up (a shared, determined parameter of friction) but "
            f"the fit of {', '.join(effects)} has none"
        )
    names, slots = [layout.names[i] for _, i in at], [layout.slots[i] for _, i in at]
    own = [(effects[s.effect], effects[s.effect].parameter(s.parameter)) for s in slots]
    values = np.array([estimates.parameters[name].value for name in names], dtype=np.float64)
    jacobian = reported_values_and_jacobian(problem, fitted.solution.p)[1][[k for k, _ in at]]
    covariance = estimates.covariance + (0.0 if misfit is None else misfit.covariance)
    matrix = _regular(jacobian @ covariance @ jacobian.T)
    for error in _common_errors(fitted, own, from_motion):
        matrix += np.outer(error * values, error * values)
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


def _common_errors(
    fitted: FittedRuns, parameters: list[tuple[Effect, Parameter]], from_motion: bool
) -> Iterator[Array]:
    """Yield relative errors (K,) that are common to all runs: of the scale, and of the mass.

    A mass error cancels in a value that scales with the load, if the load is that of the mass.
    """
    scale = max(r.displacement.relative_scale_error for r in fitted.runs)
    yield scale * np.array([_length_power(q.unit, force_has_length=from_motion) for _, q in parameters])
    if from_motion:
        mass = max((r.sigma_mass / r.mass for r in fitted.runs if r.mass), default=0.0)
        load_from_mass = all(r.normal_load is None for r in fitted.runs)
        cancels = [load_from_mass and scales_with_load(e, q) for e, q in parameters]
        is_force = ["N" in q.unit for _, q in parameters]
        yield mass * (np.array(is_force) & ~np.array(cancels))


def _length_power(unit: str, *, force_has_length: bool) -> float:
    """Return the power of length in a unit: 1 of m/s; 0 of N s/m, where forces were computed from the motion.

    Examples
    --------
    >>> [_length_power(unit, force_has_length=True) for unit in ("N", "m/s", "N s/m", "N s^2/m^2", "1")]
    [1.0, 1.0, 0.0, -1.0, 0.0]

    """
    power = 0.0
    for sign, part in zip((1, -1), unit.partition("/")[::2], strict=True):
        for factor in part.split():
            symbol, _, exponent = factor.partition("^")
            if symbol == "m" or (symbol == "N" and force_has_length):
                power += sign * float(exponent or 1)
    return power
