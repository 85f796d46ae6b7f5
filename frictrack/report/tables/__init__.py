"""Tables of text for the report and the page: results in, headings and rows out."""

from frictrack.report.tables.candidates import (
    CandidateCard,
    candidate_cards,
    candidate_table,
    detection_limit_table,
    importance_table,
    undetermined_table,
)
from frictrack.report.tables.errors import failing_span_table, history_table, route_table
from frictrack.report.tables.experiments import (
    experiment_table,
    inseparable,
    separating_experiments,
    with_expected_evidence,
)
from frictrack.report.tables.measurements import measurement_table, track_table
from frictrack.report.tables.parameters import (
    MAX_FIRST_PARAMETERS,
    interval_table,
    parameter_table,
    run_table,
    shared_parameters,
    short_parameter_table,
)
from frictrack.report.tables.text_table import Cell, TextTable, code_cell, make_table

__all__ = [
    "MAX_FIRST_PARAMETERS",
    "CandidateCard",
    "Cell",
    "TextTable",
    "candidate_cards",
    "candidate_table",
    "code_cell",
    "detection_limit_table",
    "experiment_table",
    "failing_span_table",
    "history_table",
    "importance_table",
    "inseparable",
    "interval_table",
    "make_table",
    "measurement_table",
    "parameter_table",
    "route_table",
    "run_table",
    "separating_experiments",
    "shared_parameters",
    "short_parameter_table",
    "track_table",
    "undetermined_table",
    "with_expected_evidence",
]
