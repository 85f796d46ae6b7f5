"""Decide whether a target learnt from one film is the same in another: same body, scale, light and sharpness.

The template of the other film is placed by correlation, the film is followed with it, and the mean residual of many
frames is compared with their noise. What is different in the other film stays in the mean, while noise averages out.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from frictrack.recording import Recording
from frictrack.records import Array
from frictrack.tracking.correlation import Rectangle, correlate, nearest_corner
from frictrack.tracking.measure import residual_images
from frictrack.tracking.position_errors import sigma_inflation, systematic_covariance
from frictrack.tracking.raw_track import RawTrack
from frictrack.tracking.target_model import TargetModel

MIN_SCORE = 0.9  # of the known target's picture in the other film
SEARCH_SHARE = 0.5  # of the target's sides, around the place where a moving body was found
MIN_FRAMES = 24  # whose mean residual is compared
MAX_FRAMES = 96  # more show no smaller difference
# Largest mean square of a mean residual over that of the noise. Positions absorb what is a shift; the rest, unrelated
# to the slopes, moves them by the root of it: 0.14 standard deviations of a frame, about as much as the systematic
# error that every position is given. The noise of a template learnt from n frames alone makes 1/n of it.
MAX_DIFFERENCE = 0.02


def place_known_target(film: Recording, rectangle: Rectangle, frame: int, known: TargetModel) -> Rectangle | None:
    """Place the rectangle of a known target on the body that was found in another film.

    Parameters
    ----------
    film : Recording
        The other film.
    rectangle : tuple of int
        x, y, w, h of the body that was found, px.
    frame : int
        Number of the frame to which the rectangle refers.
    known : TargetModel
        Model learnt from the first film.

    Returns
    -------
    tuple of int or None
        x, y, w, h of the known target, px; None where its picture does not match.

    """
    size = np.array(known.template.weight.shape[::-1])
    middle = np.array(rectangle[:2]) + np.array(rectangle[2:]) / 2
    reach = np.ceil(SEARCH_SHARE * size)
    low = np.maximum(np.floor(middle - size / 2 - reach), 0).astype(int)
    high = np.minimum(np.ceil(middle + size / 2 + reach), film.shape[::-1]).astype(int)
    window = film.frame(frame)[low[1] : high[1], low[0] : high[0]]
    if np.any(np.array(window.shape[::-1]) < size):
        return None
    _, score, _, corner = cv2.minMaxLoc(correlate(window.astype(np.float32), known.template.image.astype(np.float32)))
    if score < MIN_SCORE:
        return None
    return int(corner[0] + low[0]), int(corner[1] + low[1]), int(size[0]), int(size[1])


def adapt_known_target(film: Recording, raw_track: RawTrack, known: TargetModel) -> TargetModel | None:
    """Adapt the model of a target to another film, in which it was followed.

    Parameters
    ----------
    film : Recording
        The other film, with random access.
    raw_track : RawTrack
        Track with the known template.
    known : TargetModel
        Model learnt from the first film.

    Returns
    -------
    TargetModel or None
        The same template with the position errors of this film; None where the target looks different.

    """
    found = np.flatnonzero(raw_track.found & raw_track.fit.converged)
    if len(found) < MIN_FRAMES:
        return None
    rows = np.unique(found[np.linspace(0, len(found) - 1, MAX_FRAMES).astype(int)])
    size = known.template.weight.shape
    corner = nearest_corner(raw_track.position[rows], film.shape, size)
    fit = raw_track.fit[rows].moved(raw_track.corner[rows] - corner)
    cuts = film.cut(rows, corner, size)
    if _mean_difference(residual_images(cuts, fit, known.template), known.template.weight) > MAX_DIFFERENCE:
        return None
    systematic = systematic_covariance(cuts, fit, known.template)
    if np.any(systematic):  # the appearance changes along the path, which a template of its own follows better
        return None
    return replace(known, sigma_inflation=sigma_inflation(cuts, fit, known.template))


def _mean_difference(residuals: Array, weight: Array) -> float:
    """Mean square of the mean residual (n, h, w) that noise does not explain, over the noise's mean square."""
    used = residuals[:, weight > 0].astype(np.float64)
    noise = float(np.mean(np.var(used, axis=0, ddof=1)))
    return float(np.mean(np.mean(used, axis=0) ** 2)) / max(noise, 1e-300) - 1 / len(used)
