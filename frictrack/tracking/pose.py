"""Place and angle of a target that turns by any angle: weighted least squares on frames that are never interpolated.

A frame is I(u) = b + a T(R(-theta) (u - c)) + noise, with T the target's picture about its centre. T, a sum of cosines,
is tabulated on a finer grid, from which cubic splines read it and its slopes at the pixels of the frame: only the
picture is turned, so that the frame's noise stays white and the estimate at the Cramer-Rao bound.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates, spline_filter

from frictrack.records import Array, Mask
from frictrack.tracking.match import Patch
from frictrack.tracking.measure import MISFITS, fits, unexplained
from frictrack.tracking.template import Template
from frictrack.tracking.waves import EDGE

FINE = 3  # points of the table per px: cubic splines through them are off by less than 1e-4 of the contrast
STEPS = 12
SETTLED = 1e-3  # px, the last step
CYCLES = 5e-3  # px, the same where it goes to and fro, as pixels at the border come and go
AGAIN = 4  # rounds of leaving out what does not fit
LEAST_LEFT = 0.25  # of the pixels that must still count
PLAIN = 0.1  # of the mean squared slope: less is no texture
LEAST_GAIN = 1e-3
MARGIN = 6.0  # px round the target that are looked at
ODD_SHARE = 0.005  # of the picture's variance, left unexplained: less is the error of a picture that was turned
UNKNOWNS = 5  # gain, offset, x, y, angle


@dataclass(frozen=True)
class Pose:
    """Where a target is in one frame: its centre (2,) px and its angle, rad from x toward y; and what that is worth."""

    centre: Array
    angle: float
    gain: float = 1.0
    offset: float = 0.0  # DN
    sigma: tuple[float, float, float] = (np.nan, np.nan, np.nan)  # px, px, rad
    score: float = -1.0
    misfit: float = np.inf
    settled: bool = False


@dataclass(frozen=True, eq=False)
class TurnedPicture:
    """The target's picture, to be read at any place."""

    template: Template
    blocked: Mask | None = None  # pixels (H, W) of the frames before which an obstacle stands

    @property
    def middle(self) -> Array:
        """Centre (x, y) of the picture, px from its upper left pixel."""
        h, w = self.template.weight.shape
        return np.array([(w - 1) / 2, (h - 1) / 2])

    def showing(self, template: Template) -> TurnedPicture:
        """The same with another template."""
        return replace(self, template=template)

    @property
    def radius(self) -> float:
        """Half of its diagonal, px."""
        return float(np.hypot(*self.middle))

    @cached_property
    def _tables(self) -> list[Array]:
        """Spline coefficients of the picture and of its slopes along x and y."""
        (y, dy), (x, dx) = (
            _sampled(n, count) for n, count in zip(self.template.weight.shape, self._waves, strict=True)
        )
        waves = self.template.waves
        return [spline_filter(rows @ waves @ columns.T) for rows, columns in ((y, x), (y, dx), (dy, x))]

    @property
    def _waves(self) -> tuple[int, int]:
        return self.template.waves.shape[0], self.template.waves.shape[1]

    def read(self, at: Array) -> Array:
        """Picture and slopes along x and y (3, n), DN above the template's level, at places (2, n) px."""
        places = (at[::-1] + EDGE) * FINE
        return np.stack([map_coordinates(t, places, order=3, prefilter=False, mode="nearest") for t in self._tables])

    def weight(self, at: Array) -> Array:
        """Weight (n,) of the picture's nearest pixels, 0 outside it."""
        h, w = self.template.weight.shape
        x, y = np.rint(at).astype(np.int64)
        inside = (x >= 0) & (x < w) & (y >= 0) & (y < h)
        return np.where(inside, self.template.weight[y.clip(0, h - 1), x.clip(0, w - 1)], 0.0)


def _sampled(n: int, count: int) -> tuple[Array, Array]:
    """Cosines of one axis and their slopes (m, count) at the points of the finer grid, which begins at -EDGE."""
    length = n - 1 + 2 * EDGE
    q: Array = np.pi * np.arange(count, dtype=np.float64) / length
    phase: Array = q * (np.arange(int(length * FINE) + 1)[:, None] / FINE)
    return np.asarray(np.cos(phase)), np.asarray(-q * np.sin(phase))


@dataclass(frozen=True, eq=False)
class _Window:
    """The part of a frame that may show the target: its pixels (h, w) and their places (2, h w)."""

    pixels: Patch
    places: Array
    free: Mask | None  # (h w,) where no obstacle stands; None for everywhere

    @classmethod
    def around(cls, frame: Patch, centre: Array, reach: float, blocked: Mask | None) -> _Window:
        """What lies within `reach` px of a centre."""
        low = np.floor(centre - reach).astype(int).clip(0)
        high = np.minimum(np.ceil(centre + reach).astype(int) + 1, frame.shape[::-1])
        x, y = (np.arange(a, max(b, a)) for a, b in zip(low, high, strict=True))
        part = (slice(y[0], y[-1] + 1), slice(x[0], x[-1] + 1)) if len(x) and len(y) else (slice(0), slice(0))
        places = np.stack(np.meshgrid(x, y)).reshape(2, -1).astype(np.float64)
        return cls(frame[part].astype(np.float64), places, None if blocked is None else ~blocked[part].ravel())


