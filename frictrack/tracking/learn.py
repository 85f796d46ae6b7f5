"""The template averaged over the run, and how far each of its pixels can be trusted.

One noisy frame as a template costs accuracy (Clement et al. 2018, arXiv:1809.05583), so the cut-outs of up
to 160 frames, spread over the travelled path, are registered and their median is the template. The spread
about it shows which pixels belong to the target: where the rectangle holds background, the picture changes
as the target moves on, or is just what the empty scene looks like there. Such pixels get little weight or
none, because background that stays while the target moves would pull the track back, slowly and unseen.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from frictrack.records import Array, Mask
from frictrack.tracking.follow import Coarse
from frictrack.tracking.match import cut_out
from frictrack.tracking.refine import Fine, Template, refine
from frictrack.tracking.resample import MARGIN, Patch, resample

FRAMES = 160
BYTES = 64_000_000  # of registered pictures held at once
ROUNDS = 2
GOOD_SCORE = 0.7
LEAST_SHARE = 0.2  # of the rectangle that must move with the target before anything is masked
LEAK = 3  # px from the background within which interpolation mixes it in
OUTLINE = 0.5  # share of the contrast that must lie inside; else the outline is used as well
CHI2_MEDIAN = 0.455  # median of chi^2 with one degree of freedom
ROUNDING = 0.1  # variance of rounding to whole grey values, which a film without noise still has


def learn(coarse: Coarse, first: Array) -> Template:
    """The template of the run, from its coarse track.

    `first` (h + 2 PAD, w + 2 PAD) is the cut-out of the template frame, the start of the averaging.
    """
    here = np.zeros((1, 2))
    image = resample(first[None], here, MARGIN)[0][0].astype(np.float64)
    template = Template(image, np.ones([s - 2 * MARGIN for s in image.shape]))
    rows = _spread(coarse, image.size)
    patches, start = coarse.patches[rows], coarse.start[rows]
    scene = _scene(coarse, rows, template.weight.shape)
    for _ in range(ROUNDS):
        fine = refine(patches, start, template)
        good = fine.settled & (fine.score > GOOD_SCORE)
        if np.count_nonzero(good) < 3:
            break
        stack = _registered(patches[good], fine, good)
        image = np.asarray(np.median(stack, axis=0), dtype=np.float64)
        template = Template(image, _weight(stack, image, _registered(scene[good], fine, good)))
        start = fine.at
    return template


def _spread(coarse: Coarse, size: int) -> NDArray[np.int64]:
    """Cut-outs spread over the path travelled (a long rest must not decide what the target looks like)."""
    step = np.hypot(*np.diff(coarse.corner[coarse.frame], axis=0).T)
    step[step < 0.5] = 0.0
    path = np.concatenate([[0.0], np.cumsum(step)])
    index = np.linspace(0, 1, len(path))
    along = index if path[-1] < 1 else 0.9 * path / path[-1] + 0.1 * index
    count = int(np.clip(BYTES // (8 * size), 16, FRAMES))
    rows = np.searchsorted(along, np.linspace(0, 1, min(count, len(path))))
    return np.unique(rows.clip(0, len(path) - 1))


def _scene(coarse: Coarse, rows: NDArray[np.int64], size: tuple[int, ...]) -> Patch:
    """The still background as it lies behind each of these cut-outs."""
    background = coarse.background.astype(np.float32)
    return np.stack([cut_out(background, origin, (size[0], size[1])) for origin in coarse.origin[rows]])


def _registered(patches: Patch, fine: Fine, good: Mask) -> Array:
    """Pictures on the template's grid and in its grey values."""
    pictures, _ = resample(patches, fine.at[good], MARGIN)
    offset = fine.offset[good] - _level(fine, good)
    return (pictures - offset[:, None, None]) / fine.gain[good][:, None, None]


def _level(fine: Fine, good: Mask) -> float:
    """Offsets are relative to the template's mean: keep the average level of the run."""
    return float(np.median(fine.offset[good]))


def _weight(stack: Array, image: Array, scene: Array) -> Array:
    """Weight of the template's pixels (h, w), 0 to 1; arguments with MARGIN pixels round them."""
    inner = (slice(MARGIN, -MARGIN), slice(MARGIN, -MARGIN))
    spread = np.median((stack - image) ** 2, axis=0) / CHI2_MEDIAN + ROUNDING
    differs = np.median((stack - scene) ** 2, axis=0) / CHI2_MEDIAN
    moves = _trimmed((spread < 0.5 * differs).astype(np.uint8), image)[inner]
    weight = np.minimum(1.0, 2.0 * np.median(spread[inner]) / spread[inner])
    return weight * moves if moves.mean() > LEAST_SHARE else weight


def _trimmed(moves: NDArray[np.uint8], picture: Array) -> Mask:
    """What moves, less the edge across which background leaks in; with it where the edge is all there is."""
    moves = np.asarray(cv2.medianBlur(moves, 3))
    framed = cv2.copyMakeBorder(moves, LEAK, LEAK, LEAK, LEAK, cv2.BORDER_REPLICATE)
    eroded = cv2.erode(framed, np.ones((2 * LEAK + 1, 2 * LEAK + 1), np.uint8))
    inside = np.asarray(eroded[LEAK:-LEAK, LEAK:-LEAK]) > 0
    outlined = np.asarray(cv2.dilate(moves, np.ones((3, 3), np.uint8))) > 0
    energy = np.sum(np.square(np.gradient(picture)), axis=0)
    return inside if energy[inside].sum() > OUTLINE * energy[outlined].sum() else outlined
