"""The last look at every frame: with the learnt picture, without what stands in the way.

A frame whose residual picture holds more than noise is measured again with the pixels that do not fit left out
(Tukey's idea: what lies far off counts nothing), be it behind a rod, under a flash or half out of the light.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from frictrack.records import Array
from frictrack.tracking.match import Patch
from frictrack.tracking.refine import Fine, products, refine
from frictrack.tracking.template import Template
from frictrack.tracking.view import View
from frictrack.tracking.waves import RANGE

MISFITS = 1.5  # times the usual mean squared residual: the frame shows more than the target
AGAIN = 4  # rounds of leaving out what does not fit
LEAST_LEFT = 0.25  # of the pixels that must still count
FAR, FARTHEST = 2.5, 4.5  # standard deviations from which a pixel counts less, and nothing
TRUSTED = 2.0  # times the usual noise: what a prediction may be off by
BORDERS = 2, 6  # px of border left out in any case, and at most
CHANCE = 2.0  # standard deviations of the misfit that ask for more
BORDERLESS = 0.5  # of the least that must still count, without borders
FEW = 0.02  # of the pixels: fewer that do not fit are noise, and have no border
MANY = 0.5, 0.8  # share of the neighbours that fit, below which a pixel counts nothing, and less


@dataclass(frozen=True, eq=False)
class Lesson:
    """What the film has taught: the template, what stands still before it, and the usual misfit."""

    template: Template
    view: View | None = None
    usual: float = np.nan  # nan: that of the frames at hand
    inflation: Array = field(default_factory=lambda: np.ones(3))  # of the standard deviations, see `trust`
    slow: Array = field(default_factory=lambda: np.zeros((2, 2)))  # px^2, of what the target's changing look adds
    turns: bool = False  # the target turns by more than small rotations


def measure(cuts: Patch, corner: NDArray[np.int64], guess: Fine, lesson: Lesson) -> tuple[Fine, Patch | None]:
    """Positions in cut-outs (n, h, w) taken at `corner` (n, 2), from the `guess` of an earlier round.

    Also the share (n, h, w) of its weight that each pixel has kept; None where all have kept all.
    """
    share, template = None, lesson.template
    if lesson.view is not None:
        cuts, share = lesson.view.cleaned(cuts, corner, guess.gain, guess.offset)
    fine = refine(products(cuts, template), guess.at, template)
    covered = np.zeros(len(cuts), np.bool_) if share is None else np.any(share < 1, axis=(1, 2))
    usual = float(np.median(fine.misfit)) if np.isnan(lesson.usual) else lesson.usual
    usual = max(usual, template.least_misfit)
    odd = np.flatnonzero((covered | (fine.misfit > MISFITS * usual)) & guess.settled)
    if len(odd):
        share = np.ones(cuts.shape, np.float32) if share is None else share
        better, kept = without_what_does_not_fit(cuts[odd], guess[odd], template, share[odd], usual)
        # Where the rest is no better, the whole picture stands, with the larger deviation that its misfit tells.
        good = odd[better.settled]
        share[good] = kept[better.settled]
        fine.put(good, better[better.settled])
    return replace(fine, sigma=fine.sigma * lesson.inflation), share


def without_what_does_not_fit(
    cuts: Patch, guess: Fine, template: Template, given: Patch | None = None, usual: float = np.nan
) -> tuple[Fine, Patch]:
    """The frames (n, h, w), pixel by pixel weighted by how well they fit a `guess`, then each better fit; the weights.

    `given` (n, h, w) is the share of their weight that pixels have in the first place. With the `usual` misfit of a
    frame that holds nothing but target and noise the guess is trusted, and may speak against most of the picture;
    without, it is one that the whole picture has made. Where hardly anything is left, the frame is not settled.
    """
    counts = (template.weight > 0).astype(np.float32)
    given = np.broadcast_to(counts, cuts.shape) if given is None else given * counts
    fine, scale = guess, np.full(len(cuts), TRUSTED * np.sqrt(usual))
    enough, share = np.ones(len(cuts), np.bool_), np.array(given)
    for k in range(AGAIN):
        left = residual(cuts, fine, template)
        if k or np.isnan(usual):
            scale = _scale(left, share)
        share = given * fits(left / scale[:, None, None].astype(np.float32), given)
        enough &= share.mean(axis=(1, 2)) > LEAST_LEFT * float(counts.mean())
        start = np.clip(np.nan_to_num(fine.turned_back()), -RANGE, RANGE)
        share[~enough] = given[~enough]  # nothing sensible is left; the whole picture is as good as any
        better = refine(products(cuts, template, share), start, template)
        lost = ~better.settled  # what went nowhere is no ground to stand on: the last place is
        better.put(lost, replace(fine[lost], settled=better.settled[lost]))
        fine = better
    if not np.isnan(usual):
        fine, share = _without_borders(cuts, fine, template, share, given, usual)
        enough &= share.mean(axis=(1, 2)) > BORDERLESS * LEAST_LEFT * float(counts.mean())
    return replace(fine, settled=fine.settled & enough), share


def _without_borders(
    cuts: Patch, fine: Fine, template: Template, share: Patch, given: Patch, usual: float
) -> tuple[Fine, Patch]:
    """Leave out what lies round what was left out, and more of it as long as the rest misfits by more than chance.

    The soft edge of what hides the target differs from it by less than the noise of one pixel, but all of it together
    draws the place along.
    """
    out = share.copy()
    hidden = np.mean(out < 0.5 * given, axis=(1, 2)) > FEW
    for k in range(BORDERS[1]):
        chance = CHANCE * np.sqrt(2 / np.maximum(out.sum(axis=(1, 2)), 1.0))
        rows = np.flatnonzero(hidden & fine.settled & ((k < BORDERS[0]) | (fine.misfit > usual * (1 + chance))))
        if len(rows) == 0:
            break
        out[rows] = [cv2.erode(picture, np.ones((3, 3), np.uint8)) for picture in out[rows]]
        start = np.clip(fine[rows].turned_back(), -RANGE, RANGE)
        better = refine(products(cuts[rows], template, out[rows]), start, template)
        fine.put(rows, better)
    return fine, out


def _scale(left: Patch, share: Patch) -> Array:
    """Standard deviation (n,) of the residual pictures where they count, from the median."""
    scale = [
        1.4826 * np.median(np.abs(p[s > 0.5])) if np.any(s > 0.5) else 1.0 for p, s in zip(left, share, strict=True)
    ]
    return np.maximum(scale, 1e-6)


def unexplained(score: Any, misfit: Any, usual: float) -> Any:
    """Share of a picture's variance that neither the target nor the usual noise explains; numbers or arrays."""
    return (1 - score**2) * (1 - usual / np.maximum(misfit, usual))


