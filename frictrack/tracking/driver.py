"""Run the steps of tracking: find the target, follow it roughly, learn its template, measure every frame."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from frictrack.errors import FrictrackError
from frictrack.recording import Recording, random_access
from frictrack.records import Array, Mask, Track
from frictrack.tracking.areas import Areas, with_obstacles
from frictrack.tracking.batch_tracker import BatchTracker
from frictrack.tracking.checks import at_rest, key_frame_notes
from frictrack.tracking.correlation import Rectangle
from frictrack.tracking.detection import Target, resolve_target
from frictrack.tracking.learning_rounds import learn_target_model
from frictrack.tracking.measured_rows import measure_all
from frictrack.tracking.pose import RotatableTemplate
from frictrack.tracking.pose_tracker import track_known_rotating, track_rotating
from frictrack.tracking.raw_track import UNREAD, RawTrack
from frictrack.tracking.rotation_test import min_frames_if_rotating
from frictrack.tracking.segments import SEGMENT_FRAMES, Work, follow_film
from frictrack.tracking.shared_target import adapt_known_target, place_known_target
from frictrack.tracking.super_resolution import peak_locking_correction
from frictrack.tracking.target_model import TargetModel
from frictrack.tracking.template_learning import template_from_frame

if TYPE_CHECKING:
    from frictrack.workers import WorkerPool

Progress = Callable[[int, int, str], None]

MIN_CONTRAST = 3  # grey values
# Slow position errors, rms, as a share of a frame's standard deviation and in px: the noise of the template, and blur
# that changes with the speed. Measured on films of known truth, with sharp and blurred targets and 0.001 to 0.005 px
# of noise.
SYSTEMATIC_SHARE, MIN_SYSTEMATIC_PX = 0.12, 2e-4
MIN_REPORTED_PEAK_LOCKING_PX = 0.01  # amplitude


def track(
    recording: Recording,
    target: Target | Areas = None,
    *,
    template: int = 0,
    known: TargetModel | None = None,
    name: str = "target",
    progress: Progress | None = None,
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
    drawn = target if isinstance(target, Areas) else Areas(target)
    with random_access(recording, once=_single_pass(recording, drawn.target, template, known)) as film:
        if known is None:
            followed = _learn_and_track(film, drawn, template, Work(progress))
        else:
            followed = _follow_known(film, drawn, template, known, Work(progress))
        return _measure_track(recording, film, drawn, followed, name, Work(progress))


def track_in_parallel(
    recording: Recording,
    target: Target | Areas = None,
    *,
    pool: WorkerPool | None,
    template: int = 0,
    known: TargetModel | None = None,
    progress: Progress | None = None,
) -> Track:
    """Track the target of one long film in several processes; the positions are those of `track`, bit for bit.

    Parameters
    ----------
    recording : Recording
        Uncompressed film (`Recording.direct`) that all processes can read. A compressed film is decoded from its first
        frame on and is tracked in this process.
    target, template, known, progress
        As in `track`.
    pool : WorkerPool or None
        Processes of this machine (`frictrack.workers.local_workers`) or of a Dask cluster (`cluster_workers`); None for
        this process alone.

    Returns
    -------
    Track
        As by `track`.

    Raises
    ------
    FrictrackError
        As `track` does.

    Examples
    --------
    >>> from frictrack.workers import local_workers
    >>> with local_workers(2) as pool:  # doctest: +SKIP
    ...     track = track_in_parallel(open_recording("long.mraw"), pool=pool)

    """
    drawn = target if isinstance(target, Areas) else Areas(target)
    work = Work(progress, pool if recording.direct else None)
    with random_access(recording) as film:
        if known is None:
            followed = _learn_and_track(film, drawn, template, work)
        else:
            followed = _follow_known(film, drawn, template, known, work)
        return _measure_track(recording, film, drawn, followed, "target", work)


def track_same_target(
    recording: Recording,
    target: Areas,
    known: TargetModel,
    *,
    template: int = 0,
    progress: Progress | None = None,
    pool: WorkerPool | None = None,
) -> tuple[Track, TargetModel] | None:
    """Track a target with the model learnt from another film, if it looks the same here.

    Parameters
    ----------
    recording : Recording
        Film.
    target, template, progress, pool
        As in `track_in_parallel`.
    known : TargetModel
        Model of the target, learnt from another film.

    Returns
    -------
    track : Track
        Positions of the same point of the body as in the other film.
    target_model : TargetModel
        The model with the position errors of this film. None instead of both where the target looks different.

    """
    if known.rotates or known.pattern is not None:
        return None  # a fixed pattern is that of one film
    with random_access(recording) as film:
        rectangle, template = resolve_target(film, target.target, template)
        placed = place_known_target(film, rectangle, template, known)
        if placed is None:
            return None
        work = Work(progress, pool)
        raw_track = follow_film(BatchTracker(film, known.template), np.array(placed[:2]), template, work)
        adapted = adapt_known_target(film, raw_track, known)
        if adapted is None:
            return None
        followed = _Followed(placed, template, raw_track, adapted, np.arange(0))
        return _measure_track(recording, film, Areas(), followed, "target", work), adapted


@dataclass(frozen=True)
class _Followed:
    """A target that was followed: rectangle in frame `template`, track, model, and frames to be measured again."""

    rectangle: Rectangle
    template: int
    raw_track: RawTrack
    target_model: TargetModel
    rows: NDArray[np.int64]


def _follow_known(film: Recording, drawn: Areas, template: int, known: TargetModel, work: Work) -> _Followed:
    """Follow a target with a known model."""
    rectangle, template = _locate_known(film, drawn.target, template, known)
    drawn.check(film.shape)
    blocked = drawn.obstacle_mask(film.shape)
    target_model = replace(known, pattern=with_obstacles(known.pattern, blocked))
    raw_track = _track_known(film, target_model, blocked, np.array(rectangle[:2]), template, work)
    rows = np.flatnonzero(raw_track.found & (target_model.pattern is not None) & ~target_model.rotates)
    return _Followed(rectangle, template, raw_track, target_model, rows)


def _measure_track(
    recording: Recording, film: Recording, drawn: Areas, followed: _Followed, name: str, work: Work
) -> Track:
    """Measure the frames of a target that was followed, and state the errors of its positions."""
    target_model, template, rectangle = followed.target_model, followed.template, followed.rectangle
    raw_track = followed.raw_track
    measured = raw_track if target_model.rotates else measure_all(film, raw_track, followed.rows, target_model, work)
    change = _frame_changes(film) if recording.interframe else None
    result = _to_track(recording, measured, rectangle, name)
    result = _with_systematic_error(result, target_model)
    if np.count_nonzero(result.found) < 2:
        raise FrictrackError(
            f"{recording.path.name}: the target {list(rectangle)} is found in fewer than two frames; "
            "choose a rectangle that fits the moving body, in a frame that shows it well"
        )
    result = _with_reference_sigma(result, template)
    codec_notes = () if change is None else key_frame_notes(change, result.x_px, result.y_px)
    notes = (*result.notes, *codec_notes, *at_rest(result))
    return replace(
        result,
        template=template,
        picture=target_model.template.image,
        notes=notes,
        outline=drawn.outline,
        exclude=tuple(drawn.exclude),
        obstacles=tuple(drawn.obstacles),
    )


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
        As in `track_in_parallel`.

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
        drawn = target if isinstance(target, Areas) else Areas(target)
        return _learn_and_track(film, drawn, template, Work(progress, pool)).target_model


def _learn_and_track(film: Recording, drawn: Areas, template: int, work: Work) -> _Followed:
    """Find the target, follow it roughly and learn its model."""
    work.report(0, film.n_frames, "find the target")
    drawn.check(film.shape)
    rectangle, template = resolve_target(film, drawn.target, template)
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
    tracker = BatchTracker(film, first_template, with_obstacles(None, blocked))
    raw_track = follow_film(tracker, start, template, work)
    min_frames = min_frames_if_rotating(film, raw_track, rotatable, start, template)
    if min_frames is not None:
        pose_track = track_rotating(film, rotatable, start, template, min_frames, work.progress)
        if pose_track is not None:
            model = TargetModel(pose_track.template, rotates=True)
            return _Followed(rectangle, template, pose_track.to_raw_track(), model, np.arange(0))
    model = learn_target_model(film, raw_track, first_template, blocked)
    return _Followed(rectangle, template, raw_track, model, np.flatnonzero(raw_track.found))


def _track_known(
    film: Recording, known: TargetModel, blocked: Mask | None, start: Array, template: int, work: Work
) -> RawTrack:
    """Follow a target with a known model from its corner `start` (2,) px in frame `template`."""
    if known.rotates:
        return track_known_rotating(film, RotatableTemplate(known.template, blocked), start, template, work.progress)
    return follow_film(BatchTracker(film, known.template, with_obstacles(None, blocked)), start, template, work)


def _locate_known(film: Recording, target: Target, template: int, known: TargetModel) -> tuple[Rectangle, int]:
    """Locate a target of known size in the film: its rectangle and the frame of that."""
    h, w = known.template.weight.shape
    rectangle, template = resolve_target(film, known.template.image if target is None else target, template)
    if rectangle[2:] != (w, h):
        raise FrictrackError(f"expected a target of the known {w}x{h} px but got {rectangle[2]}x{rectangle[3]} px")
    return rectangle, template


def _single_pass(film: Recording, target: Target, template: int, known: TargetModel | None) -> bool:
    """Whether one pass through the film, from its first frame, is enough; segments may have to be read again."""
    is_rectangle = isinstance(target, Sequence) and len(target) == 4 and template == 0
    is_short = film.n_frames < 2 * SEGMENT_FRAMES
    return is_short and is_rectangle and known is not None and known.pattern is None


def _to_track(recording: Recording, measured: RawTrack, rectangle: Rectangle, name: str) -> Track:
    """Convert raw positions to a `Track`: NaN and a reason where a frame cannot be trusted."""
    _, _, w, h = rectangle
    fit, at, found = measured.fit, measured.position, np.flatnonzero(measured.found)
    nan_where_lost = np.where(measured.found, 0.0, np.nan)
    locking_error, size = peak_locking_correction(found, at[found])
    at[found] -= locking_error
    return Track(
        t=recording.t,
        x_px=at[:, 0] + (w - 1) / 2 + nan_where_lost,
        y_px=at[:, 1] + (h - 1) / 2 + nan_where_lost,
        angle=fit.angle + nan_where_lost,
        sigma_px=fit.sigma[:, 0] + nan_where_lost,
        sigma_y_px=fit.sigma[:, 1] + nan_where_lost,
        sigma_angle=fit.sigma[:, 2] + nan_where_lost,
        score=fit.score,
        reason=measured.reason.astype(str),
        name=name,
        target=(float(rectangle[0]), float(rectangle[1]), float(w), float(h)),
        notes=(*recording.notes, *_unread_note(measured), *_peak_locking_note(size)),
    )


def _with_reference_sigma(track: Track, template: int) -> Track:
    """Raise the standard deviations of frame `template` to the median of all frames.

    That frame made the first template, so that its own misfit is too small.
    """
    columns = {name: getattr(track, name).copy() for name in ("sigma_px", "sigma_y_px", "sigma_angle")}
    for sigma in columns.values():
        sigma[template] = np.maximum(sigma[template], np.nanmedian(sigma))
    return replace(track, **columns)


def _with_systematic_error(track: Track, target_model: TargetModel) -> Track:
    """Add the systematic error along the path, with a note where the target's appearance changes."""
    found = track.found
    sigma, at = track.sigma_px[found], np.stack([track.x_px, track.y_px])[:, found]
    if not found.any():
        return track
    direction = np.linalg.svd(at - at.mean(axis=1, keepdims=True), full_matrices=False)[0][:, 0]
    systematic = float(np.sqrt(max(direction @ target_model.systematic_covariance @ direction, 0.0)))
    min_systematic = float(np.hypot(SYSTEMATIC_SHARE * np.median(sigma), MIN_SYSTEMATIC_PX))
    if systematic < min_systematic:
        return replace(track, systematic=min_systematic)
    note = (
        f"the appearance of the target changes along its path (light, highlights, background): slow position errors of "
        f"{systematic:.2g} px rms; an outline of the part that does not change, target = [[x, y], ...], or even light "
        "reduces them"
    )
    return replace(track, systematic=float(np.hypot(min_systematic, systematic)), notes=(*track.notes, note))


def _unread_note(measured: RawTrack) -> tuple[str, ...]:
    """Note how many frames of the film could be read, where some could not."""
    count = int(np.count_nonzero(measured.reason == UNREAD))
    total = len(measured.reason)
    return (f"{total - count} of {total} frames could be read; the rest is missing or damaged",) if count else ()


def _peak_locking_note(size: Array) -> tuple[str, ...]:
    """Note the correction of peak locking, from its amplitudes (2,) along x and y, px."""
    if not np.any(size > MIN_REPORTED_PEAK_LOCKING_PX):
        return ()
    return (
        f"peak locking of {np.max(size):.3f} px was corrected: the target is sharper "
        "than the sensor resolves; a slight defocus would avoid it",
    )


def _frame_changes(film: Recording) -> Array:
    """Rms change (n,) from each frame to the next beyond a uniform change of light, on every fourth pixel."""
    change, before = np.full(film.n_frames, np.nan), None
    for i, frame in enumerate(film.frames()):
        sparse = frame[::4, ::4].astype(np.float32)
        if before is not None:
            change[i] = np.std(sparse - before)
        before = sparse
    return change
