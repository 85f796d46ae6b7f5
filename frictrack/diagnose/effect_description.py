"""Describe a fitted effect in the numbers of a study: its size, where it is strongest, and what to look for there."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from frictrack.effects import Effect
from frictrack.fit.least_squares import PieceResponse, Solution, position_and_velocity
from frictrack.models import Model
from frictrack.records import GRAVITY, Array, stretches

MIN_SHARE_OF_PEAK = 0.8  # of the largest force of the cause: the middle of the first stretch that reaches it is told
DEGREES_PER_RAD = float(np.rad2deg(1.0))


def describe_effect(effect: Effect, solution: Solution | None = None) -> dict[str, str]:
    """Describe an effect, and its fitted values if there are any.

    Parameters
    ----------
    effect
        The effect to describe.
    solution
        A fit; its numbers are added if its model contains the effect.

    Returns
    -------
    dict of str
        Keys "what", "looks_like" and "confirm". A fitted effect also has "here", with the numbers of this study.

    """
    texts = {"what": effect.what, "looks_like": effect.looks_like, "confirm": effect.confirm}
    if solution is None or effect.name not in solution.problem.model:
        return texts
    fitted = FittedEffect(effect.name, solution)
    describe = DESCRIPTIONS.get(effect.kind)
    parts = [describe(fitted) if describe else "", fitted.strongest()]
    sentence = "; ".join(part for part in parts if part)
    return texts | ({"here": f"{sentence[:1].upper()}{sentence[1:]}."} if sentence else {})


@dataclass(frozen=True)
class FittedEffect:
    """One effect of a fitted model, evaluated along the fitted runs.

    Parameters
    ----------
    name
        Name of the effect in the model.
    solution
        The fit.

    """

    name: str
    solution: Solution

    @property
    def effect(self) -> Effect:
        """The effect as it was fitted, with its bounds and fixed values."""
        return next(e for e in self.solution.problem.model.effects if e.name == self.name)

    @cached_property
    def blocks(self) -> list[Array]:
        """Contribution of the effect at the frames of each piece, (n,): N, or m in the picture."""
        return [self._block(r) for r in self.solution.responses]

    def _block(self, response: PieceResponse) -> Array:
        problem, piece = self.solution.problem, response.piece
        values, level = problem.layout.values(self.solution.p, piece.run)
        x, v = position_and_velocity(response)
        path = piece.at_frames(x, v, level)
        if self.effect.modifies:
            rest = Model(tuple(e for e in problem.model.effects if e.name != self.name))
            return np.asarray(problem.model.force(path, values) - rest.force(path, values))
        on_force = self.effect.acts_on == "force"
        made = (
            problem.model.force_columns(path, values) if on_force else problem.model.measurement_columns(path, values)
        )
        return np.asarray(made[self.name] @ problem.model.coefficients(self.name, values))

    def value(self, parameter: str, run: int | None = None) -> float:
        """Return a parameter's value in one run; by default in the run where the effect is largest."""
        values, _ = self.solution.problem.layout.values(self.solution.p, self.most[0] if run is None else run)
        return float(values[self.name][parameter])

    @cached_property
    def most(self) -> tuple[int, PieceResponse, int]:
        """Run, piece and frame in the middle of the first stretch where the effect is near its largest value."""
        tops = [float(np.max(np.abs(b), initial=0.0)) for b in self.blocks]
        k = int(np.argmax(tops))
        high = stretches(np.abs(self.blocks[k]) >= MIN_SHARE_OF_PEAK * tops[k])[0]
        i = (high.start + high.stop - 1) // 2
        response = self.solution.responses[k]
        return response.piece.run, response, i

    @property
    def run(self) -> str:
        """Name of the run in which the effect is largest."""
        return self.solution.problem.layout.run_names[self.most[0]]

    def strongest(self) -> str:
        """Say where the effect is largest: run, frame, time since release, place, speed and size."""
        _, response, i = self.most
        piece = response.piece
        k = next(n for n, r in enumerate(self.solution.responses) if r is response)
        size = abs(float(self.blocks[k][i]))
        if size == 0:
            return ""
        x, v = position_and_velocity(response)
        if self.effect.acts_on == "force":
            whole = abs(self._total(response)[i])
            how = f"{_num(size)} N of {_num(whole)} N" if whole > size else f"{_num(size)} N"
        else:
            pitch = piece.path.pixel_pitch
            how = _length(size) + (f" ({_num(size / pitch, 2)} px)" if pitch else "")
        where = f"frame {int(piece.frames[i])}, {_num(1e3 * piece.t[i])} ms after release"
        return f"look at run {self.run}, {where}, x = {x[i]:.3f} m at {_num(abs(v[i]), 2)} m/s: {how}"

    def _total(self, response: PieceResponse) -> Array:
        problem, piece = self.solution.problem, response.piece
        values, level = problem.layout.values(self.solution.p, piece.run)
        return np.asarray(problem.model.force(piece.at_frames(*position_and_velocity(response), level), values))

    def passes(self, spot: float) -> str:
        """Say in which frames and at what speeds the first runs pass the place `spot`, m."""
        found = []
        for response in self.solution.responses:
            x, v = position_and_velocity(response)
            over = np.flatnonzero(np.diff(np.sign(x - spot)))
            if len(over):
                i = int(over[0])
                name = self.solution.problem.layout.run_names[response.piece.run]
                found.append(f"{name} in frame {int(response.piece.frames[i])} at {_num(abs(v[i]), 2)} m/s")
        return ", ".join(found[:3])

    def end(self) -> tuple[PieceResponse, float]:
        """Return the longest piece and its last time since release, s."""
        longest = max(self.solution.responses, key=lambda r: float(r.piece.t[-1]))
        return longest, float(longest.piece.t[-1])


