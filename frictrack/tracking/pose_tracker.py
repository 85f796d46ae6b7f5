"""Track a target that rotates by any angle: predict and refine; where that fails, match a bank of rotated templates.

Only films in which the target rotates too far for the small angles of `subpixel_fit` use it (`min_frames_if_rotating`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from frictrack.base.distributions import robust_std
from frictrack.base.errors import result_or_none
from frictrack.recording import Recording
from frictrack.records import Array, Mask
from frictrack.tracking.batch_tracker import MAX_MISFIT_RATIO, MIN_SCORE, MIN_SCORE_SHARE, Progress
from frictrack.tracking.correlation import Patch
from frictrack.tracking.followed_target import MAX_UNEXPLAINED_SHARE, OCCLUDED
from frictrack.tracking.measure import MISFIT_RATIO, unexplained_share
from frictrack.tracking.pose import Pose, RotatableTemplate, derotate, refine_pose, to_target_frame
from frictrack.tracking.subpixel_fit import FLAT, LEAVES, NOT_CONVERGED, UNREAD, RawTrack, SubpixelFit, empty_track
from frictrack.tracking.template import REFLECTION_PX, Template
from frictrack.tracking.template_learning import learn_template, template_from_frame, without_border

MAX_ANGULAR_STEP = np.radians(25.0)  # rad per frame
SEARCH_RADIUS_PX = 24  # round the prediction
GOOD_SCORE_SHARE = 0.8  # of the typical score; such a match near the prediction ends the search
# Pictures are reduced for searching to this shorter side of the target and this number of pixels in a frame, px.
SEARCH_TARGET_PX, SEARCH_FRAME_PX = 20, 400_000
SAME_COUNT_RATIO, CLEARLY_MORE_RATIO = 0.98, 2.0  # finds of a rotating target over those of one that does not rotate
MIN_LARGE_ROTATION_SHARE = 0.1  # of the frames
MAX_CORNER_MOTION_PX = 1.0  # beyond it the linear model of small rotations is invalid
N_SAMPLED_FRAMES = 8  # lost frames that are searched before all of them are
CLEARLY_BETTER_SCORE = 0.15  # by which a rotated template must match better than the upright one ...
CLEARLY_LESS_UNEXPLAINED = 0.8  # share of the picture's variance without rotation, for a round target to rotate
MAX_DISC_CHANGE = 0.06  # share of the rectangle, by which a disc differs from the target
# What changes when a disc is rotated is a mark: in a blurred picture, within this share of the radius, by this many
# standard deviations of noise and this share of the contrast to the surroundings.
N_ANGLES = 256  # of a disc that are compared
MARK_BLUR, MARKED_RADIUS, MIN_MARK_SIGMAS, MIN_MARK_SHARE = 1.0, 0.7, 1.3, 0.04
NOISE_FILTER = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], np.float32)
MAX_UNEXPLAINED_RATIO = 0.25  # ... or unexplained variance of the rotated template over that of the upright one
MAX_TRUSTED_GAP = 3  # frames from the last find, over which a prediction is trusted
MIN_VISIBLE_SHARE = 0.8  # of the target's rectangle that must lie in the picture
MAX_LOST_FRAMES = 8  # after which the whole picture is searched in every eighth frame only
# smallest and largest number of frames from which the template is learnt
MIN_LEARNING_FRAMES, MAX_LEARNING_FRAMES = 24, 60
SINGLE_FRAME_BAND = 0.25  # cycles/px; a single frame does not determine shorter waves
ROUNDS = 3  # of learning the template and measuring these frames again
# The typical misfit is this quantile over so many frames: many of them may be partly hidden.
N_MISFIT_FRAMES, MISFIT_QUANTILE = 24, 0.1


def search_pose(
    frame: Patch,
    predicted: Pose,
    rotatable: RotatableTemplate,
    typical_score: float,
    *,
    everywhere: bool = True,
    typical_misfit: float = np.nan,
) -> Pose | None:
    """Search a frame for the target: near a prediction, then anywhere, then at any angle.

    Parameters
    ----------
    frame : array (H, W)
        Grey values.
    predicted : Pose
        Prediction from the frames before.
    rotatable : RotatableTemplate
        Template of the target.
    typical_score : float
        Match score of the last finds.
    everywhere : bool
        Whether to search beyond the neighbourhood of the prediction.
    typical_misfit : float
        Misfit of a frame that shows only target and noise; NaN where it is not known.

    Returns
    -------
    Pose or None
        The best pose; None where nothing could be matched.

    """
    step = 2.0 / rotatable.radius
    likely = predicted.angle + np.arange(-MAX_ANGULAR_STEP, MAX_ANGULAR_STEP + step / 2, step)
    rounds = [(likely, SEARCH_RADIUS_PX), (likely, np.inf), (predicted.angle + np.arange(0, 2 * np.pi, step), np.inf)]
    best: Pose | None = None
    for angles, reach in rounds if everywhere else rounds[:1]:
        found = _match_rotations(frame, predicted, rotatable, angles, reach)
        if found is None:
            continue
        found = refine_pose(frame, found, rotatable, trusted=True)
        if found.converged and not np.isnan(typical_misfit):  # at first, its own residuals set the scale
            found = refine_pose(frame, found, rotatable, typical_misfit, trusted=True)
        if best is None or (found.converged, found.score) > (best.converged, best.score):
            best = found
        if best.converged and best.score >= GOOD_SCORE_SHARE * typical_score:
            break
    return best


def _match_rotations(
    frame: Patch, predicted: Pose, rotatable: RotatableTemplate, angles: Array, reach: float
) -> Pose | None:
    """The best match of the template at some angles, within `reach` px of a prediction, on a reduced picture."""
    side = min(rotatable.template.weight.shape)
    least = np.sqrt(SEARCH_FRAME_PX / frame.size) if side > 2 * SEARCH_TARGET_PX else 0.0
    scale = float(np.clip(least, SEARCH_TARGET_PX / side, 1.0)) if side > SEARCH_TARGET_PX else 1.0
    around = np.clip(predicted.centre + np.array([[-1], [1]]) * (rotatable.radius + reach), 0, frame.shape[::-1])
    low, high = np.floor(around[0]).astype(int), np.ceil(around[1]).astype(int) + 1
    part = frame[low[1] : high[1], low[0] : high[0]].astype(np.float32)
    if not part.size:
        return None
    small = cv2.resize(part, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    best, where, angle = -np.inf, np.zeros(2), 0.0
    for one in angles:
        patch, mask = _rotated_patch(rotatable, float(one), scale)
        if patch.shape[0] > small.shape[0] or patch.shape[1] > small.shape[1]:
            continue
        scores = cv2.matchTemplate(small, patch, cv2.TM_CCOEFF_NORMED, mask=mask)
        scores[~(np.abs(scores) <= 1.001)] = -1
        _, score, _, (x, y) = cv2.minMaxLoc(scores)
        if score > best:
            best, angle = score, float(one)
            where = (np.array([x, y]) + (np.array(patch.shape[::-1]) - 1) / 2 + 0.5) / scale - 0.5 + low
    return None if not np.isfinite(best) else replace(predicted, centre=where, angle=angle)


def _rotated_patch(rotatable: RotatableTemplate, angle: float, scale: float) -> tuple[Patch, Patch]:
    """Template rotated and reduced, and its mask of 1 and 0."""
    template = rotatable.template
    image: Patch = (template.image - template.level).astype(np.float32)
    if scale < 1:
        image = cv2.GaussianBlur(image, (0, 0), 0.4 / scale)
    c, s = np.cos(angle), np.sin(angle)
    size = (2 * np.ceil(np.abs([[c, s], [s, c]]) @ rotatable.middle * scale) + 1).astype(int)
    turn = np.array([[c, s], [-s, c]]) / scale  # from the patch to the template
    matrix = np.column_stack([turn, rotatable.middle - turn @ (size - 1) / 2])
    shown = cv2.warpAffine(
        (template.weight > 0).astype(np.float32), matrix, size.tolist(), flags=cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP
    )
    turned = cv2.warpAffine(image, matrix, size.tolist(), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
    return turned * shown, shown


def is_disc(mask: Mask) -> bool:
    """Whether the pixels of a target make a disc that fills its rectangle."""
    if abs(mask.shape[0] - mask.shape[1]) > MAX_DISC_CHANGE * max(mask.shape):
        return False
    y, x = ((np.arange(n) - (n - 1) / 2) / (n / 2) for n in mask.shape)
    return bool(np.mean(mask ^ (np.hypot(y[:, None], x) <= 1)) < MAX_DISC_CHANGE)


def outline_template(disc: Patch, mask: Mask) -> Template:
    """Template of the outer ring of a disc (h, w), averaged along circles: it looks the same at any angle."""
    y, x = (np.arange(n) - (n - 1) / 2 for n in disc.shape)
    distance = np.hypot(y[:, None], x)
    ring = np.rint(distance).astype(np.int64).ravel()
    mean = np.bincount(ring, disc.ravel()) / np.maximum(np.bincount(ring), 1)
    outer = mask & (distance > MARKED_RADIUS * min(disc.shape) / 2)
    return template_from_frame(np.interp(distance, np.arange(len(mean)), mean), outer)


def has_marks(cut: Patch) -> bool:
    """Whether a disc (h, w) looks different when it is rotated, by more than its noise."""
    picture = cut.astype(np.float32)
    h, w = picture.shape
    middle, side = ((w - 1) / 2, (h - 1) / 2), min(h, w) / 2
    smooth = cv2.GaussianBlur(picture, (0, 0), MARK_BLUR)
    y, x = np.mgrid[:h, :w]
    distance = np.hypot(x - middle[0], y - middle[1])
    inside = distance < MARKED_RADIUS * side
    contrast = abs(float(np.median(picture[inside])) - float(np.median(picture[distance > side - 1])))
    noise = robust_std(cv2.filter2D(picture, -1, NOISE_FILTER)[1:-1, 1:-1]) / 6  # Immerkaer 1996, CVIU 64:300
    least = max(MIN_MARK_SIGMAS * noise, MIN_MARK_SHARE * contrast, 1.0)
    turns = (cv2.getRotationMatrix2D(middle, degrees, 1.0) for degrees in (60, 120, 180))
    changes = (np.abs(cv2.warpAffine(smooth, turn, (w, h)) - smooth)[inside] for turn in turns)
    return any(np.quantile(change, 0.97) > least for change in changes)


def min_frames_if_rotating(
    film: Recording, raw_track: RawTrack, rotatable: RotatableTemplate, start: Array, first: int
) -> float | None:
    """Compute in how many frames a rotating target must be found to be tracked as rotating.

    Large angles show in the fit, or a rotated template matches where the target was lost first. In the second case
    tracking
    must recover as many frames as were found. A mass that slides and then falls off the course has also rotated, but
    only
    its slide matters.

    Parameters
    ----------
    film : Recording
        Film with random access.
    raw_track : RawTrack
        Track for small angles.
    rotatable : RotatableTemplate
        Template of the target.
    start : array (2,)
        Corner of the target's rectangle in frame `first`, px.
    first : int
        Number of that frame.

    Returns
    -------
    float or None
        None where the target does not rotate.

    """
    rows, lost = np.flatnonzero(raw_track.found), np.flatnonzero(~raw_track.found)
    angle, found = raw_track.fit.angle[rows], len(rows)
    if np.mean(np.abs(angle - np.median(angle)) * rotatable.radius > MAX_CORNER_MOTION_PX) > MIN_LARGE_ROTATION_SHARE:
        return SAME_COUNT_RATIO * found
    first_lost = [*np.flatnonzero(~raw_track.found[first:])[:1] + first, *np.flatnonzero(~raw_track.found[:first])[-1:]]
    shown = [int(i) for i in first_lost if raw_track.reason[i] not in (LEAVES, UNREAD, FLAT)]
    if not any(_has_rotated(film, raw_track, rotatable, i, first, start) for i in shown):
        return None
    share = (CLEARLY_MORE_RATIO - 1) * found / len(lost)  # of the lost frames that would have to show it
    sampled = lost[np.unique(np.linspace(0, len(lost) - 1, N_SAMPLED_FRAMES).astype(int))] if share <= 1 else lost[:0]
    corners = (raw_track.position[rows[np.argmin(np.abs(rows - i))]] for i in sampled)
    score = float(np.median(raw_track.fit.score[rows]))
    seen = [
        _search_rotated(film, int(i), at, rotatable, score) is not None for i, at in zip(sampled, corners, strict=True)
    ]
    return CLEARLY_MORE_RATIO * found if sum(seen) > 0.5 * share * len(sampled) else None


def _search_rotated(
    film: Recording, i: int, corner: Array, rotatable: RotatableTemplate, typical_score: float
) -> Pose | None:
    """Find a rotated target in frame `i`, from a corner (2,) px on; None without a match as good as is typical."""
    frame = result_or_none(film.frame, i)
    if frame is None or frame.min() == frame.max():
        return None
    pose = search_pose(frame, Pose(corner + rotatable.middle, 0.0), rotatable, typical_score)
    return pose if pose and pose.converged and pose.score >= MIN_SCORE_SHARE * typical_score else None


def _has_rotated(
    film: Recording, raw_track: RawTrack, rotatable: RotatableTemplate, i: int, first: int, start: Array
) -> bool:
    """Whether a rotated template matches frame `i` clearly better than the upright one."""
    near = i - 1 if i > first else i + 1
    at = raw_track.position[near] if raw_track.found[near] else np.asarray(start, dtype=np.float64)
    found, upright = _search_rotated(film, i, at, rotatable, 1.0), float(np.nan_to_num(raw_track.fit.score[i]))
    if found is None:
        return False
    return found.score > upright + CLEARLY_BETTER_SCORE or 1 - found.score**2 < MAX_UNEXPLAINED_RATIO * (1 - upright**2)


@dataclass(frozen=True, eq=False)
class PoseTrack:
    """Poses of the target in all frames.

    Attributes
    ----------
    poses : list of Pose or None
        None where the target was not found.
    reason : array of object (n,)
        Why it was not found or cannot be trusted; "" where it can.
    template : Template
        Template with which it was tracked.

    """

    poses: list[Pose | None]
    reason: NDArray[np.object_]
    template: Template

    @property
    def count(self) -> int:
        """Number of frames in which the target was found."""
        return sum(pose is not None for pose in self.poses)

    def some(self, found: list[int], count: int) -> list[tuple[int, Pose]]:
        """Frames and poses, `count` of the frames `found`, evenly spread."""
        rows = [found[k] for k in np.unique(np.linspace(0, len(found) - 1, count).astype(int))] if found else []
        return [(i, pose) for i in rows if (pose := self.poses[i]) is not None]

    def explains_more(self, upright: RawTrack) -> bool:
        """Whether rotation leaves clearly less of the pictures unexplained than the `upright` template does."""
        score = np.array([pose.score for pose in self.poses if pose is not None])
        left, other = (np.median(1 - q**2) for q in (score, upright.fit.score[upright.found]))
        return bool(left < CLEARLY_LESS_UNEXPLAINED * other)

    def to_raw_track(self) -> RawTrack:
        """Convert to a track of the upper left corner of the rectangle; the rectangle itself does not rotate."""
        out, middle = empty_track(len(self.poses)), RotatableTemplate(self.template).middle
        out.reason[:] = self.reason
        values = [f.name for f in fields(SubpixelFit) if f.name != "position"]
        for i, pose in enumerate(self.poses):
            if pose is not None:
                at = pose.centre - middle
                out.corner[i] = np.rint(at)
                row = SubpixelFit((at - out.corner[i])[None], *(np.array([getattr(pose, name)]) for name in values))
                out.fit.put(np.array([i]), row)
        return out


class _PoseTracker:
    """Track one rotating target through a film."""

    def __init__(self, film: Recording, rotatable: RotatableTemplate, typical_misfit: float = np.nan) -> None:
        self.film, self.rotatable, self.misfit = film, rotatable, typical_misfit
        self.score, self.misses_left = 1.0, np.inf

    def follow(self, start: Pose, first: int, progress: Progress | None = None, min_frames: float = 0.0) -> PoseTrack:
        """Track the target both ways from frame `first`, in which it is at `start`.

        Stops where `min_frames` finds can no longer be reached.
        """
        n = self.film.n_frames
        self.misses_left = n - min_frames
        track = PoseTrack([None] * n, np.full(n, UNREAD, dtype=object), self.rotatable.template)
        for frames in (range(first, n), range(first - 1, -1, -1)):
            self._follow_frames(frames, start, track, progress)
        return track

    def _follow_frames(self, frames: range, start: Pose, track: PoseTrack, progress: Progress | None) -> None:
        last_found: list[tuple[int, Pose]] = [(frames.start - frames.step, start)] if len(frames) else []
        for done, i in enumerate(frames):
            if progress and done % 16 == 0:
                progress(done, len(frames), "follow the rotating target")
            frame = result_or_none(self.film.frame, i)
            if frame is None:
                continue
            if self.misses_left < 0:
                return
            pose, reason = self._find_pose(frame, i, last_found)
            self.misses_left -= pose is None
            still_outside = pose is None and i != frames.start and track.reason[i - frames.step] == LEAVES
            track.reason[i] = LEAVES if still_outside else reason
            if pose is not None:
                track.poses[i] = pose
                last_found = [*last_found[-1:], (i, pose)]
                self.score = 0.9 * self.score + 0.1 * pose.score

    def _find_pose(self, frame: Patch, i: int, last_found: list[tuple[int, Pose]]) -> tuple[Pose | None, str]:
        """Find the pose in frame `i`, or the reason why there is none."""
        if frame.min() == frame.max():
            return None, FLAT
        predicted = _predict_pose(i, last_found)
        trusted = len(last_found) > 1 and abs(i - last_found[-1][0]) <= MAX_TRUSTED_GAP
        pose = refine_pose(frame, predicted, self.rotatable, self.misfit, trusted=trusted)
        if not self._is_good(pose):
            everywhere = abs(i - last_found[-1][0]) <= MAX_LOST_FRAMES or i % MAX_LOST_FRAMES == 0
            searched = search_pose(
                frame, predicted, self.rotatable, self.score, everywhere=everywhere, typical_misfit=self.misfit
            )
            pose = searched if searched is not None and searched.score > pose.score - 0.02 else pose
        if self._visible_share(pose if self._is_good(pose) else predicted, frame) < MIN_VISIBLE_SHARE:
            return None, LEAVES
        if self._is_good(pose):
            return pose, self._doubt_reason(pose)
        low = f"match score {pose.score:.2f} below {self._min_score:.2f}"
        return None, NOT_CONVERGED if pose.score >= self._min_score else low

    @property
    def _min_score(self) -> float:
        return max(MIN_SCORE, MIN_SCORE_SHARE * self.score)

    def _is_good(self, pose: Pose) -> bool:
        return pose.converged and pose.score >= self._min_score

    def _doubt_reason(self, pose: Pose) -> str:
        """State why the pose cannot be trusted; empty where it can."""
        if np.isnan(self.misfit) or pose.misfit < MAX_MISFIT_RATIO * self.misfit:
            return ""
        return OCCLUDED if unexplained_share(pose.score, pose.misfit, self.misfit) > MAX_UNEXPLAINED_SHARE else ""

    def _visible_share(self, pose: Pose, frame: Patch) -> float:
        """Share of the target's rectangle that lies in the picture."""
        x, y = self.rotatable.middle
        grid = np.stack(np.meshgrid(np.linspace(-x, x, 9), np.linspace(-y, y, 9))).reshape(2, -1)
        at = to_target_frame(grid, np.zeros(2), -pose.angle) + pose.centre[:, None]
        return float(np.mean(np.all((at > -0.5) & (at < np.array(frame.shape[::-1])[:, None] - 0.5), axis=0)))


