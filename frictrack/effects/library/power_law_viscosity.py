"""Power-law viscosity: the resistance of a grease or paste grows with a power of the velocity."""

import numpy as np

from frictrack.effects.definition import Array, Nonlinear, Parameter, Path, Phrase
from frictrack.effects.ranges import ScanValues

EXPONENTS = (0.3, 0.5, 0.7, 1.4, 1.7, 2.4, 2.9)  # 0 is Coulomb friction, 1 viscous friction, 2 drag


def columns(path: Path, nonlinear: Nonlinear) -> Array:
    """Return s |v|^n, shape (n, 1): N per N (s/m)^n of c."""
    return np.asarray((path.s * path.speed ** nonlinear["n"])[:, None])


equation = "c s |v|^n"
parameters = (
    Parameter("c", "N (s/m)^n", (0.0, np.inf), linear=True),
    Parameter("n", "1", (0.1, 3.0), scan=ScanValues(EXPONENTS)),
)
varies_with = "v"
special_cases = {"viscous": {"n": 1.0}, "drag": {"n": 2.0}}
what = "A grease, paste or polymer film thins (n < 1) or thickens (n > 1) as it is sheared."
looks_like = "a curve against v that bends downward (n < 1) or upward (n > 1), whatever the load"
mistaken_for = "drag (n = 2) and viscous friction (n = 1), which it contains; log velocity; an eddy brake"
confirm = "Film runs over a decade of speed, and one with the double mass: the force stays as it is."
describe = Phrase("{c} N at 1 m/s, {2 ** n} times that at 2 m/s")
invariant = "power-law viscosity depends on the speed and not on the load"
settled_by = "measure the flow curve of the grease in a rheometer"
source = "Herschel & Bulkley 1926, Kolloid-Z. 39, 291, without the yield stress, which is Coulomb friction"
