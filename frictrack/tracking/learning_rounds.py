"""Learn template, noise and fixed pattern from a film, in rounds of learning and measuring."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from frictrack.recording import Recording
from frictrack.records import Array, Mask
from frictrack.tracking.areas import with_obstacles
from frictrack.tracking.correlation import Patch, nearest_corner
from frictrack.tracking.measure import measure_frames, model_images, systematic_covariance
from frictrack.tracking.subpixel_fit import RawTrack, SubpixelFit, refine_positions, template_products
from frictrack.tracking.template import MAX_SHIFT_PX, FixedPattern, TargetModel, Template, fit_pattern, pattern_sums
from frictrack.tracking.template_learning import (
    WIDE_RIM_PX,
    SmoothPath,
    learn_template,
    short_wave_evidence,
    smooth_path,
    without_border,
)

MAX_LEARNING_FRAMES = 500  # the noise of the template then costs a thousandth
MAX_CUTOUT_BYTES = 32_000_000  # held at once
MIN_FRAMES = 12  # fewer make a template with more noise than a single frame
MIN_USABLE_FRAMES = 3  # that a template can be learnt from
ROUNDS, MAX_ROUNDS = 3, 5  # without and with a fixed pattern
BACKGROUND_FRAMES = 15  # of which the background is the median
MAX_MISFIT_RATIO = 25.0  # to the typical misfit; such a frame shows something else
MIN_FOUND_SHARE = 0.95  # of the frames, in which a template with short waves must be found as well
MAX_OUTLIER_SHARE = 0.5  # of the frames, in which a pixel may differ from the template
N_STRETCHES = 8  # of the path; a template learnt from every second one is tested on the others
MAX_BORDER_SLOPE_ERROR = 0.2  # relative error of the slopes at the border
# Correlation of the two halves, in standard deviations. Short waves that improve positions by 5 % leave a tenth of the
# noise's variance in the residuals: 50 or more. Blocks of a codec, repeated along the path, reach 6.
MIN_SHORT_WAVE_EVIDENCE = 12.0
RESIDUAL_FRAMES = 64  # whose residuals are examined


@dataclass(frozen=True, eq=False)
class _Round:
    """Cut-outs (n, h, w) of some frames and their corners (n, 2), with template, fit and share of a round."""

    film: Recording
    background: Patch | None  # (H, W), median of the film
    frames: NDArray[np.int64]
    cuts: Patch
    corner: NDArray[np.int64]
    template: Template
    fit: SubpixelFit
    share: Patch | None = None  # (n, h, w), of the weight that pixels keep because they fit

    def __getitem__(self, rows: Mask | slice | NDArray[np.int64]) -> _Round:
        names = ("frames", "cuts", "corner", "fit") + (() if self.share is None else ("share",))
        return replace(self, **{name: getattr(self, name)[rows] for name in names})

    @property
    def usable(self) -> Mask:
        """Frames (n,) from which the template can be learnt."""
        typical_misfit = max(float(np.median(self.fit.misfit)), self.template.min_misfit)
        return self.fit.converged & (self.fit.misfit < MAX_MISFIT_RATIO * typical_misfit)

    @property
    def position(self) -> Array:
        """Corner of the target's rectangle (n, 2) px."""
        return self.corner + self.fit.position

    @property
    def scene(self) -> Patch | None:
        """Static background behind each cut-out (n, h, w); None where it is not known."""
        if self.background is None:
            return None
        h, w = self.cuts.shape[1:]
        return np.stack([self.background[y : y + h, x : x + w] for x, y in self.corner])

    def measured(self, template: Template, pattern: FixedPattern | None) -> _Round:
        """Measure the positions again with another template."""
        fit, share = measure_frames(self.cuts, self.corner, self.fit, TargetModel(template, pattern))
        return replace(self, template=template, fit=fit, share=share)

    def without(self, pattern: FixedPattern | None) -> Patch:
        """Cut-outs (n, h, w) without the fixed pattern."""
        if pattern is None:
            return self.cuts
        return pattern.corrected(self.cuts, self.corner, self.fit.gain, self.fit.offset)[0]


