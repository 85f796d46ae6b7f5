"""Fit a model to measured displacement from scratch."""

from frictrack.fit.displacement.start import fit_displacement, refit_until_stop

__all__ = [
    "fit_displacement",
    "refit_until_stop",
]
