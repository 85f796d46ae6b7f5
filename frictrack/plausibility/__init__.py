"""Check that what was typed is plausible: mass, scale, frame rate, units, incline; before minutes are spent on it.

`implausible` looks at the study file alone, `implausible_slide`, `missing_incline` and `wrong_incline` at one measured
run, `implausible_inclines`, `implausible_masses` and `implausible_clocks` at all runs together. Every finding says what
was read, why it is implausible, and what to type instead. The ranges stand in `ranges`, each with its source.
"""

from frictrack.plausibility.clocks import implausible_clocks
from frictrack.plausibility.entered_values import Typed, implausible
from frictrack.plausibility.finding import ERROR, WARNING, Finding
from frictrack.plausibility.incline import missing_incline, path_angle, wrong_incline
from frictrack.plausibility.incline_consistency import implausible_inclines
from frictrack.plausibility.masses import implausible_masses
from frictrack.plausibility.slide import Slide, implausible_slide, slide_of

__all__ = [
    "ERROR",
    "WARNING",
    "Finding",
    "Slide",
    "Typed",
    "implausible",
    "implausible_clocks",
    "implausible_inclines",
    "implausible_masses",
    "implausible_slide",
    "missing_incline",
    "path_angle",
    "slide_of",
    "wrong_incline",
]