def _predict_pose(i: int, last_found: list[tuple[int, Pose]]) -> Pose:
    """Predict the pose in frame `i` from the velocity between the last two finds, if these are neighbours."""
    frame, last = last_found[-1]
    if len(last_found) < 2 or abs(frame - last_found[-2][0]) > 2 or abs(i - frame) > MAX_LOST_FRAMES:
        return last
    ahead = (i - frame) / (frame - last_found[-2][0])
    before = last_found[-2][1]
    return replace(
        last,
        centre=last.centre + ahead * (last.centre - before.centre),
        angle=last.angle + ahead * (last.angle - before.angle),
    )


def track_rotating(
    film: Recording,
    rotatable: RotatableTemplate,
    start: Array,
    first: int,
    min_frames: float | None = None,
    progress: Progress | None = None,
) -> PoseTrack | None:
    """Track a rotating target, and learn its template from the film where it is not known.

    Parameters
    ----------
    film : Recording
        Film with random access.
    rotatable : RotatableTemplate
        Template of the target.
    start : array (2,)
        Corner of the target's rectangle in frame `first`, px.
    first : int
        Number of that frame.
    min_frames : float, optional
        Number of finds below which the target is not tracked as rotating (`min_frames_if_rotating`), for a template
        that is made of one frame. None for a template learnt from another film.
    progress : callable, optional
        Called as ``progress(done, total, step)``.

    Returns
    -------
    PoseTrack or None
        None where there are fewer finds.

    """
    origin = Pose(np.asarray(start, dtype=np.float64) + rotatable.middle, 0.0, offset=rotatable.template.level)
    least = min_frames or 0.0

    def follow(template: RotatableTemplate, misfit: float, rough: PoseTrack | None) -> PoseTrack:
        begin = (rough and rough.poses[first]) or origin
        return _PoseTracker(film, template, misfit).follow(begin, first, progress, least)

    track = _track_twice(film, rotatable, first, follow, learn=min_frames is not None, min_frames=least)
    return track if track.count >= least else None


