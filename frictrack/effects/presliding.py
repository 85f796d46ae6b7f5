"""Presliding: before it slides, a contact bends like a spring; dry friction follows its level over a short distance."""

from __future__ import annotations

import numpy as np

from frictrack.effects.base import Effect, Nonlinear, Parameter, Path, Span, log_grid
from frictrack.effects.memory import followed, travel
from frictrack.records import Array


def columns(path: Path, nonlinear: Nonlinear, inner: Array) -> Array:
    """Dry-friction columns, each replaced by its state du/dt = (|v|/length)(c - u), same shape as `inner`.

    `stiffness` is fitted as the length F_c/sigma_0, m. A path begins in steady sliding, or unbent where it begins
    at rest (s = 0).
    """
    before, after = travel(path)
    length = nonlinear["stiffness"]
    return followed(inner, (before / length, after / length), path.starts)


def lengths(span: Span) -> Array:
    """Breakaway lengths worth trying, m: from a micrometre up to a third of the travel."""
    longest = max((span.x_max - span.x_min) / 3.0, 1e-5)
    return log_grid(max(1e-6, 1e-4 * longest), longest, 4)


def quote(own: dict[str, float], model: dict[str, float]) -> dict[str, float]:
    """The stiffness at reversal per unit of what is left to slide, sigma_0 = F_c/length."""
    level = model.get("coulomb.F_c", float("nan"))
    return {"stiffness": level / own["stiffness"]} if "stiffness" in own else {}


presliding = Effect(
    name="presliding",
    acts_on="force",
    equation="coulomb + stribeck -> u, du/dt = (|v| stiffness/F_c)(coulomb + stribeck - u)",
    parameters=(Parameter("stiffness", "N/m", (0.0, np.inf), scan=lengths),),
    columns=columns,
    modifies=frozenset({"coulomb", "stribeck"}),
    scales_with="load",
    memory=True,
    turns=True,
    rank=1,
    what="Asperities bend before they slip: friction builds up over a distance, like a spring that yields.",
    looks_like="a loop against x after every reversal; nothing in a run that only slides one way",
    mistaken_for="stribeck or a soft mounting of the sensor, near reversals",
    confirm="Reverse the drive more slowly: the loop against x keeps its width, a lag in time shrinks.",
    source="Dahl 1968, Aerospace Corp. TOR-0158(3107-18)-1, exponent 1; in the form of Bliman & Sorine 1995",
    quote=quote,
)
