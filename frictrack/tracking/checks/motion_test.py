"""Test whether a target moves: by more than the noise of its positions, and differently from the whole picture."""

from __future__ import annotations

import numpy as np

from frictrack.distributions import chi2_isf, normal_ppf
from frictrack.records import Array, Mask, Track

ALPHA = 1e-3  # significance level of motion
SMOOTH_FRAMES = 16  # from this number on, the steps of a smooth path can be distinguished from those of noise


def at_rest(track: Track) -> tuple[str, ...]:
    """Note that a target does not move by more than its noise.

    Parameters
    ----------
    track : Track
        Track of the target.

    Returns
    -------
    tuple of str
        Empty for a target that moves.

    """
    found = _compared(track)
    if _moves(_places(track)[:, found], _sigma(track)[:, found]):
        return ()
    noise = float(np.sqrt(np.median(np.mean(_sigma(track)[:, found] ** 2, axis=0))))
    return (
        f"the target does not move by more than the noise of its places, {noise:.2g} px; if something else in the "
        "picture moves, give its rectangle as target = [x, y, w, h], else film it closer",
    )


def moves_with(track: Track, reference: Track) -> bool:
    """Test whether a target moves, but not relative to a reference: then the reference moves as well.

    Parameters
    ----------
    track, reference : Track
        Tracks of the same film.

    Returns
    -------
    bool
        True where the reference moves like the target.

    """
    found = _compared(track) & _compared(reference)
    if np.count_nonzero(found) < SMOOTH_FRAMES:
        return False
    own, other = _places(track)[:, found], _places(reference)[:, found]
    sigma = _sigma(track)[:, found]
    return _moves(own, sigma) and not _moves(own - other, np.hypot(sigma, _sigma(reference)[:, found]))


def _compared(track: Track) -> Mask:
    """Frames (n,) that were compared with another frame than themselves."""
    return np.asarray(track.found & (np.arange(len(track)) != track.template))


def _places(track: Track) -> Array:
    return np.stack([track.x_px, track.y_px])


def _sigma(track: Track) -> Array:
    return np.stack([track.sigma_px, track.sigma_y_px])


def _moves(places: Array, sigma: Array) -> bool:
    """Whether positions (2, n) scatter by more than their noise, or more smoothly than noise would.

    The ratio of squared steps to squares is 2 for noise, with a variance of 4 / n (von Neumann 1941, Ann. Math. Stat.
    12:367).
    """
    n, off = places.shape[1], places - places.mean(axis=1, keepdims=True)
    if float(np.sum((off / sigma) ** 2)) > chi2_isf(ALPHA, 2 * (n - 1)):
        return True
    ratio = np.sum(np.diff(off, axis=1) ** 2, axis=1) / np.maximum(np.sum(off**2, axis=1), 1e-300)
    return bool(n >= SMOOTH_FRAMES and float(np.min(ratio)) < 2 + normal_ppf(ALPHA / 2) * 2 / np.sqrt(n))