def track_disc(
    film: Recording, rotatable: RotatableTemplate, raw_track: RawTrack, first: int, *, learn: bool = True
) -> PoseTrack:
    """Follow the rotation of a disc whose middle is known by its marks, however far it turns from frame to frame.

    Parameters
    ----------
    film : Recording
        Film with random access.
    rotatable : RotatableTemplate
        Template of the disc.
    raw_track : RawTrack
        Track of the disc without rotation.
    first : int
        Number of the frame of the template.
    learn : bool
        Whether to learn the template from the film.

    Returns
    -------
    PoseTrack
        In the frames in which the disc was found.

    """

    def follow(template: RotatableTemplate, misfit: float, rough: PoseTrack | None) -> PoseTrack:
        return _disc_poses(film, template, raw_track, misfit)

    return _track_twice(film, rotatable, first, follow, learn=learn)


def _track_twice(
    film: Recording,
    rotatable: RotatableTemplate,
    first: int,
    follow: Callable[[RotatableTemplate, float, PoseTrack | None], PoseTrack],
    *,
    learn: bool,
    min_frames: float = 0.0,
) -> PoseTrack:
    """Track roughly, learn template and typical misfit from that, and track again if there are `min_frames` finds."""
    inner = rotatable.with_template(without_border(rotatable.template)) if learn else rotatable
    rough = follow(inner, np.nan, None)
    if rough.count < min_frames:
        return rough
    found = [i for i, pose in enumerate(rough.poses) if pose is not None and i != first]
    learnt = (_learn_rotatable(film, rough, rotatable, found) if learn else None) or inner
    return follow(learnt, _typical_misfit(film, rough, learnt, found), rough)


