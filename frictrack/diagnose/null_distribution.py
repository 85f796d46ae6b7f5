"""What the data would look like if nothing were missing: parametric bootstrap draws through the same pipeline.

A draw is white noise of the measured level, what a tracker is off by slowly, what may be left of a camera shake, and
levels scattering by the fitted spread, seen through the linearised model. Its noise level and its spread are estimated
again, as they were for the data, so that both uncertainties enter every p-value.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.fft import idct

from frictrack.fit.least_squares import Solution
from frictrack.fit.linearised import Float32Array, LinearisedModel, ScannedSeries, linearise
from frictrack.fit.segments import Piece, Rows
from frictrack.motion.noise import (
    DIFFERENCE_ORDER,
    FALLBACK_ORDER,
    difference_order,
    difference_variance,
    slow_spectrum,
)
from frictrack.records import Array, Mask

N_DRAWS = 999
TAU_GRID = np.geomspace(2e-4, 0.32, 13)


@dataclass(frozen=True, eq=False)
class Ensemble:
    """The data (first column) and the draws beside it, ready for any candidate; `shrinks` go with the spreads."""

    law: LinearisedModel
    series: ScannedSeries
    shrinks: list[Array]

    @property
    def left(self) -> Array:
        """What the law leaves of coordinates at the data's own spread, (L, L)."""
        mine = next(i for i, columns in enumerate(self.series.groups) if columns.start == 0 < columns.stop)
        return self.series.residual_projectors[mine]

    def residuals(self) -> Float32Array:
        """What the refitted bare model leaves of the data and of every draw, (N, D)."""
        out = self.series.data.copy()
        u, coordinates = self.law.basis.u.astype(np.float32), self.law.basis_coordinates.T @ self.series.coordinates
        for columns, shrink in zip(self.series.groups, self.shrinks, strict=True):
            out[:, columns] -= u @ (shrink @ coordinates[:, columns]).astype(np.float32)
        return out


def draw_ensemble(solution: Solution, rng: np.random.Generator, draws: int = N_DRAWS) -> Ensemble:
    """Draws of the null hypothesis that the fitted model is the whole truth."""
    law = linearise(solution)
    seen, basis = law.solution, law.basis
    data = np.empty((len(basis.u), 1 + draws), dtype=np.float32)
    data[:, 0] = seen.random_effect_data()
    _fill_noise(law, data[:, 1:], rng)
    levels = seen.problem.layout.levels
    if basis.random:
        scatter = seen.tau * rng.standard_normal((len(levels), draws))
        data[:, 1:] += (seen.jac[:, levels] @ scatter).astype(np.float32)
    own = law.coordinates(data)
    taus = np.append(TAU_GRID, seen.tau) if basis.random else np.array([1.0])
    on_basis = law.basis_coordinates.T @ own
    profile = np.stack([basis.misfit(on_basis, np.zeros(1 + draws), tau) + basis.logdet(tau) for tau in taus])
    best = np.argmin(profile, axis=0)
    # draws of one spread side by side, those of the data's own first
    order = np.concatenate([[0], 1 + np.argsort((best[1:] != best[0]) * (1 + best[1:]), kind="stable")])
    used = list(dict.fromkeys(best[order].tolist()))
    ends = np.cumsum([0, *[int(np.sum(best == t)) for t in used]]).tolist()
    groups = dict(zip(used, (slice(a, b) for a, b in pairwise(ends)), strict=True))
    none = slice(0, 0)
    series = ScannedSeries(
        np.ascontiguousarray(data[:, order]),
        own[:, order],
        [law.residual_projector(tau) for tau in taus],
        [groups.get(t, none) for t in range(len(taus))],
        profile[:, order],
    )
    return Ensemble(law, series, [basis.shrink(tau) for tau in taus])


