"""List the effects that a plan separates, each with its typical setting and the grid on which it is fitted."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np

from frictrack import effects
from frictrack.effects import Effect, Span
from frictrack.models import Model
from frictrack.records import Array

MEASUREMENT_NOISE_RATIO = 1.0  # size of a measurement fault (rms) over the noise per frame
MAX_GRID_POINTS = 150  # per effect
MAX_FREQUENCY_HZ = 250.0  # up to which spectral lines are searched for
N_EVENT_TIMES = 24  # times of an event in a run
REASON_BY_NEED = {
    "drive": "needs a measured drive",
    "lift": "needs the vertical motion of the mass",
    "angle": "needs the rotation of the target",
    "clamp_x": "needs the position of the clamp",
    "earlier": "needs pauses of known length between the runs",
}


@dataclass(frozen=True)
class Cause:
    """One effect in a plan.

    Parameters
    ----------
    effect
        The effect.
    setting
        Its non-linear parameters if it is the true cause.
    grid
        The settings (G) at which it is fitted as a rival.

    """

    effect: Effect
    setting: dict[str, float]
    grid: tuple[dict[str, float], ...]

    @property
    def is_event(self) -> bool:
        """Whether it happens at a time of its own in every run."""
        return any(p.per_run and p.scan is not None for p in self.effect.nonlinear)


def list_causes(law: Model, span: Span) -> tuple[list[Cause], dict[str, str]]:
    """List the effects that a plan examines in addition to a friction law.

    Parameters
    ----------
    law
        The assumed friction law.
    span
        Duration, course, speeds and frame rate of the candidate runs.

    Returns
    -------
    causes : list of Cause
    excluded : dict of str
        Effects that are left out, with the reason.

    """
    present = {e.kind for e in law.effects}
    replaced = frozenset[str]().union(*(e.replaces for e in law.effects))
    causes, excluded = [], {}
    for effect in effects.LIBRARY.values():
        if effect.name in present or effect.kind in replaced or effect.replaces:
            continue
        if effect.modifies and not present & effect.modifies:
            excluded[effect.name] = f"modifies {' or '.join(sorted(effect.modifies))}, which the model does not contain"
        elif lacking := [REASON_BY_NEED[need] for need in effect.needs if need != "pixel_pitch"]:
            excluded[effect.name] = lacking[0]
        else:
            causes.append(Cause(effect, _typical_setting(effect, span), _grid(effect, span)))
    return causes, excluded


def _typical_setting(effect: Effect, span: Span) -> dict[str, float]:
    """Typical setting: the middle of a range, the geometric middle of a positive one."""
    excluded = {}
    for p in effect.nonlinear:
        if p.role == "phase":
            excluded[p.name] = 0.0
        elif p.role == "depth":
            excluded[p.name] = 1.0
        elif p.scan is None or not p.free:
            excluded[p.name] = p.fixed if p.fixed is not None else _middle(*p.bounds, signed=p.signed)
        else:
            grid = _scan_values(p.name, p.scan(span), span)
            excluded[p.name] = _middle(float(grid.min()), float(grid.max()), signed=p.signed)
    return excluded


def _middle(low: float, high: float, *, signed: bool) -> float:
    if not (np.isfinite(low) and np.isfinite(high)):
        return 1.0
    return float(np.sqrt(low * high)) if low > 0 and not signed else 0.5 * (low + high)


def _scan_values(name: str, grid: Array, span: Span) -> Array:
    """Scan values of one parameter, without frequencies that such runs resolve badly."""
    grid = np.asarray(grid, dtype=float)
    return grid[grid <= MAX_FREQUENCY_HZ] if name == "frequency" and np.any(grid <= MAX_FREQUENCY_HZ) else grid


def _grid(effect: Effect, span: Span) -> tuple[dict[str, float], ...]:
    """Grid of an effect, thinned to `MAX_GRID_POINTS` points, with its typical setting."""
    own = _typical_setting(effect, span)
    scanned = [p for p in effect.nonlinear if p.scan is not None and p.free]
    axes = [_scan_values(p.name, p.scan(span), span) for p in scanned if p.scan is not None]
    if any(p.per_run for p in scanned):  # a moment is searched for in every run separately
        axes = [np.linspace(0.05, 0.95, N_EVENT_TIMES) if p.per_run else a for p, a in zip(scanned, axes, strict=True)]
    counts = [_points_per_axis(len(a), [len(b) for b in axes]) for a in axes]
    thinned = [np.unique(a[np.linspace(0, len(a) - 1, m).astype(int)]) for a, m in zip(axes, counts, strict=True)]
    points = [own | dict(zip((p.name for p in scanned), map(float, q), strict=True)) for q in product(*thinned)]
    return tuple(points if any(p.per_run for p in scanned) else [own, *points])


def _points_per_axis(count: int, counts: list[int]) -> int:
    """Points kept of one axis: the same fraction of its logarithm for every axis."""
    total = float(np.prod(counts))
    if total <= MAX_GRID_POINTS:
        return count
    return max(min(count, 3), int(count ** (np.log(MAX_GRID_POINTS) / np.log(total))))
