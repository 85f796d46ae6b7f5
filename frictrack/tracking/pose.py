"""Fit position and angle of a target that rotates by any angle, by weighted least squares on uninterpolated frames.

A frame is I(u) = b + a T(R(-theta) (u - c)) + noise, with T the template about its centre. T, a sum of cosines, is
tabulated on a finer grid, from which cubic splines read values and slopes at the pixels of the frame. Only the template
is rotated, so that the noise of the frame stays white and the estimate reaches the Cramer-Rao bound.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates, spline_filter

from frictrack.base.distributions import robust_std
from frictrack.records import Array, Mask
from frictrack.tracking.correlation import Patch
from frictrack.tracking.measure import (
    MAX_REWEIGHTINGS,
    MIN_REMAINING_SHARE,
    MISFIT_RATIO,
    inlier_weights,
    unexplained_share,
)
from frictrack.tracking.subpixel_fit import MIN_GAIN, N_UNKNOWNS, NormalEquations
from frictrack.tracking.template import REFLECTION_PX, Template

SAMPLES_PER_PX = 3  # of the table: cubic splines through it err by less than 1e-4 of the contrast
MAX_STEPS = 12  # of Gauss-Newton
STEP_TOLERANCE_PX = 1e-3  # last step
CYCLE_TOLERANCE_PX = 5e-3  # last step where the iteration cycles, as pixels at the border enter and leave
MIN_TEXTURE_RATIO = 0.1  # to the mean squared slope
MARGIN_PX = 6.0  # round the target
MAX_PLAIN_FIT_UNEXPLAINED = 0.005  # share of the picture's variance; less is the error of the rotated template


@dataclass(frozen=True)
class Pose:
    """Position and angle of a target in one frame.

    Attributes
    ----------
    centre : array (2,)
        Centre (x, y) of the target, px.
    angle : float
        From the x axis toward the y axis, rad.
    gain, offset : float
        Light of the frame: grey value = gain * template + offset (DN).
    sigma : tuple of float
        Standard deviations of x, y (px) and the angle (rad).
    score : float
        Weighted zero-normalised cross-correlation.
    misfit : float
        Mean weighted squared residual; 1 where only noise remains.
    converged : bool
        Whether Gauss-Newton converged.

    """

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
    """Template that can be read at any position.

    Attributes
    ----------
    template : Template
        Template of the target.
    blocked : array of bool (H, W) or None
        Pixels of the frames that obstacles cover.

    """

    template: Template
    blocked: Mask | None = None  # pixels (H, W) of the frames before which an obstacle stands

    @property
    def middle(self) -> Array:
        """Centre (x, y) of the template, px from its upper left pixel."""
        h, w = self.template.weight.shape
        return np.array([(w - 1) / 2, (h - 1) / 2])

    def with_template(self, template: Template) -> RotatableTemplate:
        """Replace the template and keep the obstacles.

        Parameters
        ----------
        template : Template
            New template.

        Returns
        -------
        RotatableTemplate
            With its own tables.

        """
        return replace(self, template=template)

    @property
    def radius(self) -> float:
        """Half of the diagonal, px."""
        return float(np.hypot(*self.middle))

    @cached_property
    def _tables(self) -> list[Array]:
        """Spline coefficients of the template and of its slopes along x and y."""
        coefficients = self.template.coefficients
        sides = zip(self.template.weight.shape, coefficients.shape, strict=True)
        (y, dy), (x, dx) = (_sampled(n, count) for n, count in sides)
        return [spline_filter(rows @ coefficients @ columns.T) for rows, columns in ((y, x), (y, dx), (dy, x))]

    def read(self, at: Array) -> Array:
        """Read values and slopes of the template.

        Parameters
        ----------
        at : array (2, n)
            Positions (x, y) from the upper left pixel, px.

        Returns
        -------
        array (3, n)
            Value above the template's level (DN), and its slopes along x and y (DN/px).

        """
        places = (at[::-1] + REFLECTION_PX) * SAMPLES_PER_PX
        return np.stack([map_coordinates(t, places, order=3, prefilter=False, mode="nearest") for t in self._tables])

    def weight(self, at: Array) -> Array:
        """Weight of the nearest pixels of the template.

        Parameters
        ----------
        at : array (2, n)
            Positions (x, y) from the upper left pixel, px.

        Returns
        -------
        array (n,)
            1/DN^2; 0 outside the template.

        """
        h, w = self.template.weight.shape
        x, y = np.rint(at).astype(np.int64)
        inside = (x >= 0) & (x < w) & (y >= 0) & (y < h)
        return np.where(inside, self.template.weight[y.clip(0, h - 1), x.clip(0, w - 1)], 0.0)


def _sampled(n: int, count: int) -> tuple[Array, Array]:
    """Cosines of one axis and their slopes (m, count) on the finer grid, which begins at -REFLECTION_PX."""
    length = n - 1 + 2 * REFLECTION_PX
    q: Array = np.pi * np.arange(count, dtype=np.float64) / length
    phase: Array = q * (np.arange(int(length * SAMPLES_PER_PX) + 1)[:, None] / SAMPLES_PER_PX)
    return np.asarray(np.cos(phase)), np.asarray(-q * np.sin(phase))


@dataclass(frozen=True, eq=False)
class _Window:
    """Part of a frame that may show the target: its pixels (h, w) and their positions (2, h w)."""

    pixels: Patch
    places: Array
    free: Mask | None  # (h w,) where no obstacle stands; None for everywhere

    @classmethod
    def around(cls, frame: Patch, centre: Array, reach: float, blocked: Mask | None) -> _Window:
        """The part of a frame within `reach` px of a centre."""
        low = np.floor(centre - reach).astype(int).clip(0)
        high = np.minimum(np.ceil(centre + reach).astype(int) + 1, frame.shape[::-1])
        x, y = (np.arange(a, max(b, a)) for a, b in zip(low, high, strict=True))
        part = (slice(y[0], y[-1] + 1), slice(x[0], x[-1] + 1)) if len(x) and len(y) else (slice(0), slice(0))
        places = np.stack(np.meshgrid(x, y)).reshape(2, -1).astype(np.float64)
        return cls(frame[part].astype(np.float64), places, None if blocked is None else ~blocked[part].ravel())


def to_target_frame(places: Array, centre: Array, angle: float) -> Array:
    """Transform positions to the coordinates of a rotated target.

    Parameters
    ----------
    places : array (2, n)
        Positions (x, y), px.
    centre : array (2,)
        Centre of the target, px.
    angle : float
        Rotation of the target, rad.

    Returns
    -------
    array (2, n)
        Positions relative to the centre, along the axes of the target, px.

    Examples
    --------
    >>> x, y = to_target_frame(np.array([[5.0], [7.0]]), np.array([5.0, 5.0]), np.pi / 2)
    >>> round(float(x[0]), 6)
    2.0

    """
    c, s = np.cos(angle), np.sin(angle)
    return np.asarray(np.array([[c, s], [-s, c]]) @ (places - centre[:, None]))


def refine_pose(
    frame: Patch, start: Pose, rotatable: RotatableTemplate, typical_misfit: float = np.nan, *, trusted: bool = False
) -> Pose:
    """Fit position and angle of the target in a frame.

    Pixels that do not fit are excluded where the scatter of the residuals, or the typical misfit, shows that there are
    some.

    Parameters
    ----------
    frame : array (H, W)
        Grey values.
    start : Pose
        Initial pose, accurate to about two pixels everywhere on the target.
    rotatable : RotatableTemplate
        Template of the target.
    typical_misfit : float
        Misfit of a frame that shows only target and noise; NaN where it is not known.
    trusted : bool
        Whether the initial pose outweighs most of the pixels.

    Returns
    -------
    Pose
        `converged` is false where the fit failed.

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
    """Misfit of pixels that show only target and noise, from the better half of them."""
    standardised, slopes = _standardised_residuals(window, pose, rotatable)
    textured = standardised[_textured(slopes)]
    level = max(robust_std(textured) ** 2 if len(textured) else 0.0, rotatable.template.min_misfit)
    return float(level) if np.isnan(typical_misfit) else min(float(level), typical_misfit)