def _fill_noise(law: LinearisedModel, out: Float32Array, rng: np.random.Generator) -> None:
    """White noise (N, D) of every run over its own estimated level, starts removed, in place."""
    out[...] = rng.standard_normal(out.shape, dtype=np.float32)
    for run in law.runs:
        mine = [i for i, s in enumerate(law.pieces) if s.run == run]
        level = _level([law.pieces[i].response.piece.frames for i in mine], [out[law.rows[i]] for i in mine])
        for i in mine:
            e = out[law.rows[i]]
            e /= level
            piece = law.pieces[i].response.piece
            if piece.locked and piece.path.pixel_pitch:
                e *= np.float32(np.sqrt(1 - piece.locked))
                e += peak_locking_errors(piece.y / piece.path.pixel_pitch, e.shape[1], rng) * np.float32(
                    np.sqrt(piece.locked)
                )
            if piece.step:
                share = min(piece.step**2 / 12.0 / float(np.mean(piece.sigma**2)), 1.0)
                e *= np.float32(np.sqrt(1 - share))
                e += _whitened(piece, rounding_errors(law.pieces[i].response.model_y, piece.step, e.shape[1], rng))
            if piece.systematic:
                e += _whitened(piece, piece.systematic * slow_errors(e.shape, rng))
            if piece.shake:
                frequency, rms = piece.shake
                e += _whitened(piece, rms * random_tones(piece.t * frequency, e.shape[1], rng))
            q = law.pieces[i].response.q.astype(np.float32)
            e -= q @ (q.T @ e)


def _whitened(piece: Piece, errors: Float32Array) -> Float32Array:
    return piece.whitened(errors.astype(np.float64)).astype(np.float32)


def slow_errors(shape: tuple[int, ...], rng: np.random.Generator) -> Float32Array:
    """Errors (n, D) of rms one that are as large in every octave from a few frames to the whole piece."""
    waves, size = np.zeros(shape, dtype=np.float32), slow_spectrum(shape[0]).astype(np.float32)
    waves[1 : 1 + len(size)] = size[:, None] * rng.standard_normal((len(size), shape[1]), dtype=np.float32)
    errors: Float32Array = idct(waves, axis=0, norm="ortho")
    return errors


def peak_locking_errors(place: Array, draws: int, rng: np.random.Generator) -> Float32Array:
    """Errors (n, D) of rms one on the average that repeat from pixel to pixel, at places (n,) in px.

    Where the target goes a whole number of pixels per frame, or stops, they change slowly.
    """
    return (random_tones(place, draws, rng) + random_tones(2 * place, draws, rng)) / np.float32(np.sqrt(2))


def rounding_errors(place: Array, step: float, draws: int, rng: np.random.Generator) -> Float32Array:
    """Errors (n, D) in m of places (n,) that are rounded to multiples of a step, their origin at random.

    While a mass is slower than a step per frame they are alike from frame to frame: no white noise (Widrow & Kollar
    2008, Quantization Noise, section 20).
    """
    at = place[:, None] / step + rng.uniform(0.0, 1.0, (1, draws))
    errors: Float32Array = (step * (np.round(at) - at)).astype(np.float32)
    return errors


def random_tones(turns: Array, draws: int, rng: np.random.Generator) -> Float32Array:
    """Tones (n, D) of rms one on the average and any phase, at so many `turns` (n,)."""
    waves = np.stack([np.cos(2 * np.pi * turns), np.sin(2 * np.pi * turns)], axis=1).astype(np.float32)
    return waves @ rng.standard_normal((2, draws), dtype=np.float32)


def _level(frames: list[Rows], noise: list[Float32Array]) -> Array:
    """Level (D,) of white noise (n, D) in the pieces of a run, estimated as that of the data is."""
    whole = {k: [_neighbours(f, k) for f in frames] for k in (DIFFERENCE_ORDER, FALLBACK_ORDER)}
    many, few = (sum(int(np.sum(w)) for w in whole[k]) for k in (DIFFERENCE_ORDER, FALLBACK_ORDER))
    order = difference_order(many, few)
    total = np.zeros(noise[0].shape[1])
    for e, rows in zip(noise, whole[order], strict=True):
        d = np.diff(e, order, axis=0)[rows]
        total += np.einsum("nd,nd->d", d, d)
    return np.asarray(np.sqrt(total / max(many if order == DIFFERENCE_ORDER else few, 1) / difference_variance(order)))


def _neighbours(frames: Rows, order: int) -> Mask:
    """Which differences of an order have nothing but neighbouring frames."""
    step = int(np.median(np.diff(frames)))  # of a series of which only every so many frames count
    return np.asarray(frames[order:] - frames[:-order] == order * step)
