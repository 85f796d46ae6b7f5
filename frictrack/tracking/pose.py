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
from frictrack.tracking.correlation import Patch
from frictrack.tracking.cosine_basis import REFLECTION_PX
from frictrack.tracking.measure import MISFIT_RATIO, inlier_weights, unexplained_share
from frictrack.tracking.template import Template

SAMPLES_PER_PX = 3  # points of the table per px: cubic splines through them are off by less than 1e-4 of the contrast
MAX_STEPS = 12
STEP_TOLERANCE_PX = 1e-3  # px, the last step
CYCLE_TOLERANCE_PX = 5e-3  # px, the same where it goes to and fro, as pixels at the border come and go
MAX_REWEIGHTINGS = 4  # rounds of leaving out what does not fit
MIN_REMAINING_SHARE = 0.25  # of the pixels that must still count
MIN_TEXTURE_RATIO = 0.1  # of the mean squared slope: less is no texture
MIN_GAIN = 1e-3
MARGIN_PX = 6.0  # px round the target that are looked at
MAX_PLAIN_FIT_UNEXPLAINED = (
    0.005  # of the picture's variance, left unexplained: less is the error of a picture that was turned
)
N_UNKNOWNS = 5  # gain, offset, x, y, angle


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
    converged: bool = False


@dataclass(frozen=True, eq=False)
class RotatableTemplate:
    """The target's picture, to be read at any place."""

    template: Template
    blocked: Mask | None = None  # pixels (H, W) of the frames before which an obstacle stands

    @property
    def middle(self) -> Array:
        """Centre (x, y) of the picture, px from its upper left pixel."""
        h, w = self.template.weight.shape
        return np.array([(w - 1) / 2, (h - 1) / 2])

    def with_template(self, template: Template) -> RotatableTemplate:
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
            _sampled(n, count) for n, count in zip(self.template.weight.shape, self._n_coefficients, strict=True)
        )
        coefficients = self.template.coefficients
        return [spline_filter(rows @ coefficients @ columns.T) for rows, columns in ((y, x), (y, dx), (dy, x))]

    @property
    def _n_coefficients(self) -> tuple[int, int]:
        return self.template.coefficients.shape[0], self.template.coefficients.shape[1]

    def read(self, at: Array) -> Array:
        """Picture and slopes along x and y (3, n), DN above the template's level, at places (2, n) px."""
        places = (at[::-1] + REFLECTION_PX) * SAMPLES_PER_PX
        return np.stack([map_coordinates(t, places, order=3, prefilter=False, mode="nearest") for t in self._tables])

    def weight(self, at: Array) -> Array:
        """Weight (n,) of the picture's nearest pixels, 0 outside it."""
        h, w = self.template.weight.shape
        x, y = np.rint(at).astype(np.int64)
        inside = (x >= 0) & (x < w) & (y >= 0) & (y < h)
        return np.where(inside, self.template.weight[y.clip(0, h - 1), x.clip(0, w - 1)], 0.0)


def _sampled(n: int, count: int) -> tuple[Array, Array]:
    """Cosines of one axis and their slopes (m, count) at the points of the finer grid, which begins at -EDGE."""
    length = n - 1 + 2 * REFLECTION_PX
    q: Array = np.pi * np.arange(count, dtype=np.float64) / length
    phase: Array = q * (np.arange(int(length * SAMPLES_PER_PX) + 1)[:, None] / SAMPLES_PER_PX)
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


def to_target_frame(places: Array, centre: Array, angle: float) -> Array:
    """Places (2, n) as seen from a target at `centre` turned by `angle`: relative to its centre."""
    c, s = np.cos(angle), np.sin(angle)
    return np.asarray(np.array([[c, s], [-s, c]]) @ (places - centre[:, None]))


def refine_pose(
    frame: Patch, start: Pose, rotatable: RotatableTemplate, typical_misfit: float = np.nan, *, trusted: bool = False
) -> Pose:
    """Centre and angle of the target in a frame (H, W) from a start within about two pixels everywhere on it.

    Pixels that do not fit are left out where the residuals' scatter, or the `typical_misfit` of a frame that holds
    nothing but target and noise, shows that there are some. A start that is `trusted` may speak against most pixels.
    """
    window = _Window.around(frame, start.centre, rotatable.radius + MARGIN_PX, rotatable.blocked)
    if window.pixels.size < N_UNKNOWNS:
        return start
    pose = _fit_pose(window, start, rotatable, None)
    if not (pose.converged or trusted):
        return pose
    level = _noise_misfit(window, pose if pose.converged else start, rotatable, typical_misfit)
    if pose.converged and pose.misfit < MISFIT_RATIO * level:
        return pose
    robust = _refine_robust(window, start, rotatable, level)
    if not robust.converged and pose.converged:  # the start was too far off to say what fits; this pose is near
        robust = _refine_robust(window, pose, rotatable, _noise_misfit(window, pose, rotatable, np.nan))
    if not robust.converged:
        return pose
    agree = pose.converged and unexplained_share(pose.score, pose.misfit, level) < MAX_PLAIN_FIT_UNEXPLAINED
    return _widen_sigma(pose, robust) if agree else robust


