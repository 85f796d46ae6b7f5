"""Drive offset: the sensor of the drive does not show zero where no force is, or a constant force pulls beside it."""

import numpy as np

from frictrack.effects.definition import Array, DirectCheck, EffectInStudy, Nonlinear, Parameter, Path, Phrase
from frictrack.effects.ranges import ZERO_STD_N


def columns(path: Path, nonlinear: Nonlinear) -> Array:
    """-1, shape (n, 1): N per N of D_0; D_0 > 0 means that the true drive is larger."""
    return np.full((len(path.t), 1), -1.0)


def zero_signal(effect: EffectInStudy) -> float:
    """Return chi-squared of the offset in a record without drive."""
    return (effect.rms("D_0") / ZERO_STD_N) ** 2


equation = "-D_0"
parameters = (Parameter("D_0", "N", linear=True),)
varies_with = ""
what = "The zero of the force sensor has moved, or a cable, a hose or a spring pulls with one force all the time."
looks_like = "a constant residual force, of one size in newtons, whatever the mass, the speed and the direction"
mistaken_for = "slope (runs of one mass), Coulomb friction (runs of one direction), friction as a power of the load"
confirm = (
    "Record the sensor without drive before and after a run; runs of two masses and both directions part the rest."
)
describe = Phrase("the true drive would be {D_0} N larger all the time")
invariant = "an offset of the drive has the same size in newtons on every mass"
settled_by = "record the drive while nothing pushes"
direct_check = DirectCheck("zero of the drive", "Record the drive while nothing pushes", zero_signal)
source = "Janot, Gautier & Brunot 2019 (EMPS: gain and offset of the drive)"
needs = ("drive",)
