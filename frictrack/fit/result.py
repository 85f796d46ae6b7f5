"""The result of a fit: parameters with standard deviations, errors in every unit, curves for plots; one per group."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from html import escape
from itertools import chain
from typing import TYPE_CHECKING, Any

import numpy as np

from frictrack.base import imported
from frictrack.base.arguments import checked
from frictrack.base.distributions import as_seed, normal_ppf
from frictrack.base.errors import FrictrackError, UsageError
from frictrack.base.number_format import format_number, format_plus_minus
from frictrack.effects.models import Model
from frictrack.fit.cutting import noise_free_remark
from frictrack.fit.modelled_motion import FreeRun, collisions, free_errors, law_branches
from frictrack.fit.observations import Observation, observation_of
from frictrack.fit.parameters import MIN_RUNS_FOR_SCATTER, without_mass
from frictrack.fit.prediction import predict_run
from frictrack.fit.priors import PriorAgreement, prior_agreement, prior_of
from frictrack.fit.routes import FittedRuns, SearchedOptima
from frictrack.fit.uncertainty import Estimate, UncertaintyAnalysis, reported_by_address
from frictrack.fit.uncertainty.estimates import Estimates, Misfit, Parameters, with_misfit, with_stated_errors
from frictrack.fit.uncertainty.reported import level_remarks, rolling_remarks
from frictrack.records import Array, Curve, ModelledMotion, NotebookView, Run
from frictrack.results import ModelResults
from frictrack.search import Convergence
from frictrack.settings.priors import Prior

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

FIGURES = {"force": "fit", "law": "law", "convergence": "convergence"}  # kind of figure -> function of `plots`
MAX_REPR_EQUATION = 400  # characters of the equation in a printed fit


class FitSummary(dict[str, Any]):
    """The JSON of a fit; printed, it is a table of the parameters with errors and remarks."""

    def __repr__(self) -> str:
        rows = [("parameter", "value", "unit", "")]
        for address, p in self["parameters"].items():
            value = format_plus_minus(p["value"], p.get("std_misfit", p["std"]))
            remark = p["reason"] or ("at its bound" if p["at_bound"] else "")
            rows.append((address, value, "" if p["unit"] == "1" else p["unit"], remark))
        widths = [max(len(row[k]) for row in rows) for k in range(3)] + [0]
        table = ["  ".join(cell.ljust(w) for cell, w in zip(row, widths, strict=True)).rstrip() for row in rows]
        errors = self["errors"]
        shown = ("reduced_chi2", "rms_displacement_um", "heldout_rms_um", "rms_N", "heldout_rms_N")
        known = [f"{key} {format_number(errors[key])}" for key in shown if errors.get(key) is not None]
        head = f"Fit of {' + '.join(self['model'])} ({self['domain']} domain, {self['search']})"
        remarks = [*([self["misfit"]["words"]] if self.get("misfit") else []), *self["remarks"]]
        return "\n".join([head, "", *table, "", ", ".join(known), *(f"- {line}" for line in remarks)])

    __str__ = __repr__


class StorableFit(NotebookView):
    """Base of fits: what is stored of them, which is also what figures take."""

    def _repr_html_(self) -> str:
        fitted: Any = self  # a Fit or GroupFits
        groups: dict[str, Any] = fitted.fits if isinstance(self, GroupFits) else {"": self}
        cells = "".join(
            f"<tr><th>{escape(address + (group and f'[{group}]'))}</th><td>{escape(str(e))}</td>"
            f"<td>{escape(e.reason or '')}</td></tr>"
            for group, one in groups.items()
            for address, e in one.parameters.items()
        )
        head = "<tr><th>parameter</th><th>value</th><th></th></tr>"
        return f"<table>{head}{cells}</table>{super()._repr_html_()}"

    def to_results(self, name: str = "") -> ModelResults:
        """Return what is stored of a fit: its JSON, its curves and its modelled motion.

        Parameters
        ----------
        name
            Name of the model in the store; default its effects.

        """
        fitted: Any = self  # a Fit or GroupFits
        named, model = name or f"1_{'+'.join(fitted.model.names)}", str(fitted.model)
        return ModelResults(
            named,
            model,
            fitted.summary(),
            fitted.curves,
            current=True,
            motion=fitted.motion,
            convergence=fitted.convergence,
        )

    def plot(self, kind: str = "force") -> Figure:
        """Draw the fit.

        Parameters
        ----------
        kind
            "force": modelled and measured friction force of every run over time, with the residual. "law": friction
            force and coefficient of friction over the speed, direction by direction. "convergence": a global search
            generation by generation.

        """
        if kind not in FIGURES:
            raise UsageError(f'plot: expected {" or ".join(FIGURES)} but got "{kind}"')
        fitted: Any = self
        runs = (*fitted.weighed, *getattr(fitted, "validation", ()))
        figure: Figure = imported(f"frictrack.present.plots:{FIGURES[kind]}")(self, runs)
        return figure


@dataclass(frozen=True, eq=False, repr=False)
class Fit(FittedRuns, StorableFit):
    """A model fitted to runs: parameters, errors and curves, each computed when it is first asked for.

    Attributes
    ----------
    uncertainty : UncertaintyAnalysis
        Profiles and bootstrap, where they were computed. For the others see `FittedRuns`.

    Examples
    --------
    >>> import frictrack as ft
    >>> fit = ft.fit(["coulomb", "viscous", "patch"], ft.samples.runs()[:2])
    >>> fit.model.names, sorted(fit.parameters)
    (['coulomb', 'viscous', 'patch'], ['coulomb.F_c', 'patch.F', 'patch.w', 'patch.x_c', 'viscous.F_v'])
    >>> round(fit.parameters["patch.x_c"].value, 3)
    0.1

    """

    uncertainty: UncertaintyAnalysis = field(default=UncertaintyAnalysis())

    def __repr__(self) -> str:
        equation = self.equation
        if len(equation) > MAX_REPR_EQUATION:
            equation = f"{equation[:MAX_REPR_EQUATION]}..."
        runs = "1 run" if len(self.runs) == 1 else f"{len(self.runs)} runs"
        return f"<Fit of {runs}: {equation}; reduced chi-squared {self.reduced_chi2:.4g}>"

    def to_dataframe(self) -> pd.DataFrame:
        """Return the parameters as a pandas DataFrame: value, std and unit by address.

        A parameter that the runs do not determine has NaN and a reason. While the model leaves more than noise, ``std``
        includes the effect of the missing force.
        """
        import pandas as pd  # noqa: PLC0415 - half a second

        rows = {
            address: {"value": e.value, "std": e.reported_std, "unit": e.unit, "reason": e.reason or ""}
            for address, e in self.parameters.items()
        }
        frame = pd.DataFrame.from_dict(rows, orient="index").astype({"value": float, "std": float})
        return frame.rename_axis("parameter")

    @property
    def domain(self) -> str:
        """The compared domain: "displacement" or "force"."""
        return self.route.domain

    @property
    def search(self) -> str:
        """The search method."""
        return self.route.search

    @property
    def seed(self) -> int | None:
        """Seed of the search."""
        return as_seed(self.route.rng)

    @cached_property
    def observation(self) -> Observation:
        """What was compared: displacement, acceleration or measured friction."""
        return observation_of(self.compared.problem)

    @property
    def measured(self) -> bool:
        """Whether friction itself was measured and is compared."""
        return not self.solution.problem.simulates

    @property
    def model(self) -> Model:
        """The model, its effects as they were fitted."""
        return without_mass(self.solution.problem.model)

    @property
    def equation(self) -> str:
        """The equation with its numbers: ``F = (8.01 ± 0.02) L s + (1.20 ± 0.01) v``."""
        return self.model.equation({name: replace(e, std=e.reported_std) for name, e in self.parameters.items()})

    @cached_property
    def estimates(self) -> Estimates:
        """Estimates of the parameters, with computed intervals, the misfit of a rejected model and stated errors."""
        found = self.observation.estimates(self).with_intervals(self.uncertainty.intervals)
        if self.misfit is not None:
            found = with_misfit(found, self.solution, self.misfit.covariance)
        return with_stated_errors(found, self)

    @cached_property
    def misfit(self) -> Misfit | None:
        """The force that the model misses, and its effect on the parameters; None where noise explains the residual."""
        return self.observation.misfit(self)

    @cached_property
    def prior_agreement(self) -> PriorAgreement | None:
        """How far data and priors disagree, and what comes from the priors; None for a fit without priors."""
        missing = 0.0 if self.misfit is None else self.misfit.covariance
        return prior_agreement(self.compared, self.covariance + missing)

    @checked
    def to_prior(self, study: str = "") -> Prior:
        """Return the law as a prior for another set-up: the parameters that carry over, with their covariance.

        Parameters
        ----------
        study
            Name of the study, for readers of the prior file.

        """
        return prior_of(self, self.estimates, self.misfit, from_motion=not self.measured, study=study)

    @property
    def covariance(self) -> Array:
        """Covariance (P, P) of the unknowns."""
        return self.estimates.covariance

    @property
    def parameters(self) -> Parameters:
        """Estimates by address."""
        return self.estimates.parameters

    @checked
    def conf_int(self, alpha: float = 0.05) -> pd.DataFrame:
        """Return confidence intervals of all parameters as a pandas DataFrame, ``lower`` and ``upper`` by address.

        At the default level an interval from a profile or a bootstrap counts where one was computed
        (`analyse_uncertainty`); an end that was not reached is infinite. All others are the value and the normal
        quantile times its standard deviation, which includes the effect of a missing force where the model is rejected.
        A parameter that the runs do not determine has NaN.

        Parameters
        ----------
        alpha
            One minus the confidence level.

        Examples
        --------
        >>> import frictrack as ft
        >>> fit = ft.fit(["coulomb", "viscous", "patch"], ft.samples.runs()[:2])
        >>> fit.conf_int().loc["patch.x_c"].round(3).tolist()
        [0.1, 0.1]

        """
        import pandas as pd  # noqa: PLC0415 - half a second

        if not 0 < alpha < 1:
            raise UsageError(f"expected alpha between 0 and 1, such as 0.05, but got {alpha:g}")
        frame, times = self.to_dataframe(), float(normal_ppf(1 - alpha / 2))
        ends = pd.DataFrame(
            {"lower": frame["value"] - times * frame["std"], "upper": frame["value"] + times * frame["std"]}
        )
        for address, (low, high) in self.uncertainty.intervals.items() if np.isclose(alpha, 0.05) else ():
            if self.parameters[address].value is not None:
                ends.loc[address] = -np.inf if low is None else low, np.inf if high is None else high
        return ends

    @property
    def aic(self) -> float:
        """Akaike's information criterion, chi-squared + 2 k, for k fitted numbers; smaller is better.

        Only differences between models of the same runs mean something: a constant of the data is left out, as in
        lmfit. Starts count among the fitted numbers, friction levels as what their scatter leaves.
        """
        chi2, numbers, _ = self._likelihood()
        return chi2 + 2 * numbers

    @property
    def bic(self) -> float:
        """Schwarz's information criterion, chi-squared + k ln n, for n frames; see `aic`."""
        chi2, numbers, frames = self._likelihood()
        return chi2 + numbers * float(np.log(frames))

    def _likelihood(self) -> tuple[float, float, int]:
        """Chi-squared in independent standard deviations of noise, fitted numbers and frames."""
        if self.found.force is not None:
            raise FrictrackError(
                "expected a fit of the displacement or of measured friction for AIC and BIC but got one of "
                'accelerations, whose residuals have no likelihood; fit without domain = "force"'
            )
        weighted = self.observation.weighted(self.solution)
        numbers = weighted.fitted_numbers + sum(len(start) for start in weighted.starts)
        return weighted.chi2, numbers, weighted.problem.n_frames

    @cached_property
    def heldout(self) -> tuple[float, str]:
        """Held-out root mean square error, m (N where friction itself was measured), and what was held out."""
        return self.observation.heldout(self)

    @property
    def reduced_chi2(self) -> float:
        """Chi-squared per degree of freedom, in the compared domain."""
        return self.observation.reduced_chi2(self)

    @cached_property
    def curves(self) -> tuple[Curve, ...]:
        """Curves of measurement and model, run by run, validation runs last."""
        make_curves = self.observation.curves
        predicted = zip(self.predictions, self.validation, strict=True)
        parts = [make_curves(solution, [run], "validation") for solution, run in predicted]
        return tuple(chain(make_curves(self.solution, self.runs, "fit"), *parts))

    @cached_property
    def motion(self) -> tuple[ModelledMotion, ...]:
        """The modelled x, v, a and F with their bands, one table per run, validation runs last.

        Empty where friction itself was measured.
        """
        return self.observation.motion(self, lambda: self.estimates.covariance)

    @checked
    def predict(self, *runs: Run) -> tuple[ModelledMotion, ...]:
        """Predict runs that were not fitted, with bands.

        What runs share is as fitted; the start, the level and the phases of a run are found in the run itself.

        Parameters
        ----------
        *runs
            Runs with a measured motion; none: the runs of the fit, as fitted.

        Returns
        -------
        tuple of ModelledMotion
            The modelled x, v, a and F of every run; empty where friction itself was measured.

        Raises
        ------
        FrictrackError
            If a run has no part that can be fitted.

        Examples
        --------
        >>> import frictrack as ft
        >>> *fitted, other = ft.samples.runs()
        >>> (seen,) = ft.fit(["coulomb", "viscous", "stribeck", "patch"], fitted).predict(other)
        >>> seen.run == other.name and seen.role
        'validation'

        """
        others = tuple(replace(run, role="validation") for run in runs)
        predictions = tuple(predict_run(self.solution, run, self.reference) for run in others)
        return replace(self, validation=others, predictions=predictions).motion[len(self.runs) if runs else 0 :]

    @property
    def convergence(self) -> dict[str, Convergence]:
        """The global search generation by generation, under the name "all"; empty for variable projection."""
        searched = self.found.searched
        return {} if searched is None or searched.convergence is None else {"all": searched.convergence}

    @cached_property
    def law(self) -> list[dict[str, Any]]:
        """The law over the speed with its standard deviation, one entry per direction; see `law_branches`."""
        missing = 0.0 if self.misfit is None else self.misfit.covariance
        load = self.reference.load if self.observation.knows_load(self) else None
        return law_branches(self.solution, self.curves, self.covariance + missing, load)

    @cached_property
    def collisions(self) -> list[dict[str, Any]]:
        """Summary of every collision as JSON."""
        return collisions(self.solution, self.estimates)

    @cached_property
    def free_runs(self) -> dict[str, FreeRun | None]:
        """Free runs over whole records, by run: validation runs if there are any, else the fitted ones.

        None for a record that cannot be simulated to its end. Empty where friction itself was measured.
        """
        return self.observation.free_runs(self)

    @cached_property
    def errors(self) -> dict[str, Any]:
        """Errors over the fitted runs, as JSON."""
        rms, how = self.heldout
        return self.observation.errors([self], self.curves) | {
            **self.observation.heldout_summary(rms),
            "heldout": how,
            "reduced_chi2": self.reduced_chi2,
            **free_errors(list(self.free_runs.values()), "validation" if self.validation else "fit"),
        }

    def summary(self) -> FitSummary:
        """Return the JSON of `frictrack fit`, a dictionary that prints itself as a table."""
        agreement, searched = self.prior_agreement, self.found.searched
        groups = [run.group for run in self.runs]
        scatter = self.solution.tau if len(self.solution.problem.layout.levels) >= MIN_RUNS_FOR_SCATTER else None
        return FitSummary(
            {
                "model": self.model.names,
                "equation": self.equation,
                "domain": self.domain,
                "search": self.search,
                "parameters": {k: e.json() | self._mu(k, e) | self._share(k) for k, e in self.parameters.items()},
                "friction_scatter": None
                if scatter is None
                else {"value": scatter, "std": scatter / np.sqrt(2 * (len(self.runs) - 1))},
                "correlations": [list(c) for c in self.estimates.correlations],
                "misfit": None if self.misfit is None else self.misfit.summary(),
                "remarks": [
                    *(() if self.measured else (*rolling_remarks(self), *noise_free_remark(self.runs))),
                    *([searched.remark] if searched is not None and searched.remark else []),
                    *self.estimates.remarks,
                    *level_remarks(self.solution, self.estimates.covariance, self.reduced_chi2, groups),
                    *(() if agreement is None else agreement.remarks()),
                ],
                "law": self.law,
                "errors": self.errors,
                "per_run": self.observation.per_run(self, self.curves, self.motion, self.free_runs),
                "collisions": self.collisions,
            }
            | ({} if searched is None else {"searched": searched.summary, "optima": self._optima(searched)})
            | ({} if agreement is None else {"prior": agreement.summary()})
            | self.uncertainty.summary()
        )

    def _share(self, address: str) -> dict[str, float]:
        """Share of a parameter that comes from the priors, where there are any."""
        shares = {} if self.prior_agreement is None else self.prior_agreement.shares
        return {"from_prior": shares[address]} if address in shares else {}

    def _mu(self, address: str, found: Estimate) -> dict[str, Any]:
        """The coefficient of friction to a force that scales with the load, where the load is known."""
        effect, _, parameter = address.partition("[")[0].rpartition(".")
        load = self.reference.load if self.observation.knows_load(self) else float("nan")
        if found.value is None or found.unit != "N" or not np.isfinite(load) or effect not in self.model:
            return {}
        if not next(e for e in self.model.effects if e.name == effect).parameter(parameter).loaded:
            return {}
        std = found.reported_std
        if std is not None and all(run.drive is None and run.normal_load is None for run in self.runs):
            shares = (run.sigma_mass / run.mass for run in self.runs if run.mass)  # load and force have the same
            weighing = max(shares, default=0.0)
            std = float(np.sqrt(max(std**2 - (weighing * found.value) ** 2, 0.0)))
        return {"mu": {"value": found.value / load, "std": None if std is None else std / load}}

    def _optima(self, searched: SearchedOptima) -> list[dict[str, Any]]:
        """The distinct optima of a search within 1 % of the best, best first."""
        optima = zip(searched.points, searched.costs, strict=True)
        return [{"misfit": float(cost), "parameters": reported_by_address(self.solution, p)} for p, cost in optima]


