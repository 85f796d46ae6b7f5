"""One place shows the whole flow: from a study file to its report, and nothing done twice.

    recording -> track -> displacement -> filtered -> motion -> friction        per run, the table in `stages`
    fit -> compare -> diagnose -> (add, fit again) -> report                    per study, here

`Session` is the only code that loads, runs and saves; the command line and the workbench speak to it.
"""

from frictrack.flow.demo import demo
from frictrack.flow.films import sheet
from frictrack.flow.opening import open_study, start_study
from frictrack.flow.planned import plan
from frictrack.flow.script import script
from frictrack.flow.session import Session
from frictrack.flow.stages import Progress, silent
from frictrack.flow.stored import attempted, previewed, stored
from frictrack.flow.tried import Spec, own_effects
from frictrack.flow.verify import verify

__all__ = [
    "Progress",
    "Session",
    "Spec",
    "attempted",
    "demo",
    "open_study",
    "own_effects",
    "plan",
    "previewed",
    "script",
    "sheet",
    "silent",
    "start_study",
    "stored",
    "verify",
]
