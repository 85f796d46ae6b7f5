"""Check speed, travel and friction coefficient of a measured slide, and find the unit in which they become usual."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from math import log10, sin

import numpy as np

from frictrack.plausibility.finding import ERROR, WARNING, Finding
from frictrack.plausibility.incline import MAX_PARTNER_SHARE, MIN_SHARE_EACH_WAY
from frictrack.plausibility.ranges import BLOW, FRICTION, SPEED, TRAVEL, USUAL_FRICTION, USUAL_SPEED, USUAL_TRAVEL
from frictrack.plausibility.strokes import Leg, legs_of, mean, total
from frictrack.records import GRAVITY, Run

FILM_UNITS = (  # what a number of a film may have been mistyped by: length, time, and how to say it
    (1e-3, 1.0, "the scale is a thousand times too large (mm taken for m?)"),
    (1e3, 1.0, "the scale is a thousand times too small (um taken for mm?)"),
    (1e-2, 1.0, "the scale is a hundred times too large (cm taken for m?)"),
    (1e-1, 1.0, "the scale is ten times too large"),
    (1e1, 1.0, "the scale is ten times too small"),
    (1.0, 1e-3, "fps is a thousand times too small (kHz?)"),
    (1.0, 1e-1, "fps is ten times too small"),
    (1.0, 1e1, "fps is ten times too large"),
)
TABLE_UNITS = (
    (1e-3, 1.0, 'x_m holds mm: head that column "x (mm)" and give columns = {x = "x (mm)"}'),
    (1.0, 1e-3, 't_s holds ms: head that column "t (ms)" and give columns = {t = "t (ms)"}'),
    (1e-3, 1e-3, 't_s holds ms and x_m mm: head them "t (ms)", "x (mm)" and name them in columns'),
    (1e-6, 1.0, 'x_m holds um: head that column "x (um)" and give columns = {x = "x (um)"}'),
    (1.0, 1e-6, 't_s holds us: head that column "t (us)" and give columns = {t = "t (us)"}'),
    (1e-2, 1.0, 'x_m holds cm: head that column "x (cm)" and give columns = {x = "x (cm)"}'),
    (1e3, 1.0, 'x_m holds km: head that column "x (km)" and give columns = {x = "x (km)"}'),
    (1.0, 60.0, 't_s holds minutes: head that column "t (min)" and give columns = {t = "t (min)"}'),
)
UNIT_STEP = 1e3  # from a unit to its thousandth: a slip of that size is no other setting of the instrument
FORCES = (("mN", 1e-3), ("uN", 1e-6), ("kN", 1e3))  # what a force may have been recorded in


@dataclass(frozen=True)
class Slide:
    """What a run shows of itself.

    Parameters
    ----------
    speed
        Highest speed, m/s.
    travel
        Way of its longest leg, m.
    friction
        Mean friction over the normal load while nothing but friction and gravity acts; None where that is not so.
    slows
        Mean deceleration by friction, m/s^2; None as above.

    """

    speed: float
    travel: float
    friction: float | None
    slows: float | None

    def scaled(self, length: float, time: float) -> Slide:
        """The same, had a length and a time been so many times as large; gravity is left out of it."""
        by = length / time**2
        friction = None if self.friction is None else self.friction * by
        slows = None if self.slows is None else self.slows * by
        return Slide(self.speed * length / time, self.travel * length, friction, slows)

    @property
    def possible(self) -> bool:
        """Whether a laboratory has such slides."""
        rubbing = self.friction is None or self.friction in FRICTION
        return rubbing and self.speed in SPEED and self.travel in USUAL_TRAVEL

    @property
    def rarity(self) -> float:
        """Decades by which it is off a usual slide."""
        rubbing = 0.0 if self.friction is None else abs(log10(self.friction / USUAL_FRICTION))
        return rubbing + abs(log10(self.speed / USUAL_SPEED))


def slide_of(run: Run) -> Slide | None:
    """Speed, travel and friction of a run; None where nothing moves long enough."""
    legs = legs_of(run)
    if not legs:
        return None
    slows = _deceleration(run, legs)
    load = run.load
    friction = None if slows is None or not load or not run.mass else run.mass * slows / load
    return Slide(max(leg.speed for leg in legs), max(leg.way for leg in legs), friction, slows)


def implausible_slide(run: Run, *, film: bool) -> tuple[Finding, ...]:
    """Findings on the speed, the friction coefficient and the energy of a run.

    Parameters
    ----------
    run
        A run after `differentiate`.
    film
        Whether it was filmed: then scale and fps may be wrong, else the units of the table.

    Returns
    -------
    tuple of Finding
        An error is a speed that nothing on rails ever had, and what only a unit of another thousand makes possible.

    """
    slide = slide_of(run)
    return () if slide is None else tuple(replace(f, run=run.name) for f in _found(run, slide, film=film))


def _found(run: Run, slide: Slide, *, film: bool) -> Iterator[Finding]:
    hint, correction, certain = _correction(slide, film=film)
    grade = ERROR if certain else WARNING
    yield from _measured(run)
    if slide.speed not in SPEED:
        grade = ERROR if slide.speed > SPEED.limit else grade
        than = f"than anything on rails ({SPEED.limit:g} m/s)" if slide.speed > SPEED.limit else "than in a laboratory"
        why = f"the mass would slide at {slide.speed:.3g} m/s, faster {than}"
        yield Finding("speed", f"{why}; {hint}", correction, grade=grade)
    elif slide.friction is not None and slide.friction not in FRICTION:
        yield Finding("friction", f"{_friction_words(run, slide)}; {hint}", correction, grade=grade)
    elif slide.friction is not None and slide.travel not in TRAVEL:
        words = f"the mass would slide {slide.travel:.3g} m without a stop; {hint}"
        yield Finding("scale", words, correction, grade=grade)
    elif run.drive is None and run.friction_N is None and not run.has_incline and run.mass is not None:
        yield from _blow(run.mass, slide)


def _measured(run: Run) -> Iterator[Finding]:
    """What a measured friction force has against a stated load."""
    if run.friction_N is None or run.normal_load is None:
        return
    ratio = float(np.nanmedian(np.abs(run.friction_N[run.displacement.valid]))) / run.normal_load
    if ratio in FRICTION or ratio == 0.0:
        return
    unit = next((name for name, size in FORCES if ratio * size in FRICTION), "")
    line = f'columns = {{friction = "F ({unit})"}}' if unit else ""
    likely = f"; probably friction_N holds {unit}: head that column so and give {line}" if unit else ""
    words = f"the measured friction is {ratio:.3g} times the normal load of {run.normal_load:g} N{likely}"
    yield Finding("friction", words, line)


def _friction_words(run: Run, slide: Slide) -> str:
    assert slide.friction is not None
    assert slide.slows is not None
    load = "normal load" if run.normal_load is not None else "weight"
    out = f"the friction coefficient would be {slide.friction:.3g} (friction slows by {slide.slows:.3g} m/s^2)"
    if slide.friction > FRICTION.high:
        pressed = "" if run.normal_load is not None else ", unless something presses it on (then give normal_load)"
        return f"{out}, more than {FRICTION.high:g} times the {load}{pressed}"
    return f"{out}, less than on an air bearing"


def _correction(slide: Slide, *, film: bool) -> tuple[str, str, bool]:
    """Which unit makes all of it usual, in words, and alone; and whether no smaller change of a unit does."""
    units = FILM_UNITS if film else TABLE_UNITS
    fitting = sorted((made.rarity, words, size) for made, words, size in _tried(slide, units) if made.possible)
    if not fitting:
        return ("check scale and fps" if film else "check the units of the table's columns"), "", False
    words = fitting[0][1]
    return f"probably {words}", words, all(size >= UNIT_STEP for _, _, size in fitting)


def _tried(slide: Slide, units: Sequence[tuple[float, float, str]]) -> Iterator[tuple[Slide, str, float]]:
    """The slide in other units, which they are, and by what factor they differ."""
    for length, time, words in units:
        yield slide.scaled(length, time), words, max(length, 1 / length, time, 1 / time)


def _blow(mass: float, slide: Slide) -> Iterator[Finding]:
    energy = mass * slide.speed**2 / 2
    if energy in BLOW or slide.friction is None:
        return
    grams = f'mass = "{mass:g} g"' if mass > 1.0 else ""
    likely = f"; if grams were meant give {grams}" if grams else ""
    words = (
        f"a mass of {mass:g} kg at {slide.speed:.3g} m/s has {energy:.3g} J, more than a blow gives "
        f"({BLOW.high:g} J){likely}; check mass, scale and fps"
    )
    yield Finding("mass", words, grams)


def _deceleration(run: Run, legs: tuple[Leg, ...]) -> float | None:
    """Friction over mass while nothing else acts, m/s^2; None where it cannot be told.

    That is the slowing part of a struck run, or a slide down or up an incline, in one direction of motion.
    """
    if run.drive is not None or run.friction_N is not None:
        return None
    direction = max(legs, key=lambda leg: leg.way).direction
    one_way = tuple(leg for leg in legs if leg.direction == direction)
    if total(one_way) < (1 - MIN_SHARE_EACH_WAY) * total(legs):
        return None
    pull = -GRAVITY * sin(run.incline)
    free = tuple(
        leg for leg in one_way if not leg.speeding or (run.has_incline and leg.partner < MAX_PARTNER_SHARE * leg.way)
    )
    if not free or not any(leg.certain for leg in free):
        return None
    slows = direction * (pull - mean(free))
    return slows if slows > 0 else None
