"""The papers' friction laws by the effects of the library, and the values that the papers print."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from frictrack.effects import models
from frictrack.effects.models import Model, Values
from frictrack.records import Array


@dataclass(frozen=True)
class PrintedLaw:
    """One printed law.

    Attributes
    ----------
    law
        "tustin", "atm1:2" or "atm2:2".
    where
        Table or section.
    values
        Parameters in the order of `addresses`: forces (N), speeds (m/s), angular frequencies ("rad/s"),
        phases (rad).
    speed
        Start speed of the group, m/s.
    error
        Printed error, without a unit.

    """

    law: str
    where: str
    values: tuple[float, ...]
    speed: float | None
    error: float | None = None


# First paper, section 3.1: F_c, F_s, F_v, v_s.
TM = {
    "low": PrintedLaw("tustin", "section 3.1 (1)", (13.5698, 57.2303, 8.376, 0.5712), 5.0),
    "high": PrintedLaw("tustin", "section 3.1 (2)", (12.9804, 37.2733, 12.306, 0.862), 8.0),
}
# Tables 1 and 2: F_c, F_s, F_v, v_s, then F_i, omega_i, phi_i of either sine.
ATM1 = {
    "low": PrintedLaw(
        "atm1:2",
        "Table 1",
        (29.9773, 43.6321, 4.7892, 0.2881, 38.2913, 0.0198, -0.4921, 151.2731, 0.0548, 1.0582),
        5.0,
        4.22e3,
    ),
    "high": PrintedLaw(
        "atm1:2",
        "Table 2",
        (32.3294, 45.1892, 6.8931, 0.4219, 42.3214, 0.2031, -0.5391, 182.3912, 0.0612, 2.0103),
        8.0,
        8.06e2,
    ),
}
# Tables 3 and 4: f_c, f_s, f_v, v_s, then omega_i, phi_i (sliding), then Omega_j, Phi_j (viscous).
ATM2 = {
    "low": PrintedLaw(
        "atm2:2",
        "Table 3",
        (35.7298, 42.7981, 22.3214, 0.6042, 2.1302, 0.7092, 0.4902, 1.1932, 1.1021, 1.4128, 1.9037, 0.0653),
        5.0,
        1.37e3,
    ),
    "high": PrintedLaw(
        "atm2:2",
        "Table 4",
        (37.5031, 47.3242, 8.9972, 0.5310, 1.5021, 0.2910, 0.5921, 2.4532, 0.3402, 0.0324, 0.9935, 0.3801),
        8.0,
        3.42e2,
    ),
}
# Second paper, Tables 1 and 2 (the second is captioned "without" but is the result with the sine filter).
WITHOUT_FILTER = PrintedLaw("tustin", "second paper, Table 1", (10.0, 17.8104, 5.0, 0.2512), None)
WITH_FILTER = PrintedLaw(
    "atm1:2",
    "second paper, Table 2",
    (4.0266, 12.7125, 14.7817, 1.9551, 1.5971, 2.8556, 0.3363, 0.2665, 0.7038, 0.8242),
    None,
)
IMPACT_ENERGY = 2.0  # J, second paper

GAIN_ATM1, GAIN_ATM2 = 0.09, 3.0  # "the identification accuracy raises by" 9 % and 300 % from n = 2 to 3

EQ8_MAXIMUM, EQ8_PLACE = 3.8503, 1.8505
TABLE_5 = {"GA": (34.14, 0.315051), "MGA": (29.86, 0.316321)}  # generations, seconds
TABLE_6 = {"10 bits": (3.6792, 0.184956), "20 bits": (3.8503, 0.294762), "adaptive": (3.8503, 0.210445)}
TABLE_7 = {"GA": (689.22, 15.2982, 0.30), "MGA": (479.86, 9.3094, 0.06)}  # iterations, seconds, local optima
RUNS = 50  # simulations behind Tables 5 and 7


PER_SECOND, PER_MILLISECOND = 1.0, 1e3  # 1/s: the papers' "rad/s" may mean per second, per millisecond or per sample
PER_FRAME = 4000.0
UNITS = {"second": PER_SECOND, "millisecond": PER_MILLISECOND, "sample": PER_FRAME}
RUN = "r"  # name of a run that is fitted alone
STATIC = {"F_c": "coulomb.F_c", "F_s": "stribeck.F_s", "F_v": "viscous.F_v", "v_s": "stribeck.v_s"}
SINE = {"F": "amplitude", "f": "frequency", "phi": f"phase[{RUN}]"}  # of ATM1, by the paper's name
SINES_ATM2 = {"sliding_frequency": "f", "sliding_phase": "phi", "viscous_frequency": "fv", "viscous_phase": "phiv"}


def addresses(law: str) -> dict[str, str]:
    """Addresses of a law's parameters in a fit of one run, by the papers' names; frequencies are in Hz.

    Examples
    --------
    >>> addresses("atm1:1")["f_1"], addresses("atm2:1")["phiv_1"]
    ('vibration.frequency', 'atm2:1.viscous_phase_1[r]')

    """
    kind, _, order = law.partition(":")
    if kind in ("tustin", "atm1"):
        sines = ((i, "vibration" if i == 1 else f"vibration:{i}") for i in range(1, int(order or 0) + 1))
        return STATIC | {f"{name}_{i}": f"{effect}.{own}" for i, effect in sines for name, own in SINE.items()}
    (effect,) = models.parse(law).effects
    found = {}
    for p in effect.parameters:
        stem, _, i = p.name.rpartition("_")
        name = f"{SINES_ATM2[stem]}_{i}" if stem in SINES_ATM2 else p.name
        found[name] = f"{effect.name}.{p.name}{f'[{RUN}]' if p.per_run else ''}"
    return found


def read_as_printed(source: PrintedLaw) -> Array:
    """Convert the printed parameters of ATM2 for `atm2_printed`: the viscous sum without t goes into f_v."""
    values = np.array(source.values)
    static, (sliding, viscous) = values[:4].copy(), np.split(values[4:], 2)
    static[2] *= np.sin(viscous[::2] + viscous[1::2]).sum()
    sliding[::2] *= PER_MILLISECOND / (2 * np.pi)
    return np.concatenate([static, sliding])


def is_frequency(name: str) -> bool:
    """Whether a parameter is a frequency, by its name in the papers: f_1, fv_1."""
    return name.startswith("f") and name[-1].isdigit()


def read_printed(printed: PrintedLaw, unit: str) -> Array:
    """Convert printed parameters."""
    factors = [UNITS[unit] / (2 * np.pi) if is_frequency(name) else 1.0 for name in addresses(printed.law)]
    return np.array(printed.values) * factors


def to_effects(law: str, p: Array) -> tuple[Model, Values]:
    """Return a law of the papers as a model of frictrack with its values."""
    values: dict[str, dict[str, float]] = {}
    for address, value in zip(addresses(law).values(), map(float, p), strict=True):
        effect, _, parameter = address.removesuffix(f"[{RUN}]").rpartition(".")
        values.setdefault(effect, {})[parameter] = value
    if "stribeck" in values:
        values["stribeck"] |= {"F_s": values["stribeck"]["F_s"] - values["coulomb"]["F_c"], "delta": 1.0}
    return models.parse(law), values


def tustin_below(F_c: float, F_v: float) -> Model:
    """Return the Tustin model with F_c and F_v below given values, N and N s/m."""
    known = models.tustin().effects
    most = {"coulomb": {"F_c": {"bounds": (0.0, F_c)}}, "viscous": {"F_v": {"bounds": (0.0, F_v)}}}
    return models.of([e.adjusted(**most.get(e.name, {})) for e in known])
