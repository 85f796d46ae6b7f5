"""Check what stands in the study file by itself, before any recording is opened: mass, scale, frame rate, incline."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from math import degrees

from frictrack.plausibility.finding import Finding
from frictrack.plausibility.ranges import BARE_MASS, BARE_PITCH, FPS, INCLINE, MASS, PITCH, Range


@dataclass(frozen=True)
class Typed:
    """The numbers of one run in SI, None where there is none, and which of them were typed without a unit."""

    run: str = ""
    mass: float | None = None
    pitch: float | None = None  # m/px
    fps: float | None = None
    incline: float | None = None
    bare: frozenset[str] = frozenset()  # "mass", "scale", "incline"


@dataclass(frozen=True)
class _Quantity:
    """One quantity of a study file: its key and SI unit, the unit that a bare number may have meant, what is plausible.

    `shown` is the unit of a proposal and how many of it are one of SI.
    """

    key: str
    si: str
    meant: str
    called: str
    plausible: Range
    bare: Range
    shown: tuple[float, str]
    why: Callable[[float], str] = lambda value: ""


WEIGHT = _Quantity("mass", "kg", "g", "grams", MASS, BARE_MASS, (1.0, "kg"))
SCALE = _Quantity(
    *("scale", "m/px", "mm/px", "mm"),
    *(PITCH, BARE_PITCH, (1e3, "mm/px")),
    why=lambda pitch: f": 1000 px would be {1e3 * pitch:g} m wide",
)


def implausible(typed: Typed) -> tuple[Finding, ...]:
    """Warnings on numbers of a run that no laboratory has, each with the likely correction.

    Parameters
    ----------
    typed
        The numbers as the study file has them.

    Returns
    -------
    tuple of Finding
        At most one for each number.

    Examples
    --------
    >>> from frictrack.plausibility import Typed, implausible
    >>> print(*implausible(Typed(mass=350.0, bare=frozenset({"mass"}))))
    mass = 350 has no unit and was read as 350 kg; if grams were meant give mass = "350 g", else mass = "350 kg"

    """
    return tuple(_found(typed))


def _found(typed: Typed) -> Iterator[Finding]:
    if typed.mass is not None:
        yield from _number(typed, WEIGHT, typed.mass)
    if typed.pitch is not None:
        yield from _number(typed, SCALE, typed.pitch)
    if typed.fps is not None and typed.fps not in FPS:
        thousand = f"; if kHz were meant give fps = {1e3 * typed.fps:g}" if typed.fps < FPS.low else ""
        words = f"fps = {typed.fps:g} lies outside {FPS.low:g} to {FPS.high:g} frames a second{thousand}; {_confirm()}"
        yield Finding("fps", words, f"fps = {1e3 * typed.fps:g}" if thousand else "", typed.run)
    if typed.incline is not None and "incline" in typed.bare and abs(typed.incline) > INCLINE.high:
        line = f'incline = "{typed.incline:g} deg"'
        words = (
            f"incline = {typed.incline:g} has no unit and was read as rad, which are {degrees(typed.incline):.3g} deg; "
            f'if degrees were meant give {line}, else incline = "{typed.incline:g} rad"'
        )
        yield Finding("incline", words, line, typed.run)


def _number(typed: Typed, of: _Quantity, value: float) -> Iterator[Finding]:
    """What is implausible in one quantity: a number without a unit, or one that no laboratory has."""
    if of.key in typed.bare and value > of.bare.high:
        line = f'{of.key} = "{value:g} {of.meant}"'
        words = (
            f"{of.key} = {value:g} has no unit and was read as {value:g} {of.si}; if {of.called} were meant give "
            f'{line}, else {of.key} = "{value:g} {of.si}"'
        )
        yield Finding(of.key, words, line, typed.run)
    elif of.key in typed.bare and of.plausible.low <= value < of.bare.low:
        line, small = f'{of.key} = "{1e3 * value:g} {of.si}"', f"{1e3 * value:g} {of.meant}"
        words = (
            f"{of.key} = {value:g} has no unit and was read as {value:g} {of.si}, which are {small}; if "
            f'{1e3 * value:g} {of.si} were meant give {line}, else {of.key} = "{small}"'
        )
        yield Finding(of.key, words, line, typed.run)
    elif value not in of.plausible:
        likely = value * (1e-3 if value > of.plausible.high else 1e3)
        line = f'{of.key} = "{likely * of.shown[0]:g} {of.shown[1]}"'
        words = (
            f"a {of.key} of {value:g} {of.si} lies outside {_span(of)}{of.why(value)}; was {line} meant? {_confirm()}"
        )
        yield Finding(of.key, words, line, typed.run)


def _span(of: _Quantity) -> str:
    return f"{of.plausible.low:g} to {of.plausible.high:g} {of.si}"


def _confirm() -> str:
    return 'if it is right, plausible = "checked" ends this remark'
