"""Format numbers, uncertainties, units and lists of words as text for reports, figures and the terminal.

Each function takes a number in the unit that is given and returns text; nothing here parses text (see `units`).

The rounding rule: a standard deviation keeps one significant digit, or two where the first one is 1 (below 1.95);
the value ends at the same decimal place. Results in Python print two digits and SI units (`format_plus_minus`), so that
their numbers can be used in further calculations.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

MINUS, TIMES, PLUS_MINUS = "\N{MINUS SIGN}", "\N{MULTIPLICATION SIGN}", "\N{PLUS-MINUS SIGN}"
DASH, THIN_SPACE = "\N{EN DASH}", "\N{NARROW NO-BREAK SPACE}"
NOT_DETERMINED = "not determined"
PREFIXED_UNITS = ("m", "s", "N", "N s")  # units whose thousandths and millionths are common in friction measurements
MIN_P_VALUE = 0.001  # 1/(B + 1) for the fewest simulated studies, B = 999: no smaller p is estimated
MAX_LEADING_ONE = 1.95  # a standard deviation of 1.0 to 1.95 keeps a second digit
MAX_DIGITS = 9  # of the ends of an interval that differ by little

_SUPERSCRIPT = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def format_number(value: float | None, digits: int = 3, missing: str = DASH) -> str:
    """Format a number with a fixed count of significant digits.

    Examples
    --------
    >>> format_number(0.012345), format_number(None), format_number(5.0, 1)
    ('0.0123', '–', '5')

    """
    if value is None or not math.isfinite(value):
        return missing
    if value == 0:
        return "0"
    exponent = int(f"{value:.{digits - 1}e}".partition("e")[2])  # of the rounded value: 0.9999 is 1.00
    if not -4 < exponent < 6:
        return f"{value / 10**exponent:.{digits - 1}f}".replace("-", MINUS) + _power_of_ten(exponent)
    comma = "," if exponent > 3 else ""
    return f"{value:{comma}.{max(digits - 1 - exponent, 0)}f}".replace("-", MINUS).replace(",", THIN_SPACE)


def format_plain(value: float | None, digits: int = 4) -> str:
    """Format a number for the terminal, in characters that other programs can read; "-" for None.

    Examples
    --------
    >>> format_plain(0.0000123456), format_plain(-3.0), format_plain(None), format_plain(448.0, 2)
    ('1.235e-05', '-3', '-', '450')

    """
    return "-" if value is None else f"{float(f'{value:.{digits}g}'):.{max(digits, 6)}g}"


def format_share(share: float) -> str:
    """Format a share as a whole percentage; a share that would round to nothing is below 1 %.

    Examples
    --------
    >>> format_share(0.937), format_share(0.0004), format_share(0.0)
    ('94 %', '< 1 %', '0 %')

    """
    return "< 1 %" if 0 < share < 0.005 else f"{100 * share:.0f} %"


def format_p_value(p: float | None) -> str:
    """Format a p-value; it is stated as a bound where none of the simulated studies reached the statistic.

    Examples
    --------
    >>> format_p_value(0.001), format_p_value(0.0005), format_p_value(0.2917)
    ('at most 1/1000', 'at most 1/2000', '0.29')

    """
    return format_number(p, 2) if p is None or p > MIN_P_VALUE else f"at most 1/{round(1 / max(p, 1e-9))}"


def format_change(value: float) -> str:
    """Format a whole number with its sign, thousands apart.

    Examples
    --------
    >>> format_change(-12.4) == "\N{MINUS SIGN}12"
    True

    """
    return f"{value:+,.0f}".replace("-", MINUS).replace(",", THIN_SPACE)


def format_quantity(value: float | None, std: float | None, unit: str) -> str:
    """Format a value with its standard deviation and unit.

    Examples
    --------
    >>> format_quantity(8.0123, 0.021, "N")
    '8.01 ± 0.02 N'
    >>> format_quantity(0.00123, 0.000012, "m")
    '1.230 ± 0.012 mm'
    >>> format_quantity(38799.0, 1385.0, "N/m")
    '(38800 ± 1400) N/m'

    """
    if value is None:
        return NOT_DETERMINED
    factor, unit = prefixed(value, unit)
    value, std = value * factor, None if std is None else std * factor
    tail = format_unit(unit)
    tail = f" {tail}" if tail else ""
    if not std or not math.isfinite(std):
        return f"{_without_std(value)}{tail}"
    exponent = math.floor(math.log10(max(abs(value), std)))
    exponent = 0 if -4 < exponent < 6 else exponent
    value, std = value / 10.0**exponent, std / 10.0**exponent
    text = _both(value, std, _decimal_places(std)).replace("-", MINUS)
    if exponent:
        return f"({text}){_power_of_ten(exponent)}{tail}"
    return f"({text}){tail}" if "/" in tail or " " in tail.strip() else f"{text}{tail}"


def format_plus_minus(value: float | None, std: float | None) -> str:
    """Format a value and its standard deviation for the terminal, both to the second digit of the latter.

    Examples
    --------
    >>> format_plus_minus(8.01234, 0.0214), format_plus_minus(1.0, 0.0), format_plus_minus(None, None)
    ('8.012 ± 0.021', '1', 'not determined')

    """
    if value is None:
        return NOT_DETERMINED
    if not std:
        return format_plain(value, 6)
    decimals = 1 - math.floor(math.log10(std))
    if not -3 < decimals < 7:
        return f"{value:.5g} ± {std:.2g}"
    return _both(value, std, decimals)


def format_size(value: float, unit: str) -> str:
    """Format a rough size with its unit: two significant digits.

    Examples
    --------
    >>> format_size(0.0123, "N"), format_size(2.0, "m/s^2")
    ('12 mN', '2.0 m/s²')

    """
    factor, unit = prefixed(value, unit)
    return f"{format_number(factor * value, 2)} {format_unit(unit)}".strip()


def format_length(metres: float) -> str:
    """Format a length with three significant digits in m, mm or µm.

    Examples
    --------
    >>> format_length(0.5), format_length(-0.0123), format_length(3.2e-6)
    ('0.500 m', '−12.3 mm', '3.20 µm')

    """
    size = abs(metres)
    if size >= 0.1:
        return f"{format_number(metres)} m"
    return f"{format_number(1e3 * metres)} mm" if size >= 1e-4 else f"{format_number(1e6 * metres)} µm"


def format_interval(ends: Sequence[float | None] | None, factor: float = 1.0, digits: int = 3) -> str:
    """Format both ends of an interval, multiplied by `factor`; a dash for no interval; None for an open end.

    Ends that would read the same get more digits.

    Examples
    --------
    >>> format_interval((0.031, 0.0382), 1e3), format_interval((None, 2.0)), format_interval((None, None))
    ('31.0 to 38.2', 'below 2.00', 'any')
    >>> format_interval((-0.11002, -0.10979))
    '−0.11002 to −0.10979'

    """
    if not ends:
        return DASH
    low, high = (None if end is None else format_number(factor * end, digits) for end in ends)
    if low == high and ends[0] != ends[1] and digits < MAX_DIGITS:
        return format_interval(ends, factor, digits + 2)
    if low is None or high is None:
        return f"above {low}" if low else f"below {high}" if high else "any"
    return f"{low} to {high}"


def format_range(values: Sequence[float]) -> str:
    """Format the smallest and the largest of some values in two digits, or one number where both read the same.

    Examples
    --------
    >>> format_range([0.31, 1.5, 0.9]), format_range([0.311, 0.312])
    ('0.31 to 1.5', '0.31')

    """
    low, high = format_number(min(values), 2), format_number(max(values), 2)
    return low if low == high else f"{low} to {high}"


def format_unit(unit: str) -> str:
    """Write a unit with superscripts and the micro sign; "1" gives an empty text.

    Examples
    --------
    >>> format_unit("N s^2/m^2"), format_unit("um"), format_unit("1")
    ('N s²/m²', 'µm', '')

    """
    if unit == "um":
        return "µm"
    return "" if unit == "1" else unit.replace("^2", "²").replace("^3", "³")


def _without_std(value: float) -> str:
    if value == round(value, 3) and abs(value) < 1e6:
        return f"{value:g}".replace("-", MINUS)
    return format_number(value, 4)


def prefixed(value: float, unit: str) -> tuple[float, str]:
    """Return the factor and the prefixed unit in which a small value is written."""
    size = abs(value)
    if unit not in PREFIXED_UNITS or size == 0 or size >= 0.1 or size < 1e-9:
        return 1.0, unit
    return (1e3, f"m{unit}") if size >= 1e-4 else (1e6, f"µ{unit}")


def _decimal_places(std: float) -> int:
    """Decimal places at which a value and its standard deviation end; of three digits and more, negative ones."""
    first = math.floor(math.log10(std))
    places = -first + (1 if std < MAX_LEADING_ONE * 10.0**first else 0)
    return places if std >= 100 else max(places, 0)


def _both(value: float, std: float, places: int) -> str:
    """Write a value and its standard deviation, rounded to some decimal places."""
    return " ± ".join(f"{round(one, places):.{max(places, 0)}f}" for one in (value, std))


def _power_of_ten(exponent: int) -> str:
    return f"{THIN_SPACE}{TIMES}{THIN_SPACE}10{str(exponent).translate(_SUPERSCRIPT)}"


def join_words(words: Sequence[str], last: str = "and") -> str:
    """Join words as in a sentence.

    Examples
    --------
    >>> join_words(["a", "b", "c"]), join_words(["a", "b"], "or"), join_words([])
    ('a, b and c', 'a or b', '')

    """
    return f"{', '.join(words[:-1])} {last} {words[-1]}" if len(words) > 1 else "".join(words)


def first_words(words: Sequence[str], most: int = 12) -> str:
    """List the first of many words, and how many others there are.

    Examples
    --------
    >>> first_words(["a", "b"], 2), first_words(["a", "b", "c", "d"], 2)
    ('a, b', 'a, b and 2 more')

    """
    more = len(words) - most
    return ", ".join(words[:most]) + (f" and {more} more" if more > 0 else "")


def lower_first(sentence: str) -> str:
    """Turn a sentence into a clause: lower-case first letter, no full stop.

    Examples
    --------
    >>> lower_first("Film a fixed mark.")
    'film a fixed mark'

    """
    return sentence[:1].lower() + sentence[1:].rstrip(".")


def upper_first(sentence: str) -> str:
    """Write the first letter of a sentence in upper case."""
    return sentence[:1].upper() + sentence[1:]


def describe_change(before: float | None, after: float | None, unit: str = "") -> str:
    """Describe how a number changes.

    Examples
    --------
    >>> describe_change(2.0, 1.0, "N"), describe_change(2.0, 2.001)
    ('falls from 2.00 to 1.00 N', 'stays at 2.00')

    """
    first, second = format_number(before), f"{format_number(after)} {unit}".rstrip()
    if f"{first} {unit}".rstrip() == second:
        return f"stays at {second}"
    verb = "changes" if before is None or after is None else "rises" if after > before else "falls"
    return f"{verb} from {first} to {second}"
