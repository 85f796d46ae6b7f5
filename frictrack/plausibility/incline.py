"""Find an incline that is missing, has the wrong sign or is too small, from the acceleration of an undriven mass.

On a course that rises by theta toward +x, an undriven mass has a = -g sin(theta) - f sgn(v), where f >= 0 is friction
over mass. Motion in both directions determines theta and f; motion in one direction gives a bound on theta.
"""

from __future__ import annotations

from math import asin, degrees, sin

import numpy as np

from frictrack.plausibility.finding import ERROR, Finding
from frictrack.plausibility.strokes import MIN_SIGMAS, Stroke, find_strokes, mean_acceleration, total_distance
from frictrack.records import GRAVITY, Run, Track

MAX_MISFIT = 0.02  # rms deviation from a parabola over the distance; a push by hand is less constant
MAX_PARTNER_SHARE = (
    0.25  # of its way that a speeding leg may be followed by a smooth slowing down: more is a push, or a spring
)
MIN_SPEEDING_SHARE = 0.4  # of the distance that must be covered while accelerating
MIN_SHARE_EACH_WAY = 0.2  # of the distance, for a direction to count
MIN_PUSH_SHARE = 0.05  # of the pull of gravity by which friction would have to push
MAX_PULL_RATIO = 3.0  # between the pull that the motion shows and the stated one


def missing_incline(run: Run, path_angle: float | None = None) -> Finding | None:
    """Propose an incline where a mass accelerates by itself and none is stated.

    Parameters
    ----------
    run
        A run without an incline, a drive or measured friction; other runs give None.
    path_angle
        Angle of the path in the picture to the horizontal, rad; None without a film.

    Returns
    -------
    Finding or None
        A warning; its `correction` is the line for the study file.

    """
    if run.has_incline or _is_driven(run):
        return None
    strokes = find_strokes(run)
    if not _accelerates_by_itself(strokes):
        return None
    pull, both = _gravity_pull(strokes)
    if abs(pull) >= GRAVITY:
        words = (
            f"the mass speeds up by itself with {abs(pull):.3g} m/s^2, more than gravity on any course; check scale "
            "and fps, or give the drive that pushes it"
        )
        return Finding("incline", words, "", run.name, contradicts=True)
    return _propose_incline(run, pull, path_angle, both=both)


def wrong_incline(run: Run) -> Finding | None:
    """Find a stated incline that contradicts the motion, because friction would have to push the mass.

    Parameters
    ----------
    run
        A run with an incline; driven runs give None.

    Returns
    -------
    Finding or None
        An error if the opposite sign agrees with the motion; a warning if the incline is too small or too large.

    """
    if not run.has_incline or _is_driven(run) or run.incline == 0.0:
        return None
    all_strokes = find_strokes(run)
    strokes = tuple(
        stroke
        for stroke in all_strokes
        if stroke.is_significant
        and (stroke.partner_distance < MAX_PARTNER_SHARE * stroke.distance or not stroke.is_accelerating)
    )
    deceleration = bool(strokes) and not any(stroke.is_accelerating for stroke in strokes)
    if not (deceleration or _accelerates_by_itself(all_strokes)):
        return None
    pull, both = _gravity_pull(strokes)
    if both:
        return _check_both_directions(run, pull)
    longest = max(strokes, key=lambda stroke: stroke.distance)
    return _check_deceleration(run, pull, longest) if deceleration else _check_acceleration(run, pull, longest)


def path_angle(track: Track) -> float | None:
    """Angle of a target's path in the picture to the horizontal.

    Parameters
    ----------
    track
        Positions of the target; the direction of their largest extent counts.

    Returns
    -------
    float or None
        Angle from 0 (level) to pi/2, rad; None if the target was not found in two frames.

    """
    place = np.stack([track.x_px[track.found], track.y_px[track.found]])
    if place.shape[1] < 2:
        return None
    direction = np.linalg.svd(place - np.median(place, axis=1, keepdims=True), full_matrices=False)[0][:, 0]
    return float(np.arctan2(abs(direction[1]), abs(direction[0])))


def _is_driven(run: Run) -> bool:
    return run.drive is not None or run.friction_N is not None


def _accelerates_by_itself(strokes: tuple[Stroke, ...]) -> bool:
    """Whether the speed rises steadily over most of the distance, until a collision or the end."""
    significant = tuple(stroke for stroke in strokes if stroke.is_significant)
    without_partner = tuple(
        stroke
        for stroke in significant
        if stroke.is_accelerating and stroke.partner_distance < MAX_PARTNER_SHARE * stroke.distance
    )
    steady = tuple(stroke for stroke in without_partner if stroke.speed_gain > 0 and stroke.misfit < MAX_MISFIT)
    return bool(steady) and total_distance(steady) > MIN_SPEEDING_SHARE * total_distance(significant)


def _strokes_toward(strokes: tuple[Stroke, ...], direction: float) -> tuple[Stroke, ...]:
    return tuple(stroke for stroke in strokes if stroke.direction == direction)


def _gravity_pull(strokes: tuple[Stroke, ...]) -> tuple[float, bool]:
    """Acceleration by gravity toward +x, m/s^2, and whether both directions determine it; else a lower bound of it."""
    forth, back = _strokes_toward(strokes, 1.0), _strokes_toward(strokes, -1.0)
    if (
        min(total_distance(forth), total_distance(back)) > MIN_SHARE_EACH_WAY * total_distance(strokes)
        and mean_acceleration(forth) * mean_acceleration(back) > 0.0
    ):
        return (mean_acceleration(forth) + mean_acceleration(back)) / 2, True
    return mean_acceleration(
        _strokes_toward(strokes, max(strokes, key=lambda stroke: stroke.distance).direction)
    ), False


