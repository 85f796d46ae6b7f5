"""What a measurement beside the film would say of one cause: a mark at rest, a rule, a level, a clock, a sensor.

Such a check shows the cause itself. Where it is there, an explanation without it is refuted by the whole signal S.
Where it is not, an explanation with it may shrink it, at the price of the evidence G that it has: the
least of (1 - a)^2 G + a^2 S is G S/(G + S).
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
    """One measurement beside the film: what to do, and the signal that a cause would leave there, chi-squared."""

    key: str
    words: str
    signal: Callable[[Explanation], float]


def direct_checks(one: Explanation, other: Explanation) -> list[tuple[Check, float, float]]:
    """Checks that tell two explanations apart, each with the evidence expected if `one` and if `other` is true."""
    out = []
    for mine, theirs in ((one, other), (other, one)):
        for check in _of(mine, theirs):
            signal = check.signal(mine)
            absent = mine.gain * signal / max(mine.gain + signal, 1e-12)
            out.append((check, signal, absent) if mine is one else (check, absent, signal))
    return out


def _of(mine: Explanation, theirs: Explanation) -> list[Check]:
    effect, other = _effect(mine), _effect(theirs)
    if effect.kind == other.kind:
        return []
    found = [CHECK_BY_EFFECT[effect.kind]] if effect.kind in CHECK_BY_EFFECT else []
    if effect.acts_on == "force" and other.acts_on == "measurement":
        found.append(ACCELEROMETER_CHECK)
    return found


def _effect(told: Explanation) -> Effect:
    return next(e for e in told.solution.problem.model.effects if e.name == told.effect)


def _longest(told: Explanation) -> PieceResponse:
    return max(told.solution.responses, key=lambda r: len(r.piece.t))


def _block(told: Explanation, response: PieceResponse) -> Array:
    """What the cause itself adds along one run at the frames: N, or m in the picture, (n,)."""
    problem, piece = told.solution.problem, response.piece
    values, level = problem.layout.values(told.solution.p, piece.run)
    path = piece.at_frames(response.motion.x_edge[piece.at], response.motion.v_edge[piece.at], level)
    effect, model = _effect(told), problem.model
    if effect.modifies:
        without = type(model)(tuple(e for e in model.effects if e.name != told.effect))
        return np.asarray(model.force(path, values) - without.force(path, values))
    blocks = model.force_columns(path, values) if effect.acts_on == "force" else model.measurement_columns(path, values)
    return np.asarray(blocks[told.effect] @ model.coefficients(told.effect, values))


def _value(told: Explanation, parameter: str) -> float:
    """Root mean square over the runs of one parameter of the cause."""
    layout = told.solution.problem.layout
    values = [layout.values(told.solution.p, r)[0][told.effect][parameter] for r in range(len(layout.run_names))]
    return float(np.sqrt(np.mean(np.square(values))))


def _in_picture(told: Explanation) -> float:
    """Shift of everything in the picture along one run, against the noise of a frame."""
    response = _longest(told)
    return float(np.sum(response.piece.whitened(_block(told, response)) ** 2))


def _on_rule(told: Explanation) -> float:
    """Bend of a rule along the course: a line through its marks is its scale and place."""
    response = _longest(told)
    shift, x = _block(told, response), response.motion.x_edge[response.piece.at]
    rows = np.linspace(0, len(x) - 1, N_MARKS).astype(int)
    line = np.polyfit(x[rows], shift[rows], 1)
    return float(np.sum(((shift - np.polyval(line, x)) / response.piece.noise)[rows] ** 2))


def _by_clock(told: Explanation) -> float:
    """Flashes of a clock in the picture: those of a drifting time base come earlier and earlier, or later."""
    response = _longest(told)
    piece, v = response.piece, response.motion.v_edge[response.piece.at]
    rows = np.linspace(0, len(v) - 1, N_MARKS).astype(int)
    late = _block(told, response)[rows] / np.maximum(np.abs(v[rows]), 1e-3)
    late = late - np.polyval(np.polyfit(piece.t[rows], late, 1), piece.t[rows])
    return float(np.sum((late / (FLASH_STD_FRAMES * np.median(np.diff(piece.t)))) ** 2))


def _by_rate(told: Explanation) -> float:
    """Flashes of a counter of known rate at the first and the last frame."""
    piece = _longest(told).piece
    return float((_value(told, "rate") * np.ptp(piece.t) / (FLASH_STD_FRAMES * np.median(np.diff(piece.t)))) ** 2 / 2)


def _by_stamps(told: Explanation) -> float:
    return (_value(told, "frames") / FLASH_STD_FRAMES) ** 2


def _by_level(told: Explanation) -> float:
    piece = told.solution.problem.pieces[0]
    return (_value(told, "F") / (piece.mass / piece.path.mass_ratio * GRAVITY * LEVEL_STD_RAD)) ** 2


def _by_weight(told: Explanation) -> float:
    return (_value(told, "e") / WEIGHT_RELATIVE_STD) ** 2


def _upward(told: Explanation) -> float:
    """Vertical acceleration of the course, whose weight on the mass makes the modulation."""
    response = _longest(told)
    return 0.5 * len(response.piece.t) * (_value(told, "depth") * response.piece.path.gravity / ACCELEROMETER_STD) ** 2


def _on_mass(told: Explanation) -> float:
    """Acceleration of the mass by the force: a fault of the picture has none."""
    response = _longest(told)
    return float(np.sum((_block(told, response) / response.piece.mass / ACCELEROMETER_STD) ** 2))


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
