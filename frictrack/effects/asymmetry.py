"""Direction-dependent friction: dry level and viscous coefficient differ between the two directions."""

from __future__ import annotations

import numpy as np

from frictrack.effects.base import Effect, Nonlinear, Parameter, Path
from frictrack.records import Array


def columns(path: Path, nonlinear: Nonlinear) -> Array:
    """L and |v|, shape (n, 2): N per N of dF, N per N s/m of dF_v."""
    return np.column_stack([np.full_like(path.v, path.load), np.abs(path.v)])


asymmetry = Effect(
    name="asymmetry",
    acts_on="force",
    equation="dF L + dF_v |v|",
    parameters=(Parameter("dF", "N", linear=True, loaded=True), Parameter("dF_v", "N s/m", linear=True)),
    columns=columns,
    scales_with="load",
    what="The surfaces resist more one way than the other: wear, tilted asperities, a screw.",
    looks_like="forward and reversed runs need different friction laws",
    mistaken_for="slope (the level part), a drive offset",
    confirm="Turn the mass round on the course: asymmetry of its own face turns with it.",
    source="Janot, Gautier & Brunot 2019 (EMPS)",
)
