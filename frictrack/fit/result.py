"""The result of a fit: parameters with standard deviations, errors in every unit, curves for plots."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from frictrack.fit import measured_friction, routes
from frictrack.fit.collisions import collisions
from frictrack.fit.force_domain import reduced_chi2
from frictrack.fit.free_run import FreeRun, free_errors, free_run
from frictrack.fit.least_squares import PieceResponse, Solution, heldout_rms
from frictrack.fit.modelled_motion import band_summary, covariance_at_fitted_scatter, modelled_motion
from frictrack.fit.parameters import MIN_RUNS_FOR_SCATTER, with_fitted_mass, without_mass
from frictrack.fit.routes import FitOutcome, Route
from frictrack.fit.segments import Reference
from frictrack.fit.uncertainty import (
    Estimate,
    Estimates,
    Misfit,
    UncertaintyAnalysis,
    estimate_parameters,
    linear_estimates,
    misfit_of,
    with_misfit,
)
from frictrack.fit.uncertainty import reported_by_address as quoted
from frictrack.models import Model
from frictrack.records import Array, Curve, ModelledMotion, Run


@dataclass(frozen=True, eq=False)
class Fit:
    """A model fitted to runs.

    Attributes
    ----------
    found : FitOutcome
        The solution.
    runs : tuple of Run
        The fitted runs.
    validation : tuple of Run
        Runs that are only predicted.
    predictions : tuple of Solution
        Their predictions, shared parameters held.
    reference : Reference
        Mass and load at which newtons are reported.
    route : Route
        Domain and search.
    lengths : tuple of int
        Frames per segment of every run; 0 for whole stretches.
    uncertainty : UncertaintyAnalysis
        Profiles and bootstrap, where they were computed.

    """

    found: FitOutcome
    runs: tuple[Run, ...]  # those that were fitted
    validation: tuple[Run, ...] = ()
    predictions: tuple[Solution, ...] = ()  # of the validation runs, shared parameters held
    reference: Reference = field(default=Reference(1.0, 1.0))
    route: Route = field(default=Route())
    lengths: tuple[int, ...] = ()  # frames per segment of every run, 0 where its stretches are whole
    uncertainty: UncertaintyAnalysis = field(default=UncertaintyAnalysis())

    @property
    def solution(self) -> Solution:
        """The unknowns, and the displacement model linearised there."""
        return self.found.solution

    @property
    def compared(self) -> Solution:
        """The solution in the compared domain: displacement, acceleration or measured friction."""
        return self.found.force or self.solution

    @property
    def is_default_route(self) -> bool:
        """Whether variable projection fitted the displacement."""
        return self.route.is_default

    @property
    def domain(self) -> str:
        """The compared domain: "displacement" or "force"."""
        return self.route.domain

    @property
    def search(self) -> str:
        """The search method."""
        return self.route.search

    @property
    def seed(self) -> int:
        """Seed of the search."""
        return self.route.seed

    @property
    def measured(self) -> bool:
        """Whether friction itself was measured and is compared."""
        return measured_friction.is_measured_friction(self.solution.problem)

    @property
    def model(self) -> Model:
        """The model, its effects as they were fitted."""
        return without_mass(self.solution.problem.model)

    @property
    def equation(self) -> str:
        """The equation with its numbers: ``F = 8.01(2) L s + 1.20(1) v``."""
        return self.model.equation({name: replace(e, std=e.reported_std) for name, e in self.parameters.items()})

    @property
    def weighed(self) -> tuple[Run, ...]:
        """The fitted runs, each with its given or fitted mass."""
        return tuple(with_fitted_mass(run, self.reference.mass) for run in self.runs)

    @cached_property
    def estimates(self) -> Estimates:
        """Estimates of the parameters, with the misfit of a rejected model and with computed intervals."""
        found = self._deviations.with_intervals(self.uncertainty.intervals)
        return found if self.misfit is None else with_misfit(found, self.solution, self.misfit.covariance)

    @cached_property
    def misfit(self) -> Misfit | None:
        """The force that the model misses, and its effect on the parameters; None where noise explains the residual."""
        if not (self.route.is_default or self.measured):
            return None
        return misfit_of(self.solution)

    @cached_property
    def _deviations(self) -> Estimates:
        if self.measured:
            return linear_estimates(self.solution, measured_friction.block_covariance(self.solution))
        return (
            estimate_parameters(self.solution)
            if self.route.is_default
            else linear_estimates(self.found.force or self.solution)
        )

    @property
    def covariance(self) -> Array:
        """Covariance (P, P) of the unknowns."""
        return self.estimates.covariance

    @property
    def parameters(self) -> dict[str, Any]:
        """Estimates by address."""
        return self.estimates.parameters

    @cached_property
    def heldout(self) -> tuple[float, str]:
        """Held-out root mean square error, m (N where friction itself was measured), and what was held out."""
        if self.measured:
            return measured_friction.heldout_rms(self.solution)
        if self.route.is_default:
            return heldout_rms(self.solution)
        return routes.heldout_rms(self.found, self.runs, self.route)

    @property
    def degrees(self) -> int:
        """Degrees of freedom: frames minus starts and unknowns. Levels count as far as their scatter permits."""
        basis = self.solution.basis
        used = float(np.trace(basis.shrink(self.solution.tau or 0.03)))
        starts = sum(len(start) for start in self.solution.starts)
        return int(self.solution.problem.n_frames - starts - round(used))

    @property
    def reduced_chi2(self) -> float:
        """Chi-squared per degree of freedom, in the compared domain."""
        if self.found.force is not None:
            return reduced_chi2(self.found.force)
        return self.solution.chi2 / max(self.degrees, 1)

    @cached_property
    def curves(self) -> tuple[Curve, ...]:
        """Curves of measurement and model, run by run, validation runs last."""
        make_curves = measured_friction.curves if self.measured else _curves
        fitted = make_curves(self.solution, self.runs, "fit")
        return fitted + tuple(
            c
            for s, run in zip(self.predictions, self.validation, strict=True)
            for c in make_curves(s, [run], "validation")
        )

    @cached_property
    def motion(self) -> tuple[ModelledMotion, ...]:
        """The modelled x, v, a and F with their bands, one table per run, validation runs last.

        Empty where friction itself was measured.
        """
        if self.measured:
            return ()
        held = self.found.force is None
        covariance = covariance_at_fitted_scatter(self.solution) if held else self.estimates.covariance
        return modelled_motion(
            self.solution, covariance, self.runs, list(zip(self.predictions, self.validation, strict=True))
        )

    @cached_property
    def collisions(self) -> list[dict[str, Any]]:
        """Summary of every collision as JSON."""
        return collisions(self.solution, self.estimates)

    @cached_property
    def free_runs(self) -> dict[str, FreeRun | None]:
        """Free runs over whole records, by run: validation runs if there are any, else the fitted ones.

        None for a record that cannot be simulated to its end. Empty where friction itself was measured.
        """
        if self.measured:
            return {}
        if self.validation:
            pairs = zip(self.predictions, self.validation, strict=True)
            return {run.name: free_run(s, run, self.reference) for s, run in pairs}
        return {run.name: free_run(self.solution, run, self.reference, i) for i, run in enumerate(self.runs)}

    @cached_property
    def errors(self) -> dict[str, Any]:
        """Errors over the fitted runs, as JSON."""
        rms, how = self.heldout
        if self.measured:
            out = measured_friction.errors_of(self.solution.responses)
        else:
            out = errors_of([c for c in self.curves if c.role == "fit"], self.weighed)
        return out | {
            "heldout_rms_um": None if self.measured else rms * 1e6,
            "heldout_rms_N": rms if self.measured else None,
            "heldout": how,
            "reduced_chi2": self.reduced_chi2,
            **free_errors(list(self.free_runs.values()), "validation" if self.validation else "fit"),
        }

    def summary(self) -> dict[str, Any]:
        """Return the JSON of `frictrack fit`."""
        scatter = self.solution.tau if len(self.solution.problem.layout.levels) >= MIN_RUNS_FOR_SCATTER else None
        return (
            {
                "model": self.model.names,
                "equation": self.equation,
                "domain": self.domain,
                "search": self.search,
                "parameters": {k: e.json() | self._mu(k, e) for k, e in self.parameters.items()},
                "friction_scatter": None
                if scatter is None
                else {"value": scatter, "std": scatter / np.sqrt(2 * (len(self.runs) - 1))},
                "correlations": [list(c) for c in self.estimates.correlations],
                "misfit": None if self.misfit is None else self.misfit.summary(),
                "remarks": self.estimates.remarks,
                "errors": self.errors,
                "per_run": self._per_run(),
                "collisions": self.collisions,
            }
            | ({"optima": self._optima()} if len(self.found.optima) else {})
            | self.uncertainty.summary()
        )

    def _mu(self, address: str, found: Estimate) -> dict[str, Any]:
        """The coefficient of friction to a force that scales with the load, where the load is known."""
        effect, _, parameter = address.partition("[")[0].rpartition(".")
        made = next((e for e in self.model.effects if e.name == effect), None)
        load = self.reference.load if self.measured or self.runs[0].mass is not None else float("nan")
        if made is None or found.value is None or found.unit != "N" or not np.isfinite(load):
            return {}
        if not made.parameter(parameter).loaded:
            return {}
        std = found.reported_std
        return {"mu": {"value": found.value / load, "std": None if std is None else std / load}}

    def _optima(self) -> list[dict[str, Any]]:
        """The distinct optima of a search within 1 % of the best, best first."""
        found = self.found
        return [
            {"misfit": float(cost), "parameters": quoted(found.solution, p)}
            for p, cost in zip(found.optima, found.costs, strict=True)
        ]

    def _per_run(self) -> list[dict[str, Any]]:
        if self.measured:
            rows = [measured_friction.run_summary(self.solution, i, run, "fit") for i, run in enumerate(self.runs)]
            predicted = zip(self.predictions, self.validation, strict=True)
            return rows + [measured_friction.run_summary(s, 0, run, "validation") for s, run in predicted]
        rows = [_row(self.solution, i, run, "fit", self.curves) for i, run in enumerate(self.weighed)]
        rows += [
            _row(s, 0, with_fitted_mass(run, self.reference.mass), "validation", self.curves)
            for s, run in zip(self.predictions, self.validation, strict=True)
        ]
        described = zip(rows, self.motion, self.runs + self.validation, strict=True)
        return [self._freely(row) | {"motion": band_summary(motion, run)} for row, motion, run in described]

    def _freely(self, row: dict[str, Any]) -> dict[str, Any]:
        """A row of `per_run` with the error of its free run, where there is one."""
        if row["role"] != ("validation" if self.validation else "fit"):
            return row
        return row | {"errors": row["errors"] | free_errors([self.free_runs[row["run"]]])}


def with_uncertainty(result: Fit, found: UncertaintyAnalysis) -> Fit:
    """Return the same fit with intervals, profiles and bootstrap in its summary."""
    return replace(result, uncertainty=found)


def _row(solution: Solution, index: int, run: Run, role: str, curves: Sequence[Curve]) -> dict[str, Any]:
    _, level = solution.problem.layout.values(solution.p, index)
    pieces = [p for p in solution.problem.pieces if p.run == index]
    return {
        "run": run.name,
        "role": role,
        "level": level,
        "noise_um": float(np.sqrt(np.mean(np.concatenate([p.noise for p in pieces]) ** 2)) * 1e6),
        "segments": len(pieces),
        "segment_s": float(max(p.t[-1] - p.t[0] for p in pieces)),
        "errors": errors_of([c for c in curves if c.run == run.name and c.role == role], [run]),
    }


def errors_of(curves: Sequence[Curve], runs: Sequence[Run]) -> dict[str, Any]:
    """Compute displacement, acceleration and force errors of curves against their runs.

    Parameters
    ----------
    curves : sequence of Curve
        Modelled and measured curves.
    runs : sequence of Run
        The runs, each with its mass.

    Returns
    -------
    dict
        JSON: rms in um and m/s^2, sum of squares in m^2/s^4, and the relative force error.

    """
    by_name = {r.name: r for r in runs}
    residual, a_error, f_error, f_measured = [], [], [], []
    for c in curves:
        run = by_name[c.run]
        rows = np.searchsorted(run.motion.t, c.t - 1e-9)
        a = run.motion.a[rows]
        residual.append(c.residual)
        a_error.append(a - c.a_model)
        mass = run.mass or 1.0
        f_error.append(mass * (a - c.a_model))
        f_measured.append(run.drive[rows] if run.drive is not None else c.F_model - mass * (a - c.a_model))
    a_all = np.concatenate(a_error)
    return {
        "rms_displacement_um": float(np.sqrt(np.mean(np.concatenate(residual) ** 2)) * 1e6),
        "rms_acceleration": float(np.sqrt(np.mean(a_all**2))),
        "sse_acceleration": float(np.sum(a_all**2)),
        "relative_force_error": float(
            np.linalg.norm(np.concatenate(f_error)) / max(float(np.linalg.norm(np.concatenate(f_measured))), 1e-30)
        ),
    }


def _curves(solution: Solution, runs: Sequence[Run], role: str) -> tuple[Curve, ...]:
    return tuple(_curve(solution, r, runs[r.piece.run], role) for r in solution.responses)


def _curve(solution: Solution, response: PieceResponse, run: Run, role: str) -> Curve:
    piece, motion, problem = response.piece, response.motion, solution.problem
    values, level = problem.layout.values(solution.p, piece.run)
    x, v = motion.x_edge[piece.at], motion.v_edge[piece.at]
    path = piece.at_frames(x, v, level)
    parts = {
        name: np.asarray(block @ problem.model.coefficients(name, values))
        for name, block in without_mass(problem.model).force_columns(path, values).items()
    }
    total: Array = np.sum(list(parts.values()), axis=0)
    return Curve(
        t=run.displacement.t[piece.frames],
        x=piece.y,
        sigma_x=piece.noise,
        x_model=response.model_y,
        v_model=v,
        a_model=piece.known_at_frames - total / piece.mass,
        F_model=total,
        run=run.name,
        role=role,
        parts=parts,
    )
