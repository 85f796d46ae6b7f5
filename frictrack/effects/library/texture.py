"""Surface texture: friction that varies periodically along the course."""

from frictrack.effects.definition import Array, Nonlinear, Parameter, Path, Phrase
from frictrack.effects.ranges import ScanWave, is_periodic_in, over_position, spatial_periods, wave


def columns(path: Path, nonlinear: Nonlinear) -> Array:
    """L s sin(2 pi x/period + phase), shape (n, 1): N per N of amplitude."""
    ripple = wave(path.x / nonlinear["period"], nonlinear["phase"])
    return (path.load * path.s)[:, None] * ripple


equation = "amplitude L s sin(2 pi x/period + phase)"
parameters = (
    Parameter("amplitude", "N", linear=True, loaded=True, role="amplitude"),
    Parameter("period", "m", scan=spatial_periods),
    Parameter("phase", "rad", role="phase"),
)
scan_wave = ScanWave("period", over_position, is_period=True)
varies_with = "x"
scales_with = "load"
what = "Machining marks, joints or waviness of the course."
looks_like = "ripples at the same places in every run; a chirp in time as the mass slows"
mistaken_for = "vibration, when the speed hardly changes"
confirm = "Film at another speed: the ripples stay at their places and change their frequency."
plausible = is_periodic_in("period")
describe = Phrase("a period of {period:m}: one mark every {period:m} of the course")
invariant = "texture keeps its places on the course"
basic = True
source = "textbook; position-dependent friction"
