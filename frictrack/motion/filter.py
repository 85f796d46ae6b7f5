"""The stage displacement -> low-passed displacement."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from frictrack.errors import FrictrackError
from frictrack.motion.grid import Grid, frame_grid
from frictrack.motion.smoother import MISSING, best_cutoff, noise_variance, penalty, smooth, weights
from frictrack.records import Array, Displacement, Filtered, Mask

TOO_LOW = 0.7  # of the cut-off of the highest likelihood: one below it loses more than the deviations say
VIOLENT = 10.0  # times the usual acceleration of the moving mass: a push or an impact, no collision of some per cent
MOVING = 0.05  # of the highest speed
SHORTEST = 16  # valid frames of a stretch that is filtered apart
MIN_FRAMES = 8  # valid frames below which neither noise nor cut-off can be estimated


def low_pass(displacement: Displacement, cutoff: float | None = None) -> Filtered:
    """Low-pass a displacement and bridge its missing frames.

    `cutoff` (Hz) is where a sine keeps half of its amplitude. Without it, x and y each get the cut-off of
    the highest restricted likelihood. The noise level is estimated along with it; the standard deviations
    that come with the displacement count relative to each other.

    Raises FrictrackError for too few valid frames, a position that never changes, uneven time stamps, and a
    cut-off that is not between 0 and half the frame rate.
    """
    grid = frame_grid(displacement.t)
    known = displacement.valid & np.isfinite(displacement.x)
    _check_position(displacement.x[known], len(known))
    _check_cutoff(cutoff, grid)
    first, _, best, _ = _low_pass_one(displacement.x, displacement.sigma_x, known, grid, (None, None))
    stretches, main = quiet_stretches(displacement.t, first, known, best)
    parts = [_low_pass_stretch(displacement, s, cutoff, best if len(stretches) == 1 else None) for s in stretches]
    slide = parts[main]
    sigma_x = [_like(slide.sigma_x, p.sigma_x) for p in parts]  # a short violent stretch cannot tell its noise
    return Filtered(
        t=displacement.t,
        x=np.concatenate([p.x for p in parts]),
        y=np.concatenate([p.y for p in parts]),
        sigma_x=np.concatenate(sigma_x),
        sigma_y=np.concatenate([p.sigma_y for p in parts]),
        cutoff=slide.cutoff,
        cutoff_y=slide.cutoff_y,
        reason=slide.reason,
        breaks=tuple(s.start for s in stretches),
        cutoffs=tuple(p.cutoff for p in parts),
        cutoffs_y=tuple(p.cutoff_y for p in parts),
    )


def _low_pass_stretch(displacement: Displacement, s: slice, cutoff: float | None, best: float | None) -> Filtered:
    """Low-pass the rows of one stretch by themselves; `best` is x's cut-off of the highest likelihood, if known."""
    t, valid = displacement.t[s], displacement.valid[s]
    grid = frame_grid(t)
    known = valid & np.isfinite(displacement.x[s])
    x, sigma_x, cutoff_x, reason = _low_pass_one(
        displacement.x[s], displacement.sigma_x[s], known, grid, (cutoff, best)
    )
    y = sigma_y = np.full(len(x), np.nan)
    cutoff_y = float("nan")
    known = valid & np.isfinite(displacement.y[s])
    if np.sum(known) >= MIN_FRAMES:
        across = displacement.y[s], displacement.sigma_y[s]
        y, sigma_y, cutoff_y, _ = _low_pass_one(*across, known, grid, (cutoff, None))
    return Filtered(t, x, y, sigma_x, sigma_y, cutoff_x, cutoff_y, reason)


def _like(slide: Array, own: Array) -> Array:
    """Noise of a stretch at the level of the slide's, missing frames kept missing."""
    usual = float(np.median(slide[slide < MISSING]))
    here = own < MISSING
    level = float(np.median(own[here])) if here.any() else 1.0
    return np.where(here, own * usual / level, MISSING)


