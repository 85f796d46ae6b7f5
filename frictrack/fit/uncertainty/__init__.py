"""Compute the uncertainty of fitted parameters: estimates, model misfit, profile likelihood, bootstrap."""

from frictrack.fit.uncertainty.analysis import UncertaintyAnalysis, analyse_uncertainty, merge_uncertainty
from frictrack.fit.uncertainty.estimates import (
    Estimate,
    Estimates,
    Parameters,
    estimate_parameters,
    linear_estimates,
    with_misfit,
)
from frictrack.fit.uncertainty.misfit import Misfit, dispersion, misfit_of
from frictrack.fit.uncertainty.parametric_bootstrap import Bootstrap, bootstrap
from frictrack.fit.uncertainty.profile_likelihood import Profile, profile
from frictrack.fit.uncertainty.remarks import level_remarks
from frictrack.fit.uncertainty.reported_values import (
    reported_by_address,
    reported_names,
    reported_values_and_jacobian,
)

__all__ = [
    "Bootstrap",
    "Estimate",
    "Estimates",
    "Misfit",
    "Parameters",
    "Profile",
    "UncertaintyAnalysis",
    "analyse_uncertainty",
    "bootstrap",
    "dispersion",
    "estimate_parameters",
    "level_remarks",
    "linear_estimates",
    "merge_uncertainty",
    "misfit_of",
    "profile",
    "reported_by_address",
    "reported_names",
    "reported_values_and_jacobian",
    "with_misfit",
]
