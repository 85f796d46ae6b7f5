"""Compute the Cramer-Rao bound of the parameters of a law from displacements.

Every run has its own start (x, v), and where the dry friction scatters a level of known spread: a random effect, held
to one by its own information 1/scatter^2. The Jacobian is that of scipy's integrator by central differences.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache

import numpy as np
from derivatives.signals import Array

from .scenes import Scene

STEP = 1e-4  # of a parameter; of 1 for a start or a phase that is zero


def bound(scene: Scene, noise: float) -> dict[str, float]:
    """Standard deviations of the law's parameters at white noise of `noise` m."""
    blocks = [block / noise for block in slopes(scene)]
    if scene.scatter:
        levels = np.eye(blocks[0].shape[1])[len(scene.law) + 2 :: 3]
        blocks.append(levels / scene.scatter)
    return dict(zip(scene.law, map(float, deviations(np.concatenate(blocks))), strict=False))


@lru_cache(maxsize=16)
def slopes(scene: Scene) -> tuple[Array, ...]:
    """Derivatives (n, P) of every run after the law, and every run's start and level in turn."""
    shared, runs = list(scene.law), len(scene.speeds)
    own = 3 if scene.scatter else 2
    blocks = []
    for run in range(runs):
        t = scene.frames(run)

        def moved(p: Array, run: int = run, t: Array = t) -> Array:
            return scene.motion(run, dict(zip(shared, p, strict=False)), (p[-3], p[-2]), p[-1], t)

        jac = jacobian(moved, np.array([*scene.law.values(), 0.0, scene.speeds[run], 1.0]))
        block = np.zeros((len(t), len(shared) + own * runs))
        block[:, : len(shared)] = jac[:, : len(shared)]
        block[:, len(shared) + own * run :][:, :own] = jac[:, len(shared) :][:, :own]
        blocks.append(block)
    return tuple(blocks)


def jacobian(function: Callable[[Array], Array], p: Array) -> Array:
    """Derivatives (n, P) of a function of p (P,) by central differences."""
    steps = np.where(p == 0, STEP, STEP * np.abs(p))
    up_down = [(function(p + h * e), function(p - h * e)) for h, e in zip(steps, np.eye(len(p)), strict=True)]
    return np.stack([(up - down) / (2 * h) for (up, down), h in zip(up_down, steps, strict=True)], axis=1)


def deviations(rows: Array) -> Array:
    """Deviations (P,) of least squares on rows (N, P) of unit noise."""
    norm = np.linalg.norm(rows, axis=0)
    triangle = np.linalg.qr(rows / norm, mode="r")
    return np.asarray(np.linalg.norm(np.linalg.inv(triangle), axis=1) / norm)
