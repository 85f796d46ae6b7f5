"""Find an incline that is missing, has the wrong sign or is too small, from the acceleration of undriven masses.

On a course that rises by theta toward +x, an undriven mass has a = -g sin(theta) - s (f + c |v| / m) toward +x, where s
is its direction of motion and f >= 0 and c are dry friction over mass and viscous friction. In one run, motion in both
directions determines theta and f, and motion in one direction gives a bound on theta. Several runs determine the pull
of gravity even if each of them decelerates.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import asin, degrees

import numpy as np

from frictrack.measure.friction import has_measured_force
from frictrack.measure.plausibility.slide import (
    ERROR,
    MIN_SHARE_EACH_WAY,
    MIN_SIGMAS,
    WARNING,
    Finding,
    Stroke,
    find_strokes,
    fit_columns,
    mean_acceleration,
    total_distance,
)
from frictrack.records import GRAVITY, Run, Track

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
    why = f"the mass speeds up by itself with {abs(pull):.3g} m/s^2"
    if abs(pull) >= GRAVITY:
        check = "more than gravity on any course; check scale and fps, or give the drive that pushes it"
        return _finding(f"{why}, {check}", "", run.name)
    line = _incline_line(pull)
    if both:
        words = f"{why} one way and slows down the other way, as on a course that falls; if so, give {line}"
    elif path_angle is not None and abs(path_angle) > asin(abs(pull) / GRAVITY):
        fall = f"{degrees(abs(path_angle)):.3g} deg"
        line = f'incline = "{"-" if pull > 0 else ""}{fall}"'
        words = (
            f"{why}, and its path in the picture falls by {fall}; if the camera stood level, give {line} and "
            'axis = "track"'
        )
    else:
        words = (
            f"{why}, as on a course that falls by more than {degrees(asin(abs(pull) / GRAVITY)):.2g} deg (without "
            f"friction); measure the angle and give it as {line}, or give the drive that pushes it"
        )
    return _finding(words, line, run.name)


def wrong_incline(run: Run) -> Finding | None:
    """Find a stated incline that contradicts the motion, because friction would have to push the mass.

    `run`: a run with an incline; driven runs give None. Returns an error if the opposite sign agrees with the motion; a
    warning if the incline is too small or too large.
    """
    if not run.has_incline or has_measured_force(run) or run.incline == 0.0:
        return None
    every = find_strokes(run)
    strokes = tuple(stroke for stroke in every if stroke.is_significant and stroke.is_free)
    slows_down = bool(strokes) and not any(stroke.is_accelerating for stroke in strokes)
    if not (slows_down or _accelerates_by_itself(every)):
        return None
    pull, both = _gravity_pull(strokes)
    if both:
        return _check_both_directions(run, pull)
    return _check_one_direction(run, pull, max(strokes, key=lambda stroke: stroke.distance), slows_down=slows_down)


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
    free = [run for run in runs if not has_measured_force(run) and run.mass]
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
    words = f'{words} (if it is free on a level course, set plausible = "checked")'  # no friction speeds a mass up
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


def _check_one_direction(run: Run, pull: float, longest: Stroke, *, slows_down: bool) -> Finding | None:
    """Check a stated incline against a mass that moves one way: friction must not push it along its longest stroke."""
    stated, way = run.pull, longest.direction
    if way * (stated - pull) >= -max(MIN_PUSH_SHARE * abs(stated), MIN_SIGMAS * longest.sigma_a):
        return None
    if slows_down:
        slowing = f"toward {_toward_x(way)} the mass slows down by only {abs(pull):.3g} m/s^2"
        what = f"{slowing}, where gravity alone would slow it by {abs(stated):.3g}"
        return _sign_error(run.incline, what, run.name)
    if way * (-stated - pull) >= 0.0 and stated * pull < 0.0:
        return _sign_error(run.incline, _acceleration_text(pull), run.name)
    words = (
        f"the mass speeds up with {abs(pull):.3g} m/s^2, but incline = {degrees(run.incline):.3g} deg gives only "
        f"{abs(stated):.3g} m/s^2; check the angle, the scale and fps"
    )
    return _finding(words, "", run.name)


def _check_both_directions(run: Run, pull: float) -> Finding | None:
    """Check a stated incline against motion in both directions."""
    stated = run.pull
    if stated * pull < 0 and abs(pull) > abs(stated) / MAX_PULL_RATIO:
        return _sign_error(run.incline, _acceleration_text(pull), run.name)
    if abs(pull) >= GRAVITY or 1 / MAX_PULL_RATIO < pull / stated < MAX_PULL_RATIO:
        return None
    line = _incline_line(pull)
    words = (
        f"incline = {degrees(run.incline):.3g} deg gives {abs(stated):.3g} m/s^2 along the course, but the motion in "
        f"both directions shows {abs(pull):.3g} m/s^2; check the angle ({line}), the scale and fps"
    )
    return _finding(words, line, run.name)


def _acceleration_text(pull: float) -> str:
    return f"the mass speeds up toward {_toward_x(pull)} with {abs(pull):.3g} m/s^2 and nothing drives it"


def _toward_x(direction: float) -> str:
    return "+x" if direction > 0 else "-x"


def _sign_error(incline: float, what: str, run: str = "") -> Finding:
    """The error that an incline has the wrong sign, as `what` the motion shows tells; no run: of all runs."""
    line = f'incline = "{degrees(-incline):.4g} deg"'
    words = (
        f"incline = {degrees(incline):.4g} deg says that the course {'rises' if incline > 0 else 'falls'} toward +x, "
        f'but {what}; the sign is wrong: give {line} (if something else pushes it, set plausible = "checked")'
    )
    return _finding(words, line, run, ERROR)


def _incline_line(pull: float) -> str:
    """What to enter for an acceleration by gravity toward +x, m/s^2."""
    angle = degrees(asin(min(abs(pull) / GRAVITY, 1.0)))
    return f'incline = "{"-" if pull > 0 else ""}{angle:.2g} deg"'


def _finding(words: str, line: str, run: str = "", grade: str = WARNING) -> Finding:
    return Finding("incline", words, line, run, grade, contradicts=True)
