"""The flow of tracking: find the target, follow it, learn what it looks like, measure every frame."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from frictrack.errors import FrictrackError
from frictrack.recording import Recording, random_access
from frictrack.records import Array, Mask, Track
from frictrack.tracking.areas import Areas, obstructed
from frictrack.tracking.checks import at_rest, key_frames
from frictrack.tracking.finding import Target, resolve
from frictrack.tracking.follow import LEAVES, UNREAD, UNSETTLED, Followed, Follower
from frictrack.tracking.hidden import measure_hidden
from frictrack.tracking.learn import first_look
from frictrack.tracking.lesson import taught
from frictrack.tracking.match import Rectangle, nearest_corner
from frictrack.tracking.measure import Lesson, measure
from frictrack.tracking.pose import TurnedPicture
from frictrack.tracking.sharp import drawn_to_pixels
from frictrack.tracking.turn_test import frames_to_beat
from frictrack.tracking.turned import follow_known, follow_turning

Progress = Callable[[int, int, str], None]

LEAST_CONTRAST = 3  # grey values
CHUNK = 256  # frames measured at once
OFF_CENTRE = 0.55  # px from the corner of its cut-out, beyond which a target is measured on the next one
# What places stay off slowly, rms: the noise of the picture that was learnt, and blur that changes with the speed. As
# large as this on films of known truth, of sharp targets and blurred ones, at 0.001 to 0.005 px of noise.
SLOW_SHARE, LEAST_SLOW = 0.12, 2e-4  # of a frame's standard deviation, and px
TOLD = 0.01  # px by which places are drawn to the pixels that is worth a word
SHARE = 0.7  # of the film's usual score that a trusted frame reaches


def track(
    recording: Recording,
    target: Target | Areas = None,
    *,
    template: int = 0,
    known: Lesson | None = None,
    name: str = "target",
    progress: Progress | None = None,
) -> Track:
    """Position of the moving body in every frame, in pixels, with a standard deviation and a score.

    `target` is its rectangle [x, y, w, h], its outline [[x, y], [x, y], [x, y], ...] or a click on it [x, y], px in
    frame number `template`, or a picture of it (a path or a 2-D array); without it the body that moves is found by
    itself. `Areas` give it together with parts to exclude and with obstacles before it. `known` is what another film of
    the same target has taught (`learn_target`): then this film is gone through only once. Position is that of the
    rectangle's centre (of an outline, that of the rectangle round it), the angle (rad) is positive from the picture's
    x axis toward its y axis. A frame in which the target is not found holds NaN and the reason. Raises
    `FrictrackError` for a target that does not fit the picture, a film without contrast, or one in which nothing has
    texture.
    """
    drawn = target if isinstance(target, Areas) else Areas(target)
    with random_access(recording, once=_once(drawn.target, template, known)) as film:
        if known is None:
            rectangle, template, followed, lesson = _studied(film, drawn, template, progress)
            rows = np.flatnonzero(followed.found & ~lesson.turns)
        else:
            rectangle, template = _placed(film, drawn.target, template, known)
            drawn.check(film.shape)
            blocked = drawn.blocked(film.shape)
            lesson = replace(known, view=obstructed(known.view, blocked))
            followed = _followed(film, lesson, blocked, np.array(rectangle[:2]), template, progress)
            rows = np.flatnonzero(followed.found & (lesson.view is not None) & ~lesson.turns)
        measured = followed if lesson.turns else _measured(film, followed, rows, lesson, progress)
        change = _change(film) if recording.interframe else None
    result = _assembled(recording, measured, rectangle, name)
    result = _with_slow_error(result, lesson)
    if np.count_nonzero(result.found) < 2:
        raise FrictrackError(
            f"{recording.path.name}: the target {list(rectangle)} is found in fewer than two frames; "
            "choose a rectangle that fits the moving body, in a frame that shows it well"
        )
    result = _with_own_noise(result, template)
    coded = () if change is None else key_frames(change, result.x_px, result.y_px)
    notes = (*result.notes, *coded, *at_rest(result))
    return replace(
        result,
        template=template,
        picture=lesson.template.image,
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
) -> Lesson:
    """What the film teaches of its target: its picture, the noise of the pixels, what stands still before it.

    Arguments and errors are those of `track`, which takes the result as `known` for further films of the target.
    """
    with random_access(recording) as film:
        return _studied(film, target if isinstance(target, Areas) else Areas(target), template, progress)[3]


def _studied(
    film: Recording, drawn: Areas, template: int, progress: Progress | None
) -> tuple[Rectangle, int, Followed, Lesson]:
    """Rectangle and its frame, a first rough track, and what it has taught."""
    if progress:
        progress(0, film.n_frames, "find the target")
    drawn.check(film.shape)
    rectangle, template = resolve(film, drawn.target, template)
    x, y, w, h = rectangle
    blocked, belongs = drawn.blocked(film.shape), drawn.counts(rectangle)
    cut = film.frame(template)[y : y + h, x : x + w]
    if np.ptp(cut) < LEAST_CONTRAST:
        raise FrictrackError(
            f"{film.path.name}: the target {list(rectangle)} has no contrast in frame {template}; "
            "choose a rectangle that shows texture or an outline"
        )
    first = first_look(cut, belongs)
    picture, start = TurnedPicture(first, blocked), np.array([x, y])
    followed = Follower(film, first, obstructed(None, blocked)).follow(start, template, progress)
    least = frames_to_beat(film, followed, picture, start, template)
    if least is not None:
        turned = follow_turning(film, picture, start, template, least, progress)
        if turned is not None:
            return rectangle, template, turned.as_followed(), Lesson(turned.template, turns=True)
    return rectangle, template, followed, taught(film, followed, first, blocked)


def _followed(
    film: Recording, known: Lesson, blocked: Mask | None, start: Array, template: int, progress: Progress | None
) -> Followed:
    """Track of a known target from its corner `start` (2,) in frame `template`."""
    if known.turns:
        return follow_known(film, TurnedPicture(known.template, blocked), start, template, progress)
    return Follower(film, known.template, obstructed(None, blocked)).follow(start, template, progress)


def _placed(film: Recording, target: Target, template: int, known: Lesson) -> tuple[Rectangle, int]:
    """Where a known target is in the film; its size is that of what is known."""
    h, w = known.template.weight.shape
    rectangle, template = resolve(film, known.template.image if target is None else target, template)
    if rectangle[2:] != (w, h):
        raise FrictrackError(f"expected a target of the known {w}x{h} px but got {rectangle[2]}x{rectangle[3]} px")
    return rectangle, template


def _once(target: Target, template: int, known: Lesson | None) -> bool:
    """Whether going through the film once, from its first frame, is enough."""
    placed = isinstance(target, Sequence) and len(target) == 4 and template == 0
    return placed and known is not None and known.view is None


def _measured(
    film: Recording, followed: Followed, rows: NDArray[np.int64], lesson: Lesson, progress: Progress | None
) -> Followed:
    """The track with the frames `rows` measured by what the film has taught, and the reason where that fails."""
    size = lesson.template.weight.shape
    room = np.array(film.shape[::-1]) - np.array(size[::-1])
    followed.fine.sigma[:] *= lesson.inflation
    for at in range(0, len(rows), CHUNK):
        part = rows[at : at + CHUNK]
        _measure(film, followed, part, lesson)
        again = part[followed.found[part] & np.any(np.abs(followed.fine.at[part]) > OFF_CENTRE, axis=1)]
        if len(again):  # the learnt picture has the target nearer to another pixel than the first look had
            _measure(film, followed, again, lesson)
        if progress:
            progress(at, len(rows), "measure")
    measure_hidden(film, followed, lesson)
    found = np.flatnonzero(followed.found)
    followed.reason[found] = _reasons(followed, found, room)
    return followed


def _measure(film: Recording, followed: Followed, rows: NDArray[np.int64], lesson: Lesson) -> None:
    """Measure some frames (m,) on cut-outs that lie nearest to where the target was found last."""
    size = lesson.template.weight.shape
    corner = nearest_corner(followed.at[rows], film.shape, size)
    guess = followed.fine[rows].moved(followed.corner[rows] - corner)
    followed.fine.put(rows, measure(film.cut(rows, corner, size), corner, guess, lesson)[0])
    followed.corner[rows] = corner


def _reasons(result: Followed, rows: NDArray[np.int64], room: Array) -> list[str]:
    """Why each frame's position cannot be trusted; "" where it can."""
    fine, at = result.fine[rows], result.at[rows]
    out = np.any((at < -0.5) | (at > room + 0.5), axis=1)
    least = SHARE * float(np.nanmedian(fine.score))
    reasons = []
    for outside, settled, score in zip(out, fine.settled, fine.score, strict=True):
        if outside:
            reasons.append(LEAVES)
        elif not score >= least:
            reasons.append(f"match score {score:.2f} below {least:.2f}")
        else:
            reasons.append("" if settled else UNSETTLED)
    return reasons


