"""Adhesion: dry friction does not vanish with the load, because the surfaces attract each other."""

import numpy as np

from frictrack.effects.definition import Array, Nonlinear, Parameter, Path, Phrase


def columns(path: Path, nonlinear: Nonlinear) -> Array:
    """Return s, shape (n, 1): N per N of F = mu N_a."""
    return path.s[:, None].astype(float)


equation = "F s"
parameters = (Parameter("F", "N", (0.0, np.inf), linear=True),)
varies_with = ""
what = "Surfaces attract each other, or a seal or magnet presses them together: mu (N + N_a), F = mu N_a."
looks_like = "a friction coefficient that falls as the mass rises; nothing at all with one mass"
mistaken_for = "levels that scatter from run to run, a wrong mass, friction as a power of the load"
confirm = "Film three masses, each several times: the friction force is a straight line against the load."
describe = Phrase("{F} N of dry friction that would remain without any load")
invariant = "the force of adhesion stays when the load changes"
settled_by = "film three masses, each several times"
source = "Derjaguin 1934, Z. Phys. 88, 661: mu (N + N_a)"
