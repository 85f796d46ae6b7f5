"""The rounds in which the film teaches its own template, noise and whatever stands still in the way."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from frictrack.recording import Recording
from frictrack.records import Array, Mask
from frictrack.tracking.areas import obstructed
from frictrack.tracking.follow import Followed
from frictrack.tracking.learn import WIDE_RIM, learn, without_border
from frictrack.tracking.match import Patch, nearest_corner
from frictrack.tracking.measure import Lesson, measure, modelled
from frictrack.tracking.refine import Fine, products, refine
from frictrack.tracking.sharp import SmoothPath, matters, smoothed
from frictrack.tracking.template import Template
from frictrack.tracking.trust import inflation, slow_error
from frictrack.tracking.view import Sums, View, view_of
from frictrack.tracking.waves import RANGE

FRAMES = 500  # from which the template is learnt, at most: its own noise then costs a thousandth
BYTES = 32_000_000  # of cut-outs held at once
MIN_FRAMES = 12  # fewer make a template whose own noise is larger than that of a single frame's
MIN_TAUGHT = 3  # frames that a template can be learnt from
ROUNDS, MOST_ROUNDS = 3, 5  # where nothing stands in the way, and where something does
BACKGROUND_FRAMES = 15
STRANGE = 25.0  # times the usual misfit: such a frame shows something else, and teaches nothing
STILL_FOUND = 0.95  # of the frames, in which a picture with short waves must be found as well
PARTS = 8  # stretches of the path; a picture learnt from every second one is tested on the others
BORDER_SLOPE = 0.2  # of the picture's slopes, that a border's may be off by
TRUST_FRAMES = 64  # whose residual pictures are looked at


@dataclass(frozen=True, eq=False)
class _Cuts:
    """What the rounds look at: cut-outs (n, h, w) of some frames, their corners (n, 2), and the still scene behind."""

    film: Recording
    rows: NDArray[np.int64]
    cuts: Patch
    corner: NDArray[np.int64]
    background: Patch | None  # (H, W), median of the film

    @classmethod
    def around(cls, film: Recording, rows: NDArray[np.int64], at: Array, size: tuple[int, int]) -> _Cuts:
        """Cut-outs of these frames whose corners lie nearest to `at` (n, 2) px."""
        corner = nearest_corner(at, film.shape, size)
        return cls(film, rows, film.cut(rows, corner, size), corner, _background(film))

    @property
    def scene(self) -> Patch | None:
        """The still background behind each cut-out (n, h, w); None where it is not known."""
        if self.background is None:
            return None
        h, w = self.cuts.shape[1:]
        return np.stack([self.background[y : y + h, x : x + w] for x, y in self.corner])


@dataclass(frozen=True, eq=False)
class _Found:
    """A template, where it was found in the cut-outs, and the share (n, h, w) of its pixels that fit."""

    template: Template
    fine: Fine
    share: Patch | None

    @property
    def good(self) -> Mask:
        """Frames that teach."""
        return _teaches(self.fine, self.template)


def taught(film: Recording, followed: Followed, template: Template, blocked: Mask | None = None) -> Lesson:
    """Template, view and noise from frames spread over the path of a first, rougher track.

    `blocked` (H, W) are pixels of the picture before which an obstacle is known to stand.
    """
    rows, view = spread(followed, template.weight.size), obstructed(None, blocked)
    if len(rows) < MIN_FRAMES:
        return Lesson(without_border(template), view)
    size = template.weight.shape
    seen = _Cuts.around(film, rows, followed.at[rows], size)
    fine = followed.fine[rows].moved(followed.corner[rows] - seen.corner)
    found = _Found(template, *measure(seen.cuts, seen.corner, fine, Lesson(without_border(template), view)))
    path = _path(followed, rows)
    for k in range(MOST_ROUNDS):
        if np.count_nonzero(found.good) < MIN_TAUGHT:
            break
        seen, found = _recentred(seen, found)
        found = _round(seen, found, path, view)
        if k == 1:
            found, path = _sharpened(seen, found, path)
        if view is None and k >= ROUNDS - 1:
            break
        if 0 < k < MOST_ROUNDS - 1:  # the first round straightens the places; before that all looks odd
            view = obstructed(_view(film, seen, found), blocked)
    return _concluded(seen, found, view)


def _recentred(seen: _Cuts, found: _Found) -> tuple[_Cuts, _Found]:
    """The same with cut-outs taken anew where the target has come to lie more than half a pixel off their corner."""
    fine, size = found.fine, seen.cuts.shape[1:]
    near = fine.settled & np.all(np.abs(fine.at) < RANGE + 1, axis=1)
    corner = nearest_corner(seen.corner + np.where(near[:, None], fine.at, 0.0), seen.film.shape, size)
    off = np.flatnonzero(np.any(corner != seen.corner, axis=1))
    if len(off) == 0:
        return seen, found
    cuts, share = seen.cuts.copy(), None if found.share is None else found.share.copy()
    cuts[off] = seen.film.cut(seen.rows[off], corner[off], size)
    if share is not None:
        share[off] = 1.0
    return replace(seen, cuts=cuts, corner=corner), replace(found, fine=fine.moved(seen.corner - corner), share=share)


def _round(seen: _Cuts, found: _Found, path: SmoothPath, view: View | None) -> _Found:
    """Learn the template where the last round found it, and find it again."""
    template = _learnt(seen, found, path, view)
    return _Found(template, *measure(seen.cuts, seen.corner, found.fine, Lesson(template, view)))


def _learnt(seen: _Cuts, found: _Found, path: SmoothPath, view: View | None) -> Template:
    """The template that fits the frames best where the last round found it."""
    placed = path.placed(found.fine, seen.corner, found.template)
    good = found.good & np.all(np.abs(placed.turned_back()) <= RANGE, axis=1)
    if np.count_nonzero(good) < MIN_TAUGHT:
        return found.template
    places = placed[good]
    part = (None if v is None else v[good] for v in (seen.scene, found.share))
    shown = _seen(seen.cuts[good], seen.corner[good], found.fine[good], view)
    return learn(shown, places, found.template, *part)


def _sharpened(seen: _Cuts, found: _Found, path: SmoothPath) -> tuple[_Found, SmoothPath]:
    """The same with waves shorter than two pixels, where these make the places surer."""
    if not path.axes.any():
        return found, path
    path = path.again(seen.corner + found.fine.at)
    with np.errstate(all="ignore"):  # a picture that runs away shows nothing, which is answered below
        if not _fits_other_stretches(seen, found, path):
            return found, path
        sharper = _round(seen, replace(found, template=path.widened(found.template)), path, None)
    better = path.again(seen.corner + sharper.fine.at)
    sharper = _round(seen, sharper, better, None)
    kept = _still_found(sharper.fine, found.fine) and matters(sharper.fine, found.fine, path.axes)
    return (sharper, better) if kept else (found, path)


def _still_found(again: Fine, before: Fine) -> bool:
    return bool(np.count_nonzero(again.settled) >= max(STILL_FOUND * np.count_nonzero(before.settled), 1))


def _fits_other_stretches(seen: _Cuts, found: _Found, path: SmoothPath) -> bool:
    """Whether short waves learnt from every second stretch of the path improve the fit to the other stretches.

    Light that changes along the path, or a codec, makes such waves too, but other ones in each stretch: with them the
    target is not found in the next stretch, or fits worse.
    """
    odd = (np.arange(len(seen.cuts)) * PARTS // len(seen.cuts)) % 2 == 1
    part = replace(seen, cuts=seen.cuts[~odd], corner=seen.corner[~odd], rows=seen.rows[~odd])
    half = replace(path, frames=path.frames[~odd], at=path.at[~odd])
    share = None if found.share is None else found.share[~odd]
    taught_by = _Found(path.widened(found.template), found.fine[~odd], share)
    sharper = replace(_learnt(part, taught_by, half, None), weight=found.template.weight)
    rest = np.flatnonzero(odd & found.good & (found.fine.misfit <= np.median(found.fine.misfit[found.good])))
    rest = rest[:: max(1, len(rest) // TRUST_FRAMES)]
    plain, again = (refine(products(seen.cuts[rest], t), found.fine.at[rest], t) for t in (found.template, sharper))
    return _still_found(again, plain) and bool(np.median(again.misfit) < np.median(plain.misfit))


def _concluded(seen: _Cuts, found: _Found, view: View | None) -> Lesson:
    """What the rounds have come to, and by how much the noise's deviations are too small."""
    fine, template, share = found.fine, found.template, found.share
    if not _border_is_known(seen, found):
        template = without_border(template, WIDE_RIM)
    lesson = Lesson(template, view, float(np.median(fine.misfit)))
    taught_by = np.flatnonzero(found.good)
    shown = _seen(seen.cuts[taught_by], seen.corner[taught_by], fine[taught_by], view)
    kept = None if share is None else share[taught_by]
    few = slice(None, None, max(1, len(taught_by) // TRUST_FRAMES))
    factor = inflation(shown[few], fine[taught_by[few]], template, None if kept is None else kept[few])
    return replace(lesson, inflation=factor, slow=slow_error(shown, fine[taught_by], template, kept))


def _border_is_known(seen: _Cuts, found: _Found) -> bool:
    """Whether the target has moved enough, along one axis, for its border's slopes to be learnt.

    Inside, a single frame shows the slopes; at the border only shifts teach them, with the deviation of a line's
    slope through the frames. That must be a small part of the picture's own slopes.
    """
    fine = found.fine[found.good]
    at = seen.corner[found.good] + fine.at
    moved = np.sum((at - at.mean(axis=0)) ** 2 - fine.sigma[:, :2] ** 2, axis=0)
    weight = found.template.weight
    noise = 1 / float(np.median(weight[weight > 0])) if np.any(weight > 0) else np.inf
    slopes = [float(np.mean(np.gradient(found.template.image, axis=axis) ** 2)) for axis in (1, 0)]
    return bool(np.any(moved * slopes * BORDER_SLOPE**2 > noise))


def _path(followed: Followed, rows: NDArray[np.int64]) -> SmoothPath:
    """The first track in these frames, smooth."""
    frames = np.flatnonzero(followed.found)
    return smoothed(frames, followed.at[frames], rows)


def _teaches(fine: Fine, template: Template) -> Mask:
    """Frames that show the target and not something else."""
    usual = max(float(np.median(fine.misfit)), template.least_misfit)
    return fine.settled & (fine.misfit < STRANGE * usual)


def spread(followed: Followed, size: int) -> NDArray[np.int64]:
    """Frames spread over the path travelled (a long rest must not decide what the target looks like)."""
    found = np.flatnonzero(followed.found)
    count = int(np.clip(BYTES // (4 * size), 16, FRAMES))
    if len(found) <= count:
        return found
    step = np.hypot(*np.diff(followed.at[found], axis=0).T)
    step[step < 0.5] = 0.0
    path = np.concatenate([[0.0], np.cumsum(step)])
    index = np.linspace(0, 1, len(path))
    along = index if path[-1] < 1 else 0.9 * path / path[-1] + 0.1 * index
    at = np.searchsorted(along, np.linspace(0, 1, count))
    return found[np.unique(at.clip(0, len(found) - 1))]


def _seen(cuts: Patch, corner: NDArray[np.int64], fine: Fine, view: View | None) -> Patch:
    """Cut-outs without what stands still."""
    return cuts if view is None else view.cleaned(cuts, corner, fine.gain, fine.offset)[0]


def _view(film: Recording, seen: _Cuts, found: _Found) -> View | None:
    """What stands still in the picture, from the frames' residuals."""
    sums, good, template = Sums(film.shape), found.good, found.template
    cuts, corner, fine = seen.cuts[good], seen.corner[good], found.fine[good]
    gain = fine.gain.astype(np.float32)[:, None]
    offset = (fine.offset - template.level).astype(np.float32)[:, None]
    model = (modelled(fine, template) - offset) / gain
    pixels = cuts.reshape(len(cuts), -1).astype(np.float32) - np.float32(template.level)
    differs = (pixels - offset) / gain - model
    usual = float(np.median(template.weight[template.weight > 0]))
    # What shows behind the target's edge is the scene, not something before the target.
    counts = np.asarray(template.weight > 0.5 * usual, dtype=np.float64)
    sums.add(corner, model.reshape(cuts.shape), differs.reshape(cuts.shape), counts)
    return view_of(sums, 1 / usual)


def _background(film: Recording) -> Array | None:
    """The still background (H, W), the median of frames spread over the film; None of too few frames."""
    index = np.unique(np.linspace(0, film.n_frames - 1, BACKGROUND_FRAMES).astype(int))
    frames = film.pick(index.tolist())
    return None if len(frames) < 3 else np.median(np.stack(frames), axis=0).astype(np.float32)
