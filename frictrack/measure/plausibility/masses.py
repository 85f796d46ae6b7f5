"""Find a mass (or load, scale, frame rate) that is wrong by a power of ten, by comparison with the other runs.

Friction proportional to the weight decelerates all masses alike, a = -mu g, so it hides a wrong mass. Three things show
it:

- a stated normal load: friction over load is the same for all runs, F = m a, so it is wrong by the factor of the mass;
- friction that depends on the speed and not on the load: its part of the deceleration goes with 1/m, so its coefficient
  is wrong by the factor of the mass;
- a measured drive: D = m a + F.

Without these, a mass that differs from all others by an exact power of ten only gives a warning.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from frictrack.measure.friction import is_moving
from frictrack.measure.plausibility.findings import ERROR, WARNING, Finding
from frictrack.measure.plausibility.slide import (
    CORRELATION_FACTOR,
    MIN_SIGMAS,
    SlideEstimate,
    estimate_slide,
    fit_columns,
)
from frictrack.records import Array, Run

MAX_SPREAD_DECADES = 0.2  # within which runs agree, or two numbers differ by a power of ten
EXACT_DECADES = 0.02  # within which two masses differ by exactly a power of ten
MIN_FRAMES = 20
MAX_RELATIVE_STD = 0.1  # of a mass estimated from the drive
UNITS = {3: "x_m holds mm", -6: "t_s holds ms", -3: "t_s holds ms and x_m mm"}  # by the power of ten of m = D/a
MIN_RUNS = 3  # two that agree and a third
UNIT_POWERS = (3, 6)  # of ten: a unit and its thousandth, and the square


@dataclass(frozen=True)
class _MassEvidence:
    """What one run shows of its mass: its slide, and how its deceleration rises with the speed."""

    run: Run
    mass: float  # as entered, kg
    slide: SlideEstimate
    rate: float | None  # viscous friction over mass, 1/s; None if not significant

    @property
    def viscous_coefficients(self) -> tuple[float, float] | None:
        """Coefficients of friction proportional to v (N s/m) and to v^2 (N s^2/m^2); None if not significant."""
        return None if self.rate is None else (self.rate * self.mass, self.rate * self.mass / self.slide.speed)


def implausible_masses(runs: Sequence[Run]) -> tuple[Finding, ...]:
    """Find runs that disagree with all others by a power of ten.

    `runs`: all runs of a study; fewer than three undriven runs cannot disagree with each other. Returns at most one per
    run, with the value that would agree; an error if the motion shows the power of ten.
    """
    found = [_check_against_drive(run, run.mass) for run in runs if run.drive is not None and run.mass is not None]
    slides = [evidence for run in runs if (evidence := _mass_evidence(run)) is not None]
    for i, one in enumerate(slides if len(slides) >= MIN_RUNS else []):
        others = [*slides[:i], *slides[i + 1 :]]
        found.append(_check_against_load(one, others) or _check_against_masses(one, others))
    return tuple(finding for finding in found if finding is not None)


def _mass_evidence(run: Run) -> _MassEvidence | None:
    if run.drive is not None or run.friction_N is not None or run.mass is None:
        return None
    slide = estimate_slide(run)
    return None if slide is None or slide.friction is None else _MassEvidence(run, run.mass, slide, _viscous_rate(run))


def _check_against_load(one: _MassEvidence, others: Sequence[_MassEvidence]) -> Finding | None:
    """Find a friction coefficient that differs by a power of ten from that of the others, which agree."""
    own, common = one.slide.friction, _agreed_median([w.slide.friction for w in others])
    power = _power_of_ten(own, common)
    if not power:
        return None
    why = f"the friction coefficient comes out {own:.2g} where the other runs have {common:.2g}"
    grade = ERROR if abs(power) in UNIT_POWERS else WARNING
    if one.run.normal_load is not None:
        line = _correction_line(one.mass, power)
        words = f"{why}; the mass of {one.mass:g} kg, or its normal load, is {_times_text(power)}: probably {line}"
        return Finding("mass", words, line, one.run.name, grade, contradicts=True)
    filmed = one.run.pixel_pitch is not None
    unit = "its scale" if filmed else "its unit of length"
    clock = f", or its {'fps' if filmed else 'unit of time'} {_times_text(power // 2)}" if power % 2 == 0 else ""
    words = f"{why}; probably {unit} is {_times_text(power)}{clock}"
    return Finding("scale", words, "", one.run.name, grade, contradicts=True)


def _check_against_masses(one: _MassEvidence, others: Sequence[_MassEvidence]) -> Finding | None:
    """Find a mass that is wrong by a power of ten, from viscous friction or from the masses of the others."""
    shared = _shared_mass([w.mass for w in others])
    power = _exact_power(one.mass, shared)
    decades = _decades_off_by_speed(one, others)
    if decades is not None:
        return _check_against_viscous(
            one, others, power if power and abs(decades - power) < abs(decades) else _whole_decades(decades)
        )
    if not power:
        return None
    line = _correction_line(one.mass, power)
    words = (
        f"a mass of {one.mass:g} kg is that of the other runs ({shared:g} kg) with the decimal point elsewhere, and "
        f"friction that goes with the weight cannot show which is right; was {line} meant? If not, "
        'set plausible = "checked"'
    )
    return Finding("mass", words, line, one.run.name)


def _decades_off_by_speed(one: _MassEvidence, others: Sequence[_MassEvidence]) -> float | None:
    """Decades by which the viscous friction of one run differs from that of the others; None if unknown.

    It may go with the speed or with its square: the one on which the others agree better is used.
    """
    known = [w.viscous_coefficients for w in others if w.viscous_coefficients is not None]
    laws = zip(one.viscous_coefficients, *known, strict=True) if known and one.viscous_coefficients else ()
    agreeing = [(np.ptp(np.log10(each)), own / median) for own, *each in laws if (median := _agreed_median(each))]
    return float(np.log10(min(agreeing)[1])) if agreeing else None


def _check_against_viscous(one: _MassEvidence, others: Sequence[_MassEvidence], power: int) -> Finding | None:
    """Find a mass with which viscous friction differs by a power of ten from that of the others.

    It is an error if that is a step of units, or if the mass differs from one of the others by the same power of ten.
    A mass that other runs share is not mistyped in one of them; there the friction differs.
    """
    is_unit = abs(power) in UNIT_POWERS
    is_shared = any(abs(np.log10(one.mass / w.mass)) < EXACT_DECADES for w in others)
    if not power or (is_shared and not is_unit):
        return None
    line = _correction_line(one.mass, power)
    words = (
        f"mass = {one.mass:g} kg is {_times_text(power)}: friction that depends on the speed slows it as it would slow "
        f"{one.mass / 10.0**power:.4g} kg in the other runs; give {line}"
    )
    is_significant = is_unit or any(_exact_power(one.mass, w.mass) == power for w in others)
    return Finding("mass", words, line, one.run.name, ERROR if is_significant else WARNING, contradicts=True)


def _correction_line(mass: float, power: int) -> str:
    """What to enter instead of a mass that is wrong by a power of ten."""
    return f'mass = "{mass / 10.0**power:g} kg"'


def _shared_mass(masses: Sequence[float]) -> float | None:
    """The mass of most runs; None if less than half of them, or fewer than two, share one."""
    shared = [[m for m in masses if abs(np.log10(m / one)) < EXACT_DECADES] for one in masses]
    largest = max(shared, key=len, default=[])
    return float(np.median(largest)) if len(largest) >= max(MIN_RUNS - 1, len(masses) / 2) else None


def _exact_power(own: float, other: float | None) -> int:
    """Power of ten by which two masses differ; 0 if they do not differ by one exactly."""
    power = _power_of_ten(own, other)
    return power if power and other and abs(np.log10(own / other) - power) < EXACT_DECADES else 0


def _times_text(power: int) -> str:
    return f"{10**power:g} times too large" if power > 0 else f"{10**-power:g} times too small"


def _agreed_median(values: Sequence[float | None]) -> float | None:
    """Median of values that are all known and agree; None if they do not, or are fewer than two."""
    known = np.array([v for v in values if v is not None and v > 0])
    if len(known) < max(len(values), MIN_RUNS - 1) or np.ptp(np.log10(known)) > MAX_SPREAD_DECADES:
        return None
    return float(np.median(known))


def _power_of_ten(own: float | None, common: float | None) -> int:
    """Power of ten by which two numbers differ; 0 if they do not differ by one."""
    if own is None or common is None or own <= 0:
        return 0
    return _whole_decades(float(np.log10(own / common)))


def _whole_decades(decades: float) -> int:
    """Nearest whole number of decades; 0 if none is near."""
    power = round(decades)
    return power if abs(decades - power) < MAX_SPREAD_DECADES else 0


def _viscous_rate(run: Run) -> float | None:
    """Rise of the deceleration with the speed, 1/s, while the mass decelerates; None if not significant.

    It is fitted as x = x0 + v0 t - f int int s - c int int v. The double integral of the smoothed velocity is far less
    noisy than its derivative.
    """
    rows = _decelerating_frames(run)
    if len(rows) < MIN_FRAMES:
        return None
    t, v = run.motion.t[rows], run.motion.v[rows]
    u, moved = t - t[0], _integrated(t, _integrated(t, v))
    design = np.stack([np.ones_like(u), u, -np.sign(v[0]) * u**2 / 2, -moved], axis=1)
    found, std, _ = fit_columns(design, run.displacement.x[rows])
    return float(found[3]) if found[3] > MIN_SIGMAS * CORRELATION_FACTOR * std[3] else None


def _decelerating_frames(run: Run) -> Array:
    """Frames of the longest stretch after the highest speed."""
    moving = run.displacement.valid & is_moving(run)
    speed = np.where(moving, np.abs(run.motion.v), 0.0)
    first = int(np.argmax(speed))
    ends = [e[0] for e in run.motion.events if e[0] > first]
    stops = np.flatnonzero(~moving[first:]) + first
    last = min([*ends, *stops[:1].tolist(), len(speed)])
    begin = next((e[1] + 1 for e in run.motion.events if e[0] <= first <= e[1]), first)
    return np.arange(begin, last)


def _integrated(t: Array, values: Array) -> Array:
    """Integral of values (n,) from the first time (trapezoidal rule)."""
    return np.append(0.0, np.cumsum(np.diff(t) * (values[1:] + values[:-1]) / 2))


def _check_against_drive(run: Run, mass: float) -> Finding | None:
    """Find a mass that a measured drive contradicts: D = m a + F s + c v + k x + b by least squares."""
    moving = run.displacement.valid & is_moving(run)
    if np.count_nonzero(moving) < MIN_FRAMES:
        return None
    a = run.motion.a[moving] - run.pull
    x, v, drive = run.motion.x[moving], run.motion.v[moving], np.asarray(run.drive, dtype=float)[moving]
    found, std, _ = fit_columns(np.stack([a, np.sign(v), v, x, np.ones_like(v)], axis=1), drive)
    fitted, is_known = float(found[0]), CORRELATION_FACTOR * std[0] < MAX_RELATIVE_STD * found[0]
    power = _power_of_ten(mass, fitted) if is_known else 0
    if not power:
        return None
    line = _correction_line(mass, power)
    unit = f", or {UNITS[power]}" if power in UNITS and run.pixel_pitch is None else ""
    words = (
        f"the drive accelerates it like {fitted:.3g} kg, but mass = {mass:g} kg; probably {line}, or the drive is "
        f"{_times_text(-power)}{unit}"
    )
    grade = ERROR if _exact_power(mass, fitted) else WARNING
    return Finding("mass", words, line, run.name, grade, contradicts=True)
