"""Groups of effects that are evaluated together, and the linear coefficients of their columns."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from frictrack.effects import Effect, Path
from frictrack.models import Model
from frictrack.records import Array

Indices = NDArray[np.int_]
Values = dict[str, dict[str, Any]]
QUADRATURES = (0.0, np.pi / 2)
NO_INDICES: Indices = np.zeros(0, dtype=int)


@dataclass(frozen=True)
class Coefficient:
    """One linear coefficient: a parameter of an effect, shared (run None) or of one run.

    Of a sinusoid it is one quadrature.
    """

    effect: str
    parameter: str
    run: int | None
    bounds: tuple[float, float]
    quadrature: int | None = None
    loaded: bool = False


@dataclass(frozen=True)
class EffectGroup:
    """Effects that are evaluated together.

    `nonlinear_slots` are the positions in the layout of the parameters that their columns depend on. The phases of a
    sinusoid (`phase_slots`) are separate, because its quadratures do not depend on them.
    """

    model: Model
    is_sinusoid: bool
    is_measurement: bool
    nonlinear_slots: tuple[int, ...]
    phase_slots: tuple[int, ...] = ()

    @property
    def names(self) -> list[str]:
        """Names of its effects."""
        return self.model.names

    def columns(self, path: Path, values: Values) -> Array:
        """Compute all columns of the group, (n, k)."""
        if len(self.model.effects) == 1:
            effect = self.model.effects[0]
            return effect.columns(path, values[effect.name])
        return np.concatenate(list(self.model.force_columns(path, values).values()), axis=1)


@dataclass(frozen=True, eq=False)
class Segment:
    """A part of a stack with one set of coefficients.

    `at` (k,) are the coefficients of the columns, -1 for none; `inside` is the part among the data of the stack, `cut`
    the same among all data, `members` its blocks.
    """

    at: Indices
    inside: slice
    cut: slice
    members: tuple[int, ...]

    @cached_property
    def kept(self) -> Indices:
        """Which of the columns have a coefficient."""
        return np.flatnonzero(self.at >= 0)


@dataclass(frozen=True)
class FreeValue:
    """A free non-linear parameter along a stack: positions in the layout, each with the members that it holds for."""

    effect: str
    parameter: str
    is_depth: bool
    places: list[tuple[int, list[int]]]


def is_depth(model: Model, effect: str, parameter: str) -> bool:
    """Return whether a parameter of a model scales what a modifier changes."""
    return next(e for e in model.effects if e.name == effect).parameter(parameter).role == "depth"


def coupled_effects(model: Model) -> list[list[Effect]]:
    """Effects that are evaluated together: modifiers with all that they modify, the others alone."""
    kinds = {k for e in model.effects for k in e.modifies}
    joined = [e for e in model.effects if e.modifies or e.kind in kinds]
    out: list[list[Effect]] = [[e] for e in model.effects if e not in joined]
    return [joined, *out] if joined else out