def _noise_misfit(window: _Window, pose: Pose, rotatable: RotatableTemplate, typical_misfit: float) -> float:
    """Misfit of pixels that show nothing but target and noise, as the better half of them have it."""
    standardised, slopes = _standardised_residuals(window, pose, rotatable)
    textured = _textured(slopes)
    level = max(_residual_scale(standardised[textured]) ** 2 if textured.any() else 0.0, rotatable.template.min_misfit)
    return level if np.isnan(typical_misfit) else min(level, typical_misfit)


def _widen_sigma(pose: Pose, other: Pose) -> Pose:
    """A pose whose deviations hold how far another one, from some of the pixels, is away."""
    x, y = other.centre - pose.centre
    sigma = np.hypot(pose.sigma, (x, y, other.angle - pose.angle))
    return replace(pose, sigma=(float(sigma[0]), float(sigma[1]), float(sigma[2])))


def _residual_scale(standardised: Array) -> float:
    """Standard deviation of residuals, from their median: what hides less than half of the target does not count."""
    return 1.4826 * float(np.median(np.abs(standardised)))


def _fit_pose(window: _Window, start: Pose, rotatable: RotatableTemplate, share: Array | None) -> Pose:
    """Gauss-Newton; `share` (h w,) is the share of its weight that each pixel keeps."""
    pose, step = start, np.inf
    for _ in range(MAX_STEPS):
        pose, step = _step(window, pose, rotatable, share)
        if not np.isfinite(step) or np.max(np.abs(pose.centre - start.centre)) > 6:
            return replace(pose, converged=False)
        if step < STEP_TOLERANCE_PX:
            break
    return replace(pose, converged=pose.gain > MIN_GAIN and step < CYCLE_TOLERANCE_PX)


def _step(window: _Window, pose: Pose, rotatable: RotatableTemplate, share: Array | None) -> tuple[Pose, float]:
    """The next pose, and how far any of the target's points moves, px."""
    columns, weight = _columns(window, pose, rotatable)
    if share is not None:
        weight = weight * share
    use = weight > 0
    if np.count_nonzero(use) < 4 * N_UNKNOWNS:
        return pose, np.inf
    design, values, rate = columns[:, use], window.pixels.ravel()[use] - rotatable.template.level, weight[use]
    normal, right, power = (design * rate) @ design.T, (design * rate) @ values, float(values**2 @ rate)
    inverse = np.linalg.inv(normal + 1e-12 * np.trace(normal) * np.eye(N_UNKNOWNS))
    solution = inverse @ right
    gain = max(float(solution[0]), MIN_GAIN)
    move = solution[2:] / gain
    shift, turn = float(np.max(np.abs(move[:2]))), abs(float(move[2])) * rotatable.radius
    limited = move / max(1.0, shift, turn / 2)
    count = int(np.count_nonzero(use)) - N_UNKNOWNS  # positive, see above
    misfit = max(power - float(right @ solution), 0.0) / count
    x, y, angle = (np.sqrt(misfit * np.diag(inverse)[2:].clip(0)) / gain).tolist()
    next_pose = Pose(
        centre=pose.centre + limited[:2],
        angle=pose.angle + float(limited[2]),
        gain=float(solution[0]),
        offset=float(solution[1]) + rotatable.template.level,
        sigma=(x, y, angle),
        score=_score(normal, right, power),
        misfit=misfit,
    )
    return next_pose, shift + turn


def _columns(window: _Window, pose: Pose, rotatable: RotatableTemplate) -> tuple[Array, Array]:
    """Gain, offset, x, y and angle: what they change in the pixels (5, n), over the gain; and the weights (n,)."""
    target_points = to_target_frame(window.places, pose.centre, pose.angle)
    at = target_points + rotatable.middle[:, None]
    weight = rotatable.weight(at)
    if window.free is not None:
        weight = weight * window.free
    columns = np.zeros((N_UNKNOWNS, weight.size))
    use = weight > 0
    value, dx, dy = rotatable.read(at[:, use])
    c, s = np.cos(pose.angle), np.sin(pose.angle)
    columns[0, use], columns[1] = value, 1.0
    columns[2, use], columns[3, use] = -(c * dx - s * dy), -(s * dx + c * dy)
    columns[4, use] = dx * target_points[1, use] - dy * target_points[0, use]
    return columns, weight


