"""Expected evidence between effects of the library in planned runs, from small matrices per run that add up.

Every effect is the truth at a planned size, and every other one is fitted to it over its whole scan, linearised along
the simulated motion. Let S be the columns that the runs share (sensitivities of the law, and of a rival with shared
coefficients), O a run's own ones (its friction level, and a rival with coefficients per run), and d the traces of the
true effects. With P the prior of the level, a run contributes

    M - [S d]'O (O'O + P)^-1 O'[S d],     M = [S d]'[S d]

Summed over runs, the part of a trace that neither the law nor the rival explains is d'd - d'S (S'S)^-1 S'd.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import numpy as np

from frictrack import effects
from frictrack.base.errors import FrictrackError
from frictrack.diagnose.experiments.candidates import ExperimentSetup, candidate_runs
from frictrack.diagnose.experiments.virtual_runs import (
    GOLDEN_ANGLE_RAD,
    PLANNED_RUN_NAME,
    RunDesign,
    VirtualRun,
    make_run,
)
from frictrack.diagnose.power import rms_of_parts
from frictrack.effects import PLANNED_SHARE, Effect, Span, models
from frictrack.effects.models import Model
from frictrack.fit.least_squares import displacement_response
from frictrack.fit.linearised import has_per_run_coefficients
from frictrack.fit.parameters import MIN_RUNS_FOR_SCATTER, ParameterLayout
from frictrack.fit.stepwise import bic_penalty
from frictrack.records import Array

MEASUREMENT_NOISE_RATIO = 1.0  # size of a measurement fault (rms) over the noise per frame
MAX_GRID_POINTS = 150  # per effect
MAX_FREQUENCY_HZ = 250.0  # up to which spectral lines are searched for
EVENT_TIMES = np.linspace(0.05, 0.95, 24)  # times of an event, as shares of a run
PANELS_PER_FRAME = 3  # as a blow needs them
QUADRATURES = (0.0, np.pi / 2)
RIDGE_RATIO = 1e-9  # regularises directions that no run shows
MIN_SQUARE_SHARE = 1e-10  # of a column's square, below which it is rounding

Progress = Callable[[int, int, str], None]


def simulate_runs(setup: ExperimentSetup, designs: Sequence[RunDesign]) -> list[VirtualRun]:
    """Simulate the candidate runs that are long enough; raise FrictrackError if there are none."""

    def unknowns(span: Span) -> tuple[ParameterLayout, Array]:
        layout = ParameterLayout(setup.law, ("another", PLANNED_RUN_NAME), (span, span))  # two runs have levels
        p = [setup.values[s.effect][s.parameter] if s.effect in setup.values else 1.0 for s in layout.slots]
        return layout, np.array(p)

    near, made = Span(1.0, setup.start, setup.start + setup.course, 0.01, 10.0, setup.fps), []
    for design in designs:
        with suppress(FrictrackError):  # the mass would not get far enough
            made.append(make_run(setup.conditions, design, unknowns, near, PANELS_PER_FRAME))
    if not made:
        raise FrictrackError(
            f"expected a course long enough for a run but on {setup.course:.2g} m at {setup.fps:g} frames/s every "
            "candidate run is too short; give a finer scale or a higher fps in [camera]"
        )
    return made


def span_of_runs(runs: Sequence[VirtualRun]) -> Span:
    """Range of time, place and speed of the simulated runs."""
    spans = [r.layout.spans[0] for r in runs]
    low, high = runs[0].design.course
    durations, slowest, fastest = zip(*((s.duration, s.v_min, s.v_max) for s in spans), strict=True)
    return Span(max(durations), low, high, min(slowest), max(fastest), spans[0].fps)


@dataclass(frozen=True)
class Cause:
    """One effect in a plan.

    Parameters
    ----------
    effect
        The effect.
    setting
        Its non-linear parameters if it is the true cause.
    grid
        The settings (G) at which it is fitted as a rival; times of an event as shares of the run.

    """

    effect: Effect
    setting: dict[str, float]
    grid: tuple[dict[str, float], ...]

    @property
    def times(self) -> list[str]:
        """Parameters that are times of an event, which happens at a time of its own in every run."""
        return [p.name for p in self.effect.nonlinear if p.per_run and p.scan is not None]

    @property
    def phases(self) -> list[str]:
        """Parameters that are phases."""
        return [p.name for p in self.effect.nonlinear if p.role == "phase"]


def list_causes(law: Model, runs: Sequence[VirtualRun]) -> tuple[list[Cause], dict[str, str]]:
    """List the effects that a plan examines in addition to a friction law, and those left out with the reason."""
    span, path = span_of_runs(runs), runs[0].piece.path
    present = {e.kind for e in law.effects}
    replaced = frozenset[str]().union(*(e.replaces for e in law.effects))
    causes, excluded = [], {}
    for effect in effects.LIBRARY.values():
        if effect.name in present or effect.kind in replaced or effect.replaces:
            continue
        if effect.modifies and not effect.changed(law.effects):
            excluded[effect.name] = f"modifies {' or '.join(sorted(effect.modifies))}, which the model does not contain"
        elif lacking := effect.lacks([path]):
            excluded[effect.name] = lacking.removeprefix(f"{effect.name} ").partition(";")[0]
        else:
            causes.append(_make_cause(effect, span))
    return causes, excluded


def _make_cause(effect: Effect, span: Span) -> Cause:
    """An effect at its typical setting, and its grid thinned to `MAX_GRID_POINTS` points with that setting."""
    typical, axes, is_event = {}, {}, False
    for p in effect.nonlinear:
        if p.role in ("phase", "depth"):
            typical[p.name] = 0.0 if p.role == "phase" else 1.0
        elif p.scan is None or not p.free:
            typical[p.name] = p.fixed if p.fixed is not None else _middle(*p.bounds, signed=p.signed)
        else:
            values = np.asarray(p.scan(span), dtype=float)
            low = values <= MAX_FREQUENCY_HZ  # such runs resolve higher ones badly
            values = values[low] if p.name == "frequency" and low.any() else values
            typical[p.name] = _middle(float(values.min()), float(values.max()), signed=p.signed)
            axes[p.name] = EVENT_TIMES if p.per_run else values
            is_event = is_event or p.per_run
    # of every axis the same share of its logarithm is kept
    share = min(np.log(MAX_GRID_POINTS) / max(np.log(np.prod([len(a) for a in axes.values()])), 1e-9), 1.0)
    counts = {n: n if share == 1 else max(min(n, 3), int(n**share)) for n in map(len, axes.values())}
    kept = [a[np.unique(np.linspace(0, len(a) - 1, counts[len(a)]).astype(int))] for a in axes.values()]
    points = [typical | dict(zip(axes, map(float, point), strict=True)) for point in product(*kept)]
    return Cause(effect, typical, tuple(points if is_event else [typical, *points]))


def _middle(low: float, high: float, *, signed: bool) -> float:
    """The middle of a range, the geometric middle of a positive one."""
    if not (np.isfinite(low) and np.isfinite(high)):
        return 1.0
    return float(np.sqrt(low * high)) if low > 0 and not signed else 0.5 * (low + high)


def _raw_columns(planned: VirtualRun, effect: Effect, settings: Sequence[dict[str, float]]) -> Array:
    """Columns of an effect at G settings, (m, G k): forces at the nodes, N, or shifts of the picture, m.

    A modifier makes the difference to the force that it changes.
    """
    motion, piece, model = planned.response.motion, planned.piece, planned.layout.model
    if effect.acts_on == "measurement":
        path = piece.at_frames(motion.x_edge[piece.at], motion.v_edge[piece.at], 1.0)
    else:
        path = piece.path_at_nodes(motion.x, motion.v, 1.0)
    if not effect.modifies:
        return np.concatenate([effect.columns(path, setting) for setting in settings], axis=1)
    values, _ = planned.layout.values(planned.p, piece.run)
    present = model.force_columns(path, values)
    changed = (present[e.name] @ model.coefficients(e.name, values) for e in effect.changed(model.effects))
    inner = np.sum(list(changed), axis=0)[:, None]
    return np.concatenate([effect.columns(path, setting, inner) - inner for setting in settings], axis=1)


def effect_columns(planned: VirtualRun, cause: Cause, grid: Sequence[dict[str, float]]) -> Array:
    """Whitened columns (n, G, k) of an effect at G settings in one run, initial conditions projected out.

    An effect with a phase has a sine and a cosine column.
    """
    effect, response = cause.effect, planned.response
    length = float(response.piece.t[-1])
    timed = [setting | {name: setting[name] * length for name in cause.times} for setting in grid]
    phased = [dict.fromkeys(cause.phases, q) for q in QUADRATURES] if cause.phases else [{}]
    raw = _raw_columns(planned, effect, [setting | phase for setting in timed for phase in phased])
    if effect.acts_on == "measurement":
        white = response.piece.whitened(raw)
        white -= response.q @ (response.q.T @ white)
    else:
        white = displacement_response(response, raw)
    return white.reshape(len(white), len(grid), -1)


def planned_size(runs: Sequence[VirtualRun], cause: Cause) -> float:
    """Coefficient at which an effect has its planned size over the candidate runs."""
    effect = cause.effect
    if effect.planned_size is not None:
        momenta = [r.piece.mass * abs(r.design.start[1]) for r in runs]
        return effect.planned_size(float(np.median(momenta)))
    if effect.acts_on == "force" and not effect.sized:
        return 1.0
    of_one = [_raw_columns(r, effect, [cause.setting])[:, 0] for r in runs]
    if effect.acts_on == "measurement":
        shifts = [column / r.piece.sigma for column, r in zip(of_one, runs, strict=True)]
        return MEASUREMENT_NOISE_RATIO / max(rms_of_parts(shifts), 1e-300)
    friction = np.concatenate([r.piece.mass * (r.piece.known - r.response.motion.a) for r in runs])
    return PLANNED_SHARE * float(np.mean(np.abs(friction))) / max(rms_of_parts(of_one), 1e-300)


def effect_trace(planned: VirtualRun, cause: Cause, size: float, number: int) -> Array:
    """Trace (n,) of a true effect of a given size in one run; times and phases spread evenly over the runs."""
    share = 0.3 + 0.4 * ((0.618 * (number + 1)) % 1.0)
    block = effect_columns(planned, cause, [cause.setting | dict.fromkeys(cause.times, share)])[:, 0]
    if not cause.phases:
        return size * block[:, 0]
    phase = GOLDEN_ANGLE_RAD * number if has_per_run_coefficients(cause.effect) else 0.5
    return size * (block[:, 0] * np.cos(phase) + block[:, 1] * np.sin(phase))


@dataclass(frozen=True)
class NormalMatrices:
    """Inner products of one run, or of several added, for G grid points of one rival and D true effects.

    Parameters
    ----------
    ss, sd, dd
        Products (2, G, s, s), (2, G, s, D) and (2, G, D) of shared columns s and traces d. First axis: friction levels
        free, or with their scatter as prior.
    moments
        Weighted sums (3, G, D) of 1, a and a^2, where a is the rival's amplitude in each run.
    runs, frames
        Number of runs and frames.
    paired
        Whether every true effect has one grid point of its own instead, (2, D, s, 1) and so on.

    """

    ss: Array
    sd: Array
    dd: Array
    moments: Array
    runs: int
    frames: int
    paired: bool

    @classmethod
    def of_runs(cls, parts: Sequence[NormalMatrices]) -> NormalMatrices:
        """Add the matrices of several runs."""
        sums: dict[str, Any] = {
            name: sum(getattr(part, name) for part in parts) for name in ("ss", "sd", "dd", "moments", "runs", "frames")
        }
        return replace(parts[0], **sums)

    def unexplained_chi2(self, *, scatter_known: bool = True) -> Array:
        """Chi-squared (D,) of every true effect that the law and the best fit of the rival leave unexplained.

        A rival that needs a different amplitude in every run gets them, at the penalty of BIC for each. Where the
        scatter of the levels is not known, these runs alone show it: what the levels say has only as many degrees of
        freedom.
        """
        norm = np.sqrt(np.maximum(np.einsum("kgss->kgs", self.ss), 1e-300))
        unit = self.ss / norm[..., :, None] / norm[..., None, :] + RIDGE_RATIO * np.eye(self.ss.shape[-1])
        right = self.sd / norm[..., None]
        free, known = self.dd - np.sum(right * np.linalg.solve(unit, right), axis=2)  # d'd - d'S (S'S)^-1 S'd
        if self.runs < MIN_RUNS_FOR_SCATTER:
            left = free
        else:
            left = known if scatter_known else free + chi2_equivalent(known - free, self.runs - 2)
        weight, first, second = self.moments
        one_amplitude = np.maximum(second - first**2 / np.maximum(weight, 1e-300), 0.0)
        left = left + np.minimum(one_amplitude, bic_penalty(self.runs - 1, max(self.frames, 2)))
        return np.asarray(left[:, 0] if self.paired else np.min(left, axis=0))


def chi2_equivalent(t2: Array, df: int) -> Array:
    """Chi-squared of one degree of freedom that is as improbable as the square of Student's t.

    References
    ----------
    Wallace, D. L. (1959). Ann. Math. Stat. 30, 1121-1130.

    Examples
    --------
    >>> round(float(chi2_equivalent(np.array(10.13), 3)), 1)  # both of probability 0.05
    3.8

    """
    return np.asarray(((8 * df + 1) / (8 * df + 3)) ** 2 * df * np.log1p(np.maximum(t2, 0.0) / df))


def reduce_run(
    planned: VirtualRun, traces: Array, tau: float, rival: Cause | None = None, without: str = ""
) -> NormalMatrices:
    """Reduce one run with traces (n, D) of the true effects, against all grid points of a rival if there is one.

    `tau` is the relative scatter of the friction level; the law is taken without one of its effects, if named.
    """
    law = planned.columns_of_law(without)
    shared, own, truth = law[None], np.empty((1, len(traces), 0)), traces[None]
    paired = rival is not None and bool(rival.times)
    if rival is not None:
        block = effect_columns(planned, rival, rival.grid).transpose(1, 0, 2)  # (G, n, k)
        if paired:  # each trace takes the time and width that explain it best
            own, truth = block[_best_points(planned, block, traces)], traces.T[:, :, None]
        elif has_per_run_coefficients(rival.effect):
            own = block
        else:
            shared = np.concatenate([np.broadcast_to(law, (len(block), *law.shape)), block], axis=2)
    level = np.broadcast_to(planned.level_column, (len(own), len(traces), 1))
    ss, sd, dd = _products(shared, shared), _products(shared, truth), np.sum(truth**2, axis=1)
    each = []
    columns = np.concatenate([level, own], axis=2)
    os, od, oo = (_products(columns, other) for other in (shared, truth, columns))
    for prior in (RIDGE_RATIO * oo[:, 0, 0], tau**-2):  # a free level may be all that a coefficient does in a run
        gram = oo.copy()
        gram[:, 0, 0] += prior
        weighted = _inverse(gram)
        so = os.transpose(0, 2, 1) @ weighted
        each.append((ss - so @ os, sd - so @ od, dd - np.sum(od * (weighted @ od), axis=1)))
    ss, sd, dd = (np.stack(both) for both in zip(*each, strict=True))
    moments = np.zeros((3, *dd.shape[1:]))
    if own.shape[2] and not paired:
        inverse, mine = _inverse(oo[:, 1:, 1:]), od[:, 1:]
        size = np.sqrt(np.sum((inverse @ mine) ** 2, axis=1))
        weight = np.einsum("gkk->g", oo[:, 1:, 1:])[:, None] / own.shape[2]
        moments = weight * np.stack([np.ones_like(size), size, size**2])
    return NormalMatrices(ss, sd, dd, moments, 1, len(traces), paired)


def _products(a: Array, b: Array) -> Array:
    """Inner products a'b of columns (G, n, k)."""
    return np.asarray(a.transpose(0, 2, 1) @ b)


