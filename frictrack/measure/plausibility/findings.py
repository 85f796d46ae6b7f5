"""Describe a finding, define plausible ranges with their sources, and check the values of a study file against them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from math import degrees, inf
from typing import Any

WARNING, ERROR = "warning", "error"
CONFIRM = 'if it is right, set plausible = "checked"'


@dataclass(frozen=True)
class Finding:
    """One sentence on one number of a study.

    Parameters
    ----------
    kind
        What is implausible: "mass", "scale", "fps", "speed", "friction", "incline", "origin", "sensor".
    words
        The sentence: what was read, why it is implausible, and the likely correction.
    correction
        What to type instead, as the study file has it; empty where nothing is likely.
    run
        Name of the run; empty where the whole study is meant.
    grade
        "error" where the number cannot be right, else "warning".
    contradicts
        Whether the measured data contradict what was typed. No verdict holds before one of the two is put right.
    check
        Keys of the study file to check, the likeliest first; by default the kind.

    """

    kind: str
    words: str
    correction: str = ""
    run: str = ""
    grade: str = WARNING
    contradicts: bool = False
    check: tuple[str, ...] = ()

    def __str__(self) -> str:
        return f'run "{self.run}": {self.words}' if self.run else self.words

    def to_dict(self) -> dict[str, Any]:
        """Return the JSON of the finding."""
        return {**asdict(self), "words": str(self), "check": self.check or (self.kind,)}


@dataclass(frozen=True)
class Range:
    """Plausible range of a quantity, ends included.

    Examples
    --------
    >>> 0.35 in MASS, 0.0 in MASS
    (True, False)

    """

    low: float
    high: float

    def __contains__(self, value: float) -> bool:
        return self.low <= value <= self.high


MASS = Range(1e-4, 1e3)  # kg: from a pin of a tribometer (ASTM G99: grams) to a block of a large direct-shear machine
# A number without a unit counts as kg: above 20 kg no slider is moved by hand, below 1 g nobody writes kg.
BARE_MASS = Range(1e-3, 20.0)
PITCH = Range(1e-8, 0.02)  # m/px: from half a wavelength of light to a field of view of 20 m in 1000 px
BARE_PITCH = Range(1e-8, 1e-2)  # a number without a unit counts as m/px: above 1 cm/px a slider of 0.1 m fills 10 px
FPS = Range(5.0, 1e7)  # 1/s: from a slow time lapse to in-situ storage sensors (10 million frames a second)
MAX_BARE_INCLINE = 0.8  # a number without a unit counts as rad: 0.8 rad are 46 degrees
SPEED = Range(0.0, 100.0)  # m/s: gas guns aside
RAIL_SPEED = 2885.0  # m/s: the fastest rocket sled (Holloman, 2003)
TRAVEL = Range(0.0, 100.0)  # m, of a free slide; a curling stone goes 30 to 45 m (World Curling)
FRICTION = Range(1e-4, 10.0)  # from an air bearing to ten times the weight; dry solids in air reach about 1.5
MIN_ROLLING = 1e-3  # friction coefficient of a ball bearing (0.0010 to 0.0015, SKF catalogue)
DRY_FRICTION = Range(0.02, 2.0)  # from ice or PTFE on steel to rubber; most dry pairs lie between 0.1 and 1
USUAL_FRICTION = 0.3  # most pairs of solids, dry or with boundary lubrication, lie within a decade of it
USUAL_SPEED = 1.0  # m/s
USUAL_TRAVEL = Range(1e-4, 20.0)  # m: courses in a laboratory
BLOW_ENERGY = Range(0.0, 300.0)  # J: the largest pendulum hammers in common use (ISO 148-1)


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
    pitch: float | None = None
    fps: float | None = None
    incline: float | None = None
    bare: frozenset[str] = frozenset()


def implausible_entries(entered: EnteredValues) -> tuple[Finding, ...]:
    """Find values that no laboratory has, each with the likely correction.

    Returns at most one warning per value.

    Examples
    --------
    >>> print(*implausible_entries(EnteredValues(mass=350.0, bare=frozenset({"mass"}))))
    mass = 350 has no unit and was read as 350 kg; if grams were meant give mass = "350 g", else mass = "350 kg"

    """
    return tuple(Finding(kind, words, line, entered.run) for kind, words, line in _implausible(entered))


def _implausible(entered: EnteredValues) -> Iterator[tuple[str, str, str]]:
    """Kind, sentence and correction of every implausible value."""
    if entered.mass is not None:
        yield from _misread(
            "mass", entered.mass, ("kg", "g", "grams"), MASS, BARE_MASS if "mass" in entered.bare else None
        )
    if entered.pitch is not None:
        bare = BARE_PITCH if "scale" in entered.bare else None
        yield from _misread("scale", entered.pitch, ("m/px", "mm/px", "mm"), PITCH, bare)
    if entered.fps is not None and entered.fps not in FPS:
        line = f"fps = {1e3 * entered.fps:g}" if entered.fps < FPS.low else ""
        thousand = f"; if kHz were meant give {line}" if line else ""
        outside = f"fps = {entered.fps:g} lies outside {FPS.low:g} to {FPS.high:g} frames per second"
        yield "fps", f"{outside}{thousand}; {CONFIRM}", line
    if entered.incline is not None and "incline" in entered.bare and abs(entered.incline) > MAX_BARE_INCLINE:
        line = f'incline = "{entered.incline:g} deg"'
        read = (
            f"incline = {entered.incline:g} has no unit and was read as rad, that is {degrees(entered.incline):.3g} deg"
        )
        yield "incline", f'{read}; if degrees were meant give {line}, else incline = "{entered.incline:g} rad"', line


def _misread(
    key: str, value: float, units: tuple[str, str, str], plausible: Range, bare: Range | None
) -> Iterator[tuple[str, str, str]]:
    """Find a number without a unit (then `bare` is its range) that probably means another, or a value out of range."""
    si, meant, called = units
    bare = bare or Range(0.0, inf)
    read = f"{key} = {value:g} has no unit and was read as {value:g} {si}"
    if value > bare.high:
        line = f'{key} = "{value:g} {meant}"'
        yield key, f'{read}; if {called} were meant give {line}, else {key} = "{value:g} {si}"', line
    elif plausible.low <= value < bare.low:
        line, small = f'{key} = "{1e3 * value:g} {si}"', f"{1e3 * value:g} {meant}"
        words = f'{read}, which are {small}; if {1e3 * value:g} {si} were meant give {line}, else {key} = "{small}"'
        yield key, words, line
    elif value not in plausible:
        likely = value * (1e-3 if value > plausible.high else 1e3)
        line = f'{key} = "{1e3 * likely:g} mm/px"' if key == "scale" else f'{key} = "{likely:g} {si}"'
        wide = f": 1000 px would be {1e3 * value:g} m wide" if key == "scale" else ""
        outside = f"a {key} of {value:g} {si} lies outside {plausible.low:g} to {plausible.high:g} {si}"
        yield key, f"{outside}{wide}; was {line} meant? {CONFIRM}", line
