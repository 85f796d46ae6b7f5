"""Follow a target that turns by any angle: predict, refine; where that fails, match a bank of turned pictures.

Only films in which the target turns too far for the small rotations of `refine` come this way (`turns`).
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
from frictrack.tracking.follow import FLAT, LEAST_SCORE, LEAVES, NOISIER, SHARE, UNREAD, UNSETTLED, Followed, nowhere
from frictrack.tracking.hidden import HIDDEN, HIDDEN_SHARE
from frictrack.tracking.learn import learn, without_border
from frictrack.tracking.match import Patch
from frictrack.tracking.measure import MISFITS, unexplained
from frictrack.tracking.pose import Pose, TurnedPicture, derotated, refine_pose, turned_back
from frictrack.tracking.refine import Fine
from frictrack.tracking.template import Template
from frictrack.tracking.waves import EDGE

Progress = Callable[[int, int, str], None]

FASTEST = np.radians(25.0)  # rad a frame
REACH = 24  # px searched round the prediction
NEAR = 0.8  # of the usual score: a match near the prediction that is as good ends the search
SMALL, LARGE = 20, 400_000  # px of a target's shorter side, and of a picture, to which they are reduced for searching
NEARBY = 3  # frames from the last find, over which a prediction is trusted
LEAST_SHOWN = 0.8  # of the target's rectangle that must lie within the picture
FORGOTTEN = 8  # frames without a find after which the whole picture is searched in every eighth frame only
MIN_FRAMES, TEACHING = 24, 60  # frames that teach the picture, at least and at most
SMOOTH = 0.25  # cycles/px, beyond which a single frame does not tell the picture
ROUNDS = 3  # of learning the picture and measuring those frames again
JUDGED, CLEAR = 24, 0.1  # frames whose misfit is the usual one: this quantile of it, as many may be partly hidden


@dataclass(frozen=True, eq=False)
class TurnedTrack:
    """Poses of the target, frame by frame, None where it was not found, and why (n,)."""

    poses: list[Pose | None]
    reason: NDArray[np.object_]
    template: Template

    @property
    def count(self) -> int:
        """Frames in which the target was found."""
        return sum(pose is not None for pose in self.poses)

    def as_followed(self) -> Followed:
        """The same as a track of the rectangle's upper left corner; the rectangle itself does not turn."""
        out = nowhere(len(self.poses))
        out.reason[:] = self.reason
        middle = TurnedPicture(self.template).middle
        for i, pose in enumerate(self.poses):
            if pose is None:
                continue
            at = pose.centre - middle
            out.corner[i] = np.rint(at)
            row = Fine(
                (at - out.corner[i])[None], *(np.array([q]) for q in (pose.angle, pose.sigma, pose.score)),
                *(np.array([q]) for q in (pose.gain, pose.offset, pose.misfit, pose.settled)),
            )  # fmt: skip
            out.fine.put(np.array([i]), row)
        return out


