"""Find an incline that is missing, has the wrong sign, or is too small: by how a mass speeds up without being driven.

On a course that rises by theta toward +x, a mass that nothing drives has a = -g sin(theta) - f sgn(v), f >= 0 being
friction over mass. Motion in both directions gives theta and f. Motion in one direction gives a bound on theta.
"""

from __future__ import annotations

from math import asin, degrees, sin

import numpy as np

from frictrack.plausibility.finding import ERROR, Finding
from frictrack.plausibility.strokes import MIN_SIGMAS, Leg, legs_of, mean, total
from frictrack.records import GRAVITY, Run, Track

MAX_MISFIT = 0.02  # rms off a parabola over the way: a push by hand is not as constant as gravity
MAX_PARTNER_SHARE = (
    0.25  # of its way that a speeding leg may be followed by a smooth slowing down: more is a push, or a spring
)
MIN_SPEEDING_SHARE = 0.4  # of the whole way that must be passed speeding up
MIN_SHARE_EACH_WAY = 0.2  # of the whole way that a direction needs to count
MIN_PUSH_SHARE = 0.05  # of the pull of gravity by which friction would have to push
MAX_PULL_RATIO = 3.0  # by which the pull that the motion shows may differ from the stated one


def missing_incline(run: Run, path_angle: float | None = None) -> Finding | None:
    """Propose an incline where a mass speeds up by itself and none is stated.

    Parameters
    ----------
    run
        A run without an incline, a drive or measured friction; of any other one nothing is said.
    path_angle
        Angle of the path in the picture against the horizontal, rad, where there is a film.

    Returns
    -------
    Finding or None
        A warning. Its `correction` is the line of the study file.

    """
    if run.has_incline or _driven(run):
        return None
    legs = legs_of(run)
    if not _speeds_up(legs):
        return None
    pull, both = _pull(legs)
    if abs(pull) >= GRAVITY:
        words = (
            f"the mass speeds up by itself with {abs(pull):.3g} m/s^2, more than gravity on any course; check scale "
            "and fps, or give the drive that pushes it"
        )
        return Finding("incline", words, "", run.name, contradicts=True)
    return _proposed(run, pull, path_angle, both=both)


def wrong_incline(run: Run) -> Finding | None:
    """Find an incline that contradicts the motion: friction would have to push the mass.

    An error where the opposite sign agrees with the motion, a warning where the incline is too small or too large.
    """
    if not run.has_incline or _driven(run) or run.incline == 0.0:
        return None
    every = legs_of(run)
    legs = tuple(
        leg for leg in every if leg.certain and (leg.partner < MAX_PARTNER_SHARE * leg.way or not leg.speeding)
    )
    slows = bool(legs) and not any(leg.speeding for leg in legs)
    if not (slows or _speeds_up(every)):
        return None
    pull, both = _pull(legs)
    if both:
        return _of_both(run, pull)
    longest = max(legs, key=lambda leg: leg.way)
    return _of_slowing(run, pull, longest) if slows else _of_speeding(run, pull, longest)


def path_angle(track: Track) -> float | None:
    """Angle of a target's path in the picture against the horizontal, rad from 0 to pi/2; None where it is not found.

    Parameters
    ----------
    track
        The target's places; the direction of their largest extent counts.

    Returns
    -------
    float or None
        0 for a level path.

    """
    place = np.stack([track.x_px[track.found], track.y_px[track.found]])
    if place.shape[1] < 2:
        return None
    along = np.linalg.svd(place - np.median(place, axis=1, keepdims=True), full_matrices=False)[0][:, 0]
    return float(np.arctan2(abs(along[1]), abs(along[0])))


def _driven(run: Run) -> bool:
    return run.drive is not None or run.friction_N is not None


def _speeds_up(legs: tuple[Leg, ...]) -> bool:
    """Whether most of the way is passed at a steadily rising speed that nothing but a collision or the end stops."""
    known = tuple(leg for leg in legs if leg.certain)
    alone = tuple(leg for leg in known if leg.speeding and leg.partner < MAX_PARTNER_SHARE * leg.way)
    steady = tuple(leg for leg in alone if leg.gains > 0 and leg.misfit < MAX_MISFIT)
    return bool(steady) and total(steady) > MIN_SPEEDING_SHARE * total(known)


def _toward(legs: tuple[Leg, ...], direction: float) -> tuple[Leg, ...]:
    return tuple(leg for leg in legs if leg.direction == direction)


def _pull(legs: tuple[Leg, ...]) -> tuple[float, bool]:
    """Pull of gravity over mass toward +x, m/s^2, and whether both directions tell it; else a lower bound of it."""
    forth, back = _toward(legs, 1.0), _toward(legs, -1.0)
    if min(total(forth), total(back)) > MIN_SHARE_EACH_WAY * total(legs) and mean(forth) * mean(back) > 0.0:
        return (mean(forth) + mean(back)) / 2, True
    return mean(_toward(legs, max(legs, key=lambda leg: leg.way).direction)), False


