"""Quintic-spline interpolation at one sub-pixel shift, as a short separable filter.

A spline of order five through the pixels, evaluated at the pixel grid moved by (dx, dy), is a convolution
with a fixed kernel per axis (the cardinal spline at that shift). Its tails fall as 0.43^|n|, so twenty-one
taps carry it to 1e-4 of the pixel-to-pixel alternation and far better for real pictures. Order five
matters: the cubic leaves 1.3 mpx of peak locking where this leaves 0.2 (4 px speckle).
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline
from scipy.ndimage import spline_filter1d

Patch = NDArray[Any]
Float32 = NDArray[np.float32]

TAPS = 10  # reach of the kernel on either side, px
REACH = 2  # whole pixels a patch may still be off its cut-out
MARGIN = 4  # pixels round the template that its gradient needs
PAD = TAPS + REACH + MARGIN  # what a cut-out carries round the target

_BASIS = BSpline.basis_element(np.arange(-3.0, 4.0), extrapolate=False)
_OFFSETS = np.arange(-3, 4)


def _prefilter() -> NDArray[np.float64]:
    """The inverse of the sampled quintic B-spline, as rows (7, 2 TAPS + 1) shifted by -3..3."""
    impulse = np.zeros(129)
    impulse[64] = 1.0
    response = spline_filter1d(impulse, order=5, mode="mirror")
    taps = np.arange(-TAPS, TAPS + 1)
    return np.stack([response[64 + taps - i] for i in _OFFSETS])


_PREFILTER = _prefilter()


def kernels(shift: NDArray[np.float64], derivative: int = 0) -> NDArray[np.float64]:
    """Kernels (n, 2 TAPS + 1) that read a row at `shift` (n,), each within +-0.5 px; or its derivative."""
    basis = _BASIS.derivative(derivative) if derivative else _BASIS
    at = np.asarray(shift, dtype=np.float64)[:, None] - _OFFSETS
    return np.nan_to_num(basis(at)) @ _PREFILTER


def resample(patches: Patch, at: NDArray[np.float64], margin: int = 0) -> tuple[Float32, NDArray[np.float64]]:
    """Read each cut-out on the template's grid moved by `at`.

    `patches` is (n, h + 2 PAD, w + 2 PAD) of any unsigned type, `at` (n, 2) as (x, y) px within +-REACH.
    Returns the pictures (n, h + 2 margin, w + 2 margin), float32, and the factor (n,) by which white pixel
    noise lost variance in the interpolation.
    """
    whole = np.clip(np.rint(at), -REACH, REACH).astype(int)
    rest = np.clip(at - whole, -0.5, 0.5)
    kx, ky = kernels(rest[:, 0]), kernels(rest[:, 1])
    n, height, width = patches.shape
    h, w = height - 2 * PAD + 2 * margin, width - 2 * PAD + 2 * margin
    edge = PAD - TAPS - margin
    out = np.empty((n, h, w), np.float32)
    for i in range(n):
        x, y = whole[i] + edge
        cut = patches[i, y : y + h + 2 * TAPS, x : x + w + 2 * TAPS]
        out[i] = cv2.sepFilter2D(cut, cv2.CV_32F, kx[i], ky[i])[TAPS : TAPS + h, TAPS : TAPS + w]
    return out, np.sum(kx**2, axis=1) * np.sum(ky**2, axis=1)


def gradient(image: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Derivative along x and y of the spline through `image`, at its pixels."""
    slope = kernels(np.zeros(1), derivative=1)[0]
    still = np.zeros(2 * TAPS + 1)
    still[TAPS] = 1.0
    gx = cv2.sepFilter2D(image, cv2.CV_64F, slope, still)
    gy = cv2.sepFilter2D(image, cv2.CV_64F, still, slope)
    return np.asarray(gx, dtype=np.float64), np.asarray(gy, dtype=np.float64)
