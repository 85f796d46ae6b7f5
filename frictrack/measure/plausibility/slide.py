"""Check the values that a study file states and the motion of each run: plausible ranges with their sources.

The motion is divided into strokes: one direction, accelerating or decelerating, with a fitted acceleration. Speed,
distance and friction that no laboratory has name the unit with which they become typical.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from math import degrees, inf, log10
from operator import itemgetter
from typing import Any

import numpy as np

from frictrack.measure.friction import has_measured_force, is_moving, split_by_direction
from frictrack.records import Array, Run, mask_of_spans, stretches
from frictrack.study import ANGLE_NOTE, COLUMNS

WARNING, ERROR = "warning", "error"
ACCEPTED = 'set plausible = "checked"'  # in the study file, where a number is right that looks implausible
CONFIRM = f"if it is right, {ACCEPTED}"


@dataclass(frozen=True)
class Finding:
    """One sentence on one number of a study.

    Parameters
    ----------
    kind
        What is implausible: "mass", "scale", "fps", "speed", "friction", "incline", "origin",
        "sensor", "copy".
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
MAX_RARITY = 2.0  # decades from a usual slide, friction and speed together, where no dry solid rubs as much
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
        bare = BARE_MASS if "mass" in entered.bare else None
        yield from _misread("mass", entered.mass, ("kg", "g", "grams"), MASS, bare)
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


MIN_FRAMES = 10  # of a stroke, for a parabola
TRIMMED_SHARE = 0.1  # of a stroke at either end; smoothing affects frames near a collision
EVENT_REACH_FRAMES = 3  # frames that an event affects beyond itself
CORRELATION_FACTOR = 3.0  # on standard deviations, for errors that neighbours share
MIN_SIGMAS = 5.0  # of an acceleration that differs from 0
# Share of its way that a speeding leg may be followed by a smooth slowing down: more is a push, or a spring.
MAX_PARTNER_SHARE = 0.25
IDLE_SHARE = 0.05  # of the median force: below it nothing rubs; dry friction has no such speeds
MIN_IDLE_SHARE = 0.02  # of the moving frames; a reversal passes through zero in fewer
MIN_SHARE_EACH_WAY = 0.2  # of the distance, for a direction to count
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
MS_AND_MM: Mapping[str, str] = {"t": "ms", "x": "mm"}
MIN_TRAVEL_MS_MM = 1.0  # m: in a laboratory a free slide is shorter
TABLE_UNITS = (  # the same of a table, and what its columns may hold
    (1e-3, 1.0, {"x": "mm"}),
    (1.0, 1e-3, {"t": "ms"}),
    (1e-3, 1e-3, MS_AND_MM),
    (1e-6, 1.0, {"x": "um"}),
    (1.0, 1e-6, {"t": "us"}),
    (1e-2, 1.0, {"x": "cm"}),
    (1e3, 1.0, {"x": "km"}),
    (1.0, 60.0, {"t": "min"}),
)
UNIT_STEP = 1e3  # factor of a wrong unit; no camera setting differs by as much
FORCES = (("mN", 1e-3), ("uN", 1e-6), ("kN", 1e3))  # what a force may have been recorded in


@dataclass(frozen=True)
class Stroke:
    """A stretch of one direction between two collisions, stops or reversals, before or after its highest speed."""

    distance: float  # m, above 0
    direction: float  # 1 or -1
    a: float  # m/s^2 toward +x
    sigma_a: float
    speed: float  # m/s, the highest
    mid_speed: float  # m/s, in its middle
    misfit: float  # rms of what a constant acceleration leaves beyond the noise, over the way
    is_accelerating: bool  # before the highest speed
    partner_distance: float  # m, way of the same stretch on the other side of its highest speed

    @property
    def speed_gain(self) -> float:
        """Acceleration in the direction of motion, m/s^2."""
        return self.a * self.direction

    @property
    def is_significant(self) -> bool:
        """Whether the acceleration differs from 0."""
        return abs(self.a) > MIN_SIGMAS * self.sigma_a

    @property
    def is_free(self) -> bool:
        """Whether nothing pushes the mass: it decelerates, or its acceleration lasts to the end."""
        return not self.is_accelerating or self.partner_distance < MAX_PARTNER_SHARE * self.distance


def find_strokes(run: Run) -> tuple[Stroke, ...]:
    """Find the strokes of a run, in order; they exclude frames not found, events and rests."""
    reach = [(max(first - EVENT_REACH_FRAMES, 0), last + EVENT_REACH_FRAMES) for first, last in run.motion.events]
    free = run.displacement.valid & is_moving(run) & ~mask_of_spans(reach, len(run.motion))
    x, found = run.motion.x, []
    for s in split_by_direction(run, stretches(free)):
        top = s.start + int(np.argmax(np.abs(run.motion.v[s])))  # the highest speed
        before, after = abs(float(x[top] - x[s.start])), abs(float(x[s.stop - 1] - x[top]))
        found.append(_fit_stroke(run, slice(s.start, top + 1), is_accelerating=True, partner_distance=after))
        found.append(_fit_stroke(run, slice(top, s.stop), is_accelerating=False, partner_distance=before))
    return tuple(stroke for stroke in found if stroke is not None)


