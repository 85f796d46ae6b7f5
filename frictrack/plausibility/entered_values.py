"""Check the values of a study file before any recording is opened: mass, scale, frame rate and incline."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from math import degrees

from frictrack.plausibility.finding import Finding
from frictrack.plausibility.ranges import BARE_MASS, BARE_PITCH, FPS, INCLINE, MASS, PITCH, Range


@dataclass(frozen=True)
class EnteredValues:
    """Values of one run as entered, in SI; None if not given.

    Parameters
    ----------
    run
        Name of the run.
    mass, pitch, fps, incline
        Mass kg, pixel pitch m/px, frame rate 1/s, incline rad.
    bare
        Which of "mass", "scale" and "incline" were entered without a unit.

    """

    run: str = ""
    mass: float | None = None
    pitch: float | None = None  # m/px
    fps: float | None = None
    incline: float | None = None
    bare: frozenset[str] = frozenset()  # "mass", "scale", "incline"


@dataclass(frozen=True)
class _Quantity:
    """One quantity of a study file, its units and its plausible ranges.

    `meant` is the unit that a bare number may have meant, called `called`; `bare` is the range of a bare number;
    `shown` is the unit of a proposed correction and its number per SI unit.
    """

    key: str
    si: str
    meant: str
    called: str
    plausible: Range
    bare: Range
    shown: tuple[float, str]
    why: Callable[[float], str] = lambda value: ""


MASS_ENTRY = _Quantity("mass", "kg", "g", "grams", MASS, BARE_MASS, (1.0, "kg"))
SCALE_ENTRY = _Quantity(
    *("scale", "m/px", "mm/px", "mm"),
    *(PITCH, BARE_PITCH, (1e3, "mm/px")),
    why=lambda pitch: f": 1000 px would be {1e3 * pitch:g} m wide",
)


def implausible_entries(entered: EnteredValues) -> tuple[Finding, ...]:
    """Find values that no laboratory has, each with the likely correction.

    Parameters
    ----------
    entered
        The values of one run.

    Returns
    -------
    tuple of Finding
        At most one warning per value.

    Examples
    --------
    >>> print(*implausible_entries(EnteredValues(mass=350.0, bare=frozenset({"mass"}))))
    mass = 350 has no unit and was read as 350 kg; if grams were meant give mass = "350 g", else mass = "350 kg"

    """
    return tuple(_found(entered))


def _found(entered: EnteredValues) -> Iterator[Finding]:
    if entered.mass is not None:
        yield from _check_number(entered, MASS_ENTRY, entered.mass)
    if entered.pitch is not None:
        yield from _check_number(entered, SCALE_ENTRY, entered.pitch)
    if entered.fps is not None and entered.fps not in FPS:
        thousand = f"; if kHz were meant give fps = {1e3 * entered.fps:g}" if entered.fps < FPS.low else ""
        outside = f"fps = {entered.fps:g} lies outside {FPS.low:g} to {FPS.high:g} frames per second"
        words = f"{outside}{thousand}; {_confirm_text()}"
        yield Finding("fps", words, f"fps = {1e3 * entered.fps:g}" if thousand else "", entered.run)
    if entered.incline is not None and "incline" in entered.bare and abs(entered.incline) > INCLINE.high:
        line = f'incline = "{entered.incline:g} deg"'
        words = (
            f"incline = {entered.incline:g} has no unit and was read as rad, "
            f"that is {degrees(entered.incline):.3g} deg; "
            f'if degrees were meant give {line}, else incline = "{entered.incline:g} rad"'
        )
        yield Finding("incline", words, line, entered.run)


def _check_number(entered: EnteredValues, quantity: _Quantity, value: float) -> Iterator[Finding]:
    """Find a bare number that probably means another unit, or a value out of range."""
    if quantity.key in entered.bare and value > quantity.bare.high:
        line = f'{quantity.key} = "{value:g} {quantity.meant}"'
        words = (
            f"{quantity.key} = {value:g} has no unit and was read as {value:g} {quantity.si}; "
            f"if {quantity.called} were meant give "
            f'{line}, else {quantity.key} = "{value:g} {quantity.si}"'
        )
        yield Finding(quantity.key, words, line, entered.run)
    elif quantity.key in entered.bare and quantity.plausible.low <= value < quantity.bare.low:
        line, small = f'{quantity.key} = "{1e3 * value:g} {quantity.si}"', f"{1e3 * value:g} {quantity.meant}"
        words = (
            f"{quantity.key} = {value:g} has no unit and was read as {value:g} {quantity.si}, which are {small}; if "
            f'{1e3 * value:g} {quantity.si} were meant give {line}, else {quantity.key} = "{small}"'
        )
        yield Finding(quantity.key, words, line, entered.run)
    elif value not in quantity.plausible:
        likely = value * (1e-3 if value > quantity.plausible.high else 1e3)
        line = f'{quantity.key} = "{likely * quantity.shown[0]:g} {quantity.shown[1]}"'
        outside = f"a {quantity.key} of {value:g} {quantity.si} lies outside {_range_text(quantity)}"
        words = f"{outside}{quantity.why(value)}; was {line} meant? {_confirm_text()}"
        yield Finding(quantity.key, words, line, entered.run)


def _range_text(quantity: _Quantity) -> str:
    return f"{quantity.plausible.low:g} to {quantity.plausible.high:g} {quantity.si}"


def _confirm_text() -> str:
    return 'if it is right, set plausible = "checked"'
