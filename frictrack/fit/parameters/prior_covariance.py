"""Compute the covariance of the priors of a model, and the matrix that whitens it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from frictrack.errors import FrictrackError
from frictrack.models import Model
from frictrack.records import Array


@dataclass(frozen=True)
class ReportedPrior:
    """Prior knowledge of a parameter: mean and standard deviation of its reported value.

    `slot` is its position in the parameter vector, None if the reported value differs from the internal one.
    """

    address: str
    mean: float
    std: float
    slot: int | None
    phase: bool


def covariance_of_priors(model: Model, priors: Sequence[ReportedPrior]) -> Array:
    """Compute the covariance (m, m) of priors from their standard deviations and correlations.

    Raises
    ------
    FrictrackError
        (usage) If the correlations cannot hold together.

    """
    std = np.array([q.std for q in priors])
    at = {q.address: i for i, q in enumerate(priors)}
    matrix = np.eye(len(priors))
    for e in model.effects:
        for p in e.parameters:
            i = at.get(f"{e.name}.{p.name}")
            for other, r in p.prior_correlation if i is not None else ():
                if other in at:
                    matrix[i, at[other]] = matrix[at[other], i] = r
    if len(priors) and np.linalg.eigvalsh(matrix)[0] <= 0:
        raise FrictrackError("expected prior_correlation that can hold together (positive definite)", usage=True)
    return np.asarray(matrix * std * std[:, None], dtype=np.float64)


def whitening(covariance: Array) -> Array:
    """Compute W (m, m) with W' W the inverse of a covariance."""
    std = np.sqrt(np.diag(covariance))
    factor = np.linalg.cholesky(covariance / std / std[:, None])
    return np.asarray(np.linalg.inv(factor) / std, dtype=np.float64)
