"""Test whether a misfit repeats from run to run: at the same place, time since release or speed, or with one frequency.

Over every axis, the most likely smooth force (see `smooth_forces`) is fitted to the other runs, and the share of a
run's misfit that it predicts is computed; over the place also a wave. Null distribution: the signs of every run's
residual are drawn at random in an orthonormal basis, which keeps its misfit and noise but nothing common.

The axis is chosen by likelihood: of a smooth force over the axis (over the place also a wave) against a smooth force of
its own in every run. Other runs predict little if few of them show the misfit; the likelihood uses all of them. One
frequency with a phase of its own in every run is judged by likelihood alone, since slow misfits have those in common.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from frictrack.diagnose.compressed import CompressedResidual
from frictrack.diagnose.smooth_forces import ResidualForces, raw_traces, separate_curves
from frictrack.diagnose.waves import FoundWaves, WaveScan
from frictrack.fit.least_squares import Solution
from frictrack.fit.linearised import linearise
from frictrack.fit.pieces import Rows
from frictrack.records import Array
from frictrack.results.motion_axes import AXES

N_DRAWS = 199
MIN_SINGULAR_VALUE = 1e-6  # of a direction of the model in one run; smaller ones are rounding
STRIDE = 8  # of the scanned periods: those between are slow modulations of these
MIN_PREDICTED_SHARE = 0.25  # of a run's misfit that counts as repeating there
MIN_SHARE, ALPHA = 0.5, 0.01  # share of the misfit that the other runs must predict, and its significance level
MIN_EXPLAINED = 0.99  # of the gain of separate forces, above which a common one may be most of the misfit
MIN_EVIDENCE = 10.0  # twice the log likelihood ratio that decides

AXIS_TEXTS = {
    "x": ("at the same place", "it depends on the position along the course"),
    "t": ("at the same time since release", "it depends on the time since release, not on the place"),
    "v": ("at the same speed", "it depends on the speed, so the friction law itself is wrong"),
    "phase": ("with one frequency, at a different phase in every run", "something vibrates"),
}


@dataclass(frozen=True)
class AxisRepeatability:
    """How well the misfit repeats over one axis.

    Parameters
    ----------
    axis
        "x", "t", "v" or "phase".
    share
        Share of the misfit that the other runs predict.
    p
        p-value of that share.
    runs, of
        Number of runs in which it repeats, and of all runs.
    frequency
        Frequency, Hz, for "phase".
    evidence
        Twice the log likelihood ratio against a force of its own in every run.
    explained
        Gain in likelihood over that of a force of its own in every run.

    """

    axis: str
    share: float
    p: float
    runs: int
    of: int
    frequency: float | None = None  # Hz, of the phase
    evidence: float = 0.0
    explained: float = 0.0

    @property
    def holds(self) -> bool:
        """Whether the misfit repeats: a common force is decisively more likely, or the other runs predict most of it.

        A strong narrow force is followed more closely by a curve per run than by a common one, but what runs predict
        of each other is common to them. Nothing is predicted of a phase.
        """
        predicted = self.axis != "phase" and self.share > MIN_SHARE and self.p < ALPHA
        return self.evidence > MIN_EVIDENCE or predicted

    @property
    def mostly(self) -> bool:
        """Whether a common force explains nearly all that a force of its own in every run does."""
        return self.explained > MIN_EXPLAINED

    def summary(self) -> dict[str, Any]:
        """Return the JSON of one axis."""
        found = {"axis": self.axis, "share": round(self.share, 4), "p": self.p, "runs": self.runs, "of": self.of}
        found |= {"evidence": round(self.evidence, 1), "holds": self.holds, "mostly": self.mostly}
        return found | ({} if self.frequency is None else {"frequency": self.frequency})


@dataclass(frozen=True)
class Repeatability:
    """Result over all axes, best first, and as sentences."""

    axes: list[AxisRepeatability] = field(default_factory=list)
    words: str = ""

    @property
    def best(self) -> AxisRepeatability | None:
        """The axis over which the misfit repeats; None if it does not."""
        return next((a for a in self.axes if a.holds), None)

    def summary(self) -> list[dict[str, Any]]:
        """Return the JSON `repeats`."""
        return [a.summary() for a in self.axes]


def assess_repeatability(
    solution: Solution,
    rng: np.random.Generator,
    waves: WaveScan | None = None,
    forces: ResidualForces | None = None,
) -> Repeatability:
    """Test over which axis the misfit of a fit repeats from run to run.

    `waves`: scan for waves in its residual, if there is one; `forces`: smooth forces in its residual, if they were
    computed before.
    """
    if solution.problem.is_of_points:
        return Repeatability()
    forces, waves = forces or ResidualForces(solution, about_measurement=True), waves or WaveScan(linearise(solution))
    misfit = _Misfit.of(forces.compressed, rng)
    if len(misfit.model) < 2:
        return Repeatability(
            words="One run cannot show whether the misfit repeats: film another one, best at another speed."
        )
    separate = max(separate_curves(forces.compressed).process.gain, 0.0)
    found = []
    for axis in ("x", "t", "v"):
        smooth = next(s for s in forces.smooth if s.axis.name == axis)
        tried, evidence = [smooth.traces], max(smooth.gain, 0.0)
        if axis == "x" and (in_place := waves.in_place) is not None:
            frequencies = [in_place.f[in_place.best], *in_place.f[::STRIDE]]
            tried += [misfit.scaled(_wave_traces(forces.compressed, f)) for f in frequencies]
            evidence = max(evidence, in_place.evidence)
        explained = evidence / separate if separate > 0 else 0.0
        result = misfit.result(axis, [misfit.predicted(traces) for traces in tried])
        found.append(replace(result, evidence=evidence - separate, explained=explained))
    if waves.in_time is not None:
        found.append(replace(_common_frequency(waves.in_time, misfit, rng), evidence=waves.in_time.evidence - separate))
    found = sort_axes(found)
    return Repeatability(found, describe_axes(found))


@dataclass(frozen=True)
class _Misfit:
    """The compressed residual and draws of it without anything common, (M, D), next to a model of each run's own.

    The rows of every run and orthonormal columns (m, P) there of all that the model can absorb in it are projected out:
    so nothing passes from run to run but what is tested. The `excess` (R,) is chi-squared above its expectation, at
    least its standard deviation; `whole` is that next to the common model.
    """

    model: list[tuple[Rows, Array]]
    series: Array
    excess: Array
    whole: Array

    @classmethod
    def of(cls, compressed: CompressedResidual, rng: np.random.Generator) -> _Misfit:
        r, run = compressed.residual, np.repeat(compressed.runs, [len(m) for m in compressed.force_maps])
        model = []
        for one in sorted(set(compressed.runs)):
            rows = np.flatnonzero(run == one)
            u, size, _ = np.linalg.svd(compressed.model_directions[rows], full_matrices=False)
            model.append((rows, u[:, size > MIN_SINGULAR_VALUE]))
        drawn = r[:, None] * rng.choice([-1.0, 1.0], (len(r), N_DRAWS))
        series, excess, whole = _without_model(np.column_stack([r, drawn]), model), [], []
        for rows, u in model:
            chi2, free = np.sum(series[rows] ** 2, axis=0), max(len(rows) - u.shape[1], 1)
            series[rows] *= np.sqrt(chi2[0] / np.maximum(chi2, 1e-300))
            excess.append(max(float(chi2[0]) - free, float(np.sqrt(2 * free))))
            whole.append(max(float(r[rows] @ r[rows]) - free, excess[-1]))
        return cls(model, series, np.array(excess), np.array(whole))

    def predicted(self, traces: Array) -> Array:
        """Fall of every run's chi-squared with a process fitted to the other runs, (R, D).

        A are the traces (M, k) of its components of unit variance. With c from (I + A'A) c = A'r of the other runs, the
        fall is c'(2 A'r - A'A c) in the run.
        """
        traces = _without_model(traces, self.model)
        gram = np.stack([traces[rows].T @ traces[rows] for rows, _ in self.model])
        data = np.stack([traces[rows].T @ self.series[rows] for rows, _ in self.model])
        c = np.linalg.solve(np.eye(traces.shape[1]) + gram.sum(axis=0) - gram, data.sum(axis=0) - data)
        return np.asarray(np.einsum("rkd,rkd->rd", c, 2 * data - gram @ c))

    def scaled(self, traces: Array) -> Array:
        """Traces (M, k) of components as large as the misfit."""
        return traces * np.sqrt(self.excess.sum() / np.maximum(np.sum(traces**2, axis=0), 1e-300))

    def result(self, axis: str, tried: Sequence[Array]) -> AxisRepeatability:
        """Share of the misfit predicted, its p-value, and the number of runs, from the best of gains (R, D) tried."""
        shares = np.stack([gains.sum(axis=0) for gains in tried]) / self.excess.sum()
        share, best = shares.max(axis=0), tried[int(np.argmax(shares[:, 0]))]
        p = float((1 + np.sum(share[1:] >= share[0])) / len(share))
        runs = int(np.sum(best[:, 0] > MIN_PREDICTED_SHARE * self.excess))
        return AxisRepeatability(axis, float(np.clip(share[0], 0.0, 1.0)), p, runs, len(self.model))


def _without_model(columns: Array, model: Sequence[tuple[Rows, Array]]) -> Array:
    """Columns (M, k) with the model of every run projected out."""
    out = np.array(columns)
    for rows, u in model:
        out[rows] -= u @ (u.T @ out[rows])
    return out


def _wave_traces(compressed: CompressedResidual, f: float) -> Array:
    """Traces (M, 4) of dry friction forces that are a sine and a cosine over the place, with slow modulation."""
    columns = []
    for path in compressed.paths:
        turns, dry = 2 * np.pi * f * path.x, path.load * path.s
        wave = np.column_stack([np.sin(turns) * dry, np.cos(turns) * dry])
        columns.append(np.hstack([wave, path.x[:, None] * wave]))
    return raw_traces(compressed, columns)


def _common_frequency(waves: FoundWaves, misfit: _Misfit, rng: np.random.Generator) -> AxisRepeatability:
    """Share of the misfit with one frequency, phase and amplitude free; by chance, every run has another frequency."""
    gains, best = np.maximum(waves.gains_of_runs - 2, 0.0), waves.best  # above the expectation of two coefficients
    shifts = rng.integers(0, len(waves.f), (N_DRAWS, len(gains), 1))
    drawn = np.take_along_axis(gains[None], (np.arange(len(waves.f)) + shifts) % len(waves.f), axis=2)
    p = float((1 + np.sum(drawn.sum(axis=1).max(axis=1) >= gains.sum(axis=0).max())) / (1 + N_DRAWS))
    share = float(np.clip(gains[:, best].sum() / misfit.whole.sum(), 0.0, 1.0))
    runs = int(np.sum(gains[:, best] > MIN_PREDICTED_SHARE * misfit.whole))
    return AxisRepeatability("phase", share, p, runs, len(gains), float(waves.f[best]))


def sort_axes(axes: Sequence[AxisRepeatability]) -> list[AxisRepeatability]:
    """Sort axes by likelihood; those between which the likelihood does not decide, by the share predicted."""
    undecided = _undecided(axes)
    return sorted(axes, key=lambda a: (not a.holds, a not in undecided, -a.share if a in undecided else -a.evidence))


def _undecided(axes: Sequence[AxisRepeatability]) -> list[AxisRepeatability]:
    """Axes between which and the most likely one the likelihood does not decide."""
    top = max(a.evidence for a in axes)
    return [a for a in axes if a.evidence > top - MIN_EVIDENCE]


def describe_axes(axes: Sequence[AxisRepeatability]) -> str:
    """Describe the result as sentences."""
    best = axes[0]
    if not best.holds:
        if best.mostly:
            share = f"{100 * best.explained:.1f} %" if best.explained < 0.9995 else "nearly all"
            return (
                f"A force that depends on {AXES[best.axis].name} alone explains {share} of what a force of its own in "
                "every run explains: most of the misfit repeats, or the runs overlap too little to tell."
            )
        if best.evidence < -MIN_EVIDENCE:
            return "The misfit does not repeat from run to run: no place, time, speed or frequency is common to it."
        return "These runs do not determine whether the misfit repeats from run to run: they show too little of it."
    where, why = AXIS_TEXTS[best.axis]
    if best.axis == "phase" and best.frequency is not None:
        where = f"{where} ({best.frequency:.3g} Hz)"
    how_often = f" in {best.runs} of {best.of} runs" if best.runs > 1 else ""
    words = f"The misfit repeats {where}{how_often}: {why}."
    others = [a.axis for a in _undecided(axes) if a is not best]
    if others:
        names = " or ".join(AXES[name].name for name in others)
        words += f" These runs hardly distinguish it from the same {names}; a run at another speed would."
    return words
