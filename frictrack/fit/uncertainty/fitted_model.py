"""What profiles and the bootstrap need of a fitted model."""

from __future__ import annotations

from typing import Protocol

from frictrack.fit.least_squares import Solution
from frictrack.records import Array


class FittedModel(Protocol):
    """A model fitted to runs, such as `frictrack.fit.Fit`."""

    @property
    def solution(self) -> Solution:
        """The unknowns, and the model of the displacement linearised there."""

    @property
    def compared(self) -> Solution:
        """The same in the domain that was compared: displacement, acceleration or measured friction."""

    @property
    def domain(self) -> str:
        """What was compared: "displacement" or "force"."""

    @property
    def search(self) -> str:
        """How the parameters were searched for."""

    @property
    def is_default_route(self) -> bool:
        """Whether variable projection fitted the displacement."""

    @property
    def covariance(self) -> Array:
        """Covariance (P, P) of the unknowns."""
