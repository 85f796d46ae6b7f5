"""Render the films of the benchmark: eight conditions of known truth, and the Cramer-Rao bound of each.

A block of 90 x 60 px slides 743 px in 600 frames (3.4 to 1.7 m/s at 0.5 mm/px and 4000 frames/s; blur: 8 m/s) and
vibrates vertically by 0.3 px. Full well 15 000 e-, read noise 20 e-, 8 bit, 1024 x 128 px.
"""

from __future__ import annotations

import hashlib
import os
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import tifffile
from numpy.typing import NDArray

import frictrack.simulate
from frictrack.simulate.rendering import (
    Camera,
    Highlight,
    Oscillation,
    Rod,
    Surface,
    Target,
    render,
    render_clean,
    write_film,
)

Array = NDArray[np.float64]

WINDOW = 83, 53  # px, width and height of what is tracked
BLOCK = 90.0, 60.0
FPS, SCALE = 4000.0, 0.5e-3
WIDTH, HEIGHT = 1024, 128
TRAVEL, FRAMES, MAX_FRAMES = 743.0, 600, {"blur8": 240}
DRY_DECELERATION, VISCOUS = 5.0, 2.5  # m/s^2 and 1/s: deceleration 5 + 2.5 v
BEGIN_X, BEGIN_Y = 60.3, 60.1  # px, the block's centre in frame 0
BOUND_FRAMES = 12
EDITION = 1  # count up when the code below makes other films of the same numbers
FOLDER = Path(os.environ.get("FRICTRACK_FILMS", Path(tempfile.gettempdir()) / "frictrack_films"))

# Speckle of 4 px: full width at half maximum of the autocorrelation of the paint, 4 / sqrt 2 of one blot.
SPECKLE = Surface("speckle", 2.83, level=0.625, contrast=0.29)
DOTS = Surface("dots", 3.5, level=0.55, contrast=0.5)
CHECKER = Surface("checker", 6.0, level=0.625, contrast=0.293)


@dataclass(frozen=True)
class Setting:
    """What differs from the nominal film. `drift` is the change of light from the first frame to the last."""

    camera: dict[str, Any] = field(default_factory=dict)
    target: dict[str, Any] = field(default_factory=dict)
    surface: Surface = SPECKLE
    speed: float | None = None  # m/s in frame 0; else so that 743 px are travelled
    drift: float = 0.0
    quality: int | None = None  # of MJPEG; without it the film is not compressed


SETTINGS = {
    "nominal": Setting(),
    "lowlight": Setting(camera={"full_well": 1000.0}),
    "flicker": Setting(camera={"flicker": Oscillation(0.15, 100.0)}, drift=-0.25),
    "blur8": Setting(camera={"exposure": 0.5}, speed=8.0),
    "mjpg": Setting(quality=18),  # about what FFmpeg writes unless told otherwise
    "hard": Setting(
        camera={
            "prnu": 0.01,
            "shake_x": Oscillation(0.3, 35.0),
            "shake_y": Oscillation(0.2, 35.0, 1.0),
            "flicker": Oscillation(0.05, 100.0),
        },
        target={
            "rotation": Oscillation(np.deg2rad(0.15), 40.0),
            "rod": Rod(520.0, 14.0, 0.06),
            "highlight": Highlight(300.0, 60.0, 14.0, 0.25),
        },
    ),
    "dots": Setting(surface=DOTS),
    "checker": Setting(surface=CHECKER),
}
# One nuisance of the hard film at a time.
SETTINGS |= {
    "prnu": Setting(camera={"prnu": 0.01}),
    "rotation": Setting(target={"rotation": SETTINGS["hard"].target["rotation"]}),
    "shake": Setting(camera={key: SETTINGS["hard"].camera[key] for key in ("shake_x", "shake_y")}),
    "highlight": Setting(target={"highlight": SETTINGS["hard"].target["highlight"]}),
    "rod": Setting(target={"rod": SETTINGS["hard"].target["rod"]}),
}
CONDITIONS = ("nominal", "lowlight", "flicker", "blur8", "mjpg", "hard", "dots", "checker")
NUISANCES = ("prnu", "rotation", "shake", "highlight", "rod")