def _widen_sigma(pose: Pose, other: Pose) -> Pose:
    """Add the difference from another pose, fitted to some pixels, to the standard deviations."""
    x, y = other.centre - pose.centre
    sigma = np.hypot(pose.sigma, (x, y, other.angle - pose.angle))
    return replace(pose, sigma=(float(sigma[0]), float(sigma[1]), float(sigma[2])))


def _fit_pose(window: _Window, start: Pose, rotatable: RotatableTemplate, share: Array | None) -> Pose:
    """Iterate Gauss-Newton; `share` (h w,) is the share of its weight that each pixel keeps."""
    pose, step = start, np.inf
    for _ in range(MAX_STEPS):
        pose, step = _step(window, pose, rotatable, share)
        if not np.isfinite(step) or np.max(np.abs(pose.centre - start.centre)) > 6:
            return replace(pose, converged=False)
        if step < STEP_TOLERANCE_PX:
            break
    return replace(pose, converged=pose.gain > MIN_GAIN and step < CYCLE_TOLERANCE_PX)


def _step(window: _Window, pose: Pose, rotatable: RotatableTemplate, share: Array | None) -> tuple[Pose, float]:
    """Compute the next pose, and how far any point of the target moves, px."""
    columns, weight = _columns(window, pose, rotatable)
    if share is not None:
        weight = weight * share
    use = weight > 0
    if np.count_nonzero(use) < 4 * N_UNKNOWNS:
        return pose, np.inf
    design, values, rate = columns[:, use], window.pixels.ravel()[use] - rotatable.template.level, weight[use]
    products = (design * rate) @ design.T, (design * rate) @ values, values**2 @ rate
    normal, right, power = (np.asarray(one)[None] for one in products)
    found = NormalEquations(normal, right, power, int(np.count_nonzero(use)))
    move = found.moves[0]
    shift, turn = float(np.max(np.abs(move[:2]))), abs(float(move[2])) * rotatable.radius
    limited = move / max(1.0, shift, turn / 2)
    x, y, angle = found.sigma[0].tolist()
    next_pose = Pose(
        centre=pose.centre + limited[:2],
        angle=pose.angle + float(limited[2]),
        gain=float(found.coefficients[0, 0]),
        offset=float(found.coefficients[0, 1]) + rotatable.template.level,
        sigma=(x, y, angle),
        score=float(found.score[0]),
        misfit=float(found.misfit[0]),
    )
    return next_pose, shift + turn


