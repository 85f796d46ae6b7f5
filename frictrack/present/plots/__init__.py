"""Draw records and results as matplotlib figures. Nothing here computes physics or opens a file.

plots.motion(run).savefig("v3.pdf")
"""

from frictrack.present.plots.budget import budget, budgets, budgets_title
from frictrack.present.plots.campaign import trends
from frictrack.present.plots.candidates import candidates, has_limits, has_scan, limits, scan
from frictrack.present.plots.convergence import convergence
from frictrack.present.plots.cutoff import cutoff, cutoffs, filters
from frictrack.present.plots.drawn_data import plotted_data
from frictrack.present.plots.figure_list import study_figures
from frictrack.present.plots.held_out import history
from frictrack.present.plots.inputs import AnyModel as AnyModel
from frictrack.present.plots.inputs import AnyRun as AnyRun
from frictrack.present.plots.inputs import as_model, as_runs
from frictrack.present.plots.law import has_law, law, law_title, loops
from frictrack.present.plots.measured import film, friction, friction_title, motion, motions, motions_title, table
from frictrack.present.plots.missing_force import correlated_signal, has_missing_force, missing_force, unexplained
from frictrack.present.plots.model import failing, fit, modelled_force, noise_um, residual_unit, residuals, routes
from frictrack.present.plots.modelled import modelled
from frictrack.present.plots.notebook import html
from frictrack.present.plots.plan import next_experiments, pair_separation, remaining_pairs
from frictrack.present.plots.profiles import profiles
from frictrack.present.plots.style import numbered_name, pdf, plain_name, png, svg, svg_file
from frictrack.present.plots.verdict import failed_model, is_rejected, verdict
from frictrack.results.candidates import passes

__all__ = [
    "as_model",
    "as_runs",
    "budget",
    "budgets",
    "budgets_title",
    "candidates",
    "convergence",
    "correlated_signal",
    "cutoff",
    "cutoffs",
    "failed_model",
    "failing",
    "film",
    "filters",
    "fit",
    "friction",
    "friction_title",
    "has_law",
    "has_limits",
    "has_missing_force",
    "has_scan",
    "history",
    "html",
    "is_rejected",
    "law",
    "law_title",
    "limits",
    "loops",
    "missing_force",
    "modelled",
    "modelled_force",
    "motion",
    "motions",
    "motions_title",
    "next_experiments",
    "noise_um",
    "numbered_name",
    "pair_separation",
    "passes",
    "pdf",
    "plain_name",
    "plotted_data",
    "png",
    "profiles",
    "remaining_pairs",
    "residual_unit",
    "residuals",
    "routes",
    "scan",
    "study_figures",
    "svg",
    "svg_file",
    "table",
    "trends",
    "unexplained",
    "verdict",
]
