"""The parameter vector of a fit: its layout, constraints, priors, friction levels of the runs, and an unknown mass.

The unknowns of a model over several runs form one vector p (P,). `ParameterLayout` maps it to the parameter values of
every run. The internal value of a parameter may differ from the reported one: F_s is fitted as F_s - F_c, and with an
unknown mass every force is fitted as a multiple of itself.
"""

# ruff: noqa: F401 - the imports are the interface

from frictrack.fit.parameters.constraints import MASS, apply_constraints, reported_value
from frictrack.fit.parameters.layout import (
    LEVEL,
    MIN_RUNS_FOR_SCATTER,
    ParameterLayout,
    Slot,
    canonical_form,
    known_value,
    mass_ratio,
    normalise_levels,
)
from frictrack.fit.parameters.mass import (
    MASS_EFFECT,
    is_mass_unknown,
    rescale_to_mass,
    with_fitted_mass,
    with_mass,
    without_mass,
)
from frictrack.fit.parameters.penalties import (
    SCATTER_BOUNDS,
    JacobianBasis,
    direct_prior_equations,
    jacobian_basis,
    penalty_jacobian,
    penalty_residual,
    prior_departure,
    prior_jacobian,
    prior_misfit,
    prior_residual,
)
