"""Decide whether a target learnt from one film is the same in another: same body, scale, light and sharpness.

The template of the other film is placed by correlation, the film is followed with it, and the mean residual of many
frames is compared with their noise. What is different in the other film stays in the mean, while noise averages out.

Register the targets of two films, so that positions along the course refer to the same point of the same body.

Every film finds its target by itself, and the rectangle may differ by a pixel. The averaged pictures of the two targets
show by how much.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from frictrack.recording import Recording
from frictrack.records import Array, Track
from frictrack.tracking.correlation import best_match, nearest_corner
from frictrack.tracking.measure import residual_images, sigma_inflation, systematic_covariance
from frictrack.tracking.subpixel_fit import RawTrack, refine_positions, template_products
from frictrack.tracking.template import TargetModel, Template
from frictrack.tracking.template_learning import template_from_frame, without_border

MIN_SHARED_SCORE = 0.9  # of the known target's picture in the other film
SEARCH_SHARE = 0.5  # of the target's sides, around the place where a moving body was found
MIN_FRAMES = 24  # whose mean residual is compared
MAX_FRAMES = 96  # more show no smaller difference
# Largest mean square of a mean residual over that of the noise. Positions absorb what is a shift; the rest, unrelated
# to the slopes, moves them by the root of it: 0.14 standard deviations of a frame, about as much as the systematic
# error that every position is given. The noise of a template learnt from n frames alone makes 1/n of it.
MAX_DIFFERENCE = 0.02


def match_near(
    film: Recording, near: tuple[float, float, float, float], frame: int, template: Template
) -> tuple[Array, float]:
    """Corner (2,) px and score of the best match of a template about a rectangle, which may be as large or larger."""
    size, room = np.array(template.weight.shape[::-1]), np.array(film.shape[::-1])
    if np.any(room < size):
        return np.zeros(2), -1.0
    middle = np.array(near[:2]) + np.array(near[2:]) / 2
    half = size / 2 + np.ceil(np.maximum(SEARCH_SHARE * size, np.array(near[2:]) / 2 - size / 2))
    low = np.clip(np.floor(middle - half), 0, room - size).astype(int)
    high = np.clip(np.ceil(middle + half), low + size, room).astype(int)
    window = film.frame(frame)[low[1] : high[1], low[0] : high[0]]
    corner, score = best_match(window.astype(np.float32), template.image.astype(np.float32), template.mask)
    return low + corner, score


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


MAX_OFFSET_SHARE = 0.25  # of the target's sides
MIN_SAME_BODY_SCORE = 0.8  # correlation of two pictures of the same body
MIN_CORRECTION_PX = 0.02  # a smaller offset is not corrected
MIN_CORE_PX = 12  # shortest side of the compared part


@dataclass(frozen=True)
class TargetOffset:
    """Offset from the centre of one target's picture to the centre of the other's, with its error, px."""

    dx: float
    dy: float
    sigma_x: float
    sigma_y: float


def align_track(track: Track, reference: Track, name: str = "the reference") -> Track:
    """Move a track to the point of the body that a reference track follows.

    Parameters
    ----------
    track, reference : Track
        Tracks with the pictures of their targets.
    name : str
        What the notes call the reference.

    Returns
    -------
    Track
        With a note of what was done; unchanged, with a note, where the pictures do not show the same body.

    Examples
    --------
    >>> import frictrack as ft
    >>> film = ft.open_recording(ft.samples.films_folder() / "fast.avi")
    >>> track = ft.track(film)
    >>> aligned = ft.align_track(track, track)
    >>> bool(abs(aligned.x_px - track.x_px)[:140].max() < 0.01)
    True

    """
    found = target_offset(track.picture, reference.picture)
    if found is None:
        note = (
            f"its target does not look like that of {name}: it has an origin of its own along the course, which agrees "
            "with the other only as well as the two rectangles do, about a pixel; x_offset corrects it"
        )
        return replace(track, notes=(*track.notes, note))
    if np.hypot(found.dx, found.dy) < max(MIN_CORRECTION_PX, 2 * np.hypot(found.sigma_x, found.sigma_y)):
        return track
    note = (
        f"tracked point moved by ({found.dx:+.3f} +/- {found.sigma_x:.3f}, {found.dy:+.3f} +/- {found.sigma_y:.3f}) px "
        f"to that of {name}"
    )
    return replace(track, x_px=track.x_px + found.dx, y_px=track.y_px + found.dy, notes=(*track.notes, note))


def target_offset(picture: Array | None, reference: Array | None) -> TargetOffset | None:
    """Measure the offset between two pictures of the same body.

    The middle of one picture is located in the other by cross-correlation, then refined as a target in a frame is.

    Parameters
    ----------
    picture, reference : array (h, w) or None
        Averaged pictures of the targets, DN.

    Returns
    -------
    TargetOffset or None
        None where they do not show the same body or are too small.

    """
    if picture is None or reference is None:
        return None
    edge = np.maximum((MAX_OFFSET_SHARE * np.array(picture.shape)).astype(int), 1)
    core = picture[edge[0] : -edge[0], edge[1] : -edge[1]].astype(np.float32)
    reference_image = reference.astype(np.float32)
    if min(core.shape) < MIN_CORE_PX or np.any(np.array(reference_image.shape) < np.array(core.shape) + 2):
        return None
    corner, score = best_match(reference_image, core)
    if score < MIN_SAME_BODY_SCORE:
        return None
    x, y = np.rint(corner).astype(int)
    template = without_border(template_from_frame(core))
    cut = reference_image[None, y : y + core.shape[0], x : x + core.shape[1]]
    fit = refine_positions(template_products(cut, template), np.zeros((1, 2)), template)
    # The core has the same centre as the picture from which it was cut.
    dx, dy = (np.array(reference_image.shape[::-1]) - core.shape[::-1]) / 2 - (x, y) - fit.position[0]
    return TargetOffset(float(dx), float(dy), float(fit.sigma[0, 0]), float(fit.sigma[0, 1]))