def turned_back(places: Array, centre: Array, angle: float) -> Array:
    """Places (2, n) as seen from a target at `centre` turned by `angle`: relative to its centre."""
    c, s = np.cos(angle), np.sin(angle)
    return np.asarray(np.array([[c, s], [-s, c]]) @ (places - centre[:, None]))


def refine_pose(
    frame: Patch, start: Pose, picture: TurnedPicture, usual: float = np.nan, *, trusted: bool = False
) -> Pose:
    """Centre and angle of the target in a frame (H, W) from a start within about two pixels everywhere on it.

    Pixels that do not fit are left out where the residuals' scatter, or the `usual` misfit of a frame that holds
    nothing but target and noise, shows that there are some. A start that is `trusted` may speak against most pixels.
    """
    window = _Window.around(frame, start.centre, picture.radius + MARGIN, picture.blocked)
    if window.pixels.size < UNKNOWNS:
        return start
    pose = _fitted(window, start, picture, None)
    if not (pose.settled or trusted):
        return pose
    level = _noise(window, pose if pose.settled else start, picture, usual)
    if pose.settled and pose.misfit < MISFITS * level:
        return pose
    robust = _without_what_does_not_fit(window, start, picture, level)
    if not robust.settled and pose.settled:  # the start was too far off to say what fits; this pose is near
        robust = _without_what_does_not_fit(window, pose, picture, _noise(window, pose, picture, np.nan))
    if not robust.settled:
        return pose
    agrees = pose.settled and unexplained(pose.score, pose.misfit, level) < ODD_SHARE
    return _doubted(pose, robust) if agrees else robust


def _noise(window: _Window, pose: Pose, picture: TurnedPicture, usual: float) -> float:
    """Misfit of pixels that show nothing but target and noise, as the better half of them have it."""
    rated, slopes = _rated(window, pose, picture)
    tells = _textured(slopes)
    level = max(_scale(rated[tells]) ** 2 if tells.any() else 0.0, picture.template.least_misfit)
    return level if np.isnan(usual) else min(level, usual)


def _doubted(pose: Pose, other: Pose) -> Pose:
    """A pose whose deviations hold how far another one, from some of the pixels, is away."""
    x, y = other.centre - pose.centre
    sigma = np.hypot(pose.sigma, (x, y, other.angle - pose.angle))
    return replace(pose, sigma=(float(sigma[0]), float(sigma[1]), float(sigma[2])))


def _scale(rated: Array) -> float:
    """Standard deviation of residuals, from their median: what hides less than half of the target does not count."""
    return 1.4826 * float(np.median(np.abs(rated)))


def _fitted(window: _Window, start: Pose, picture: TurnedPicture, share: Array | None) -> Pose:
    """Gauss-Newton; `share` (h w,) is the share of its weight that each pixel keeps."""
    pose, step = start, np.inf
    for _ in range(STEPS):
        pose, step = _step(window, pose, picture, share)
        if not np.isfinite(step) or np.max(np.abs(pose.centre - start.centre)) > 6:
            return replace(pose, settled=False)
        if step < SETTLED:
            break
    return replace(pose, settled=pose.gain > LEAST_GAIN and step < CYCLES)


def _step(window: _Window, pose: Pose, picture: TurnedPicture, share: Array | None) -> tuple[Pose, float]:
    """The next pose, and how far any of the target's points moves, px."""
    columns, weight = _columns(window, pose, picture)
    if share is not None:
        weight = weight * share
    use = weight > 0
    if np.count_nonzero(use) < 4 * UNKNOWNS:
        return pose, np.inf
    design, values, rate = columns[:, use], window.pixels.ravel()[use] - picture.template.level, weight[use]
    normal, right, power = (design * rate) @ design.T, (design * rate) @ values, float(values**2 @ rate)
    inverse = np.linalg.inv(normal + 1e-12 * np.trace(normal) * np.eye(UNKNOWNS))
    found = inverse @ right
    gain = max(float(found[0]), LEAST_GAIN)
    move = found[2:] / gain
    shift, turn = float(np.max(np.abs(move[:2]))), abs(float(move[2])) * picture.radius
    limited = move / max(1.0, shift, turn / 2)
    count = int(np.count_nonzero(use)) - UNKNOWNS  # positive, see above
    misfit = max(power - float(right @ found), 0.0) / count
    x, y, angle = (np.sqrt(misfit * np.diag(inverse)[2:].clip(0)) / gain).tolist()
    better = Pose(
        centre=pose.centre + limited[:2],
        angle=pose.angle + float(limited[2]),
        gain=float(found[0]),
        offset=float(found[1]) + picture.template.level,
        sigma=(x, y, angle),
        score=_score(normal, right, power),
        misfit=misfit,
    )
    return better, shift + turn


