"""The parameter vector: its layout, constraints between parameters, friction levels of the runs, an unknown mass."""

from frictrack.fit.parameters.constraints import MASS, follow, quoted
from frictrack.fit.parameters.layout import LEVEL, MIN_RUNS, Layout, Slot, balanced, settle, told
from frictrack.fit.parameters.level_scatter import (
    Basis,
    basis_of,
    prior_departure,
    prior_misfit,
    prior_rows,
    restraint,
    restraint_rows,
)
from frictrack.fit.parameters.mass import MASS_EFFECT, friction_law, is_sought, ratio, rescaled, weighed, with_mass

__all__ = [
    "LEVEL",
    "MASS",
    "MASS_EFFECT",
    "MIN_RUNS",
    "Basis",
    "Layout",
    "Slot",
    "balanced",
    "basis_of",
    "follow",
    "friction_law",
    "is_sought",
    "prior_departure",
    "prior_misfit",
    "prior_rows",
    "quoted",
    "ratio",
    "rescaled",
    "restraint",
    "restraint_rows",
    "settle",
    "told",
    "weighed",
    "with_mass",
]
