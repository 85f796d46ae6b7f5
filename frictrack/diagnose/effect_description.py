"""Describe a fitted effect in the numbers of a study: its size, where it is strongest, and what to look for there."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from frictrack.base.number_format import format_length, format_number
from frictrack.effects import Effect, EffectRecord, Path
from frictrack.fit.least_squares import PieceResponse, Solution, position_and_velocity
from frictrack.records import GRAVITY, Array, stretches

MIN_SHARE_OF_PEAK = 0.8  # of the largest contribution; the first stretch above it is described


def describe_effect(effect: Effect, solution: Solution | None = None) -> dict[str, str]:
    """Describe an effect, and its fitted values if there are any.

    `solution`: a fit; its numbers are added if its model contains the effect. The keys are "what", "looks_like" and
    "confirm". A fitted effect also has "here", with the numbers of this study.
    """
    texts = {"what": effect.what, "looks_like": effect.looks_like, "confirm": effect.confirm}
    if solution is None or effect.name not in solution.problem.model:
        return texts
    fitted = FittedEffect(effect.name, solution)
    describe = effect.describe or _list_parameters
    parts = [describe(fitted), fitted.strongest()]
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
        return self.solution.problem.model.effect_contribution(self.name, *self._path_and_values(response))

    def _path_and_values(self, response: PieceResponse) -> tuple[Path, dict[str, dict[str, float]]]:
        """Path at the frames of a piece, and the parameter values of its run."""
        values, level = self.solution.problem.layout.values(self.solution.p, response.piece.run)
        return response.piece.at_frames(*position_and_velocity(response), level), values

    def value(self, parameter: str) -> float:
        """Return a parameter's value in the run in which the effect is largest."""
        values, _ = self.solution.problem.layout.values(self.solution.p, self._largest[0].piece.run)
        return float(values[self.name][parameter])

    @cached_property
    def _largest(self) -> tuple[PieceResponse, int, float]:
        """Piece and frame in the middle of the first stretch where the effect is near its largest value; its size."""
        tops = [float(np.max(np.abs(b), initial=0.0)) for b in self.blocks]
        k = int(np.argmax(tops))
        high = stretches(np.abs(self.blocks[k]) >= MIN_SHARE_OF_PEAK * tops[k])[0]
        i = (high.start + high.stop - 1) // 2
        return self.solution.responses[k], i, abs(float(self.blocks[k][i]))

    @property
    def run(self) -> str:
        """Name of the run in which the effect is largest."""
        return self.solution.problem.layout.run_names[self._largest[0].piece.run]

    def strongest(self) -> str:
        """Say where the effect is largest: run, frame, time since release, place, speed and size."""
        response, i, size = self._largest
        if size == 0:
            return ""
        piece, (x, v) = response.piece, position_and_velocity(response)
        if self.effect.acts_on == "force":
            whole = abs(self.solution.problem.model.force(*self._path_and_values(response))[i])
            how = f"{format_number(size)} N of {format_number(whole)} N" if whole > size else f"{format_number(size)} N"
        else:
            pitch = piece.path.pixel_pitch
            how = format_length(size) + (f" ({format_number(size / pitch, 2)} px)" if pitch else "")
        where = f"frame {int(piece.frames[i])}, {format_number(1e3 * piece.t[i])} ms after release"
        return f"look at run {self.run}, {where}, x = {x[i]:.3f} m at {format_number(abs(v[i]), 2)} m/s: {how}"

    def passes(self, spot: float) -> str:
        """Say in which frames and at what speeds the first runs pass the place `spot`, m."""
        found = []
        for response in self.solution.responses:
            x, v = position_and_velocity(response)
            over = np.flatnonzero(np.diff(np.sign(x - spot)))
            if len(over):
                i = int(over[0])
                name = self.solution.problem.layout.run_names[response.piece.run]
                found.append(f"{name} in frame {int(response.piece.frames[i])} at {format_number(abs(v[i]), 2)} m/s")
        return ", ".join(found[:3])

    @property
    def mass(self) -> float:
        """Moving mass of the run in which the effect is largest, kg."""
        return float(self._largest[0].piece.mass)

    @property
    def pixel_pitch(self) -> float | None:
        """Length of a pixel in the run in which the effect is largest, m; None for a table."""
        return self._largest[0].piece.path.pixel_pitch

    @property
    def typical_speed(self) -> float:
        """Median speed of the run in which the effect is largest, m/s."""
        return float(np.median(np.abs(position_and_velocity(self._largest[0])[1])))

    @property
    def reference_weight(self) -> float:
        """Weight of the reference mass, N."""
        piece = self.solution.problem.pieces[0]
        return float((piece.path.mass or piece.mass) / piece.path.mass_ratio * GRAVITY)

    @property
    def stated_incline(self) -> float:
        """Incline of the run in which the effect is largest as the study states it, rad; 0 where it states none."""
        piece = self._largest[0].piece
        driven = 0.0 if piece.path.drive is None else piece.path.drive[0]
        weight = (piece.path.mass or piece.mass) * GRAVITY
        return float(np.arcsin(np.clip((driven - piece.mass * piece.known[0]) / weight, -1.0, 1.0)))

    @property
    def last_run(self) -> tuple[str, float]:
        """Name and duration (s since release) of the run that lasts longest."""
        longest = max(self.solution.responses, key=lambda r: float(r.piece.t[-1]))
        return self.solution.problem.layout.run_names[longest.piece.run], float(longest.piece.t[-1])

    @property
    def course(self) -> tuple[float, float]:
        """Smallest and largest place that any run reaches, m."""
        x = np.concatenate([position_and_velocity(r)[0] for r in self.solution.responses])
        return float(x.min()), float(x.max())

    @cached_property
    def longest(self) -> EffectRecord:
        """The effect along the run with most frames."""
        response = max(self.solution.responses, key=lambda r: len(r.piece.t))
        piece = response.piece
        x, v = position_and_velocity(response)
        noise, block = np.broadcast_to(piece.noise, piece.t.shape), self._block(response)
        return EffectRecord(piece.t, x, v, block, noise, piece.whitened, float(piece.mass), float(piece.path.gravity))

    def rms(self, parameter: str) -> float:
        """Return the root mean square of a parameter over the runs."""
        layout = self.solution.problem.layout
        values = [layout.values(self.solution.p, r)[0][self.name][parameter] for r in range(len(layout.run_names))]
        return float(np.sqrt(np.mean(np.square(values))))


def _list_parameters(fitted: FittedEffect) -> str:
    """The parameters of an effect that does not describe itself, as text."""
    shown = [p for p in fitted.effect.parameters if p.role != "phase" and p.fixed is None]
    return ", ".join(f"{p.name} = {format_number(fitted.value(p.name))} {p.unit}".removesuffix(" 1") for p in shown)
