"""Convert texts with a unit and an uncertainty to numbers in SI units."""

from __future__ import annotations

import math
import re
from fractions import Fraction
from functools import cache
from typing import Any

import numpy as np

from frictrack.base.errors import FrictrackError

_NUMBER = r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?"
# Pint evaluates any arithmetic, also 9**9**9, which never ends: only a name may have an exponent, of up to two digits.
_UNBOUNDED_ARITHMETIC = re.compile(
    r"[\d.)]\s*(?:\^|\*\*)|(?:\^|\*\*)(?!\s*[+-]?\d{1,2}(?!\w|\.))|[⁰¹²³⁴-⁹]{3}|\)\s*[⁺⁻⁰¹²³⁴-⁹]"
)
# The ordinary units, so that a study file need not wait for pint to load: factor to SI, and powers of (m, kg, s, px).
_UNITS: dict[str, tuple[Fraction, tuple[int, int, int, int]]] = {
    "m": (Fraction(1), (1, 0, 0, 0)),
    "g": (Fraction(1, 1000), (0, 1, 0, 0)),
    "s": (Fraction(1), (0, 0, 1, 0)),
    "Hz": (Fraction(1), (0, 0, -1, 0)),
    "fps": (Fraction(1), (0, 0, -1, 0)),
    "N": (Fraction(1), (1, 1, -2, 0)),
    "J": (Fraction(1), (2, 1, -2, 0)),
    "Pa": (Fraction(1), (-1, 1, -2, 0)),
    "rad": (Fraction(1), (0, 0, 0, 0)),
    "deg": (Fraction(math.pi) / 180, (0, 0, 0, 0)),
    "px": (Fraction(1), (0, 0, 0, 1)),
}
_PREFIXES = {"": 0, "n": -9, "u": -6, "µ": -6, "m": -3, "c": -2, "d": -1, "k": 3, "M": 6}
_WITHOUT_PREFIX = ("deg", "px")
_DECIMAL_COMMA = re.compile(r"(?<=\d),(?=\d)")
_POWER = r"([nuµmcdkM]??)(m|g|s|Hz|fps|N|J|Pa|rad|deg|px)(?:\^([1-3]))?"
_ORDINARY_UNIT = re.compile(rf"{_POWER}(?:/{_POWER})?")
_MIN_VALUE, _MAX_VALUE = 1e-20, 1e30  # in any unit; smaller values above zero, and larger ones, are no measurements
_MAX_UNIT_LENGTH = 60  # characters of a unit
_QUANTITY = re.compile(
    rf"^\s*\(?\s*(?P<value>{_NUMBER})\s*(?:(?:\+/-|±)\s*(?P<std>{_NUMBER})\s*(?P<percent>%)?)?\s*\)?\s*(?P<unit>.*?)\s*$"
)


# such as "0.35" or "0.35 +/- 1 %"
NUMBER_WITHOUT_UNIT = re.compile(r"\s*[+-]?[\d.]+(?:[eE][+-]?\d+)?\s*(?:(?:\+/-|±)\s*[\d.eE+-]+\s*%?)?\s*")


def lacks_unit(value: Any) -> bool:
    """Return whether a quantity is a number without a unit, as a number or as text.

    Examples
    --------
    >>> lacks_unit(0.35), lacks_unit("0.35 +/- 1 %"), lacks_unit("350 g")
    (True, True, False)

    """
    if isinstance(value, str):
        return NUMBER_WITHOUT_UNIT.fullmatch(value) is not None
    return isinstance(value, int | float) and not isinstance(value, bool)


