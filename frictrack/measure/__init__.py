"""From a track or a table to the motion and the friction force of a run.

calibration   pixels -> metres: scale, plane, lens, reference point
table_clock   measured columns -> the same on an even clock
tables        columns on an even clock -> displacement and run
motion        displacement -> smoothed x, v, a with their deviations
sensors       other instruments on the clock of the film
repairing     spans of a track that are tracked again or left out
friction      mass and drive -> friction force, free flights, impacts
error_budget  the sources of the error of F
plausibility  numbers that cannot be right
"""

# ruff: noqa: F401 - the imports are for type checkers; at run time the modules are imported on first use

from typing import TYPE_CHECKING

from frictrack.base import lazy_names

if TYPE_CHECKING:
    from frictrack.measure import (
        calibration,
        error_budget,
        friction,
        motion,
        plausibility,
        repairing,
        sensors,
        table_clock,
        tables,
    )

__getattr__, __all__ = lazy_names(__name__)
