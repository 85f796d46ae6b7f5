"""Find interlaced films: odd lines show the target half a frame earlier or later than even lines."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import shift

from frictrack.recording import Recording
from frictrack.records import Array, Track

FRAMES = 24  # that are looked at, those in which the target is fastest
MIN_STEP_PX = 0.5  # of the target from frame to frame; slower ones show nothing
MAX_MISFIT_SHARE = 0.6  # of lines that are moved by half a step, over that of lines as they are


def interlacing_note(film: Recording, track: Track) -> tuple[str, ...]:
    """Note that the lines of a film were exposed at two moments.

    Parameters
    ----------
    film : Recording
        The film, with random access.
    track : Track
        Track of the target.

    Returns
    -------
    tuple of str
        Empty for a progressive film, and where the target is too slow to tell.

    """
    assert track.target is not None
    width, height = (int(side) for side in track.target[2:])
    step = np.nan_to_num(np.gradient(track.x_px)) * track.found
    fastest = np.sort(np.argsort(-np.abs(step))[:FRAMES])
    fastest = fastest[(np.abs(step[fastest]) > MIN_STEP_PX) & (np.abs(step[fastest]) < width / 2)]
    if not len(fastest):
        return ()
    corners = np.stack([track.x_px - (width - 1) / 2, track.y_px - (height - 1) / 2], axis=1)[fastest]
    corners = np.clip(np.rint(corners).astype(int), 0, np.array(film.shape)[::-1] - (width, height))
    pictures = film.cut(fastest, corners, (height, width)).astype(float)
    shares = [_misfit_shares(*each) for each in zip(pictures, step[fastest] / 2, corners[:, 1], strict=True)]
    if min(np.median(shares, axis=0)) > MAX_MISFIT_SHARE:
        return ()
    return (
        "the film is interlaced: odd and even lines show the target at two moments, half a frame apart; film "
        "progressively, or separate the fields, as with ffmpeg -vf bwdif=send_field",
    )


def _misfit_shares(picture: Array, moved: float, top: int) -> tuple[float, float]:
    """Misfit of the odd lines to their neighbours once moved by so many px, to either side, over that unmoved."""
    first = 1 + top % 2  # the first odd line of the film with a line above it
    odd = picture[first:-1:2]
    between = (picture[first - 1 : -2 : 2][: len(odd)] + picture[first + 1 :: 2][: len(odd)]) / 2
    edge = int(np.ceil(abs(moved))) + 1
    left = [(shift(odd, (0, by), order=3, mode="nearest") - between)[:, edge:-edge] for by in (0.0, moved, -moved)]
    still, right, wrong = (float(np.sum(part**2)) for part in left)
    return right / max(still, 1e-300), wrong / max(still, 1e-300)