def _columns(window: _Window, pose: Pose, picture: TurnedPicture) -> tuple[Array, Array]:
    """Gain, offset, x, y and angle: what they change in the pixels (5, n), over the gain; and the weights (n,)."""
    seen = turned_back(window.places, pose.centre, pose.angle)
    at = seen + picture.middle[:, None]
    weight = picture.weight(at)
    if window.free is not None:
        weight = weight * window.free
    columns = np.zeros((UNKNOWNS, weight.size))
    use = weight > 0
    value, dx, dy = picture.read(at[:, use])
    c, s = np.cos(pose.angle), np.sin(pose.angle)
    columns[0, use], columns[1] = value, 1.0
    columns[2, use], columns[3, use] = -(c * dx - s * dy), -(s * dx + c * dy)
    columns[4, use] = dx * seen[1, use] - dy * seen[0, use]
    return columns, weight


def _score(normal: Array, right: Array, power: float) -> float:
    """Weighted zero-normalised cross-correlation."""
    n = max(normal[1, 1], 1e-300)
    both = right[0] - right[1] * normal[0, 1] / n
    frame, model = power - right[1] ** 2 / n, normal[0, 0] - normal[0, 1] ** 2 / n
    return float(np.clip(both / np.sqrt(max(frame * model, 1e-300)), -1, 1))


def _without_what_does_not_fit(window: _Window, start: Pose, picture: TurnedPicture, usual: float) -> Pose:
    """The pose from pixels that fit the start, then each better pose.

    What is left must hold enough of the slopes that tell the pose: a plain background fits anywhere.
    """
    pose, share = start, np.ones(window.pixels.size)
    for k in range(AGAIN):
        rated, slopes = _rated(window, pose, picture)
        given = slopes > 0
        scale = 2 * np.sqrt(usual) if k == 0 else _scale(rated[(share > 0.5) & _textured(slopes)])
        share = _fit_share(window, rated / max(scale, 1e-6), given)
        if share @ slopes < LEAST_LEFT * np.sum(slopes):
            return replace(pose, settled=False)
        better = _fitted(window, pose, picture, share)
        if not better.settled:
            return better
        pose = better
    return pose


def _rated(window: _Window, pose: Pose, picture: TurnedPicture) -> tuple[Array, Array]:
    """What the target does not explain (n,), in standard deviations of the template's noise; and its squared slopes.

    The slopes are 0 outside the target, and only there.
    """
    columns, weight = _columns(window, pose, picture)
    left = window.pixels.ravel() - pose.offset - pose.gain * columns[0]
    slopes = np.where(weight > 0, np.maximum(weight * (columns[2] ** 2 + columns[3] ** 2), 1e-300), 0.0)
    return np.where(weight > 0, left * np.sqrt(weight), 0.0), slopes


def _textured(slopes: Array) -> Mask:
    """Pixels (n,) that would not fit at a wrong pose: a plain background fits anywhere."""
    return np.asarray(slopes > PLAIN * np.mean(slopes))


def _fit_share(window: _Window, rated: Array, given: Mask) -> Array:
    shape = (1, *window.pixels.shape)
    found: Array = fits(rated.reshape(shape).astype(np.float32), given.reshape(shape).astype(np.float32))
    return found.ravel() * given


def derotated(frame: Patch, pose: Pose, picture: TurnedPicture) -> NDArray[np.float32]:
    """The frame as the target's picture (h, w) would show it without its turn; to learn from, not to measure.

    Only what the picture known so far does not explain is interpolated: it is small, and so is the error of that.
    """
    window = _Window.around(frame, pose.centre, picture.radius + MARGIN, picture.blocked)
    at = turned_back(window.places, pose.centre, pose.angle) + picture.middle[:, None]
    template = picture.template
    h, w = template.weight.shape
    shown = np.all((at > -EDGE) & (at < np.array([[w], [h]]) - 1 + EDGE), axis=0)
    left = window.pixels.ravel() - pose.offset - pose.gain * picture.read(at)[0]
    shown = shown if window.free is None else shown & window.free
    left = np.where(shown, left, 0.0).reshape(window.pixels.shape)
    y, x = np.mgrid[:h, :w].reshape(2, -1).astype(np.float64)
    seen = np.stack([x, y]) - picture.middle[:, None]
    back = turned_back(seen, np.zeros(2), -pose.angle) + pose.centre[:, None] - window.places[:, :1]
    rest = map_coordinates(left, back[::-1], order=5, mode="nearest").reshape(h, w)
    return np.asarray(pose.offset + pose.gain * (template.image - template.level) + rest, dtype=np.float32)
