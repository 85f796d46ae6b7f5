"""Check speed, distance and friction coefficient of a run, and find the unit with which they become typical."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from math import log10, sin

import numpy as np

from frictrack.plausibility.finding import ERROR, WARNING, Finding
from frictrack.plausibility.incline import MAX_PARTNER_SHARE, MIN_SHARE_EACH_WAY
from frictrack.plausibility.ranges import (
    BLOW_ENERGY,
    DRY_FRICTION,
    FRICTION,
    ROLLING,
    SPEED,
    TRAVEL,
    USUAL_FRICTION,
    USUAL_SPEED,
    USUAL_TRAVEL,
    Range,
)
from frictrack.plausibility.strokes import Stroke, find_strokes, mean_acceleration, total_distance
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
MS_AND_MM = 't_s holds ms and x_m mm: give columns = {t = "t_s (ms)", x = "x_m (mm)"}'
MIN_TRAVEL_MS_MM = 1.0  # m: in a laboratory a free slide is shorter
TABLE_UNITS = (
    (1e-3, 1.0, 'x_m holds mm: give columns = {x = "x_m (mm)"}'),
    (1.0, 1e-3, 't_s holds ms: give columns = {t = "t_s (ms)"}'),
    (1e-3, 1e-3, MS_AND_MM),
    (1e-6, 1.0, 'x_m holds um: give columns = {x = "x_m (um)"}'),
    (1.0, 1e-6, 't_s holds us: give columns = {t = "t_s (us)"}'),
    (1e-2, 1.0, 'x_m holds cm: give columns = {x = "x_m (cm)"}'),
    (1e3, 1.0, 'x_m holds km: give columns = {x = "x_m (km)"}'),
    (1.0, 60.0, 't_s holds minutes: give columns = {t = "t_s (min)"}'),
)
UNIT_STEP = 1e3  # factor of a wrong unit; no camera setting differs by as much
FORCES = (("mN", 1e-3), ("uN", 1e-6), ("kN", 1e3))  # what a force may have been recorded in


@dataclass(frozen=True)
class SlideEstimate:
    """Speed, distance and friction of a run.

    Parameters
    ----------
    speed
        Highest speed, m/s.
    travel
        Distance of its longest stroke, m.
    friction
        Mean friction over normal load while only friction and gravity act; None if never.
    deceleration
        Mean deceleration by friction, m/s^2; None as above.

    """

    speed: float
    travel: float
    friction: float | None
    deceleration: float | None

    def scaled(self, length: float, time: float) -> SlideEstimate:
        """Return the estimate for lengths and times multiplied by factors; gravity is not changed."""
        by = length / time**2
        friction = None if self.friction is None else self.friction * by
        deceleration = None if self.deceleration is None else self.deceleration * by
        return SlideEstimate(self.speed * length / time, self.travel * length, friction, deceleration)

    @property
    def is_possible(self) -> bool:
        """Whether such slides occur in a laboratory."""
        friction_term = self.friction is None or self.friction in FRICTION
        return friction_term and self.speed in SPEED and self.travel in USUAL_TRAVEL

    @property
    def rarity(self) -> float:
        """Decades by which friction and speed differ from typical ones."""
        friction_term = 0.0 if self.friction is None else abs(log10(self.friction / USUAL_FRICTION))
        return friction_term + abs(log10(self.speed / USUAL_SPEED))


def estimate_slide(run: Run) -> SlideEstimate | None:
    """Estimate speed, distance and friction of a run.

    Parameters
    ----------
    run
        A run with displacement and motion.

    Returns
    -------
    SlideEstimate or None
        None if nothing moves long enough.

    """
    strokes = find_strokes(run)
    if not strokes:
        return None
    deceleration = _deceleration(run, strokes)
    load = run.load
    friction = None if deceleration is None or not load or not run.mass else run.mass * deceleration / load
    return SlideEstimate(
        max(stroke.speed for stroke in strokes), max(stroke.distance for stroke in strokes), friction, deceleration
    )


def implausible_slide(run: Run, *, film: bool) -> tuple[Finding, ...]:
    """Find an implausible speed, friction coefficient or energy of a run.

    Parameters
    ----------
    run
        A run with displacement and motion.
    film
        Whether it was filmed: then scale and fps may be wrong, else the units of the table.

    Returns
    -------
    tuple of Finding
        An error is a speed beyond any rail vehicle, or a value that only a unit wrong by a thousand explains.

    """
    slide = estimate_slide(run)
    if slide is None:
        return ()
    # The motion shows that one of them is wrong, not which: v goes with scale and fps, energy with their squares.
    check = ("scale", "fps", *(("mass",) if run.mass is not None else ())) if film else ()
    return tuple(replace(f, run=run.name, check=check) for f in _found(run, slide, film=film))


def _found(run: Run, slide: SlideEstimate, *, film: bool) -> Iterator[Finding]:
    hint, correction, is_significant = _correction(slide, film=film)
    grade = ERROR if is_significant else WARNING
    yield from _check_measured_friction(run)
    if slide.speed not in SPEED:
        grade = ERROR if slide.speed > SPEED.limit else grade
        than = f"than anything on rails ({SPEED.limit:g} m/s)" if slide.speed > SPEED.limit else "than in a laboratory"
        why = f"the mass would slide at {slide.speed:.3g} m/s, faster {than}"
        yield Finding("speed", f"{why}; {hint}", correction, grade=grade)
    elif slide.friction is not None and slide.friction not in FRICTION:
        yield Finding("friction", f"{_friction_text(run, slide)}; {hint}", correction, grade=grade)
    elif slide.friction is not None and slide.travel not in TRAVEL:
        words = f"the mass would slide {slide.travel:.3g} m without a stop; {hint}"
        yield Finding("scale", words, correction, grade=grade)
    elif not film and _holds_ms_and_mm(slide):
        seconds = float(run.displacement.t[-1] - run.displacement.t[0])
        words = f"{_friction_text(run, slide, ROLLING)}, over {slide.travel:.3g} m in {seconds:.3g} s"
        yield Finding("friction", f"{words}; probably {MS_AND_MM}", MS_AND_MM)
    elif run.drive is None and run.friction_N is None and not run.has_incline and run.mass is not None:
        yield from _check_energy(run.mass, slide)


def _holds_ms_and_mm(slide: SlideEstimate) -> bool:
    """Whether a long slide with hardly any friction is a usual one in ms and mm; its speed is the same in both."""
    if slide.friction is None or slide.friction >= ROLLING.low or slide.travel < MIN_TRAVEL_MS_MM:
        return False
    return 1e3 * slide.friction in DRY_FRICTION and 1e-3 * slide.travel in USUAL_TRAVEL


def _check_measured_friction(run: Run) -> Iterator[Finding]:
    """Check a measured friction force against the stated load."""
    if run.friction_N is None or run.normal_load is None:
        return
    ratio = float(np.nanmedian(np.abs(run.friction_N[run.displacement.valid]))) / run.normal_load
    if ratio in FRICTION or ratio == 0.0:
        return
    unit = next((name for name, size in FORCES if ratio * size in FRICTION), "")
    line = f'columns = {{friction = "friction_N ({unit})"}}' if unit else ""
    likely = f"; probably friction_N holds {unit}: give {line}" if unit else ""
    words = f"the measured friction is {ratio:.3g} times the normal load of {run.normal_load:g} N{likely}"
    yield Finding("friction", words, line)


def _friction_text(run: Run, slide: SlideEstimate, least: Range = FRICTION) -> str:
    assert slide.friction is not None
    assert slide.deceleration is not None
    load = "normal load" if run.normal_load is not None else "weight"
    out = f"the friction coefficient would be {slide.friction:.3g} (friction slows by {slide.deceleration:.3g} m/s^2)"
    if slide.friction > FRICTION.high:
        pressed = "" if run.normal_load is not None else ", unless something presses it on (then give normal_load)"
        return f"{out}, more than {FRICTION.high:g} times the {load}{pressed}"
    return f"{out}, less than {'on an air bearing' if least is FRICTION else 'in a ball bearing'}"


def _correction(slide: SlideEstimate, *, film: bool) -> tuple[str, str, bool]:
    """Likely correction of the units, as a sentence and alone, and whether it must be a factor of a thousand."""
    units = FILM_UNITS if film else TABLE_UNITS
    fitting = sorted(
        (made.rarity, words, size) for made, words, size in _in_other_units(slide, units) if made.is_possible
    )
    if not fitting:
        return ("check scale and fps" if film else "check the units of the table's columns"), "", False
    words = fitting[0][1]
    return f"probably {words}", words, all(size >= UNIT_STEP for _, _, size in fitting)


def _in_other_units(
    slide: SlideEstimate, units: Sequence[tuple[float, float, str]]
) -> Iterator[tuple[SlideEstimate, str, float]]:
    """The estimate in other units, with their description and factor."""
    for length, time, words in units:
        yield slide.scaled(length, time), words, max(length, 1 / length, time, 1 / time)


def _check_energy(mass: float, slide: SlideEstimate) -> Iterator[Finding]:
    energy = mass * slide.speed**2 / 2
    if energy in BLOW_ENERGY or slide.friction is None:
        return
    grams = f'mass = "{mass:g} g"' if mass > 1.0 else ""
    likely = f"; if grams were meant give {grams}" if grams else ""
    words = (
        f"a mass of {mass:g} kg at {slide.speed:.3g} m/s has {energy:.3g} J, more than a blow gives "
        f"({BLOW_ENERGY.high:g} J){likely}; check mass, scale and fps"
    )
    yield Finding("mass", words, grams)


def _deceleration(run: Run, strokes: tuple[Stroke, ...]) -> float | None:
    """Deceleration by friction alone, m/s^2; None if it cannot be determined.

    It is taken from the decelerating part of a struck run, or from a slide on an incline, in one direction of motion.
    """
    if run.drive is not None or run.friction_N is not None:
        return None
    direction = max(strokes, key=lambda stroke: stroke.distance).direction
    one_way = tuple(stroke for stroke in strokes if stroke.direction == direction)
    if total_distance(one_way) < (1 - MIN_SHARE_EACH_WAY) * total_distance(strokes):
        return None
    pull = -GRAVITY * sin(run.incline)
    free = tuple(
        stroke
        for stroke in one_way
        if not stroke.is_accelerating
        or (run.has_incline and stroke.partner_distance < MAX_PARTNER_SHARE * stroke.distance)
    )
    if not free or not any(stroke.is_significant for stroke in free):
        return None
    deceleration = direction * (pull - mean_acceleration(free))
    return deceleration if deceleration > 0 else None
