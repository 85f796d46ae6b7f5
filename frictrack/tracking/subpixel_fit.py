"""Sub-pixel position: Gauss-Newton on a few products of each frame with fixed pictures.

With the target's picture T known, a frame is

    I(u) = b + a [T(u - p) + theta R(u - p)] + noise        R: change per rad of rotation

and maximum likelihood for white noise is weighted least squares in a, b, p, theta. T and R at any shift are
sums of the template's fixed pictures (see `cosine_basis`), so a frame enters by its products with those and by its own
power alone: no frame is ever interpolated, which keeps its noise white and the estimate at the Cramer-Rao
bound (Pham et al. 2005, EURASIP J. Appl. Signal Process. 2005:2199).
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from frictrack.records import Array, Mask
from frictrack.tracking.correlation import Patch
from frictrack.tracking.template import Template

MAX_STEPS = 12  # at most: five where the picture fits, more where something hides a part of it
STEP_TOLERANCE_PX = 2e-3  # px; Gauss-Newton's next step would be a few percent of this
N_UNKNOWNS = 5
MIN_GAIN = 1e-3


@dataclass(frozen=True, eq=False)
class SubpixelFit:
    """Where the target is on its cut-outs: `position` (n, 2) px from their corners, and the rest (n,)."""

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
        """The same places, on cut-outs whose corners lie `by` (n, 2) px further up and left."""
        return replace(self, position=self.position + by)

    def unrotated(self) -> Array:
        """Where the target lay on its cut-out before it turned about the cut-out's middle (n, 2) px."""
        return self.position - _rotation_offset(self.angle, self.position)

    def put(self, rows: np.ndarray | slice, part: SubpixelFit) -> None:
        """Write `part` into these rows."""
        for f in fields(self):
            getattr(self, f.name)[rows] = getattr(part, f.name)


@dataclass(frozen=True, eq=False)
class TemplateProducts:
    """What is left of the frames: products with the pictures (n, k), power (n,), and products among the pictures.

    `gram` is (k, k), or (n, k, k) where the frames do not share their weights; `n_pixels` likewise.
    """

    moments: Array
    power: Array
    gram: Array
    n_pixels: Array | int

    def subset(self, rows: Mask) -> TemplateProducts:
        """Those of some frames."""
        gram = self.gram if self.gram.ndim == 2 else self.gram[rows]
        count = self.n_pixels if np.ndim(self.n_pixels) == 0 else np.asarray(self.n_pixels)[rows]
        return TemplateProducts(self.moments[rows], self.power[rows], gram, count)


def template_products(cuts: Patch, template: Template, share: Patch | None = None) -> TemplateProducts:
    """Multiply frames' cut-outs (n, h, w) by the template's pictures.

    `share` (n, h, w), 0 to 1, is how much of its weight each pixel keeps in each frame.
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
    """Position of the target in each frame, from `start` (n, 2) px; outside the expansion's reach not settled."""
    max_search_px = template.shift_expansion.max_search_px
    at = np.clip(np.array(start, dtype=np.float64), -max_search_px, max_search_px)
    n = len(at)
    result = np.zeros((n, N_UNKNOWNS)), np.zeros((n, N_UNKNOWNS)), np.zeros((n, N_UNKNOWNS, N_UNKNOWNS))
    converged, active = np.zeros(n, np.bool_), np.ones(n, np.bool_)
    for _ in range(MAX_STEPS):
        rows = np.flatnonzero(active)
        solution = _solve(data.subset(active), at[active], template)
        for whole, part in zip(result, solution, strict=True):
            whole[rows] = part
        step = np.clip(solution[0][:, 2:4] / _safe_gain(solution[0])[:, None], -1.0, 1.0)
        before = at[rows]
        at[rows] = np.clip(before + step, -max_search_px, max_search_px)
        small = np.max(np.abs(step), axis=1) < STEP_TOLERANCE_PX
        converged[rows[small]] = True
        stuck = np.max(np.abs(at[rows] - before), axis=1) < STEP_TOLERANCE_PX  # where the expansion ends
        active[rows] = ~(small | stuck)
        if not active.any():
            break
    return _summarise(at, converged, data, result, template)


def _solve(data: TemplateProducts, at: Array, template: Template) -> tuple[Array, Array, Array]:
    """Coefficients (n, 5) of gain, offset, p_x, p_y, turn; their right-hand side; the normal matrix (n, 5, 5)."""
    columns = template.design(at)
    normal = columns @ data.gram @ columns.transpose(0, 2, 1)
    right = np.einsum("nik,nk->ni", columns, data.moments)
    return np.linalg.solve(normal + _RIDGE, right[..., None])[..., 0], right, normal


_RIDGE = 1e-9 * np.eye(N_UNKNOWNS)  # a picture without contrast has no position, and says so by its score


def _safe_gain(coefficients: Array) -> Array:
    """The gain (n,), kept away from zero; a target with less than that is not there."""
    return np.maximum(coefficients[:, 0], MIN_GAIN)


def _summarise(
    at: Array, converged: Mask, data: TemplateProducts, result: tuple[Array, Array, Array], template: Template
) -> SubpixelFit:
    coefficients, right, normal = result
    gain = _safe_gain(coefficients)
    residual_power = np.maximum(data.power - np.einsum("ni,ni->n", coefficients, right), 0.0)
    misfit = residual_power / np.maximum(data.n_pixels - N_UNKNOWNS, 1)
    unit_sigma = np.sqrt(np.maximum(np.diagonal(np.linalg.inv(normal + _RIDGE), axis1=1, axis2=2)[:, 2:], 0.0))
    angle = coefficients[:, 4] / gain
    return SubpixelFit(
        position=at + _rotation_offset(angle, at),
        angle=angle,
        sigma=np.sqrt(misfit)[:, None] * unit_sigma / gain[:, None],
        score=_correlation(data, right, normal),
        gain=coefficients[:, 0],
        offset=coefficients[:, 1] + template.level,
        misfit=misfit,
        converged=converged & (coefficients[:, 0] > MIN_GAIN),
    )


def _rotation_offset(angle: Array, at: Array) -> Array:
    """The turn is about the middle of the cut-out: how far the target's own middle moves by it."""
    return angle[:, None] * np.stack([-at[:, 1], at[:, 0]], axis=1)


def _correlation(data: TemplateProducts, right: Array, normal: Array) -> Array:
    """Weighted zero-normalised cross-correlation (n,) of the frames with the template at its place."""
    weight = np.maximum(normal[:, 1, 1], 1e-12)
    both = right[:, 0] - right[:, 1] * normal[:, 0, 1] / weight
    frame = data.power - right[:, 1] ** 2 / weight
    picture = normal[:, 0, 0] - normal[:, 0, 1] ** 2 / weight
    # Where nothing is left of frame or picture, rounding errors are no match.
    size = np.maximum(frame, 1e-9 * data.power) * np.maximum(picture, 1e-9 * normal[:, 0, 0])
    return np.clip(both / np.sqrt(np.maximum(size, 1e-12)), -1.0, 1.0)
