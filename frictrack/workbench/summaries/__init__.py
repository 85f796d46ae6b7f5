"""Say everything that the page shows about a study, as plain JSON; no web framework, and nothing is computed.

state = state_of(read_snapshot(Path("study.toml")))

snapshot        read study file, results, history and recordings as their files are
fields          mass, frame rate, scale: the value as read, warnings, errors
recordings      the recordings in the folder
readiness       what is missing before the analysis can run
runs            quality of the measurement, suspect frames, `repairs`, smoothing
models          models tried, parameters and settings of the current one, falling error
candidates      curves and errors of the model with one more effect
diagnosis       verdict, candidates, formulas, next experiments
outdated        results that do not belong to the study file or the model of now
history         changes in plain words
"""

from frictrack.workbench.summaries.candidates import candidate_curves
from frictrack.workbench.summaries.fields import check_fields, new_study, refuse_implausible
from frictrack.workbench.summaries.models import effect_library
from frictrack.workbench.summaries.snapshot import Snapshot, SnapshotReader, read_snapshot
from frictrack.workbench.summaries.state import StudyState, state_of

__all__ = [
    "Snapshot",
    "SnapshotReader",
    "StudyState",
    "candidate_curves",
    "check_fields",
    "effect_library",
    "new_study",
    "read_snapshot",
    "refuse_implausible",
    "state_of",
]