def _score(normal: Array, right: Array, power: float) -> float:
    """Weighted zero-normalised cross-correlation."""
    n = max(normal[1, 1], 1e-300)
    both = right[0] - right[1] * normal[0, 1] / n
    frame, model = power - right[1] ** 2 / n, normal[0, 0] - normal[0, 1] ** 2 / n
    return float(np.clip(both / np.sqrt(max(frame * model, 1e-300)), -1, 1))


def _refine_robust(window: _Window, start: Pose, rotatable: RotatableTemplate, typical_misfit: float) -> Pose:
    """The pose from pixels that fit the start, then each better pose.

    What is left must hold enough of the slopes that tell the pose: a plain background fits anywhere.
    """
    pose, share = start, np.ones(window.pixels.size)
    for k in range(MAX_REWEIGHTINGS):
        standardised, slopes = _standardised_residuals(window, pose, rotatable)
        inside = slopes > 0
        scale = (
            2 * np.sqrt(typical_misfit) if k == 0 else _residual_scale(standardised[(share > 0.5) & _textured(slopes)])
        )
        share = _inlier_share(window, standardised / max(scale, 1e-6), inside)
        if share @ slopes < MIN_REMAINING_SHARE * np.sum(slopes):
            return replace(pose, converged=False)
        next_pose = _fit_pose(window, pose, rotatable, share)
        if not next_pose.converged:
            return next_pose
        pose = next_pose
    return pose


def _standardised_residuals(window: _Window, pose: Pose, rotatable: RotatableTemplate) -> tuple[Array, Array]:
    """What the target does not explain (n,), in standard deviations of the template's noise; and its squared slopes.

    The slopes are 0 outside the target, and only there.
    """
    columns, weight = _columns(window, pose, rotatable)
    residual = window.pixels.ravel() - pose.offset - pose.gain * columns[0]
    slopes = np.where(weight > 0, np.maximum(weight * (columns[2] ** 2 + columns[3] ** 2), 1e-300), 0.0)
    return np.where(weight > 0, residual * np.sqrt(weight), 0.0), slopes


def _textured(slopes: Array) -> Mask:
    """Pixels (n,) that would not fit at a wrong pose: a plain background fits anywhere."""
    return np.asarray(slopes > MIN_TEXTURE_RATIO * np.mean(slopes))


def _inlier_share(window: _Window, standardised: Array, inside: Mask) -> Array:
    shape = (1, *window.pixels.shape)
    solution: Array = inlier_weights(
        standardised.reshape(shape).astype(np.float32), inside.reshape(shape).astype(np.float32)
    )
    return solution.ravel() * inside


def derotate(frame: Patch, pose: Pose, rotatable: RotatableTemplate) -> NDArray[np.float32]:
    """The frame as the target's picture (h, w) would show it without its turn; to learn from, not to measure.

    Only what the picture known so far does not explain is interpolated: it is small, and so is the error of that.
    """
    window = _Window.around(frame, pose.centre, rotatable.radius + MARGIN_PX, rotatable.blocked)
    at = to_target_frame(window.places, pose.centre, pose.angle) + rotatable.middle[:, None]
    template = rotatable.template
    h, w = template.weight.shape
    visible = np.all((at > -REFLECTION_PX) & (at < np.array([[w], [h]]) - 1 + REFLECTION_PX), axis=0)
    residual = window.pixels.ravel() - pose.offset - pose.gain * rotatable.read(at)[0]
    visible = visible if window.free is None else visible & window.free
    residual = np.where(visible, residual, 0.0).reshape(window.pixels.shape)
    y, x = np.mgrid[:h, :w].reshape(2, -1).astype(np.float64)
    target_points = np.stack([x, y]) - rotatable.middle[:, None]
    frame_points = (
        to_target_frame(target_points, np.zeros(2), -pose.angle) + pose.centre[:, None] - window.places[:, :1]
    )
    residual_in_target = map_coordinates(residual, frame_points[::-1], order=5, mode="nearest").reshape(h, w)
    return np.asarray(
        pose.offset + pose.gain * (template.image - template.level) + residual_in_target, dtype=np.float32
    )
