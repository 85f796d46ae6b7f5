"""Check that the numbers of a study are plausible: mass, scale, frame rate, units and incline.

`implausible_entries` checks the study file alone; `implausible_slide`, `missing_incline` and `wrong_incline` check one
measured run; `implausible_inclines`, `implausible_masses`, `implausible_clocks`, `implausible_sensors` and
`different_origins` check all runs together. Every finding states what was read, why it is implausible, and what to
enter instead. The plausible ranges and their sources are in `ranges`.
"""

from frictrack.plausibility.clocks import CONTRADICTION, MAX_RELATIVE_DIFFERENCE, implausible_clocks, time_unit
from frictrack.plausibility.entered_values import EnteredValues, implausible_entries
from frictrack.plausibility.finding import ERROR, WARNING, Finding
from frictrack.plausibility.incline import missing_incline, path_angle, wrong_incline
from frictrack.plausibility.incline_consistency import implausible_inclines
from frictrack.plausibility.masses import implausible_masses
from frictrack.plausibility.origins import describe_shift, different_origins, shifted_swings
from frictrack.plausibility.sensors import implausible_sensors
from frictrack.plausibility.slide import SlideEstimate, estimate_slide, implausible_slide

__all__ = [
    "CONTRADICTION",
    "ERROR",
    "MAX_RELATIVE_DIFFERENCE",
    "WARNING",
    "EnteredValues",
    "Finding",
    "SlideEstimate",
    "describe_shift",
    "different_origins",
    "estimate_slide",
    "implausible_clocks",
    "implausible_entries",
    "implausible_inclines",
    "implausible_masses",
    "implausible_sensors",
    "implausible_slide",
    "missing_incline",
    "path_angle",
    "shifted_swings",
    "time_unit",
    "wrong_incline",
]