class _Turning:
    """Follows one turning target through a film."""

    def __init__(self, film: Recording, picture: TurnedPicture, usual: float = np.nan) -> None:
        self.film, self.picture, self.misfit = film, picture, usual
        self.score, self.missable = 1.0, np.inf

    def follow(self, start: Pose, first: int, progress: Progress | None = None, least: float = 0.0) -> TurnedTrack:
        """All frames, both ways from frame `first`, in which the target is at `start`.

        It ends where `least` frames can no longer be reached.
        """
        n = self.film.n_frames
        self.missable = n - least
        track = TurnedTrack([None] * n, np.full(n, UNREAD, dtype=object), self.picture.template)
        for frames in (range(first, n), range(first - 1, -1, -1)):
            self._follow_frames(frames, start, track, progress)
        return track

    def _follow_frames(self, frames: range, start: Pose, track: TurnedTrack, progress: Progress | None) -> None:
        known: list[tuple[int, Pose]] = [(frames.start - frames.step, start)] if len(frames) else []
        for done, i in enumerate(frames):
            if progress and done % 16 == 0:
                progress(done, len(frames), "follow the turning target")
            try:
                frame = self.film.frame(i)
            except FrictrackError:
                continue
            if self.missable < 0:
                return
            pose, reason = self._found(frame, i, known)
            self.missable -= pose is None
            gone = pose is None and i != frames.start and track.reason[i - frames.step] == LEAVES
            track.reason[i] = LEAVES if gone else reason
            if pose is not None:
                track.poses[i] = pose
                known = [*known[-1:], (i, pose)]
                self.score = 0.9 * self.score + 0.1 * pose.score

    def _found(self, frame: Patch, i: int, known: list[tuple[int, Pose]]) -> tuple[Pose | None, str]:
        """The target's pose in frame `i`, or why there is none."""
        if frame.min() == frame.max():
            return None, FLAT
        predicted = _predicted(i, known)
        trusted = len(known) > 1 and abs(i - known[-1][0]) <= NEARBY
        pose = refine_pose(frame, predicted, self.picture, self.misfit, trusted=trusted)
        if not self._good(pose):
            age = abs(i - known[-1][0])
            everywhere = age <= FORGOTTEN or i % FORGOTTEN == 0
            searched = search_pose(frame, predicted, self.picture, self.score, everywhere=everywhere, usual=self.misfit)
            pose = searched if searched is not None and searched.score > pose.score - 0.02 else pose
        if self._shown(pose if self._good(pose) else predicted, frame) < LEAST_SHOWN:
            return None, LEAVES
        if self._good(pose):
            return pose, self._trusted(pose)
        return None, UNSETTLED if pose.score >= self._least else f"match score {pose.score:.2f} below {self._least:.2f}"

    @property
    def _least(self) -> float:
        return max(LEAST_SCORE, SHARE * self.score)

    def _good(self, pose: Pose) -> bool:
        return pose.settled and pose.score >= self._least

    def _trusted(self, pose: Pose) -> str:
        """Why the pose cannot be trusted; empty where it can."""
        if np.isnan(self.misfit) or pose.misfit < NOISIER * self.misfit:
            return ""
        return HIDDEN if unexplained(pose.score, pose.misfit, self.misfit) > HIDDEN_SHARE else ""

    def _shown(self, pose: Pose, frame: Patch) -> float:
        """Share of the target's rectangle that lies within the picture."""
        x, y = self.picture.middle
        grid = np.stack(np.meshgrid(np.linspace(-x, x, 9), np.linspace(-y, y, 9))).reshape(2, -1)
        at = turned_back(grid, np.zeros(2), -pose.angle) + pose.centre[:, None]
        return float(np.mean(np.all((at > -0.5) & (at < np.array(frame.shape[::-1])[:, None] - 0.5), axis=0)))


def _corners(picture: TurnedPicture, pose: Pose) -> Array:
    """Corners (2, 4) of the turned rectangle."""
    x, y = picture.middle
    return turned_back(np.array([[-x, x, x, -x], [-y, -y, y, y]]), np.zeros(2), -pose.angle) + pose.centre[:, None]


def _predicted(i: int, known: list[tuple[int, Pose]]) -> Pose:
    """The pose in frame `i` by the velocity between the last two, where these are neighbours."""
    frame, last = known[-1]
    if len(known) < 2 or abs(frame - known[-2][0]) > 2 or abs(i - frame) > FORGOTTEN:
        return last
    ahead = (i - frame) / (frame - known[-2][0])
    before = known[-2][1]
    return replace(
        last,
        centre=last.centre + ahead * (last.centre - before.centre),
        angle=last.angle + ahead * (last.angle - before.angle),
    )


# ---- searching


def search_pose(
    frame: Patch,
    predicted: Pose,
    picture: TurnedPicture,
    usual_score: float,
    *,
    everywhere: bool = True,
    usual: float = np.nan,
) -> Pose | None:
    """The best pose near a prediction; anywhere where none is good; at any angle where that fails too."""
    step = 2.0 / picture.radius
    slow = predicted.angle + np.arange(-FASTEST, FASTEST + step / 2, step)
    rounds = [(slow, REACH), (slow, 0), (predicted.angle + np.arange(0, 2 * np.pi, step), 0)]
    best: Pose | None = None
    for angles, reach in rounds if everywhere else rounds[:1]:
        start = _matched(frame, predicted, picture, angles, reach)
        found = None if start is None else _polished(frame, start, picture, usual)
        if found is not None and (best is None or (found.settled, found.score) > (best.settled, best.score)):
            best = found
        if best is not None and best.settled and best.score >= NEAR * usual_score:
            break
    return best


