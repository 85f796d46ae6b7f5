"""Scan the residual of a fit for sinusoidal forces: in time with a phase per run, or over the place for all runs.

Both are scans of effects of the library, vibration and texture, in the linearised model.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from frictrack.base.distributions import chi2_sf
from frictrack.effects import LIBRARY
from frictrack.fit.linearised import CandidateGrid, LinearisedModel, candidate_grids, measured_series, scan_candidate
from frictrack.records import Array

WAVES = {name: LIBRARY[name] for name in ("vibration", "texture")}  # in time, and in place
MIN_PERIODS = 3.0  # in the longest run; fewer are no oscillation


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
