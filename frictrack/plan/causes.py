"""The effects that a plan tries to tell apart: each at a stated size and a usual setting, and its rivals' forms."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np

from frictrack import effects
from frictrack.effects import Effect, Span
from frictrack.models import Model
from frictrack.records import Array

SHARE = 0.05  # of the friction force (rms), of the momentum of a blow
FRAMES = 1.0  # frames lost
PICTURE = 1.0  # times the noise of a frame (rms), of a fault of the picture
MOST_FORMS = 150  # of one effect
HIGHEST = 250.0  # Hz, up to which lines are looked for
MOMENTS = 24  # of a run, at which an event may come
NEEDED = {
    "drive": "needs a measured drive",
    "lift": "needs a mass that is seen to move up and down",
    "angle": "needs a target that is seen to turn",
    "clamp_x": "needs the place of the clamp",
}


@dataclass(frozen=True)
class Cause:
    """One effect as a plan has it: where it stands if it is true, and all forms (G) in which it may explain another."""

    effect: Effect
    setting: dict[str, float]
    forms: tuple[dict[str, float], ...]

    @property
    def event(self) -> bool:
        """Whether it comes at a moment of its own in every run."""
        return any(p.per_run and p.scan is not None for p in self.effect.nonlinear)


def library(law: Model, span: Span) -> tuple[list[Cause], dict[str, str]]:
    """Causes that a plan looks at beside a law, and those it does not, with the reason."""
    there = {e.kind for e in law.effects}
    taken = frozenset[str]().union(*(e.replaces for e in law.effects))
    causes, out = [], {}
    for effect in effects.LIBRARY.values():
        if effect.name in there or effect.kind in taken or effect.replaces:
            continue
        if effect.modifies and not there & effect.modifies:
            out[effect.name] = f"reshapes {' or '.join(sorted(effect.modifies))}, which the law lacks"
        elif lacking := [NEEDED[need] for need in effect.needs if need != "pixel_pitch"]:
            out[effect.name] = lacking[0]
        else:
            causes.append(Cause(effect, _setting(effect, span), _forms(effect, span)))
    return causes, out


def _setting(effect: Effect, span: Span) -> dict[str, float]:
    """Where an effect stands: the middle of a place or moment, the geometric middle of a size."""
    out = {}
    for p in effect.nonlinear:
        if p.role == "phase":
            out[p.name] = 0.0
        elif p.role == "depth":
            out[p.name] = 1.0
        elif p.scan is None or not p.free:
            out[p.name] = p.fixed if p.fixed is not None else _middle(*p.bounds, signed=p.signed)
        else:
            grid = _axis(p.name, p.scan(span), span)
            out[p.name] = _middle(float(grid.min()), float(grid.max()), signed=p.signed)
    return out


def _middle(low: float, high: float, *, signed: bool) -> float:
    if not (np.isfinite(low) and np.isfinite(high)):
        return 1.0
    return float(np.sqrt(low * high)) if low > 0 and not signed else 0.5 * (low + high)


def _axis(name: str, grid: Array, span: Span) -> Array:
    """One axis of a scan, the part of a line's frequencies left out that no such film shows well."""
    grid = np.asarray(grid, dtype=float)
    return grid[grid <= HIGHEST] if name == "frequency" and np.any(grid <= HIGHEST) else grid


def _forms(effect: Effect, span: Span) -> tuple[dict[str, float], ...]:
    """The grid of an effect, thinned to `MOST_FORMS` points, its own setting among them."""
    own = _setting(effect, span)
    scanned = [p for p in effect.nonlinear if p.scan is not None and p.free]
    axes = [_axis(p.name, p.scan(span), span) for p in scanned if p.scan is not None]
    if any(p.per_run for p in scanned):  # moments are sought in every run by themselves
        axes = [np.linspace(0.05, 0.95, MOMENTS) if p.per_run else a for p, a in zip(scanned, axes, strict=True)]
    most = [_many(len(a), [len(b) for b in axes]) for a in axes]
    thin = [np.unique(a[np.linspace(0, len(a) - 1, m).astype(int)]) for a, m in zip(axes, most, strict=True)]
    points = [own | dict(zip((p.name for p in scanned), map(float, q), strict=True)) for q in product(*thin)]
    return tuple(points if any(p.per_run for p in scanned) else [own, *points])


def _many(mine: int, all_of_them: list[int]) -> int:
    """Points kept of an axis so that the grid keeps to `MOST_FORMS`: each by the same share of its digits."""
    total = float(np.prod(all_of_them))
    if total <= MOST_FORMS:
        return mine
    return max(min(mine, 3), int(mine ** (np.log(MOST_FORMS) / np.log(total))))
