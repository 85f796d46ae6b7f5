"""Learn the target's picture from the film itself, with the noise of every pixel.

One noisy frame as a template costs accuracy (Clement et al. 2018, arXiv:1809.05583), so the picture is fitted to
frames from the whole path. Given their shifts it is linear least squares, and the frames enter it by a few sums
alone: with h_i the expansion of frame i's shift (see `waves`), sum h_i h_i' and sum h_i I_i stand for them all.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np

from frictrack.records import Array, Mask
from frictrack.tracking.match import Patch
from frictrack.tracking.refine import Fine
from frictrack.tracking.template import Template
from frictrack.tracking.waves import BAND, Shifts, shifts

CONJUGATE_STEPS = 15
# Px of the border that do not count: of a single frame, and where all frames show the same (there slopes are off by
# 0.4 % two pixels from the border of a target of 24 x 40 px, by 0.1 % four pixels from it).
RIM, WIDE_RIM = (2,), (2, 4)
ALIKE = 16  # neighbouring waves along either axis that share what is expected of them
LARGEST_DOUBT = 10.0  # over what the frames show of a wave: more would only slow the conjugate gradients
CLOSE = 1e-9  # of the squared gradient of no picture at all; less is below the noise
RIDGE = 2.5e-4  # frames' worth of doubt whether there is any picture: keeps what lies outside the window finite
LEAST_SHARE = 0.2  # of the rectangle that must move with the target before anything is masked
DECISIVE = 4.0  # times better, for so many pixels: of a target that hardly moves, noise makes a fifth twice better
MEDIAN_OF = 60  # frames
SELDOM = 0.5  # share of the frames in which a pixel of the target must show it
LEAK = 2  # px from the background within which the lens and the sub-pixel shifts mix it in
OUTLINE = 0.5  # share of the contrast that must lie inside; else the outline is used as well
SCATTERS = 1.5  # times the noise: such a pixel is not just noisy, it shows something that comes and goes
ROUNDING = 1 / 12  # variance of rounding to whole grey values, which a film without noise still has


def first_look(cut: Patch, belongs: Mask | None = None) -> Template:
    """The template that one cut-out (h, w) makes, of which some pixels (h, w) belong to the target, or all."""
    shown = cut if belongs is None else cut[belongs]
    weight = np.ones(cut.shape) / max(float(np.var(shown)), 1.0)
    weight = weight if belongs is None else weight * belongs
    level = float(np.mean(shown))
    grid = shifts((cut.shape[0], cut.shape[1]))
    still = grid.design(np.zeros((1, 2)))[0]
    waves = _fitted(grid, still, (cut - level).reshape(1, -1), weight, np.zeros(grid.n_waves), _least_doubt(weight, 1))
    return Template(waves, weight, level, belongs=belongs)


def without_border(template: Template, rims: Sequence[int] = RIM) -> Template:
    """The template whose border counts nothing: as the target moves, its border shows what one frame has not seen.

    The border is the widest of `rims` (px) that leaves three quarters of a side, else one pixel.
    """
    shape = template.weight.shape
    rim = [max((r for r in rims if 8 * r <= side), default=1) for side in shape]
    whole = np.ones(shape, np.uint8) if template.belongs is None else template.belongs.astype(np.uint8)
    around = np.ones([2 * r + 1 for r in rim], np.uint8)
    counts = cv2.erode(whole, around, borderType=cv2.BORDER_CONSTANT, borderValue=0.0)
    return replace(template, weight=template.weight * counts)


def learn(
    cuts: Patch, fine: Fine, template: Template, scene: Patch | None = None, share: Patch | None = None
) -> Template:
    """The template that fits the cut-outs (n, h, w) best where `fine` found the target in them.

    `scene` (n, h, w) is the still background behind each cut-out, where it is known; `share` (n, h, w) how much of
    each pixel shows the target, the rest is taken to be as expected.
    """
    fine = replace(fine, gain=fine.gain / np.median(fine.gain))  # the picture is that of the usual light
    pixels = cuts.reshape(len(cuts), -1).astype(np.float32) - fine.offset.astype(np.float32)[:, None]
    columns, turn = _columns(template, fine)
    pixels -= turn
    k = columns.shape[1]
    seen = pixels
    if share is not None:
        expected = columns.astype(np.float32) @ template.pictures[:k].astype(np.float32)
        seen = expected + share.reshape(pixels.shape) * (pixels - expected)
    waves, freedom = _waves(template, columns, seen)
    learnt = replace(template, waves=waves, level=float(np.median(fine.offset)))
    left = pixels - columns.astype(np.float32) @ learnt.pictures[:k].astype(np.float32)
    left = (left / fine.gain.astype(np.float32)[:, None]).reshape(cuts.shape)
    moves = None if scene is None else _moves(cuts, scene, left, learnt.image)
    spread = _spread(left, share, freedom)
    spread = spread if template.belongs is None else np.where(template.belongs, spread, np.inf)
    return replace(learnt, weight=_weight(spread, learnt.image, moves))


def _spread(left: Patch, share: Patch | None, freedom: float) -> Array:
    """Variance (h, w) of each pixel about the picture, DN^2; infinite where it seldom shows the target."""
    n, size = len(left), left[0].size
    lost = min(freedom / size, 0.5 * n)  # frames' worth of noise that the picture has taken up
    if share is None:
        return np.mean(left**2, axis=0) * (n / (n - lost)) + ROUNDING
    counted = np.sum(share, axis=0)
    spread = np.einsum("nij,nij,nij->ij", share, left, left) / np.maximum(counted, 1.0) * (n / (n - lost))
    return np.where(counted > SELDOM * n, spread + ROUNDING, np.inf)


def _columns(template: Template, fine: Fine) -> tuple[Array, Patch]:
    """Gain times the expansion of every frame's shift (n, k), and what its turn changes (n, h w)."""
    picture, _, _, turn = template.shifts.design(fine.turned_back())
    k = picture.shape[1]
    turned = (turn * (fine.gain * fine.angle)[:, None]).astype(np.float32)
    return picture * fine.gain[:, None], turned @ template.pictures[k:-1].astype(np.float32)


