"""Compare the effects found with a force of one variable that has few parameters common to all runs.

Effects with parameters of their own in every run can imitate much. Formulas are fitted if such effects were found
though the misfit repeats over one axis, or if a smooth force over one axis is more likely than all that was found. Ties
go to the library: a formula must be decisively better, with a penalty for its search.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from frictrack.axes import AXES
from frictrack.diagnose.formulas import AXIS_SYMBOLS, SHAPES, Shape
from frictrack.diagnose.model_selection import MIN_CHI2_SEPARATED, information_criterion
from frictrack.diagnose.repeatability import Repeatability
from frictrack.diagnose.smooth_forces import ResidualForces
from frictrack.diagnose.unexplained import unexplained_force
from frictrack.fit.least_squares import Solution

MAX_DELTA_BIC_EQUAL = 6.0  # within which two models explain equally (Kass & Raftery 1995)


def find_simpler_model(
    forces: ResidualForces,
    found: Solution,
    repeats: Callable[[], Repeatability],
    functions: Sequence[Shape] = (),
) -> dict[str, Any] | None:
    """Find a force of one variable that explains as much as the effects found.

    Parameters
    ----------
    forces
        Smooth forces in the residual of the model before the search.
    found
        The model with the effects found.
    repeats
        Computes whether the misfit repeats, and over which axis; called only where that matters.
    functions
        Further shapes of formulas.

    Returns
    -------
    dict or None
        As `unexplained_force`, with `words`, and `decisive` if it explains more, with a penalty for its search.

    """
    start = forces.solution
    evidence = information_criterion(start) - information_criterion(found)
    if not _is_worth_searching(forces, found, repeats, evidence):
        return None
    unexplained = unexplained_force(start, forces=forces, functions=functions)
    if not unexplained["formulas"]:
        return None
    first = unexplained["formulas"][0]
    advantage = first["delta_bic"] - evidence
    added = len(found.problem.layout.slots) - len(start.problem.layout.slots)
    if advantage < -MAX_DELTA_BIC_EQUAL or first["unknowns"] >= added:
        return None
    decisive = advantage > MIN_CHI2_SEPARATED + _search_penalty(unexplained["axes"])
    return unexplained | {"decisive": decisive, "words": _words(first, added, decisive=decisive)}


def _is_worth_searching(
    forces: ResidualForces, found: Solution, repeats: Callable[[], Repeatability], evidence: float
) -> bool:
    """Whether formulas should be searched."""
    own = {s.effect for s in found.problem.layout.slots if s.run is not None}
    start = forces.solution.problem
    several = len({p.run for p in start.pieces}) > 1
    may_imitate = several and any(name in own for name in found.problem.model.names if name not in start.model)
    best_axis = repeats().best if may_imitate else None
    if best_axis is not None and best_axis.axis in AXIS_SYMBOLS:
        return True
    return forces.smooth[0].gain > evidence + MIN_CHI2_SEPARATED


def _search_penalty(axes: int) -> float:
    """Penalty for the best of many forms, axes and multipliers (Bonferroni)."""
    return 2 * float(np.log(len(SHAPES) * len(AXIS_SYMBOLS) * max(axes, 1)))


def _words(first: Mapping[str, Any], added: int, *, decisive: bool) -> str:
    much, than = ("more", "than") if decisive else ("as much", "as")
    count = "one parameter" if first["unknowns"] == 1 else f"{first['unknowns']} parameters"
    variables = " and ".join(AXES[name].name for name in first["variables"])
    return (
        f"a force that depends only on {variables} explains {much} with {count}, common to all runs, "
        f"{than} the effects found with {added}: {first['formula']}"
    )
