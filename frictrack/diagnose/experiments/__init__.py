"""Plan experiments: the run or the direct check that separates what the present runs cannot; runs before filming."""
# ruff: noqa: F401 - the imports are the interface

from frictrack.diagnose.experiments.candidates import ExperimentSetup, candidate_runs, default_setup, fitted_setup
from frictrack.diagnose.experiments.proposals import next_run, plan_for_candidates, plan_for_unexplained
from frictrack.diagnose.experiments.selection import RunPlan, choose_runs, summarise_plan