def with_uncertainty(result: Fit, found: UncertaintyAnalysis) -> Fit:
    """Return the same fit with intervals, profiles and bootstrap in its summary."""
    return replace(result, uncertainty=found)


@dataclass(frozen=True, eq=False, repr=False)
class GroupFits(StorableFit):
    """The same model fitted to every group of runs separately; `fits` by the name of the group.

    Examples
    --------
    >>> import frictrack as ft
    >>> from dataclasses import replace
    >>> runs = [replace(run, group="low" if run.name == "to_a_stop" else "high") for run in ft.samples.runs()]
    >>> ft.fit(["coulomb", "viscous"], runs, per="group")
    <GroupFits: coulomb+viscous, fitted to each of high (3 runs), low (1 runs)>

    """

    fits: dict[str, Fit]

    def __repr__(self) -> str:
        names = ", ".join(f"{name} ({len(f.runs)} runs)" for name, f in self.fits.items())
        return f"<GroupFits: {'+'.join(self.model.names)}, fitted to each of {names}>"

    def to_dataframe(self) -> pd.DataFrame:
        """Return the parameters of all groups as a pandas DataFrame, by group and address; see `Fit.to_dataframe`."""
        import pandas as pd  # noqa: PLC0415 - half a second

        return pd.concat({name: f.to_dataframe() for name, f in self.fits.items()}, names=["group"])

    @property
    def model(self) -> Model:
        """The model of all groups."""
        return next(iter(self.fits.values())).model

    @property
    def runs(self) -> tuple[Run, ...]:
        """All fitted runs, group by group."""
        return tuple(chain.from_iterable(f.runs for f in self.fits.values()))

    @property
    def weighed(self) -> tuple[Run, ...]:
        """The same runs, each with its given or fitted mass."""
        return tuple(chain.from_iterable(f.weighed for f in self.fits.values()))

    @property
    def curves(self) -> tuple[Curve, ...]:
        """Curves of measurement and model, group by group."""
        return tuple(chain.from_iterable(f.curves for f in self.fits.values()))

    @property
    def motion(self) -> tuple[ModelledMotion, ...]:
        """Simulated motions with their bands, group by group."""
        return tuple(chain.from_iterable(f.motion for f in self.fits.values()))

    @property
    def convergence(self) -> dict[str, Convergence]:
        """The global search of every group; empty for variable projection."""
        return {name: one for name, f in self.fits.items() for one in f.convergence.values()}

    @property
    def errors(self) -> dict[str, Any]:
        """Errors over all fitted runs. The held-out error is the root mean square over the frames of all groups."""
        group_fits = list(self.fits.values())
        frames = np.array([f.solution.problem.n_frames for f in group_fits], dtype=float)
        share = frames / frames.sum()
        ways = {f.heldout[1] for f in group_fits}
        heldout = float(np.sqrt(share @ np.array([f.heldout[0] for f in group_fits]) ** 2))
        observation = group_fits[0].observation
        return observation.errors(group_fits, self.curves) | {
            **observation.heldout_summary(heldout),
            "heldout": "run" if ways == {"run"} else "frames",
            "reduced_chi2": float(share @ np.array([f.reduced_chi2 for f in group_fits])),
            **free_errors([r for f in group_fits for r in f.free_runs.values()], group_fits[0].errors["free_run"]),
        }

    def summary(self) -> FitSummary:
        """Return the JSON of `frictrack fit --per group`: the same keys, parameters as `coulomb.F_c[low]`."""
        group_fits = {name: f.summary() for name, f in self.fits.items()}
        first = next(iter(group_fits.values()))
        return FitSummary(
            {key: first[key] for key in ("model", "domain", "search")}
            | {
                "per": "group",
                "parameters": {f"{k}[{g}]": v for g, s in group_fits.items() for k, v in s["parameters"].items()},
                "friction_scatter": {g: s["friction_scatter"] for g, s in group_fits.items()},
                "correlations": [
                    [f"{a}[{g}]", f"{b}[{g}]", r] for g, s in group_fits.items() for a, b, r in s["correlations"]
                ],
                "remarks": [f"{g}: {line}" for g, s in group_fits.items() for line in s["remarks"]],
                "law": [branch | {"group": g} for g, s in group_fits.items() for branch in s["law"]],
                "errors": self.errors,
                "per_run": [row | {"group": g} for g, s in group_fits.items() for row in s["per_run"]],
                "collisions": [
                    collision | {"group": g} for g, s in group_fits.items() for collision in s["collisions"]
                ],
            }
            | {key: {g: s[key] for g, s in group_fits.items()} for key in ("prior", "searched") if key in first}
        )


def by_group(runs: Sequence[Run]) -> dict[str, list[Run]]:
    """Sort runs into groups, in the order in which the groups first appear.

    Raises
    ------
    FrictrackError
        (usage) If a run has no group.

    """
    if ungrouped := [r.name for r in runs if not r.group]:
        raise UsageError(
            f"per group: expected every run to have a group but {', '.join(ungrouped)} has none; give it "
            'group = "low", for example'
        )
    groups: dict[str, list[Run]] = {}
    for run in runs:
        groups.setdefault(run.group, []).append(run)
    return groups
