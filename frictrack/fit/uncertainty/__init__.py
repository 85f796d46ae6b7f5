"""Compute the uncertainty of fitted parameters: estimates, model misfit, profile likelihood, bootstrap."""

# ruff: noqa: F401 - the imports are the interface

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from frictrack.base.distributions import RNG
from frictrack.base.workers import one_thread
from frictrack.fit.routes import FittedRuns, require_one_fit
from frictrack.fit.uncertainty.estimates import (
    Estimate,
    Estimates,
    Misfit,
    Parameters,
    dispersion,
    estimate_parameters,
    linear_estimates,
    misfit_of,
    stated_error_changes,
    with_misfit,
    with_stated_errors,
)
from frictrack.fit.uncertainty.parametric_bootstrap import Bootstrap, Progress, bootstrap
from frictrack.fit.uncertainty.profile_likelihood import Profile, profile
from frictrack.fit.uncertainty.reported import (
    level_remarks,
    reported_by_address,
    reported_names,
    reported_values_and_jacobian,
    rolling_remarks,
)

Interval = tuple[float | None, float | None]


@dataclass(frozen=True)
class UncertaintyAnalysis:
    """Profiles and a bootstrap of one fit, where they were computed."""

    profiles: tuple[Profile, ...] = ()
    bootstrap: Bootstrap | None = None

    @property
    def intervals(self) -> dict[str, Interval]:
        """Intervals by address: from a profile, or else from the bootstrap."""
        from_bootstrap: dict[str, Interval] = {} if self.bootstrap is None else dict(self.bootstrap.intervals)
        return from_bootstrap | {p.address: (p.low, p.high) for p in self.profiles}

    def summary(self) -> dict[str, Any]:
        """Return JSON with `profiles` and `bootstrap`, where they were computed."""
        out: dict[str, Any] = {}
        if self.profiles:
            out["profiles"] = {p.address: p.summary() for p in self.profiles}
        if self.bootstrap is not None:
            out["bootstrap"] = self.bootstrap.summary()
        return out


@one_thread()
def analyse_uncertainty(
    result: FittedRuns,
    *,
    profiles: bool = True,
    draws: int = 0,
    rng: RNG = 0,
    progress: Progress | None = None,
) -> UncertaintyAnalysis:
    """Compute the profiles of all shared parameters of a fit, and a bootstrap.

    Parameters
    ----------
    result : Fit
        The fit.
    profiles : bool
        Whether to compute profiles.
    draws : int
        Number of bootstrap draws; 0 for none.
    rng : numpy.random.Generator or int or None
        Seed of the bootstrap.
    progress : callable, optional
        Called with the number done, the total, and what is computed.

    Returns
    -------
    UncertaintyAnalysis
        Profiles and bootstrap.

    Raises
    ------
    FrictrackError
        (usage) For fits of groups.

    """
    require_one_fit(result)
    slots = result.solution.problem.layout.slots if profiles else ()
    addresses = [f"{s.effect}.{s.parameter}" for s in slots if s.run is None]
    profile_list = []
    for k, address in enumerate(addresses):
        profile_list.append(profile(result, address))
        if progress is not None:
            progress(k + 1, len(addresses), "profiles")
    from_bootstrap = bootstrap(result, draws, rng=rng, progress=progress) if draws else None
    return UncertaintyAnalysis(tuple(profile_list), from_bootstrap)


def merge_uncertainty(summary: Mapping[str, Any], found: Mapping[str, Any]) -> dict[str, Any]:
    """Merge the JSON of a fit with that of its `UncertaintyAnalysis`: parameters get their intervals."""
    from_bootstrap = {name: b["interval"] for name, b in found.get("bootstrap", {}).get("parameters", {}).items()}
    intervals = from_bootstrap | {name: [p["low"], p["high"]] for name, p in found.get("profiles", {}).items()}
    parameters = {
        k: p | ({"interval": intervals[k]} if k in intervals else {}) for k, p in summary["parameters"].items()
    }
    return {**summary, "parameters": parameters, **found}
