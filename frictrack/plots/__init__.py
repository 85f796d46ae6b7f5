"""Records and results -> matplotlib figures. Nothing here computes physics or opens a file.

plots.motion(run).savefig("v3.pdf")
"""

from frictrack.plots.budget import budget
from frictrack.plots.cutoff import cutoff
from frictrack.plots.evidence import candidates, gain, history, limited, limits, passes, scan, scanned
from frictrack.plots.loops import loops
from frictrack.plots.measured import film, friction, motion
from frictrack.plots.model import failing, fit, noise_um, routes
from frictrack.plots.modelled import modelled
from frictrack.plots.profiles import profiles
from frictrack.plots.settle import settle
from frictrack.plots.style import number, numbered_name, plain_name, png, svg, unit
from frictrack.plots.unexplained import in_step, unexplained
from frictrack.plots.where import drawable, missing_force

__all__ = [
    "budget",
    "candidates",
    "cutoff",
    "drawable",
    "failing",
    "film",
    "fit",
    "friction",
    "gain",
    "history",
    "in_step",
    "limited",
    "limits",
    "loops",
    "missing_force",
    "modelled",
    "motion",
    "noise_um",
    "number",
    "numbered_name",
    "passes",
    "plain_name",
    "png",
    "profiles",
    "routes",
    "scan",
    "scanned",
    "settle",
    "svg",
    "unexplained",
    "unit",
]