def _disc_poses(film: Recording, rotatable: RotatableTemplate, raw_track: RawTrack, misfit: float) -> PoseTrack:
    """Refine the pose of a disc in every frame, from its middle and the angle at which its marks correlate best."""
    rows = np.flatnonzero(raw_track.found)
    track = PoseTrack([None] * film.n_frames, raw_track.reason.copy(), rotatable.template)
    spectrum = np.conj(np.fft.rfft(_marks(rotatable.template.image, rotatable.middle, rotatable.radius), axis=0))
    angles = np.zeros(len(rows))
    for k, i in enumerate(rows.tolist()):
        centre = raw_track.position[i] + rotatable.middle
        seen = np.fft.rfft(_marks(film.frame(i), centre, rotatable.radius), axis=0)
        angles[k] = 2 * np.pi / N_ANGLES * int(np.argmax(np.fft.irfft(seen * spectrum, N_ANGLES, axis=0).sum(axis=1)))
    tracker = _PoseTracker(film, rotatable, misfit)
    tracker.score = float(np.median(raw_track.fit.score[rows]))
    for i, angle in zip(rows.tolist(), np.unwrap(angles).tolist(), strict=True):
        fit = raw_track.fit
        start = Pose(raw_track.position[i] + rotatable.middle, angle, float(fit.gain[i]), float(fit.offset[i]))
        pose = refine_pose(film.frame(i), start, rotatable, misfit)
        if tracker._is_good(pose):
            track.poses[i], track.reason[i] = pose, tracker._doubt_reason(pose)
        else:
            track.reason[i] = NOT_CONVERGED
    return track


