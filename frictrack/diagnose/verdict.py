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
    is_explained = (
        grounds.n_found > 0
        and not grounds.misfit_left
        and not grounds.has_objection
        and grounds.error_ratio < MAX_ERROR_RATIO
    )
    if grounds.gaps and not _is_clear(grounds, is_explained):
        return "undetermined"
    if grounds.is_formula or not is_explained:
        return "unexplained"
    return "ambiguous" if grounds.has_rivals else "missing"


def _is_clear(grounds: Grounds, is_explained: bool) -> bool:
    """Whether something is missing, whatever the runs leave open."""
    if not is_explained:
        return grounds.reduced_chi2 >= 1
    model_is_determined = all(gap.uncertainty is None for gap in grounds.gaps)
    return model_is_determined or grounds.error_ratio < MAX_ERROR_RATIO_DECISIVE
