"""Fit waves of a common amplitude in one run: each with a free amplitude, or pairs with their common amplitudes."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any

import numpy as np
from scipy.ndimage import minimum_filter

from frictrack.effects import Effect, RelaxedPart
from frictrack.fit.separable.model import SeparableModel
from frictrack.fit.separable.newton import ProjectedProblem, SeparableSolution
from frictrack.fit.separable.varpro import ROUGH_STEPS, VariableProjection
from frictrack.models import Model
from frictrack.records import Array

MAX_SLOW_PERIODS = 2.1  # periods per run up to which a wave is slow
MAX_PAIR_PLACES = 3.0  # periods per run within which waves of two sums may be confused
RELATIVE_STEP = 0.1  # periods per run between the scanned frequencies
PHASE_COUNT = 16  # phases around the circle
TRIAL_PHASES = np.arange(PHASE_COUNT) * 2 * np.pi / PHASE_COUNT - np.pi
MIN_DIFFERENCE_SHARE = 1e-5  # smallest remaining share of two sums
# coefficients of the two quadratures at these phases
PHASE_ROTATIONS = np.array([np.cos(TRIAL_PHASES), np.sin(TRIAL_PHASES)])


@dataclass(frozen=True)
class Wave:
    """One wave of a sum: its group in the relaxed model, and the names of its amplitude, frequency and phase."""

    g: int
    size: str
    frequency: str
    phase: str


class RelaxedWaves:
    """The relaxed model of one run, at given values of the shared parameters."""

    def __init__(self, full_model: SeparableModel, effect: Effect, shared_values: Mapping[str, float]) -> None:
        self.full_model, self.effect, self.shared_values = full_model, effect, shared_values
        self.parts = {f"{effect.name}.{part.effect.name}": part for part in effect.relaxed}
        part_effects = [_effect_of_part(name, part, effect, shared_values) for name, part in self.parts.items()]
        law = Model(
            tuple(q for e in full_model.layout.model.effects for q in (part_effects if e.name == effect.name else [e]))
        )
        self.separable = SeparableModel(replace(full_model.layout, model=law), full_model.blocks)
        self.search = VariableProjection(self.separable)
        self.waves = list(self._waves())
        self.slow = np.arange(RELATIVE_STEP / 2, MAX_SLOW_PERIODS, RELATIVE_STEP) / full_model.layout.span.duration
        self.groups = {w.g for w in self.waves}
        self._rows: dict[str, Array] = {}
        self._products: dict[tuple[str, str], tuple[Any, ...]] = {}

    def _waves(self) -> Iterator[Wave]:
        """The waves among the groups of the relaxed model."""
        for g, group in enumerate(self.separable.groups):
            part = self.parts.get(group.names[0])
            if part is not None and group.is_sinusoid:
                names = dict(zip((p.name for p in part.effect.parameters), part.names, strict=True))
                own_parameters = [p for p in part.effect.nonlinear if names[p.name] not in self.shared_values]
                frequency = next(p for p in own_parameters if p.role != "phase")
                phase = next(p for p in own_parameters if p.role == "phase")
                yield Wave(g, names[part.effect.linear[0].name], names[frequency.name], names[phase.name])

    # --- free amplitudes

    def free_amplitude_fits(self, data: Array) -> list[tuple[float, Array]]:
        """Fit data (M,) with free amplitudes, as found and with waves of two sums exchanged.

        Returns
        -------
        list of (float, array of shape (P,))
            Misfits and parameter vectors of the full model.

        """
        problem = ProjectedProblem(self.separable, data)
        state = self.search.start_solution(problem)
        found = [state]
        for one, other in combinations(self.waves, 2):
            at = [self.separable.groups[w.g].nonlinear_slots for w in (one, other)]
            if one.size == other.size or not all(at):
                continue
            i, j = at[0][0], at[1][0]
            if max(state.nonlinear_values[i], state.nonlinear_values[j]) > self.slow[-1]:
                nonlinear_values = state.nonlinear_values.copy()
                nonlinear_values[[i, j]] = nonlinear_values[[j, i]]
                moved = problem.at(nonlinear_values, state, {one.g, other.g})
                found.append(problem.refine(moved, steps=ROUGH_STEPS, enough=1e-3))
        return [(s.misfit, self._in_full_model(s)) for s in found]

    def _in_full_model(self, state: SeparableSolution) -> Array:
        """Parameter vector (P,) of the full model with the waves of a relaxed solution."""
        law = self.separable.law(state.nonlinear_values, state.coefficients)
        known = {(self.effect.name, name): value for name, value in self.shared_values.items()}
        for slot, value in zip(self.separable.layout.slots, law, strict=True):
            part = self.parts.get(slot.effect)
            if part is None:
                known[slot.effect, slot.parameter] = float(value)
            else:
                names = dict(zip((p.name for p in part.effect.parameters), part.names, strict=True))
                known[self.effect.name, names[slot.parameter]] = float(value)
        return np.array([known.get((s.effect, s.parameter), 1.0) for s in self.full_model.layout.slots])

    # --- common amplitudes

    def fast_periods(self, p: Array) -> Array:
        """Return the periods per run of the fast waves, sum after sum, (f,); slow ones count as zero."""
        duration = self.full_model.layout.span.duration
        out = []
        for size in dict.fromkeys(w.size for w in self.waves):
            periods = sorted(self._value(p, w.frequency) * duration for w in self.waves if w.size == size)
            out += [f if f > MAX_SLOW_PERIODS else 0.0 for f in periods]
        return np.array(out)

    def with_waves_exchanged(self, p: Array) -> Iterator[Array]:
        """Yield parameter vectors (P,) with two neighbouring waves of different sums exchanged."""
        for one, other in combinations(self.waves, 2):
            f, g = (self._value(p, w.frequency) for w in (one, other))
            near = abs(f - g) * self.full_model.layout.span.duration < MAX_PAIR_PLACES
            if one.size != other.size and near and max(f, g) > self.slow[-1]:
                q = p.copy()
                self._set_wave(q, one, g, self._value(p, other.phase))
                self._set_wave(q, other, f, self._value(p, one.phase))
                yield q

    def slow_wave_positions(self, p: Array, data: Array) -> list[tuple[float, Array]]:
        """Scan the slowest waves of two sums beside all others of a model.

        Returns
        -------
        list of (float, array of shape (P,))
            Misfits of the local minima, and their parameter vectors.

        """
        slowest = {}
        for w in sorted(self.waves, key=lambda w: -self._value(p, w.frequency)):
            slowest[w.size] = w
        return [place for pair in combinations(slowest.values(), 2) for place in self._scan_pair(p, data, pair)]

    def _scan_pair(self, p: Array, data: Array, pair: tuple[Wave, Wave]) -> list[tuple[float, Array]]:
        """Scan one pair of waves over frequency and phase."""
        one, other = pair
        basis = self._other_effects_basis(p, pair)
        a, b, aa, bb, ab = self._pair_products(pair, basis)
        r, q = (_single_precision(_without_basis(self._other_waves(p, w), basis)) for w in pair)
        y = _single_precision(_without_basis(data, basis))
        g11, u1 = (r @ r + 2 * _over_phases(a @ r) + aa)[:, None], (r @ y + _over_phases(a @ y))[:, None]
        g22, u2 = q @ q + 2 * _over_phases(b @ q) + bb, q @ y + _over_phases(b @ y)
        g12 = ab + (r @ q + _over_phases(a @ q))[:, None]
        g12 += _over_phases(b @ r)
        det = np.maximum(g11 * g22 - g12 * g12, MIN_DIFFERENCE_SHARE * g11 * g22)
        c1, c2 = g22 * u1 - g12 * u2, g11 * u2 - g12 * u1
        gain = (c1 * u1 + c2 * u2) / det
        gain[(c1 <= 0) | (c2 <= 0)] = 0.0
        cost = (
            (y @ y - gain)
            .reshape(len(a), PHASE_COUNT, len(b), PHASE_COUNT)
            .transpose(0, 2, 1, 3)
            .reshape(len(a), len(b), -1)
        )
        phase_index = cost.argmin(axis=-1)
        least = cost.min(axis=-1)
        out = []
        for i, j in np.argwhere(least == minimum_filter(least, 3, mode="nearest")):
            q = p.copy()
            self._set_wave(q, one, self.slow[i], TRIAL_PHASES[phase_index[i, j] // PHASE_COUNT])
            self._set_wave(q, other, self.slow[j], TRIAL_PHASES[phase_index[i, j] % PHASE_COUNT])
            for name, value in self.shared_values.items():
                k = self.full_model.position(self.effect.name, name)
                if k is not None:
                    q[k] = value
            out.append((float(least[i, j]), q))
        return out

    def _pair_products(self, pair: tuple[Wave, Wave], basis: Array) -> tuple[Any, ...]:
        """Both waves at all slow frequencies, other effects projected out, and their products at all phases.

        They depend on the motion only, and are kept as long as the other effects stay the same.
        """
        key = pair[0].frequency, pair[1].frequency
        if key not in self._products or not np.array_equal(self._products[key][0], basis):
            a, b = (_single_precision(_without_basis(self._slow_quadratures(w), basis)) for w in pair)
            aa, bb = (
                np.einsum("ap,fab,bp->fp", PHASE_ROTATIONS, x @ x.transpose(0, 2, 1), PHASE_ROTATIONS).ravel()
                for x in (a, b)
            )
            n = a.shape[-1]
            cross_products = (a.reshape(-1, n) @ b.reshape(-1, n).T).reshape(len(a), 2, len(b), 2)
            ab = np.einsum(
                "ap,fagb,bq->fpgq",
                _single_precision(PHASE_ROTATIONS),
                cross_products,
                _single_precision(PHASE_ROTATIONS),
                optimize=True,
            )
            self._products[key] = basis, a, b, aa, bb, np.ascontiguousarray(ab.reshape(len(a) * PHASE_COUNT, -1))
        return self._products[key][1:]

    def _set_wave(self, q: Array, w: Wave, frequency: float, phase: float) -> None:
        """Set frequency and phase of a wave in a parameter vector, in place."""
        for name, value in ((w.frequency, frequency), (w.phase, phase)):
            k = self.full_model.position(self.effect.name, name)
            if k is not None:
                q[k] = value

    def _value(self, p: Array, name: str) -> float:
        """Value of a parameter of the effect."""
        k = self.full_model.position(self.effect.name, name)
        return self.full_model.layout.fixed[self.effect.name, name] if k is None else float(p[k])

    def _slow_quadratures(self, w: Wave) -> Array:
        """Both quadratures (F, 2, M) of a wave at every slow frequency; of a fixed one at its own."""
        fixed = self.full_model.layout.fixed.get((self.effect.name, w.frequency))
        key = w.size if fixed is None else w.frequency
        if key not in self._rows:
            self._rows[key] = self._quadratures(w, self.slow if fixed is None else np.array([fixed]))
        return self._rows[key]

    def _quadratures(self, w: Wave, frequencies: Array) -> Array:
        """Both quadratures (F, 2, M) of a wave at some frequencies."""
        nonlinear_values = np.ones((len(frequencies), len(self.separable.layout.slots)))
        for i in self.separable.groups[w.g].nonlinear_slots:
            nonlinear_values[:, i] = frequencies
        rows = [self.separable.rows(w.g, b, nonlinear_values) for b in range(len(self.separable.blocks))]
        return np.concatenate(rows, axis=2)

    def _other_waves(self, p: Array, w: Wave) -> Array:
        """Sum (M,) of the other waves that share the amplitude of `w`."""
        out = np.zeros(self.separable.size)
        for q in self.waves:
            if q.size == w.size and q is not w:
                phase = self._value(p, q.phase)
                rows = self._quadratures(q, np.array([self._value(p, q.frequency)]))[0]
                out += np.cos(phase) * rows[0] + np.sin(phase) * rows[1]
        return out

    def _other_effects_basis(self, p: Array, pair: tuple[Wave, Wave]) -> Array:
        """Orthonormal basis (k, M) of everything beside two sums, at the values of a parameter vector (P,)."""
        known = {(s.effect, s.parameter): float(v) for s, v in zip(self.full_model.layout.slots, p, strict=True)}
        nonlinear_values = np.array([[known.get((s.effect, s.parameter), 1.0) for s in self.separable.layout.slots]])
        rows = []
        for g in set(range(len(self.separable.groups))) - self.groups:
            each = [self.separable.rows(g, b, nonlinear_values)[0] for b in range(len(self.separable.blocks))]
            rows.append(np.concatenate(each, axis=1))
        for size in dict.fromkeys(w.size for w in self.waves if w.size not in {w.size for w in pair}):
            w = next(w for w in self.waves if w.size == size)
            own_parameters = self._quadratures(w, np.array([self._value(p, w.frequency)]))[0]
            phase_index = self._value(p, w.phase)
            rows.append(
                (
                    self._other_waves(p, w)
                    + np.cos(phase_index) * own_parameters[0]
                    + np.sin(phase_index) * own_parameters[1]
                )[None]
            )
        if not rows:
            return np.zeros((0, self.separable.size))
        q, _ = np.linalg.qr(np.concatenate(rows).T)
        return np.asarray(q.T)


def _without_basis(rows: Array, basis: Array) -> Array:
    """Rows (..., M) minus their projection on an orthonormal basis (k, M)."""
    return np.asarray(rows - (rows @ basis.T) @ basis)


def _single_precision(rows: Array) -> Array:
    """Rows in single precision: they only show where to refine."""
    return rows.astype(np.float32)


def _over_phases(products: Array) -> Array:
    """Products of waves at all phases, (F PHASE_COUNT,), from those of their quadratures (F, 2)."""
    return np.asarray((products @ _single_precision(PHASE_ROTATIONS)).ravel())


def _effect_of_part(name: str, part: RelaxedPart, effect: Effect, shared_values: Mapping[str, float]) -> Effect:
    """A part as an effect of its own: bounds and fixed values of the whole, shared parameters fixed."""
    own_parameters = []
    for q, reported_name in zip(part.effect.parameters, part.names, strict=True):
        parameter = effect.parameter(reported_name)
        fixed_value = shared_values.get(reported_name, parameter.fixed)
        if q.role == "amplitude":
            own_parameters.append(q)
        else:
            own_parameters.append(replace(q, bounds=parameter.bounds, scan=parameter.scan, fixed=fixed_value))
    return replace(part.effect, name=name, parameters=tuple(own_parameters))
