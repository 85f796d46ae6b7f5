"""Frames in which part of the target is hidden: measured again from where their neighbours have it, or left empty.

A match of the whole picture is drawn toward whatever hides the target, and from there everything looks odd. From a
prediction by frames that show the target well, what hides it stands out and is left out (`measure`).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from frictrack.recording import Recording
from frictrack.records import Array, Mask
from frictrack.tracking.follow import NOISIER, Followed
from frictrack.tracking.measure import Lesson, unexplained, without_what_does_not_fit
from frictrack.tracking.waves import RANGE

NEAR = 3  # frames to the nearest good one, over which a prediction is trusted
NEIGHBOURS, FAR = 16, 64  # good frames that predict a place, and how far away they may be
ROUNDS = 64  # of predicting from frames that the round before has measured
HIDDEN_SHARE = 0.03  # of the picture's variance, left unexplained beyond the noise: something else than the target
AGREES = 4.0  # standard deviations of a place, that its prediction may be off by
HIDDEN = "too much of the target is hidden"


def measure_hidden(film: Recording, followed: Followed, lesson: Lesson) -> None:
    """Measure frames that hold more than the target again, and say which of them cannot be trusted."""
    limit = NOISIER * max(lesson.usual, lesson.template.least_misfit)
    odd = followed.found & ~((followed.fine.misfit < limit) & followed.fine.settled)
    if not odd.any() or np.isnan(limit):
        return
    good = followed.found & ~odd
    tried = ~odd
    for _ in range(ROUNDS):
        rows = np.flatnonzero(~tried & (_distance(good) <= NEAR))
        if len(rows) == 0:
            break
        tried[rows] = True
        good[rows] = _again(film, followed, rows, np.flatnonzero(good), lesson)
    _accept_gradual(followed, good, unexplained(followed.fine.score, followed.fine.misfit, lesson.usual))
    followed.reason[odd & ~good] = HIDDEN


def _accept_gradual(followed: Followed, good: Mask, share: Array) -> None:
    """Add frames to the `good` ones that leave hardly more unexplained, `share` (n,), than the good ones before.

    Light and background change gradually along a path, what hides a target comes at once. The place must be where the
    neighbours have it, within its own deviation.
    """
    tried = good | ~followed.found
    for _ in range(len(good)):
        rows = np.flatnonzero(~tried & (_distance(good) <= NEAR))
        if len(rows) == 0:
            break
        tried[rows] = True
        known = np.flatnonzero(good)
        usual = np.array([np.median(share[known[np.argsort(np.abs(known - row))[:NEIGHBOURS]]]) for row in rows])
        off = np.abs(followed.at[rows] - _predicted(followed.at, rows, known)[0])
        agrees = np.all(off < AGREES * followed.fine.sigma[rows, :2], axis=1)
        few = share[rows] <= HIDDEN_SHARE
        good[rows] = few | (agrees & (share[rows] <= usual + HIDDEN_SHARE))
    good |= followed.found & ~tried & (share <= HIDDEN_SHARE)


def _distance(good: Mask) -> NDArray[np.int64]:
    """Frames from every frame to the nearest good one (n,); n where there is none."""
    n = np.arange(len(good))
    rows = np.flatnonzero(good)
    if len(rows) == 0:
        return np.full(len(good), len(good))
    after = np.searchsorted(rows, n).clip(0, len(rows) - 1)
    return np.minimum(np.abs(rows[after] - n), np.abs(rows[np.maximum(after - 1, 0)] - n))


def _again(
    film: Recording, followed: Followed, rows: NDArray[np.int64], good: NDArray[np.int64], lesson: Lesson
) -> Mask:
    """Measure some frames (m,) from predictions by the `good` ones; whether that came out right."""
    template = lesson.template
    size = template.weight.shape
    room = np.array(film.shape[::-1]) - np.array(size[::-1])
    predicted, nearest = _predicted(followed.at, rows, good)
    corner = np.rint(predicted).astype(np.int64).clip(0, room)
    guess = replace(followed.fine[nearest], at=np.clip(predicted - corner, -RANGE, RANGE))
    cuts, share = film.cut(rows, corner, size), None
    if lesson.view is not None:
        cuts, share = lesson.view.cleaned(cuts, corner, guess.gain, guess.offset)
    usual = max(lesson.usual, template.least_misfit)
    fine, _ = without_what_does_not_fit(cuts, guess, template, share, usual)
    fine = replace(fine, sigma=fine.sigma * lesson.inflation)
    right = fine.settled & (fine.misfit < NOISIER * usual) & np.all(np.abs(fine.at) < RANGE, axis=1)
    followed.corner[rows[right]] = corner[right]
    followed.fine.put(rows[right], fine[right])
    return np.asarray(right)


def _predicted(at: Array, rows: NDArray[np.int64], good: NDArray[np.int64]) -> tuple[Array, NDArray[np.int64]]:
    """Where parabolas through the nearest `good` frames have the target in some frames (m, 2); the nearest of these."""
    places, nearest = np.empty((len(rows), 2)), np.empty(len(rows), np.int64)
    for k, row in enumerate(rows):
        middle = int(np.searchsorted(good, row))
        near = good[max(middle - NEIGHBOURS, 0) : middle + NEIGHBOURS]
        near = near[np.argsort(np.abs(near - row), kind="stable")][:NEIGHBOURS]
        near = near[np.abs(near - row) <= FAR]
        nearest[k] = near[0]
        powers = np.vander((near - row) / FAR, min(3, 1 + len(near) // 3), increasing=True)
        places[k] = np.linalg.lstsq(powers, at[near], rcond=None)[0][0]
    return places, nearest
