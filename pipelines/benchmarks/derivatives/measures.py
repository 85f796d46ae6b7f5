"""Compute the figures of the table from estimates and truth."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from .estimate import Estimate
from .signals import Array, Signal

END_SHARE = 0.05  # of the record, at either end
NEAR_JUMP_S = 2e-3  # s, about a jump
ORDERS = "xva"


def judge(truth: Signal, estimates: Sequence[Estimate], seconds: Sequence[float]) -> dict[str, Any]:
    """Figures of one method over several noise realisations: rms errors in m, m/s, m/s^2; rms of the z-scores."""
    errors = np.array([[found - true for found, true in zip(e[:3], truth[2:5], strict=True)] for e in estimates])
    figures = summary(truth, errors**2)
    figures["a_worst"] = max(_rms(one**2) for one in errors[:, 2])
    for k, order in enumerate(ORDERS):
        figures[f"z_{order}"] = _z(errors[:, k], [e[3 + k] for e in estimates])
    return figures | {"ms": 1e3 * float(np.median(seconds)), "seeds": len(estimates)}


def summary(truth: Signal, squares: Array) -> dict[str, Any]:
    """Rms over the record and its parts, from squared errors (seeds, 3, n)."""
    where = parts(truth)
    a = {f"a_{part}": _rms(squares[:, 2, mask]) for part, mask in where.items()}
    return {"a": _rms(squares[:, 2]), **a, "v": _rms(squares[:, 1]), "x": _rms(squares[:, 0])}


def parts(truth: Signal) -> dict[str, Any]:
    """Masks of the middle, of both ends, and of what is near an event or not."""
    n = len(truth.t)
    edge, frame = round(END_SHARE * n), np.arange(n)
    first, last = frame < edge, frame >= n - edge
    near = np.zeros(n, dtype=bool)
    if truth.events:
        near = np.min(np.abs(truth.t[:, None] - np.array(truth.events)), axis=1) <= NEAR_JUMP_S
    return {"mid": ~first & ~last, "first": first, "last": last, "near": near, "off": ~near & near.any()}


def _rms(squares: Array) -> float:
    return float(np.sqrt(np.mean(squares))) if squares.size else float("nan")


def _z(errors: Array, sigmas: Sequence[Array | None]) -> float:
    if any(s is None for s in sigmas):
        return float("nan")
    with np.errstate(divide="ignore"):  # who claims to be exact is infinitely wrong
        return _rms((errors / np.array(sigmas)) ** 2)