def learn_target_model(
    film: Recording, raw_track: RawTrack, template: Template, blocked: Mask | None = None
) -> TargetModel:
    """Learn the model of a target from frames spread over the path of a first, rough track.

    Parameters
    ----------
    film : Recording
        Film with random access.
    raw_track : RawTrack
        Rough track of the target.
    template : Template
        Template with which it was made.
    blocked : array of bool (H, W), optional
        Pixels of the picture that obstacles cover.

    Returns
    -------
    TargetModel
        With fewer than `MIN_FRAMES` frames, the first template without its border.

    """
    rows, pattern = _spread_frames(raw_track, template.weight.size), with_obstacles(None, blocked)
    if len(rows) < MIN_FRAMES:
        return TargetModel(without_border(template), pattern)
    size = template.weight.shape
    corner = nearest_corner(raw_track.position[rows], film.shape, size)
    fit = raw_track.fit[rows].moved(raw_track.corner[rows] - corner)
    found = _Round(film, _median_background(film), rows, film.cut(rows, corner, size), corner, template, fit)
    found = replace(found.measured(without_border(template), pattern), template=template)
    frames = np.flatnonzero(raw_track.found)
    path = smooth_path(frames, raw_track.position[frames], rows)
    for k in range(MAX_ROUNDS):
        if np.count_nonzero(found.usable) < MIN_USABLE_FRAMES:
            break
        found = _run_round(_recentre(found), path, pattern)
        if k == 1:
            found, path = _try_super_resolution(found, path)
        if pattern is None and k >= ROUNDS - 1:
            break
        if 0 < k < MAX_ROUNDS - 1:  # the first round straightens the places; before that all looks odd
            pattern = with_obstacles(_estimate_pattern(found), blocked)
    return _final_model(found, pattern) if found.usable.any() else TargetModel(without_border(template), pattern)


def _recentre(found: _Round) -> _Round:
    """Read cut-outs again where the target lies more than half a pixel off their corner."""
    fit, size = found.fit, found.cuts.shape[1:]
    near = fit.converged & np.all(np.abs(fit.position) < MAX_SHIFT_PX + 1, axis=1)
    corner = nearest_corner(found.corner + np.where(near[:, None], fit.position, 0.0), found.film.shape, size)
    moved = np.flatnonzero(np.any(corner != found.corner, axis=1))
    if len(moved) == 0:
        return found
    cuts, share = found.cuts.copy(), None if found.share is None else found.share.copy()
    cuts[moved] = found.film.cut(found.frames[moved], corner[moved], size)
    if share is not None:
        share[moved] = 1.0
    return replace(found, cuts=cuts, corner=corner, fit=fit.moved(found.corner - corner), share=share)


def _run_round(found: _Round, path: SmoothPath, pattern: FixedPattern | None) -> _Round:
    """Learn the template from the positions of the last round, and measure the positions again."""
    return found.measured(_learn(found, path, pattern), pattern)


def _learn(found: _Round, path: SmoothPath, pattern: FixedPattern | None) -> Template:
    """Learn the template that fits the frames best at the positions of the last round."""
    placed = path.with_path_positions(found.fit, found.corner, found.template)
    usable = found.usable & np.all(np.abs(placed.unrotated()) <= MAX_SHIFT_PX, axis=1)
    if np.count_nonzero(usable) < MIN_USABLE_FRAMES:
        return found.template
    used = found[usable]
    share = used.share
    if share is not None:  # what most frames do not show was something else in the first template, such as a hand
        open_share = np.ones_like(share) if pattern is None else pattern.pixel_shares(used.corner, share.shape[1:])
        wrong = np.mean((share < 0.5) & (open_share >= 0.5), axis=0) > MAX_OUTLIER_SHARE
        share = np.where(wrong, open_share, share)
    return learn_template(used.without(pattern), placed[usable], found.template, used.scene, share)


def _try_super_resolution(found: _Round, path: SmoothPath) -> tuple[_Round, SmoothPath]:
    """Add waves shorter than two pixels to the template, where these make the positions more precise."""
    if not path.axes.any():
        return found, path
    path = path.updated(found.position)
    with np.errstate(all="ignore"):  # a picture that runs away shows nothing, which is answered below
        if not (_shows_short_waves(found, path) and _cross_validates(found, path)):
            return found, path
        refined = _run_round(replace(found, template=path.widened(found.template)), path, None)
    better_path = path.updated(refined.position)
    refined = _run_round(refined, better_path, None)
    return (refined, better_path) if _mostly_found(refined.fit, found.fit) else (found, path)


def _shows_short_waves(found: _Round, path: SmoothPath) -> bool:
    """Whether two halves of the frames agree that the template lacks short waves: fitting these takes far longer."""
    wide = path.widened(found.template)
    placed = path.with_path_positions(found.fit, found.corner, wide)
    usable = np.flatnonzero(found.usable & np.all(np.abs(placed.unrotated()) <= MAX_SHIFT_PX, axis=1))
    half = _odd_stretches(len(found.cuts))[usable]
    evidence = short_wave_evidence(found.cuts[usable], placed[usable], found.template, wide, half)
    return evidence > MIN_SHORT_WAVE_EVIDENCE


