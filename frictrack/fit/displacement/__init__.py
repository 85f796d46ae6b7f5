"""Fit a model to measured displacement from scratch."""

from frictrack.fit.displacement.start import solve_model, until_stop

__all__ = ["solve_model", "until_stop"]
