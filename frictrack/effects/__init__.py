"""Physical effects: forces on the sliding mass and errors of its measurement, one file per effect in `library`.

`Effect` says what an effect is. `get` and `known` find effects by name, `effect` declares one in Python, `formula`
makes one from a text, `EffectSettings` holds what a study file changes of one.
"""
# ruff: noqa: F401 - the imports are the interface

from frictrack.effects.atm2 import PRINTED_TIME_UNIT_S, atm2, atm2_printed
from frictrack.effects.definition import (
    ACCELEROMETER_CHECK,
    OF_RUNS,
    DirectCheck,
    Effect,
    EffectRecord,
    Nonlinear,
    Parameter,
    Path,
    TestDraw,
    carries_over,
    joined_paths,
    scales_with_load,
)
from frictrack.effects.memory import direction_of_motion
from frictrack.effects.ranges import PLANNED_SHARE, Span, Within, frequencies
from frictrack.effects.registry import DECLARED, LIBRARY, catalogue, get, known, laws_in_place_of, order
from frictrack.effects.settings import EffectSettings, Tie, check_ties, definitions, differences, read_settings
from frictrack.effects.user import CONSTANTS, FUNCTIONS, OPERATORS, VARIABLES, effect, formula
