"""Viscous modulation: the film of lubricant is squeezed and drawn in turn, and viscous friction with it."""

from frictrack.base.number_format import format_number
from frictrack.effects.definition import EffectInStudy, Parameter, oscillation
from frictrack.effects.path import Array, Nonlinear, Path, ScanWave, over_time, wave
from frictrack.effects.ranges import all_of, frequencies, modulates, oscillates


def columns(path: Path, nonlinear: Nonlinear, inner: Array) -> Array:
    """Viscous columns times 1 + depth sin(2 pi f t + phase), same shape as `inner`."""
    return inner * (1 + nonlinear["depth"] * wave(nonlinear["frequency"] * path.t, nonlinear["phase"]))


def describe(effect: EffectInStudy) -> str:
    """Frequency and depth."""
    percent = format_number(100 * abs(effect.value("depth")), 2)
    return f"{oscillation(effect)}; the viscous coefficient changes by ± {percent} %"


equation = "F_v v depth sin(2 pi frequency t + phase)"
parameters = (
    Parameter("depth", "1", (-1.0, 1.0), role="depth"),
    Parameter("frequency", "Hz", scan=frequencies),
    Parameter("phase", "rad", per_run=True, role="phase"),
)
scan_wave = ScanWave("frequency", over_time)
varies_with = ""
modifies = frozenset({"viscous"})
what = "The gap between the surfaces breathes, and the film in it resists more and less in turn."
looks_like = "a line in time whose size falls with the speed, to nothing at the stop"
mistaken_for = "vibration and load modulation (same shape while the speed hardly changes), decaying vibration"
confirm = "Film a run twice as fast: the line doubles, a vibration's and a load modulation's stay."
plausible = all_of(oscillates, modulates)
invariant = "modulated viscous friction grows with the speed"
source = "the physical form of the first paper's ATM2 (Eq. 4, third sum)"