def _assembled(recording: Recording, measured: Followed, rectangle: Rectangle, name: str) -> Track:
    """One row per frame: the position where it can be trusted, else NaN and the reason."""
    _, _, w, h = rectangle
    fine, at, found = measured.fine, measured.at, np.flatnonzero(measured.found)
    kept = np.where(measured.found, 0.0, np.nan)
    off, size = drawn_to_pixels(found, at[found])
    at[found] -= off
    return Track(
        t=recording.t,
        x_px=at[:, 0] + (w - 1) / 2 + kept,
        y_px=at[:, 1] + (h - 1) / 2 + kept,
        angle=fine.angle + kept,
        sigma_px=fine.sigma[:, 0] + kept,
        sigma_y_px=fine.sigma[:, 1] + kept,
        sigma_angle=fine.sigma[:, 2] + kept,
        score=fine.score,
        reason=measured.reason.astype(str),
        name=name,
        target=(float(rectangle[0]), float(rectangle[1]), float(w), float(h)),
        notes=(*recording.notes, *_unread(measured), *_drawn(size)),
    )


def _with_own_noise(track: Track, template: int) -> Track:
    """The track in which frame `template`, which few frames were compared with, is no better known than these."""
    columns = {name: getattr(track, name).copy() for name in ("sigma_px", "sigma_y_px", "sigma_angle")}
    for sigma in columns.values():
        sigma[template] = np.maximum(sigma[template], np.nanmedian(sigma))
    return replace(track, **columns)


