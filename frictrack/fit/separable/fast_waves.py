"""Find the fast waves of a model with common amplitudes: with free amplitudes, beside anything slow."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from frictrack.fit.separable.blocks import DataBlock, Forward
from frictrack.fit.separable.newton import SeparableSolution
from frictrack.fit.separable.relaxed import RelaxedWaves, Wave
from frictrack.fit.separable.varpro import VariableProjection
from frictrack.records import Array

REFINE_STEPS, ENOUGH = 8, 1e-4  # steps from given frequencies; predicted fall of the misfit at which they end


@dataclass(frozen=True, eq=False)
class WaveSet:
    """Fast waves: parameter vector (P,) of the full model, misfit beside anything slow, and periods per run.

    `misses_wave` says that one more wave would explain far more than chance.
    """

    p: Array
    misfit: float
    periods: Array
    misses_wave: bool = False

    def resembles(self, other: WaveSet, most: float) -> bool:
        """Return whether all waves are within some periods per run of those of another set."""
        return bool(np.all(np.abs(self.periods - other.periods) <= most))


class FastWaves:
    """The search for some waves at one value of the shared parameter. Its tables serve all data along the motion.

    Parameters
    ----------
    relaxed : RelaxedWaves
        The model in one run.
    waves : sequence of Wave
        The waves to find, at least one.
    shared_value : float
        Value of the shared parameter.
    slow : array of shape (k, M)
        Rows that span everything slow, which is projected out.

    """

    def __init__(self, relaxed: RelaxedWaves, waves: Sequence[Wave], shared_value: float, slow: Array) -> None:
        self.relaxed, self.waves, self.shared_value = relaxed, waves, shared_value
        pairs = zip(relaxed.full_model.blocks, relaxed.full_model.slices, strict=True)
        self._without_slow = [_projection(slow[:, cut]) for _, cut in pairs]
        blocks = [_without_slow_part(b, f) for b, f in zip(relaxed.full_model.blocks, self._without_slow, strict=True)]
        self.separable = relaxed.waves_alone(waves, shared_value, blocks)
        self.search = VariableProjection(self.separable)

    def __call__(self, data: Array) -> WaveSet:
        """Return the best waves for data (M,)."""
        outside = self._outside(data)
        state = self.search(outside)
        misses = self.search.misses_effect(self.search.problem(outside), state)
        return replace(self._wave_set(state), misses_wave=misses)

    def first_found(self, data: Array) -> WaveSet:
        """Return the waves for data (M,) as found one after the other, without any exchange."""
        return self._wave_set(self.search.start_solution(self.search.problem(self._outside(data))))

    def refined(self, frequencies: Sequence[float], data: Array, fastest_hidden: float) -> WaveSet:
        """Return the waves for data (M,) refined from given frequencies, Hz, one per wave.

        Waves up to the frequency `fastest_hidden`, Hz, are hardly seen beside anything slow. They stay where they are.
        """
        problem, values = self.search.problem(self._outside(data)), self.search.start_values()
        for w, frequency in zip(self.waves, frequencies, strict=True):
            for i, slot in enumerate(self.separable.layout.slots):
                if slot.effect == w.part and self.relaxed.full_name(w.part, slot.parameter) == w.frequency:
                    values[i] = frequency
        groups = self.separable.groups
        seen = {w.part for w, f in zip(self.waves, frequencies, strict=True) if f > fastest_hidden}
        refined = [g for g, group in enumerate(groups) if group.names[0] in seen]
        return self._wave_set(problem.refine(problem.at(values), refined, steps=REFINE_STEPS, enough=ENOUGH))

    def _outside(self, data: Array) -> Array:
        """The part of data (M,) that nothing slow explains."""
        pairs = zip(self._without_slow, self.separable.slices, strict=True)
        return np.concatenate([f(data[cut]) for f, cut in pairs])

    def _wave_set(self, state: SeparableSolution) -> WaveSet:
        """The waves of a solution in a parameter vector of the full model."""
        relaxed, layout = self.relaxed, self.separable.layout
        law = self.separable.law(state.nonlinear_values, state.coefficients)
        known = dict(zip(((s.effect, s.parameter) for s in layout.slots), map(float, law), strict=True))
        p = np.array([known.get((s.effect, s.parameter), 1.0) for s in relaxed.full_model.layout.slots])
        if relaxed.shared is not None:
            relaxed.set_value(p, relaxed.shared.name, self.shared_value)
        for (part, name), value in known.items():
            if part in relaxed.parts:
                relaxed.set_value(p, relaxed.full_name(part, name), value)
        duration = relaxed.full_model.layout.span.duration
        periods = [
            sorted(relaxed.value(p, w.frequency) * duration for w in waves if w in self.waves)
            for waves in relaxed.sums.values()
        ]
        return WaveSet(p, state.misfit, np.concatenate(periods))


def _projection(slow: Array) -> Forward:
    """The map of rows (..., m) to their part outside some rows (k, m)."""
    basis, sizes, _ = np.linalg.svd(slow.T, full_matrices=False)
    basis = basis[:, sizes > np.finfo(float).eps * len(slow.T) * max(sizes.max(initial=0.0), 1.0)]

    def outside(rows: Array) -> Array:
        return np.asarray(rows - (rows @ basis) @ basis.T)

    return outside


def _without_slow_part(block: DataBlock, outside: Forward) -> DataBlock:
    """A block with everything slow projected out of data and rows."""
    forward, picture = block.forward, block.picture
    return replace(
        block,
        data=outside(block.data),
        forward=lambda rows: outside(forward(rows)),
        picture=lambda rows: outside(picture(rows)),
    )
