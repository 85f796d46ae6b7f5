"""Explain why a planned run separates two causes: what each cause keeps when a run is made differently."""

from __future__ import annotations

from collections.abc import Sequence

INVARIANTS = {
    "stribeck": "the Stribeck effect is strong only where the mass is slow",
    "viscous": "viscous friction goes with the speed",
    "drag": "drag goes with the square of the speed",
    "vibration": "a vibration keeps its frequency in time and its size in newtons",
    "decaying_vibration": "ringing dies away with the time since release, wherever the mass is",
    "beam_vibration": "the beam's tone falls toward its free end, and a heavier mass lowers it",
    "texture": "texture keeps its places on the course",
    "patch": "a patch keeps its place on the course",
    "spring": "a spring pulls by place, whichever way the mass goes",
    "collision": "a blow comes at a moment of its own",
    "thermal": "warming and running-in go with the distance slid",
    "drift": "drift goes with the time since release",
    "asymmetry": "asymmetry belongs to the direction and grows with the load or the speed",
    "slope": "a slope pulls one way, as hard on every kilogram",
    "load_modulation": "a modulated load goes with the dry friction, and so with the mass",
    "measured_load": "the load follows the vertical motion",
    "viscous_modulation": "modulated viscous friction goes with the speed",
    "drive_error": "an error of the drive follows the drive",
    "lens": "the lens bends the picture by place, at every speed alike",
    "peak_locking": "peak locking follows the pixel, not the course",
    "camera_shake": "a shaking camera moves the picture as far whatever slides",
    "dropped_frame": "a lost frame shifts the picture by as far as the mass goes in it",
    "timebase": "a drifting clock feigns a deceleration that grows with the speed",
    "clock_rate": "a wrong clock of one run changes its speeds by a factor and its forces by the square of it",
    "target_rotation": "a turning target moves its mark as its angle says",
    "presliding": "presliding needs a reversal",
    "friction_lag": "a lag needs a speed that swings",
    "bouc_wen": "a hysteretic spring remembers its way, whatever the speed",
    "lugre": "LuGre's bristles need a reversal or a slow speed",
    "place": "what is tied to the place comes again at the same place",
    "time since release": "what is tied to the time comes again as long after release",
    "speed": "what is tied to the speed comes again at the same speed",
}
UNSEPARATED = (
    "No candidate run separates {0}: they change the motion in the same way at every speed, mass and direction"
)
OTHER_MEASUREMENTS = {
    frozenset({"slope", "spring"}): "lay a level on the course, and take the cable off",
    frozenset({"slope", "asymmetry"}): "lay a level on the course, and turn the mass round on it",
    frozenset({"slope", "drive_error"}): "lay a level on the course, and hang a known weight on the drive",
    frozenset({"timebase", "drag"}): "film a flashing diode in the same picture",
    frozenset({"timebase", "viscous"}): "film a flashing diode in the same picture",
    frozenset({"lens", "spring"}): "film a rule along the course, and take the cable off",
}  # what settles a pair that no film can part


def explain_separation(names: Sequence[str]) -> str:
    """Return the invariants of the separated causes, joined by commas.

    Examples
    --------
    >>> explain_separation(["drag", "spring"])
    'drag goes with the square of the speed, a spring pulls by place, whichever way the mass goes'

    """
    kept = [INVARIANTS[kind] for kind in dict.fromkeys(n.split(":")[0] for n in names) if kind in INVARIANTS]
    return ", ".join(kept)


def describe_unseparated(names: Sequence[str], confirm: Sequence[str]) -> str:
    """Say that no planned run separates some causes, and what other measurement would."""
    named = " and ".join(names)
    kinds = frozenset(n.split(":")[0] for n in names)
    means = OTHER_MEASUREMENTS.get(kinds) or "; ".join(c.rstrip(".").replace("`", "") for c in confirm if c)
    said = UNSEPARATED.format(named)
    return f"{said}; {means}" if means else said


def describe_separation(groups: Sequence[Sequence[str]]) -> str:
    """Say which causes are separated: "a, b and c apart", or "a from b or c" where some stay together.

    Examples
    --------
    >>> describe_separation([["drag"], ["spring"]])
    'drag and spring apart'
    >>> describe_separation([["lens"], ["drag", "timebase"]])
    'lens from drag or timebase'

    """
    if all(len(group) == 1 for group in groups):
        *most, last = (group[0] for group in groups)
        return f"{', '.join(most)} and {last} apart"
    return " from ".join(" or ".join(group) for group in groups)
