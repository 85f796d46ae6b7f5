"""Follow a target that turns by any angle: predict, refine; where that fails, match a bank of turned pictures.

Only films in which the target turns too far for the small rotations of `refine_positions` come this way (`turns`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from frictrack.errors import FrictrackError
from frictrack.recording import Recording
from frictrack.records import Array
from frictrack.tracking.batch_tracker import (
    FLAT,
    LEAVES,
    MAX_MISFIT_RATIO,
    MIN_SCORE,
    MIN_SCORE_SHARE,
    NOT_CONVERGED,
    UNREAD,
    RawTrack,
    empty_track,
)
from frictrack.tracking.correlation import Patch
from frictrack.tracking.cosine_basis import REFLECTION_PX
from frictrack.tracking.measure import MISFIT_RATIO, unexplained_share
from frictrack.tracking.occlusion import MAX_UNEXPLAINED_SHARE, OCCLUDED
from frictrack.tracking.pose import Pose, RotatableTemplate, derotate, refine_pose, to_target_frame
from frictrack.tracking.subpixel_fit import SubpixelFit
from frictrack.tracking.template import Template
from frictrack.tracking.template_learning import learn_template, without_border

Progress = Callable[[int, int, str], None]

MAX_ANGULAR_STEP = np.radians(25.0)  # rad a frame
SEARCH_RADIUS_PX = 24  # px searched round the prediction
GOOD_SCORE_SHARE = 0.8  # of the usual score: a match near the prediction that is as good ends the search
SEARCH_TARGET_PX, SEARCH_FRAME_PX = (
    20,
    400_000,
)  # px of a target's shorter side, and of a picture, to which they are reduced for searching
MAX_TRUSTED_GAP = 3  # frames from the last find, over which a prediction is trusted
MIN_VISIBLE_SHARE = 0.8  # of the target's rectangle that must lie within the picture
MAX_LOST_FRAMES = 8  # frames without a find after which the whole picture is searched in every eighth frame only
MIN_LEARNING_FRAMES, MAX_LEARNING_FRAMES = 24, 60  # frames that teach the picture, at least and at most
SINGLE_FRAME_BAND = 0.25  # cycles/px, beyond which a single frame does not tell the picture
ROUNDS = 3  # of learning the picture and measuring those frames again
N_MISFIT_FRAMES, MISFIT_QUANTILE = (
    24,
    0.1,
)  # frames whose misfit is the usual one: this quantile of it, as many may be partly hidden


@dataclass(frozen=True, eq=False)
class PoseTrack:
    """Poses of the target, frame by frame, None where it was not found, and why (n,)."""

    poses: list[Pose | None]
    reason: NDArray[np.object_]
    template: Template

    @property
    def count(self) -> int:
        """Frames in which the target was found."""
        return sum(pose is not None for pose in self.poses)

    def to_raw_track(self) -> RawTrack:
        """The same as a track of the rectangle's upper left corner; the rectangle itself does not turn."""
        out = empty_track(len(self.poses))
        out.reason[:] = self.reason
        middle = RotatableTemplate(self.template).middle
        for i, pose in enumerate(self.poses):
            if pose is None:
                continue
            at = pose.centre - middle
            out.corner[i] = np.rint(at)
            row = SubpixelFit(
                (at - out.corner[i])[None], *(np.array([q]) for q in (pose.angle, pose.sigma, pose.score)),
                *(np.array([q]) for q in (pose.gain, pose.offset, pose.misfit, pose.converged)),
            )  # fmt: skip
            out.fit.put(np.array([i]), row)
        return out


