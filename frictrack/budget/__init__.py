"""Where the error of a run's friction force comes from, in newtons: frame by frame, and of its mean.

Noise averages out in the mean, as its full covariance has it; scale, mass and time base do not. What is not known
stands in the table without a number: a budget that leaves it out would be no budget.
"""

from frictrack.budget.error_budget import Budget, Contribution, budget

__all__ = ["Budget", "Contribution", "budget"]
