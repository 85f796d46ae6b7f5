"""Define what a search leaves to its conclusion: the effects found, those tried alone, and the models examined."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from frictrack.diagnose.examination import Examination
from frictrack.diagnose.formulas import FormulaSearch
from frictrack.effects import Effect
from frictrack.fit.least_squares import Solution


@dataclass(frozen=True)
class RefinedCandidate:
    """An effect added to a model, with its evidence.

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


@dataclass(frozen=True, eq=False)
class FinishedSearch:
    """Result of a search.

    `first` and `last` are the examinations of the model and of the model with the effects found. `tried` are effects
    that gain something alone, best first, and `generators` the random numbers of the later steps. `formulas` searches
    formulas of what `start` misses. `cut` says what was left out because the budget of evaluations was spent; it is
    None if nothing was. `alternatives` are other sets that explain as much as the effects found; `is_beaten` says that
    one formula explains far more than these.
    """

    start: Solution
    first: Examination
    last: Examination
    tried: list[RefinedCandidate]
    found: list[RefinedCandidate]
    generators: list[np.random.Generator]
    formulas: FormulaSearch
    cut: str | None = None
    alternatives: Sequence[dict[str, Any]] = ()
    is_beaten: bool = False

    @property
    def passing(self) -> list[RefinedCandidate]:
        """Effects that pass alone, best first."""
        return [t for t in self.tried if t.passes]

    @property
    def something_is_missing(self) -> bool:
        """Whether the model leaves a significant misfit, or an effect passes its test."""
        return bool(self.first.leaves_misfit or self.passing or self.found)
