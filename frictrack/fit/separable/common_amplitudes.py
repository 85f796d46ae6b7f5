"""Fit models whose waves have common amplitudes, such as ATM2: fast waves, then slow ones, then everything together.

The effect names its parts (`Effect.relaxed`): waves, which are linear where each has its own amplitude, and other
columns. The waves of one amplitude make a sum, and one wave of either sum is taken as slow. The fast waves are found
with free amplitudes, anything slow projected out, at a few values of the parameter that several parts share, such as
v_s. The slow waves follow on a grid with the common amplitudes, and all are refined together. The run with the
most frames is solved first; the other runs add only their own parameters.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain, combinations, product

import numpy as np

from frictrack.effects import Effect
from frictrack.effects.models import Model
from frictrack.fit.parameters import ParameterLayout
from frictrack.fit.separable.model import DataBlock, SeparableModel
from frictrack.fit.separable.projected import ProjectedProblem, SeparableSolution
from frictrack.fit.separable.varpro import VariableProjection
from frictrack.records import Array

SCAN_PLACES_FROM_END = (3, 6, 8)  # grid points from the end of the shared parameter's scan at which waves are searched
MAX_WAVE_SETS = 4  # sets of fast waves for each of which slow waves are searched
MAX_RELAXED_MISFIT_RATIO = 1.5  # times the best misfit; relaxed fits beyond have the wrong waves
MIN_FAST_PERIODS = 1.9  # periods per run above which a wave may be a fast one
MAX_SLOW_PERIODS = 2.1  # and up to which it may be a slow one
MAX_MIXED_PERIODS = 4.5  # periods per run up to which a fast wave may be confused with slow ones
MIXED_PERIODS = (2.2, 2.7, 3.2, 3.7, 4.2)  # frequencies in between, which may be hidden by slow waves
MAX_CONFUSED_PERIODS = 1.5  # periods per run within which fast waves of two sums may be confused
SAME_WAVE_PERIODS = 0.25  # periods per run; closer waves count as the same
MAX_ASSIGNMENTS = 100  # choices of frequencies that are refined
MAX_REASSIGNED_SETS = 8  # sets with reassigned frequencies for each of which slow waves are searched
SAME_SET_PERIODS = 0.05  # periods per run; closer sets are not searched twice
SLOW_STEP_PERIODS = 0.2  # periods per run between scanned slow waves
SCAN_SHARED_VALUES = 10  # scanned values of the shared parameter
PHASES = np.arange(8) * np.pi / 4 - np.pi  # scanned phases
MIN_DIFFERENCE_SHARE = 1e-5  # smallest share of a sum that the other one does not explain
SPAN_PRECISION = 3e-3  # singular values below this share of the largest are no direction of slow rows
MAX_STARTS, MAX_FINALISTS = 16, 3  # local minima of the scan that are refined by a few steps, and to the end
FIRST_STEPS, MAX_STEPS = 4, 30
LAST_STEPS, LAST_MIN_FALL = 100, 1e-6  # the valleys of v_s and slow waves are long
ROUGH_STEPS, ROUGH_MIN_FALL = 8, 1e-4  # steps from given frequencies; predicted fall, share of the misfit
MIN_GAIN_SHARE = 1e-5  # least gain of a trial, share of the misfit


def variable_projection(separable: SeparableModel) -> VariableProjection | ConstrainedVariableProjection:
    """Create the search that fits a model along the measured motion."""
    relaxed = any(e.relaxed for e in separable.layout.model.effects)
    return ConstrainedVariableProjection(separable) if relaxed else VariableProjection(separable)


class ConstrainedVariableProjection:
    """The search for a model with a relaxed effect. Its tables are reused for further data sets."""

    def __init__(self, separable: SeparableModel) -> None:
        self.separable = separable
        length = {r: sum(len(b.data) for b in separable.blocks if b.run == r) for r in separable.runs}
        self.runs = sorted(separable.runs, key=lambda r: -length[r])
        self.first = _RunSearch(_single_run(separable, self.runs[0], separable.layout.model))

    def __call__(self, data: Array | None = None) -> SeparableSolution:
        """Return the best solution for data (M,); default those of the blocks."""
        data = self.separable.data if data is None else data
        if self.first.separable is self.separable:
            return self.first(data)
        found: dict[str, float] = {}
        for run in self.runs:
            known = Model(tuple(_with_fixed_values(e, found) for e in self.separable.layout.model.effects))
            search = _RunSearch(_single_run(self.separable, run, known)) if found else self.first
            own = search(self._data_of_run(run, data))
            found = dict(zip(search.separable.layout.names, search.full_vector(own), strict=True)) | found
        problem = ProjectedProblem(self.separable, data)
        nonlinear_values = np.array([found.get(name, 1.0) for name in self.separable.layout.names])
        return problem.refine(problem.at(nonlinear_values), steps=MAX_STEPS)

    def unneeded_events(self, state: SeparableSolution, penalty: float) -> frozenset[tuple[str, int]]:
        """Return the events of single runs, (effect, run), that gain less than a penalty."""
        return VariableProjection(self.separable).unneeded_events(state, penalty)

    def _data_of_run(self, run: int, data: Array) -> Array:
        """The data of one run."""
        pairs = zip(self.separable.blocks, self.separable.slices, strict=True)
        return np.concatenate([data[s] for block, s in pairs if block.run == run])


@dataclass(frozen=True)
class Wave:
    """One wave: its part and group in the relaxed model, and what the whole calls its frequency and phase."""

    part: str
    g: int
    frequency: str
    phase: str


@dataclass(frozen=True, eq=False)
class WaveSet:
    """Fast waves in a parameter vector (P,) of the full model, misfit outside anything slow, and periods per run.

    `misses_wave` says that one more wave would explain far more than chance.
    """

    p: Array
    misfit: float
    periods: Array
    misses_wave: bool = False

    def resembles(self, others: Iterable[WaveSet], most: float = SAME_WAVE_PERIODS) -> bool:
        """Return whether all waves are within some periods per run of those of another set."""
        return any(np.all(np.abs(self.periods - other.periods) <= most) for other in others)


class _RunSearch:
    """The search in one run."""

    def __init__(self, separable: SeparableModel) -> None:
        self.separable, self.layout = separable, separable.layout
        self.effect = next(e for e in self.layout.model.effects if e.relaxed)
        self.duration = self.layout.span.duration
        self.names = {
            part: dict(zip((q.name for q in own.effect.parameters), own.names, strict=True))
            for part, own in zip(_part_names(self.effect), self.effect.relaxed, strict=True)
        }
        self.shared, self.shared_values = self._shared_parameter()
        self.relaxed = SeparableModel(self.layout_with(_parts(self.effect)), separable.blocks)
        self.addresses = self.addresses_of(self.relaxed)
        groups = [(g, group.names[0], group.is_sinusoid) for g, group in enumerate(self.relaxed.groups)]
        self.other_effects = [g for g, name, _ in groups if name not in self.names]
        self.other_parts = [g for g, name, is_wave in groups if name in self.names and not is_wave]
        sums: dict[str, list[Wave]] = {}
        for g, part, is_wave in groups:
            if is_wave and part in self.names:
                amplitude, *_, frequency, phase = self.names[part].values()
                sums.setdefault(amplitude, []).append(Wave(part, g, frequency, phase))
        self.sums = list(sums.values())
        self.slow = [min(waves, key=lambda w: self._bounds(w.frequency)[0]) for waves in self.sums]
        self.waves = list(chain(*self.sums))
        self.fast = [w for w in self.waves if w not in self.slow]
        self._tabulate_slow_rows()
        self._searches: dict[tuple[int, int], _FreeWaves] = {}

    def __call__(self, data: Array) -> SeparableSolution:
        """Return the best solution for data (M,)."""
        problem, last = ProjectedProblem(self.separable, data), len(self.shared_values)
        places = sorted({max(last - k, 0) for k in SCAN_PLACES_FROM_END})
        tried = _promising([self._free_waves(i, self.fast).found(data) for i in places]) if self.fast else []
        best = None
        for p in [w.p for w in tried] or [VariableProjection(self.separable).start_values()]:
            best = self._with_slow_waves(problem, p, best)
        assert best is not None
        if tried and self._is_ambiguous(best):
            best = self._with_waves_reassigned(problem, best, tried)
        if all(w.misses_wave for w in tried):  # perhaps no wave is slow
            start = problem.at(self._free_waves(self._place_of(best), self.waves).found(data).p)
            best = min(best, problem.refine(start, steps=MAX_STEPS, below=best.misfit), key=lambda s: s.misfit)
        return problem.refine(best, steps=LAST_STEPS, enough=LAST_MIN_FALL)

    # --- parameters

    def layout_with(self, parts: Sequence[Effect]) -> ParameterLayout:
        """The layout with the effect replaced by some of its parts."""
        effects = [q for e in self.layout.model.effects for q in (parts if e is self.effect else [e])]
        return replace(self.layout, model=Model(tuple(effects)))

    def full_vector(self, state: SeparableSolution) -> Array:
        """The parameter vector (P,) of a solution."""
        return self.separable.law(state.nonlinear_values, state.coefficients)

    def _shared_parameter(self) -> tuple[str, Array]:
        """Name of the parameter that several parts share, empty for none, and its values to try."""
        shared = [q for q in self.effect.nonlinear if sum(q.name in own.values() for own in self.names.values()) > 1]
        if not shared:
            return "", np.ones(1)
        (q,) = shared
        if q.fixed is not None:
            return q.name, np.array([q.fixed])
        return q.name, np.ones(1) if q.scan is None else np.asarray(q.scan(self.layout.span), dtype=float)

    def addresses_of(self, separable: SeparableModel) -> list[tuple[str, str]]:
        """Effect and parameter of the full model that the unknowns of a relaxed one belong to."""
        return [
            (self.effect.name, self.names[s.effect][s.parameter]) if s.effect in self.names else (s.effect, s.parameter)
            for s in separable.layout.slots
        ]

    def _value(self, p: Array, name: str) -> float:
        """The value of a parameter of the effect in a parameter vector (P,)."""
        k = self.separable.position(self.effect.name, name)
        return self.layout.fixed[self.effect.name, name] if k is None else float(p[k])

    def _with_values(self, p: Array, values: Mapping[str, float]) -> Array:
        """A parameter vector (P,) with other values of the effect, where these are not fixed."""
        out = p.copy()
        for name, value in values.items():
            if (k := self.separable.position(self.effect.name, name)) is not None:
                out[k] = value
        return out

    def _bounds(self, name: str) -> tuple[float, float]:
        """Bounds of a parameter of the effect; both are its value if it is fixed."""
        k = self.separable.position(self.effect.name, name)
        return self.layout.slots[k].bounds if k is not None else (self.layout.fixed[self.effect.name, name],) * 2

    def _rows(self, g: int, values: Mapping[str, Array], p: Array | None = None) -> Array:
        """Rows (S, k, M) of a group of the relaxed model at all scanned values of the shared parameter."""
        # other parameters of the effect have `values` (S,), other effects those of a parameter vector p (P,)
        count = len(self.scanned)
        known = {} if p is None else {(s.effect, s.parameter): v for s, v in zip(self.layout.slots, p, strict=True)}
        known |= {(self.effect.name, name): own for name, own in {self.shared: self.scanned, **values}.items()}
        vectors = np.stack([np.broadcast_to(known.get(a, 1.0), count) for a in self.addresses], axis=1)
        rows = np.concatenate([self.relaxed.rows(g, b, vectors) for b in range(len(self.relaxed.blocks))], axis=2)
        return np.broadcast_to(rows, (count, *rows.shape[1:]))

    def _wave_rows(self, w: Wave, frequency: float) -> Array:
        """Both quadratures (S, 2, M) of a wave."""
        return self._rows(w.g, {w.frequency: np.full(len(self.scanned), frequency)})

    # --- fast waves

    def _place_of(self, state: SeparableSolution) -> int:
        """Position of the value of the shared parameter nearest to that of a solution."""
        value = self._value(state.nonlinear_values, self.shared) if self.shared else 1.0
        return int(np.argmin(np.abs(np.log(self.shared_values / value))))

    def _free_waves(self, place: int, waves: Sequence[Wave]) -> _FreeWaves:
        """The search for some waves at one of the values of the shared parameter."""
        key = place, len(waves)
        if key not in self._searches:
            self._searches[key] = _FreeWaves(self, waves, float(self.shared_values[place]))
        return self._searches[key]

    def periods(self, p: Array, chosen: Sequence[Wave] = ()) -> list[Array]:
        """Periods per run of the waves of every sum; default all."""
        return [
            np.array([self.duration * self._value(p, w.frequency) for w in waves if w in chosen or not chosen])
            for waves in self.sums
        ]

    def _is_ambiguous(self, state: SeparableSolution) -> bool:
        """Whether fast waves of two sums are close enough to be confused, or a wave is neither slow nor fast."""
        one, other = (*self.periods(state.nonlinear_values), np.empty(0))[:2]
        both = np.concatenate([one, other])
        close = np.abs(one[:, None] - other) < MAX_CONFUSED_PERIODS
        fast = np.minimum(one[:, None], other) > MIN_FAST_PERIODS
        return bool(np.any(close & fast) or np.any((both > MIN_FAST_PERIODS) & (both < MAX_MIXED_PERIODS)))

    def _with_waves_reassigned(
        self, problem: ProjectedProblem, best: SeparableSolution, tried: list[WaveSet]
    ) -> SeparableSolution:
        """The best solution with every frequency that was found in either sum, until nothing is better."""
        refined: list[WaveSet] = []
        before = np.inf
        while best.misfit < (1 - MIN_GAIN_SHARE) * before:
            before, p, place = best.misfit, self.full_vector(best), self._place_of(best)
            search = self._free_waves(place, self.fast)
            sets = [search.refined(periods, problem.data) for periods in self._assignments(p, tried)]
            new = [w for w in _promising(sets, MAX_REASSIGNED_SETS) if not w.resembles(refined, SAME_SET_PERIODS)]
            refined += new
            for q in [p, *(w.p for w in new)]:
                best = self._with_slow_waves(problem, q, best)
        return best

    def _assignments(self, p: Array, tried: list[WaveSet]) -> list[Array]:
        """Periods per run of the fast waves, in their order: every choice out of all that were found."""
        seen = np.concatenate([*self.periods(p), *(w.periods for w in tried), MIXED_PERIODS])
        pool: list[float] = []
        for f in seen[seen > MIN_FAST_PERIODS]:
            if not any(abs(f - g) < SAME_WAVE_PERIODS for g in pool):
                pool.append(float(f))
        choices = product(*(combinations(pool, sum(w in self.fast for w in waves)) for waves in self.sums))
        return [np.concatenate(choice) for choice in choices][:MAX_ASSIGNMENTS]

    # --- slow waves

    def _tabulate_slow_rows(self) -> None:
        """Rows of the slow waves and of the other parts on a grid."""
        low, high = np.log(self.shared_values[[0, -1]])
        self.scanned = np.exp(np.linspace(low, high, SCAN_SHARED_VALUES if high > low else 1))
        self.frequencies = [self._slow_frequencies(w) for w in self.slow]
        pairs = zip(self.slow, self.frequencies, strict=True)
        self.slow_rows = [np.concatenate([self._wave_rows(w, f) for f in own], axis=1) for w, own in pairs]
        self.other_rows = [self._rows(g, {}) for g in self.other_parts]  # (S, k, M) each, like those of slow waves

    def directions_without(self, waves: Sequence[Wave]) -> list[Array]:
        """Directions (D, m) in every block that span the other parts, and the slow waves if these are not searched."""
        slow = [own for w, own in zip(self.slow, self.slow_rows, strict=True) if w not in waves]
        rows = np.concatenate([r.reshape(-1, self.separable.size) for r in (*slow, *self.other_rows)])
        return [_directions(rows[:, cut]) for cut in self.separable.slices]

    def _slow_frequencies(self, w: Wave) -> Array:
        """Scanned frequencies of a slow wave, Hz."""
        low, high = self._bounds(w.frequency)
        width = max(min(high, MAX_SLOW_PERIODS / self.duration) - low, 0.0)
        count = max(round(width * self.duration / SLOW_STEP_PERIODS), 1)
        return low + (np.arange(count) + 0.5) / count * width

    def _with_slow_waves(
        self, problem: ProjectedProblem, p: Array, best: SeparableSolution | None
    ) -> SeparableSolution:
        """The best refined solution with the fast waves of a parameter vector (P,)."""
        starts = [problem.refine(problem.at(q), steps=FIRST_STEPS) for q in self._slow_starts(p, problem.data)]
        for start in sorted(starts, key=lambda s: s.misfit)[:MAX_FINALISTS]:
            limit = np.inf if best is None else best.misfit
            state = problem.refine(start, steps=MAX_STEPS, enough=ROUGH_MIN_FALL, below=limit)
            best = state if state.misfit < limit else best
        assert best is not None
        return best

    def _slow_starts(self, p: Array, data: Array) -> Iterator[Array]:
        """Parameter vectors (P,) with the fast waves of p, at the best minima over slow waves and shared parameter."""
        margins = [1, *([1, 0] * len(self.slow))]  # phases close on themselves
        grid = np.pad(self._misfits(p, data), [(m, m) for m in margins], constant_values=np.inf)
        sides = [grid <= np.roll(grid, step, axis) for axis in range(grid.ndim) for step in (-1, 1)]
        places = np.argwhere(np.all(sides, axis=0) & np.isfinite(grid))
        best = places[np.argsort(grid[tuple(places.T)])[:MAX_STARTS]] - margins
        for s, *pairs in best:
            values = {self.shared: self.scanned[s]}
            for w, own, i, k in zip(self.slow, self.frequencies, pairs[::2], pairs[1::2], strict=True):
                values |= {w.frequency: own[i], w.phase: PHASES[k]}
            yield self._with_values(p, values)

    def _misfits(self, p: Array, data: Array) -> Array:
        """Misfits over shared parameter, and frequency and phase of every slow wave, (S, F, 8) or (S, F, 8, F', 8)."""
        # of two sums a and b, other rows projected out, the amplitudes solve (aa ab; ab bb) c = (ay by)
        others = [*self.other_rows, *(self._rows(g, {}, p) for g in self.other_effects)]
        basis = np.linalg.qr(np.concatenate(others, axis=1).transpose(0, 2, 1))[0]  # (S, M, k)
        y = data - (basis @ (data @ basis)[:, :, None])[:, :, 0]
        sums = [self._trial_sums(p, i, basis) for i in range(len(self.sums))]
        squares = [np.einsum("ti,sij,tj->st", w, rows @ rows.transpose(0, 2, 1), w) for rows, w in sums]
        products = [np.einsum("ti,sim,sm->st", w, rows, y, optimize=True) for rows, w in sums]
        if len(sums) == 1:  # the phases cover negative amplitudes
            gain = np.maximum(products[0], 0.0) ** 2 / squares[0]
        else:
            (a, one), (b, other) = sums
            ab = one @ (a @ b.transpose(0, 2, 1)) @ other.T
            aa, ay, bb, by = squares[0][:, :, None], products[0][:, :, None], squares[1][:, None], products[1][:, None]
            det = np.maximum(aa * bb - ab * ab, MIN_DIFFERENCE_SHARE * aa * bb)
            c, d = bb * ay - ab * by, aa * by - ab * ay
            gain = np.where((c > 0) & (d > 0), (c * ay + d * by) / det, 0.0)
        misfit = np.einsum("sm,sm->s", y, y).reshape(-1, *[1] * len(sums)) - gain
        sizes = chain(*((len(own), len(PHASES)) for own in self.frequencies))
        return misfit.reshape(len(self.scanned), *sizes)

    def _trial_sums(self, p: Array, i: int, basis: Array) -> tuple[Array, Array]:
        """The waves of a sum that stay and the slow quadratures, (S, 1 + 2 F, M), and their weights in all trials."""
        slow = self.slow_rows[i]
        fast = np.zeros((len(slow), 1, slow.shape[2]))
        for w in self.sums[i]:
            if w in self.fast:
                phase = self._value(p, w.phase)
                fast += (
                    np.array([np.cos(phase), np.sin(phase)]) @ self._wave_rows(w, self._value(p, w.frequency))[:, None]
                )
        rows = np.concatenate([fast, slow], axis=1)
        turned = np.kron(np.eye(len(self.frequencies[i])), np.stack([np.cos(PHASES), np.sin(PHASES)], axis=1))
        return rows - (rows @ basis) @ basis.transpose(0, 2, 1), np.hstack([np.ones((len(turned), 1)), turned])


class _FreeWaves:
    """The search for some waves with free amplitudes, at one value of the shared parameter."""

    # what else the effect may consist of is projected out

    def __init__(self, run: _RunSearch, waves: Sequence[Wave], shared_value: float) -> None:
        self.run, self.waves, self.shared_value = run, waves, shared_value
        known = {run.shared: {"fixed": shared_value}} if run.shared else {}
        parts = [e for e in _parts(run.effect.adjusted(**known)) if e.name in {w.part for w in waves}]
        self.spans = run.directions_without(waves)
        blocks = [_without(block, span) for block, span in zip(run.separable.blocks, self.spans, strict=True)]
        self.separable = SeparableModel(run.layout_with(parts), blocks)
        self.addresses = run.addresses_of(self.separable)
        self.search = VariableProjection(self.separable)

    def found(self, data: Array) -> WaveSet:
        """Return the best waves for data (M,)."""
        problem = self.search.problem(self._outside(data))
        state = self.search(problem.data)
        return replace(self._wave_set(state), misses_wave=self.search.misses_effect(problem, state))

    def refined(self, periods: Array, data: Array) -> WaveSet:
        """Return the waves refined from given periods; those that slow waves nearly explain stay where they are."""
        problem, values, refined = self.search.problem(self._outside(data)), self.search.start_values(), list[int]()
        names = [name for _, name in self.addresses]
        for w, own in zip(self.waves, periods, strict=True):
            if w.frequency in names:
                values[names.index(w.frequency)] = own / self.run.duration
            if own > MAX_MIXED_PERIODS:
                refined += [g for g, group in enumerate(self.separable.groups) if group.names == [w.part]]
        return self._wave_set(problem.refine(problem.at(values), refined, steps=ROUGH_STEPS, enough=ROUGH_MIN_FALL))

    def _outside(self, data: Array) -> Array:
        """The part of data (M,) that nothing else explains."""
        pairs = zip(self.spans, self.separable.slices, strict=True)
        return np.concatenate([data[cut] - span.T @ (span @ data[cut]) for span, cut in pairs])

    def _wave_set(self, state: SeparableSolution) -> WaveSet:
        """The waves of a solution in a parameter vector of the full model."""
        law = self.separable.law(state.nonlinear_values, state.coefficients)
        known = dict(zip(self.addresses, map(float, law), strict=True))
        known[self.run.effect.name, self.run.shared] = self.shared_value
        p = np.array([known.get((s.effect, s.parameter), 1.0) for s in self.run.layout.slots])
        return WaveSet(p, state.misfit, np.concatenate([np.sort(own) for own in self.run.periods(p, self.waves)]))


def _promising(sets: list[WaveSet], most: int = MAX_WAVE_SETS) -> list[WaveSet]:
    """The best of every set of waves, best first."""
    chosen: list[WaveSet] = []
    for waves in sorted(sets, key=lambda w: w.misfit):
        if waves.misfit <= MAX_RELAXED_MISFIT_RATIO * (chosen or [waves])[0].misfit and not waves.resembles(chosen):
            chosen.append(waves)
    return chosen[:most]


def _part_names(effect: Effect) -> list[str]:
    """Names of the parts of a relaxed effect as effects of their own."""
    return [f"{effect.name}.{part.effect.name}" for part in effect.relaxed]


def _parts(effect: Effect) -> list[Effect]:
    """The parts as effects of their own, each with a free amplitude; bounds, scans and fixed values of the whole."""
    out = []
    for name, part in zip(_part_names(effect), effect.relaxed, strict=True):
        pairs = zip(part.effect.parameters, map(effect.parameter, part.names), strict=True)
        own = [
            q if q.role == "amplitude" else replace(q, bounds=whole.bounds, scan=whole.scan, fixed=whole.fixed)
            for q, whole in pairs
        ]
        out.append(replace(part.effect, name=name, parameters=tuple(own)))
    return out


def _single_run(separable: SeparableModel, run: int, model: Model) -> SeparableModel:
    """The model of one run alone, without a level."""
    layout = separable.layout
    if len(layout.run_names) == 1:
        return separable
    absent = frozenset((e, 0) for e, r in layout.absent if r == run)
    alone = ParameterLayout(model, (layout.run_names[run],), (layout.spans[run],), absent)
    return SeparableModel(alone, [replace(b, run=0) for b in separable.blocks if b.run == run])


def _with_fixed_values(effect: Effect, found: dict[str, float]) -> Effect:
    """An effect with those non-linear parameters fixed that the runs share and that have been found."""
    known = {q.name: found.get(f"{effect.name}.{q.name}") for q in effect.nonlinear if q.free}
    return effect.adjusted(**{name: {"fixed": value} for name, value in known.items() if value is not None})


def _directions(rows: Array) -> Array:
    """Orthonormal directions (D, m) that span rows (k, m) to a relative precision."""
    _, sizes, directions = np.linalg.svd(rows, full_matrices=False)
    return np.asarray(directions[sizes > SPAN_PRECISION * sizes[0]])


def _without(block: DataBlock, span: Array) -> DataBlock:
    """A block with some directions (D, m) projected out of data and rows."""
    forward, picture = block.forward, block.picture

    def outside(rows: Array) -> Array:
        return np.asarray(rows - (rows @ span.T) @ span)

    return replace(
        block,
        data=outside(block.data),
        forward=lambda rows: outside(forward(rows)),
        picture=lambda rows: outside(picture(rows)),
    )
