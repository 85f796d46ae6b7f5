"""One place shows the whole flow: from a study file to its report, and nothing done twice.

    recording -> track -> displacement -> filtered -> motion -> friction        per run, the table in `stages`
    fit -> compare -> diagnose -> (add, fit again) -> report                    per study, here

`Session` is the only code that loads, runs and saves; the command line and the workbench speak to it.
"""

from frictrack.flow.film_stages import contact_sheet_path
from frictrack.flow.opening import open_study, start_study
from frictrack.flow.pipeline import Progress, no_progress
from frictrack.flow.replay import replay_script
from frictrack.flow.run_plan import plan
from frictrack.flow.sample_demo import demo
from frictrack.flow.session import Session
from frictrack.flow.stored_results import preview_motion, read_attempt, read_results
from frictrack.flow.tried_models import FitRequest, user_effects
from frictrack.flow.verification import verify

__all__ = [
    "FitRequest",
    "Progress",
    "Session",
    "contact_sheet_path",
    "demo",
    "no_progress",
    "open_study",
    "plan",
    "preview_motion",
    "read_attempt",
    "read_results",
    "replay_script",
    "start_study",
    "user_effects",
    "verify",
]
