"""Viscous modulation: the film of lubricant is squeezed and drawn in turn, and viscous friction with it."""

from frictrack.effects.definition import OSCILLATION, Phrase
from frictrack.effects.library import load_modulation
from frictrack.effects.ranges import all_of, modulates, oscillates

equation = "F_v v depth sin(2 pi frequency t + phase)"
parameters = load_modulation.parameters
columns = load_modulation.columns
scan_wave = load_modulation.scan_wave
varies_with = ""
modifies = frozenset({"viscous"})
what = "The gap between the surfaces breathes, and the film in it resists more and less in turn."
looks_like = "a line in time whose size falls with the speed, to nothing at the stop"
mistaken_for = "vibration and load modulation (same shape while the speed hardly changes), decaying vibration"
confirm = "Film a run twice as fast: the line doubles, a vibration's and a load modulation's stay."
plausible = all_of(oscillates, modulates)
describe = Phrase(OSCILLATION + "; the viscous coefficient changes by ± {100 * abs(depth):2} %")
invariant = "modulated viscous friction grows with the speed"
source = "the physical form of the first paper's ATM2 (Eq. 4, third sum)"
