"""Decide the verdict of a diagnosis from what its search found: the only place with this rule."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from frictrack.diagnose.power import Undetermined

MAX_ERROR_RATIO = 1.002  # of held-out errors that counts as no rise
MAX_ERROR_RATIO_DECISIVE = 0.9  # of held-out errors, for an effect named while the model is undetermined
NOTHING_TO_EXPLAIN = ("complete", "undetermined")  # verdicts that name no failure


@dataclass(frozen=True)
class Grounds:
    """What the verdict rests on.

    Attributes
    ----------
    something_missing
        Whether the model leaves a significant misfit, or an effect passes its test.
    n_found
        Number of effects found.
    misfit_left
        Whether a significant misfit is left with them.
    has_objection
        Whether one of them is no plausible cause.
    has_rivals
        Whether others explain as much, or a formula.
    is_formula
        Whether a formula explains far more than they do.
    error_ratio
        Held-out error with all effects found over that of the model without them; 0 if it was not computed.
    reduced_chi2
        Of the model without them.
    gaps
        What the runs could not have shown, and parameters of the model that they do not determine.
    doubted
        The run of which another mass explains more than the effects found.

    """

    something_missing: bool
    n_found: int = 0
    misfit_left: bool = False
    has_objection: bool = False
    has_rivals: bool = False
    is_formula: bool = False
    error_ratio: float = 0.0
    reduced_chi2: float = 1.0
    gaps: Sequence[Undetermined] = ()
    doubted: Sequence[Undetermined] = ()

    @property
    def is_explained(self) -> bool:
        """Whether the effects found are plausible, leave no misfit and lower the held-out error."""
        is_cause = self.n_found > 0 and not self.has_objection
        return is_cause and not self.misfit_left and self.error_ratio < MAX_ERROR_RATIO

    @property
    def is_clear(self) -> bool:
        """Whether something is missing that nothing explains, whatever the runs leave open."""
        return self.something_missing and not self.is_explained and self.reduced_chi2 >= 1


def judge(grounds: Grounds) -> str:
    """Return the verdict: complete, missing, ambiguous, unexplained or undetermined.

    Examples
    --------
    >>> judge(Grounds(something_missing=True, n_found=1, error_ratio=0.3))
    'missing'
    >>> judge(Grounds(something_missing=True, n_found=1, error_ratio=0.3, has_rivals=True))
    'ambiguous'

    """
    if not grounds.something_missing:
        return "undetermined" if grounds.gaps else "complete"
    if grounds.doubted:
        return "undetermined"
    if grounds.gaps and not (grounds.is_clear or _is_decisive(grounds)):
        return "undetermined"
    if grounds.is_formula or not grounds.is_explained:
        return "unexplained"
    return "ambiguous" if grounds.has_rivals else "missing"


def _is_decisive(grounds: Grounds) -> bool:
    """Whether the effects found are missing, whatever the runs leave open."""
    model_is_determined = all(gap.uncertainty is None for gap in grounds.gaps)
    return grounds.is_explained and (model_is_determined or grounds.error_ratio < MAX_ERROR_RATIO_DECISIVE)