class _PoseTracker:
    """Follows one turning target through a film."""

    def __init__(self, film: Recording, rotatable: RotatableTemplate, typical_misfit: float = np.nan) -> None:
        self.film, self.rotatable, self.misfit = film, rotatable, typical_misfit
        self.score, self.misses_left = 1.0, np.inf

    def follow(self, start: Pose, first: int, progress: Progress | None = None, min_frames: float = 0.0) -> PoseTrack:
        """All frames, both ways from frame `first`, in which the target is at `start`.

        It ends where `min_frames` frames can no longer be reached.
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
                progress(done, len(frames), "follow the turning target")
            try:
                frame = self.film.frame(i)
            except FrictrackError:
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
        """The target's pose in frame `i`, or why there is none."""
        if frame.min() == frame.max():
            return None, FLAT
        predicted = _predict_pose(i, last_found)
        trusted = len(last_found) > 1 and abs(i - last_found[-1][0]) <= MAX_TRUSTED_GAP
        pose = refine_pose(frame, predicted, self.rotatable, self.misfit, trusted=trusted)
        if not self._is_good(pose):
            age = abs(i - last_found[-1][0])
            everywhere = age <= MAX_LOST_FRAMES or i % MAX_LOST_FRAMES == 0
            searched = search_pose(
                frame, predicted, self.rotatable, self.score, everywhere=everywhere, typical_misfit=self.misfit
            )
            pose = searched if searched is not None and searched.score > pose.score - 0.02 else pose
        if self._visible_share(pose if self._is_good(pose) else predicted, frame) < MIN_VISIBLE_SHARE:
            return None, LEAVES
        if self._is_good(pose):
            return pose, self._doubt_reason(pose)
        return (
            None,
            NOT_CONVERGED
            if pose.score >= self._min_score
            else f"match score {pose.score:.2f} below {self._min_score:.2f}",
        )

    @property
    def _min_score(self) -> float:
        return max(MIN_SCORE, MIN_SCORE_SHARE * self.score)

    def _is_good(self, pose: Pose) -> bool:
        return pose.converged and pose.score >= self._min_score

    def _doubt_reason(self, pose: Pose) -> str:
        """Why the pose cannot be trusted; empty where it can."""
        if np.isnan(self.misfit) or pose.misfit < MAX_MISFIT_RATIO * self.misfit:
            return ""
        return OCCLUDED if unexplained_share(pose.score, pose.misfit, self.misfit) > MAX_UNEXPLAINED_SHARE else ""

    def _visible_share(self, pose: Pose, frame: Patch) -> float:
        """Share of the target's rectangle that lies within the picture."""
        x, y = self.rotatable.middle
        grid = np.stack(np.meshgrid(np.linspace(-x, x, 9), np.linspace(-y, y, 9))).reshape(2, -1)
        at = to_target_frame(grid, np.zeros(2), -pose.angle) + pose.centre[:, None]
        return float(np.mean(np.all((at > -0.5) & (at < np.array(frame.shape[::-1])[:, None] - 0.5), axis=0)))


def _corners(rotatable: RotatableTemplate, pose: Pose) -> Array:
    """Corners (2, 4) of the turned rectangle."""
    x, y = rotatable.middle
    return to_target_frame(np.array([[-x, x, x, -x], [-y, -y, y, y]]), np.zeros(2), -pose.angle) + pose.centre[:, None]


def _predict_pose(i: int, last_found: list[tuple[int, Pose]]) -> Pose:
    """The pose in frame `i` by the velocity between the last two, where these are neighbours."""
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


# ---- searching


def search_pose(
    frame: Patch,
    predicted: Pose,
    rotatable: RotatableTemplate,
    typical_score: float,
    *,
    everywhere: bool = True,
    typical_misfit: float = np.nan,
) -> Pose | None:
    """The best pose near a prediction; anywhere where none is good; at any angle where that fails too."""
    step = 2.0 / rotatable.radius
    likely_angles = predicted.angle + np.arange(-MAX_ANGULAR_STEP, MAX_ANGULAR_STEP + step / 2, step)
    rounds = [
        (likely_angles, SEARCH_RADIUS_PX),
        (likely_angles, 0),
        (predicted.angle + np.arange(0, 2 * np.pi, step), 0),
    ]
    best: Pose | None = None
    for angles, reach in rounds if everywhere else rounds[:1]:
        start = _match_rotations(frame, predicted, rotatable, angles, reach)
        found = None if start is None else _refine_match(frame, start, rotatable, typical_misfit)
        if found is not None and (best is None or (found.converged, found.score) > (best.converged, best.score)):
            best = found
        if best is not None and best.converged and best.score >= GOOD_SCORE_SHARE * typical_score:
            break
    return best


def _refine_match(frame: Patch, start: Pose, rotatable: RotatableTemplate, typical_misfit: float) -> Pose:
    """The pose from a rough match, whose own misfit says which pixels fit, then from a good start by the usual one."""
    rough = refine_pose(frame, start, rotatable, trusted=True)
    if np.isnan(typical_misfit) or not rough.converged:
        return rough
    return refine_pose(frame, rough, rotatable, typical_misfit, trusted=True)


