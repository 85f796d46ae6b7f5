"""The rounds in which the film teaches its own template, noise and whatever stands still in the way."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from frictrack.recording import Recording
from frictrack.records import Array
from frictrack.tracking.follow import Followed
from frictrack.tracking.learn import learn
from frictrack.tracking.match import Patch
from frictrack.tracking.measure import Lesson, measure, modelled
from frictrack.tracking.refine import Fine
from frictrack.tracking.template import Template
from frictrack.tracking.trust import inflation
from frictrack.tracking.view import Sums, View, view_of

FRAMES = 500  # from which the template is learnt, at most: its own noise then costs a thousandth
BYTES = 32_000_000  # of cut-outs held at once
ROUNDS = 3
BACKGROUND_FRAMES = 15
TRUST_FRAMES = 64  # whose residual pictures are looked at


def taught(film: Recording, followed: Followed, template: Template) -> Lesson:
    """Template, view and noise from frames spread over the path of a first, rougher track."""
    rows = spread(followed, template.weight.size)
    if len(rows) < 3:
        return Lesson(template)
    size = template.weight.shape
    corner = np.rint(followed.at[rows]).astype(np.int64).clip(0, np.array(film.shape[::-1]) - size[::-1])
    cuts = film.cut(rows, corner, size)
    fine = followed.fine[rows].moved(followed.corner[rows] - corner)
    scene = _scene(film, corner, size)
    view = None
    for k in range(ROUNDS):
        template = learn(_seen(cuts, corner, fine, template, view), fine, template, scene)
        fine = measure(cuts, corner, fine, Lesson(template, view))
        good = fine.settled
        if np.count_nonzero(good) < 3:
            break
        rows, corner, cuts, fine = rows[good], corner[good], cuts[good], fine[good]
        scene = None if scene is None else scene[good]
        if k + 1 < ROUNDS:
            view = _view(film, cuts, corner, fine, template)
    few = slice(None, None, max(1, len(fine.score) // TRUST_FRAMES))
    wider = inflation(_seen(cuts[few], corner[few], fine[few], template, view), fine[few], template)
    return Lesson(template, view, float(np.median(fine.misfit)), wider)


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


def _seen(cuts: Patch, corner: NDArray[np.int64], fine: Fine, template: Template, view: View | None) -> Patch:
    """Cut-outs without what stands still; pixels that do not see the target show what is expected of them."""
    if view is None:
        return cuts
    clean, share = view.cleaned(cuts, corner, fine.gain, fine.offset)
    expected = modelled(fine, template).reshape(clean.shape) + np.float32(template.level)
    return np.where(share >= 1, clean, share * clean + (1 - share) * expected)


def _view(film: Recording, cuts: Patch, corner: NDArray[np.int64], fine: Fine, template: Template) -> View | None:
    """What stands still in the picture, from the frames' residuals."""
    sums = Sums(film.shape)
    gain = fine.gain.astype(np.float32)[:, None]
    offset = (fine.offset - template.level).astype(np.float32)[:, None]
    model = (modelled(fine, template) - offset) / gain
    pixels = cuts.reshape(len(cuts), -1).astype(np.float32) - np.float32(template.level)
    differs = (pixels - offset) / gain - model
    counted = template.weight.ravel() > 0
    sums.add(corner, model.reshape(cuts.shape), (differs * counted).reshape(cuts.shape))
    return view_of(sums, 1 / float(np.median(template.weight[template.weight > 0])))


def _scene(film: Recording, corner: NDArray[np.int64], size: tuple[int, ...]) -> Array | None:
    """The still background behind each cut-out, the median of frames spread over the film."""
    index = np.unique(np.linspace(0, film.n_frames - 1, BACKGROUND_FRAMES).astype(int))
    frames = film.pick(index.tolist())
    if len(frames) < 3:
        return None
    background = np.median(np.stack(frames), axis=0).astype(np.float32)
    h, w = size
    return np.stack([background[y : y + h, x : x + w] for x, y in corner])
