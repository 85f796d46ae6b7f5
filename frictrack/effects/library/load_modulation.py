"""Load modulation: the normal load, and with it dry friction, oscillates (contact vibrating vertically)."""

from frictrack.effects.definition import OSCILLATION, DirectCheck, EffectInStudy, Nonlinear, Parameter, Path, Phrase
from frictrack.effects.ranges import ACCELEROMETER_STD, WAVE_IN_TIME, all_of, frequencies, modulates, oscillates, wave
from frictrack.records import Array


def columns(path: Path, nonlinear: Nonlinear, inner: Array) -> Array:
    """Dry-friction columns times 1 + depth sin(2 pi f t + phase), same shape as `inner`."""
    return inner * (1 + nonlinear["depth"] * wave(nonlinear["frequency"] * path.t, nonlinear["phase"]))


def upward_acceleration_signal(effect: EffectInStudy) -> float:
    """Return chi-squared of the vertical acceleration of the course that would change the load as fitted."""
    record = effect.longest
    return 0.5 * len(record.t) * (effect.rms("depth") * record.gravity / ACCELEROMETER_STD) ** 2


equation = "(coulomb + stribeck) depth sin(2 pi frequency t + phase)"
parameters = (
    Parameter("depth", "1", (-1.0, 1.0), role="depth"),
    Parameter("frequency", "Hz", scan=frequencies),
    Parameter("phase", "rad", per_run=True, role="phase"),
)
scan_wave = WAVE_IN_TIME
varies_with = ""
modifies = frozenset({"coulomb", "stribeck"})
scales_with = "load"
what = "The beam vibrates vertically: the mass is pressed on harder and lighter in turn."
looks_like = "a line in time whose size follows the dry friction"
mistaken_for = "vibration (same shape when the dry friction is constant)"
confirm = "Double the mass: the force doubles with the load, a vibration's stays."
plausible = all_of(oscillates, modulates)
describe = Phrase(
    OSCILLATION + "; the load changes by ± {100 * abs(depth):2} %, as on a course that moves "
    "up and down by ± {abs(depth) * g / (2 * pi * frequency) ** 2:m}"
)
invariant = "a modulated load acts through the dry friction, and so grows with the mass"
direct_check = DirectCheck(
    "course sensor", "Fix an accelerometer to the course, facing upward", upward_acceleration_signal
)
source = "Teidelt et al.; the physical form of the first paper's ATM2"
