"""Values that the two papers print, with units and misprints as printed; `laws.read_printed` converts them."""

from __future__ import annotations

from dataclasses import dataclass

PAPERS = {
    "first": "Research on parameter identification of nonlinear friction on cantilever beam",
    "second": "Research on friction parameter identification under the influence of vibration and collision",
}


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
        Parameters in the order of `laws.PaperLaw.names`: forces (N), speeds (m/s), angular frequencies ("rad/s"),
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
