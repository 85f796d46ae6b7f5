"""Smooth positions by a structural model: a trend of varying stiffness, lines, events, and coloured noise."""

from frictrack.motion.smoother.equations import FactoredSmoother, variances_of
from frictrack.motion.smoother.place_forces import Course, PlaceForce, find_place_forces, place_force_errors
from frictrack.motion.smoother.posterior_deviations import deviations, line_frequency_errors, weighted_cubic
from frictrack.motion.smoother.smoother_data import (
    TREND_ORDER,
    LineParameters,
    NoiseColour,
    SmootherData,
    cutoff_of,
    penalty,
    response,
)
from frictrack.motion.smoother.structure import Event, Structure
from frictrack.motion.smoother.structure_average import (
    ChangeGroup,
    StructureChange,
    added_variances,
    alternatives,
    mean_shift,
)
from frictrack.motion.smoother.structure_search import (
    MAX_WHOLE_FRAMES,
    ScoredStructure,
    StructureSearch,
    find_structure,
    undetectable_amplitude,
    window_data,
)

__all__ = [
    "MAX_WHOLE_FRAMES",
    "TREND_ORDER",
    "ChangeGroup",
    "Course",
    "Event",
    "FactoredSmoother",
    "LineParameters",
    "NoiseColour",
    "PlaceForce",
    "ScoredStructure",
    "SmootherData",
    "Structure",
    "StructureChange",
    "StructureSearch",
    "added_variances",
    "alternatives",
    "cutoff_of",
    "deviations",
    "find_place_forces",
    "find_structure",
    "line_frequency_errors",
    "mean_shift",
    "penalty",
    "place_force_errors",
    "response",
    "undetectable_amplitude",
    "variances_of",
    "weighted_cubic",
    "window_data",
]
