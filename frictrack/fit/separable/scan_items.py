"""The effects of a model that are scanned, their grids and their coefficients."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from frictrack.effects import Effect
from frictrack.fit.separable.model import SeparableModel
from frictrack.fit.separable.table_scan import ScanGrid

MAX_SCAN_AXES = 3  # parameters of one effect that are scanned together


def scan_grid(separable: SeparableModel, effect: str, run: int | None) -> ScanGrid:
    """Create the grid of an effect's scanned parameters, without frequencies above the band of the data."""
    effect_rows = next(e for e in separable.layout.model.effects if e.name == effect)
    span = separable.layout.span if run is None else separable.layout.spans[run]
    highest = max(b.highest for b in separable.blocks)
    scanned = [p for p in effect_rows.nonlinear if p.scan is not None and p.free]
    axes = []
    for p in scanned:
        assert p.scan is not None
        axis = np.asarray(p.scan(span), dtype=float)
        axis = axis[(axis >= p.bounds[0]) & (axis <= p.bounds[1])]
        if p.unit == "Hz" and np.any(axis < highest):
            axis = axis[axis < highest]
        axes.append(axis)
    values = np.array(list(product(*axes)))
    steps = np.array(list(product(*[range(len(a)) for a in axes])))
    return ScanGrid(tuple(p.name for p in scanned), values, steps)


@dataclass(frozen=True)
class ScanItem:
    """An effect to scan, in group `g`; in one `run` if its scan belongs to single runs."""

    effect: str
    g: int
    run: int | None = None


def is_scannable(effect: Effect) -> bool:
    """Return whether an effect can be scanned on a grid: it modifies no other and has few scanned parameters.

    An effect with relaxed parts is scanned part by part.
    """
    scanned = [p for p in effect.nonlinear if p.scan is not None and p.free]
    return bool(effect.relaxed) or (not effect.modifies and len(scanned) <= MAX_SCAN_AXES)


def scanned_effects(separable: SeparableModel) -> list[ScanItem]:
    """Return the effects of a model that are scanned, in its order."""
    out = []
    for effect in separable.layout.model.effects:
        g = next(k for k, group in enumerate(separable.groups) if effect.name in group.names)
        scanned = [p for p in effect.nonlinear if p.scan is not None and p.free]
        if not is_scannable(effect) or effect.relaxed:
            continue
        if effect.single:
            out += [
                ScanItem(effect.name, g, r) for r in separable.runs if (effect.name, r) not in separable.layout.absent
            ]
        elif scanned and effect.linear:
            out.append(ScanItem(effect.name, g))
    return out


def coefficients_of(separable: SeparableModel, item: ScanItem) -> NDArray[np.int_]:
    """Return the coefficients of the model that belong to an item."""
    return np.array(
        [
            i
            for i, c in enumerate(separable.coefficients)
            if c.effect == item.effect and (item.run is None or c.run in (None, item.run))
        ],
        dtype=int,
    )