def _match_rotations(
    frame: Patch, predicted: Pose, rotatable: RotatableTemplate, angles: Array, reach: int
) -> Pose | None:
    """The best match of the picture turned by some angles, within `reach` px of a prediction, or anywhere for 0."""
    scale = _scale(rotatable, frame)
    low, part = _crop(frame, predicted.centre, rotatable.radius + reach if reach else np.inf)
    small = cv2.resize(part.astype(np.float32), None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    best, where, angle = -np.inf, np.zeros(2), 0.0
    for one in angles:
        patch, mask = _rotated_patch(rotatable, float(one), scale)
        if patch.shape[0] > small.shape[0] or patch.shape[1] > small.shape[1]:
            continue
        scores = cv2.matchTemplate(small, patch, cv2.TM_CCOEFF_NORMED, mask=mask)
        scores[~np.isfinite(scores) | (np.abs(scores) > 1.001)] = -1
        _, score, _, (x, y) = cv2.minMaxLoc(scores)
        if score > best:
            best, angle = score, float(one)
            where = (np.array([x, y]) + (np.array(patch.shape[::-1]) - 1) / 2 + 0.5) / scale - 0.5 + low
    return None if not np.isfinite(best) else replace(predicted, centre=where, angle=angle)


def _scale(rotatable: RotatableTemplate, frame: Patch) -> float:
    """By how much pictures are reduced for searching."""
    side = min(rotatable.template.weight.shape)
    return min(
        1.0,
        max(
            SEARCH_TARGET_PX / side,
            np.sqrt(SEARCH_FRAME_PX / frame.size) if side > 2 * SEARCH_TARGET_PX else SEARCH_TARGET_PX / side,
        ),
    )


def _crop(frame: Patch, centre: Array, reach: float) -> tuple[Array, Patch]:
    """The part of a frame within reach of a centre, and where it begins."""
    if np.isinf(reach):
        return np.zeros(2), frame
    low = np.floor(centre - reach).astype(int).clip(0, np.array(frame.shape[::-1]) - 1)
    high = np.ceil(centre + reach).astype(int) + 1
    high = np.maximum(high, low + 1)
    return low.astype(np.float64), frame[low[1] : high[1], low[0] : high[0]]


def _rotated_patch(rotatable: RotatableTemplate, angle: float, scale: float) -> tuple[Patch, Patch]:
    """The picture turned and reduced, and where it is, 1 or 0."""
    corners = _corners(rotatable, Pose(np.zeros(2), angle))
    w, h = (int(v) for v in 2 * np.ceil(np.abs(corners).max(axis=1) * scale) + 1)
    x, y = (np.arange(n) - (n - 1) / 2 for n in (w, h))
    places = np.stack(np.meshgrid(x, y)).reshape(2, -1) / scale
    at = to_target_frame(places, np.zeros(2), angle) + rotatable.middle[:, None]
    shown = rotatable.weight(at) > 0
    image = cv2.GaussianBlur(rotatable.template.image.astype(np.float32), (0, 0), 0.4 / scale) if scale < 1 else None
    if image is None:
        values = np.where(shown, rotatable.read(at)[0], 0.0)
    else:
        i, j = (np.rint(q).astype(int).clip(0, n - 1) for q, n in zip(at[::-1], image.shape, strict=True))
        values = np.where(shown, image[i, j], 0.0)
    return values.reshape(h, w).astype(np.float32), shown.reshape(h, w).astype(np.float32)


# ---- the whole film


def track_rotating(
    film: Recording,
    rotatable: RotatableTemplate,
    start: Array,
    first: int,
    min_frames: float,
    progress: Progress | None = None,
) -> PoseTrack | None:
    """Track of a target whose rectangle's corner is at `start` (2,) in frame `first`; its picture is learnt from it.

    None where it is seen in fewer frames than `min_frames`, see `min_frames_if_rotating`.
    """
    start_pose, first_template = (
        _start_pose(rotatable, start),
        rotatable.with_template(without_border(rotatable.template)),
    )
    rough = _PoseTracker(film, first_template).follow(start_pose, first, progress, min_frames)
    if rough.count < min_frames:
        return None
    learnt = _learn_rotatable(film, rough, rotatable, first) or first_template
    typical_misfit = _typical_misfit(film, rough, learnt, first)
    track = _PoseTracker(film, learnt, typical_misfit).follow(
        rough.poses[first] or start_pose, first, progress, min_frames
    )
    return track if track.count >= min_frames else None


def track_known_rotating(
    film: Recording, rotatable: RotatableTemplate, start: Array, first: int, progress: Progress | None = None
) -> RawTrack:
    """The same with a picture that another film has taught."""
    start_pose = _start_pose(rotatable, start)
    rough = _PoseTracker(film, rotatable).follow(start_pose, first, progress)
    typical_misfit = _typical_misfit(film, rough, rotatable, first)
    return (
        _PoseTracker(film, rotatable, typical_misfit)
        .follow(rough.poses[first] or start_pose, first, progress)
        .to_raw_track()
    )


def _start_pose(rotatable: RotatableTemplate, start: Array) -> Pose:
    """The pose of a rectangle whose corner is at `start` (2,) px."""
    return Pose(np.asarray(start, dtype=np.float64) + rotatable.middle, 0.0, offset=rotatable.template.level)


def _typical_misfit(film: Recording, rough: PoseTrack, rotatable: RotatableTemplate, first: int) -> float:
    """Misfit of frames that show nothing but target and noise: that of the better ones."""
    found = [i for i, pose in enumerate(rough.poses) if pose is not None and i != first]
    rows = [found[k] for k in np.unique(np.linspace(0, len(found) - 1, N_MISFIT_FRAMES).astype(int))] if found else []
    poses = [refine_pose(film.frame(i), pose, rotatable) for i in rows if (pose := rough.poses[i]) is not None]
    misfit = [pose.misfit for pose in poses if pose.converged]
    return max(float(np.quantile(misfit, MISFIT_QUANTILE)), rotatable.template.min_misfit) if misfit else np.nan


def _learn_rotatable(
    film: Recording, rough: PoseTrack, rotatable: RotatableTemplate, first: int
) -> RotatableTemplate | None:
    """The picture learnt from frames spread over the film; None where these are too few to teach."""
    found = [i for i, pose in enumerate(rough.poses) if pose is not None and i != first]
    if len(found) < MIN_LEARNING_FRAMES:
        return None
    rows = [found[k] for k in np.unique(np.linspace(0, len(found) - 1, MAX_LEARNING_FRAMES).astype(int))]
    frames = [film.frame(i) for i in rows]
    poses, template = [pose for i in rows if (pose := rough.poses[i]) is not None], _low_pass(rotatable.template)
    for _ in range(ROUNDS):
        template = _learn(frames, poses, rotatable.with_template(template))
        inner = rotatable.with_template(without_border(template))
        poses = [refine_pose(frame, pose, inner) for frame, pose in zip(frames, poses, strict=True)]
    return rotatable.with_template(without_border(template))


def _low_pass(template: Template) -> Template:
    """The picture without its shortest waves: of a single frame these are mostly noise, which learning would keep."""
    frequency = [
        np.arange(n) / (2 * (side - 1 + 2 * REFLECTION_PX))
        for n, side in zip(template.coefficients.shape, template.weight.shape, strict=True)
    ]
    transmission = np.exp(-((np.hypot(frequency[0][:, None], frequency[1]) / SINGLE_FRAME_BAND) ** 4))
    return replace(template, coefficients=template.coefficients * transmission)


def _learn(frames: list[Patch], poses: list[Pose], rotatable: RotatableTemplate) -> Template:
    """The template that fits the frames best in which no more than the target is seen."""
    limit = MISFIT_RATIO * float(np.median([pose.misfit for pose in poses]))
    chosen = [(f, p) for f, p in zip(frames, poses, strict=True) if p.converged and p.misfit <= limit]
    cuts = np.stack([derotate(frame, pose, rotatable) for frame, pose in chosen])
    n = len(chosen)
    gain, offset = (np.array([getattr(pose, name) for _, pose in chosen]) for name in ("gain", "offset"))
    at_rest = np.zeros((n, 2))
    fit = SubpixelFit(
        at_rest, np.zeros(n), np.zeros((n, 3)), np.ones(n), gain, offset, np.ones(n), np.ones(n, np.bool_)
    )
    return learn_template(cuts, fit, rotatable.template)
