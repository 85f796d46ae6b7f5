"""Identify a law on a recording by the papers' search and by frictrack's own fit, and render the recordings.

Each law is identified twice: by the papers' method (force domain, low-pass, double difference, MGA over all
parameters), and by frictrack (displacement domain, variable projection). The lowest error that is known for a law
separates what the law cannot do from what a search did not find.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from frictrack.base.errors import FrictrackError
from frictrack.effects import models
from frictrack.fit import Fit, fit
from frictrack.records import Array, Run
from frictrack.validation.reproduce import laws, papers_method, printed, recordings
from frictrack.validation.reproduce.laws import PaperLaw
from frictrack.validation.reproduce.papers_method import AccelerationSeries
from frictrack.validation.reproduce.recordings import BEAM, SyntheticRecording
from frictrack.validation.reproduce.sections import Effort

TIME_UNITS = {"ATM1": "sample", "ATM2": "millisecond"}  # of the printed frequencies, as `time_units` finds
ADDRESSES = {"F_c": "coulomb.F_c", "F_s": "stribeck.F_s", "F_v": "viscous.F_v", "v_s": "stribeck.v_s"}
GROUPS = {"low": "low speed, 5 m/s", "high": "high speed, 8 m/s"}


@dataclass(frozen=True, eq=False)
class Identification:
    """Parameters of a law on one series: by the papers' search, and those of the lowest error known.

    Attributes
    ----------
    law, data
        The law and the series.
    found
        Parameters found with each seed, (d,) each.
    best
        Parameters of the lowest error known, (d,).

    """

    law: PaperLaw
    data: AccelerationSeries
    found: tuple[Array, ...]
    best: Array

    @cached_property
    def errors(self) -> Array:
        """Sum of squared acceleration residuals with each seed, m^2/s^4."""
        return np.array([papers_method.squared_error(self.law, p, self.data) for p in self.found])

    @property
    def lowest(self) -> float:
        """Lowest error known, m^2/s^4."""
        return papers_method.squared_error(self.law, self.best, self.data)

    @property
    def chosen(self) -> Array:
        """Best parameters that the search found, (d,)."""
        return self.found[int(np.argmin(self.errors))]

    def acceleration(self, p: Array) -> Array:
        """Acceleration of the law along the series.

        Parameters
        ----------
        p
            Parameters, (d,).

        Returns
        -------
        Array
            Acceleration, m/s^2, (n,).

        """
        out: Array = -self.law.force(p[None], self.data.v, self.data.t)[0] / self.data.mass
        return out


def identify(
    law: PaperLaw, data: AccelerationSeries, effort: Effort, rng: np.random.Generator, method: str = "mga"
) -> Identification:
    """Identify a law by the papers' search.

    Parameters
    ----------
    law, data
        The law, and the series to explain.
    effort
        Number of seeds and evaluations.
    rng
        Source of the search for the lowest error.
    method
        Search of `frictrack.search`.

    Returns
    -------
    Identification
        Parameters of each seed, and those of the lowest error known.

    """
    found = tuple(
        papers_method.search_parameters(law, data, method, seed=i, budget=effort.budget).x
        for i in range(effort.identified)
    )
    best = min(found, key=lambda p: papers_method.squared_error(law, p, data))
    return Identification(
        law, data, found, papers_method.lowest_error_parameters(law, data, [best], rng, effort.lowest)
    )


def mechanism_of_neither() -> tuple[models.Model, dict[str, dict[str, float]]]:
    """Build a mechanism of neither law: the beam's vibration modulates dry friction, and there is a collision.

    Returns
    -------
    tuple
        Model, and parameter values by effect.

    """
    p = dict(zip(laws.tustin().names, printed.ATM1["low"].values[:4], strict=True))
    model = models.of(["coulomb", "stribeck", "viscous", "load_modulation", "collision"])
    return model, {
        "coulomb": {"F_c": p["F_c"]},
        "stribeck": {"F_s": p["F_s"] - p["F_c"], "v_s": p["v_s"], "delta": 1.0},
        "viscous": {"F_v": p["F_v"]},
        "load_modulation": {"depth": 0.6, "frequency": 34.9, "phase": 0.4},
        "collision": {"J": 0.3, "time": 0.03, "width": 2e-3},
    }


def simulate_sources(group: str, rng: np.random.Generator) -> dict[str, SyntheticRecording]:
    """Simulate the recordings of one speed group.

    Parameters
    ----------
    group
        "low" or "high".
    rng
        Source of the noise.

    Returns
    -------
    dict
        Recordings from the ATM1 tables, from the ATM2 tables, and from neither model.

    """
    speed = printed.ATM1[group].speed or 0.0
    return {
        "ATM1 tables": recordings.record_printed(printed.ATM1[group], TIME_UNITS["ATM1"], BEAM, rng),
        "ATM2 tables": recordings.record_printed(printed.ATM2[group], TIME_UNITS["ATM2"], BEAM, rng),
        "neither": recordings.record_law(*mechanism_of_neither(), BEAM, speed, rng),
    }


def fit_with_frictrack(law: str, run: Run) -> Fit | None:
    """Fit a law to one run in the displacement domain; None if the fit fails."""
    try:
        return fit(law, [replace(run, name="r")])
    except FrictrackError:
        return None


def estimate_text(found: Fit | None, address: str, form: str = ".3f") -> str:
    """An estimate of frictrack as text, with its standard deviation; `address` may be F_c, F_s, F_v or v_s."""
    if found is None:
        return "no fit"
    estimate = found.parameters[ADDRESSES.get(address, address)]
    if estimate.value is None:
        return "not determined"
    spread = "" if estimate.std is None else f" ± {estimate.std:{'.2g' if form.endswith('g') else form}}"
    return f"{estimate.value:{form}}{spread}"


def range_over_seeds(result: Identification, i: int) -> str:
    """Smallest and largest value of a parameter over the seeds, as text."""
    seeds = np.array(result.found)[:, i]
    return f"{seeds.min():.3g} to {seeds.max():.3g}"
