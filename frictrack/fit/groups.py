"""Fit one set of parameters per group of runs, such as low and high speed in the papers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import chain
from typing import TYPE_CHECKING, Any

import numpy as np

from frictrack.errors import FrictrackError
from frictrack.fit.free_run import free_errors
from frictrack.fit.result import Fit, StorableFit
from frictrack.lazy import imported
from frictrack.models import Model
from frictrack.records import Curve, ModelledMotion, Run

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure


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

    def plot(self) -> Figure:
        """Draw the modelled and the measured friction force of all groups; see `Fit.plot`."""
        figure: Figure = imported("frictrack.plots:fit")(self, self.weighed)
        return figure

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

    def summary(self) -> dict[str, Any]:
        """Return the JSON of `frictrack fit --per group`: the same keys, parameters as `coulomb.F_c[low]`."""
        group_fits = {name: f.summary() for name, f in self.fits.items()}
        first = next(iter(group_fits.values()))
        return (
            {key: first[key] for key in ("model", "domain", "search")}
            | {
                "per": "group",
                "parameters": {f"{k}[{g}]": v for g, s in group_fits.items() for k, v in s["parameters"].items()},
                "friction_scatter": {g: s["friction_scatter"] for g, s in group_fits.items()},
                "correlations": [
                    [f"{a}[{g}]", f"{b}[{g}]", r] for g, s in group_fits.items() for a, b, r in s["correlations"]
                ],
                "remarks": [f"{g}: {line}" for g, s in group_fits.items() for line in s["remarks"]],
                "errors": self.errors,
                "per_run": [row | {"group": g} for g, s in group_fits.items() for row in s["per_run"]],
                "collisions": [
                    collision | {"group": g} for g, s in group_fits.items() for collision in s["collisions"]
                ],
            }
            | ({"prior": {g: s["prior"] for g, s in group_fits.items()}} if "prior" in first else {})
        )


def by_group(runs: Sequence[Run]) -> dict[str, list[Run]]:
    """Sort runs into groups, in the order in which the groups first appear.

    Raises
    ------
    FrictrackError
        (usage) If a run has no group.

    """
    ungrouped = [r.name for r in runs if not r.group]
    if ungrouped:
        raise FrictrackError(
            f"per group: expected every run to have a group but {', '.join(ungrouped)} has none; give it "
            'group = "low", for example',
            usage=True,
        )
    groups: dict[str, list[Run]] = {}
    for run in runs:
        groups.setdefault(run.group, []).append(run)
    return groups
