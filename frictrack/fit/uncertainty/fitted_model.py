"""The interface of a fitted model that profiles and the bootstrap need."""

from __future__ import annotations

from typing import Protocol

from frictrack.fit.least_squares import Solution
from frictrack.records import Array


class FittedModel(Protocol):
    """A model fitted to runs, such as `frictrack.fit.Fit`."""

    @property
    def solution(self) -> Solution:
        """The unknowns, and the displacement model linearised there."""

    @property
    def compared(self) -> Solution:
        """The solution in the compared domain: displacement, acceleration or measured friction."""

    @property
    def domain(self) -> str:
        """The compared domain: "displacement" or "force"."""

    @property
    def search(self) -> str:
        """The search method."""

    @property
    def is_default_route(self) -> bool:
        """Whether variable projection fitted the displacement."""

    @property
    def covariance(self) -> Array:
        """Covariance (P, P) of the unknowns."""
