"""Add one effect to a fitted model or remove one: trial values from a scan, then refinement in simulation."""

from frictrack.fit.stepwise.growth import first_guess, grow, rebuilt, reordered, settled, simulated, without
from frictrack.fit.stepwise.order import follows, in_turn, known, led_the_other_way
from frictrack.fit.stepwise.trial import (
    PULSE_PRICE,
    STRONG,
    TIE_ALPHA,
    Trial,
    bare,
    deepened,
    is_loose,
    shortfall,
    tried,
    tried_together,
)

__all__ = [
    "PULSE_PRICE",
    "STRONG",
    "TIE_ALPHA",
    "Trial",
    "bare",
    "deepened",
    "first_guess",
    "follows",
    "grow",
    "in_turn",
    "is_loose",
    "known",
    "led_the_other_way",
    "rebuilt",
    "reordered",
    "settled",
    "shortfall",
    "simulated",
    "tried",
    "tried_together",
    "without",
]
