"""Write raw films of a block that friction brakes, one study each."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

WIDTH, HEIGHT, TOP = 1024, 256, 100  # px; the target's rows begin at TOP
BLOCK = (40, 60)  # height and width of the target, px
FRAMES = 1000  # of a film, 262 MB; fewer where the total is small
MIN_FILMS, MIN_FRAMES = 4, 60
SECONDS, MASS, PIXEL = 0.25, 0.35, 5e-4  # s of a film, kg, m
STUDY = """[study]
mass = {mass}
model = ["coulomb"]
[camera]
scale = "{pixel} m/px"
[[run]]
video = "film.cihx"
"""
HEADER = """<cih><fileInfo/><frameInfo><totalFrame>{n}</totalFrame><startFrame>0</startFrame></frameInfo>
<recordInfo><recordRate>{fps:g}</recordRate></recordInfo>
<imageFileInfo><fileFormat>MRaw</fileFormat></imageFileInfo>
<imageDataInfo><resolution><width>{width}</width><height>{height}</height></resolution>
<colorInfo><type>Mono</type><bit>8</bit></colorInfo>
<effectiveBit><depth>8</depth><side>Lower</side></effectiveBit></imageDataInfo></cih>
"""


def write_films(folder: Path, total: float) -> list[Path]:
    """Write films of `total` bytes together, each in the folder of its study; return their paths."""
    count = max(MIN_FILMS, round(total / (FRAMES * WIDTH * HEIGHT)))
    n = max(MIN_FRAMES, round(total / count / (WIDTH * HEIGHT)))
    return [_write_film(folder / f"study_{seed:03}", n, seed) for seed in range(count)]


def _write_film(folder: Path, n: int, seed: int) -> Path:
    """Write one film of `n` frames: the block slides from the left to the right and loses most of its speed."""
    folder.mkdir(parents=True)
    rng = np.random.default_rng(seed)
    s = np.arange(n) / (n - 1)
    x = 100.0 + 700.0 * (1.6 * s - 0.6 * s**2)
    texture = np.pad(_speckle(rng, BLOCK[1], BLOCK[0]), ((0, 0), (2, 2)))
    ground = np.clip(np.round(20 + 2.0 * rng.standard_normal((HEIGHT, WIDTH))), 0, 255).astype(np.uint8)
    (folder / "study.toml").write_text(STUDY.format(mass=MASS, pixel=PIXEL))
    (folder / "film.cihx").write_text(HEADER.format(n=n, fps=n / SECONDS, width=WIDTH, height=HEIGHT))
    u = np.arange(texture.shape[1] + 1)
    with (folder / "film.mraw").open("wb") as film:
        for at in x:
            left, share = int(at), at % 1.0
            moved = np.stack([np.interp(u - share, u[:-1], row, left=0.0, right=0.0) for row in texture])
            frame = np.roll(ground, int(rng.integers(HEIGHT)), axis=0)
            part = frame[TOP : TOP + BLOCK[0], left : left + len(u)]
            part[...] = np.clip(np.round(moved + 20 + 2.0 * rng.standard_normal(part.shape)), 0, 255)
            film.write(frame.tobytes())
        film.flush()
        os.fsync(film.fileno())  # what is not on the disk cannot be dropped from memory
    return folder / "film.mraw"


def _speckle(rng: np.random.Generator, width: int, height: int) -> np.ndarray:
    """Grey levels of the block, as a lens leaves them."""
    window = np.hanning(7) / np.hanning(7).sum()
    rough = rng.uniform(40, 220, (height, width))
    smooth = np.apply_along_axis(np.convolve, 1, rough, window, "same")
    return np.apply_along_axis(np.convolve, 0, smooth, window, "same")
