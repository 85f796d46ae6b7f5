"""Find an incline that is missing or has the wrong sign from runs in both directions, which gravity slows differently.

A freely sliding mass has a = -g sin(theta) - s (f + c |v| / m) toward +x, where s is its direction of motion and f and
c are dry friction over mass and viscous friction. Runs in both directions determine the pull of gravity, even if each
of them decelerates.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import asin, degrees, sin

import numpy as np

from frictrack.plausibility.finding import ERROR, Finding
from frictrack.plausibility.incline import MAX_PARTNER_SHARE, MAX_PULL_RATIO, sign_error
from frictrack.plausibility.strokes import MIN_SIGMAS, Stroke, find_strokes
from frictrack.records import GRAVITY, Run

MIN_STROKES = 5  # strokes, for three parameters and their scatter
# Friction one way over friction the other way, which no dry surface exceeds: snake skin, made for it, has 1.3
# (Hu, Nirody, Scott & Shelley 2009, Proc. Natl. Acad. Sci. 106, 10081).
MAX_DIRECTION_RATIO = 2.0


@dataclass(frozen=True)
class _ExtraPull:
    """Acceleration toward +x beyond the stated one, and the mean deceleration in each direction, all m/s^2."""

    value: float
    sigma: float
    forth: float  # m/s^2 by which runs toward +x slow down, less than 0 where they speed up
    back: float

    @property
    def is_significant(self) -> bool:
        """Whether it differs from 0."""
        return abs(self.value) > MIN_SIGMAS * self.sigma

    @property
    def words(self) -> str:
        """How the runs of both directions differ."""
        return f"runs toward +x {_change_text(self.forth)} and runs toward -x {_change_text(self.back)}"


def _change_text(deceleration: float) -> str:
    return f"{'slow down' if deceleration > 0 else 'speed up'} by {abs(deceleration):.2g} m/s^2"


def implausible_inclines(runs: Sequence[Run]) -> tuple[Finding, ...]:
    """Find one incline of all runs that is missing or has the wrong sign.

    Parameters
    ----------
    runs
        All runs of a study; driven ones and those whose friction was measured are left out.

    Returns
    -------
    tuple of Finding
        At most one: an error where the opposite sign agrees with the motion. Where no incline is stated, an error if
        runs speed up one way, and a warning if they slow down more than twice as much one way as the other.

    Examples
    --------
    >>> implausible_inclines([])
    ()

    """
    free = [run for run in runs if run.drive is None and run.friction_N is None and run.mass]
    stated = {run.incline for run in free}
    if len(stated) != 1:
        return ()
    pull = _fit_pull(free)
    if pull is None or not pull.is_significant:
        return ()
    incline = stated.pop()
    if any(run.has_incline for run in free):
        return _contradicts_stated(incline, pull)
    ratio = max(pull.forth, pull.back) / max(min(pull.forth, pull.back), 1e-300)
    return (_missing_incline(pull),) if ratio > MAX_DIRECTION_RATIO and abs(pull.value) < GRAVITY else ()


def _fit_pull(runs: Sequence[Run]) -> _ExtraPull | None:
    """Fit the extra pull to the strokes of all runs; None if they do not go both ways, or are too few."""
    slides = [
        (run, stroke)
        for run in runs
        for stroke in find_strokes(run)
        if stroke.is_significant and _is_free_slide(stroke)
    ]
    s = np.array([stroke.direction for _, stroke in slides])
    if len(slides) < MIN_STROKES or abs(np.sum(s)) == len(slides):
        return None
    a = np.array([stroke.a + GRAVITY * sin(run.incline) for run, stroke in slides])
    speed = np.array([_speed_over_mass(run, stroke) for run, stroke in slides])
    design = np.stack([np.ones_like(s), -s, -s * speed], axis=1)
    found, _, rank, _ = np.linalg.lstsq(design, a, rcond=1e-9)
    if rank < design.shape[1]:
        return None
    residual_variance = float(np.sum((a - design @ found) ** 2) / (len(a) - design.shape[1]))
    sigma = float(np.sqrt(residual_variance * np.linalg.inv(design.T @ design)[0, 0]))
    deceleration = [
        float(np.mean([-stroke.speed_gain for _, stroke in slides if stroke.direction == distance]))
        for distance in (1.0, -1.0)
    ]
    return _ExtraPull(float(found[0]), sigma, *deceleration)


def _is_free_slide(stroke: Stroke) -> bool:
    """Whether nothing pushes the mass: it decelerates, or its acceleration lasts to the end."""
    return not stroke.is_accelerating or stroke.partner_distance < MAX_PARTNER_SHARE * stroke.distance


def _speed_over_mass(run: Run, stroke: Stroke) -> float:
    """Speed over mass, to which viscous friction over mass is proportional."""
    assert run.mass is not None
    return stroke.mid_speed / run.mass


def _contradicts_stated(incline: float, pull: _ExtraPull) -> tuple[Finding, ...]:
    """Finding if runs in both directions contradict a stated incline."""
    stated = -GRAVITY * sin(incline)
    total_pull = stated + pull.value
    if stated * total_pull >= 0 or abs(total_pull) < abs(stated) / MAX_PULL_RATIO:
        return ()
    return (sign_error(incline, pull.words),)


def _missing_incline(pull: _ExtraPull) -> Finding:
    """Finding with the incline that runs in both directions suggest."""
    angle = degrees(asin(-pull.value / GRAVITY))
    line = f'incline = "{angle:.2g} deg"'
    rises = "rises" if angle > 0 else "falls"
    words = (
        f"{pull.words}, as on a course that {rises} toward +x by {abs(angle):.2g} deg; measure the angle and give it "
        f"as {line}, or give what else pulls the mass as its drive"
    )
    if min(pull.forth, pull.back) > 0:
        return Finding("incline", words, line, contradicts=True)
    words = f'{words} (if it is free on a level course, set plausible = "checked")'  # no friction speeds a mass up
    return Finding("incline", words, line, grade=ERROR, contradicts=True)