def _marks(picture: Patch, centre: Array, radius: float) -> Array:
    """What differs along circles round a centre: grey values (angle, radius) less the mean of every circle."""
    side = radius / np.sqrt(2)  # of the disc; `radius` is that of its rectangle's corners
    size = max(round(0.75 * side), 4), N_ANGLES
    at = float(centre[0]), float(centre[1])
    unrolled = cv2.warpPolar(picture.astype(np.float32), size, at, 0.8 * side, cv2.INTER_LINEAR)
    return np.asarray((unrolled - unrolled.mean(axis=0)) * np.sqrt(np.arange(size[0])), dtype=np.float64)


def _typical_misfit(film: Recording, rough: PoseTrack, rotatable: RotatableTemplate, found: list[int]) -> float:
    """Misfit of frames that show only target and noise: a low quantile over some of the frames `found`."""
    poses = [refine_pose(film.frame(i), pose, rotatable) for i, pose in rough.some(found, N_MISFIT_FRAMES)]
    misfit = [pose.misfit for pose in poses if pose.converged]
    return max(float(np.quantile(misfit, MISFIT_QUANTILE)), rotatable.template.min_misfit) if misfit else np.nan


def _learn_rotatable(
    film: Recording, rough: PoseTrack, rotatable: RotatableTemplate, found: list[int]
) -> RotatableTemplate | None:
    """Learn the template from some of the frames `found`; None where there are too few."""
    if len(found) < MIN_LEARNING_FRAMES:
        return None
    chosen = rough.some(found, MAX_LEARNING_FRAMES)
    frames, poses = [film.frame(i) for i, _ in chosen], [pose for _, pose in chosen]
    template = _low_pass(rotatable.template)
    for _ in range(ROUNDS):
        template = _learn(frames, poses, rotatable.with_template(template))
        inner = rotatable.with_template(without_border(template))
        poses = [refine_pose(frame, pose, inner) for frame, pose in zip(frames, poses, strict=True)]
    return inner


