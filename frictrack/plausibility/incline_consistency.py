"""Find an incline that is missing or has the wrong sign by runs in both directions, which gravity slows differently.

A mass that slides freely has a = -g sin(theta) - s (f + c |v| / m) toward +x, s being its direction of motion, f and c
its dry and viscous friction. Runs in both directions tell the pull of gravity, even where each of them slows down.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import asin, degrees, sin

import numpy as np

from frictrack.plausibility.finding import ERROR, Finding
from frictrack.plausibility.incline import MAX_PARTNER_SHARE, MAX_PULL_RATIO, sign_error
from frictrack.plausibility.strokes import MIN_SIGMAS, Leg, legs_of
from frictrack.records import GRAVITY, Run

MIN_LEGS = 5  # slides for three numbers and their scatter
# Friction one way over friction the other way, which no dry surface exceeds: snake skin, made for it, has 1.3
# (Hu, Nirody, Scott & Shelley 2009, Proc. Natl. Acad. Sci. 106, 10081).
MAX_DIRECTION_RATIO = 2.0


@dataclass(frozen=True)
class _Pull:
    """The pull toward +x that runs show beyond what was stated, m/s^2, and how they slow each way."""

    value: float
    sigma: float
    forth: float  # m/s^2 by which runs toward +x slow down, less than 0 where they speed up
    back: float

    @property
    def certain(self) -> bool:
        """Whether it differs from 0."""
        return abs(self.value) > MIN_SIGMAS * self.sigma

    @property
    def words(self) -> str:
        """How the runs differ."""
        return f"runs toward +x {_changes(self.forth)} and runs toward -x {_changes(self.back)}"


def _changes(slows: float) -> str:
    return f"{'slow down' if slows > 0 else 'speed up'} by {abs(slows):.2g} m/s^2"


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
    pull = _pull(free)
    if pull is None or not pull.certain:
        return ()
    incline = stated.pop()
    if any(run.has_incline for run in free):
        return _against(incline, pull)
    ratio = max(pull.forth, pull.back) / max(min(pull.forth, pull.back), 1e-300)
    return (_missing(pull),) if ratio > MAX_DIRECTION_RATIO and abs(pull.value) < GRAVITY else ()


def _pull(runs: Sequence[Run]) -> _Pull | None:
    """What the slides of all runs say by least squares; None where they do not go both ways, or are too few."""
    slides = [(run, leg) for run in runs for leg in legs_of(run) if leg.certain and _slides(leg)]
    s = np.array([leg.direction for _, leg in slides])
    if len(slides) < MIN_LEGS or abs(np.sum(s)) == len(slides):
        return None
    a = np.array([leg.a + GRAVITY * sin(run.incline) for run, leg in slides])
    speed = np.array([_rate(run, leg) for run, leg in slides])
    design = np.stack([np.ones_like(s), -s, -s * speed], axis=1)
    found, _, rank, _ = np.linalg.lstsq(design, a, rcond=1e-9)
    if rank < design.shape[1]:
        return None
    left = float(np.sum((a - design @ found) ** 2) / (len(a) - design.shape[1]))
    sigma = float(np.sqrt(left * np.linalg.inv(design.T @ design)[0, 0]))
    slows = [float(np.mean([-leg.gains for _, leg in slides if leg.direction == way])) for way in (1.0, -1.0)]
    return _Pull(float(found[0]), sigma, *slows)


def _slides(leg: Leg) -> bool:
    """Whether nothing pushes the mass: it slows down, or what speeds it up goes on to the end."""
    return not leg.speeding or leg.partner < MAX_PARTNER_SHARE * leg.way


def _rate(run: Run, leg: Leg) -> float:
    """Speed over mass, to which viscous friction over mass is proportional."""
    assert run.mass is not None
    return leg.usual_speed / run.mass


def _against(incline: float, pull: _Pull) -> tuple[Finding, ...]:
    """What runs in both directions have against a stated incline."""
    stated = -GRAVITY * sin(incline)
    total = stated + pull.value
    if stated * total >= 0 or abs(total) < abs(stated) / MAX_PULL_RATIO:
        return ()
    return (sign_error(incline, pull.words),)


def _missing(pull: _Pull) -> Finding:
    """The incline that runs in both directions suggest."""
    angle = degrees(asin(-pull.value / GRAVITY))
    line = f'incline = "{angle:.2g} deg"'
    rises = "rises" if angle > 0 else "falls"
    words = (
        f"{pull.words}, as on a course that {rises} toward +x by {abs(angle):.2g} deg; measure the angle and give it "
        f"as {line}, or give what else pulls the mass as its drive"
    )
    if min(pull.forth, pull.back) > 0:
        return Finding("incline", words, line, contradicts=True)
    words = f'{words} (if it is free on a level course, plausible = "checked" goes on)'  # no friction speeds a mass up
    return Finding("incline", words, line, grade=ERROR, contradicts=True)
