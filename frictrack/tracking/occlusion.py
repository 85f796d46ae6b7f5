"""Measure frames in which part of the target is hidden again, starting from the positions in neighbouring frames.

A match of the whole template is biased toward an object that hides the target, and from the biased position all pixels
misfit. From a position predicted by frames that show the target well, the object itself stands out and is excluded.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from frictrack.recording import Recording
from frictrack.records import Array, Mask
from frictrack.tracking.batch_tracker import MAX_MISFIT_RATIO
from frictrack.tracking.cosine_basis import MAX_SHIFT_PX
from frictrack.tracking.measure import refine_robust, unexplained_share
from frictrack.tracking.raw_track import RawTrack
from frictrack.tracking.target_model import TargetModel

MAX_PREDICTION_GAP = 3  # frames to the nearest good one
MAX_NEIGHBOURS, MAX_NEIGHBOUR_DISTANCE = 16, 64  # good frames that predict a position, and their distance in frames
MAX_ROUNDS = 64  # of predicting from the frames of the round before
MAX_UNEXPLAINED_SHARE = 0.03  # of the picture's variance beyond the noise; more shows another object
MAX_PREDICTION_SIGMAS = 4.0  # standard deviations between position and prediction
OCCLUDED = "too much of the target is hidden"


def remeasure_occluded(film: Recording, raw_track: RawTrack, target_model: TargetModel) -> None:
    """Measure frames with a large misfit again, and mark those that cannot be trusted.

    Parameters
    ----------
    film : Recording
        Film with random access.
    raw_track : RawTrack
        Track of the target; it is updated in place.
    target_model : TargetModel
        Learnt model of the target.

    """
    limit = MAX_MISFIT_RATIO * max(target_model.typical_misfit, target_model.template.min_misfit)
    suspect = raw_track.found & ~((raw_track.fit.misfit < limit) & raw_track.fit.converged)
    if not suspect.any() or np.isnan(limit):
        return
    good = raw_track.found & ~suspect
    visited = ~suspect
    for _ in range(MAX_ROUNDS):
        rows = np.flatnonzero(~visited & (_distance(good) <= MAX_PREDICTION_GAP))
        if len(rows) == 0:
            break
        visited[rows] = True
        good[rows] = _remeasure(film, raw_track, rows, np.flatnonzero(good), target_model)
    _accept_gradual(
        raw_track, good, unexplained_share(raw_track.fit.score, raw_track.fit.misfit, target_model.typical_misfit)
    )
    raw_track.reason[suspect & ~good] = OCCLUDED


def _accept_gradual(raw_track: RawTrack, good: Mask, share: Array) -> None:
    """Accept frames whose unexplained `share` (n,) hardly exceeds that of neighbouring good frames.

    Light and background change gradually along the path, while an occluding object appears at once. The position must
    also
    agree with the prediction from the neighbours, within its own standard deviation.
    """
    visited = good | ~raw_track.found
    for _ in range(len(good)):
        rows = np.flatnonzero(~visited & (_distance(good) <= MAX_PREDICTION_GAP))
        if len(rows) == 0:
            break
        visited[rows] = True
        good_rows = np.flatnonzero(good)
        typical = np.array(
            [np.median(share[good_rows[np.argsort(np.abs(good_rows - row))[:MAX_NEIGHBOURS]]]) for row in rows]
        )
        off = np.abs(raw_track.position[rows] - _predict_from_neighbours(raw_track.position, rows, good_rows)[0])
        agrees = np.all(off < MAX_PREDICTION_SIGMAS * raw_track.fit.sigma[rows, :2], axis=1)
        little_unexplained = share[rows] <= MAX_UNEXPLAINED_SHARE
        good[rows] = little_unexplained | (agrees & (share[rows] <= typical + MAX_UNEXPLAINED_SHARE))
    good |= raw_track.found & ~visited & (share <= MAX_UNEXPLAINED_SHARE)


def _distance(good: Mask) -> NDArray[np.int64]:
    """Distance (n,) in frames from every frame to the nearest good one; n where there is none."""
    n = np.arange(len(good))
    rows = np.flatnonzero(good)
    if len(rows) == 0:
        return np.full(len(good), len(good))
    after = np.searchsorted(rows, n).clip(0, len(rows) - 1)
    return np.minimum(np.abs(rows[after] - n), np.abs(rows[np.maximum(after - 1, 0)] - n))


def _remeasure(
    film: Recording, raw_track: RawTrack, rows: NDArray[np.int64], good: NDArray[np.int64], target_model: TargetModel
) -> Mask:
    """Measure frames (m,) from predictions by the good ones; return which of them succeeded."""
    template = target_model.template
    size = template.weight.shape
    max_corner = np.array(film.shape[::-1]) - np.array(size[::-1])
    predicted, nearest = _predict_from_neighbours(raw_track.position, rows, good)
    corner = np.rint(predicted).astype(np.int64).clip(0, max_corner)
    guess = replace(raw_track.fit[nearest], position=np.clip(predicted - corner, -MAX_SHIFT_PX, MAX_SHIFT_PX))
    cuts, share = film.cut(rows, corner, size), None
    if target_model.pattern is not None:
        cuts, share = target_model.pattern.corrected(cuts, corner, guess.gain, guess.offset)
    typical = max(target_model.typical_misfit, template.min_misfit)
    fit, _ = refine_robust(cuts, guess, template, share, typical)
    fit = replace(fit, sigma=fit.sigma * target_model.sigma_inflation)
    accepted = (
        fit.converged & (fit.misfit < MAX_MISFIT_RATIO * typical) & np.all(np.abs(fit.position) < MAX_SHIFT_PX, axis=1)
    )
    raw_track.corner[rows[accepted]] = corner[accepted]
    raw_track.fit.put(rows[accepted], fit[accepted])
    return np.asarray(accepted)


def _predict_from_neighbours(
    at: Array, rows: NDArray[np.int64], good: NDArray[np.int64]
) -> tuple[Array, NDArray[np.int64]]:
    """Predict positions (m, 2) px by parabolas through the nearest good frames; return the nearest of these, too."""
    places, nearest = np.empty((len(rows), 2)), np.empty(len(rows), np.int64)
    for k, row in enumerate(rows):
        centre = int(np.searchsorted(good, row))
        near = good[max(centre - MAX_NEIGHBOURS, 0) : centre + MAX_NEIGHBOURS]
        near = near[np.argsort(np.abs(near - row), kind="stable")][:MAX_NEIGHBOURS]
        near = near[np.abs(near - row) <= MAX_NEIGHBOUR_DISTANCE]
        nearest[k] = near[0]
        powers = np.vander((near - row) / MAX_NEIGHBOUR_DISTANCE, min(3, 1 + len(near) // 3), increasing=True)
        places[k] = np.linalg.lstsq(powers, at[near], rcond=None)[0][0]
    return places, nearest