def _columns(window: _Window, pose: Pose, rotatable: RotatableTemplate) -> tuple[Array, Array]:
    """Derivatives of the pixels (5, n) by gain, offset, x, y and angle, over the gain; and weights (n,)."""
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


def _refine_robust(window: _Window, start: Pose, rotatable: RotatableTemplate, typical_misfit: float) -> Pose:
    """Fit the pose to the pixels that agree with the start, then with each better pose.

    The remaining pixels must hold enough of the texture that determines the pose: a plain background fits anywhere.
    """
    pose, share, shape = start, np.ones(window.pixels.size), (1, *window.pixels.shape)
    for k in range(MAX_REWEIGHTINGS):
        standardised, slopes = _standardised_residuals(window, pose, rotatable)
        inside = slopes > 0
        used = standardised[(share > 0.5) & _textured(slopes)]
        scale = max(2 * np.sqrt(typical_misfit) if k == 0 else float(robust_std(used)), 1e-6)
        weights = inlier_weights(*(q.reshape(shape).astype(np.float32) for q in (standardised / scale, inside)))
        share = weights.ravel() * inside
        if share @ slopes < MIN_REMAINING_SHARE * np.sum(slopes):
            return replace(pose, converged=False)
        next_pose = _fit_pose(window, pose, rotatable, share)
        if not next_pose.converged:
            return next_pose
        pose = next_pose
    return pose


def _standardised_residuals(window: _Window, pose: Pose, rotatable: RotatableTemplate) -> tuple[Array, Array]:
    """Residuals (n,) in standard deviations of the template noise; squared slopes, 0 outside the target."""
    columns, weight = _columns(window, pose, rotatable)
    residual = window.pixels.ravel() - pose.offset - pose.gain * columns[0]
    slopes = np.where(weight > 0, np.maximum(weight * (columns[2] ** 2 + columns[3] ** 2), 1e-300), 0.0)
    return np.where(weight > 0, residual * np.sqrt(weight), 0.0), slopes


def _textured(slopes: Array) -> Mask:
    """Pixels (n,) that would not fit at a wrong pose."""
    return np.asarray(slopes > MIN_TEXTURE_RATIO * np.mean(slopes))


def derotate(frame: Patch, pose: Pose, rotatable: RotatableTemplate) -> NDArray[np.float32]:
    """Rotate a frame back to the template's orientation, to learn from it.

    Only the residual of the known template is interpolated: it is small, and so is its interpolation error.

    Parameters
    ----------
    frame : array (H, W)
        Grey values.
    pose : Pose
        Pose of the target in the frame.
    rotatable : RotatableTemplate
        Template of the target.

    Returns
    -------
    array (h, w)
        Grey values at the pixels of the template, DN.

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
