"""Logarithmic velocity dependence: dry friction rises or falls with the logarithm of the speed."""

import numpy as np

from frictrack.effects.definition import Array, Nonlinear, Parameter, Path, Phrase

REFERENCE_VELOCITY = 1e-6  # m/s, as usual in rate-and-state friction (Dieterich 1979)


def columns(path: Path, nonlinear: Nonlinear) -> Array:
    """L s ln(1 + |v|/v_0), shape (n, 1): N per N of a."""
    return np.asarray((path.load * path.s * np.log1p(path.speed / nonlinear["v_0"]))[:, None])


equation = "a L s ln(1 + |v|/v_0)"
parameters = (
    Parameter("a", "N", linear=True, loaded=True),
    # far above v_0, another v_0 only moves friction between a and F_c: it is not fitted
    Parameter("v_0", "m/s", (1e-12, 10.0), fixed=REFERENCE_VELOCITY),
)
varies_with = "v"
scales_with = "load"
what = "Contacts creep under load: friction rises (a > 0) or, where they age faster, falls with the speed (a < 0)."
looks_like = "the same change of dry friction from 0.1 to 1 m/s as from 1 to 10 m/s, in proportion to the load"
mistaken_for = "viscous friction or drag over less than a decade of speed, flash weakening (where friction falls)"
confirm = "Film runs over two decades of speed, one of them with the double mass: the change doubles with the load."
describe = Phrase("{abs(a) * log(10)} N {'more' if a > 0 else 'less'} at ten times the speed, at the reference load")
invariant = "the change depends on the ratio of two speeds and grows with the load"
source = "Dieterich 1979, J. Geophys. Res. 84, 2161; Ruina 1983 (steady state), regularised at v = 0"
