"""Predict the evidence of direct checks: measurements that show one cause without filming another run.

Examples are a mark at rest, a rule, a level, a clock and a sensor. If the cause is present, an explanation without it
is refuted by the whole signal, S in chi-squared. If it is absent, an explanation with it may shrink the effect by a
share a, which costs part of the evidence G that the runs give it. The least of (1 - a)^2 G + a^2 S is G S/(G + S).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from frictrack.diagnose.experiments.expected_separation import Explanation
from frictrack.effects import Effect
from frictrack.fit.least_squares import PieceResponse
from frictrack.records import GRAVITY, Array

N_MARKS = 20  # of a rule, or flashes of a diode, that are looked at
FLASH_STD_FRAMES = 0.1  # of a frame, to which a flash or a stamp tells the time
LEVEL_STD_RAD = np.deg2rad(0.05)  # to which a level tells a slope
WEIGHT_RELATIVE_STD = 0.01  # relative, to which a known weight tells a drive
ACCELEROMETER_STD = 0.2  # m/s^2, noise of a frame


@dataclass(frozen=True)
class Check:
    """One direct check: its key, the instruction, and the signal (chi-squared) that a cause would leave in it."""

    key: str
    words: str
    signal: Callable[[Explanation], float]


def direct_checks(one: Explanation, other: Explanation) -> list[tuple[Check, float, float]]:
    """Return the checks that separate two explanations.

    Parameters
    ----------
    one, other
        Two explanations of the same runs.

    Returns
    -------
    list of (Check, float, float)
        Each check with the chi-squared expected if `one` is true and if `other` is true.

    """
    out = []
    for explained, rival in ((one, other), (other, one)):
        for check in _checks_of(explained, rival):
            signal = check.signal(explained)
            absent = explained.gain * signal / max(explained.gain + signal, 1e-12)
            out.append((check, signal, absent) if explained is one else (check, absent, signal))
    return out


def _checks_of(explained: Explanation, rival: Explanation) -> list[Check]:
    effect, other = _effect(explained), _effect(rival)
    if effect.kind == other.kind:
        return []
    found = [CHECK_BY_EFFECT[effect.kind]] if effect.kind in CHECK_BY_EFFECT else []
    if effect.acts_on == "force" and other.acts_on == "measurement":
        found.append(ACCELEROMETER_CHECK)
    return found


def _effect(explanation: Explanation) -> Effect:
    return next(e for e in explanation.solution.problem.model.effects if e.name == explanation.effect)


def _longest(explanation: Explanation) -> PieceResponse:
    return max(explanation.solution.responses, key=lambda r: len(r.piece.t))


def _effect_contribution(explanation: Explanation, response: PieceResponse) -> Array:
    """Contribution of the effect alone along one piece at the frames, (n,): N, or m in the picture."""
    problem, piece = explanation.solution.problem, response.piece
    values, level = problem.layout.values(explanation.solution.p, piece.run)
    path = piece.at_frames(response.motion.x_edge[piece.at], response.motion.v_edge[piece.at], level)
    effect, model = _effect(explanation), problem.model
    if effect.modifies:
        without = type(model)(tuple(e for e in model.effects if e.name != explanation.effect))
        return np.asarray(model.force(path, values) - without.force(path, values))
    blocks = model.force_columns(path, values) if effect.acts_on == "force" else model.measurement_columns(path, values)
    return np.asarray(blocks[explanation.effect] @ model.coefficients(explanation.effect, values))


def _value(explanation: Explanation, parameter: str) -> float:
    """Root mean square over the runs of one parameter of the effect."""
    layout = explanation.solution.problem.layout
    values = [
        layout.values(explanation.solution.p, r)[0][explanation.effect][parameter] for r in range(len(layout.run_names))
    ]
    return float(np.sqrt(np.mean(np.square(values))))


def _in_picture(explanation: Explanation) -> float:
    """Signal of a shift of the whole picture along one run, in units of the noise per frame."""
    response = _longest(explanation)
    return float(np.sum(response.piece.whitened(_effect_contribution(explanation, response)) ** 2))


def _on_rule(explanation: Explanation) -> float:
    """Signal of a bent rule along the course; a line through its marks is scale and position."""
    response = _longest(explanation)
    shift, x = _effect_contribution(explanation, response), response.motion.x_edge[response.piece.at]
    rows = np.linspace(0, len(x) - 1, N_MARKS).astype(int)
    line = np.polyfit(x[rows], shift[rows], 1)
    return float(np.sum(((shift - np.polyval(line, x)) / response.piece.noise)[rows] ** 2))


def _by_clock(explanation: Explanation) -> float:
    """Signal of clock flashes in the picture: with a drifting time base their delay changes."""
    response = _longest(explanation)
    piece, v = response.piece, response.motion.v_edge[response.piece.at]
    rows = np.linspace(0, len(v) - 1, N_MARKS).astype(int)
    late = _effect_contribution(explanation, response)[rows] / np.maximum(np.abs(v[rows]), 1e-3)
    late = late - np.polyval(np.polyfit(piece.t[rows], late, 1), piece.t[rows])
    return float(np.sum((late / (FLASH_STD_FRAMES * np.median(np.diff(piece.t)))) ** 2))


def _by_rate(explanation: Explanation) -> float:
    """Signal of a counter of known rate at the first and the last frame."""
    piece = _longest(explanation).piece
    return float(
        (_value(explanation, "rate") * np.ptp(piece.t) / (FLASH_STD_FRAMES * np.median(np.diff(piece.t)))) ** 2 / 2
    )


def _by_stamps(explanation: Explanation) -> float:
    return (_value(explanation, "frames") / FLASH_STD_FRAMES) ** 2


def _by_level(explanation: Explanation) -> float:
    piece = explanation.solution.problem.pieces[0]
    return (_value(explanation, "F") / (piece.mass / piece.path.mass_ratio * GRAVITY * LEVEL_STD_RAD)) ** 2


def _by_weight(explanation: Explanation) -> float:
    return (_value(explanation, "e") / WEIGHT_RELATIVE_STD) ** 2


def _upward(explanation: Explanation) -> float:
    """Signal of the vertical acceleration of the course, which modulates the load."""
    response = _longest(explanation)
    return (
        0.5
        * len(response.piece.t)
        * (_value(explanation, "depth") * response.piece.path.gravity / ACCELEROMETER_STD) ** 2
    )


def _on_mass(explanation: Explanation) -> float:
    """Signal of the acceleration that the force gives the mass; an error of the picture gives none."""
    response = _longest(explanation)
    return float(np.sum((_effect_contribution(explanation, response) / response.piece.mass / ACCELEROMETER_STD) ** 2))


CHECK_BY_EFFECT = {
    "camera_shake": Check(
        "reference",
        "Film a run with something in the picture that does not move, a mark on the frame, and give it as `reference`",
        _in_picture,
    ),
    "lens": Check("rule", "Film a rule that lies along the course: its marks stand as far apart everywhere", _on_rule),
    "timebase": Check("clock", "Film a flashing diode or a counter of known rate in the same picture", _by_clock),
    "clock_rate": Check("rate", "Look up the frame rate of that run, or film a counter of known rate", _by_rate),
    "dropped_frame": Check("time stamps", "Keep the camera's time stamps, or film a running counter", _by_stamps),
    "target_rotation": Check("second mark", "Follow a second mark at another height of the target", _in_picture),
    "slope": Check("level", "Lay a level on the course, or measure how far its ends stand above the table", _by_level),
    "drive_error": Check("known weight", "Hang a known weight on the drive", _by_weight),
    "load_modulation": Check("course sensor", "Fix an accelerometer to the course, facing upward", _upward),
}
ACCELEROMETER_CHECK = Check("accelerometer", "Fix an accelerometer to the mass and give it as `sensor`", _on_mass)