def _waves(template: Template, columns: Array, pixels: Patch) -> tuple[Array, float]:
    """The picture's waves in frames' pixels (n, h w) with columns (n, k), and how many numbers the frames have given.

    Short waves are doubted: they have steep slopes, and their noise, which every frame shares, would be the place's.
    """
    n, weight = len(columns), template.weight
    least = _least_doubt(weight, n)
    waves = _fitted(template.shifts, columns, pixels, weight, template.waves, least)
    if max(template.bands) <= BAND:
        return waves, waves.size
    doubt = _doubt(waves, weight, n)
    waves = _fitted(template.shifts, columns, pixels, weight, waves, doubt)
    return waves, float(np.sum(1 / (1 + doubt / _shown(weight, n))))


def _least_doubt(weight: Array, n: int) -> float:
    return RIDGE * n * float(weight.mean())


def _shown(weight: Array, n: int) -> float:
    """How surely n frames show a wave: one over the variance of its coefficient, 1 / DN^2."""
    return n * float(weight.sum()) / 4  # the squares of two cosines


def _doubt(waves: Array, weight: Array, n: int) -> Array:
    """One over the expected square of every wave's coefficient, 1 / DN^2, from coefficients without doubt.

    Waves of about the same length share theirs: what they hold on average, less what noise alone would make of it
    (Wiener 1949; the expectation from the data themselves, Efron & Morris 1973, J. Am. Stat. Assoc. 68:117).
    """
    down, across = (_alike(count) for count in waves.shape)
    power, shown = down @ waves**2 @ across, _shown(weight, n)
    return np.clip(1 / np.maximum(power - 1 / shown, 1e-300), _least_doubt(weight, n), LARGEST_DOUBT * shown)


def _alike(count: int) -> Array:
    """What takes the mean over each `ALIKE` neighbours (count, count)."""
    group = np.arange(count) // ALIKE
    same = group[:, None] == group
    return same / same.sum(axis=0)


