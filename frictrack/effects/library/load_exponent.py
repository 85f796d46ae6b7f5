"""Load exponent: dry friction grows with a power of the load other than one."""

import numpy as np

from frictrack.effects.definition import Array, Nonlinear, Parameter, Path, Phrase


def columns(path: Path, nonlinear: Nonlinear, inner: Array) -> Array:
    """Dry-friction columns, which carry the load L, times q^excess, same shape as `inner`; q is the mass ratio."""
    ratio = np.broadcast_to(path.mass_ratio, path.t.shape)[:, None]
    return np.asarray(inner * ratio ** nonlinear["excess"])


equation = "(coulomb + stribeck) (m/m_0)^excess"
parameters = (Parameter("excess", "1", (-1.0, 1.0), role="depth"),)
varies_with = ""
modifies = frozenset({"coulomb", "stribeck"})
scales_with = "load"
what = "The area of contact does not grow in proportion to the load: as load^(2/3) for one smooth soft contact."
looks_like = "a friction coefficient that falls (excess < 0) or rises with the mass; nothing at all with one mass"
mistaken_for = "adhesion (where there are only two masses), levels that scatter from run to run, a wrong mass"
confirm = "Film three masses, each several times: friction against load is a straight line on logarithmic axes."
describe = Phrase(
    "dry friction grows with the load to the power of {1 + excess}: "
    "twice the load makes {2 ** (1 + excess)} times the friction"
)
invariant = "the power of the load shows only as the load changes"
settled_by = "film three masses, each several times"
source = "Archard 1957, Proc. R. Soc. A 243, 190; Bowden & Tabor 1964: F = mu_0 N^n, n from 2/3 to 1"