def _num(value: float, digits: int = 3) -> str:
    """Format a number with a few significant digits, without an exponent where possible."""
    if value == 0 or not np.isfinite(value):
        return f"{value:g}"
    places = max(digits - 1 - int(np.floor(np.log10(abs(value)))), 0)
    return f"{value:.{places}f}" if 1e-3 <= abs(value) < 1e5 else f"{value:.{digits - 1}e}"


def _length(metres: float) -> str:
    """Format a length in m, mm or µm."""
    size = abs(metres)
    if size >= 0.1:
        return f"{_num(metres)} m"
    return f"{_num(1e3 * metres)} mm" if size >= 1e-4 else f"{_num(1e6 * metres)} µm"


def _swing(fitted: FittedEffect) -> str:
    f = fitted.value("frequency")
    return f"{_num(f)} Hz, one swing every {_num(1e3 / f)} ms in every run"


def _vibration(fitted: FittedEffect) -> str:
    f, mass = fitted.value("frequency"), fitted.most[1].piece.mass
    moved = fitted.value("amplitude") / (mass * (2 * np.pi * f) ** 2)
    return (
        f"{_swing(fitted)}; ± {_num(abs(fitted.value('amplitude')))} N, which moves the mass by ± {_length(abs(moved))}"
    )


def _ringing(fitted: FittedEffect) -> str:
    return f"{_swing(fitted)}, down to a third after {_num(1e3 * fitted.value('tau'))} ms"


def _beam(fitted: FittedEffect) -> str:
    return f"{_num(fitted.value('frequency'))} Hz near the clamp, lower with the mass farther out"


def _modulated_load(fitted: FittedEffect) -> str:
    f, depth = fitted.value("frequency"), abs(fitted.value("depth"))
    lift = depth * GRAVITY / (2 * np.pi * f) ** 2
    return (
        f"{_swing(fitted)}; the load swings by ± {_num(100 * depth, 2)} %, as on a course that moves up and down by ± "
        + (_length(lift))
    )


def _modulated_viscous(fitted: FittedEffect) -> str:
    return f"{_swing(fitted)}; the viscous coefficient swings by ± {_num(100 * abs(fitted.value('depth')), 2)} %"


def _shake(fitted: FittedEffect) -> str:
    size = abs(fitted.value("amplitude"))
    pitch = fitted.most[1].piece.path.pixel_pitch
    px = f" ({_num(size / pitch, 2)} px)" if pitch else ""
    return f"{_swing(fitted)}; everything in the picture would move by ± {_length(size)}{px}"


def _texture(fitted: FittedEffect) -> str:
    period = fitted.value("period")
    return f"a period of {_length(period)}: one mark every {_length(period)} of the course"


def _patch(fitted: FittedEffect) -> str:
    middle, width = fitted.value("x_c"), fitted.value("w")
    past = fitted.passes(middle)
    return f"from x = {middle - 2 * width:.3f} to {middle + 2 * width:.3f} m, the middle passed by {past or 'no run'}"


