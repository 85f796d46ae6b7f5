"""Say everything that the page shows about a study, as plain JSON; no web framework, and nothing is computed.

state = state_of(read_snapshot(Path("study.toml")))

snapshot   read study file, results, history and recordings as their files are
fields     mass, frame rate, scale: the value as read, warnings, errors
runs       quality of the measurement, suspect frames, repairs, smoothing; what is missing before the analysis can run
models     models tried, parameters and settings of the current one, outdated results
diagnosis  verdict, candidates, formulas, next experiments; curves and errors of the model with one more effect
state      all of it, with the changes in plain words
"""

# ruff: noqa: F401 - the imports are the interface

from frictrack.workbench.summaries.diagnosis import candidate_curves
from frictrack.workbench.summaries.fields import check_fields, new_study, refuse_implausible
from frictrack.workbench.summaries.models import effect_library, searches
from frictrack.workbench.summaries.snapshot import Snapshot, SnapshotReader, read_snapshot
from frictrack.workbench.summaries.state import change_words, state_of
