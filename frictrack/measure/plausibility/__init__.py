"""Check that the numbers of a study are plausible: mass, scale, frame rate, units and incline.

`implausible_entries` checks the study file alone; `implausible_slide`, `missing_incline` and `wrong_incline` check one
measured run; `implausible_inclines`, `implausible_masses`, `implausible_clocks`, `implausible_sensors` and
`different_origins` check all runs together. Every finding states what was read, why it is
implausible, and what to enter instead.
"""

# ruff: noqa: F401 - the imports are the interface

from frictrack.measure.plausibility.comparison import (
    CONTRADICTION,
    MAX_RELATIVE_DIFFERENCE,
    describe_shift,
    different_origins,
    implausible_clocks,
    implausible_inclines,
    implausible_masses,
    implausible_sensors,
    missing_incline,
    path_angle,
    shifted_swings,
    swing_centre,
    time_unit,
    wrong_incline,
)
from frictrack.measure.plausibility.slide import (
    ACCEPTED,
    ERROR,
    EnteredValues,
    Finding,
    estimate_slide,
    implausible_entries,
    implausible_slide,
)
