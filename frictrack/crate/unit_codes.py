"""Codes of units for other programs: UCUM, and the address of the unit in the QUDT vocabulary.

References
----------
Schadow & McDonald, The Unified Code for Units of Measure, version 2.2, https://ucum.org/ucum.
QUDT Units Vocabulary, http://qudt.org/vocab/unit/.

"""

from __future__ import annotations

from dataclasses import dataclass

QUDT = "http://qudt.org/vocab/unit/"


@dataclass(frozen=True)
class UnitCode:
    """The codes of a unit.

    Attributes
    ----------
    ucum
        Code in UCUM; "" where a unit has none, because its powers are themselves fitted.
    qudt
        Name in the QUDT vocabulary; "" where QUDT has no such unit.

    """

    ucum: str
    qudt: str = ""

    @property
    def address(self) -> str:
        """Address of the unit in QUDT; its UCUM code after ``ucum:`` where QUDT does not have it."""
        if self.qudt:
            return QUDT + self.qudt
        return f"ucum:{self.ucum}" if self.ucum else ""


UNIT_CODES = {
    "1": UnitCode("1", "UNITLESS"),
    "%": UnitCode("%", "PERCENT"),
    "1/m": UnitCode("m-1", "PER-M"),
    "1/m^2": UnitCode("m-2", "PER-M2"),
    "1/s": UnitCode("s-1", "PER-SEC"),
    "Hz": UnitCode("Hz", "HZ"),
    "N": UnitCode("N", "N"),
    "N (s/m)^n": UnitCode(""),  # n is a parameter
    "N s": UnitCode("N.s", "N-SEC"),
    "N s/m": UnitCode("N.s/m", "N-SEC-PER-M"),
    "N s^2/m^2": UnitCode("N.s2/m2", "KiloGM-PER-M"),  # the same unit: N s²/m² = kg/m
    "N/m": UnitCode("N/m", "N-PER-M"),
    "N/s": UnitCode("N/s"),
    "g": UnitCode("g", "GM"),
    "kg": UnitCode("kg", "KiloGM"),
    "m": UnitCode("m", "M"),
    "m/s": UnitCode("m/s", "M-PER-SEC"),
    "m/s^2": UnitCode("m/s2", "M-PER-SEC2"),
    "ms": UnitCode("ms", "MilliSEC"),
    "px": UnitCode("{pixel}"),  # an annotation: UCUM counts pixels as 1
    "rad": UnitCode("rad", "RAD"),
    "s": UnitCode("s", "SEC"),
    "s/m": UnitCode("s/m"),
    "um": UnitCode("um", "MicroM"),
}  # by the unit as frictrack writes it


def unit_code(unit: str) -> UnitCode:
    """Return the codes of a unit; empty codes for one that a user's own effect brings in.

    Parameters
    ----------
    unit
        The unit, such as ``"N s/m"``.

    Examples
    --------
    >>> unit_code("N s/m").ucum, unit_code("N s/m").address
    ('N.s/m', 'http://qudt.org/vocab/unit/N-SEC-PER-M')

    """
    return UNIT_CODES.get(unit, UnitCode(""))
