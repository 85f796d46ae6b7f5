"""Sub-pixel position: inverse-compositional Gauss-Newton against one fixed template.

Minimises the weighted, zero-normalised squared difference between picture and template (Baker & Matthews
2004, IJCV 56:221; gain and offset free as in digital image correlation). Near the solution

    I(u + p) = b + a [T(u) + g(u).(p - p*) + theta g_theta(u)]

is linear in a, b, p* and the rotation theta, with columns that belong to the template alone: one product of
the picture with a fixed matrix is one Gauss-Newton step. The rotation turns about the template's centre of
stiffness, where g_theta is orthogonal to both gradients, so that estimating it costs x and y nothing.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from frictrack.records import Array, Mask
from frictrack.tracking.resample import MARGIN, REACH, Patch, gradient, resample

STEPS = 12
SETTLED = 2e-3  # px; Gauss-Newton's next step would be a few percent of this
UNKNOWNS = 5
LEAST_GAIN = 1e-3


@dataclass(frozen=True, eq=False)
class Template:
    """What the target looks like: `image` (h + 2 MARGIN, w + 2 MARGIN) and the `weight` (h, w) of its pixels."""

    image: Array
    weight: Array

    @cached_property
    def design(self) -> Array:
        """Columns (h w, 5): gradient along x and y, rotation, picture, one; times the root of the weight."""
        inner = (slice(MARGIN, -MARGIN), slice(MARGIN, -MARGIN))
        gx, gy = (g[inner].ravel() for g in gradient(self.image))
        weight = self.weight.ravel()
        picture = self.image[inner].ravel()
        picture = picture - np.average(picture, weights=weight)
        slopes = np.column_stack([gx, gy])
        turn = _turn(slopes, self.weight)
        return np.column_stack([slopes, turn, picture, np.ones_like(gx)]) * self.root[:, None]

    @cached_property
    def root(self) -> Array:
        """Square root of the weights (h w,)."""
        return np.sqrt(self.weight.ravel())

    @cached_property
    def covariance(self) -> Array:
        """Inverse normal matrix (5, 5): covariance of the coefficients per unit noise variance."""
        return np.asarray(np.linalg.pinv(self.design.T @ self.design, hermitian=True), dtype=np.float64)

    @cached_property
    def n_pixels(self) -> int:
        """Pixels that count."""
        return int(np.count_nonzero(self.weight))


def _turn(slopes: Array, weight: Array) -> Array:
    """Change (h w,) of the picture per rad of rotation about the centre of stiffness.

    About the corner that is g_x y - g_y x; moving the centre takes off the part along the slopes (h w, 2).
    """
    y, x = (c.ravel().astype(np.float64) for c in np.mgrid[: weight.shape[0], : weight.shape[1]])
    turn = slopes[:, 0] * y - slopes[:, 1] * x
    root = np.sqrt(weight.ravel())
    shift = np.linalg.lstsq(slopes * root[:, None], turn * root, rcond=None)[0]
    return np.asarray(turn - slopes @ shift, dtype=np.float64)


@dataclass(frozen=True, eq=False)
class Fine:
    """Where the target is on its cut-outs: `at` (n, 2) px and the rest (n,)."""

    at: Array
    angle: Array
    sigma: Array  # (n, 2) px
    score: Array
    gain: Array
    offset: Array
    settled: Mask


def refine(patches: Patch, start: Array, template: Template) -> Fine:
    """Position of the template on each cut-out (n, h + 2 PAD, w + 2 PAD), from `start` (n, 2) px."""
    n = len(patches)
    at, settled = np.array(start, dtype=np.float64), np.zeros(n, np.bool_)
    moments, power, loss = np.zeros((n, UNKNOWNS)), np.ones(n), np.ones(n)
    active = np.arange(n)
    for _ in range(STEPS):
        pictures, loss[active] = resample(patches[active], at[active])
        pixels = pictures.reshape(len(active), -1) * template.root
        moments[active] = pixels @ template.design
        power[active] = np.einsum("ij,ij->i", pixels, pixels)
        step = _step(moments[active] @ template.covariance)
        at[active] -= step
        small = np.max(np.abs(step), axis=1) < SETTLED
        settled[active[small]] = True
        active = active[~small & _near(at[active])]
        if not len(active):
            break
    return _summarise(at, settled, (moments, power, loss), template)


def _step(coefficients: Array) -> Array:
    """Gauss-Newton step (n, 2) px, at most one pixel long per axis."""
    return np.clip(coefficients[:, :2] / _divisor(coefficients)[:, None], -1.0, 1.0)


def _divisor(coefficients: Array) -> Array:
    """The gain (n,), kept away from zero; a target with less than that is not there."""
    return np.maximum(coefficients[:, 3], LEAST_GAIN)


def _near(at: Array) -> Mask:
    """Still on the cut-out."""
    return np.all(np.abs(at) < REACH + 0.5, axis=1)


def _summarise(at: Array, settled: Mask, sums: tuple[Array, Array, Array], template: Template) -> Fine:
    """All that is said of a frame, from its products with the template (n, 5) and its own power (n,)."""
    moments, power, loss = sums
    coefficients = moments @ template.covariance
    gain = _divisor(coefficients)
    misfit = np.maximum(power - np.sum(coefficients * moments, axis=1), 0.0)
    # Interpolation took some of the noise out of the pixels, though not out of what the gradient sees.
    noise = misfit / max(template.n_pixels - UNKNOWNS, 1) / loss
    spread = np.sqrt(np.diag(template.covariance)[:2])
    return Fine(
        at=at,
        angle=coefficients[:, 2] / gain,
        sigma=np.sqrt(noise)[:, None] * spread / gain[:, None],
        score=_correlation(moments, power, template),
        gain=coefficients[:, 3],
        offset=coefficients[:, 4],
        settled=settled & (coefficients[:, 3] > LEAST_GAIN),
    )


def _correlation(moments: Array, power: Array, template: Template) -> Array:
    """Weighted zero-normalised cross-correlation (n,) of the pictures with the template."""
    picture = template.design[:, 3]
    centred = power - moments[:, 4] ** 2 / np.sum(template.weight)
    return moments[:, 3] / np.sqrt(np.maximum(centred * (picture @ picture), 1e-12))