def total_distance(strokes: tuple[Stroke, ...]) -> float:
    """Distance of all strokes together, m."""
    return float(sum(stroke.distance for stroke in strokes))


def mean_acceleration(strokes: tuple[Stroke, ...]) -> float:
    """Mean acceleration of strokes, weighted by their variances, m/s^2."""
    floor = 1e-6 * max(stroke.sigma_a for stroke in strokes) + 1e-300
    weights = [(stroke.sigma_a + floor) ** -2.0 for stroke in strokes]
    return float(np.average([stroke.a for stroke in strokes], weights=weights))


def _fit_stroke(run: Run, s: slice, *, is_accelerating: bool, partner_distance: float) -> Stroke | None:
    """Fit the stroke of a slice; None if it is too short."""
    trimmed = int(TRIMMED_SHARE * (s.stop - s.start))
    rows = slice(s.start + trimmed, s.stop - trimmed)
    t, x = run.motion.t[rows], run.displacement.x[rows]
    distance = float(abs(x[-1] - x[0])) if len(t) >= MIN_FRAMES else 0.0
    if distance <= 0.0:
        return None
    u = t - (t[0] + t[-1]) / 2
    (_, slope, a), std, residual_rms = fit_columns(np.stack([np.ones_like(u), u, u**2 / 2], axis=1), x)
    noise = float(np.median(run.displacement.sigma_x[rows]))
    return Stroke(
        distance=distance,
        direction=float(np.sign(x[-1] - x[0])),
        a=float(a),
        sigma_a=CORRELATION_FACTOR * float(std[2]),
        speed=float(abs(slope) + abs(a) * (t[-1] - t[0]) / 2),
        mid_speed=float(abs(slope)),
        misfit=float(np.sqrt(max(residual_rms**2 - noise**2, 0.0))) / distance,
        is_accelerating=is_accelerating,
        partner_distance=partner_distance,
    )


def fit_columns(design: Array, values: Array) -> tuple[Array, Array, float]:
    """Least-squares coefficients (k,) of columns (n, k), their deviations for white noise, and the rms residual."""
    scale = np.maximum(np.abs(design).max(axis=0), 1e-300)
    unit = design / scale
    found = np.linalg.lstsq(unit, values, rcond=None)[0]
    rms = float(np.sqrt(np.sum((values - unit @ found) ** 2) / max(len(values) - unit.shape[1], 1)))
    std = rms * np.sqrt(np.diag(np.linalg.pinv(unit.T @ unit)))
    return found / scale, std / scale, rms


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
        both = self.friction, self.deceleration
        friction, deceleration = (None if one is None else one * length / time**2 for one in both)
        return SlideEstimate(self.speed * length / time, self.travel * length, friction, deceleration)

    @property
    def is_possible(self) -> bool:
        """Whether such slides occur in a laboratory."""
        friction_is_possible = self.friction is None or self.friction in FRICTION
        return friction_is_possible and self.speed in SPEED and self.travel in USUAL_TRAVEL

    @property
    def rarity(self) -> float:
        """Decades by which friction and speed differ from typical ones."""
        friction_term = 0.0 if self.friction is None else abs(log10(self.friction / USUAL_FRICTION))
        return friction_term + abs(log10(self.speed / USUAL_SPEED))


def estimate_slide(run: Run) -> SlideEstimate | None:
    """Estimate speed, distance and friction of a run; None if nothing moves long enough."""
    strokes = find_strokes(run)
    if not strokes:
        return None
    deceleration, load = _deceleration(run, strokes), run.load
    friction = None  # of a body that rolls no range is known
    if deceleration is not None and load and run.mass and not run.rolling:
        friction = run.mass * deceleration / load
    return SlideEstimate(max(s.speed for s in strokes), max(s.distance for s in strokes), friction, deceleration)


def _deceleration(run: Run, strokes: tuple[Stroke, ...]) -> float | None:
    """Deceleration by friction alone, m/s^2; None if it cannot be determined.

    It is taken from the decelerating part of a struck run, or from a slide on an incline, in one direction of motion.
    """
    if has_measured_force(run) or (run.radius and run.has_incline):
        return None
    direction = max(strokes, key=lambda stroke: stroke.distance).direction
    one_way = tuple(stroke for stroke in strokes if stroke.direction == direction)
    free = tuple(s for s in one_way if s.is_free and (run.has_incline or not s.is_accelerating))
    goes_one_way = total_distance(one_way) >= (1 - MIN_SHARE_EACH_WAY) * total_distance(strokes)
    if not (goes_one_way and any(stroke.is_significant for stroke in free)):
        return None
    deceleration = direction * (run.pull - mean_acceleration(free))
    return deceleration if deceleration > 0 else None


