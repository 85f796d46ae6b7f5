"""Say everything that the page shows about a study, as plain JSON; no web framework, and nothing is computed.

state = state_of(SnapshotReader(Path("study.toml")).read())

snapshot   read study file, results, history and recordings as their files are
fields     mass, frame rate, scale: the value as read, warnings, errors
models     models tried, outdated results; parameters, settings, verdict and candidates of the current model
state      all of it, with the runs, what is missing before the analysis can run, and the changes in plain words
"""

# ruff: noqa: F401 - the imports are the interface

from frictrack.workbench.summaries.fields import check_fields, new_study, refuse_implausible
from frictrack.workbench.summaries.models import candidate_curves, effect_library, searches
from frictrack.workbench.summaries.snapshot import Snapshot, SnapshotReader
from frictrack.workbench.summaries.state import change_words, state_of
