"""Clock rate: the clock of a single run is wrong by a factor, so that its times are all too long or too short."""

from math import exp, log

import numpy as np

from frictrack.effects.definition import Array, DirectCheck, EffectInStudy, Nonlinear, Parameter, Path, Phrase
from frictrack.effects.ranges import FLASH_STD_FRAMES, MAX_CLOCK_FACTOR, Span


def columns(path: Path, nonlinear: Nonlinear) -> Array:
    """V t, shape (n, 1): m by which the mass is ahead of where it would be, per unit of rate, t being the true time.

    A drive that was measured frame by frame comes at other times, too.
    """
    return np.asarray((path.v * path.t - _by_drive(path))[:, None])


def _by_drive(path: Path) -> Array:
    """Displacement (n,) by a drive that comes later by t per unit of rate: t D'(t)/m, integrated twice."""
    if path.drive is None or path.mass is None:
        return np.zeros_like(path.t)
    parts = zip(*(np.split(q, path.starts[1:]) for q in (path.t, path.drive)), strict=True)
    return np.concatenate([_integrated(t, t * d - _integrated(t, d)) for t, d in parts]) / path.mass


def _integrated(t: Array, rate: Array) -> Array:
    """Integral (n,) from the first sample by the trapezoidal rule."""
    return np.append(0.0, np.cumsum(np.diff(t) * (rate[1:] + rate[:-1]) / 2))


def factor(values: Nonlinear) -> float:
    """True time since release over recorded time."""
    return exp(values["rate"])


def plausible(values: Nonlinear, span: Span) -> str:
    """Return an objection to a clock that is wrong by more than the step between two frame rates of a camera."""
    off = exp(abs(values["rate"]))
    if off <= MAX_CLOCK_FACTOR:
        return ""
    return f"its times would be wrong by a factor of {off:.2g}, expected at most {MAX_CLOCK_FACTOR:g}"


def counter_signal(effect: EffectInStudy) -> float:
    """Return chi-squared of a counter of known rate at the first and the last frame."""
    record = effect.longest
    return float((effect.rms("rate") * np.ptp(record.t) / (FLASH_STD_FRAMES * record.frame_interval)) ** 2 / 2)


acts_on = "measurement"
equation = "y: x(t exp(rate)) - x(t)"
parameters = (Parameter("rate", "1", bounds=(-log(10.0), log(10.0)), linear=True, per_run=True),)
clock = factor
what = "The frame rate or the time stamps of a run are wrong by a factor exp(rate), true over recorded time."
looks_like = "one run whose viscous friction and Stribeck velocity are off by a factor, its level by its square"
mistaken_for = "a collision or a lost frame of that run; in all runs alike it is absorbed by the law"
confirm = "Look up the frame rate of that film, or film a clock; compare the rates that the runs were typed with."
describe = Phrase("in run {study.run}, whose true times would be its recorded ones times {exp(rate):4}")
invariant = "a wrong clock of one run changes its speeds by a factor and its forces by the square of it"
direct_check = DirectCheck(
    "rate", "Look up the frame rate of that run, or film a counter of known rate", counter_signal
)
same_cause_as = "fps"
source = "textbook: with t = c T, x' goes with 1/c and x'' with 1/c^2"
