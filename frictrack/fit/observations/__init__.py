"""What a run contributes to a fit, by the compared quantity: displacement, acceleration, or measured friction.

A kind of observation is a `LeastSquaresProblem`, which compares and linearises, and an `Observation`, which knows
noise, errors and remarks of that quantity. Everything else is blind to the kind.
"""

# ruff: noqa: F401 - the imports are the interface

from frictrack.fit.least_squares import LeastSquaresProblem
from frictrack.fit.observations.acceleration import AccelerationObservation
from frictrack.fit.observations.displacement import DisplacementObservation, Observation
from frictrack.fit.observations.load_cell import MeasuredFrictionPiece, friction_pieces, keep_compared_frames
from frictrack.fit.observations.measured_friction import FrictionObservation, weight_by_noise

KINDS: dict[str, Observation] = {
    "displacement": DisplacementObservation(),
    "acceleration": AccelerationObservation(),
    "friction": FrictionObservation(),
}


def observation_of(problem: LeastSquaresProblem) -> Observation:
    """Return what was observed of the runs of a problem."""
    return KINDS[problem.observed]
