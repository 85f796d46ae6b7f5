"""Time base: the frame rate drifts during a run, so that the recorded clock is not the true one."""

import numpy as np

from frictrack.base.number_format import format_number
from frictrack.effects.definition import Array, DirectCheck, EffectInStudy, Nonlinear, Parameter, Path
from frictrack.effects.ranges import FLASH_STD_FRAMES, MAX_CLOCK_DRIFT, Span


def columns(path: Path, nonlinear: Nonlinear) -> Array:
    """V t^2/2, shape (n, 1): m per 1/s of k; the true time is t + k t^2/2."""
    return np.asarray((path.v * path.t**2 / 2)[:, None])


def plausible(values: Nonlinear, span: Span) -> str:
    """Return an objection to a clock that drifts more than any camera's does."""
    drift = abs(values["k"]) * span.duration / 2
    if drift <= MAX_CLOCK_DRIFT:
        return ""
    return f"the clock would be off by {100 * drift:.2g} % at the end, expected at most {100 * MAX_CLOCK_DRIFT:g} %"


def describe(effect: EffectInStudy) -> str:
    """Change of the frame rate."""
    _, end = effect.last_run
    return f"the frame rate would change by {format_number(100 * effect.value('k') * end, 2)} % in the longest run"


def flash_signal(effect: EffectInStudy) -> float:
    """Return chi-squared of flashes of known rate in the picture, which drift against the frames."""
    record = effect.longest
    rows = record.marks
    late = record.contribution[rows] / np.maximum(np.abs(record.v[rows]), 1e-3)
    late = late - np.polyval(np.polyfit(record.t[rows], late, 1), record.t[rows])
    return float(np.sum((late / (FLASH_STD_FRAMES * record.frame_interval)) ** 2))


acts_on = "measurement"
equation = "y: k v t^2/2"
parameters = (Parameter("k", "1/s", linear=True, role="amplitude"),)
what = "The camera's clock runs faster or slower as it goes: at the end of a run every frame comes late or early."
looks_like = "a false deceleration that grows with the speed and hardly depends on the mass"
mistaken_for = "viscous friction and drag, unless runs of two masses are there"
confirm = "Film a counter, a flashing diode or a second clock in the same picture."
invariant = "a drifting clock looks like a deceleration that grows with the speed"
settled_by = "film a flashing diode in the same picture"
direct_check = DirectCheck(
    "clock", "Film a flashing diode or a counter of known rate in the same picture", flash_signal
)
film_fault = True
source = "textbook: a clock with a linear rate; y(t) = x(t + k t^2/2)"