def _with_slow_error(track: Track, lesson: Lesson) -> Track:
    """The track with what its places are off slowly, along its path, and a remark where the target's look changes."""
    found = track.found
    sigma, at = track.sigma_px[found], np.stack([track.x_px, track.y_px])[:, found]
    if not found.any():
        return track
    along = np.linalg.svd(at - at.mean(axis=1, keepdims=True), full_matrices=False)[0][:, 0]
    look = float(np.sqrt(max(along @ lesson.slow @ along, 0.0)))
    own = float(np.hypot(SLOW_SHARE * np.median(sigma), LEAST_SLOW))
    if look < own:
        return replace(track, systematic=own)
    note = (
        f"the look of the target changes along its path (light, highlights, background): places are off slowly by "
        f"{look:.2g} px rms; an outline of what does not change, target = [[x, y], ...], or even light lowers that"
    )
    return replace(track, systematic=float(np.hypot(own, look)), notes=(*track.notes, note))


def _unread(measured: Followed) -> tuple[str, ...]:
    count = int(np.count_nonzero(measured.reason == UNREAD))
    total = len(measured.reason)
    return (f"{total - count} of {total} frames could be read; the rest is missing or damaged",) if count else ()


def _drawn(size: Array) -> tuple[str, ...]:
    """What is said of places that were drawn to the pixels, by amplitudes (2,) along x and y, px."""
    if not np.any(size > TOLD):
        return ()
    return (
        f"places drawn to the pixels by {np.max(size):.3f} px were set right (peak locking): the target is sharper "
        "than the sensor resolves; a slight defocus would avoid it",
    )


def _change(film: Recording) -> Array:
    """Rms difference (n,) of each picture from the one before beyond a change of light, on every fourth pixel."""
    change, before = np.full(film.n_frames, np.nan), None
    for i, frame in enumerate(film.frames()):
        few = frame[::4, ::4].astype(np.float32)
        if before is not None:
            change[i] = np.std(few - before)
        before = few
    return change