def quiet_stretches(t: Array, smoothed: Array, known: Mask, cutoff: float) -> tuple[list[slice], int]:
    """Rows of a record cut where something violent begins and ends, and which stretch is the longest quiet one.

    A push or an impact accelerates the mass far more than the slide does and would drag the cut-off of the whole
    record up with it, and its smear into the slide. Violent is what exceeds `VIOLENT` times the median
    acceleration of the moving frames after a first low-pass at `cutoff` (Hz), and half a
    period of that filter round it.
    """
    v = np.gradient(smoothed, t)
    a = np.abs(np.gradient(v, t))
    moving = known & (np.abs(v) > MOVING * np.max(np.abs(v[known])))
    violent = known & (a > VIOLENT * np.median(a[moving]))
    reach = int(np.ceil(0.5 / (cutoff * float(np.median(np.diff(t)))))) + 1
    violent = np.convolve(violent, np.ones(2 * reach + 1), mode="same") > 0
    cuts = [int(c) + 1 for c in np.flatnonzero(np.diff(violent))]
    bounds = _long_enough([0, *cuts, len(t)], known)
    stretches = [slice(i, j) for i, j in pairwise(bounds)]
    quiet = [int(np.sum(known[s] & ~violent[s])) for s in stretches]
    return stretches, int(np.argmax(quiet))


def _long_enough(bounds: list[int], known: Mask) -> list[int]:
    """The same bounds without those that would leave fewer than `SHORTEST` valid frames in a stretch."""
    kept = [0]
    for b in bounds[1:-1]:
        if np.sum(known[kept[-1] : b]) >= SHORTEST:
            kept.append(b)
    while len(kept) > 1 and np.sum(known[kept[-1] :]) < SHORTEST:
        kept.pop()
    return [*kept, bounds[-1]]


def _low_pass_one(
    y: Array, sigma: Array, known: Mask, grid: Grid, asked: tuple[float | None, float | None]
) -> tuple[Array, Array, float, str]:
    """Low-pass one coordinate: smoothed rows, the noise of each row, the cut-off and why it is this.

    `asked` is the cut-off that is wanted, and the one of the highest likelihood where that is known already.
    """
    cutoff, best = asked
    w = grid.spread(weights(sigma, known))
    full = grid.spread(np.where(known, y, 0.0))
    best = best or best_cutoff(full, w, grid.interval)
    level = np.sqrt(noise_variance(full, w, penalty(best, grid.interval)))  # whatever cut-off is given
    sigma_rows = np.full(len(y), MISSING)
    sigma_rows[known] = level / np.sqrt(w[grid.frames][known])
    used = best if cutoff is None else cutoff
    x = smooth(full, w, penalty(used, grid.interval))[grid.frames]
    return x, sigma_rows, used, _reason(used, best)


def _reason(used: float, best: float) -> str:
    if used == best:
        return f"cut-off {used:.3g} Hz by maximum likelihood"
    reason = f"cut-off {used:.3g} Hz as given"
    if used < TOO_LOW * best:
        reason += f", maximum likelihood would take {best:.3g} Hz: the deviations do not cover the signal lost"
    return reason


def _check_position(x: Array, n: int) -> None:
    if len(x) < MIN_FRAMES:
        raise FrictrackError(
            f"displacement: expected at least {MIN_FRAMES} valid frames but got {len(x)} of {n}; "
            "check that the target was found"
        )
    if np.all(x == x[0]):
        raise FrictrackError(
            f"displacement: expected a moving target but x is {x[0]:g} m in all {len(x)} valid frames; "
            "check which target was tracked"
        )


def _check_cutoff(cutoff: float | None, grid: Grid) -> None:
    nyquist = 0.5 / grid.interval
    if cutoff is not None and not 0.0 < cutoff < nyquist:
        raise FrictrackError(
            f"cutoff: expected a frequency between 0 and half the frame rate, {nyquist:g} Hz, but got "
            f"{cutoff:g} Hz; leave it out to have it chosen from the data"
        )
