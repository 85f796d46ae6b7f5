"""The response of a solution to its non-linear parameters and friction levels, to first order."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from frictrack.fit.separable.groups import Indices
from frictrack.records import Array, Mask


@dataclass(frozen=True, eq=False)
class Tangent:
    """The response of a solution to d non-linear parameters and R friction levels, at constant coefficients.

    A datum belongs to one run, hence responds to one level only.

    Attributes
    ----------
    positions : array of int, shape (d + R,)
        Positions of the parameters in the layout, the levels last.
    slopes : array of shape (d, M)
        Change of the modelled data per unit of every parameter.
    per_datum : array of shape (M,)
        Change of every modelled datum per unit of the level of its run.
    run : array of int, shape (M,)
        The run of every datum.
    precision : array of shape (d + R, d + R), optional
        Precision of the penalties on them.
    gradient : array of shape (d + R,)
        Half the downward slope of the misfit.
    is_inside : array of bool, shape (d + R,)
        Which of them are inside their bounds.

    """

    positions: Indices
    slopes: Array
    per_datum: Array
    run: Indices
    precision: Array | None
    gradient: Array
    is_inside: Mask

    @property
    def n_levels(self) -> int:
        """Number of friction levels."""
        return len(self.positions) - len(self.slopes)

    @cached_property
    def rows(self) -> Array:
        """Change of the modelled data per unit of everything, (d + R, M)."""
        if not self.n_levels:
            return self.slopes
        out = np.zeros((len(self.positions), self.slopes.shape[1]))
        out[: len(self.slopes)] = self.slopes
        out[len(self.slopes) + self.run, np.arange(len(self.run))] = self.per_datum
        return out

    def products(self, others: Array) -> Array:
        """Multiply other data (K, M) with the responses; gives (K, d + R)."""
        own = others @ self.slopes.T
        return np.hstack([own, self._level_products(others)]) if self.n_levels else own

    def _level_products(self, others: Array) -> Array:
        """Products of other data (K, M) with the responses to the levels, (K, R)."""
        return np.stack([np.bincount(self.run, self.per_datum * other, self.n_levels) for other in others])

    @cached_property
    def normal(self) -> Array:
        """Inner products of the responses, with the precision of the penalties, (d + R, d + R)."""
        d, out = len(self.slopes), np.zeros((len(self.positions), len(self.positions)))
        out[:d, :d] = self.slopes @ self.slopes.T
        if self.n_levels:
            across = self._level_products(np.concatenate([self.slopes, self.per_datum[None]]))
            out[:d, d:], out[d:, :d], out[d:, d:] = across[:d], across[:d].T, np.diag(across[d])
        return out if self.precision is None else out + self.precision
