"""Compare one parameter between labelled groups of runs: good and magnetic, lubricated and dry.

All runs are fitted together with one law, in which every run i has its own value y_i of this parameter and all share
the others. The values scatter from run to run beyond their noise:

    y_i = mean of the group of run i + u_i + e_i,   u_i ~ N(0, tau^2),   e ~ N(0, V)

V is the covariance of the joint fit; tau is estimated by restricted maximum likelihood. Intervals use Student's t with
the runs less the groups as degrees of freedom, and the sum of squares that the runs themselves show (Knapp & Hartung).

References
----------
Knapp, G. & Hartung, J. (2003). Improved tests for a random effects meta-regression. Stat. Med. 22, 2693-2710.

"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from frictrack.base.distributions import f_sf, student_ppf, student_sf
from frictrack.base.errors import FrictrackError, UsageError
from frictrack.base.number_format import format_plain, format_plus_minus
from frictrack.base.workers import one_thread
from frictrack.effects.models import Model
from frictrack.fit import Fit, GroupFits, ParameterEstimates, by_group, fit
from frictrack.fit.uncertainty import reported_values_and_jacobian
from frictrack.records import Array

MIN_P_SHOWN = 1e-4


@dataclass(frozen=True)
class GroupValue:
    """A parameter in one group, or its difference between two: value, standard deviation and 95 % interval."""

    value: float
    std: float
    interval: tuple[float, float]
    runs: int
    p: float | None = None  # of a difference: that there is none


@dataclass(frozen=True, repr=False)
class ParameterByGroup:
    """One parameter in groups of runs.

    Attributes
    ----------
    parameter, unit : str
        Address of the parameter, and its unit.
    groups : mapping of str to GroupValue
        Its mean in every group.
    differences : mapping of str to GroupValue
        Every group minus the first one, as "b - a".
    p : float
        p-value that all groups are alike.
    scatter : float
        Standard deviation between runs of a group, beyond their noise.
    degrees : int
        Degrees of freedom of the intervals.
    values : mapping of str to (float, float)
        Value and standard deviation of every run.
    left_out : mapping of str to str
        Runs that do not determine the parameter, with the reason.

    Examples
    --------
    >>> import frictrack as ft
    >>> from dataclasses import replace
    >>> runs = [replace(run, group="low" if run.name == "to_a_stop" else "high") for run in ft.samples.runs()]
    >>> found = ft.compare_groups(ft.fit(["coulomb", "viscous"], runs), "viscous.F_v")
    >>> list(found.differences), found.degrees
    (['low - high'], 2)

    """

    parameter: str
    unit: str
    groups: Mapping[str, GroupValue]
    differences: Mapping[str, GroupValue]
    p: float
    scatter: float
    degrees: int
    values: Mapping[str, tuple[float, float]]
    left_out: Mapping[str, str]

    def __repr__(self) -> str:
        return f"<ParameterByGroup of {'; '.join(self.sentences())}>"

    def sentences(self) -> list[str]:
        """Return the comparison in words: the parameter of every group, the differences, and what they rest on."""
        unit = "" if self.unit == "1" else f" {self.unit}"
        means = ", ".join(f"{name} {format_plus_minus(g.value, g.std)}" for name, g in self.groups.items())
        out = [f"{self.parameter}: {means}{unit}"]
        for name, d in self.differences.items():
            ends = " to ".join(format_plus_minus(end, d.std).split(" ")[0] for end in d.interval)
            assert d.p is not None
            p = f"p {'below 1e-4' if d.p < MIN_P_SHOWN else format_plain(d.p, 2)}"
            out.append(f"{name}: {format_plus_minus(d.value, d.std)}{unit}, 95 % interval {ends}, {p}")
        scatter = f"scatter between runs {format_plain(self.scatter, 2)}{unit}" if self.scatter else "no scatter seen"
        return [*out, f"{len(self.values)} runs, {scatter}; Student's t with {self.degrees} degrees of freedom"]

    def summary(self) -> dict[str, Any]:
        """Return the JSON of `frictrack compare --parameter`."""
        pairs = {"groups": self.groups, "differences": self.differences}
        json = {
            key: {name: vars(one) | {"interval": list(one.interval)} for name, one in found.items()}
            for key, found in pairs.items()
        }
        for one in json["groups"].values():
            del one["p"]
        runs = {name: {"value": value, "std": std} for name, (value, std) in self.values.items()}
        more = {"p": self.p, "scatter": self.scatter, "degrees": self.degrees, "runs": runs}
        return {
            "parameter": self.parameter,
            "unit": self.unit,
            **json,
            **more,
            "left_out": dict(self.left_out),
            "words": self.sentences(),
        }


@one_thread()
def compare_groups(fitted: Fit | GroupFits, parameter: str) -> ParameterByGroup:
    """Compare one parameter between the groups of runs, with one law and the other parameters in common.

    Parameters
    ----------
    fitted
        A fit of runs with `group`; its model is fitted again with one value of the parameter per run.
    parameter
        Address of the parameter, such as "viscous.F_v".

    Returns
    -------
    ParameterByGroup
        The parameter in every group, and every group minus the first, with 95 % intervals and p-values.

    Raises
    ------
    FrictrackError
        (usage) If the model has no such parameter, a run has no group, there is one group only, or there are no more
        runs than groups.

    Examples
    --------
    >>> import frictrack as ft
    >>> from dataclasses import replace
    >>> runs = [replace(run, group="low" if run.name == "to_a_stop" else "high") for run in ft.samples.runs()]
    >>> fit = ft.fit(["coulomb", "viscous"], runs)
    >>> ft.compare_groups(fit, "viscous.F_v").differences["low - high"].p > 0.01
    True

    """
    names = list(by_group(fitted.runs))
    if len(names) < 2 or len(fitted.runs) <= len(names):
        raise UsageError(
            f"expected runs of at least two groups, and more runs than groups, to see how runs of one group scatter, "
            f"but got {len(fitted.runs)} runs of {', '.join(names)}"
        )
    one = next(iter(fitted.fits.values())) if isinstance(fitted, GroupFits) else fitted
    again = fit(_with_value_per_run(one.model, parameter), fitted.runs, domain=one.domain)
    known = {run.name: again.parameters[f"{parameter}[{run.name}]"] for run in again.runs}
    left_out = {name: e.reason or "not determined" for name, e in known.items() if e.value is None}
    kept = [run for run in again.runs if run.name not in left_out]
    present = [name for name in names if any(run.group == name for run in kept)]
    if len(present) < 2 or len(kept) <= len(present):
        reasons = "; ".join(f"{name}: {why}" for name, why in left_out.items())
        raise FrictrackError(f"expected runs that determine {parameter} in two groups but got {len(kept)} ({reasons})")
    addresses = [f"{parameter}[{run.name}]" for run in kept]
    y, jacobian = reported_values_and_jacobian(again.solution.problem, again.solution.p, addresses)
    covariance = jacobian @ again.covariance @ jacobian.T
    x = np.array([[float(run.group == name) for name in present] for run in kept])
    deviations = np.sqrt(np.diag(covariance))
    values = {run.name: (float(v), float(s)) for run, v, s in zip(kept, y, deviations, strict=True)}
    return _compare((parameter, known[kept[0].name].unit), present, (y, covariance, x), values, left_out)


def _with_value_per_run(model: Model, parameter: str) -> Model:
    """The same model with one value of a parameter per run."""
    effect, _, name = parameter.partition(".")
    known = [f"{e.name}.{p.name}" for e in model.effects for p in e.parameters if p.free]
    if parameter not in known:
        raise UsageError(
            f'expected a parameter of the model that is fitted but got "{parameter}"; it has {", ".join(known)}'
        )
    return replace(
        model, effects=tuple(e.adjusted(**{name: {"per_run": True}}) if e.name == effect else e for e in model.effects)
    )


def _compare(
    what: tuple[str, str],
    names: list[str],
    seen: tuple[Array, Array, Array],
    values: Mapping[str, tuple[float, float]],
    left_out: Mapping[str, str],
) -> ParameterByGroup:
    """Compare groups by values y (n,) with covariance (n, n) and groups x (n, q)."""
    y, covariance, x = seen
    variance, turn = np.linalg.eigh(covariance)  # independent combinations of the runs; their scatter stays tau
    runs = ParameterEstimates(turn.T @ y, np.maximum(variance, 0.0), turn.T @ x)
    scatter = runs.scatter()
    beta, bread, squares = runs.at_scatter(scatter)
    spread, degrees = bread * squares / runs.degrees, runs.degrees
    counts = x.sum(axis=0).astype(int)
    contrasts = np.eye(len(names))[1:] - np.eye(len(names))[:1]

    def value(row: Array, count: int, *, tested: bool = False) -> GroupValue:
        found, std = float(row @ beta), float(np.sqrt(row @ spread @ row))
        half = float(student_ppf(0.975, degrees)) * std
        p = float(2 * student_sf(abs(found) / max(std, 1e-300), degrees)) if tested else None
        return GroupValue(found, std, (found - half, found + half), count, p)

    between = contrasts @ beta
    size = float(between @ np.linalg.solve(contrasts @ spread @ contrasts.T, between)) / len(contrasts)
    return ParameterByGroup(
        parameter=what[0],
        unit=what[1],
        groups={name: value(row, int(n)) for name, row, n in zip(names, np.eye(len(names)), counts, strict=True)},
        differences={
            f"{name} - {names[0]}": value(row, int(n + counts[0]), tested=True)
            for name, row, n in zip(names[1:], contrasts, counts[1:], strict=True)
        },
        p=float(f_sf(size, len(contrasts), degrees)),
        scatter=scatter,
        degrees=degrees,
        values=values,
        left_out=left_out,
    )
