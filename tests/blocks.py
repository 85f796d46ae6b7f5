"""Small films of speckled blocks for finding and pointing: made of `film`'s exact shifts."""

from __future__ import annotations

import film
import numpy as np
from film import Film, block_film, expose, moved, speckle

SIZE, SHAPE = (36, 48), (64, 240)  # of the block and the picture, px
N = 80
SLIDE = 40 + 150 * (1 - np.exp(-np.arange(N) / 40))


def a_film(x, change=None, **given):
    """The block film, drawn once; `change(i, frame)` may spoil frames."""
    source = block_film(np.asarray(x), size=SIZE, shape=SHAPE, **given)
    frames = [source.frame(i) for i in range(len(source))]
    if change:
        frames = [change(i, frame.copy()) for i, frame in enumerate(frames)]
    return Film(lambda i: frames[i], len(frames), frames[0].shape)


def pasted(shape=SHAPE, seed=3, contrast=25.0):
    """A speckled scene and a way to paste speckled blocks at any place on it, exactly."""
    scene = 110 + speckle(shape, np.random.default_rng(seed), contrast=contrast)

    def paste(picture, x, y, size, block):
        """Block number `block` of `size` (h, w), centre at x, y; `picture` is changed."""
        texture = 128 + speckle((size[0] + 36, size[1] + 38), np.random.default_rng([seed, block]))
        h, w = picture.shape
        x0, y0 = int(np.floor(x - size[1] / 2)) - 2, int(np.floor(y - size[0] / 2)) - 2
        left, top = x - size[1] / 2, y - size[0] / 2
        body = moved(texture, left - x0, top - y0)[: size[0] + 6, : size[1] + 6]
        mask = np.zeros(shape)
        whole = np.zeros(shape)
        rows, columns = slice(max(y0, 0), min(y0 + size[0] + 6, h)), slice(max(x0, 0), min(x0 + size[1] + 6, w))
        whole[rows, columns] = body[rows.start - y0 : rows.stop - y0, columns.start - x0 : columns.stop - x0]
        mask = np.outer(film.cover(h, top, top + size[0]), film.cover(w, left, left + size[1]))
        picture += mask * (whole - picture)

    return scene, paste


def shown(draw, n=N, shape=SHAPE, seed=5):
    """A film of pictures with camera noise, drawn once."""
    frames = [expose(draw(i), np.random.default_rng([seed, i])) for i in range(n)]
    return Film(lambda i: frames[i], n, shape)


def holds(rect, x, y, size):
    """The rectangle lies within the body (half a pixel of grace) and covers most of it."""
    left, top, w, h = rect
    inside = (
        left - 0.5 >= x - size[1] / 2 - 1.1
        and left + w - 0.5 <= x + size[1] / 2 + 1.1
        and top - 0.5 >= y - size[0] / 2 - 1.1
        and top + h - 0.5 <= y + size[0] / 2 + 1.1
    )
    return inside and w * h > 0.5 * size[0] * size[1]


def shaking(scale=3.0):
    """Whole-picture shake (n, 2) px and a film of it."""
    shake = scale * np.stack([np.sin(np.arange(N) / 3.1), 0.6 * np.cos(np.arange(N) / 2.3)], axis=1)
    wide = 110 + speckle((SHAPE[0], SHAPE[1]), np.random.default_rng(8), contrast=25.0)
    _, paste = pasted()

    def draw(i):
        picture = moved(wide, *shake[i])
        paste(picture, SLIDE[i] + shake[i, 0], 31.5 + shake[i, 1], SIZE, 1)
        return picture

    return shake, shown(draw)


def two_blocks():
    """A film of two blocks that move towards each other, at (40, 20) and (200, 48) px in its first frame."""
    scene, paste = pasted()

    def draw(i):
        picture = scene.copy()
        paste(picture, SLIDE[i], 20, (26, 40), 1)
        paste(picture, 200 - 1.5 * i, 48, (22, 36), 2)
        return picture

    return shown(draw)
