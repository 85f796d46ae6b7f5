"""Add one effect to a fitted model, or remove one: start values from a scan, then refinement in simulation."""

# ruff: noqa: F401 - the imports are the interface

from frictrack.fit.stepwise.growth import (
    add_effect,
    guess_coefficients,
    refine_to_end,
    remove_effect,
    reorder_effects,
    simulate_trial,
)
from frictrack.fit.stepwise.order import EVENT_PARAMETERS, bic_penalty, entry_order, reversed_ties, ties_are_resolved
from frictrack.fit.stepwise.scan_starts import effect_for_scan, scan_effect, scan_effects
from frictrack.fit.stepwise.trial import (
    STRONG_MISFIT_CHI2,
    CandidateTrial,
    baseline_misfit,
    deepen_trials,
    gain_by_smaller_scatter,
    is_unconstrained,
    misfit_left_by_other,
    most_by_smaller_scatter,
    try_effect,
    try_effects,
    try_together,
)