def standard_header(key: str) -> str:
    """Return the header that a column of a table has where the study file names none."""
    return COLUMNS[key][0]


def implausible_slide(run: Run, *, film: bool, header: Callable[[str], str] = standard_header) -> tuple[Finding, ...]:
    """Find an implausible speed, friction coefficient or energy of a run.

    `run`: a run with displacement and motion; `film`: whether it was filmed: then scale and fps may be wrong, else the
    units of the table, whose columns have a `header` each. An error is a speed beyond any rail vehicle, or a value that
    only a unit wrong by a thousand explains.
    """
    if ANGLE_NOTE in run.displacement.notes:
        return ()  # of a moment of inertia, and torques, no range is known
    slide = estimate_slide(run)
    # the motion shows that one of them is wrong, not which: v goes with scale and fps, energy with their squares
    check = ("scale", "fps", *(("mass",) if run.mass is not None else ())) if film else ()
    found = [*_check_measured_friction(run, header)]
    found += [] if slide is None else _check_slide(run, slide, None if film else header)
    return tuple(replace(one, run=run.name, check=check) for one in found)


def _check_slide(run: Run, slide: SlideEstimate, header: Callable[[str], str] | None) -> Iterator[Finding]:
    """Check the speed, else the friction, the distance or the energy of a slide; a film has no header."""
    kind, mu = "", slide.friction
    # friction above that of dry solids, and it and the speed are as large as a wrong scale makes them
    is_rare = mu is not None and mu > DRY_FRICTION.high and slide.rarity > MAX_RARITY
    if slide.speed not in SPEED:
        than = f"than anything on rails ({RAIL_SPEED:g} m/s)" if slide.speed > RAIL_SPEED else "than in a laboratory"
        kind, words = "speed", f"the mass would slide at {slide.speed:.3g} m/s, faster {than}"
    elif mu is not None and (mu not in FRICTION or is_rare):
        kind, words = "friction", _friction_text(run, slide)
    elif mu is not None and slide.travel not in TRAVEL:
        kind, words = "scale", f"the mass would slide {slide.travel:.3g} m without a stop"
    if kind:
        hint, correction, grade = _correction(slide, header)
        yield Finding(kind, f"{words}; {hint}", correction, grade=ERROR if slide.speed > RAIL_SPEED else grade)
    elif header is not None and _holds_ms_and_mm(slide):
        seconds, line = float(run.displacement.t[-1] - run.displacement.t[0]), _unit_text(MS_AND_MM, header)
        words = f"{_friction_text(run, slide)}, over {slide.travel:.3g} m in {seconds:.3g} s"
        yield Finding("friction", f"{words}; probably {line}", line)
    elif mu is not None and not run.has_incline and run.mass is not None:
        energy = run.mass * slide.speed**2 / 2
        if energy not in BLOW_ENERGY:
            grams = f'mass = "{run.mass:g} g"' if run.mass > 1.0 else ""
            likely = f"; if grams were meant give {grams}" if grams else ""
            words = (
                f"a mass of {run.mass:g} kg at {slide.speed:.3g} m/s has {energy:.3g} J, more than a blow gives "
                f"({BLOW_ENERGY.high:g} J){likely}; check mass, scale and fps"
            )
            yield Finding("mass", words, grams)


def _holds_ms_and_mm(slide: SlideEstimate) -> bool:
    """Whether a long slide with hardly any friction is a usual one in ms and mm; its speed is the same in both."""
    if slide.friction is None or slide.friction >= MIN_ROLLING or slide.travel < MIN_TRAVEL_MS_MM:
        return False
    return 1e3 * slide.friction in DRY_FRICTION and 1e-3 * slide.travel in USUAL_TRAVEL


def _check_measured_friction(run: Run, header: Callable[[str], str]) -> Iterator[Finding]:
    """Check a measured friction force: its sign, where it is idle, and its size against the stated load."""
    if run.friction_N is None:
        return
    moving = np.flatnonzero(is_moving(run) & np.isfinite(run.friction_N))
    if len(moving) >= MIN_FRAMES:
        yield from _check_sign(np.asarray(run.friction_N)[moving], run.motion.v[moving], header)
        if run.free is None:
            yield from _check_idle_ends(np.asarray(run.friction_N)[moving], run.motion.t[moving])
    if run.normal_load is None:
        return
    ratio = float(np.nanmedian(np.abs(run.friction_N[run.displacement.valid]))) / run.normal_load
    if ratio not in FRICTION and ratio != 0.0:
        unit = next((name for name, size in FORCES if ratio * size in FRICTION), "")
        line = _unit_text({"friction": unit}, header) if unit else ""
        likely = f"; probably {line}" if unit else ""
        words = f"the measured friction is {ratio:.3g} times the normal load of {run.normal_load:g} N{likely}"
        yield Finding("friction", words, line.partition("give ")[2])


