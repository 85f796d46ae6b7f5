"""Compare runs with gravity, and with each other: inclines, frame rates, masses, places of swings, accelerometers.

An incline that is missing, has the wrong sign or is too small shows in the acceleration of undriven masses. On a course
that rises by theta toward +x, an undriven mass has a = -g sin(theta) - s (f + c |v| / m) toward +x, where s is its
direction of motion and f >= 0 and c are dry friction over mass and viscous friction. In one run, motion in both
directions determines theta and f, and motion in one direction gives a bound on theta. Several runs determine the pull
of gravity even if each of them decelerates.

A mass (or load, scale, frame rate) may be wrong by a power of ten. Friction proportional to the weight decelerates
all masses alike, a = -mu g, so it hides a wrong mass. A stated normal load shows it, because friction over load,
F = m a, is the same for all runs; and a measured drive, D = m a + F. Without these, a mass that differs from the others
by an exact power of ten only gives a warning.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import chain
from math import asin, degrees
from typing import Any, NamedTuple

import numpy as np
from scipy.signal import find_peaks

from frictrack.measure.friction import has_measured_force, is_moving
from frictrack.measure.plausibility.slide import (
    ACCEPTED,
    CORRELATION_FACTOR,
    ERROR,
    MIN_SHARE_EACH_WAY,
    MIN_SIGMAS,
    WARNING,
    Finding,
    Stroke,
    estimate_slide,
    find_strokes,
    fit_columns,
    mean_acceleration,
    total_distance,
)
from frictrack.records import GRAVITY, Array, Run, Track

MAX_MISFIT = 0.02  # rms deviation from a parabola over the distance; a push by hand is less constant
MIN_SPEEDING_SHARE = 0.4  # of the distance that must be covered while accelerating
MIN_PUSH_SHARE = 0.05  # of the pull of gravity by which friction would have to push
MAX_PULL_RATIO = 3.0  # between the pull that the motion shows and the stated one
MIN_STROKES = 5  # strokes, for three parameters and their scatter
# Friction one way over friction the other way, which no dry surface exceeds: snake skin, made for it, has 1.3
# (Hu, Nirody, Scott & Shelley 2009, Proc. Natl. Acad. Sci. 106, 10081).
MAX_DIRECTION_RATIO = 2.0


def missing_incline(run: Run, path_angle: float | None = None) -> Finding | None:
    """Propose an incline where a mass accelerates by itself and none is stated.

    `run`: a run without an incline, a drive or measured friction; other runs give None; `path_angle`: angle of the path
    in the picture to the horizontal, rad; None without a film. Returns a warning; its `correction` is the line for the
    study file.
    """
    strokes = () if run.has_incline or has_measured_force(run) else find_strokes(run)
    if not _accelerates_by_itself(strokes):
        return None
    pull, both = _gravity_pull(strokes)
    line = _incline_line(pull)
    if run.radius:
        line = 'incline = "0 deg"'
        rest = f" on a circle; if that stands upright, give {line}"
    elif abs(pull) >= GRAVITY:
        line, rest = "", ", more than gravity on any course; check scale and fps, or give the drive that pushes it"
    elif both:
        rest = f" one way and slows down the other way, as on a course that falls; if so, give {line}"
    elif path_angle is not None and abs(path_angle) > asin(abs(pull) / GRAVITY):
        fall = f"{degrees(abs(path_angle)):.3g} deg"
        line = f'incline = "{"-" if pull > 0 else ""}{fall}"'
        rest = (
            f', and its path in the picture falls by {fall}; if the camera stood level, give {line} and axis = "track"'
        )
    else:
        rest = (
            f", as on a course that falls by more than {degrees(asin(abs(pull) / GRAVITY)):.2g} deg (without "
            f"friction); measure the angle and give it as {line}, or give the drive that pushes it"
        )
    return _finding(f"the mass speeds up by itself with {abs(pull):.3g} m/s^2{rest}", line, run.name)


def wrong_incline(run: Run) -> Finding | None:
    """Find a stated incline that contradicts the motion, because friction would have to push the mass.

    `run`: a run with an incline; driven runs give None. Returns an error if the opposite sign agrees with the motion; a
    warning if the incline is too small or too large.
    """
    if not run.has_incline or has_measured_force(run) or run.straight_incline == 0.0:
        return None
    every = find_strokes(run)
    strokes = tuple(stroke for stroke in every if stroke.is_significant and stroke.is_free)
    slows_down = bool(strokes) and not any(stroke.is_accelerating for stroke in strokes)
    if not (slows_down or _accelerates_by_itself(every)):
        return None
    (pull, both), stated = _gravity_pull(strokes), run.pull
    entered, least = f"incline = {degrees(run.incline):.3g} deg", MIN_PUSH_SHARE * abs(stated)
    toward = f"the mass speeds up toward {_toward_x(pull)} with {abs(pull):.3g} m/s^2 and nothing drives it"
    contradiction, words, line = "", "", ""  # of the sign, or of the size alone
    if both:  # friction must not push the mass in either direction
        if stated * pull < 0 and abs(pull) > abs(stated) / MAX_PULL_RATIO:
            contradiction = toward
        elif abs(pull) < GRAVITY and any(_is_pushed(run, strokes, way, least) for way in (1.0, -1.0)):
            line = _incline_line(pull)
            words = (
                f"{entered} gives {abs(stated):.3g} m/s^2 along the course, but the motion in both directions shows "
                f"{abs(pull):.3g} m/s^2; check the angle ({line}), the scale and fps"
            )
    else:
        longest = max(strokes, key=lambda stroke: stroke.distance)  # along which friction must not push the mass
        way = longest.direction
        if way * (stated - pull) >= -max(least, MIN_SIGMAS * longest.sigma_a):
            return None
        if slows_down:
            slowing = f"toward {_toward_x(way)} the mass slows down by only {abs(pull):.3g} m/s^2"
            contradiction = f"{slowing}, where gravity alone would slow it by {abs(stated):.3g}"
        elif way * (-stated - pull) >= 0.0 and stated * pull < 0.0:
            contradiction = toward
        else:
            words = f"the mass speeds up with {abs(pull):.3g} m/s^2, but {entered} gives only {abs(stated):.3g} m/s^2"
            words += "; check the angle, the scale and fps"
    if contradiction:
        return _sign_error(run.incline, contradiction, run.name)
    return _finding(words, line, run.name) if words else None


def _is_pushed(run: Run, strokes: tuple[Stroke, ...], way: float, least: float) -> bool:
    """Whether friction would have to push the mass in one direction of motion, by more than `least`, m/s^2."""
    same = tuple(stroke for stroke in strokes if stroke.direction == way)
    sigma = sum(stroke.sigma_a**-2.0 for stroke in same) ** -0.5 + GRAVITY * run.sigma_incline
    return way * (mean_acceleration(same) - run.pull) > max(least, MIN_SIGMAS * sigma)


def path_angle(track: Track) -> float | None:
    """Angle of a target's path in the picture to the horizontal.

    `track`: positions of the target; the direction of their largest extent counts. Returns the angle from 0 (level) to
    pi/2, rad; None if the target was not found in two frames.
    """
    place = np.stack([track.x_px[track.found], track.y_px[track.found]])
    if place.shape[1] < 2:
        return None
    direction = np.linalg.svd(place - np.median(place, axis=1, keepdims=True), full_matrices=False)[0][:, 0]
    return float(np.arctan2(abs(direction[1]), abs(direction[0])))


def implausible_inclines(runs: Sequence[Run]) -> tuple[Finding, ...]:
    """Find one incline of all runs that is missing or has the wrong sign.

    `runs`: all runs of a study; driven ones and those whose friction was measured are left out. Returns at most one: an
    error where the opposite sign agrees with the motion. Where no incline is stated, an error if runs speed up one way,
    and a warning if they slow down more than twice as much one way as the other.

    Examples
    --------
    >>> implausible_inclines([])
    ()

    """
    free = [run for run in runs if not has_measured_force(run) and run.mass and not run.radius]
    stated = {run.incline for run in free}
    found = _fit_pull(free) if len(stated) == 1 else None
    if found is None:
        return ()
    pull, forth, back = found
    changes = [f"{'slow down' if a > 0 else 'speed up'} by {abs(a):.2g} m/s^2" for a in (forth, back)]
    words = "runs toward +x {} and runs toward -x {}".format(*changes)
    if any(run.has_incline for run in free):
        incline = stated.pop()
        gravity = free[0].pull
        is_opposite = gravity * (gravity + pull) < 0 and abs(gravity + pull) >= abs(gravity) / MAX_PULL_RATIO
        return (_sign_error(incline, words),) if is_opposite else ()
    least, most = sorted((forth, back))
    if abs(pull) >= GRAVITY or most <= MAX_DIRECTION_RATIO * max(least, 1e-300):
        return ()
    angle, line = degrees(asin(-pull / GRAVITY)), _incline_line(pull)
    words = (
        f"{words}, as on a course that {'rises' if angle > 0 else 'falls'} toward +x by {abs(angle):.2g} deg; measure "
        f"the angle and give it as {line}, or give what else pulls the mass as its drive"
    )
    if least > 0:
        return (_finding(words, line),)
    words = f"{words} (if it is free on a level course, {ACCEPTED})"  # no friction speeds a mass up
    return (_finding(words, line, grade=ERROR),)


def _fit_pull(runs: Sequence[Run]) -> tuple[float, float, float] | None:
    """Fit to all strokes the acceleration toward +x beyond the stated one, and the mean deceleration each way, m/s^2.

    None if it is not significant, or if the strokes do not go both ways or are too few.
    """
    strokes = [(run, one) for run in runs for one in find_strokes(run) if one.is_significant and one.is_free]
    s = np.array([one.direction for _, one in strokes])
    if len(strokes) < MIN_STROKES or abs(np.sum(s)) == len(strokes):
        return None
    a = np.array([one.a - run.pull for run, one in strokes])
    speed = np.array([one.mid_speed / (run.mass or np.nan) for run, one in strokes])  # viscous friction over mass
    design = np.stack([np.ones_like(s), -s, -s * speed], axis=1)
    if np.linalg.matrix_rank(design / np.linalg.norm(design, axis=0), rtol=1e-9) < design.shape[1]:
        return None
    (pull, *_), (sigma, *_), _ = fit_columns(design, a)
    if abs(pull) <= MIN_SIGMAS * sigma:
        return None
    forth, back = (np.mean([-one.speed_gain for _, one in strokes if one.direction == way]) for way in (1.0, -1.0))
    return float(pull), float(forth), float(back)


def _accelerates_by_itself(strokes: tuple[Stroke, ...]) -> bool:
    """Whether the speed rises steadily over most of the distance, until a collision or the end."""
    significant = tuple(stroke for stroke in strokes if stroke.is_significant)
    rising = (s for s in significant if s.is_accelerating and s.is_free and s.speed_gain > 0 and s.misfit < MAX_MISFIT)
    return total_distance(tuple(rising)) > MIN_SPEEDING_SHARE * total_distance(significant)


def _gravity_pull(strokes: tuple[Stroke, ...]) -> tuple[float, bool]:
    """Acceleration by gravity toward +x, m/s^2, and whether both directions determine it; else a lower bound of it."""
    forth, back = (tuple(stroke for stroke in strokes if stroke.direction == way) for way in (1.0, -1.0))
    both = min(total_distance(forth), total_distance(back)) > MIN_SHARE_EACH_WAY * total_distance(strokes)
    if both and mean_acceleration(forth) * mean_acceleration(back) > 0.0:
        return (mean_acceleration(forth) + mean_acceleration(back)) / 2, True
    longest = max(strokes, key=lambda stroke: stroke.distance)
    return mean_acceleration(forth if longest.direction > 0 else back), False


def _toward_x(direction: float) -> str:
    return "+x" if direction > 0 else "-x"


def _sign_error(incline: float, what: str, run: str = "") -> Finding:
    """The error that an incline has the wrong sign, as `what` the motion shows tells; no run: of all runs."""
    line = f'incline = "{degrees(-incline):.4g} deg"'
    words = (
        f"incline = {degrees(incline):.4g} deg says that the course {'rises' if incline > 0 else 'falls'} toward +x, "
        f"but {what}; the sign is wrong: give {line} (if something else pushes it, {ACCEPTED})"
    )
    return _finding(words, line, run, ERROR)


def _incline_line(pull: float) -> str:
    """What to enter for an acceleration by gravity toward +x, m/s^2."""
    angle = degrees(asin(min(abs(pull) / GRAVITY, 1.0)))
    return f'incline = "{"-" if pull > 0 else ""}{angle:.2g} deg"'


def _finding(words: str, line: str, run: str = "", grade: str = WARNING) -> Finding:
    return Finding("incline", words, line, run, grade, contradicts=True)


MAX_RELATIVE_DIFFERENCE = 0.01  # of frame rates; forces are then wrong by twice as much
CONTRADICTION = "one of the two is wrong and every force goes with its square"
MIN_OTHER_SETTING = 0.35  # relative difference between runs from which the camera setting differs
TIME_UNITS = {1e3: ("ms", "t_s (ms)"), 1e6: ("us", "t_s (us)"), 1 / 60: ("minutes", "t_s (min)")}  # stated over stamped

MIN_TURNS = 4  # turning points that show a centre and its scatter
SMOOTHED_SHARE = 4  # part of a half swing over which positions are averaged: all turning points come nearer alike
CENTRE_WEIGHTS = np.array([0.25, 0.5, 0.25])  # of three turning points: a decay that is linear cancels
MIN_SWING_SHARE = 0.25  # of the whole travel; a smaller swing back is noise, or the end of a decay
MIN_SHIFT_SIGMAS, MIN_SHIFT_SHARE = 5.0, 0.01  # standard deviations, and share of the travel, of a shift that is said

MAX_GAIN_DIFFERENCE = 0.1  # relative, between runs of one sensor: the scale of each film is in it
MAX_DELAY_DIFFERENCE = 2e-4  # s, in addition to the deviations: jitter of a trigger
SHARE_APART, DELAY_RANGE = 0.1, 0.1  # of the runs that have another delay than the others, and within how many s
MAX_RIVAL_PROBABILITY = 1e-3  # of all other delays together, below which one is common to the runs
MAX_SIGMAS = 5.0


# --- frame rates


def implausible_clocks(runs: Mapping[str, Run], stated: Mapping[str, float | None]) -> tuple[Finding, ...]:
    """Find runs whose time stamps contradict the stated frame rate, or nearly but not quite those of the other runs.

    `stated`: the frame rate that is given of each, Hz; None where none is. Returns at most one per run, or one for all
    where all say the same. Time stamps in another unit are an error.

    Examples
    --------
    >>> implausible_clocks({}, {})
    ()

    """
    rates = {}
    for name, run in runs.items():
        steps = np.diff(run.displacement.t)
        usual = float(np.median(steps))
        if not np.mean(np.abs(steps / usual - 1) < MAX_RELATIVE_DIFFERENCE) < 0.5:
            rates[name] = run.displacement.stamped_rate or 1.0 / usual
    median_rate = float(np.median(list(rates.values()))) if len(rates) > 2 else float("nan")
    checked = (_check_rate(name, rate, stated.get(name), median_rate) for name, rate in rates.items())
    found = tuple(filter(None, checked))
    is_one = len(found) == len(runs) > 1 and len({f.words for f in found}) == 1
    return (replace(found[0], run=""),) if is_one else found


def _check_rate(run: str, rate: float, given: float | None, median_rate: float) -> Finding | None:
    """Check the rate of the stamps against the given one, else against the median, which may show which is right."""
    correction, advice = "", f"{CONTRADICTION}; give the true times or frame rate"
    if given is None or abs(rate / given - 1) <= MAX_RELATIVE_DIFFERENCE:
        if not MAX_RELATIVE_DIFFERENCE < abs(rate / median_rate - 1) < MIN_OTHER_SETTING:
            return None
        words = f"the time stamps say {rate:.5g} Hz where the other runs have {median_rate:.5g} Hz"
    else:
        words = f"the time stamps say {rate:.5g} Hz but fps = {given:.5g} is given"
        if unit := time_unit(given / rate):
            line = f'columns = {{t = "{unit[1]}"}}'
            words = f"{words}; the table's times are in {unit[0]}: give {line}"
            return Finding("fps", words, line, run, ERROR, contradicts=True)
        if abs(given / median_rate - 1) <= MAX_RELATIVE_DIFFERENCE:
            words += f", which the other runs have: its times are probably to be multiplied by {rate / given:.5g}"
        else:
            correction = f"fps = {rate:.5g}"
    return Finding("fps", f"{words}; {advice}", correction, run, contradicts=True)


def time_unit(ratio: float) -> tuple[str, str] | None:
    """Return the unit of time in which stamps agree with a stated rate, and its column heading; None if there is none.

    `ratio` is the stated rate over that of the stamps.
    """
    return next((unit for size, unit in TIME_UNITS.items() if abs(ratio / size - 1) <= MAX_RELATIVE_DIFFERENCE), None)


# --- places about which masses swing


def swing_centre(x: Array) -> tuple[float, float] | None:
    """The place about which a mass swings, and its standard deviation, m; None where it does not swing.

    Of three turning points in a row, (a + 2 b + c) / 4 is the centre, also while dry friction takes as much from every
    half swing.
    """
    width = max(len(x) // (SMOOTHED_SHARE * (len(_turns(x)) + 2)), 1)
    turns = _turns(np.convolve(x, np.ones(width) / width, mode="valid"))
    if len(turns) < MIN_TURNS:
        return None
    centres = np.convolve(turns, CENTRE_WEIGHTS, mode="valid")
    # neighbouring centres differ by a quarter of the sum of four independent errors: half the error of a turning point
    error = 2.0 * np.sqrt(np.mean(np.diff(centres) ** 2))
    weights = np.convolve(np.full(len(centres), 1 / len(centres)), CENTRE_WEIGHTS)  # of the turning points in the mean
    return float(np.mean(centres)), float(error * np.linalg.norm(weights))


def _turns(x: Array) -> Array:
    """Positions at which the mass turns, between which it moves by `MIN_SWING_SHARE` of its travel; not the ends."""
    least = MIN_SWING_SHARE * float(np.ptp(x)) if len(x) else 0.0
    return x[np.sort(np.concatenate([find_peaks(side, prominence=least)[0] for side in (x, -x)]))]


def shifted_swings(positions: Mapping[str, Array]) -> Iterator[tuple[str, str, float]]:
    """Yield a record, the first one that swings, and how far from that one's its swing is centred, m.

    `positions`: positions of each record, m; NaN where unknown.
    """
    known = {name: x[np.isfinite(x)] for name, x in positions.items()}
    centres = {name: found for name, x in known.items() if (found := swing_centre(x)) is not None}
    first = next(iter(centres), "")
    for name, (centre, sigma) in centres.items():
        shift, spread = centre - centres[first][0], np.hypot(sigma, centres[first][1])
        if abs(shift) > max(MIN_SHIFT_SIGMAS * spread, MIN_SHIFT_SHARE * float(np.ptp(known[name]))):
            yield name, first, shift


def different_origins(runs: Mapping[str, Run]) -> tuple[Finding, ...]:
    """Find runs without a drive whose swing is centred elsewhere than that of the first run."""
    free = {name: run.displacement.x for name, run in runs.items() if not has_measured_force(run)}
    found = []
    for name, first, shift in shifted_swings(free):
        line = f'x_offset = "{-1e3 * shift:.4g} mm"'
        advice = f'if it has another origin, give {line}, or [[effect]] spring with per_run = ["x_0"]'
        found.append(Finding("origin", f"{describe_shift(shift, first)}; {advice}", line, name))
    return tuple(found)


def describe_shift(shift: float, first: str) -> str:
    """Say how far a swing is centred from that of the record `first`; the shift is in m."""
    return f"its rest and its turning points lie {1e3 * shift:+.3g} mm from those of {first}"


# --- accelerometers


class _Mode(NamedTuple):
    """One delay and gain that a run allows."""

    offset: float
    gain: float
    sigma_offset: float = 0.0
    sigma_gain: float = 0.0
    probability: float = 1.0

    def agrees(self, other: _Mode, with_delay: bool) -> bool:
        """Whether two runs may have this delay and gain in common."""
        gain = MAX_GAIN_DIFFERENCE * abs(self.gain) + MAX_SIGMAS * np.hypot(self.sigma_gain, other.sigma_gain)
        delay = MAX_DELAY_DIFFERENCE + MAX_SIGMAS * np.hypot(self.sigma_offset, other.sigma_offset)
        near = not with_delay or abs(self.offset - other.offset) < delay
        return bool(near and self.gain * other.gain > 0.0 and abs(self.gain - other.gain) < gain)


def implausible_sensors(clocks: Mapping[str, Mapping[str, Any]]) -> tuple[Finding, ...]:
    """Find runs in which an accelerometer has another sign, gain or delay than in the others, or an ambiguous one.

    `clocks`: alignment of the accelerometer of each run. Where all runs together show one delay, every run must have
    it. Where they do not, because the sensor was started by hand, sign and gain must be the same.
    """
    modes = {run: _modes(clock) for run, clock in clocks.items() if clock.get("gain") is not None}
    clear = {run: those for run, those in modes.items() if len(those) == 1}
    for tried, with_delay in ((modes, True), (clear, False)):
        common = _common(tried, with_delay=with_delay)
        if common is not None:
            found = (_sensor_finding(run, those, common, with_delay=with_delay) for run, those in tried.items())
            return tuple(filter(None, found))
    if len(clear) < 2:
        return ()
    stated = ", ".join(f'{those[0].gain:.3g} in "{run}"' for run, those in clear.items())
    words = f"the gain of the accelerometer differs between the runs: {stated}; one sensor has one: check its mounting"
    return (Finding("sensor", f"{words}, its offset and the scale of each film"),)


def _modes(clock: Mapping[str, Any]) -> list[_Mode]:
    """The stated delay and gain of a run first, then its rivals; the stated deviation holds those, too."""
    rivals, first = clock.get("rivals", ()), clock["offset_s"]
    spread = sum(p * (offset - first) ** 2 for offset, _, p in rivals)
    sigmas = float(np.sqrt(max((clock["sigma_offset_s"] or 0.0) ** 2 - spread, 0.0))), clock["sigma_gain"] or 0.0
    every = [(first, clock["gain"], 1.0 - sum(p for *_, p in rivals)), *rivals]
    return [_Mode(offset, gain, *sigmas, probability) for offset, gain, probability in every]


def _common(modes: Mapping[str, Sequence[_Mode]], *, with_delay: bool) -> _Mode | None:
    """The delay and gain that all runs together leave alone as probable; None if there is none."""
    every = list(chain.from_iterable(modes.values()))
    if not every:
        return None
    logs = np.array([sum(_log_probability(those, mode, with_delay) for those in modes.values()) for mode in every])
    apart = np.array([not mode.agrees(every[np.argmax(logs)], with_delay) for mode in every])
    if np.sum(np.exp(logs[apart] - np.max(logs))) > MAX_RIVAL_PROBABILITY:
        return None
    return min((every[k] for k in np.flatnonzero(~apart)), key=lambda mode: mode.sigma_offset or np.inf)


def _log_probability(those: Sequence[_Mode], mode: _Mode, with_delay: bool) -> float:
    """Log of the probability density of the data of a run, if the sensor has one delay and gain in nearly all runs."""
    weights = np.array([one.probability * one.agrees(mode, False) for one in those])
    sigma = np.hypot(MAX_DELAY_DIFFERENCE / 3.0, [np.hypot(one.sigma_offset, mode.sigma_offset) for one in those])
    z = np.array([one.offset - mode.offset for one in those]) / sigma * with_delay
    density = float(np.sum(weights * np.exp(-0.5 * z**2) / sigma))
    return float(np.log((1.0 - SHARE_APART) * density + SHARE_APART / DELAY_RANGE))


def _sensor_finding(run: str, modes: Sequence[_Mode], common: _Mode, *, with_delay: bool) -> Finding | None:
    """What a run should have instead; None where it has it."""
    agreeing = next((mode for mode in modes if mode.agrees(common, with_delay)), None)
    if len(modes) == 1 and agreeing is not None:
        return None
    first = modes[0]
    words = f"its accelerometer has {-1e3 * first.offset:.4g} ms delay and gain {first.gain:.3g}"
    others = f"the other runs have {-1e3 * common.offset:.4g} ms and {common.gain:.3g}"
    if agreeing is None:
        others = others if with_delay else f"the other runs have gain {common.gain:.3g}"
        return Finding("sensor", f"{words} where {others}: check its mounting, its trigger and the scale", run=run)
    line = f'offset = "{1e3 * common.offset:.4g} ms"'
    possible = "and so may this one" if agreeing is not first else "which settles it"
    return Finding("sensor", f"{words}, but is ambiguous; {others}, {possible}: set {line}", line, run)


# --- masses


MAX_SPREAD_DECADES = 0.2  # within which runs agree, or two numbers differ by a power of ten
EXACT_DECADES = 0.02  # within which two masses differ by exactly a power of ten
MIN_FRAMES = 20
MAX_RELATIVE_STD = 0.1  # of a mass estimated from the drive
UNITS = {3: "x_m holds mm", -6: "t_s holds ms", -3: "t_s holds ms and x_m mm"}  # by the power of ten of m = D/a
MIN_RUNS = 3  # two that agree and a third
UNIT_POWERS = (3, 6)  # of ten: a unit and its thousandth, and the square


def implausible_masses(runs: Sequence[Run]) -> tuple[Finding, ...]:
    """Find runs that disagree with all others by a power of ten.

    `runs`: all runs of a study; fewer than three undriven runs cannot disagree with each other. Returns at most one per
    run, with the value that would agree; an error if the motion shows the power of ten.
    """
    found = [_check_against_drive(run, run.mass) for run in runs if run.drive is not None and run.mass is not None]
    bare = [run for run in runs if run.mass is not None and not has_measured_force(run)]
    slides = [(run, slide.friction) for run in bare if (slide := estimate_slide(run)) and slide.friction is not None]
    for i, (run, friction) in enumerate(slides if len(slides) >= MIN_RUNS else []):
        others = [*slides[:i], *slides[i + 1 :]]
        found.append(
            _check_against_load(run, friction, [other for _, other in others])
            or _check_against_masses(run, [other.mass or 0.0 for other, _ in others])
        )
    return tuple(filter(None, found))


def _check_against_load(run: Run, friction: float, others: Sequence[float]) -> Finding | None:
    """Find a friction coefficient that differs by a power of ten from that of the others, which agree."""
    if np.ptp(np.log10(others)) > MAX_SPREAD_DECADES:
        return None
    common = float(np.median(others))
    power = _power_of_ten(friction / common)
    if not power:
        return None
    why = f"the friction coefficient comes out {friction:.2g} where the other runs have {common:.2g}"
    grade = ERROR if abs(power) in UNIT_POWERS else WARNING
    if run.normal_load is not None and run.mass:
        line = _correction_line(run.mass, power)
        words = f"{why}; the mass of {run.mass:g} kg, or its normal load, is {_times_text(power)}: probably {line}"
        return Finding("mass", words, line, run.name, grade, contradicts=True)
    filmed = run.pixel_pitch is not None
    unit = "its scale" if filmed else "its unit of length"
    clock = f", or its {'fps' if filmed else 'unit of time'} {_times_text(power // 2)}" if power % 2 == 0 else ""
    words = f"{why}; probably {unit} is {_times_text(power)}{clock}"
    return Finding("scale", words, "", run.name, grade, contradicts=True)


def _check_against_masses(run: Run, others: Sequence[float]) -> Finding | None:
    """Find a mass that is that of most other runs but for the decimal point."""
    sharing = [[m for m in others if abs(np.log10(m / one)) < EXACT_DECADES] for one in others]
    shared = max(sharing, key=len)
    power = _power_of_ten((run.mass or 0.0) / float(np.median(shared)), EXACT_DECADES)
    if not power or len(shared) < max(MIN_RUNS - 1, len(others) / 2):
        return None
    line = _correction_line(run.mass or 0.0, power)
    words = (
        f"a mass of {run.mass:g} kg is that of the other runs ({np.median(shared):g} kg) with the decimal point "
        "elsewhere, and friction that goes with the weight cannot show which is right; "
        f"was {line} meant? If not, {ACCEPTED}"
    )
    return Finding("mass", words, line, run.name, contradicts=abs(power) in UNIT_POWERS)


def _correction_line(mass: float, power: int) -> str:
    """What to enter instead of a mass that is wrong by a power of ten."""
    return f'mass = "{mass / 10.0**power:g} kg"'


def _times_text(power: int) -> str:
    return f"{10**power:g} times too large" if power > 0 else f"{10**-power:g} times too small"


def _power_of_ten(ratio: float, tolerance: float = MAX_SPREAD_DECADES) -> int:
    """Power of ten that a ratio is within a tolerance in decades; 0 if it is none."""
    decades = float(np.log10(ratio)) if ratio > 0 else np.inf
    power = round(decades) if np.isfinite(decades) else 0
    return power if abs(decades - power) < tolerance else 0


def _check_against_drive(run: Run, mass: float) -> Finding | None:
    """Find a mass that a measured drive contradicts: D = m a + F s + c v + k x + b by least squares."""
    moving = run.displacement.valid & is_moving(run)
    if np.count_nonzero(moving) < MIN_FRAMES:
        return None
    a = run.motion.a[moving] - run.pull
    x, v, drive = run.motion.x[moving], run.motion.v[moving], np.asarray(run.drive, dtype=float)[moving]
    found, std, _ = fit_columns(np.stack([a, np.sign(v), v, x, np.ones_like(v)], axis=1), drive)
    fitted, is_known = float(found[0]), CORRELATION_FACTOR * std[0] < MAX_RELATIVE_STD * found[0]
    power = _power_of_ten(mass / fitted) if is_known else 0
    if not power:
        return None
    line = _correction_line(mass, power)
    unit = f", or {UNITS[power]}" if power in UNITS and run.pixel_pitch is None else ""
    words = (
        f"the drive accelerates it like {fitted:.3g} kg, but mass = {mass:g} kg; probably {line}, or the drive is "
        f"{_times_text(-power)}{unit}"
    )
    grade = ERROR if _power_of_ten(mass / fitted, EXACT_DECADES) else WARNING
    return Finding("mass", words, line, run.name, grade, contradicts=True)