class Condition(NamedTuple):
    """A film and its truth: the block's centre in the picture (shake included) at mid-exposure."""

    frames: NDArray[Any]  # (n, 128, 1024) uint8, mapped from the film where that is uncompressed
    x: Array  # (n,) px
    y: Array  # (n,) px
    angle: Array  # (n,) rad
    rectangle: tuple[int, int, int, int]  # x, y, w, h px in frame 0
    bound: float  # px, Cramer-Rao bound of x for the known template, averaged over the frames
    bound_y: float
    film: Path  # a .tif, for mjpg an .avi


def condition(name: str, seed: int = 0, n_frames: int = FRAMES) -> Condition:
    """Film of a condition; kept in a temporary folder, so that the second call is instant.

    At most as many frames as fit into the picture (240 with blur); more than 600 frames slow the slide down.
    """
    n = min(n_frames, MAX_FRAMES.get(name, n_frames))
    stem, quality = FOLDER / f"{name}_{seed}_{n}_{_version(name)}", SETTINGS[name].quality
    stem.parent.mkdir(parents=True, exist_ok=True)
    film, numbers = stem.with_suffix(".avi" if quality else ".tif"), stem.with_suffix(".npz")
    if not numbers.exists():  # written last
        path, camera, target = scene(name, seed, n)
        write_film(render(path, camera, target, np.random.default_rng([seed, 5]), n), film, FPS, quality or 0)
        _save(numbers, truth(name, seed, n))
    known = np.load(numbers)
    rectangle = tuple(int(v) for v in known["rectangle"])
    bounds = float(known["bound"][0]), float(known["bound"][1])
    return Condition(_frames(film, n), known["x"], known["y"], known["angle"], rectangle, *bounds, film=film)


def scene(name: str, seed: int, n: int = FRAMES) -> tuple[Callable[[Array], tuple[Array, ...]], Camera, Target]:
    """Path, camera and target of a condition."""
    setting = SETTINGS[name]
    seconds = max(n, FRAMES) / FPS
    camera = Camera(fps=FPS, width=WIDTH, height=HEIGHT, scale=SCALE, black=0.0, prnu_seed=seed)
    camera = replace(camera, drift=setting.drift / seconds, **setting.camera)
    target = Target(*BLOCK, surface=replace(setting.surface, seed=1000 + seed), **setting.target)
    return _path(setting.speed, seconds), camera, target


def truth(name: str, seed: int, n: int) -> dict[str, Any]:
    """What `condition` knows besides the frames."""
    path, camera, target = scene(name, seed, n)
    t = np.arange(n) / FPS
    (x, y), shake = path(t), camera.shake(t)
    angle = target.rotation(t) if target.rotation else np.zeros(n)
    corner = [round(float(c[0]) - (side - 1) / 2) for c, side in zip((x, y), WINDOW, strict=True)]
    bound = np.sqrt(np.mean(_variances(name, seed, n), axis=0))
    return {"x": x + shake[0], "y": y + shake[1], "angle": angle, "rectangle": [*corner, *WINDOW], "bound": bound}


def _path(speed: float | None, seconds: float) -> Callable[[Array], tuple[Array, Array]]:
    """x'' = -(DRY + VISCOUS x') in closed form; y vibrates. Slower slides decelerate less."""
    slow = (FRAMES / FPS / seconds) ** 2
    dry, k = DRY_DECELERATION * slow, VISCOUS * np.sqrt(slow)
    fall = (1 - np.exp(-k * seconds)) / k
    start = speed or (TRAVEL * SCALE + dry / k * (seconds - fall)) / fall

    def path(t: Array) -> tuple[Array, Array]:
        metres = (start + dry / k) * (1 - np.exp(-k * t)) / k - dry / k * t
        return BEGIN_X + metres / SCALE, BEGIN_Y + 0.3 * np.sin(2 * np.pi * 60.0 * t)

    return path