def _best_points(planned: VirtualRun, block: Array, traces: Array) -> Array:
    """Grid point of an event's columns (G, n, k) that explains most of each trace (n, D) apart from the law, (D,)."""
    q, _ = np.linalg.qr(np.column_stack([planned.columns_of_law(), planned.level_column]))
    left = block - q @ (q.T @ block)
    right = left.transpose(0, 2, 1) @ traces
    return np.asarray(np.argmax(np.sum(right * (_inverse(_products(left, left)) @ right), axis=1), axis=0))


def _inverse(gram: Array) -> Array:
    """Inverses of Gram matrices (G, k, k) on the directions that exist."""
    size = np.sqrt(np.maximum(np.einsum("gkk->gk", gram), 1e-300))
    w, v = np.linalg.eigh(gram / size[:, :, None] / size[:, None, :])
    good = (w > MIN_SQUARE_SHARE) & (np.max(size, axis=1)[:, None] > 1e-10)
    inverse = (v * np.where(good, 1 / np.maximum(w, MIN_SQUARE_SHARE), 0.0)[:, None, :]) @ v.transpose(0, 2, 1)
    return np.asarray(inverse / size[:, :, None] / size[:, None, :])


@dataclass(frozen=True)
class EvidenceTables:
    """Normal matrices of every candidate run for every effect.

    Parameters
    ----------
    runs
        The simulated runs, R of them.
    causes
        The effects, D of them.
    sizes
        Planned size of each effect, (D,).
    matrices
        Matrices of each run against each effect, and last without a rival: ``matrices[run][cause]``.
    raw_chi2
        Chi-squared of every trace before anything is fitted to it, (R, D): what a mark at rest in the picture shows.

    """

    runs: list[VirtualRun]
    causes: list[Cause]
    sizes: Array
    matrices: list[list[NormalMatrices]]
    raw_chi2: Array

    @property
    def names(self) -> list[str]:
        """Names of the effects."""
        return [c.effect.name for c in self.causes]

    def evidence(self, chosen: list[int], *, reference: bool) -> Array:
        """Expected chi-squared (D, D + 1) that separates each true effect (row) from each rival, the last one none.

        `chosen` are indices of runs; with `reference`, a mark at rest is filmed too.
        """
        d = len(self.causes)
        if not chosen:
            return np.zeros((d, d + 1))
        by_rival = zip(*(self.matrices[r] for r in chosen), strict=True)
        out = np.column_stack([NormalMatrices.of_runs(parts).unexplained_chi2() for parts in by_rival])
        bare = out[:, -1].copy()
        for k in (i for i, c in enumerate(self.causes) if reference and c.effect.moves_picture):
            out[k] += self.raw_chi2[chosen, k].sum()
            out[:, k] = np.where(np.arange(d) == k, out[:, k], bare)
        out[np.arange(d), np.arange(d)] = np.inf
        return np.maximum(out, 0.0)


