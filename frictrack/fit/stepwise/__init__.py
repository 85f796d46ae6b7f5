"""Add one effect to a fitted model, or remove one: start values from a scan, then refinement in simulation."""

# ruff: noqa: F401 - the imports are the interface

from frictrack.fit.stepwise.growth import add_effect, refine_to_end, remove_effect, simulate_trial
from frictrack.fit.stepwise.starts import (
    EVENT_PARAMETERS,
    bic_penalty,
    effect_for_scan,
    entry_order,
    scan_effect,
    scan_effects,
    ties_are_resolved,
)
from frictrack.fit.stepwise.trial import (
    CandidateTrial,
    TiedSeparableModel,
    baseline_misfit,
    can_choose_levels,
    deepen_trials,
    is_unconstrained,
    likely_levels,
    misfit_left_by_other,
    most_by_smaller_scatter,
    physical_objection,
    refine_on_measured_motion,
    try_effect,
    try_effects,
    try_together,
    with_levels,
    with_likely_levels,
    with_smaller_scatter,
)
