"""Draw records and results as matplotlib figures. Nothing here computes physics or opens a file.

plots.motion(run).savefig("v3.pdf")
"""
# ruff: noqa: F401 - the imports are the interface

from frictrack.present.plots.evidence import (
    candidates,
    correlated_signal,
    has_limits,
    has_scan,
    limits,
    missing_force,
    next_experiments,
    pair_separation,
    parameter_unit,
    scan,
    unexplained,
)
from frictrack.present.plots.figure_list import study_figures
from frictrack.present.plots.inputs import AnyModel, AnyRun, as_model, as_runs, plotted_data
from frictrack.present.plots.law import convergence, has_law, law, law_title, loops, profiles, trends
from frictrack.present.plots.measured import (
    budget,
    budgets,
    budgets_title,
    cutoff,
    cutoffs,
    film,
    filters,
    friction,
    friction_title,
    motion,
    motions,
    motions_title,
    table,
)
from frictrack.present.plots.model import (
    error_words,
    failing,
    fit,
    history,
    modelled,
    modelled_force,
    noise_um,
    residual_unit,
    residuals,
    routes,
)
from frictrack.present.plots.style import file_content, html, pdf, png, svg, svg_file
from frictrack.present.plots.verdict import failed_model, is_rejected, verdict
from frictrack.results.candidates import numbered_name, passes, plain_name
