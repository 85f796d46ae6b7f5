"""Run the steps of tracking: find the target, follow it roughly, learn its template, measure every frame.

A target learnt from one film may be the same in another: same body, scale, light and sharpness. The film is followed
with its template, and the mean residual of many frames is compared with their noise: what is different in the other
film stays in the mean, while noise averages out. Else the averaged pictures of the two targets show by how much their
rectangles differ, so that positions along the course refer to the same point of the same body.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from frictrack.base.errors import FrictrackError
from frictrack.recording import FrameRange, Recording, random_access
from frictrack.records import Array, Mask, Track
from frictrack.tracking.areas import Areas, with_obstacles
from frictrack.tracking.batch_tracker import MIN_SCORE, SILENT_WORK, BatchTracker, Progress, Work, follow_film
from frictrack.tracking.correlation import Patch, Rectangle, best_match, nearest_corner
from frictrack.tracking.detection import Target, resolve_areas, resolve_target, target_fault
from frictrack.tracking.followed_target import Followed, measure_track
from frictrack.tracking.learning_rounds import learn_target_model
from frictrack.tracking.measure import residual_images, systematic_covariance
from frictrack.tracking.pose import RotatableTemplate
from frictrack.tracking.pose_tracker import (
    PoseTrack,
    has_marks,
    is_disc,
    min_frames_if_rotating,
    outline_template,
    track_disc,
    track_rotating,
)
from frictrack.tracking.subpixel_fit import RawTrack, refine_positions, template_products
from frictrack.tracking.template import TargetModel, Template
from frictrack.tracking.template_learning import template_from_frame, without_border

if TYPE_CHECKING:
    from frictrack.base.workers import WorkerPool


MIN_CONTRAST = 3  # grey values
MIN_OUTLINE_SHARE = 0.95  # of the frames, in which a disc is found by its outline, or its marks are followed
MAX_STRAIGHT_ANGLE = 0.05  # rad, of a track up to which its target does not rotate
MIN_SHARED_SCORE = 0.9  # of the known target's picture in the other film
SEARCH_SHARE = 0.5  # of the target's sides, around the place where a moving body was found
MIN_FRAMES = 24  # whose mean residual is compared
MAX_FRAMES = 96  # more show no smaller difference
# Largest mean square of a mean residual over that of the noise. Positions absorb what is a shift; the rest, unrelated
# to the slopes, moves them by the root of it: 0.14 standard deviations of a frame, about as much as the systematic
# error that every position is given. The noise of a template learnt from n frames alone makes 1/n of it.
MAX_DIFFERENCE = 0.02
MAX_OFFSET_SHARE = 0.25  # of the target's sides
MIN_SAME_BODY_SCORE = 0.8  # correlation of two pictures of the same body
MIN_CORRECTION_PX = 0.02  # a smaller offset is not corrected
MIN_CORE_PX = 12  # shortest side of the compared part


def track(  # noqa: PLR0913 - one door with named settings, all but one of them optional
    recording: Recording,
    target: Target | Areas = None,
    *,
    template: int = 0,
    known: TargetModel | None = None,
    name: str = "target",
    progress: Progress | None = None,
    pool: WorkerPool | None = None,
) -> Track:
    """Track the target in every frame: position in pixels, standard deviation and match score.

    Parameters
    ----------
    recording : Recording
        Film, as `open_recording` returns it.
    target : list, array, path or Areas, optional
        Rectangle [x, y, w, h], outline [[x, y], [x, y], [x, y], ...] or click [x, y], px in frame `template`; or a
        picture of the target (a path or a 2-D array). `Areas` adds parts to exclude and obstacles. By default the
        moving body is found automatically.
    template : int
        Number of the frame in which `target` is given.
    known : TargetModel, optional
        Model of the same target learnt from another film (`learn_target`). The film is then read only once.
    name : str
        Name of the track.
    progress : callable, optional
        Called as ``progress(done, total, step)``.
    pool : WorkerPool, optional
        Processes of this machine (`base.workers.local_workers`) or of a Dask cluster (`cluster_workers`) that take over
        segments of a long uncompressed film (`Recording.direct`) that all of them can read; the positions are the same.

    Returns
    -------
    Track
        One row per frame. The position is that of the centre of the target's rectangle, px; the angle, rad, is positive
        from the x axis of the picture toward its y axis. A frame in which the target is not found has NaN and a reason.

    Raises
    ------
    FrictrackError
        For a target outside the picture, a film without contrast, or a target found in fewer than two frames.

    Examples
    --------
    >>> import frictrack as ft
    >>> track = ft.track(ft.open_recording(ft.samples.films_folder() / "fast.avi"))
    >>> len(track.t), float(track.x_px[0].round(1))
    (150, 59.0)

    """
    work = Work(progress, pool if recording.direct else None)
    return track_and_learn(recording, _areas(target), template, known=known, name=name, work=work)[0]


def track_and_learn(
    recording: Recording,
    drawn: Areas,
    template: int,
    *,
    known: TargetModel | None = None,
    name: str = "target",
    work: Work = SILENT_WORK,
) -> tuple[Track, TargetModel]:
    """Track the target as `track` does, and return its model with the track."""
    with random_access(recording) as film:
        followed = _follow(film, drawn, template, known, work)
        track = measure_track(recording, film, followed, name, work)
        if drawn.target is None and (fault := target_fault(film, track)):
            raise FrictrackError(f"{recording.path.name}: {fault}")
        return track, followed.target_model


def _rectangle_at(corner: Array, known: TargetModel) -> Rectangle:
    """Rectangle of a known target whose upper left corner is at (2,) px."""
    h, w = known.template.weight.shape
    return round(float(corner[0])), round(float(corner[1])), w, h


def _areas(target: Target | Areas) -> Areas:
    return target if isinstance(target, Areas) else Areas(target)


def track_same_target(
    recording: Recording,
    target: Areas,
    known: TargetModel,
    template: int = 0,
    work: Work = SILENT_WORK,
) -> tuple[Track, TargetModel] | None:
    """Track a target with the model learnt from another film, if it looks the same here.

    Parameters
    ----------
    recording : Recording
        Film.
    target, template
        As in `track`.
    known : TargetModel
        Model of the target, learnt from another film.
    work : Work
        Where work is done, and who hears of its progress.

    Returns
    -------
    track : Track
        Positions of the same point of the body as in the other film.
    target_model : TargetModel
        The known model. None instead of both where the target looks different.

    """
    if known.rotates or known.pattern is not None:
        return None  # a fixed pattern is that of one film
    with random_access(recording) as film:
        rectangle, template = resolve_target(film, target.target, template)
        corner, score = match_near(film, rectangle, template, known.template)
        if score < MIN_SHARED_SCORE:
            return None
        placed = _rectangle_at(corner, known)
        raw_track = follow_film(BatchTracker(film, known.template), np.array(placed[:2]), template, work)
        if not looks_the_same(film, raw_track, known):
            return None
        followed = Followed(Areas(), placed, template, raw_track, known, remeasure=False)
        return measure_track(recording, film, followed, "target", work), known


def _follow(film: Recording, drawn: Areas, template: int, known: TargetModel | None, work: Work) -> Followed:
    """Follow a target with a known model, or learn its model first."""
    if known is None:
        return _learn_and_track(film, drawn, template, work)
    h, w = known.template.weight.shape
    target = known.template.image if drawn.target is None else drawn.target
    rectangle, template = resolve_target(film, target, template)
    if rectangle[2:] != (w, h):
        raise FrictrackError(f"expected a target of the known {w}x{h} px but got {rectangle[2]}x{rectangle[3]} px")
    drawn.check(film.shape)
    blocked = drawn.obstacle_mask(film.shape)
    target_model = replace(known, pattern=with_obstacles(known.pattern, blocked))
    raw_track = _follow_known(film, target_model, blocked, np.array(rectangle[:2]), template, work)
    return Followed(drawn, rectangle, template, raw_track, target_model, target_model.pattern is not None)


def learn_target(
    recording: Recording,
    target: Target | Areas = None,
    *,
    template: int = 0,
    progress: Progress | None = None,
    pool: WorkerPool | None = None,
) -> TargetModel:
    """Learn the model of a target from a film: template, pixel noise and fixed pattern.

    Parameters
    ----------
    recording : Recording
        Film of the target.
    target, template, progress, pool
        As in `track`.

    Returns
    -------
    TargetModel
        Pass it to `track` as `known` for further films of the same target.

    Raises
    ------
    FrictrackError
        As `track` does.

    Examples
    --------
    >>> import frictrack as ft
    >>> film = ft.open_recording(ft.samples.films_folder() / "fast.avi")
    >>> target = ft.learn_target(film)
    >>> track = ft.track(film, known=target)
    >>> len(track.t)
    150

    """
    with random_access(recording) as film:
        return _learn_and_track(film, _areas(target), template, Work(progress, pool)).target_model


def relearn_target(recording: Recording, track: Track) -> TargetModel:
    """Learn the model of a target again from the film of its track, as `track` did.

    Parameters
    ----------
    recording : Recording
        Film of the track.
    track : Track
        Track of the target, before repairs.

    Returns
    -------
    TargetModel
        Model for `track_frames`.

    """
    drawn = Areas(track.outline or track.target, track.exclude, track.obstacles)
    may_rotate = bool(np.nanmax(np.abs(track.angle)) > MAX_STRAIGHT_ANGLE)
    with random_access(recording) as film:
        return _learn_and_track(film, drawn, track.template, SILENT_WORK, may_rotate=may_rotate).target_model


def _learn_and_track(film: Recording, drawn: Areas, template: int, work: Work, *, may_rotate: bool = True) -> Followed:
    """Find the target, follow it roughly and learn its model."""
    work.report(0, film.n_frames, "find the target")
    drawn.check(film.shape)
    drawn, rectangle, template = resolve_areas(film, drawn, template)
    x, y, w, h = rectangle
    blocked, mask = drawn.obstacle_mask(film.shape), drawn.target_mask(rectangle)
    cut = film.frame(template)[y : y + h, x : x + w]
    if np.ptp(cut) < MIN_CONTRAST:
        raise FrictrackError(
            f"{film.path.name}: the target {list(rectangle)} has no contrast in frame {template}; "
            "choose a rectangle that shows texture or an outline"
        )
    first_template = template_from_frame(cut, mask)
    rotatable, start = RotatableTemplate(first_template, blocked), np.array([x, y])
    is_round = mask is not None and is_disc(mask)
    pose_track = None
    if is_round and has_marks(cut):
        assert mask is not None
        raw_track, pose_track = _follow_disc(film, (cut, mask), rotatable, (start, template), work, learn=True)
    else:
        obstacles = with_obstacles(None, blocked)
        raw_track = follow_film(BatchTracker(film, first_template, obstacles), start, template, work)
        if may_rotate and not is_round:
            min_frames = min_frames_if_rotating(film, raw_track, rotatable, start, template)
            if min_frames is not None:
                pose_track = track_rotating(film, rotatable, start, template, min_frames, work.progress)
    if pose_track is not None and (not is_round or pose_track.explains_more(raw_track)):
        model = TargetModel(pose_track.template, rotates=True)
        return Followed(drawn, rectangle, template, pose_track.to_raw_track(), model)
    model = replace(learn_target_model(film, raw_track, first_template, blocked), rotation_seen=not is_round)
    return Followed(drawn, rectangle, template, raw_track, model)


def _follow_known(
    film: Recording, known: TargetModel, blocked: Mask | None, start: Array, template: int, work: Work
) -> RawTrack:
    """Follow a target with a known model from its corner `start` (2,) px in frame `template`."""
    mask, rotatable = known.template.mask, RotatableTemplate(known.template, blocked)
    if known.rotates and mask is not None and is_disc(mask):
        disc = known.template.image, mask
        return _follow_disc(film, disc, rotatable, (start, template), work, learn=False)[1].to_raw_track()
    if known.rotates:
        found = track_rotating(film, rotatable, start, template, progress=work.progress)
        assert found is not None
        return found.to_raw_track()
    return follow_film(BatchTracker(film, known.template, with_obstacles(None, blocked)), start, template, work)


def _follow_disc(
    film: Recording,
    disc: tuple[Patch, Mask],
    rotatable: RotatableTemplate,
    where: tuple[Array, int],
    work: Work,
    *,
    learn: bool,
) -> tuple[RawTrack, PoseTrack]:
    """Follow a disc, given by its picture and mask, from a corner (2,) px in a frame by its outline, then by its marks.

    Where the outline is too faint and is lost, the marks lead from frame to frame.
    """
    outline = outline_template(*disc)
    shown, (start, template) = outline.weight > 0, where
    score = float(np.corrcoef(outline.image[shown], disc[0][shown])[0, 1])
    tracker = BatchTracker(film, outline, with_obstacles(None, rotatable.blocked), score)
    raw_track = follow_film(tracker, start, template, work)
    track = track_disc(film, rotatable, raw_track, template, learn=learn)
    if track.count < MIN_OUTLINE_SHARE * film.n_frames:
        least = track.count + 1.0 if learn else None
        more = track_rotating(film, rotatable, start, template, least, work.progress)
        track = max(more or track, track, key=lambda found: found.count)
    return raw_track, track


def track_frames(
    film: Recording,
    frames: range,
    box: tuple[float, float, float, float],
    frame: int,
    known: TargetModel,
    obstacles: Areas | None = None,
) -> Track:
    """Track a known target through some frames, both ways from the frame in which its place was drawn.

    Parameters
    ----------
    film : Recording
        Film with random access.
    frames : range
        Numbers of neighbouring frames.
    box : tuple of float
        Rectangle (x, y, w, h) px that tells where the target is; its own size and place do not change the result.
    frame : int
        Number of the frame in which it was drawn.
    known : TargetModel
        Model of the target, as `learn_target` returns it.
    obstacles : Areas, optional
        Obstacles before the target.

    Returns
    -------
    Track
        One row for each of `frames`.

    Raises
    ------
    FrictrackError
        Where the target is not recognised near `box`, or found in fewer than two frames.

    """
    part, at = FrameRange(film, frames.start, frames.stop), frame - frames.start
    drawn = obstacles or Areas()
    if known.rotates:  # its angle in this frame is unknown: the tracker searches it
        start, score = np.array(box[:2]) + (np.array(box[2:]) + 1 - known.template.weight.shape[::-1]) / 2, 1.0
    else:
        start, score = match_near(part, box, at, known.template)
    if score < MIN_SCORE:
        raise FrictrackError(
            f"expected the target near its drawn place in frame {frame} but it is not recognised "
            "there; draw it in a frame that shows it well"
        )
    raw_track = _follow_known(part, known, drawn.obstacle_mask(film.shape), start, at, SILENT_WORK)
    followed = Followed(Areas(), _rectangle_at(start, known), at, raw_track, known)
    return measure_track(part, part, followed, "target", SILENT_WORK)


def match_near(
    film: Recording, near: tuple[float, float, float, float], frame: int, template: Template
) -> tuple[Array, float]:
    """Corner (2,) px and score of the best match of a template about a rectangle, which may be as large or larger."""
    size, drawn = np.array(template.weight.shape[::-1]), np.array(near)
    if np.any(np.array(film.shape[::-1]) < size):
        return np.zeros(2), -1.0
    spare = (drawn[2:] - size) / 2
    reach = np.ceil(np.maximum(SEARCH_SHARE * size, spare))
    return BatchTracker(film, template).match_near(film.frame(frame), drawn[:2] + spare, reach)


def looks_the_same(film: Recording, raw_track: RawTrack, known: TargetModel) -> bool:
    """Whether a target that was followed with a model from another film looks the same in most frames of this one."""
    found = np.flatnonzero(raw_track.found & raw_track.fit.converged)
    if len(found) < MIN_FRAMES:
        return False
    rows = np.unique(found[np.linspace(0, len(found) - 1, MAX_FRAMES).astype(int)])
    size = known.template.weight.shape
    corner = nearest_corner(raw_track.position[rows], film.shape, size)
    fit = raw_track.fit[rows].moved(raw_track.corner[rows] - corner)
    cuts = film.cut(rows, corner, size)
    difference = _mean_difference(residual_images(cuts, fit, known.template), known.template.weight)
    # where the appearance changes along the path, a template of its own follows it better
    return difference <= MAX_DIFFERENCE and not np.any(systematic_covariance(cuts, fit, known.template))


def _mean_difference(residuals: Array, weight: Array) -> float:
    """Mean square of the mean residual (n, h, w) that noise does not explain, over the noise's mean square."""
    used = residuals[:, weight > 0].astype(np.float64)
    noise = float(np.mean(np.var(used, axis=0, ddof=1)))
    return float(np.mean(np.mean(used, axis=0) ** 2)) / max(noise, 1e-300) - 1 / len(used)


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
    (dx, dy), sigma = found
    if np.hypot(dx, dy) < max(MIN_CORRECTION_PX, 2 * np.hypot(*sigma)):
        return track
    note = f"tracked point moved by ({dx:+.3f} +/- {sigma[0]:.3f}, {dy:+.3f} +/- {sigma[1]:.3f}) px to that of {name}"
    return replace(track, x_px=track.x_px + dx, y_px=track.y_px + dy, notes=(*track.notes, note))


def target_offset(picture: Array | None, reference: Array | None) -> tuple[Array, Array] | None:
    """Measure the offset between two pictures of the same body.

    The middle of one picture is located in the other by cross-correlation, then refined as a target in a frame is.

    Parameters
    ----------
    picture, reference : array (h, w) or None
        Averaged pictures of the targets, DN.

    Returns
    -------
    offset, sigma : array (2,)
        From the centre of the first picture to that of the reference, with standard deviations, px. None instead of
        both where they do not show the same body or are too small.

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
    offset = (np.array(reference_image.shape[::-1]) - core.shape[::-1]) / 2 - (x, y) - fit.position[0]
    return offset, fit.sigma[0, :2]
