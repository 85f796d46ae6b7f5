"""Find the run whose mass (or load, scale, frame rate) was mistyped by a power of ten, by what the other runs show.

Friction that goes with the weight slows all masses alike: a = -mu g, so a wrong mass is absorbed. What tells it:

- a stated normal load: friction over load is the same for all runs, F = m a, so it is off by the mass' own factor,
- friction that goes with the speed and not with the load: its part of the deceleration goes with 1/m, so that its
  coefficient is the same for all runs and a wrong mass shows in it by its own factor,
- a measured drive: D = m a + F.

Without any of these, a mass that is an exact power of ten of all others, which agree, is remarked only.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from frictrack.friction import is_moving
from frictrack.plausibility.finding import ERROR, WARNING, Finding
from frictrack.plausibility.slide import Slide, slide_of
from frictrack.plausibility.strokes import CORRELATION_FACTOR, MIN_SIGMAS
from frictrack.records import GRAVITY, Array, Run

MAX_SPREAD_DECADES = 0.2  # decades within which the other runs agree, or two numbers are the same up to a power of ten
EXACT_DECADES = 0.02  # decades: the same weighing up to a power of ten
MIN_FRAMES = 20
MAX_RELATIVE_STD = 0.1  # relative deviation of a mass that the drive tells
UNITS = {3: "x_m holds mm", -6: "t_s holds ms", -3: "t_s holds ms and x_m mm"}  # by the power of ten of m = D/a
MIN_RUNS = 3  # runs, of which two agree against the third
UNIT_POWERS = (3, 6)  # of ten: steps from a unit to its thousandth, and their squares, where nothing else is likely


@dataclass(frozen=True)
class Weighed:
    """What one run says of its mass: typed (kg), and seen in several ways; None where it cannot be seen.

    Parameters
    ----------
    run
        The run.
    slide
        Its speed and friction.
    rate
        By how much the deceleration rises with the speed, 1/s: friction over mass that goes with the speed.

    """

    run: Run
    slide: Slide
    rate: float | None

    @property
    def mass(self) -> float:
        """The typed mass, kg."""
        return float(self.run.mass or np.nan)

    @property
    def by_speed(self) -> tuple[float, float] | None:
        """Coefficient of friction that goes with the speed (N s/m), and with its square (N s^2/m^2), by this mass."""
        return None if self.rate is None else (self.rate * self.mass, self.rate * self.mass / self.slide.speed)


def implausible_masses(runs: Sequence[Run]) -> tuple[Finding, ...]:
    """Findings on runs that disagree with all others by a power of ten, each with the number that would agree.

    Parameters
    ----------
    runs
        All runs of a study; fewer than three struck or pushed ones cannot disagree with each other.

    Returns
    -------
    tuple of Finding
        At most one per run; an error where the motion shows the power of ten by which the number differs.

    """
    driven = (_of_drive(run) for run in runs if run.drive is not None and run.mass is not None)
    slides = [weighed for run in runs if (weighed := _weighed(run)) is not None]
    return (*(found for found in driven if found), *_among(slides))


def _weighed(run: Run) -> Weighed | None:
    if run.drive is not None or run.friction_N is not None or run.mass is None:
        return None
    slide = slide_of(run)
    return None if slide is None or slide.friction is None else Weighed(run, slide, _rate(run))


def _among(slides: Sequence[Weighed]) -> Iterator[Finding]:
    """What each run has against all others."""
    for i, one in enumerate(slides):
        others = [*slides[:i], *slides[i + 1 :]]
        found = (_by_load(one, others) or _by_mass(one, others)) if len(slides) >= MIN_RUNS else None
        if found is not None:
            yield found


def _by_load(one: Weighed, others: Sequence[Weighed]) -> Finding | None:
    """A friction coefficient that is a power of ten off that of the others, which agree."""
    own, common = one.slide.friction, _common([w.slide.friction for w in others])
    power = _power(own, common)
    if not power:
        return None
    why = f"the friction coefficient comes out {own:.2g} where the other runs have {common:.2g}"
    grade = ERROR if abs(power) in UNIT_POWERS else WARNING
    if one.run.normal_load is not None:
        line = _line(one.mass, power)
        words = f"{why}; the mass of {one.mass:g} kg, or its normal load, is {_times(power)}: probably {line}"
        return Finding("mass", words, line, one.run.name, grade, contradicts=True)
    filmed = one.run.pixel_pitch is not None
    unit = "its scale" if filmed else "its unit of length"
    clock = f", or its {'fps' if filmed else 'unit of time'} {_times(power // 2)}" if power % 2 == 0 else ""
    words = f"{why}; probably {unit} is {_times(power)}{clock}"
    return Finding("scale", words, "", one.run.name, grade, contradicts=True)


def _by_mass(one: Weighed, others: Sequence[Weighed]) -> Finding | None:
    """A mass that is a power of ten off: by friction that goes with the speed, else by the masses of the others."""
    usual = _usual([w.mass for w in others])
    power = _exact_power(one.mass, usual)
    off = _off_by_speed(one, others)
    if off is not None:
        return _by_viscous(one, others, power if power and abs(off - power) < abs(off) else _whole(off))
    if not power:
        return None
    line = _line(one.mass, power)
    words = (
        f"a mass of {one.mass:g} kg is that of the other runs ({usual:g} kg) with the decimal point elsewhere, and "
        f"friction that goes with the weight cannot show which is right; was {line} meant? If not, "
        'plausible = "checked" ends this'
    )
    return Finding("mass", words, line, one.run.name)


def _off_by_speed(one: Weighed, others: Sequence[Weighed]) -> float | None:
    """Decades by which the friction of one run that goes with the speed is off that of the others; None if unknown.

    It may go with the speed or with its square: that counts in which the others agree better.
    """
    known = [w.by_speed for w in others if w.by_speed is not None]
    if one.by_speed is None or not known:
        return None
    found = [(own, each) for own, *each in zip(one.by_speed, *known, strict=True) if _common(each) is not None]
    if not found:
        return None
    own, each = min(found, key=lambda pair: np.ptp(np.log10(pair[1])))
    return float(np.log10(own / np.median(each)))


def _by_viscous(one: Weighed, others: Sequence[Weighed], power: int) -> Finding | None:
    """A mass with which the friction that goes with the speed comes out a power of ten off that of the others.

    Certain where that is a step of units, or the mass differs from one of the others by the same power of ten.
    """
    if not power:
        return None
    line = _line(one.mass, power)
    words = (
        f"mass = {one.mass:g} kg is {_times(power)}: the friction that goes with the speed slows it as it would slow "
        f"{one.mass / 10.0**power:.4g} kg in the other runs; give {line}"
    )
    certain = abs(power) in UNIT_POWERS or any(_exact_power(one.mass, w.mass) == power for w in others)
    return Finding("mass", words, line, one.run.name, ERROR if certain else WARNING, contradicts=True)


def _line(mass: float, power: int) -> str:
    """What to type instead of a mass that is a power of ten off."""
    return f'mass = "{mass / 10.0**power:g} kg"'


def _usual(masses: Sequence[float]) -> float | None:
    """The mass that most runs share; None where less than half of them, or fewer than two, do."""
    shared = [[m for m in masses if abs(np.log10(m / one)) < EXACT_DECADES] for one in masses]
    most = max(shared, key=len, default=[])
    return float(np.median(most)) if len(most) >= max(MIN_RUNS - 1, len(masses) / 2) else None


def _exact_power(own: float, other: float | None) -> int:
    """The power of ten by which two weighings differ; 0 where they do not differ by one exactly."""
    power = _power(own, other)
    return power if power and other and abs(np.log10(own / other) - power) < EXACT_DECADES else 0


def _times(power: int) -> str:
    return f"{10**power:g} times too large" if power > 0 else f"{10**-power:g} times too small"


def _common(values: Sequence[float | None]) -> float | None:
    """The median of values that are all known and agree; None where they do not, or are fewer than two."""
    known = np.array([v for v in values if v is not None and v > 0])
    if len(known) < max(len(values), MIN_RUNS - 1) or np.ptp(np.log10(known)) > MAX_SPREAD_DECADES:
        return None
    return float(np.median(known))


def _power(own: float | None, common: float | None) -> int:
    """The power of ten, other than 0, by which two numbers differ; 0 where they do not differ by one."""
    if own is None or common is None or own <= 0:
        return 0
    return _whole(float(np.log10(own / common)))


def _whole(decades: float) -> int:
    """The whole number that decades are; 0 where they are none."""
    power = round(decades)
    return power if abs(decades - power) < MAX_SPREAD_DECADES else 0


def _rate(run: Run) -> float | None:
    """How fast the deceleration rises with the speed, 1/s, over the slowing part; None where it is not certain.

    x = x0 + v0 t - f int int s - c int int v, by least squares: with v the smoothed velocity, the integral of an
    integral of it is known far better than its derivative.
    """
    rows = _slowing(run)
    if len(rows) < MIN_FRAMES:
        return None
    t, x, v = run.motion.t[rows], run.displacement.x[rows], run.motion.v[rows]
    u = t - t[0]
    design = np.stack([np.ones_like(u), u, -np.sign(v[0]) * u**2 / 2, -_twice(u, v)], axis=1)
    scale = np.abs(design).max(axis=0)
    solution = np.linalg.lstsq(design / scale, x, rcond=None)[0]
    left = float(np.sum((x - design / scale @ solution) ** 2) / (len(u) - 4))
    covariance = left * np.linalg.pinv((design / scale).T @ (design / scale))
    rate, std = float(solution[3] / scale[3]), CORRELATION_FACTOR * float(np.sqrt(covariance[3, 3])) / float(scale[3])
    return rate if rate > MIN_SIGMAS * std else None


def _slowing(run: Run) -> Array:
    """Rows of the longest stretch after the highest speed."""
    moving = run.displacement.valid & is_moving(run)
    speed = np.where(moving, np.abs(run.motion.v), 0.0)
    first = int(np.argmax(speed))
    ends = [e[0] for e in run.motion.events if e[0] > first]
    stops = np.flatnonzero(~moving[first:]) + first
    last = min([*ends, *stops[:1].tolist(), len(speed)])
    begin = next((e[1] + 1 for e in run.motion.events if e[0] <= first <= e[1]), first)
    return np.arange(begin, last)


def _twice(t: Array, v: Array) -> Array:
    """The integral of the integral of a velocity (n,), from the first frame."""
    step = np.diff(t)
    once = np.concatenate([[0.0], np.cumsum(step * (v[1:] + v[:-1]) / 2)])
    return np.concatenate([[0.0], np.cumsum(step * (once[1:] + once[:-1]) / 2)])


def _of_drive(run: Run) -> Finding | None:
    """A mass that the measured drive contradicts: D = m a + F s + c v + k x + b, by least squares."""
    assert run.drive is not None
    assert run.mass is not None
    moving = run.displacement.valid & is_moving(run)
    if np.count_nonzero(moving) < MIN_FRAMES:
        return None
    a = run.motion.a[moving] + GRAVITY * np.sin(run.incline)
    x, v, drive = run.motion.x[moving], run.motion.v[moving], np.asarray(run.drive, dtype=float)[moving]
    design = np.stack([a, np.sign(v), v, x, np.ones_like(v)], axis=1)
    scale = np.maximum(np.abs(design).max(axis=0), 1e-300)
    solution = np.linalg.lstsq(design / scale, drive, rcond=None)[0]
    left = float(np.sum((drive - design / scale @ solution) ** 2) / max(len(v) - 5, 1))
    covariance = left * np.linalg.pinv((design / scale).T @ (design / scale))
    seen, std = float(solution[0] / scale[0]), CORRELATION_FACTOR * float(np.sqrt(covariance[0, 0])) / float(scale[0])
    power = _power(run.mass, seen) if seen > 0 and std < MAX_RELATIVE_STD * seen else 0
    if not power:
        return None
    line = _line(run.mass, power)
    unit = f", or {UNITS[power]}" if power in UNITS and run.pixel_pitch is None else ""
    words = (
        f"the drive moves it as a mass of {seen:.3g} kg, but mass = {run.mass:g} kg; probably {line}, or the drive is "
        f"{_times(-power)}{unit}"
    )
    grade = ERROR if _exact_power(run.mass, seen) else WARNING
    return Finding("mass", words, line, run.name, grade, contradicts=True)
