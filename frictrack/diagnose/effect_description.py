"""A candidate in this study's own numbers: how large it is, where in which film it shows, what to look for there."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from frictrack.effects import Effect
from frictrack.fit.least_squares import PieceResponse, Solution, position_and_velocity
from frictrack.models import Model
from frictrack.records import GRAVITY, Array, stretches

STRONG_SHARE = 0.8  # of the largest force of the cause: the middle of the first stretch that reaches it is told
DEGREE = float(np.rad2deg(1.0))


def describe_effect(effect: Effect, solution: Solution | None = None) -> dict[str, str]:
    """What a cause is, what it looks like, how to confirm it, and `here`: this study's numbers once it is fitted."""
    told = {"what": effect.what, "looks_like": effect.looks_like, "confirm": effect.confirm}
    if solution is None or effect.name not in solution.problem.model:
        return told
    seen = FittedEffect(effect.name, solution)
    own = DESCRIPTIONS.get(effect.kind)
    parts = [own(seen) if own else "", seen.strongest()]
    said = "; ".join(part for part in parts if part)
    return told | ({"here": f"{said[:1].upper()}{said[1:]}."} if said else {})


@dataclass(frozen=True)
class FittedEffect:
    """One cause of a fitted law along the fitted runs."""

    name: str
    solution: Solution

    @property
    def effect(self) -> Effect:
        """The cause in the form in which it was fitted."""
        return next(e for e in self.solution.problem.model.effects if e.name == self.name)

    @cached_property
    def blocks(self) -> list[Array]:
        """What it adds in every piece at the frames: N, or m in the picture."""
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
        """A parameter's value in one run; default the one with most of the cause."""
        values, _ = self.solution.problem.layout.values(self.solution.p, self.most[0] if run is None else run)
        return float(values[self.name][parameter])

    @cached_property
    def most(self) -> tuple[int, PieceResponse, int]:
        """Run, piece and frame where the cause is first about as large as it gets."""
        tops = [float(np.max(np.abs(b), initial=0.0)) for b in self.blocks]
        k = int(np.argmax(tops))
        high = stretches(np.abs(self.blocks[k]) >= STRONG_SHARE * tops[k])[0]
        i = (high.start + high.stop - 1) // 2
        response = self.solution.responses[k]
        return response.piece.run, response, i

    @property
    def run(self) -> str:
        """Name of the run that shows most of it."""
        return self.solution.problem.layout.run_names[self.most[0]]

    def strongest(self) -> str:
        """Where it shows: run, frame, time since release, place, speed, and how much it is there."""
        _, response, i = self.most
        piece = response.piece
        k = next(n for n, r in enumerate(self.solution.responses) if r is response)
        size = abs(float(self.blocks[k][i]))
        if size == 0:
            return ""
        x, v = position_and_velocity(response)
        if self.effect.acts_on == "force":
            whole = abs(self._total(response)[i])
            how = f"{_n(size)} N of {_n(whole)} N" if whole > size else f"{_n(size)} N"
        else:
            pitch = piece.path.pixel_pitch
            how = _length(size) + (f" ({_n(size / pitch, 2)} px)" if pitch else "")
        where = f"frame {int(piece.frames[i])}, {_n(1e3 * piece.t[i])} ms after release"
        return f"look at run {self.run}, {where}, x = {x[i]:.3f} m at {_n(abs(v[i]), 2)} m/s: {how}"

    def _total(self, response: PieceResponse) -> Array:
        problem, piece = self.solution.problem, response.piece
        values, level = problem.layout.values(self.solution.p, piece.run)
        return np.asarray(problem.model.force(piece.at_frames(*position_and_velocity(response), level), values))

    def passes(self, spot: float) -> str:
        """When each of the first runs comes past a place: frames and speeds."""
        found = []
        for response in self.solution.responses:
            x, v = position_and_velocity(response)
            over = np.flatnonzero(np.diff(np.sign(x - spot)))
            if len(over):
                i = int(over[0])
                name = self.solution.problem.layout.run_names[response.piece.run]
                found.append(f"{name} in frame {int(response.piece.frames[i])} at {_n(abs(v[i]), 2)} m/s")
        return ", ".join(found[:3])

    def end(self) -> tuple[PieceResponse, float]:
        """The longest piece and its last time since release."""
        longest = max(self.solution.responses, key=lambda r: float(r.piece.t[-1]))
        return longest, float(longest.piece.t[-1])


def _n(value: float, digits: int = 3) -> str:
    """A number of a few digits, without an exponent where digits do."""
    if value == 0 or not np.isfinite(value):
        return f"{value:g}"
    places = max(digits - 1 - int(np.floor(np.log10(abs(value)))), 0)
    return f"{value:.{places}f}" if 1e-3 <= abs(value) < 1e5 else f"{value:.{digits - 1}e}"


def _length(metres: float) -> str:
    size = abs(metres)
    if size >= 0.1:
        return f"{_n(metres)} m"
    return f"{_n(1e3 * metres)} mm" if size >= 1e-4 else f"{_n(1e6 * metres)} µm"


def _swing(seen: FittedEffect) -> str:
    f = seen.value("frequency")
    return f"{_n(f)} Hz, one swing every {_n(1e3 / f)} ms in every run"


