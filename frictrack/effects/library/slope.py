"""Slope: the course is not level, gravity pulls along it."""

import numpy as np

from frictrack.base.number_format import format_number
from frictrack.effects.definition import Array, DirectCheck, EffectInStudy, Nonlinear, Parameter, Path
from frictrack.effects.ranges import LEVEL_STD_RAD


def columns(path: Path, nonlinear: Nonlinear) -> Array:
    """m/m_ref, shape (n, 1): N per N of F at the reference mass; times the cosine of the angle on an upright circle."""
    tilt = np.cos(path.curvature * (path.x - path.lowest)) if path.upright else 1.0
    return np.broadcast_to(path.mass_ratio * tilt, path.t.shape)[:, None]


def describe(effect: EffectInStudy) -> str:
    """Incline that would make the force, and the stated one."""
    stated, lean = effect.stated_incline, effect.value("F") / effect.reference_weight
    angle = np.arcsin(np.clip(np.sin(stated) + lean, -1.0, 1.0))
    digits = max(1 - int(np.floor(np.log10(max(abs(np.rad2deg(angle - stated)), 1e-9)))), 1)  # that show the difference
    was, found = (f"{np.rad2deg(one):.{digits}f}".rstrip("0").rstrip(".") for one in (stated, angle))
    return (
        f"the incline is {found} degrees, not {was}: the course rises toward +x by {format_number(1e3 * lean)} mm in a "
        "metre more than stated"
    )


def level_signal(effect: EffectInStudy) -> float:
    """Return chi-squared of the incline at a spirit level."""
    return (effect.rms("F") / (effect.reference_weight * LEVEL_STD_RAD)) ** 2


equation = "F m/m_ref"
parameters = (Parameter("F", "N", linear=True),)
varies_with = ""
scales_with = "mass"
what = "The course is tilted, or a constant force pulls one way."
looks_like = "forward runs slow faster than reversed ones, by the same deceleration whatever the mass"
mistaken_for = "Coulomb friction in one direction, asymmetry, a cable"
confirm = "Lay a level on the course; no film can part a slope from a constant pull."
invariant = "a slope pulls one way, with the same acceleration on every mass"
settled_by = "lay a level on the course"
direct_check = DirectCheck(
    "level", "Lay a level on the course, or measure how far its ends stand above the table", level_signal
)
in_base_law = True
same_cause_as = "incline"
source = "textbook: F = m g sin(alpha)"
