"""Test whether a misfit repeats from run to run: at the same place, time since release or speed, or with one frequency.

Over every axis, the most likely smooth force (see `smooth_forces`) is fitted to the other runs, and the share of a
run's misfit that it predicts is computed; over the place also a wave. Null distribution: the signs of every run's
residual are drawn at random in an orthonormal basis, which keeps its misfit and noise but nothing common.

The axis is chosen by likelihood: of a smooth force over the axis (over the place also a wave) against a smooth force of
its own in every run. Other runs predict little if few of them show the misfit; the likelihood uses all of them. One
frequency with a phase of its own in every run is judged by likelihood alone, since slow misfits have those in common.

Waves, in time with a phase per run or over the place for all runs, are scans of effects of the library, vibration and
texture, in the linearised model.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from frictrack.base.distributions import chi2_sf
from frictrack.diagnose.compressed import CompressedResidual, separate_curves
from frictrack.diagnose.examination import p_value
from frictrack.effects import LIBRARY, Path
from frictrack.fit.linearised import CandidateGrid, LinearisedModel, candidate_grids, measured_series, scan_candidate
from frictrack.fit.pieces import Rows
from frictrack.records import Array
from frictrack.results.candidates import AXES

N_DRAWS = 199
MIN_SINGULAR_VALUE = 1e-6  # of a direction of the model in one run; smaller ones are rounding
STRIDE = 8  # of the scanned periods: those between are slow modulations of these
MIN_PREDICTED_SHARE = 0.25  # of a run's misfit that counts as repeating there
MIN_SHARE, ALPHA = 0.5, 0.01  # share of the misfit that the other runs must predict, and its significance level
MIN_EXPLAINED = 0.99  # of the gain of separate forces, above which a common one may be most of the misfit
MIN_SHARE_ALONE = 0.999  # of the misfit in one run, in which case the others cannot show what repeats
MIN_EVIDENCE = 10.0  # twice the log likelihood ratio that decides

AXIS_TEXTS = {
    "x": ("at the same place", "it depends on the position along the course"),
    "t": ("at the same time since release", "it depends on the time since release, not on the place"),
    "v": ("at the same speed", "it depends on the speed, so the friction law itself is wrong"),
    "phase": ("with one frequency, at a different phase in every run", "something vibrates"),
}
WAVES = {name: LIBRARY[name] for name in ("vibration", "texture")}  # in time, and in place
MIN_PERIODS = 3.0  # in the longest run; fewer are no oscillation


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


def assess_repeatability(compressed: CompressedResidual, waves: WaveScan, rng: np.random.Generator) -> Repeatability:
    """Test over which axis the misfit of a fit repeats from run to run, from its residual and the waves in that."""
    misfit = _Misfit.of(compressed, rng)
    if len(misfit.model) < 2:
        return Repeatability(
            words="One run cannot show whether the misfit repeats: film another one, best at another speed."
        )
    if misfit.excess.max() > MIN_SHARE_ALONE * misfit.excess.sum():
        run = waves.model.solution.problem.layout.run_names[sorted(set(compressed.runs))[int(np.argmax(misfit.excess))]]
        words = f"Only run {run} shows the misfit: no other can show whether it repeats; film one more like it."
        return Repeatability(words=words)
    separate = max(separate_curves(compressed).process.gain, 0.0)
    found = []
    for axis in ("x", "t", "v"):
        smooth = next(s for s in compressed.smooth if s.axis.name == axis)
        tried, evidence = [smooth.traces], max(smooth.gain, 0.0)
        if axis == "x" and (in_place := waves.in_place) is not None:
            for f in (in_place.f[in_place.best], *in_place.f[::STRIDE]):
                traces = compressed.raw_traces(np.concatenate([place_wave(path, f) for path in compressed.paths]))
                # components as large as the misfit
                size = misfit.excess.sum() / np.maximum(np.sum(traces**2, axis=0), 1e-300)
                tried.append(traces * np.sqrt(size))
            evidence = max(evidence, in_place.evidence)
        result = misfit.result(axis, [misfit.predicted(traces) for traces in tried])
        explained = evidence / separate if separate > 0 else 0.0
        found.append(replace(result, evidence=evidence - separate, explained=explained))
    if waves.in_time is not None:
        found.append(replace(_common_frequency(waves.in_time, misfit, rng), evidence=waves.in_time.evidence - separate))
    found = sort_axes(found)
    return Repeatability(found, describe_axes(found))


def sine_cosine(turns: Array) -> Array:
    """Sine and cosine (n, 2) at phases in cycles (n,)."""
    return np.column_stack([np.sin(2 * np.pi * turns), np.cos(2 * np.pi * turns)])


def place_wave(path: Path, f: float) -> Array:
    """Dry friction forces (n, 4), a sine and a cosine over the place; times x, for a small change of frequency."""
    wave = sine_cosine(f * path.x) * (path.load * path.s)[:, None]
    return np.hstack([wave, path.x[:, None] * wave])


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

    def result(self, axis: str, tried: Sequence[Array]) -> AxisRepeatability:
        """Share of the misfit predicted, its p-value, and the number of runs, from the best of gains (R, D) tried."""
        shares = np.stack([gains.sum(axis=0) for gains in tried]) / self.excess.sum()
        share, best = shares.max(axis=0), tried[int(np.argmax(shares[:, 0]))]
        p = p_value(share[1:], float(share[0]))
        runs = int(np.sum(best[:, 0] > MIN_PREDICTED_SHARE * self.excess))
        return AxisRepeatability(axis, float(np.clip(share[0], 0.0, 1.0)), p, runs, len(self.model))


def _without_model(columns: Array, model: Sequence[tuple[Rows, Array]]) -> Array:
    """Columns (M, k) with the model of every run projected out."""
    out = np.array(columns)
    for rows, u in model:
        out[rows] -= u @ (u.T @ out[rows])
    return out


def _common_frequency(waves: FoundWaves, misfit: _Misfit, rng: np.random.Generator) -> AxisRepeatability:
    """Share of the misfit with one frequency, phase and amplitude free; by chance, every run has another frequency."""
    gains, best = np.maximum(waves.gains_of_runs - 2, 0.0), waves.best  # above the expectation of two coefficients
    shifts = rng.integers(0, len(waves.f), (N_DRAWS, len(gains), 1))
    drawn = np.take_along_axis(gains[None], (np.arange(len(waves.f)) + shifts) % len(waves.f), axis=2)
    p = p_value(drawn.sum(axis=1).max(axis=1), float(gains.sum(axis=0).max()))
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


@dataclass(frozen=True, eq=False)
class FoundWaves:
    """Waves added to a model.

    Parameters
    ----------
    f
        Frequencies (G,): Hz, or cycles per m.
    gains
        Fall of chi-squared with each, (G,).
    gains_of_runs
        The same of every run alone, or of the wave that all share, (R, G).
    amplitudes
        Sine and cosine amplitude of every run at every frequency, N, (R, G, 2).
    runs
        Indices of the R runs.

    """

    f: Array
    gains: Array
    gains_of_runs: Array
    amplitudes: Array
    runs: list[int]

    @property
    def best(self) -> int:
        """The frequency that lowers chi-squared most."""
        return int(np.argmax(self.gains))

    @property
    def p(self) -> float:
        """p-value of the best frequency among all."""
        return float(min(1.0, len(self.f) * chi2_sf(float(self.gains.max()), 2 * len(self.gains_of_runs))))

    @property
    def evidence(self) -> float:
        """Twice the rise of the log restricted likelihood with the best frequency at its most likely amplitude.

        A wave of K coefficients z ~ N(0, s) gains at most K (g - 1 - log g), where g is its fall of chi-squared over K.
        """
        count = 2 * len(self.gains_of_runs)
        each = max(float(self.gains.max()) / count, 1.0)
        return count * (each - 1 - float(np.log(each))) - 2 * float(np.log(len(self.f)))


@dataclass(frozen=True)
class SpectralLine:
    """A sinusoidal force in time: its frequency (Hz) and its sine and cosine amplitude in every run, N."""

    frequency: float
    amplitudes: dict[int, Array]

    def phase(self, run: int, t: Array) -> Array:
        """Phase in cycles (n,), folded to 0 ... 1; 0 where the force rises through zero."""
        a, b = self.amplitudes.get(run, (1.0, 0.0))
        return np.asarray((self.frequency * t + np.arctan2(b, a) / (2 * np.pi)) % 1.0)


@dataclass(frozen=True, eq=False)
class WaveScan:
    """Waves in the residual of a linearised model; each kind is scanned when it is first asked for."""

    model: LinearisedModel

    @cached_property
    def in_time(self) -> FoundWaves | None:
        """Forces that are sinusoidal in time; None if the runs are too short to scan."""
        found = self._scan("vibration", lambda values: values)
        kept = (
            np.array([]) if found is None else found.f >= MIN_PERIODS / self.model.solution.problem.layout.span.duration
        )
        if found is None or not kept.any():
            return None
        return FoundWaves(found.f[kept], found.gains[kept], found.gains_of_runs[:, kept], found.amplitudes[:, kept],
                          found.runs)  # fmt: skip

    @cached_property
    def in_place(self) -> FoundWaves | None:
        """Dry friction forces that are sinusoidal over the place."""
        return self._scan("texture", lambda values: 1 / values)

    def line(self, frequency: float | None = None) -> SpectralLine | None:
        """The strongest line in time, or that nearest a frequency."""
        found = self.in_time
        if found is None:
            return None
        g = found.best if frequency is None else int(np.argmin(np.abs(found.f - frequency)))
        return SpectralLine(float(found.f[g]), dict(zip(found.runs, found.amplitudes[:, g], strict=True)))

    def _scan(self, effect: str, frequency: Callable[[Array], Array]) -> FoundWaves | None:
        grids = candidate_grids(self.model, WAVES[effect])
        if not grids:
            return None
        grid, series = grids[0], measured_series(self.model)
        scan, projector = scan_candidate(self.model, grid, series), series.residual_projectors[0]
        left = projector @ series.coordinates[:, 0]
        pairs = zip(scan.products, scan.rows, strict=True)
        products = np.stack([own.data + own.coordinates @ left[rows] for own, rows in pairs], axis=1)  # (G, B, 2)
        sizes = np.linalg.pinv(scan.schur(projector), rcond=1e-6, hermitian=True) @ products[..., None]
        amplitudes = sizes[..., 0].transpose(1, 0, 2)
        gains = np.sum(amplitudes * products.transpose(1, 0, 2), axis=2)
        return FoundWaves(frequency(grid.values[:, 0]), scan.gains, gains, amplitudes, self._runs(grid))

    def _runs(self, grid: CandidateGrid) -> list[int]:
        return sorted({self.model.pieces[i].run for i in grid.members})
