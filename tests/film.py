"""Films of known truth for the tests: a speckled block over a speckled background, shifted exactly.

The block's texture is periodic and band-limited, so a Fourier phase moves it by any fraction of a pixel
without error. Nothing here comes from the code under test.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np

from frictrack.recording import Header, Recording

FULL_WELL, READ_NOISE = 15_000.0, 20.0  # electrons


def speckle(shape, rng, *, fwhm=4.0, contrast=38.0):
    """Periodic band-limited speckle of zero mean and rms `contrast`."""
    ky, kx = np.fft.fftfreq(shape[0])[:, None], np.fft.rfftfreq(shape[1])[None, :]
    sigma = fwhm / 2.355
    low = np.exp(-2 * (np.pi * sigma) ** 2 * (kx**2 + ky**2))
    low[np.hypot(kx, ky) > 0.45] = 0
    field = np.fft.irfft2(np.fft.rfft2(rng.standard_normal(shape)) * low, shape)
    return contrast * (field - field.mean()) / field.std()


def moved(texture, dx, dy):
    """The periodic texture moved by (dx, dy) px, exactly."""
    ky, kx = np.fft.fftfreq(texture.shape[0])[:, None], np.fft.rfftfreq(texture.shape[1])[None, :]
    return np.fft.irfft2(np.fft.rfft2(texture) * np.exp(-2j * np.pi * (kx * dx + ky * dy)), texture.shape)


def cover(n, low, high):
    """Share of each of n pixels that lies between `low` and `high` (pixel i spans i - 0.5 to i + 0.5)."""
    edge = np.arange(n + 1) - 0.5
    return np.diff(np.clip(edge, low, high))


class Film(Recording):
    """A film in memory: frames are drawn when they are asked for."""

    suffixes = ()

    def __init__(self, draw, n, shape, fps=4000.0, bit_depth=8, notes=()):
        self._draw, self._about = draw, Header(n, shape, bit_depth, notes=notes)
        super().__init__(Path("film.test"), fps)

    def _open(self):
        return self._about

    def _read(self, indices: Iterable[int]) -> Iterator[np.ndarray]:
        for i in indices:
            yield self._draw(i)


def block_film(x, y=None, *, size=(60, 90), shape=(128, 512), seed=0, noise=True, light=None, fps=4000.0):
    """Film of a block whose centre is at x (n,), y (n,) px."""
    rng = np.random.default_rng(seed)
    y = np.full(len(x), (shape[0] - 1) / 2) if y is None else y
    texture = speckle((size[0] + 36, size[1] + 38), rng)
    scene = 110 + speckle(shape, rng, contrast=25.0)
    light = np.ones(len(x)) if light is None else light

    def draw(i):
        h, w = size
        left, top = x[i] - w / 2, y[i] - h / 2
        x0, y0 = int(np.floor(left)) - 2, int(np.floor(top)) - 2
        body = 128 + moved(texture, left - x0, top - y0)[: h + 6, : w + 6]
        mask = np.outer(cover(h + 6, top - y0, top - y0 + h), cover(w + 6, left - x0, left - x0 + w))
        picture = scene.copy()
        ys, xs = np.arange(y0, y0 + h + 6), np.arange(x0, x0 + w + 6)
        iy, ix = (ys >= 0) & (ys < shape[0]), (xs >= 0) & (xs < shape[1])
        at = np.ix_(ys[iy], xs[ix])
        picture[at] += (mask * (body - 0))[np.ix_(iy, ix)] - mask[np.ix_(iy, ix)] * picture[at]
        return expose(light[i] * picture, np.random.default_rng([seed, i]) if noise else None)

    return Film(draw, len(x), shape, fps)


def expose(picture, rng):
    """Grey values 0..255 -> 8 bit, with shot and read noise when a generator is given."""
    if rng is not None:
        electrons = np.clip(picture, 0, None) / 255 * FULL_WELL
        electrons = rng.poisson(electrons) + READ_NOISE * rng.standard_normal(picture.shape)
        picture = electrons / FULL_WELL * 255
    return np.clip(np.rint(picture), 0, 255).astype(np.uint8)