def parse_quantity(
    text: str | float,
    unit: str,
    what: str,
    *,
    above: float = -math.inf,
    below: float = math.inf,
    least: float = -math.inf,
) -> tuple[float, float]:
    """Read a number, or a text with a unit and an uncertainty.

    Parameters
    ----------
    text
        A number or a text without a unit is already in `unit`. A text may have a unit and an uncertainty: ``"0.35
        kg"``, ``"350 +/- 2 g"``, ``"(350 ± 2) g"``, ``"0.35 +/- 1% kg"``.
    unit
        The wanted unit, as pint writes it: ``"kg"``, ``"m/px"``, ``"rad"``.
    what
        Name of the quantity, for messages.
    above, below, least
        Limits of the value; it may be the least.

    Returns
    -------
    tuple of (float, float)
        Value and standard deviation, in `unit`.

    Raises
    ------
    FrictrackError
        If it is no quantity, its unit is unknown or of another quantity, its uncertainty is negative, or it is beyond
        the limits.

    Examples
    --------
    >>> parse_quantity("0.5 +/- 0.25", "kg", "mass")
    (0.5, 0.25)
    >>> parse_quantity("25 cm", "m", "length")
    (0.25, 0.0)

    """
    if isinstance(text, str):
        value, std = _parse(text, unit, what)
    elif isinstance(text, (int, float, np.number)) and not isinstance(text, bool):  # type: ignore[redundant-expr]
        value, std = _float(text), 0.0
    else:
        raise FrictrackError(_expected(unit, what) + f" but got {text!r}")
    if not (value == 0 or _MIN_VALUE <= abs(value) < _MAX_VALUE):
        raise FrictrackError(_expected(unit, what) + f" but got {value:g}")
    if not (above < value < below and value >= least):
        span = f"above {above:g}" if below == math.inf else f"between {above:.3g} and {below:.3g}"
        span = span if least == -math.inf else f"of at least {least:g}"
        is_degrees = unit == "rad" and not isinstance(text, str) and abs(text) < 90
        hint = f'; a number is in rad: write "{text:g} deg" for degrees' if is_degrees else ""
        raise FrictrackError(f"expected {what} {span}{'' if unit == '1' else f' {unit}'} but got {text!r}{hint}")
    return value, std


def _float(number: float) -> float:
    """Convert to a float; an integer beyond all floats becomes infinite."""
    try:
        return float(number)
    except OverflowError:
        return np.inf


def _parse(text: str, unit: str, what: str) -> tuple[float, float]:
    if _DECIMAL_COMMA.search(text):
        point = _DECIMAL_COMMA.sub(".", text)
        raise FrictrackError(f'{_expected(unit, what)} but got "{text}"; write a decimal point: "{point}"')
    match = _QUANTITY.match(text)
    if match is None:
        raise FrictrackError(_expected(unit, what) + f' but got "{text}"')
    value, std = float(match["value"]), float(match["std"] or 0.0)
    if match["percent"]:
        std *= abs(value) / 100
    if not 0 <= std < np.inf:
        raise FrictrackError(f'expected an uncertainty of {what} above 0 but got "{text}"')
    if not match["unit"]:
        return value, std
    low, high = _convert(np.array([value, value + std]), match["unit"], unit, what)
    return float(low), float(high - low)


def is_ordinary_unit(text: str) -> bool:
    """Return whether a text is one of the ordinary units, which need no pint to convert.

    Examples
    --------
    >>> is_ordinary_unit("mm"), is_ordinary_unit("time")
    (True, False)

    """
    return _ordinary_unit(text) is not None


def _convert(values: np.ndarray, source: str, target: str, what: str) -> Any:
    """Convert values from one unit to another; pint, which takes long to load, converts all but ordinary units."""
    given, wanted = _ordinary_unit(source), _ordinary_unit(target)
    if given and wanted:
        if given[1] != wanted[1]:
            raise FrictrackError(_another_quantity(source, target, what))
        factor = given[0] / wanted[0]
        return values * float(factor) if factor.denominator == 1 else values / float(1 / factor)
    return _convert_with_pint(values, source, target, what)


