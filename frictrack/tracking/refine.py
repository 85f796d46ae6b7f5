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


@dataclass(frozen=True, eq=False)
class Template:
    """What the target looks like: `image` (h + 2 MARGIN, w + 2 MARGIN) and the `weight` (h, w) of its pixels."""

    image: Array
    weight: Array

    @cached_property
    def columns(self) -> Array:
        """Columns (h w, 5): gradient along x and y, rotation, picture, one."""
        inner = (slice(MARGIN, -MARGIN), slice(MARGIN, -MARGIN))
        gx, gy = (g[inner].ravel() for g in gradient(self.image))
        picture = self.image[inner].ravel()
        picture = picture - np.average(picture, weights=self.weight.ravel())
        h, w = self.weight.shape
        y, x = (c.ravel().astype(np.float64) for c in np.mgrid[0:h, 0:w])
        gradients = np.stack([gx, gy], axis=1)
        turn = gx * y - gy * x
        moment = gradients.T @ (self.weight.ravel() * turn)
        cy, minus_cx = np.linalg.lstsq(self._stiffness(gradients), moment, rcond=None)[0]
        turn = turn - gx * cy - gy * minus_cx
        return np.column_stack([gx, gy, turn, picture, np.ones_like(gx)])

    def _stiffness(self, gradients: Array) -> Array:
        return gradients.T @ (self.weight.ravel()[:, None] * gradients)

    @cached_property
    def weighted(self) -> Array:
        """The columns times the weights (h w, 5)."""
        return self.columns * self.weight.reshape(-1, 1)

    @cached_property
    def covariance(self) -> Array:
        """Inverse normal matrix (5, 5): covariance of the coefficients per unit noise variance."""
        return np.linalg.pinv(self.columns.T @ self.weighted, hermitian=True)

    @property
    def n_pixels(self) -> int:
        """Pixels that count."""
        return int(np.count_nonzero(self.weight))


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
    pixels = np.zeros((n, template.weight.size), np.float32)
    loss, coefficients = np.ones(n), np.zeros((n, UNKNOWNS))
    active = np.arange(n)
    for _ in range(STEPS):
        pictures, loss[active] = resample(patches[active], at[active])
        pixels[active] = pictures.reshape(len(active), -1)
        coefficients[active] = pixels[active] @ template.weighted @ template.covariance
        step = _step(coefficients[active])
        at[active] -= step
        small = np.max(np.abs(step), axis=1) < SETTLED
        settled[active[small]] = True
        active = active[~small & _near(at[active])]
        if not len(active):
            break
    return _summarise(at, settled, (pixels, loss, coefficients), template)


def _step(coefficients: Array) -> Array:
    """Gauss-Newton step (n, 2) px, at most one pixel long per axis."""
    gain = coefficients[:, 3:4]
    safe = np.where(np.abs(gain) > 1e-3, gain, 1e-3)
    return np.clip(coefficients[:, :2] / safe, -1.0, 1.0)


def _near(at: Array) -> Mask:
    """Still on the cut-out."""
    return np.all(np.abs(at) < REACH + 0.5, axis=1)


def _summarise(at: Array, settled: Mask, last: tuple[Array, Array, Array], template: Template) -> Fine:
    pixels, loss, coefficients = last
    gain = coefficients[:, 3]
    safe = np.where(np.abs(gain) > 1e-3, gain, 1e-3)
    residual = pixels - coefficients @ template.columns.T
    freedom = max(template.n_pixels - UNKNOWNS, 1)
    variance = (residual**2 @ template.weight.ravel()) / freedom / loss
    spread = np.sqrt(np.diag(template.covariance)[:2])
    return Fine(
        at=at,
        angle=coefficients[:, 2] / safe,
        sigma=np.sqrt(variance)[:, None] * spread / np.abs(safe)[:, None],
        score=_correlation(pixels, template),
        gain=gain,
        offset=coefficients[:, 4],
        settled=settled & (gain > 1e-3),
    )


def _correlation(pixels: Array, template: Template) -> Array:
    """Weighted zero-normalised cross-correlation (n,) of the pictures with the template."""
    weight, picture = template.weight.ravel(), template.columns[:, 3]
    mean = pixels @ weight / weight.sum()
    centred = pixels - mean[:, None]
    power = (centred**2 @ weight) * (picture**2 @ weight)
    return (centred @ (weight * picture)) / np.sqrt(np.maximum(power, 1e-12))