def _odd_stretches(count: int) -> Mask:
    """Frames (count,) in every second stretch of the path."""
    return np.asarray((np.arange(count) * N_STRETCHES // count) % 2 == 1)


def _mostly_found(refitted: SubpixelFit, before: SubpixelFit) -> bool:
    """Whether nearly all frames are still found."""
    return bool(np.count_nonzero(refitted.converged) >= max(MIN_FOUND_SHARE * np.count_nonzero(before.converged), 1))


def _cross_validates(found: _Round, path: SmoothPath) -> bool:
    """Whether short waves learnt from every second stretch of the path improve the fit to the other stretches.

    Light that changes along the path, or a video codec, makes such waves too, but different ones in each stretch.
    """
    odd = _odd_stretches(len(found.cuts))
    half_path = replace(path, frames=path.frames[~odd], position=path.position[~odd])
    half = replace(found[~odd], template=path.widened(found.template))
    refined = replace(_learn(half, half_path, None), weight=found.template.weight)
    tested = np.flatnonzero(odd & found.usable & (found.fit.misfit <= np.median(found.fit.misfit[found.usable])))
    tested = tested[:: max(1, len(tested) // RESIDUAL_FRAMES)]
    band_limited, refitted = (
        refine_positions(template_products(found.cuts[tested], t), found.fit.position[tested], t)
        for t in (found.template, refined)
    )
    return _mostly_found(refitted, band_limited) and bool(np.median(refitted.misfit) < np.median(band_limited.misfit))


def _final_model(found: _Round, pattern: FixedPattern | None) -> TargetModel:
    """Assemble the model of the last round."""
    template = found.template if _border_slopes_known(found) else without_border(found.template, WIDE_RIM_PX)
    used = found[found.usable]
    systematic = systematic_covariance(used.without(pattern), used.fit, template, used.share)
    return TargetModel(template, pattern, float(np.median(found.fit.misfit)), systematic)


def _border_slopes_known(found: _Round) -> bool:
    """Whether the target has moved far enough, along one axis, for the slopes at its border to be learnt.

    Inside, a single frame shows the slopes. At the border only shifts determine them, to the standard deviation of the
    slope of a line through the frames, which must be a small part of the slopes of the picture.
    """
    at, sigma = found.position[found.usable], found.fit.sigma[found.usable, :2]
    moved = np.sum((at - at.mean(axis=0)) ** 2 - sigma**2, axis=0)
    weight = found.template.weight
    noise = 1 / float(np.median(weight[weight > 0])) if np.any(weight > 0) else np.inf
    slopes = [float(np.mean(np.gradient(found.template.image, axis=axis) ** 2)) for axis in (1, 0)]
    return bool(np.any(moved * slopes * MAX_BORDER_SLOPE_ERROR**2 > noise))


def _spread_frames(raw_track: RawTrack, size: int) -> NDArray[np.int64]:
    """Choose frames spread over the path travelled, so that a long rest does not dominate the template."""
    found = np.flatnonzero(raw_track.found)
    count = int(np.clip(MAX_CUTOUT_BYTES // (4 * size), 16, MAX_LEARNING_FRAMES))
    if len(found) <= count:
        return found
    step = np.hypot(*np.diff(raw_track.position[found], axis=0).T)
    step[step < 0.5] = 0.0
    path = np.concatenate([[0.0], np.cumsum(step)])
    index = np.linspace(0, 1, len(path))
    progress = index if path[-1] < 1 else 0.9 * path / path[-1] + 0.1 * index
    at = np.searchsorted(progress, np.linspace(0, 1, count))
    return found[np.unique(at.clip(0, len(found) - 1))]


def _estimate_pattern(found: _Round) -> FixedPattern | None:
    """Estimate the fixed pattern of the picture from the residuals of the frames."""
    used, template = found[found.usable], found.template
    cuts, fit = used.cuts, used.fit
    gain = fit.gain.astype(np.float32)[:, None]
    offset = (fit.offset - template.level).astype(np.float32)[:, None]
    model = (model_images(fit, template) - offset) / gain
    pixels = cuts.reshape(len(cuts), -1).astype(np.float32) - np.float32(template.level)
    difference = (pixels - offset) / gain - model
    typical_misfit = float(np.median(template.weight[template.weight > 0]))
    # Differences at the target's edge come from the scene behind it and not from an obstacle.
    inside = np.asarray(template.weight > 0.5 * typical_misfit, dtype=np.float64)
    sums = pattern_sums(used.film.shape, used.corner, model.reshape(cuts.shape), difference.reshape(cuts.shape), inside)
    return fit_pattern(sums, 1 / typical_misfit)


def _median_background(film: Recording) -> Array | None:
    """Median (H, W) of frames spread over the film; None for fewer than three frames."""
    index = np.unique(np.linspace(0, film.n_frames - 1, BACKGROUND_FRAMES).astype(int))
    frames = film.pick(index.tolist())
    return None if len(frames) < 3 else np.median(np.stack(frames), axis=0).astype(np.float32)
