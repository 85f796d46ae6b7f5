"""Summarise collisions: a film determines the impulse, but mostly not the duration and so not the peak force.

The displacement responds to a pulse J g((t - time)/width) through its moments: J, J time and J width^2/2. So the
square of the width is nearly linear in the data, with the standard deviation 2 width std(width).
"""

from __future__ import annotations

from typing import Any

import numpy as np

from frictrack.effects import Effect
from frictrack.fit.least_squares import Solution
from frictrack.fit.pieces import Piece
from frictrack.fit.uncertainty import Estimates
from frictrack.records import Array, Mask

MAX_RELATIVE_STD = 0.3  # relative standard deviation of a resolved width
MIN_IMPULSE_STD = 3.0  # standard deviations; a smaller impulse is not significant
PULSE_HALF_WIDTHS = 3.0  # half length of a pulse in widths


def collisions(solution: Solution, estimates: Estimates) -> list[dict[str, Any]]:
    """Summarise every collision of the fitted runs as JSON: impulse, time since release, what is known of the width."""
    layout = solution.problem.layout
    return [
        _collision(solution, estimates, effect, i)
        for effect in _collision_effects(solution)
        for i in range(len(layout.run_names))
        if (effect.name, i) not in layout.absent
    ]


def frames_of_impact(solution: Solution, covariance: Array, piece: Piece) -> Mask:
    """Return the frames (n,) of collisions whose width is not resolved."""
    layout = solution.problem.layout
    values, _ = layout.values(solution.p, piece.run)
    out = np.zeros(len(piece.t), dtype=bool)
    for effect in _collision_effects(solution):
        width, std = _width(solution, covariance, effect, piece.run)
        if (effect.name, piece.run) not in layout.absent and std > MAX_RELATIVE_STD * width:
            out |= np.abs(piece.t - values[effect.name]["time"]) <= PULSE_HALF_WIDTHS * max_width(width, std)
    return out


def max_width(width: float, std: float) -> float:
    """Compute the largest plausible width (s) of a pulse: two standard deviations of its square above the fitted one.

    Examples
    --------
    >>> max_width(3.0, 0.0)
    3.0

    """
    return float(np.sqrt(width**2 + 4 * width * std))


def _collision_effects(solution: Solution) -> list[Effect]:
    return [e for e in solution.problem.model.effects if e.kind == "collision"]


def _width(solution: Solution, covariance: Array, effect: Effect, run: int) -> tuple[float, float]:
    """Width of a collision and its standard deviation, s; 0 where it is fixed."""
    layout = solution.problem.layout
    values, _ = layout.values(solution.p, run)
    at = [i for i in layout.active(run) if (s := layout.slots[i]).effect == effect.name and s.parameter == "width"]
    return values[effect.name]["width"], float(np.sqrt(covariance[at[0], at[0]])) if at else 0.0


def _collision(solution: Solution, estimates: Estimates, effect: Effect, index: int) -> dict[str, Any]:
    run, parameters = solution.problem.layout.run_names[index], estimates.parameters
    impulse, time = parameters[f"{effect.name}.J[{run}]"], parameters[f"{effect.name}.time[{run}]"]
    width, std = _width(solution, estimates.covariance, effect, index)
    at_most, resolved = max_width(width, std), std <= MAX_RELATIVE_STD * width
    if not impulse.value or abs(impulse.value) < MIN_IMPULSE_STD * (impulse.std or np.inf):
        remark = "no significant collision in this run"
    elif resolved:
        remark = "its width is resolved"
    else:
        remark = (
            f"its width is known to {100 * std / width:.0f} % only (at most {1e3 * at_most:.2g} ms): "
            "these frames determine the impulse, but not the peak force"
        )
    return {
        "effect": effect.name,
        "run": run,
        "impulse_N_s": impulse.value,
        "std": impulse.std,
        "relative_std": impulse.std / abs(impulse.value) if impulse.value and impulse.std is not None else None,
        "time_s": time.value,
        "width_s": width,
        "width_std": std,
        "width_at_most_s": at_most,
        "resolved": resolved,
        "words": remark,
    }