def _fitted(grid: Shifts, columns: Array, pixels: Patch, weight: Array, start: Array, doubt: Array | float) -> Array:
    """Coefficients of the picture by weighted least squares of pixels (n, h w) = columns (n, k) B.

    `doubt`, 1 / DN^2, holds each of them to zero.

    Conjugate gradients on a small problem: as many pseudo-frames as there are shifts to tell apart stand for the
    frames, columns' columns = L L'.
    """
    values, vectors = np.linalg.eigh(columns.T @ columns)
    keep = values > 1e-7 * values[-1]
    mix = vectors[:, keep] * np.sqrt(values[keep])
    sums = (columns.T.astype(np.float32) @ pixels.astype(np.float32)).astype(np.float64)
    pseudo = ((vectors[:, keep] / np.sqrt(values[keep])).T @ sums).astype(np.float32)
    mix, rate = mix.astype(np.float32), weight.ravel().astype(np.float32)
    ridge = np.float32(doubt)

    def forward(waves: Patch) -> Patch:
        return mix.T @ grid.pictures(waves).reshape(len(mix), -1)

    def back(pictures: Patch) -> Patch:
        return grid.adjoint((mix @ (pictures * rate)).reshape(-1, *weight.shape))

    waves: Patch = start.astype(np.float32)
    left = back(pseudo - forward(waves)) - ridge * waves
    way, size = left, float(np.sum(left**2))
    aim = CLOSE * float(np.sum(back(pseudo) ** 2))
    for _ in range(CONJUGATE_STEPS):
        if size <= aim:
            break
        bent = back(forward(way)) + ridge * way
        length = np.float32(size / float(np.sum(way * bent)))
        waves, left = waves + length * way, left - length * bent
        before, size = size, float(np.sum(left**2))
        way = left + np.float32(size / before) * way
    return waves.astype(np.float64)


def _moves(cuts: Patch, scene: Patch, left: Patch, image: Array) -> Mask | None:
    """Pixels that move with the target: better explained by it than by the still scene; None where too few do.

    Medians over some of the frames, since a rod before the target is no background.
    """
    few = slice(None, None, -(-len(cuts) // MEDIAN_OF))
    spread = np.median(left[few] ** 2, axis=0)
    differs = np.median((cuts[few].astype(np.float32) - scene[few]) ** 2, axis=0)
    if np.quantile(differs / np.maximum(spread, ROUNDING), 1 - LEAST_SHARE) < DECISIVE:
        return None
    moves = _trimmed((spread < 0.5 * differs).astype(np.uint8), image)
    return moves if moves.mean() > LEAST_SHARE else None


def _trimmed(moves: Array, picture: Array) -> Mask:
    """What moves, less the edge across which background leaks in; with it where the edge is all there is."""
    moves = np.asarray(cv2.medianBlur(moves, 3))
    framed = cv2.copyMakeBorder(moves, LEAK, LEAK, LEAK, LEAK, cv2.BORDER_REPLICATE)
    eroded = cv2.erode(framed, np.ones((2 * LEAK + 1, 2 * LEAK + 1), np.uint8))
    inside = np.asarray(eroded[LEAK:-LEAK, LEAK:-LEAK]) > 0
    outlined = np.asarray(cv2.dilate(moves, np.ones((3, 3), np.uint8))) > 0
    energy = np.sum(np.square(np.gradient(picture)), axis=0)
    return inside if energy[inside].sum() > OUTLINE * energy[outlined].sum() else outlined


def _weight(spread: Array, image: Array, moves: Mask | None) -> Array:
    """One over the variance of each pixel (h, w): the photon-transfer line, or its own where it scatters more.

    Shot noise grows with the light: variance = read noise + light / (electrons per DN), Janesick 2007, Photon Transfer.
    """
    line = _photon_line(spread, image)
    scatters = spread > SCATTERS * line
    weight = 1 / np.where(scatters, spread, line)
    return weight if moves is None else weight * moves


def _photon_line(spread: Array, image: Array) -> Array:
    """The line through variance against light, that of the pixels which follow one; nowhere below half its median."""
    good = np.isfinite(spread)
    line = np.full(spread.shape, np.median(spread[good]) if good.any() else 1.0)
    for _ in range(3):
        good = spread < SCATTERS * line
        if np.count_nonzero(good) < 20 or np.ptp(image[good]) <= 0:
            break
        slope, level = np.polynomial.Polynomial.fit(image[good], spread[good], 1).convert().coef[::-1]
        line = np.maximum(level + max(slope, 0.0) * image, 0.5 * np.median(spread[good]))
    return line
