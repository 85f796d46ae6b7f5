"""What a fit minimises, behind one interface: residuals of displacement, acceleration or measured friction."""

from frictrack.fit.measured_friction import is_measured_friction
from frictrack.fit.objectives.base import FittedRuns, Objective
from frictrack.fit.objectives.displacement import DisplacementObjective, SearchedObjective
from frictrack.fit.objectives.measured_friction import MeasuredFrictionObjective

__all__ = ["FittedRuns", "Objective", "objective_of"]


def objective_of(fitted: FittedRuns) -> Objective:
    """Return the objective that a model was fitted by."""
    if is_measured_friction(fitted.solution.problem):
        return MeasuredFrictionObjective()
    return DisplacementObjective() if fitted.route.is_default else SearchedObjective()
