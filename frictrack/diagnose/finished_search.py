"""Define what a search leaves to its conclusion."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from frictrack.diagnose.examination import Examination
from frictrack.diagnose.formulas import FormulaSearch
from frictrack.diagnose.refined_candidates import RefinedCandidate
from frictrack.diagnose.rivals import AlternativeSet
from frictrack.fit.least_squares import Solution


@dataclass(frozen=True, eq=False)
class FinishedSearch:
    """Result of a search.

    `first` and `last` are the examinations of the model and of the model with the effects found. `tried` are effects
    that gain something alone, best first, and `generators` the random numbers of the later steps. `formulas` searches
    formulas beside `start`. `cut` says what was left out because the budget of evaluations was spent; it is None if
    nothing was. `alternatives` are other sets that explain as much as the effects found; `is_beaten` says that one
    formula explains far more than these.
    """

    start: Solution
    first: Examination
    last: Examination
    tried: list[RefinedCandidate]
    found: list[RefinedCandidate]
    generators: list[np.random.Generator]
    formulas: FormulaSearch
    cut: str | None = None
    alternatives: Sequence[AlternativeSet] = ()
    is_beaten: bool = False

    @property
    def passing(self) -> list[RefinedCandidate]:
        """Effects that pass alone, best first."""
        return [t for t in self.tried if t.passes]