def residual(cuts: Patch, fine: Fine, template: Template) -> Array:
    """What the target does not explain of the cut-outs (n, h, w), in standard deviations of the template's noise."""
    return (template.weighted(cuts) - modelled(fine, template) * template.root).reshape(cuts.shape)


def modelled(fine: Fine, template: Template) -> Array:
    """What the cut-outs should show (n, h w), DN above the template's level."""
    columns = template.columns(fine.turned_back())
    ones = np.ones_like(fine.gain)
    parts = np.stack([fine.gain, fine.offset - template.level, 0 * ones, 0 * ones, fine.gain * fine.angle], axis=1)
    weights = np.einsum("ni,nik->nk", parts, columns).astype(np.float32)
    return np.asarray(weights @ template.pictures.astype(np.float32))


def fits(rated: Patch, given: Patch) -> Patch:
    """How well each pixel fits (n, h, w), 1 to 0, by itself and with its neighbours; `rated` in standard deviations."""
    fits = np.empty_like(rated)
    for k, picture in enumerate(rated):
        around = 3 * np.abs(cv2.blur(picture, (3, 3)))  # the mean of nine: a standard deviation of one third
        fits[k] = np.clip((FARTHEST - np.maximum(np.abs(picture), around)) / (FARTHEST - FAR), 0, 1)
        # Among many that do not fit, one that does is there by chance.
        company = cv2.blur(fits[k] * (given[k] > 0), (5, 5)) / np.maximum(cv2.blur(given[k], (5, 5)), 0.1)
        fits[k] *= np.clip((company - MANY[0]) / (MANY[1] - MANY[0]), 0, 1)
    return fits
