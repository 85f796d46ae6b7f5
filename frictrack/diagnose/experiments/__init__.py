"""Plan experiments: the run or the direct check that separates what the present runs cannot; runs before filming."""

from frictrack.diagnose.experiments.candidates import ExperimentSetup, candidate_runs, default_setup, fitted_setup
from frictrack.diagnose.experiments.proposals import next_run, plan_for_candidates, plan_for_unexplained
from frictrack.diagnose.experiments.selection import RunPlan, choose_runs, summarise_plan

__all__ = [
    "ExperimentSetup",
    "RunPlan",
    "candidate_runs",
    "choose_runs",
    "default_setup",
    "fitted_setup",
    "next_run",
    "plan_for_candidates",
    "plan_for_unexplained",
    "summarise_plan",
]