def _check_sign(force: Array, v: Array, header: Callable[[str], str]) -> Iterator[Finding]:
    """Check that friction takes energy from the motion: over all frames, the sum of F v is positive.

    Elastic energy that comes back, as after every reversal of a compliant set-up, cancels over a cycle.
    """
    power, exchanged = float(force @ v), float(np.abs(force) @ np.abs(v))
    if power < -MIN_SHARE_EACH_WAY * exchanged:
        words = (
            f"the measured friction drives the mass (its power is negative, {100 * power / exchanged:.0f} % of what "
            "|F||v| gives), so it has the sign of the force on the mass; frictrack takes the force against the motion: "
            f'write a minus before the header of its column, friction = "-{header("friction")}"'
        )
        yield Finding("friction", words, f'columns = {{friction = "-{header("friction")}"}}', grade=ERROR)


def _check_idle_ends(force: Array, t: Array) -> Iterator[Finding]:
    """Find a start or an end where the mass moves and nothing rubs yet, or any more."""
    usual = float(np.median(np.abs(force)))
    rubs = np.flatnonzero(np.abs(force) > IDLE_SHARE * usual)
    half = np.flatnonzero(np.abs(force) > 0.5 * usual)
    if not len(half):
        return
    ends = np.array([t[0], t[-1]])
    # the force rises from nothing to its half as long as it then takes to its whole
    begin = 2 * t[half[0]] - t[rubs[0]] if rubs[0] >= MIN_IDLE_SHARE * len(t) else ends[0]
    stop = 2 * t[half[-1]] - t[rubs[-1]] if len(t) - 1 - rubs[-1] >= MIN_IDLE_SHARE * len(t) else ends[1]
    if ends[0] < begin < stop or begin < stop < ends[1]:
        idle = [f"{ends[0]:.3g} to {t[rubs[0]]:.3g} s"] if begin > ends[0] else []
        idle += [f"{t[rubs[-1]]:.3g} to {ends[1]:.3g} s"] if stop < ends[1] else []
        line = f"free = [{begin:.4g}, {stop:.4g}]"
        words = f"it moves without friction from {' and '.join(idle)} (no contact, or slack?); leave that out: {line}"
        yield Finding("friction", words, line)


def _friction_text(run: Run, slide: SlideEstimate) -> str:
    """Say how large the friction coefficient would be, and what has more or less."""
    assert slide.friction is not None
    out = f"the friction coefficient would be {slide.friction:.3g} (friction slows by {slide.deceleration:.3g} m/s^2)"
    if slide.friction > DRY_FRICTION.high:
        load = "normal load" if run.normal_load is not None else "weight"
        pressed = "" if run.normal_load is not None else ", unless something presses it on (then give normal_load)"
        return f"{out} at {slide.speed:.3g} m/s, where dry solids have at most 1.5 times the {load}{pressed}"
    return f"{out}, less than {'on an air bearing' if slide.friction < FRICTION.low else 'in a ball bearing'}"


def _correction(slide: SlideEstimate, header: Callable[[str], str] | None) -> tuple[str, str, str]:
    """Likely correction of the units as a sentence and alone; an error where it must be a factor of a thousand."""
    units: Sequence[tuple[float, float, Any]] = FILM_UNITS if header is None else TABLE_UNITS
    fitting = [
        (made.rarity, what, max(length, 1 / length, time, 1 / time))
        for length, time, what in units
        if (made := slide.scaled(length, time)).is_possible
    ]
    if not fitting:
        return ("check scale and fps" if header is None else "check the units of the table's columns"), "", WARNING
    what, grade = min(fitting, key=itemgetter(0))[1], ERROR if all(f[2] >= UNIT_STEP for f in fitting) else WARNING
    words = what if header is None else _unit_text(what, header)
    return f"probably {words}", words, grade


def _unit_text(units: Mapping[str, str], header: Callable[[str], str]) -> str:
    """Say what the columns of a table hold, by unit, and what to enter then."""
    held = " and ".join(f"{header(k)} {'' if n else 'holds '}{unit}" for n, (k, unit) in enumerate(units.items()))
    given = ", ".join(f'{key} = "{header(key)} ({unit})"' for key, unit in units.items())
    return f"{held}: give columns = {{{given}}}"
