"""Propose the next experiment: the run, or the direct check, that separates what the present runs cannot."""

from frictrack.diagnose.experiments.advice_text import settled_by
from frictrack.diagnose.experiments.evidence_forecast import EvidenceForecast
from frictrack.diagnose.experiments.expected_separation import FittedExplanation, ModelDiscrimination, make_explanation
from frictrack.diagnose.experiments.menu import Experiment, candidate_experiments, combined_experiments
from frictrack.diagnose.experiments.rating import (
    plan_for_candidates,
    plan_for_unexplained,
    propose_experiments,
    rate_runs,
)
from frictrack.diagnose.experiments.settings import last_settings, settings_of
from frictrack.diagnose.experiments.unknown_cause import explain_by_axes
from frictrack.diagnose.experiments.virtual_runs import (
    DEFAULT_SCATTER,
    GOLDEN_ANGLE_RAD,
    PLANNED_RUN_NAME,
    RunConditions,
    RunDesign,
    blank_piece,
    integrate_motion,
    max_frames_of_film,
)

__all__ = [
    "DEFAULT_SCATTER",
    "GOLDEN_ANGLE_RAD",
    "PLANNED_RUN_NAME",
    "EvidenceForecast",
    "Experiment",
    "FittedExplanation",
    "ModelDiscrimination",
    "RunConditions",
    "RunDesign",
    "blank_piece",
    "candidate_experiments",
    "combined_experiments",
    "explain_by_axes",
    "integrate_motion",
    "last_settings",
    "make_explanation",
    "max_frames_of_film",
    "plan_for_candidates",
    "plan_for_unexplained",
    "propose_experiments",
    "rate_runs",
    "settings_of",
    "settled_by",
]