def _blow(fitted: FittedEffect) -> str:
    mass = fitted.most[1].piece.mass
    lost = abs(fitted.value("J")) / mass
    when = 1e3 * fitted.value("time")
    impulse = _num(abs(fitted.value("J")))
    return f"in run {fitted.run} {_num(when)} ms after release, of {impulse} N s: {_num(lost, 2)} m/s at once"


def _lost(fitted: FittedEffect) -> str:
    when = _num(1e3 * fitted.value("time"))
    return f"in run {fitted.run} {when} ms after release, {_num(fitted.value('frames'), 2)} frames"


def _drag(fitted: FittedEffect) -> str:
    return f"{_num(fitted.value('c'))} N at 1 m/s, four times that at 2 m/s"


def _spring(fitted: FittedEffect) -> str:
    return f"{_num(fitted.value('k'))} N more for every metre toward +x"


def _thermal(fitted: FittedEffect) -> str:
    way = "less" if fitted.value("dF") > 0 else "more"
    size, length = _num(abs(fitted.value("dF"))), _length(fitted.value("length"))
    return f"{size} N {way} in the end, two thirds of it within {length} slid"


def _drift(fitted: FittedEffect) -> str:
    longest, end = fitted.end()
    name = fitted.solution.problem.layout.run_names[longest.piece.run]
    return f"{_num(fitted.value('k') * end)} N by the end of run {name}, {_num(1e3 * end)} ms after release"


def _slope(fitted: FittedEffect) -> str:
    piece = fitted.solution.problem.pieces[0]
    lean = fitted.value("F") / (piece.mass / piece.path.mass_ratio * GRAVITY)
    return (
        f"as a course that rises by {_num(1e3 * lean)} mm in a metre toward +x ({_num(DEGREES_PER_RAD * lean)} degrees)"
    )


def _asymmetry(fitted: FittedEffect) -> str:
    return (
        f"{_num(2 * fitted.value('dF'))} N between the two directions at the reference load, and "
        f"{_num(2 * fitted.value('dF_v'))} N more for every m/s"
    )


def _lens(fitted: FittedEffect) -> str:
    return f"no error at x = {fitted.value('x_c'):.3f} m, growing with the cube of the way from there"


def _locking(fitted: FittedEffect) -> str:
    return f"± {_num(abs(fitted.value('amplitude')), 2)} px, once in every pixel"


def _clock(fitted: FittedEffect) -> str:
    _, end = fitted.end()
    return f"the frame rate would change by {_num(100 * fitted.value('k') * end, 2)} % in the longest run"


def _rate(fitted: FittedEffect) -> str:
    factor = float(np.exp(fitted.value("rate")))
    return f"in run {fitted.run}, whose true times would be its recorded ones times {_num(factor, 4)}"


def _late(fitted: FittedEffect) -> str:
    tau = fitted.value("tau")
    speed = float(np.median(np.abs(position_and_velocity(fitted.most[1])[1])))
    return f"{_num(1e3 * tau)} ms late, {_length(tau * speed)} at {_num(speed, 2)} m/s"


def _turned(fitted: FittedEffect) -> str:
    behind, above = fitted.value("along"), fitted.value("across")
    return f"the followed point would lie {_length(behind)} along and {_length(above)} above the centre of mass"


def _driven(fitted: FittedEffect) -> str:
    return (
        f"the true drive would be {_num(100 * fitted.value('e'))} % larger, {_num(1e3 * fitted.value('tau'))} ms late"
    )


def _hysteresis(fitted: FittedEffect) -> str:
    length = 1.0 / fitted.value("gamma")
    return f"{_num(fitted.value('alpha'))} N/m for small swings, yielding within {_length(length)}"


DESCRIPTIONS: dict[str, Callable[[FittedEffect], str]] = {
    "vibration": _vibration,
    "decaying_vibration": _ringing,
    "beam_vibration": _beam,
    "load_modulation": _modulated_load,
    "viscous_modulation": _modulated_viscous,
    "camera_shake": _shake,
    "texture": _texture,
    "patch": _patch,
    "collision": _blow,
    "dropped_frame": _lost,
    "drag": _drag,
    "spring": _spring,
    "bouc_wen": _hysteresis,
    "thermal": _thermal,
    "drift": _drift,
    "slope": _slope,
    "asymmetry": _asymmetry,
    "lens": _lens,
    "peak_locking": _locking,
    "timebase": _clock,
    "clock_rate": _rate,
    "friction_lag": _late,
    "target_rotation": _turned,
    "drive_error": _driven,
}
