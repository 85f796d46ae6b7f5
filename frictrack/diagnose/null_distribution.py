"""Draw data of the null hypothesis that the fitted model is complete (parametric bootstrap).

A draw is white noise of the measured level plus slow tracker errors, remaining camera shake and friction levels
scattering by the fitted spread, all seen through the linearised model. Noise level and spread are estimated again for
every draw, as they were for the data, so that both uncertainties enter every p-value.

References
----------
Efron & Tibshirani (1993), An Introduction to the Bootstrap, section 6.5.

"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from scipy.fft import idct

from frictrack.fit.least_squares import Solution
from frictrack.fit.linearised import Float32Array, LinearisedModel, ScannedSeries, linearise
from frictrack.fit.observations import MeasuredFrictionPiece
from frictrack.fit.pieces import Piece, Rows
from frictrack.measure.motion import (
    DIFFERENCE_ORDER,
    FALLBACK_ORDER,
    difference_order,
    difference_variance,
    slow_spectrum,
)
from frictrack.records import Array, Mask

N_DRAWS = 999
N_DRAWS_FEW = 399  # that decide most tests at a level of 0.005
MIN_DRAWS_BELOW_LEVEL = 2  # p-values that a level must leave below it; a small level takes more draws
TAU_GRID = np.geomspace(2e-4, 0.32, 13)  # spreads of friction levels at which a draw is estimated


@dataclass(frozen=True, eq=False)
class NullEnsemble:
    """Data (first column) and draws, ready to be scanned for any candidate.

    Parameters
    ----------
    law
        The linearised model.
    series
        Data and draws, grouped by their spread of friction levels.

    """

    law: LinearisedModel
    series: ScannedSeries

    @property
    def unbounded_projector(self) -> Array:
        """Projector of the model's residual at the data's own spread, as if no bound held an unknown, (L, L)."""
        own_group = next(i for i, columns in enumerate(self.series.groups) if columns.start == 0 < columns.stop)
        return self.law.unbounded_projector(float(self.series.taus[own_group]))

    def without_residuals(self) -> NullEnsemble:
        """Return the draws without their residuals, which take tens of megabytes and only tests of them need."""
        return NullEnsemble(self.law, replace(self.series, residuals=self.series.residuals[:, :1].copy()))


def count_draws(level: float, at_least: int = N_DRAWS) -> int:
    """Number of draws of a test at a significance level: `at_least`, or more where these cannot show such a level.

    Examples
    --------
    >>> count_draws(0.005), count_draws(0.001)
    (999, 1999)

    """
    return max(at_least, int(np.ceil(MIN_DRAWS_BELOW_LEVEL / level)) - 1)


def draw_null_ensemble(solution: Solution, rng: np.random.Generator, draws: int = N_DRAWS) -> NullEnsemble:
    """Draw data of the null hypothesis that the fitted model is complete."""
    law = linearise(solution)
    fitted, basis = law.solution, law.basis
    data = np.empty((len(basis.u), 1 + draws), dtype=np.float32)
    data[:, 0] = fitted.random_effect_data()
    _fill_noise(law, data[:, 1:], rng)
    levels = fitted.problem.layout.levels
    if basis.random:
        scatter = fitted.tau * rng.standard_normal((len(levels), draws))
        for rows in law.rows:
            data[rows, 1:] += (fitted.jac[rows][:, levels] @ scatter).astype(np.float32)
    coordinates = law.coordinates(data)
    taus = np.append(TAU_GRID, fitted.tau) if basis.random else np.array([1.0])
    on_basis = law.basis_coordinates.T @ coordinates
    profile = np.stack([basis.misfit(on_basis, np.zeros(1 + draws), tau) + basis.logdet(tau) for tau in taus])
    best = np.argmin(profile, axis=0)
    # draws of one spread side by side, those of the data's own first
    order = np.concatenate([[0], 1 + np.argsort((best[1:] != best[0]) * (1 + best[1:]), kind="stable")])
    used = list(dict.fromkeys(best[order].tolist()))
    ends = np.cumsum([0, *[int(np.sum(best == t)) for t in used]]).tolist()
    groups = dict(zip(used, (slice(a, b) for a, b in pairwise(ends)), strict=True))
    spreads = [groups.get(t, slice(0, 0)) for t in range(len(taus))]
    coordinates, fits = coordinates[:, order], np.empty((basis.u.shape[1], 1 + draws), dtype=np.float32)
    for tau, columns in zip(taus, spreads, strict=True):
        fits[:, columns] = law.fitted_coordinates(coordinates[:, columns], tau)
    for rows in law.rows:  # piece by piece, because many runs leave no room for a second copy
        data[rows] = np.take(data[rows], order, axis=1) - basis.u[rows].astype(np.float32) @ fits
    projectors = [law.residual_projector(tau) for tau in taus]
    measured = fitted.random_effect_data()
    return NullEnsemble(law, ScannedSeries(measured, data, coordinates, taus, projectors, spreads, profile[:, order]))


def _fill_noise(law: LinearisedModel, out: Float32Array, rng: np.random.Generator) -> None:
    """Fill in noise (N, D) over its estimated level, run by run, with initial conditions projected out."""
    for rows in law.rows:
        out[rows] = rng.standard_normal(out[rows].shape, dtype=np.float32)
    for run in law.runs:
        members = [i for i, s in enumerate(law.pieces) if s.run == run]
        one = law.pieces[members[0]].response
        if one.piece.path.steady:
            assert isinstance(one.piece, MeasuredFrictionPiece)
            drawn = out[law.rows[members[0]]].astype(np.float64)
            level = one.piece.noise_levels(one.model_y, one.r, len(law.solution.p), drawn)
        else:
            level = _noise_level(
                [law.pieces[i].response.piece.frames for i in members], [out[law.rows[i]] for i in members]
            )
        for i in members:
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
            if piece.clock_error:
                moved = piece.clock_error * law.pieces[i].response.motion.v_edge[piece.at] * piece.t
                rates = rng.standard_normal((1, e.shape[1]), dtype=np.float32)
                e += _whitened(piece, moved[:, None].astype(np.float32) * rates)
            if piece.shake:
                frequency, rms = piece.shake
                e += _whitened(piece, rms * random_tones(piece.t * frequency, e.shape[1], rng))
            q = law.pieces[i].response.q.astype(np.float32)
            e -= q @ (q.T @ e)


def _whitened(piece: Piece, errors: Float32Array) -> Float32Array:
    return piece.whitened(errors.astype(np.float64)).astype(np.float32)


def slow_errors(shape: tuple[int, ...], rng: np.random.Generator) -> Float32Array:
    """Slow errors of rms one, equally large in every octave from a few frames to the whole piece.

    `shape`: frames and draws, (n, D).
    """
    waves, size = np.zeros(shape, dtype=np.float32), slow_spectrum(shape[0]).astype(np.float32)
    waves[1 : 1 + len(size)] = size[:, None] * rng.standard_normal((len(size), shape[1]), dtype=np.float32)
    errors: Float32Array = idct(waves, axis=0, norm="ortho")
    return errors


def peak_locking_errors(place: Array, draws: int, rng: np.random.Generator) -> Float32Array:
    """Peak-locking errors of rms one on average, periodic in the pixel.

    They change slowly where the target moves a whole number of pixels per frame, or stops.

    `place`: positions, px, (n,).
    """
    return (random_tones(place, draws, rng) + random_tones(2 * place, draws, rng)) / np.float32(np.sqrt(2))


def rounding_errors(place: Array, step: float, draws: int, rng: np.random.Generator) -> Float32Array:
    """Errors of positions rounded to multiples of a step, with random origin.

    While a mass moves less than a step per frame they are equal from frame to frame, so they are not white.

    `place`: positions, m, (n,); `step`: rounding step, m. Returns the errors, m.

    References
    ----------
    Widrow & Kollar (2008), Quantization Noise, section 20.

    """
    at = place[:, None] / step + rng.uniform(0.0, 1.0, (1, draws))
    errors: Float32Array = (step * (np.round(at) - at)).astype(np.float32)
    return errors


def random_tones(cycles: Array, draws: int, rng: np.random.Generator) -> Float32Array:
    """Sinusoids of rms one on average and random phase, (n, D), at phases `cycles` (n,)."""
    waves = np.stack([np.cos(2 * np.pi * cycles), np.sin(2 * np.pi * cycles)], axis=1).astype(np.float32)
    return waves @ rng.standard_normal((2, draws), dtype=np.float32)


def _noise_level(frames: list[Rows], noise: list[Float32Array]) -> Array:
    """Level (D,) of white noise (n, D) in the pieces of a run, estimated like that of the data."""
    consecutive = {k: [_consecutive(f, k) for f in frames] for k in (DIFFERENCE_ORDER, FALLBACK_ORDER)}
    n_high, n_fallback = (sum(int(np.sum(w)) for w in consecutive[k]) for k in (DIFFERENCE_ORDER, FALLBACK_ORDER))
    order = difference_order(n_high, n_fallback)
    total = np.zeros(noise[0].shape[1])
    for e, rows in zip(noise, consecutive[order], strict=True):
        d = np.diff(e, order, axis=0)[rows]
        total += np.einsum("nd,nd->d", d, d)
    return np.asarray(
        np.sqrt(total / max(n_high if order == DIFFERENCE_ORDER else n_fallback, 1) / difference_variance(order))
    )


def _consecutive(frames: Rows, order: int) -> Mask:
    """Which differences of an order use only consecutive frames."""
    step = int(np.median(np.diff(frames)))  # of a series of which only every so many frames count
    return np.asarray(frames[order:] - frames[:-order] == order * step)
