"""Check what stands in the study file by itself, before any recording is opened: mass, scale, frame rate, incline."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from math import degrees

from frictrack.plausibility.finding import Finding
from frictrack.plausibility.ranges import BARE_MASS, BARE_PITCH, FPS, INCLINE, MASS, PITCH


@dataclass(frozen=True)
class Typed:
    """The numbers of one run in SI, None where there is none, and which of them were typed without a unit."""

    run: str = ""
    mass: float | None = None
    pitch: float | None = None  # m/px
    fps: float | None = None
    incline: float | None = None
    bare: frozenset[str] = frozenset()  # "mass", "scale", "incline"


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
        yield from _mass(typed, typed.mass)
    if typed.pitch is not None:
        yield from _pitch(typed, typed.pitch)
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


def _mass(typed: Typed, mass: float) -> Iterator[Finding]:
    if "mass" in typed.bare and mass > BARE_MASS.high:
        line = f'mass = "{mass:g} g"'
        words = (
            f"mass = {mass:g} has no unit and was read as {mass:g} kg; if grams were meant give {line}, "
            f'else mass = "{mass:g} kg"'
        )
        yield Finding("mass", words, line, typed.run)
    elif mass not in MASS:
        factor = 1e-3 if mass > MASS.high else 1e3
        line = f'mass = "{mass * factor:g} kg"'
        words = f"a mass of {mass:g} kg lies outside {_span(MASS.low, MASS.high, 'kg')}; was {line} meant? {_confirm()}"
        yield Finding("mass", words, line, typed.run)


def _pitch(typed: Typed, pitch: float) -> Iterator[Finding]:
    if "scale" in typed.bare and pitch > BARE_PITCH.high:
        line = f'scale = "{pitch:g} mm/px"'
        words = (
            f"scale = {pitch:g} has no unit and was read as {pitch:g} m/px; if mm were meant give {line}, "
            f'else scale = "{pitch:g} m/px"'
        )
        yield Finding("scale", words, line, typed.run)
    elif pitch not in PITCH:
        factor = 1e-3 if pitch > PITCH.high else 1e3
        line = f'scale = "{1e3 * pitch * factor:g} mm/px"'
        words = (
            f"a scale of {pitch:g} m/px lies outside {_span(PITCH.low, PITCH.high, 'm/px')}: 1000 px would be "
            f"{1e3 * pitch:g} m wide; was {line} meant? {_confirm()}"
        )
        yield Finding("scale", words, line, typed.run)


def _span(low: float, high: float, unit: str) -> str:
    return f"{low:g} to {high:g} {unit}"


def _confirm() -> str:
    return 'if it is right, plausible = "checked" ends this remark'
