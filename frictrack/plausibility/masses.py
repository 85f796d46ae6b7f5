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

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from frictrack.friction import is_moving
from frictrack.plausibility.finding import ERROR, WARNING, Finding
from frictrack.plausibility.slide import SlideEstimate, estimate_slide
from frictrack.plausibility.strokes import CORRELATION_FACTOR, MIN_SIGMAS
from frictrack.records import GRAVITY, Array, Run

MAX_SPREAD_DECADES = 0.2  # within which runs agree, or two numbers differ by a power of ten
EXACT_DECADES = 0.02  # within which two masses differ by exactly a power of ten
MIN_FRAMES = 20
MAX_RELATIVE_STD = 0.1  # of a mass estimated from the drive
UNITS = {3: "x_m holds mm", -6: "t_s holds ms", -3: "t_s holds ms and x_m mm"}  # by the power of ten of m = D/a
MIN_RUNS = 3  # two that agree and a third
UNIT_POWERS = (3, 6)  # of ten: a unit and its thousandth, and the square


@dataclass(frozen=True)
class MassEvidence:
    """What one run shows of its mass.

    Parameters
    ----------
    run
        The run.
    slide
        Its speed and friction.
    rate
        Rise of the deceleration with the speed, 1/s: viscous friction over mass; None if not significant.

    """

    run: Run
    slide: SlideEstimate
    rate: float | None

    @property
    def mass(self) -> float:
        """The entered mass, kg."""
        return float(self.run.mass or np.nan)

    @property
    def viscous_coefficients(self) -> tuple[float, float] | None:
        """Coefficients of friction proportional to v (N s/m) and to v^2 (N s^2/m^2); None if not significant."""
        return None if self.rate is None else (self.rate * self.mass, self.rate * self.mass / self.slide.speed)


def implausible_masses(runs: Sequence[Run]) -> tuple[Finding, ...]:
    """Find runs that disagree with all others by a power of ten.

    Parameters
    ----------
    runs
        All runs of a study; fewer than three undriven runs cannot disagree with each other.

    Returns
    -------
    tuple of Finding
        At most one per run, with the value that would agree; an error if the motion shows the power of ten.

    """
    driven = (_check_against_drive(run) for run in runs if run.drive is not None and run.mass is not None)
    slides = [weighed for run in runs if (weighed := _mass_evidence(run)) is not None]
    return (*(found for found in driven if found), *_compare_runs(slides))


def _mass_evidence(run: Run) -> MassEvidence | None:
    if run.drive is not None or run.friction_N is not None or run.mass is None:
        return None
    slide = estimate_slide(run)
    return None if slide is None or slide.friction is None else MassEvidence(run, slide, _viscous_rate(run))


def _compare_runs(slides: Sequence[MassEvidence]) -> Iterator[Finding]:
    """Compare each run with all others."""
    for i, one in enumerate(slides):
        others = [*slides[:i], *slides[i + 1 :]]
        found = (
            (_check_against_load(one, others) or _check_against_masses(one, others))
            if len(slides) >= MIN_RUNS
            else None
        )
        if found is not None:
            yield found


def _check_against_load(one: MassEvidence, others: Sequence[MassEvidence]) -> Finding | None:
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


def _check_against_masses(one: MassEvidence, others: Sequence[MassEvidence]) -> Finding | None:
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


def _decades_off_by_speed(one: MassEvidence, others: Sequence[MassEvidence]) -> float | None:
    """Decades by which the viscous friction of one run differs from that of the others; None if unknown.

    It may go with the speed or with its square: the one on which the others agree better is used.
    """
    known = [w.viscous_coefficients for w in others if w.viscous_coefficients is not None]
    if one.viscous_coefficients is None or not known:
        return None
    found = [
        (own, each)
        for own, *each in zip(one.viscous_coefficients, *known, strict=True)
        if _agreed_median(each) is not None
    ]
    if not found:
        return None
    own, each = min(found, key=lambda pair: np.ptp(np.log10(pair[1])))
    return float(np.log10(own / np.median(each)))


def _check_against_viscous(one: MassEvidence, others: Sequence[MassEvidence], power: int) -> Finding | None:
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
    t, x, v = run.motion.t[rows], run.displacement.x[rows], run.motion.v[rows]
    u = t - t[0]
    design = np.stack([np.ones_like(u), u, -np.sign(v[0]) * u**2 / 2, -_integrate_twice(u, v)], axis=1)
    scale = np.abs(design).max(axis=0)
    solution = np.linalg.lstsq(design / scale, x, rcond=None)[0]
    residual_variance = float(np.sum((x - design / scale @ solution) ** 2) / (len(u) - 4))
    covariance = residual_variance * np.linalg.pinv((design / scale).T @ (design / scale))
    rate, std = float(solution[3] / scale[3]), CORRELATION_FACTOR * float(np.sqrt(covariance[3, 3])) / float(scale[3])
    return rate if rate > MIN_SIGMAS * std else None


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


def _integrate_twice(t: Array, v: Array) -> Array:
    """Double integral of a velocity (n,) from the first frame (trapezoidal rule)."""
    step = np.diff(t)
    once = np.concatenate([[0.0], np.cumsum(step * (v[1:] + v[:-1]) / 2)])
    return np.concatenate([[0.0], np.cumsum(step * (once[1:] + once[:-1]) / 2)])


def _check_against_drive(run: Run) -> Finding | None:
    """Find a mass that a measured drive contradicts: D = m a + F s + c v + k x + b by least squares."""
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
    residual_variance = float(np.sum((drive - design / scale @ solution) ** 2) / max(len(v) - 5, 1))
    covariance = residual_variance * np.linalg.pinv((design / scale).T @ (design / scale))
    fitted_mass, std = (
        float(solution[0] / scale[0]),
        CORRELATION_FACTOR * float(np.sqrt(covariance[0, 0])) / float(scale[0]),
    )
    power = _power_of_ten(run.mass, fitted_mass) if fitted_mass > 0 and std < MAX_RELATIVE_STD * fitted_mass else 0
    if not power:
        return None
    line = _correction_line(run.mass, power)
    unit = f", or {UNITS[power]}" if power in UNITS and run.pixel_pitch is None else ""
    words = (
        f"the drive accelerates it like {fitted_mass:.3g} kg, but mass = {run.mass:g} kg; "
        f"probably {line}, or the drive is "
        f"{_times_text(-power)}{unit}"
    )
    grade = ERROR if _exact_power(run.mass, fitted_mass) else WARNING
    return Finding("mass", words, line, run.name, grade, contradicts=True)
