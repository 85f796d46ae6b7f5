"""Compute the error budget of a run's friction force: of each frame, and of its mean.

Noise averages out in the mean according to its covariance; errors of scale, mass and time base do not. A source whose
size is not known stays in the table without a number.
"""

from frictrack.measure.error_budget.sources import budget
from frictrack.measure.error_budget.summary import Budget, Contribution

__all__ = ["Budget", "Contribution", "budget"]