def _variances(name: str, seed: int, n: int) -> Array:
    """Cramer-Rao variance of x and of y in some frames (frames, 2), px^2, gain and offset unknown too.

    Inverse of the information matrix of (x, y, gain, offset) of the block alone with the true noise of each pixel;
    rod, highlight, flat-field noise, rotation and compression are left out, blur, flicker and drift are in.
    """
    path, camera, target = scene(name, seed, n)
    step = max(1, n // BOUND_FRAMES)
    # A slower camera of the same shutter sees every step-th frame.
    camera = replace(camera, fps=FPS / step, exposure=camera.exposure / step, prnu=0.0, shake_x=None, shake_y=None)
    target = replace(target, rod=None, highlight=None, rotation=None, course=False)

    def pictures(dx: float, dy: float) -> Iterator[Array]:
        return render_clean(lambda t: (path(t)[0] + dx, path(t)[1] + dy), camera, target, -(-n // step))

    h = 0.02
    moved = [pictures(dx, dy) for dx, dy in ((0, 0), (h, 0), (-h, 0), (0, h), (0, -h))]
    out = []
    for i, (centre, right, left, down, up) in enumerate(zip(*moved, strict=True)):
        x, y = (float(c[0]) for c in path(np.array([i * step / FPS])))
        cut = _window(x, y)
        slope_x, slope_y = ((camera.mean(a) - camera.mean(b)) / (2 * h) for a, b in ((right, left), (down, up)))
        columns = [-slope_x[cut], -slope_y[cut], camera.mean(centre)[cut], np.ones(WINDOW[::-1])]
        design = np.stack([c.ravel() for c in columns], axis=1) / camera.noise(centre)[cut].reshape(-1, 1)
        out.append(np.diag(np.linalg.inv(design.T @ design))[:2])
    return np.array(out)


def _window(x: float, y: float) -> tuple[slice, slice]:
    """Rows and columns of the tracked window nearest to the block's centre."""
    left, top = round(x - (WINDOW[0] - 1) / 2), round(y - (WINDOW[1] - 1) / 2)
    return slice(top, top + WINDOW[1]), slice(left, left + WINDOW[0])


def _frames(film: Path, n: int) -> NDArray[Any]:
    """Grey frames as they are decoded, mapped from the film or from a copy beside it."""
    if film.suffix == ".tif":
        return tifffile.memmap(film, mode="r")
    copy = film.with_suffix(".npy")
    if not copy.exists():
        capture = cv2.VideoCapture(str(film))
        partial = copy.with_name(f"{copy.stem}.{os.getpid()}.npy")
        frames = np.lib.format.open_memmap(partial, "w+", np.uint8, (n, HEIGHT, WIDTH))
        for i in range(n):
            frames[i] = cv2.cvtColor(capture.read()[1], cv2.COLOR_BGR2GRAY)
        frames.flush()
        partial.replace(copy)
    return np.load(copy, mmap_mode="r")


def _save(path: Path, arrays: dict[str, Any]) -> None:
    partial = path.with_name(f"{path.stem}.{os.getpid()}.npz")
    np.savez(partial, **arrays)
    partial.replace(path)


def _version(name: str) -> str:
    """Changes with the renderer and with the condition, so that no film outlives what it was made by."""
    sources = [p.read_bytes() for p in sorted(Path(frictrack.simulate.__path__[0]).glob("*.py"))]
    about = repr((SETTINGS[name], WINDOW, BLOCK, TRAVEL, DRY_DECELERATION, VISCOUS, BEGIN_X, BEGIN_Y, EDITION))
    return hashlib.sha256(b"".join(sources) + about.encode()).hexdigest()[:10]
