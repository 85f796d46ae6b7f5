"""Numbers as people write them: rounded to their uncertainty, in units that need no exponent."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence

from markupsafe import Markup, escape

from frictrack.plots import unit as written_unit

MINUS, TIMES, THIN = "\N{MINUS SIGN}", "\N{MULTIPLICATION SIGN}", "\N{NARROW NO-BREAK SPACE}"
SUPERSCRIPT = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
PREFIXED = ("m", "s", "N", "N s")  # units whose thousandths and millionths are common
GREEK = (("delta", "δ"), ("pi", "π"), ("omega", "ω"), ("tau", "τ"))
TICKS = re.compile(r"`([^`]+)`")
NAME = re.compile(r"(?<![A-Za-z_])([A-Za-z]+)_([A-Za-z0-9]+)")
POWER = re.compile(r"\^([A-Za-z0-9]+)")


def number(value: float | None, digits: int = 3) -> str:
    """A number of so many digits; an en dash for none."""
    if value is None or not math.isfinite(value):
        return "\N{EN DASH}"
    if value == 0:
        return "0"
    exponent = int(f"{value:.{digits - 1}e}".partition("e")[2])  # of the rounded value: 0.9999 is 1.00
    if not -4 < exponent < 6:
        return (
            f"{value / 10**exponent:.{digits - 1}f}{THIN}{TIMES}{THIN}10{str(exponent).translate(SUPERSCRIPT)}".replace(
                "-", MINUS
            )
        )
    comma = "," if exponent > 3 else ""
    return f"{value:{comma}.{max(digits - 1 - exponent, 0)}f}".replace("-", MINUS).replace(",", THIN)


def quantity(value: float | None, std: float | None, unit: str) -> str:
    """A value with its standard deviation and unit: ``quantity(8.0123, 0.021, "N")`` is ``"8.01 ± 0.02 N"``.

    The deviation keeps one digit, two where the first is 1; the value ends at the same place. Small lengths, times
    and forces are given in their thousandths or millionths. A value of None is "not determined".
    """
    if value is None:
        return "not determined"
    factor, unit = _prefixed(value, unit)
    value, std = value * factor, None if std is None else std * factor
    tail = written_unit(unit)
    tail = f" {tail}" if tail else ""
    if not std or not math.isfinite(std):
        return f"{_short(value)}{tail}"
    body, exponent = _rounded(value, std)
    if exponent:
        return f"({body}){THIN}{TIMES}{THIN}10{str(exponent).translate(SUPERSCRIPT)}{tail}"
    return f"({body}){tail}" if "/" in tail or " " in tail.strip() else f"{body}{tail}"


def _short(value: float) -> str:
    return f"{value:g}".replace("-", MINUS) if value == round(value, 3) and abs(value) < 1e6 else number(value, 4)


def _prefixed(value: float, unit: str) -> tuple[float, str]:
    size = abs(value)
    if unit not in PREFIXED or size == 0 or size >= 0.1 or size < 1e-9:
        return 1.0, unit
    return (1e3, f"m{unit}") if size >= 1e-4 else (1e6, f"µ{unit}")


def _rounded(value: float, std: float) -> tuple[str, int]:
    """Both numbers at the same place, ``8.01 ± 0.02``, and the power of ten that was taken out (0 for none)."""
    largest = max(abs(value), std)
    power = math.floor(math.log10(largest))
    power = 0 if -4 < power < 6 else power
    value, std = value / 10.0**power, std / 10.0**power
    first = math.floor(math.log10(std))
    if round(std / 10.0**first) == 10:  # 0.096 is 0.1, and its first digit 1
        first += 1
    places = max(-first + (1 if std < 1.95 * 10.0**first else 0), 0)
    return f"{value:.{places}f} ± {std:.{places}f}".replace("-", MINUS), power


def formula(text: str) -> Markup:
    """An equation in plain text with its subscripts, powers and Greek letters set: ``F_c``, ``v^2``, ``pi``."""
    marked = POWER.sub(r"<sup>\1</sup>", NAME.sub(r"\1<sub>\2</sub>", str(escape(text))))
    for word, letter in GREEK:
        marked = re.sub(rf"\b{word}\b", letter, marked)
    return Markup(marked.replace(" - ", f" {MINUS} ").replace("(-", f"({MINUS}"))


def typed(text: str) -> Markup:
    """Words in which backticks mark what can be typed."""
    return Markup(TICKS.sub(r"<code>\1</code>", str(escape(text))))


def size(value: float, unit: str) -> str:
    """A rough size with its unit: two digits."""
    factor, unit = _prefixed(value, unit)
    return f"{number(factor * value, 2)} {written_unit(unit)}".strip()


def span(pair: list[float] | tuple[float, float] | None, factor: float = 1.0) -> str:
    """Both ends of a stretch: "31.0 to 38.2"."""
    if not pair:
        return "\N{EN DASH}"
    return " to ".join(number(factor * end) for end in pair)


def low_to_high(values: Sequence[float]) -> str:
    """The extent of some values in two digits: "0.31 to 1.5", or one number where they agree."""
    low, high = number(min(values), 2), number(max(values), 2)
    return low if low == high else f"{low} to {high}"