@cache
def _ordinary_unit(unit: str) -> tuple[Fraction, tuple[int, ...]] | None:
    """Return the factor of a unit such as "mm/px" to SI, and its powers of (m, kg, s, px); None for all others."""
    found = _ORDINARY_UNIT.fullmatch(unit)
    if found is None:
        return None
    above = _power(found[1], found[2], int(found[3] or 1))
    below = _power(found[4], found[5], int(found[6] or 1)) if found[5] else (Fraction(1), (0, 0, 0, 0))
    if above is None or below is None:
        return None
    return above[0] / below[0], tuple(a - b for a, b in zip(above[1], below[1], strict=True))


def _power(prefix: str, name: str, exponent: int) -> tuple[Fraction, tuple[int, ...]] | None:
    """Return a power of one unit; None for a prefix that it does not have."""
    if prefix and name in _WITHOUT_PREFIX:
        return None
    factor, dimension = _UNITS[name]
    return (factor * Fraction(10) ** _PREFIXES[prefix]) ** exponent, tuple(exponent * power for power in dimension)


def _convert_with_pint(values: np.ndarray, source: str, target: str, what: str) -> Any:
    """Convert values from one unit to another by pint."""
    import pint  # noqa: PLC0415 - takes half a second, which only texts with units need

    if len(source) > _MAX_UNIT_LENGTH or _UNBOUNDED_ARITHMETIC.search(source):
        raise FrictrackError(f'{_expected(target, what)} but got "{source[:_MAX_UNIT_LENGTH]}" as its unit')
    try:
        return _registry().Quantity(values, _pint_name(source)).to(_pint_name(target)).magnitude
    except pint.UndefinedUnitError as error:
        raise FrictrackError(
            f'{_expected(target, what)} but got the unknown unit "{source}"; write it like "{_example(target)}"'
        ) from error
    except pint.DimensionalityError as error:
        raise FrictrackError(_another_quantity(source, target, what)) from error
    except Exception as error:  # pint's parser raises whatever Python's tokenizer does
        raise FrictrackError(f'{_expected(target, what)} but got "{source}" as its unit') from error


@cache
def _registry() -> Any:
    import pint  # noqa: PLC0415

    return pint.UnitRegistry(cache_folder=None)


def _pint_name(unit: str) -> str:
    """Return a unit as pint spells it: pint's ``px`` is 1/96 inch of style sheets, a camera's pixel is ``pixel``."""
    return re.sub(r"\bpx\b", "pixel", unit)


def _another_quantity(source: str, target: str, what: str) -> str:
    return (
        f'{_expected(target, what)} but got "{source}", which measures something else; '
        f'write it like "{_example(target)}"'
    )


def _expected(unit: str, what: str) -> str:
    return f"expected {what} as a number" if unit == "1" else f"expected {what} as a quantity in {unit}"


def _example(unit: str) -> str:
    return {"m/px": "0.5 mm/px", "m": "100 mm", "kg": "0.350 +/- 0.002 kg"}.get(unit, f"1.5 {unit}")


COHERENT_UNITS = ("1", "N", "m", "s", "Hz", "rad", "m/s", "N/m", "N s", "N s/m", "1/m", "kg")  # known without pint


_UNIT_POWER = r"(?:1|[A-Za-zµ]{1,20}(?:\^-?\d(?:\.(?:5|333|667))?)?)"  # whole, half and third powers
UNIT_PATTERN = re.compile(rf"{_UNIT_POWER}(?:[ */]{_UNIT_POWER}){{0,6}}")


def is_coherent(unit: str) -> bool:
    """Return whether a unit is an SI unit without prefix, so that numbers in it need no factor.

    Examples
    --------
    >>> is_coherent("N s/m"), is_coherent("N s^0.5/m^0.5"), is_coherent("mm")
    (True, True, False)

    """
    if unit in COHERENT_UNITS:
        return True
    if not UNIT_PATTERN.fullmatch(unit):  # pint would work out any arithmetic
        return False
    try:
        factor, _ = _registry().get_base_units(_pint_name(unit))
    except Exception:  # noqa: BLE001 - pint's parser raises whatever Python's tokenizer does
        return False
    return bool(abs(float(factor) - 1.0) < 1e-12)
