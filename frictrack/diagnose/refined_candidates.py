"""One effect as the result of a search: its fit beside the model, and its evidence."""

from __future__ import annotations

from dataclasses import dataclass

from frictrack.effects import Effect
from frictrack.fit.least_squares import Solution


@dataclass(frozen=True)
class RefinedCandidate:
    """An effect beside a model.

    Attributes
    ----------
    effect
        The effect.
    solution
        The simulated fit; None if it is too far behind to be simulated.
    delta_bic
        Fall of BIC.
    p
        p-value for the whole search.
    indistinguishable_from
        Effects whose best fit predicts the same data.
    objection
        Why it cannot be the cause; empty if it can.
    share
        Share of the misfit above the noise that it explains alone, along the measured motion; None if unknown.
    passes
        Whether it is plausible, significant in the whole search, and confirmed by its simulated fit.

    """

    effect: Effect
    solution: Solution | None
    delta_bic: float
    p: float
    indistinguishable_from: tuple[str, ...] = ()
    objection: str = ""
    share: float | None = None
    passes: bool = False

    @property
    def law(self) -> Solution:
        """The simulated fit."""
        assert self.solution is not None
        return self.solution