def _propose_incline(run: Run, pull: float, path_angle: float | None, *, both: bool) -> Finding:
    """Finding with the incline that the motion, and the path in the picture, suggest."""
    min_angle = asin(min(abs(pull), GRAVITY) / GRAVITY)
    sign = "-" if pull > 0 else ""
    why = f"the mass speeds up by itself with {abs(pull):.3g} m/s^2"
    if both:
        line = f'incline = "{sign}{degrees(min_angle):.2g} deg"'
        words = f"{why} one way and slows down the other way, as on a course that falls; if so, give {line}"
        return Finding("incline", words, line, run.name, contradicts=True)
    if path_angle is not None and abs(path_angle) > min_angle:
        line = f'incline = "{sign}{degrees(abs(path_angle)):.3g} deg"'
        words = (
            f"{why}, and its path in the picture falls by {degrees(abs(path_angle)):.3g} deg; if the camera stood "
            f'level, give {line} and axis = "track"'
        )
        return Finding("incline", words, line, run.name, contradicts=True)
    line = f'incline = "{sign}{degrees(min_angle):.2g} deg"'
    words = (
        f"{why}, as on a course that falls by more than {degrees(min_angle):.2g} deg (without friction); measure the "
        f"angle and give it as {line}, or give the drive that pushes it"
    )
    return Finding("incline", words, line, run.name, contradicts=True)


def _stated_pull(run: Run) -> float:
    """Acceleration by gravity toward +x of the stated incline, m/s^2."""
    return -GRAVITY * sin(run.incline)


def _needs_pushing_friction(run: Run, pull: float, longest: Stroke) -> bool:
    """Whether friction would have to push the mass along its longest stroke."""
    friction = longest.direction * (_stated_pull(run) - pull)
    return friction < -max(MIN_PUSH_SHARE * abs(_stated_pull(run)), MIN_SIGMAS * longest.sigma_a)


def _check_deceleration(run: Run, pull: float, longest: Stroke) -> Finding | None:
    """Check a stated incline against a mass that decelerates in one direction."""
    if not _needs_pushing_friction(run, pull, longest):
        return None
    what = (
        f"toward {_toward_x(longest.direction)} the mass slows down by only {abs(pull):.3g} m/s^2, where gravity alone "
        f"would slow it by {abs(_stated_pull(run)):.3g}"
    )
    return sign_error(run.incline, what, run.name)


def _check_acceleration(run: Run, pull: float, longest: Stroke) -> Finding | None:
    """Check a stated incline against a mass that accelerates in one direction."""
    stated = _stated_pull(run)
    if not _needs_pushing_friction(run, pull, longest):
        return None
    if longest.direction * (-stated - pull) >= 0.0 and stated * pull < 0.0:
        return sign_error(run.incline, _acceleration_text(pull), run.name)
    words = (
        f"the mass speeds up with {abs(pull):.3g} m/s^2, but incline = {degrees(run.incline):.3g} deg gives only "
        f"{abs(stated):.3g} m/s^2; check the angle, the scale and fps"
    )
    return Finding("incline", words, "", run.name, contradicts=True)


def _check_both_directions(run: Run, pull: float) -> Finding | None:
    """Check a stated incline against motion in both directions."""
    stated = _stated_pull(run)
    if stated * pull < 0 and abs(pull) > abs(stated) / MAX_PULL_RATIO:
        return sign_error(run.incline, _acceleration_text(pull), run.name)
    if abs(pull) < GRAVITY and not 1 / MAX_PULL_RATIO < pull / stated < MAX_PULL_RATIO:
        line = _correction_line(pull)
        words = (
            f"incline = {degrees(run.incline):.3g} deg gives {abs(stated):.3g} m/s^2 along the course, but the motion "
            f"in both directions shows {abs(pull):.3g} m/s^2; check the angle ({line}), the scale and fps"
        )
        return Finding("incline", words, line, run.name, contradicts=True)
    return None


def _acceleration_text(pull: float) -> str:
    """Say how a mass accelerates along the pull of gravity."""
    return f"the mass speeds up toward {_toward_x(pull)} with {abs(pull):.3g} m/s^2 and nothing drives it"


def _toward_x(direction: float) -> str:
    return "+x" if direction > 0 else "-x"


def sign_error(incline: float, what: str, run: str = "") -> Finding:
    """Make the error that an incline has the wrong sign.

    Parameters
    ----------
    incline
        The stated incline, rad.
    what
        What the motion shows.
    run
        Name of the run; empty for all.

    Returns
    -------
    Finding

    """
    rises = "rises" if incline > 0 else "falls"
    line = f'incline = "{degrees(-incline):.4g} deg"'
    words = (
        f"incline = {degrees(incline):.4g} deg says that the course {rises} toward +x, but {what}; the sign is "
        f'wrong: give {line} (if something else pushes it, set plausible = "checked")'
    )
    return Finding("incline", words, line, run, ERROR, contradicts=True)


def _correction_line(pull: float) -> str:
    angle = degrees(asin(min(abs(pull), GRAVITY) / GRAVITY))
    return f'incline = "{"-" if pull > 0 else ""}{angle:.2g} deg"'
