"""Whether a force of one variable with few numbers, the same in all runs, explains as much as what was found.

Effects with numbers of their own in every run can imitate much. Where such were found though the failure repeats along
one axis, or where a smooth force over one axis is likelier than all that was found, formulas are sought. The library
wins ties: only a formula that is decisively better, its search paid for, says that the cause is none of the library.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from frictrack.axes import AXES
from frictrack.diagnose.compressed import compress_residual
from frictrack.diagnose.formulas import AXIS_SYMBOLS, MAX_DELTA_BIC_EQUAL, SHAPES
from frictrack.diagnose.model_selection import MIN_CHI2_SEPARATED, information_criterion
from frictrack.diagnose.repeatability import Repeatability
from frictrack.diagnose.smooth_forces import smooth_forces
from frictrack.diagnose.unexplained import unexplained_force
from frictrack.fit.least_squares import Solution


def find_simpler_model(start: Solution, found: Solution, repeats: Repeatability) -> dict[str, Any] | None:
    """A plain force that explains as much as the effects found beyond the law of `start`, or None.

    As `unexplained_force`, with `words`, and `decisive` where it explains more, its search paid for.
    """
    worth = information_criterion(start) - information_criterion(found)
    if not _is_worth_searching(start, found, repeats, worth):
        return None
    told = unexplained_force(start)
    if not told["formulas"]:
        return None
    first = told["formulas"][0]
    ahead = first["delta_bic"] - worth
    added = len(found.problem.layout.slots) - len(start.problem.layout.slots)
    if ahead < -MAX_DELTA_BIC_EQUAL or first["unknowns"] >= added:
        return None
    decisive = ahead > MIN_CHI2_SEPARATED + _search_penalty(told["axes"])
    return told | {"decisive": decisive, "words": _words(first, added, decisive=decisive)}


def _is_worth_searching(start: Solution, found: Solution, repeats: Repeatability, worth: float) -> bool:
    """Whether a formula is worth a search."""
    own = {s.effect for s in found.problem.layout.slots if s.run is not None}
    several = len({p.run for p in start.problem.pieces}) > 1
    imitated = several and any(name in own for name in found.problem.model.names if name not in start.problem.model)
    along = repeats.best
    if imitated and along is not None and along.axis in AXIS_SYMBOLS:
        return True
    return smooth_forces(compress_residual(start))[0].gain > worth + MIN_CHI2_SEPARATED


def _search_penalty(axes: int) -> float:
    """What the best of so many forms gains by having been sought."""
    return 2 * float(np.log(len(SHAPES) * max(axes, 1)))


def _words(first: Mapping[str, Any], added: int, *, decisive: bool) -> str:
    much, than = ("more", "than") if decisive else ("as much", "as")
    count = "one number" if first["unknowns"] == 1 else f"{first['unknowns']} numbers"
    return (
        f"a force of {AXES[first['axis']].name} alone explains {much} with {count}, the same in all runs, "
        f"{than} what was found with {added}: {first['formula']}"
    )