def _polished(frame: Patch, start: Pose, picture: TurnedPicture, usual: float) -> Pose:
    """The pose from a rough match, whose own misfit says which pixels fit, then from a good start by the usual one."""
    rough = refine_pose(frame, start, picture, trusted=True)
    if np.isnan(usual) or not rough.settled:
        return rough
    return refine_pose(frame, rough, picture, usual, trusted=True)


def _matched(frame: Patch, predicted: Pose, picture: TurnedPicture, angles: Array, reach: int) -> Pose | None:
    """The best match of the picture turned by some angles, within `reach` px of a prediction, or anywhere for 0."""
    scale = _scale(picture, frame)
    low, part = _part(frame, predicted.centre, picture.radius + reach if reach else np.inf)
    small = cv2.resize(part.astype(np.float32), None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    best, where, angle = -np.inf, np.zeros(2), 0.0
    for one in angles:
        patch, mask = _turned_patch(picture, float(one), scale)
        if patch.shape[0] > small.shape[0] or patch.shape[1] > small.shape[1]:
            continue
        scores = cv2.matchTemplate(small, patch, cv2.TM_CCOEFF_NORMED, mask=mask)
        scores[~np.isfinite(scores) | (np.abs(scores) > 1.001)] = -1
        _, score, _, (x, y) = cv2.minMaxLoc(scores)
        if score > best:
            best, angle = score, float(one)
            where = (np.array([x, y]) + (np.array(patch.shape[::-1]) - 1) / 2 + 0.5) / scale - 0.5 + low
    return None if not np.isfinite(best) else replace(predicted, centre=where, angle=angle)


def _scale(picture: TurnedPicture, frame: Patch) -> float:
    """By how much pictures are reduced for searching."""
    side = min(picture.template.weight.shape)
    return min(1.0, max(SMALL / side, np.sqrt(LARGE / frame.size) if side > 2 * SMALL else SMALL / side))


def _part(frame: Patch, centre: Array, reach: float) -> tuple[Array, Patch]:
    """The part of a frame within reach of a centre, and where it begins."""
    if np.isinf(reach):
        return np.zeros(2), frame
    low = np.floor(centre - reach).astype(int).clip(0, np.array(frame.shape[::-1]) - 1)
    high = np.ceil(centre + reach).astype(int) + 1
    high = np.maximum(high, low + 1)
    return low.astype(np.float64), frame[low[1] : high[1], low[0] : high[0]]


def _turned_patch(picture: TurnedPicture, angle: float, scale: float) -> tuple[Patch, Patch]:
    """The picture turned and reduced, and where it is, 1 or 0."""
    corners = _corners(picture, Pose(np.zeros(2), angle))
    w, h = (int(v) for v in 2 * np.ceil(np.abs(corners).max(axis=1) * scale) + 1)
    x, y = (np.arange(n) - (n - 1) / 2 for n in (w, h))
    places = np.stack(np.meshgrid(x, y)).reshape(2, -1) / scale
    at = turned_back(places, np.zeros(2), angle) + picture.middle[:, None]
    shown = picture.weight(at) > 0
    image = cv2.GaussianBlur(picture.template.image.astype(np.float32), (0, 0), 0.4 / scale) if scale < 1 else None
    if image is None:
        values = np.where(shown, picture.read(at)[0], 0.0)
    else:
        i, j = (np.rint(q).astype(int).clip(0, n - 1) for q, n in zip(at[::-1], image.shape, strict=True))
        values = np.where(shown, image[i, j], 0.0)
    return values.reshape(h, w).astype(np.float32), shown.reshape(h, w).astype(np.float32)


# ---- the whole film


def follow_turning(
    film: Recording, picture: TurnedPicture, start: Array, first: int, least: float, progress: Progress | None = None
) -> TurnedTrack | None:
    """Track of a target whose rectangle's corner is at `start` (2,) in frame `first`; its picture is learnt from it.

    None where it is seen in fewer frames than `least`, see `frames_to_beat`.
    """
    begin, once = _begin(picture, start), picture.showing(without_border(picture.template))
    rough = _Turning(film, once).follow(begin, first, progress, least)
    if rough.count < least:
        return None
    learnt = _taught(film, rough, picture, first) or once
    usual = _usual_misfit(film, rough, learnt, first)
    track = _Turning(film, learnt, usual).follow(rough.poses[first] or begin, first, progress, least)
    return track if track.count >= least else None


def follow_known(
    film: Recording, picture: TurnedPicture, start: Array, first: int, progress: Progress | None = None
) -> Followed:
    """The same with a picture that another film has taught."""
    begin = _begin(picture, start)
    rough = _Turning(film, picture).follow(begin, first, progress)
    usual = _usual_misfit(film, rough, picture, first)
    return _Turning(film, picture, usual).follow(rough.poses[first] or begin, first, progress).as_followed()


def _begin(picture: TurnedPicture, start: Array) -> Pose:
    """The pose of a rectangle whose corner is at `start` (2,) px."""
    return Pose(np.asarray(start, dtype=np.float64) + picture.middle, 0.0, offset=picture.template.level)


def _usual_misfit(film: Recording, rough: TurnedTrack, picture: TurnedPicture, first: int) -> float:
    """Misfit of frames that show nothing but target and noise: that of the better ones."""
    found = [i for i, pose in enumerate(rough.poses) if pose is not None and i != first]
    rows = [found[k] for k in np.unique(np.linspace(0, len(found) - 1, JUDGED).astype(int))] if found else []
    poses = [refine_pose(film.frame(i), pose, picture) for i in rows if (pose := rough.poses[i]) is not None]
    misfit = [pose.misfit for pose in poses if pose.settled]
    return max(float(np.quantile(misfit, CLEAR)), picture.template.least_misfit) if misfit else np.nan


def _taught(film: Recording, rough: TurnedTrack, picture: TurnedPicture, first: int) -> TurnedPicture | None:
    """The picture learnt from frames spread over the film; None where these are too few to teach."""
    found = [i for i, pose in enumerate(rough.poses) if pose is not None and i != first]
    if len(found) < MIN_FRAMES:
        return None
    rows = [found[k] for k in np.unique(np.linspace(0, len(found) - 1, TEACHING).astype(int))]
    frames = [film.frame(i) for i in rows]
    poses, template = [pose for i in rows if (pose := rough.poses[i]) is not None], _smooth(picture.template)
    for _ in range(ROUNDS):
        template = _learnt(frames, poses, picture.showing(template))
        inner = picture.showing(without_border(template))
        poses = [refine_pose(frame, pose, inner) for frame, pose in zip(frames, poses, strict=True)]
    return picture.showing(without_border(template))


def _smooth(template: Template) -> Template:
    """The picture without its shortest waves: of a single frame these are mostly noise, which learning would keep."""
    frequency = [
        np.arange(n) / (2 * (side - 1 + 2 * EDGE))
        for n, side in zip(template.waves.shape, template.weight.shape, strict=True)
    ]
    passed = np.exp(-((np.hypot(frequency[0][:, None], frequency[1]) / SMOOTH) ** 4))
    return replace(template, waves=template.waves * passed)


def _learnt(frames: list[Patch], poses: list[Pose], picture: TurnedPicture) -> Template:
    """The template that fits the frames best in which no more than the target is seen."""
    limit = MISFITS * float(np.median([pose.misfit for pose in poses]))
    chosen = [(f, p) for f, p in zip(frames, poses, strict=True) if p.settled and p.misfit <= limit]
    cuts = np.stack([derotated(frame, pose, picture) for frame, pose in chosen])
    n = len(chosen)
    gain, offset = (np.array([getattr(pose, name) for _, pose in chosen]) for name in ("gain", "offset"))
    still = np.zeros((n, 2))
    fine = Fine(still, np.zeros(n), np.zeros((n, 3)), np.ones(n), gain, offset, np.ones(n), np.ones(n, np.bool_))
    return learn(cuts, fine, picture.template)
