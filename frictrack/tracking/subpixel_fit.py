"""Fit position, small rotation, gain and offset of the template to frames: Gauss-Newton on a few products per frame.

With the template T known, a frame is

    I(u) = b + a [T(u - p) + theta R(u - p)] + noise        R: change per rad of rotation

Maximum likelihood for white noise is weighted least squares in a, b, p and theta. T and R at any shift are sums of
fixed pictures (`ShiftExpansion`), so that a frame enters only by its products with these pictures and by its power. The
template is shifted and not the frame (Baker & Matthews 2004, Int. J. Comput. Vis. 56:221, discuss both choices): frames
are never interpolated, their noise stays white, and the estimate reaches the Cramer-Rao bound (Pham et al. 2005,
EURASIP J. Appl. Signal Process. 2005:2199).
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from frictrack.records import Array, Mask
from frictrack.tracking.correlation import Patch
from frictrack.tracking.template import Template

MAX_STEPS = 12  # five are enough where the template fits, more where part of it is hidden
STEP_TOLERANCE_PX = 2e-3  # the next step of Gauss-Newton would be a few percent of it
N_UNKNOWNS = 5  # gain, offset, x, y, angle
MIN_GAIN = 1e-3  # a target with less is not visible
_RIDGE = 1e-9 * np.eye(N_UNKNOWNS)  # a picture without contrast has no position, which its score shows
# Reasons for which a frame has no position; the user reads them.
UNREAD = "frame cannot be read"
FLAT = "picture without contrast"
LEAVES = "target leaves the frame"
NOT_CONVERGED = "sub-pixel fit did not converge"


@dataclass(frozen=True, eq=False)
class SubpixelFit:
    """Result of the sub-pixel fit in n frames.

    Attributes
    ----------
    position : array (n, 2)
        Shift along x and y from the corner of the cut-out, px.
    angle : array (n,)
        Rotation from the x axis toward the y axis, rad.
    sigma : array (n, 3)
        Standard deviations of x, y (px) and the angle (rad): template noise times the root of the misfit.
    score : array (n,)
        Weighted zero-normalised cross-correlation.
    gain, offset : array (n,)
        Light of the frame: grey value = gain * template + offset (DN).
    misfit : array (n,)
        Mean weighted squared residual; 1 where only noise remains.
    converged : array of bool (n,)
        Whether Gauss-Newton converged to a positive gain.

    """

    position: Array
    angle: Array  # rad, x toward y
    sigma: Array  # (n, 3) of x, y (px) and the angle (rad), from the template's noise times the root of `misfit`
    score: Array
    gain: Array
    offset: Array  # DN
    misfit: Array  # mean weighted squared residual; 1 where only noise is left
    converged: Mask

    def __getitem__(self, rows: Mask | slice | np.ndarray) -> SubpixelFit:
        return SubpixelFit(*(getattr(self, f.name)[rows] for f in fields(self)))

    def moved(self, by: NDArray[Any]) -> SubpixelFit:
        """Express the positions on cut-outs whose corners lie further up and left by (n, 2) px."""
        return replace(self, position=self.position + by)

    def unrotated(self) -> Array:
        """Positions (n, 2) px that the target would have without rotation about the centre of the cut-out."""
        return self.position - _rotation_offset(self.angle, self.position)

    def put(self, rows: np.ndarray | slice, part: SubpixelFit) -> None:
        """Replace some rows."""
        for f in fields(self):
            getattr(self, f.name)[rows] = getattr(part, f.name)


@dataclass(frozen=True, eq=False)
class TemplateProducts:
    """Sufficient statistics of frames: products with the basis images.

    Attributes
    ----------
    moments : array (n, k)
        Weighted products of the frames with the basis images.
    power : array (n,)
        Weighted sums of squares of the frames.
    gram : array (k, k) or (n, k, k)
        Weighted products of the basis images; per frame where the frames have weights of their own.
    n_pixels : int or array (n,)
        Number of pixels that count.

    """

    moments: Array
    power: Array
    gram: Array
    n_pixels: Array | int

    def subset(self, rows: Mask) -> TemplateProducts:
        """Select some frames.

        Parameters
        ----------
        rows : array of bool (n,)
            Frames to keep.

        Returns
        -------
        TemplateProducts
            Products of these frames.

        """
        gram = self.gram if self.gram.ndim == 2 else self.gram[rows]
        count = self.n_pixels if np.ndim(self.n_pixels) == 0 else np.asarray(self.n_pixels)[rows]
        return TemplateProducts(self.moments[rows], self.power[rows], gram, count)


@dataclass(frozen=True, eq=False)
class NormalEquations:
    """One step of Gauss-Newton in n frames: weighted least squares in gain, offset, x, y and angle.

    Attributes
    ----------
    normal, right : arrays (n, 5, 5) and (n, 5)
        Weighted products of the derivatives of the frame by the unknowns (over the gain) with each other and with it.
    power : array (n,)
        Weighted sums of squares of the frames.
    n_pixels : int or array (n,)
        Number of pixels that count.

    """

    normal: Array
    right: Array
    power: Array
    n_pixels: Array | int

    @cached_property
    def coefficients(self) -> Array:
        """Gain, offset, and gain times the moves, (n, 5)."""
        return np.asarray(np.linalg.solve(self.normal + _RIDGE, self.right[..., None])[..., 0])

    @property
    def _gain(self) -> Array:
        return np.maximum(self.coefficients[:, :1], MIN_GAIN)

    @property
    def moves(self) -> Array:
        """Moves along x and y, px, and rotation, rad, (n, 3)."""
        return self.coefficients[:, 2:] / self._gain

    @property
    def misfit(self) -> Array:
        """Mean weighted squared residual, (n,)."""
        residual_power = np.maximum(self.power - np.einsum("ni,ni->n", self.coefficients, self.right), 0.0)
        return np.asarray(residual_power / np.maximum(self.n_pixels - N_UNKNOWNS, 1))

    @property
    def sigma(self) -> Array:
        """Standard deviations of the moves, (n, 3): template noise times the root of the misfit."""
        variance = np.diagonal(np.linalg.inv(self.normal + _RIDGE), axis1=1, axis2=2)[:, 2:]
        return np.asarray(np.sqrt(self.misfit[:, None] * np.maximum(variance, 0.0)) / self._gain)

    @property
    def score(self) -> Array:
        """Weighted zero-normalised cross-correlation (n,) of the frames with the template."""
        normal, right = self.normal, self.right
        weight = np.maximum(normal[:, 1, 1], 1e-12)
        both = right[:, 0] - right[:, 1] * normal[:, 0, 1] / weight
        frame = self.power - right[:, 1] ** 2 / weight
        picture = normal[:, 0, 0] - normal[:, 0, 1] ** 2 / weight
        # The variance of a flat frame or template is a rounding error and must not give a score.
        size = np.maximum(frame, 1e-9 * self.power) * np.maximum(picture, 1e-9 * normal[:, 0, 0])
        return np.clip(both / np.sqrt(np.maximum(size, 1e-12)), -1.0, 1.0)


def template_products(cuts: Patch, template: Template, share: Patch | None = None) -> TemplateProducts:
    """Multiply cut-outs by the basis images of a template.

    Parameters
    ----------
    cuts : array (n, h, w)
        Grey values.
    template : Template
        Template of the same size.
    share : array (n, h, w), optional
        Share of its weight that each pixel keeps in each frame, 0 to 1; 1 by default.

    Returns
    -------
    TemplateProducts
        All that the sub-pixel fit needs of the frames.

    """
    pixels = template.weighted(cuts)
    if share is None:
        power = np.einsum("ij,ij->i", pixels, pixels)
        return TemplateProducts(
            (pixels @ template.filters).astype(float), power.astype(float), template.gram, template.n_pixels
        )
    kept_share = share.reshape(len(cuts), -1).astype(np.float32)
    moments, power, gram = [], [], []
    for frame, keep in zip(pixels, kept_share, strict=True):
        filters = template.filters * keep[:, None]
        moments.append(frame @ filters)
        power.append((frame * keep) @ frame)
        gram.append(template.filters.T @ filters)
    moved, powers, grams = (np.asarray(v, dtype=np.float64) for v in (moments, power, gram))
    return TemplateProducts(
        moved, powers, grams, np.asarray(kept_share @ (template.weight.ravel() > 0), dtype=np.float64)
    )


def refine_positions(data: TemplateProducts, start: Array, template: Template) -> SubpixelFit:
    """Fit position, rotation, gain and offset in every frame by Gauss-Newton.

    Parameters
    ----------
    data : TemplateProducts
        Products of n frames with the template.
    start : array (n, 2)
        Initial positions, px.
    template : Template
        The same template.

    Returns
    -------
    SubpixelFit
        `converged` is false where the position leaves the range of the expansion.

    """
    max_search_px = template.shift_expansion.max_search_px
    at = np.clip(np.array(start, dtype=np.float64), -max_search_px, max_search_px)
    n = len(at)
    normal, right = np.zeros((n, N_UNKNOWNS, N_UNKNOWNS)), np.zeros((n, N_UNKNOWNS))
    converged, active = np.zeros(n, np.bool_), np.ones(n, np.bool_)
    for _ in range(MAX_STEPS):
        rows = np.flatnonzero(active)
        equations = _equations(data.subset(active), at[rows], template)
        normal[rows], right[rows] = equations.normal, equations.right
        step = np.clip(equations.moves[:, :2], -1.0, 1.0)
        before = at[rows]
        at[rows] = np.clip(before + step, -max_search_px, max_search_px)
        small = np.max(np.abs(step), axis=1) < STEP_TOLERANCE_PX
        converged[rows[small]] = True
        stuck = np.max(np.abs(at[rows] - before), axis=1) < STEP_TOLERANCE_PX  # where the expansion ends
        active[rows] = ~(small | stuck)
        if not active.any():
            break
    found = NormalEquations(normal, right, data.power, data.n_pixels)
    angle = found.moves[:, 2]
    return SubpixelFit(
        position=at + _rotation_offset(angle, at),
        angle=angle,
        sigma=found.sigma,
        score=found.score,
        gain=found.coefficients[:, 0],
        offset=found.coefficients[:, 1] + template.level,
        misfit=found.misfit,
        converged=converged & (found.coefficients[:, 0] > MIN_GAIN),
    )


def _equations(data: TemplateProducts, at: Array, template: Template) -> NormalEquations:
    """The linear problem at given shifts."""
    columns = template.design(at)
    normal = columns @ data.gram @ columns.transpose(0, 2, 1)
    return NormalEquations(normal, np.einsum("nik,nk->ni", columns, data.moments), data.power, data.n_pixels)


def _rotation_offset(angle: Array, at: Array) -> Array:
    """How far the rotation about the centre of the cut-out moves the centre of a target at `at`, (n, 2) px."""
    return angle[:, None] * np.stack([-at[:, 1], at[:, 0]], axis=1)


@dataclass(frozen=True, eq=False)
class RawTrack:
    """Position of the target in every frame, on cut-outs.

    Attributes
    ----------
    corner : array of int (n, 2)
        Upper left corner (x, y) of each cut-out, px.
    fit : SubpixelFit
        Fit on the cut-outs; NaN where the target was not found.
    reason : array of object (n,)
        Why the target was not found; "" where it was.

    """

    corner: NDArray[np.int64]  # (n, 2) px, upper left corner of each cut-out
    fit: SubpixelFit
    reason: NDArray[np.object_]  # (n,), "" where found

    def __getitem__(self, rows: np.ndarray | slice) -> RawTrack:
        return RawTrack(self.corner[rows], self.fit[rows], self.reason[rows])

    def put(self, rows: np.ndarray | slice, part: RawTrack) -> None:
        """Replace some rows."""
        self.corner[rows], self.reason[rows] = part.corner, part.reason
        self.fit.put(rows, part.fit)

    @property
    def position(self) -> Array:
        """Upper left corner of the target's rectangle (n, 2) px."""
        return self.corner + self.fit.position

    @property
    def found(self) -> Mask:
        """Frames (n,) in which the target was found."""
        return np.asarray(self.reason == "")


def empty_track(n: int) -> RawTrack:
    """Create a track in which nothing is found yet.

    Parameters
    ----------
    n : int
        Number of frames.

    Returns
    -------
    RawTrack
        All positions are NaN, all reasons "frame cannot be read".

    """
    nan = np.full(n, np.nan)
    pair = np.full((n, 2), np.nan)
    score, gain, offset, misfit = (nan.copy() for _ in range(4))
    fit = SubpixelFit(pair, nan, np.full((n, 3), np.nan), score, gain, offset, misfit, np.zeros(n, np.bool_))
    return RawTrack(np.zeros((n, 2), np.int64), fit, np.full(n, UNREAD, dtype=object))
