"""Find the slow waves of two sums with common amplitudes: an exhaustive scan, then Gauss-Newton from many starts.

Slow waves of two sums are confused with each other and with everything smooth, so that the misfit has many local
minima. Rows of slow waves are smooth in their frequency and in the shared parameter. They are interpolated between
Chebyshev points and expressed in a basis of a few dozen rows, in which many starts are refined at once.

References
----------
Golub, G. H. & Pereyra, V. (1973). SIAM J. Numer. Anal. 10, 413-432.
Kaufman, L. (1975). BIT 15, 49-57.

"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from frictrack.fit.separable.relaxed import RelaxedWaves, Wave
from frictrack.fit.smooth_functions import ChebyshevAxis
from frictrack.records import Array, Mask

MAX_SLOW_PERIODS = 2.1  # periods per run up to which a wave is slow
FREQUENCY_POINTS, SHARED_POINTS = 20, 14  # Chebyshev points; rows are then exact to 1e-4
BASIS_PRECISION = 1e-4  # singular values of the rows below this share of the largest are left out
SCAN_STEP_PERIODS = 0.2  # periods per run between scanned frequencies
SCAN_SHARED_VALUES = 8  # scanned values of the shared parameter
PHASE_COUNT = 8  # scanned phases around the circle
MIN_DIFFERENCE_SHARE = 1e-5  # smallest remaining share of two sums
MAX_STARTS, MAX_FINALISTS = 24, 8  # local minima of the scan that are refined, and to the end
FIRST_ROUND, LAST_ROUND = 6, 20  # Gauss-Newton steps of all starts, and of the finalists
SAME_MISFIT_SHARE = 1e-5  # local minima of misfits this close are the same
NEARBY_PERIODS, NEARBY_POINTS = 1.0, 10  # periods per run within which other waves are refined, and their points
SHARED_STRIDE = 3  # every third point of the shared axis extends the basis
SPAN_PRECISION = 3e-3  # the same for what is projected out while fast waves are searched
RIDGE = 1e-9  # relative; keeps nearly equal rows solvable
TRIAL_PHASES = np.arange(PHASE_COUNT) * 2 * np.pi / PHASE_COUNT - np.pi


@dataclass(frozen=True, eq=False)
class SlowTable:
    """Rows of one slow wave at the points of its axes, in the coordinates of the basis, with their slopes.

    Attributes
    ----------
    frequency : ChebyshevAxis
        Its frequencies, Hz.
    depends_on_shared : bool
        Whether its rows depend on the shared parameter.
    rows : array of shape (n_u n_f, 3 2 D)
        Value, slope over frequency and slope over the logarithm of the shared parameter, of both quadratures.

    """

    frequency: ChebyshevAxis
    depends_on_shared: bool
    rows: Array

    def evaluate(self, shared_weights: Array, frequencies: Array) -> Array:
        """Compute value and both slopes of both quadratures, (Q, 3, 2, D)."""
        weights = self.frequency.weights(frequencies)
        if self.depends_on_shared:
            weights = (shared_weights[:, :, None] * weights[:, None, :]).reshape(len(weights), -1)
        return (weights @ self.rows).reshape(len(weights), 3, 2, -1)


@dataclass(frozen=True, eq=False)
class SlowProblem:
    """The data, the waves to refine, and what stays as it is, in an extended basis (E, M).

    `tables` are the waves to refine and `sum_of` the sum to which each belongs; slow waves come first. `sums`
    (2, n_u, E) are the waves of both sums that stay, at the points of the shared axis, `others` (n_u, k, E) the rows of
    everything with a free coefficient, `slopes` the slopes of both over the logarithm of the shared parameter.
    """

    data: Array  # (E,)
    rest: float  # squared data outside the basis
    tables: list[SlowTable]
    sum_of: list[int]
    sums: Array
    others: Array
    sum_slopes: Array
    other_slopes: Array
    bounds: tuple[Array, Array]  # of the parameters d


@dataclass(frozen=True, eq=False)
class SlowState:
    """Starts x (Q, d): logarithm of the shared parameter, frequency and phase of every wave; with what a step needs."""

    x: Array
    misfit: Array  # (Q,)
    normal: Array  # (Q, d, d)
    gradient: Array  # (Q, d)

    def at(self, chosen: NDArray[np.int_]) -> SlowState:
        """Return some of the starts."""
        return SlowState(self.x[chosen], self.misfit[chosen], self.normal[chosen], self.gradient[chosen])

    def updated(self, trial: SlowState, better: Mask) -> SlowState:
        """Return the states with those replaced that are better in a trial."""
        pairs = ((getattr(self, name), getattr(trial, name)) for name in ("x", "misfit", "normal", "gradient"))
        return SlowState(*(np.where(better.reshape(-1, *(1,) * (a.ndim - 1)), b, a) for a, b in pairs))


class SlowWaves:
    """The slow waves of two sums. The tables depend only on the motion and serve all data along it."""

    def __init__(self, relaxed: RelaxedWaves, pair: tuple[Wave, Wave]) -> None:
        self.relaxed, self.pair = relaxed, pair
        values = relaxed.shared.values if relaxed.shared is not None else (1.0,)
        self.shared = ChebyshevAxis.over(float(np.log(min(values))), float(np.log(max(values))), SHARED_POINTS)
        axes = [self._frequency_axis(w) for w in pair]
        raw = [self._raw_rows(w, axis) for w, axis in zip(pair, axes, strict=True)]
        self.raw_others = relaxed.other_parts(np.exp(self.shared.points))
        self.basis, sizes = _basis([*raw, self.raw_others])
        self.span = self.basis[sizes > SPAN_PRECISION * sizes[0]]
        self.tables = tuple(self._table(w, a, r, self.basis) for w, a, r in zip(pair, axes, raw, strict=True))
        self._scan_points = self._scanned()

    def _frequency_axis(self, w: Wave) -> ChebyshevAxis:
        low, high = self.relaxed.bounds(w.frequency)
        limit = MAX_SLOW_PERIODS / self.relaxed.full_model.layout.span.duration
        return ChebyshevAxis.over(low, max(low, min(high, limit)), FREQUENCY_POINTS)

    def _raw_rows(self, w: Wave, axis: ChebyshevAxis) -> Array:
        """Rows (n_u, n_f, 2, M) at all points of the axes; n_u is one if the shared parameter has no effect."""
        shared = np.exp(self.shared.points) if self.relaxed.depends_on_shared(w) else np.ones(1)
        rows = self.relaxed.quadratures(w, np.tile(axis.points, len(shared)), np.repeat(shared, axis.count))
        return rows.reshape(len(shared), axis.count, 2, -1)

    def _table(self, w: Wave, axis: ChebyshevAxis, raw: Array, basis: Array) -> SlowTable:
        """The table of a wave in a basis (E, M), from its rows at all points of the axes."""
        rows = raw @ basis.T
        over_frequency = np.einsum("ij,ujqd->uiqd", axis.slopes, rows)
        depends = self.relaxed.depends_on_shared(w)
        over_shared = np.einsum("ij,jfqd->ifqd", self.shared.slopes, rows) if depends else np.zeros_like(rows)
        stacked = np.stack([rows, over_frequency, over_shared], axis=2)
        return SlowTable(axis, depends, stacked.reshape(stacked.shape[0] * stacked.shape[1], -1))

    def _scanned(self) -> tuple[Array, list[Array], list[Array]]:
        """Scanned values of the shared axis (S,), frequencies (F,) and rows at all phases (S, F P, D) of both waves."""
        count = SCAN_SHARED_VALUES if self.shared.count > 1 else 1
        shared = np.linspace(self.shared.low, self.shared.high, count)
        frequencies, rows = [], []
        for table in self.tables:
            axis = table.frequency
            steps = round((axis.high - axis.low) * self.relaxed.full_model.layout.span.duration / SCAN_STEP_PERIODS)
            own = axis.low + (np.arange(max(steps, 1)) + 0.5) / max(steps, 1) * (axis.high - axis.low)
            weights = self.shared.weights(np.repeat(shared, len(own)))
            waves = table.evaluate(weights, np.tile(own, count))[:, 0]
            rotations = np.stack([np.cos(TRIAL_PHASES), np.sin(TRIAL_PHASES)], axis=1)
            frequencies.append(own)
            rows.append((rotations @ waves).reshape(count, len(own) * PHASE_COUNT, -1))
        return shared, frequencies, rows

    # --- search

    def __call__(self, p: Array, data: Array, all_waves: bool = False) -> list[tuple[float, Array]]:
        """Find the slow waves of data beside all other waves of a model.

        Parameters
        ----------
        p : array of shape (P,)
            Parameter vector of the full model with the other waves.
        data : array of shape (M,)
            Whitened data.
        all_waves : bool
            Whether the other waves are refined too, and not only the slow ones.

        Returns
        -------
        list of (float, array of shape (P,))
            Misfits of the local minima, best first, and their parameter vectors.

        """
        problem = self._problem(p, data)
        starts = self._starts(problem)
        waves = list(self.pair)
        if all_waves:
            own = [w for w in self.relaxed.waves if w not in waves]
            problem, waves = self._problem(p, data, own), waves + own
            known = [v for w in own for v in (self.relaxed.value(p, w.frequency), self.relaxed.value(p, w.phase))]
            starts = np.concatenate([starts, np.tile(known, (len(starts), 1))], axis=1)
        return self._best(problem, starts, p, waves)

    def near(self, p: Array, data: Array) -> list[tuple[float, Array]]:
        """Refine all waves of a parameter vector (P,) from many values of the shared parameter; see `__call__`."""
        waves, shared = list(self.relaxed.waves), self._scan_points[0]
        known = [v for w in waves for v in (self.relaxed.value(p, w.frequency), self.relaxed.value(p, w.phase))]
        starts = np.concatenate([shared[:, None], np.tile(known, (len(shared), 1))], axis=1)
        return self._best(self._problem(p, data, waves), starts, p, waves)

    def _best(self, problem: SlowProblem, starts: Array, p: Array, waves: Sequence[Wave]) -> list[tuple[float, Array]]:
        """Misfits and parameter vectors (P,) of the local minima that starts (Q, d) lead to, best first."""
        state = self._refined(problem, self._evaluate(problem, starts), FIRST_ROUND)
        state = self._refined(problem, state.at(np.argsort(state.misfit)[:MAX_FINALISTS]), LAST_ROUND)
        return [(float(state.misfit[i]), self._full_vector(p, waves, state.x[i])) for i in _distinct(state)]

    def _problem(self, p: Array, data: Array, refined: Sequence[Wave] = ()) -> SlowProblem:
        """The data and the other waves in the basis, extended by what lies outside it.

        The slow waves are refined wherever they are slow, or near p if they are among those `refined`.
        """
        effects = self.relaxed.other_effects(p)
        shared = np.exp(self.shared.points)
        sums = [self._other_waves(p, w, shared, refined) for w in self.pair]
        axes = [self._nearby(p, w) for w in refined]
        raw = [self._raw_rows(w, axis) for w, axis in zip(refined, axes, strict=True)]
        rows = np.concatenate([effects, *sums, *(r[::SHARED_STRIDE].reshape(-1, r.shape[-1]) for r in raw)])
        outside = rows - (rows @ self.basis.T) @ self.basis
        basis = np.concatenate([self.basis, _basis([outside])[0]])
        own = [self._table(w, a, r, basis) for w, a, r in zip(refined, axes, raw, strict=True)]
        both = np.stack([np.broadcast_to(s @ basis.T, (len(shared), len(basis))) for s in sums])
        constant = np.broadcast_to(effects @ basis.T, (len(shared), len(effects), len(basis)))
        others = np.concatenate([self.raw_others @ basis.T, constant], axis=1)
        y = basis @ data
        slopes = self.shared.slopes
        slow = [i for i, w in enumerate(self.pair) if w not in refined]
        tables = [*(self.tables[i] for i in slow), *own]
        limits = [(self.shared.low, self.shared.high)]
        for table in tables:
            limits += [(table.frequency.low, table.frequency.high), (-np.inf, np.inf)]
        low, high = np.array(limits).T
        return SlowProblem(
            data=y,
            rest=float(data @ data - y @ y),
            tables=tables,
            sum_of=[*slow, *(int(w.size == self.pair[1].size) for w in refined)],
            sums=both,
            others=others,
            sum_slopes=slopes @ both,
            other_slopes=np.einsum("ij,jke->ike", slopes, others),
            bounds=(low, high),
        )

    def _nearby(self, p: Array, w: Wave) -> ChebyshevAxis:
        """The frequencies within which a wave that is not slow is refined."""
        low, high = self.relaxed.bounds(w.frequency)
        width = NEARBY_PERIODS / self.relaxed.full_model.layout.span.duration
        f = self.relaxed.value(p, w.frequency)
        return ChebyshevAxis.over(max(low, f - width), min(high, f + width), NEARBY_POINTS)

    def _other_waves(self, p: Array, slow: Wave, shared: Array, refined: Sequence[Wave]) -> Array:
        """Sum (n_u or 1, M) of the waves that stay, in the sum to which a slow wave belongs."""
        values = shared if self.relaxed.depends_on_shared(slow) else shared[:1]
        waves = [w for w in self.relaxed.sums[slow.size] if w != slow and w not in refined]
        rows = np.zeros((len(values), self.relaxed.separable.size))
        for w in waves:
            rows += self.relaxed.wave_rows(p, w, values)
        return rows

    def _starts(self, problem: SlowProblem) -> Array:
        """The most promising local minima (Q, 5) of the scan over shared parameter, frequencies and phases."""
        shared, frequencies, rows = self._scan_points
        weights = self.shared.weights(shared)
        others = np.einsum("su,uke->ske", weights, problem.others)
        ortho = np.linalg.qr(others.transpose(0, 2, 1))[0]
        y = problem.data - (ortho @ (ortho.transpose(0, 2, 1) @ problem.data)[:, :, None])[:, :, 0]
        a, b = (self._with_waves(r, weights @ s, ortho) for r, s in zip(rows, problem.sums, strict=True))
        g11, g22 = np.einsum("sie,sie->si", a, a)[:, :, None], np.einsum("sie,sie->si", b, b)[:, None, :]
        u1, u2 = (a @ y[:, :, None]), (b @ y[:, :, None]).transpose(0, 2, 1)
        g12 = a @ b.transpose(0, 2, 1)
        det = np.maximum(g11 * g22 - g12 * g12, MIN_DIFFERENCE_SHARE * g11 * g22)
        c1, c2 = g22 * u1 - g12 * u2, g11 * u2 - g12 * u1
        gain = np.where((c1 > 0) & (c2 > 0), (c1 * u1 + c2 * u2) / det, 0.0)
        cost = np.sum(y * y, axis=1)[:, None, None] - gain
        sizes = [len(f) for f in frequencies]
        grid = cost.reshape(len(shared), sizes[0], PHASE_COUNT, sizes[1], PHASE_COUNT)
        places = _local_minima(grid, periodic=(2, 4))
        s, i, m, j, n = places[np.argsort(grid[tuple(places.T)])[:MAX_STARTS]].T
        starts = (shared[s], frequencies[0][i], TRIAL_PHASES[m], frequencies[1][j], TRIAL_PHASES[n])
        return np.stack(starts, axis=1)

    @staticmethod
    def _with_waves(rows: Array, sums: Array, ortho: Array) -> Array:
        """Sums (S, F P, E) with a slow wave at every trial, the other rows projected out."""
        whole = np.repeat(sums[:, None, :], rows.shape[1], axis=1)
        whole[:, :, : rows.shape[2]] += rows
        return np.asarray(whole - (whole @ ortho) @ ortho.transpose(0, 2, 1))

    def _refined(self, problem: SlowProblem, state: SlowState, steps: int) -> SlowState:
        """All starts refined by Levenberg-Marquardt."""
        damping = np.full(len(state.x), 1e-3)
        for _ in range(steps):
            x = np.clip(state.x + _damped_step(state, damping, *problem.bounds), *problem.bounds)
            trial = self._evaluate(problem, x)
            better = trial.misfit < state.misfit
            state = state.updated(trial, better)
            damping = np.where(better, 0.1 * damping, 10 * damping)
        return state

    def _evaluate(self, problem: SlowProblem, x: Array) -> SlowState:
        """Misfits and normal equations of starts (Q, d), amplitudes and free coefficients projected out."""
        weights = self.shared.weights(x[:, 0])
        q, e, n = len(x), len(problem.data), len(problem.tables)
        k = problem.others.shape[1]
        columns = np.empty((q, 2 + k, e))
        columns[:, :2] = np.einsum("qu,sue->qse", weights, problem.sums)
        columns[:, 2:] = (weights @ problem.others.reshape(len(weights[0]), -1)).reshape(q, k, e)
        over_shared = np.einsum("qu,sue->qse", weights, problem.sum_slopes)
        slopes = np.zeros((q, n, 2, e))  # of every wave over frequency and phase
        for i, (table, s) in enumerate(zip(problem.tables, problem.sum_of, strict=True)):
            rows = table.evaluate(weights, x[:, 1 + 2 * i])
            d = rows.shape[-1]
            phase = x[:, 2 + 2 * i]
            rotated = np.stack([np.cos(phase), np.sin(phase)], axis=1)[:, None, None, :] @ rows
            columns[:, s, :d] += rotated[:, 0, 0]
            slopes[:, i, 0, :d] = rotated[:, 1, 0]
            over_shared[:, s, :d] += rotated[:, 2, 0]
            slopes[:, i, 1, :d] = np.cos(phase)[:, None] * rows[:, 0, 1] - np.sin(phase)[:, None] * rows[:, 0, 0]
        c, residual, inverse = _least_squares(columns, problem.data)
        other_slopes = (weights @ problem.other_slopes.reshape(len(weights[0]), -1)).reshape(q, k, e)
        jacobian = np.empty((q, 1 + 2 * n, e))
        jacobian[:, 0] = np.einsum("qs,qse->qe", c[:, :2], over_shared)
        jacobian[:, 0] += np.einsum("qk,qke->qe", c[:, 2:], other_slopes)
        jacobian[:, 1:] = (c[:, problem.sum_of, None, None] * slopes).reshape(q, 2 * n, e)
        across = jacobian @ columns.transpose(0, 2, 1)
        normal = jacobian @ jacobian.transpose(0, 2, 1) - across @ inverse @ across.transpose(0, 2, 1)
        gradient = (jacobian @ residual[:, :, None])[:, :, 0]
        return SlowState(x, problem.rest + np.einsum("qe,qe->q", residual, residual), normal, gradient)

    def _full_vector(self, p: Array, waves: Sequence[Wave], x: Array) -> Array:
        """The parameter vector (P,) with the waves and the shared parameter of a state (d,)."""
        out, relaxed = p.copy(), self.relaxed
        if relaxed.shared is not None:
            relaxed.set_value(out, relaxed.shared.name, float(np.exp(x[0])))
        for w, frequency, phase in zip(waves, x[1::2], x[2::2], strict=True):
            relaxed.set_value(out, w.frequency, frequency)
            relaxed.set_value(out, w.phase, phase)
        return out


def _damped_step(state: SlowState, damping: Array, low: Array, high: Array) -> Array:
    """Damped Gauss-Newton steps (Q, d); parameters at a bound that they would cross stay."""
    gradient, normal = state.gradient, state.normal.copy()
    held = ((state.x <= low) & (gradient <= 0)) | ((state.x >= high) & (gradient >= 0))
    held |= np.einsum("qii->qi", normal) <= 0
    normal[held[:, :, None] | held[:, None, :]] = 0.0
    diagonal = np.einsum("qii->qi", normal)  # a view
    diagonal *= 1 + damping[:, None] + RIDGE
    diagonal[held] = 1.0
    return np.asarray(np.linalg.solve(normal, np.where(held, 0.0, gradient)[:, :, None])[:, :, 0])


def _basis(rows: list[Array]) -> tuple[Array, Array]:
    """Orthonormal basis (D, M) of rows (..., M), to a relative precision, and its singular values (D,), falling."""
    flat = np.concatenate([r.reshape(-1, r.shape[-1]) for r in rows])
    values, vectors = np.linalg.eigh(flat @ flat.T)
    kept = np.flatnonzero(values > max(BASIS_PRECISION**2 * values[-1], np.finfo(float).tiny))[::-1]
    sizes = np.sqrt(values[kept])
    return np.asarray((vectors[:, kept] / sizes).T @ flat), sizes


def _distinct(state: SlowState) -> list[int]:
    """Indices of distinct local minima, best first: those whose misfits differ."""
    chosen: list[int] = []
    for i in map(int, np.argsort(state.misfit)):
        if not chosen or state.misfit[i] > (1 + SAME_MISFIT_SHARE) * state.misfit[chosen[-1]]:
            chosen.append(i)
    return chosen


def _local_minima(values: Array, periodic: tuple[int, ...]) -> NDArray[np.int_]:
    """Indices (k, d) of the points that are not above their two neighbours on any axis."""
    lowest = np.ones(values.shape, dtype=bool)
    for axis in range(values.ndim):
        moved, low = np.moveaxis(values, axis, 0), np.moveaxis(lowest, axis, 0)
        rises = moved[1:] >= moved[:-1]
        low[:-1] &= rises
        low[1:] &= moved[1:] <= moved[:-1]
        if axis in periodic:
            low[-1] &= moved[0] >= moved[-1]
            low[0] &= moved[-1] >= moved[0]
    return np.argwhere(lowest)


def _least_squares(columns: Array, data: Array) -> tuple[Array, Array, Array]:
    """Coefficients (Q, k), residuals (Q, E) and inverse Gram matrices (Q, k, k) of columns (Q, k, E)."""
    gram = columns @ columns.transpose(0, 2, 1)
    size = np.sqrt(np.maximum(np.einsum("qkk->qk", gram), 1e-300))
    unit = gram / size[:, :, None] / size[:, None, :] + RIDGE * np.eye(gram.shape[1])
    inverse = np.linalg.inv(unit) / size[:, :, None] / size[:, None, :]
    c = (inverse @ (columns @ data)[:, :, None])[:, :, 0]
    return c, data - (c[:, None, :] @ columns)[:, 0], inverse