def _low_pass(template: Template) -> Template:
    """Remove the shortest waves of a template from one frame: they are mostly noise, which learning would keep."""
    frequency = [
        np.arange(n) / (2 * (side - 1 + 2 * REFLECTION_PX))
        for n, side in zip(template.coefficients.shape, template.weight.shape, strict=True)
    ]
    transmission = np.exp(-((np.hypot(frequency[0][:, None], frequency[1]) / SINGLE_FRAME_BAND) ** 4))
    return replace(template, coefficients=template.coefficients * transmission)


def _learn(frames: list[Patch], poses: list[Pose], rotatable: RotatableTemplate) -> Template:
    """Fit the template to the frames that show only the target."""
    limit = MISFIT_RATIO * float(np.median([pose.misfit for pose in poses]))
    chosen = [(f, p) for f, p in zip(frames, poses, strict=True) if p.converged and p.misfit <= limit]
    cuts = np.stack([derotate(frame, pose, rotatable) for frame, pose in chosen])
    light = {name: np.array([getattr(pose, name) for _, pose in chosen]) for name in ("gain", "offset")}
    n = len(chosen)
    fit = replace(empty_track(n).fit, position=np.zeros((n, 2)), angle=np.zeros(n), **light)
    return learn_template(cuts, fit, rotatable.template)