def _proposed(run: Run, pull: float, path_angle: float | None, *, both: bool) -> Finding:
    """The incline that the motion, and the path in the picture, suggest."""
    least = asin(min(abs(pull), GRAVITY) / GRAVITY)
    sign = "-" if pull > 0 else ""
    why = f"the mass speeds up by itself with {abs(pull):.3g} m/s^2"
    if both:
        line = f'incline = "{sign}{degrees(least):.2g} deg"'
        words = f"{why} one way and slows down the other way, as on a course that falls; if so, give {line}"
        return Finding("incline", words, line, run.name, contradicts=True)
    if path_angle is not None and abs(path_angle) > least:
        line = f'incline = "{sign}{degrees(abs(path_angle)):.3g} deg"'
        words = (
            f"{why}, and its path in the picture falls by {degrees(abs(path_angle)):.3g} deg; if the camera stood "
            f'level, give {line} and axis = "track"'
        )
        return Finding("incline", words, line, run.name, contradicts=True)
    line = f'incline = "{sign}{degrees(least):.2g} deg"'
    words = (
        f"{why}, as on a course that falls by more than {degrees(least):.2g} deg (without friction); measure the "
        f"angle and give it as {line}, or give the drive that pushes it"
    )
    return Finding("incline", words, line, run.name, contradicts=True)


def _stated(run: Run) -> float:
    """The pull of gravity toward +x that a stated incline gives, m/s^2."""
    return -GRAVITY * sin(run.incline)


def _pushes(run: Run, pull: float, longest: Leg) -> bool:
    """Whether friction would have to push the mass along its longest leg."""
    friction = longest.direction * (_stated(run) - pull)
    return friction < -max(MIN_PUSH_SHARE * abs(_stated(run)), MIN_SIGMAS * longest.sigma_a)


def _of_slowing(run: Run, pull: float, longest: Leg) -> Finding | None:
    """What a mass that slows down in one direction has against a stated incline."""
    if not _pushes(run, pull, longest):
        return None
    what = (
        f"toward {_toward_x(longest.direction)} the mass slows down by only {abs(pull):.3g} m/s^2, where gravity alone "
        f"would slow it by {abs(_stated(run)):.3g}"
    )
    return sign_error(run.incline, what, run.name)


def _of_speeding(run: Run, pull: float, longest: Leg) -> Finding | None:
    """What a mass that speeds up in one direction has against a stated incline."""
    stated = _stated(run)
    if not _pushes(run, pull, longest):
        return None
    if longest.direction * (-stated - pull) >= 0.0 and stated * pull < 0.0:
        return sign_error(run.incline, _sped_up(pull), run.name)
    words = (
        f"the mass speeds up with {abs(pull):.3g} m/s^2, but incline = {degrees(run.incline):.3g} deg gives only "
        f"{abs(stated):.3g} m/s^2; check the angle, the scale and fps"
    )
    return Finding("incline", words, "", run.name, contradicts=True)


def _of_both(run: Run, pull: float) -> Finding | None:
    """What a motion in both directions has against a stated incline."""
    stated = _stated(run)
    if stated * pull < 0 and abs(pull) > abs(stated) / MAX_PULL_RATIO:
        return sign_error(run.incline, _sped_up(pull), run.name)
    if abs(pull) < GRAVITY and not 1 / MAX_PULL_RATIO < pull / stated < MAX_PULL_RATIO:
        line = _line(pull)
        words = (
            f"incline = {degrees(run.incline):.3g} deg gives {abs(stated):.3g} m/s^2 along the course, but the motion "
            f"in both directions shows {abs(pull):.3g} m/s^2; check the angle ({line}), the scale and fps"
        )
        return Finding("incline", words, line, run.name, contradicts=True)
    return None


def _sped_up(pull: float) -> str:
    """What a mass does that gravity pulls along."""
    return f"the mass speeds up toward {_toward_x(pull)} with {abs(pull):.3g} m/s^2 and nothing drives it"


def _toward_x(direction: float) -> str:
    return "+x" if direction > 0 else "-x"


def sign_error(incline: float, what: str, run: str = "") -> Finding:
    """Say that the sign of an incline (rad) is wrong, and `what` of the motion shows it; an error."""
    rises = "rises" if incline > 0 else "falls"
    line = f'incline = "{degrees(-incline):.4g} deg"'
    words = (
        f"incline = {degrees(incline):.4g} deg says that the course {rises} toward +x, but {what}; the sign is "
        f'wrong: give {line} (if something else pushes it, plausible = "checked" goes on)'
    )
    return Finding("incline", words, line, run, ERROR, contradicts=True)


def _line(pull: float) -> str:
    angle = degrees(asin(min(abs(pull), GRAVITY) / GRAVITY))
    return f'incline = "{"-" if pull > 0 else ""}{angle:.2g} deg"'