def _vibration(seen: FittedEffect) -> str:
    f, mass = seen.value("frequency"), seen.most[1].piece.mass
    moved = seen.value("amplitude") / (mass * (2 * np.pi * f) ** 2)
    return f"{_swing(seen)}; ± {_n(abs(seen.value('amplitude')))} N, which moves the mass by ± {_length(abs(moved))}"


def _ringing(seen: FittedEffect) -> str:
    return f"{_swing(seen)}, down to a third after {_n(1e3 * seen.value('tau'))} ms"


def _beam(seen: FittedEffect) -> str:
    return f"{_n(seen.value('frequency'))} Hz near the clamp, lower with the mass farther out"


def _modulated_load(seen: FittedEffect) -> str:
    f, depth = seen.value("frequency"), abs(seen.value("depth"))
    lift = depth * GRAVITY / (2 * np.pi * f) ** 2
    return (
        f"{_swing(seen)}; the load swings by ± {_n(100 * depth, 2)} %, as on a course that moves up and down by ± "
        + (_length(lift))
    )


def _modulated_viscous(seen: FittedEffect) -> str:
    return f"{_swing(seen)}; the viscous coefficient swings by ± {_n(100 * abs(seen.value('depth')), 2)} %"


def _shake(seen: FittedEffect) -> str:
    size = abs(seen.value("amplitude"))
    pitch = seen.most[1].piece.path.pixel_pitch
    px = f" ({_n(size / pitch, 2)} px)" if pitch else ""
    return f"{_swing(seen)}; everything in the picture would move by ± {_length(size)}{px}"


def _texture(seen: FittedEffect) -> str:
    period = seen.value("period")
    return f"a period of {_length(period)}: one mark every {_length(period)} of the course"


def _patch(seen: FittedEffect) -> str:
    middle, width = seen.value("x_c"), seen.value("w")
    past = seen.passes(middle)
    return f"from x = {middle - 2 * width:.3f} to {middle + 2 * width:.3f} m, the middle passed by {past or 'no run'}"


def _blow(seen: FittedEffect) -> str:
    mass = seen.most[1].piece.mass
    lost = abs(seen.value("J")) / mass
    when = 1e3 * seen.value("time")
    return (
        f"in run {seen.run} {_n(when)} ms after release, of {_n(abs(seen.value('J')))} N s: {_n(lost, 2)} m/s at once"
    )


def _lost(seen: FittedEffect) -> str:
    return f"in run {seen.run} {_n(1e3 * seen.value('time'))} ms after release, {_n(seen.value('frames'), 2)} frames"


def _drag(seen: FittedEffect) -> str:
    return f"{_n(seen.value('c'))} N at 1 m/s, four times that at 2 m/s"


def _spring(seen: FittedEffect) -> str:
    return f"{_n(seen.value('k'))} N more for every metre toward +x"


def _thermal(seen: FittedEffect) -> str:
    way = "less" if seen.value("dF") > 0 else "more"
    return (
        f"{_n(abs(seen.value('dF')))} N {way} in the end, two thirds of it within {_length(seen.value('length'))} slid"
    )


def _drift(seen: FittedEffect) -> str:
    longest, end = seen.end()
    name = seen.solution.problem.layout.run_names[longest.piece.run]
    return f"{_n(seen.value('k') * end)} N by the end of run {name}, {_n(1e3 * end)} ms after release"


def _slope(seen: FittedEffect) -> str:
    piece = seen.solution.problem.pieces[0]
    lean = seen.value("F") / (piece.mass / piece.path.mass_ratio * GRAVITY)
    return f"as a course that rises by {_n(1e3 * lean)} mm in a metre toward +x ({_n(DEGREE * lean)} degrees)"


def _asymmetry(seen: FittedEffect) -> str:
    return (
        f"{_n(2 * seen.value('dF'))} N between the two directions at the reference load, and "
        f"{_n(2 * seen.value('dF_v'))} N more for every m/s"
    )


def _lens(seen: FittedEffect) -> str:
    return f"no error at x = {seen.value('x_c'):.3f} m, growing with the cube of the way from there"


def _locking(seen: FittedEffect) -> str:
    return f"± {_n(abs(seen.value('amplitude')), 2)} px, once in every pixel"


def _clock(seen: FittedEffect) -> str:
    _, end = seen.end()
    return f"the frame rate would change by {_n(100 * seen.value('k') * end, 2)} % in the longest run"


def _rate(seen: FittedEffect) -> str:
    factor = float(np.exp(seen.value("rate")))
    return f"in run {seen.run}, whose true times would be its recorded ones times {_n(factor, 4)}"


def _late(seen: FittedEffect) -> str:
    tau = seen.value("tau")
    speed = float(np.median(np.abs(position_and_velocity(seen.most[1])[1])))
    return f"{_n(1e3 * tau)} ms late, {_length(tau * speed)} at {_n(speed, 2)} m/s"


def _turned(seen: FittedEffect) -> str:
    along, across = seen.value("along"), seen.value("across")
    return f"the followed point would lie {_length(along)} along and {_length(across)} above the centre of mass"


def _driven(seen: FittedEffect) -> str:
    return f"the true drive would be {_n(100 * seen.value('e'))} % larger, {_n(1e3 * seen.value('tau'))} ms late"


def _hysteresis(seen: FittedEffect) -> str:
    length = 1.0 / seen.value("gamma")
    return f"{_n(seen.value('alpha'))} N/m for small swings, yielding within {_length(length)}"


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
