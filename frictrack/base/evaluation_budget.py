"""Count the evaluations of a model that a search makes, and stop it when its budget is spent."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

COST_OF_MEMORY = 3.0  # of an evaluation of a law with memory, over one without (70 and 25 ms)


@dataclass(eq=False)
class EvaluationBudget:
    """Evaluations granted to a search and made so far; all fits of the search share one budget.

    A fit that finds it spent returns the best unknowns so far.

    Parameters
    ----------
    granted
        Evaluations that may be made; one is a simulation of all runs with its sensitivities, or what costs as much.
    used
        Evaluations made.
    was_cut
        Whether a step was left out because the budget was spent.

    Examples
    --------
    >>> budget = EvaluationBudget(granted=2)
    >>> budget.spend()
    >>> budget.stops()
    False
    >>> budget.spend()
    >>> budget.stops(), budget.was_cut
    (True, True)

    """

    granted: float = np.inf
    used: float = 0.0
    was_cut: bool = False

    @property
    def is_spent(self) -> bool:
        """Whether no evaluation is left."""
        return self.used >= self.granted

    def spend(self, evaluations: float = 1.0) -> None:
        """Count some evaluations."""
        self.used += evaluations

    def stops(self) -> bool:
        """Return whether the next step has to be left out, and remember it if so."""
        self.was_cut = self.was_cut or self.is_spent
        return self.is_spent

    def grant(self, evaluations: float) -> None:
        """Grant as many evaluations to what follows, whatever is left."""
        self.granted = self.used + evaluations