def tabulate_evidence(setup: ExperimentSetup, notify: Progress) -> tuple[EvidenceTables, dict[str, str]]:
    """Simulate every candidate run and reduce it against every effect; return effects left out and why, too."""
    runs = simulate_runs(setup, [*setup.completed, *candidate_runs(setup)])
    causes, excluded = list_causes(setup.law, runs)
    sizes = np.array([planned_size(runs, c) for c in causes])
    matrices, raw_chi2 = [], []
    for number, run in enumerate(runs):
        notify(number, len(runs), f"simulating {run.design.key}")
        traces = np.column_stack([effect_trace(run, c, s, number) for c, s in zip(causes, sizes, strict=True)])
        matrices.append([reduce_run(run, traces, setup.scatter, rival) for rival in (*causes, None)])
        raw_chi2.append(np.sum(traces**2, axis=0))
    return EvidenceTables(runs, causes, sizes, matrices, np.array(raw_chi2)), excluded


def tabulate_effect(runs: Sequence[VirtualRun], name: str, share: float, scatter: float) -> list[NormalMatrices] | None:
    """Matrices of the law without an effect, of a share of the friction, in every run; None if that is not possible."""
    law = models.of([e for e in runs[0].layout.model.effects if e.name != name])
    cause = next((c for c in list_causes(law, runs)[0] if c.effect.name == name), None)
    if cause is None:
        return None
    size = planned_size(runs, cause) * share / PLANNED_SHARE
    traces = (effect_trace(run, cause, size, number)[:, None] for number, run in enumerate(runs))
    return [reduce_run(run, trace, scatter, without=name) for run, trace in zip(runs, traces, strict=True)]
