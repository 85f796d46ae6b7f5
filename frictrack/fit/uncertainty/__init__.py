"""Parameter uncertainty: estimates with deviations, model misfit, profile likelihood, bootstrap."""

from frictrack.fit.uncertainty.bootstrap import Bootstrap, bootstrap
from frictrack.fit.uncertainty.certainty import Certainty, certainty, merge_certainty
from frictrack.fit.uncertainty.estimates import Estimate, Estimates, estimates, with_misfit
from frictrack.fit.uncertainty.linear import linear_estimates
from frictrack.fit.uncertainty.misfit import Misfit, dispersion, misfit_of
from frictrack.fit.uncertainty.profile import Profile, profile
from frictrack.fit.uncertainty.quoted import quoted_by_address

__all__ = [
    "Bootstrap",
    "Certainty",
    "Estimate",
    "Estimates",
    "Misfit",
    "Profile",
    "bootstrap",
    "certainty",
    "dispersion",
    "estimates",
    "linear_estimates",
    "merge_certainty",
    "misfit_of",
    "profile",
    "quoted_by_address",
    "with_misfit",
]
