"""Load exponent: dry friction grows with a power of the load other than one."""

import numpy as np

from frictrack.base.number_format import format_number
from frictrack.effects.definition import EffectInStudy, Parameter
from frictrack.effects.path import Array, Nonlinear, Path


def columns(path: Path, nonlinear: Nonlinear, inner: Array) -> Array:
    """Dry-friction columns, which carry the load L, times q^excess, same shape as `inner`; q is the mass ratio."""
    ratio = np.broadcast_to(path.mass_ratio, path.t.shape)[:, None]
    return np.asarray(inner * ratio ** nonlinear["excess"])


def describe(effect: EffectInStudy) -> str:
    """The exponent, and what a doubled load does."""
    exponent = 1 + effect.value("excess")
    power, factor = format_number(exponent), format_number(2**exponent)
    return f"dry friction grows with the load to the power of {power}: twice the load makes {factor} times the friction"


equation = "(coulomb + stribeck) (m/m_0)^excess"
parameters = (Parameter("excess", "1", (-1.0, 1.0), role="depth"),)
varies_with = ""
modifies = frozenset({"coulomb", "stribeck"})
scales_with = "load"
what = "The area of contact does not grow in proportion to the load: as load^(2/3) for one smooth soft contact."
looks_like = "a friction coefficient that falls (excess < 0) or rises with the mass; nothing at all with one mass"
mistaken_for = "adhesion (where there are only two masses), levels that scatter from run to run, a wrong mass"
confirm = "Film three masses, each several times: friction against load is a straight line on logarithmic axes."
invariant = "the power of the load shows only as the load changes"
settled_by = "film three masses, each several times"
source = "Archard 1957, Proc. R. Soc. A 243, 190; Bowden & Tabor 1964: F = mu_0 N^n, n from 2/3 to 1"
