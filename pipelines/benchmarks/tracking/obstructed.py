"""Draw films of one body among hands, walls, cables, shadows and other bodies, with its true path.

Everything is drawn here with NumPy and OpenCV, by signed distances and bicubic textures; nothing is shared with
`frictrack.simulate`. A seed gives size, contrast, background, motion and disturbances of a film.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates, spline_filter

from frictrack.recording import Header, Recording

Array = NDArray[np.float64]
DISTURBANCES = ("hand", "wall", "second body", "cable", "shadow", "flicker", "shake")
MOTIONS = ("slide", "accelerate", "bounce", "oscillate")
LOOKS = ("textured", "plain", "marked")


class DrawnFilm(Recording):
    """Frames in memory."""

    suffixes = ()

    def __init__(self, frames: NDArray[np.uint8], fps: float = 240.0) -> None:
        self._stack = frames
        super().__init__(Path("drawn.film"), fps)

    def _open(self) -> Header:
        return Header(len(self._stack), self._stack.shape[1:], 8)

    def _read(self, indices: Iterable[int]) -> Iterator[NDArray[np.uint8]]:
        for i in indices:
            yield self._stack[i]


@dataclass(frozen=True)
class Body:
    """A block or disc: half sides (x, y) px, path (n, 2) px, angle (n,) rad, spline of its picture with 4 px margin."""

    half: Array
    round: bool
    centre: Array
    angle: Array
    texture: NDArray[np.float32]

    def cover(self, i: int, x: Array, y: Array) -> tuple[Array, Array, Array]:
        """Share of the pixels at x, y that the body covers in frame i, and their places on the body."""
        c, s = np.cos(self.angle[i]), np.sin(self.angle[i])
        dx, dy = x - self.centre[i, 0], y - self.centre[i, 1]
        u, v = c * dx + s * dy, c * dy - s * dx
        distance = (
            np.hypot(u, v) - self.half[0] if self.round else np.maximum(abs(u) - self.half[0], abs(v) - self.half[1])
        )
        return np.clip(0.5 - distance, 0, 1), u, v

    def draw(self, picture: NDArray[np.float32], i: int) -> None:
        """Draw the body of frame i."""
        reach = float(np.hypot(*self.half)) + 2
        (x0, y0), (x1, y1) = (np.clip(self.centre[i] + d, 0, picture.shape[::-1]).astype(int) for d in (-reach, reach))
        if x1 <= x0 or y1 <= y0:
            return
        y, x = np.mgrid[y0:y1, x0:x1].astype(np.float64)
        share, u, v = self.cover(i, x, y)
        # OpenCV's remap rounds places to 1/32 px, which is more than the tracker's noise.
        places = np.stack([v + self.half[1] + 4, u + self.half[0] + 4])
        grey = map_coordinates(self.texture, places, order=3, mode="nearest", prefilter=False)
        part = picture[y0:y1, x0:x1]
        part += share * (grey - part)


@dataclass(frozen=True)
class Scene:
    """A film, its body, and what disturbs it."""

    frames: NDArray[np.uint8]
    body: Body
    second: Body | None
    tags: tuple[str, ...]

    @property
    def visible(self) -> NDArray[np.bool_]:
        """Frames (n,) in which the whole body is in the picture."""
        h, w = self.frames.shape[1:]
        return np.all((self.body.centre > self.body.half) & (self.body.centre < (w, h) - self.body.half), axis=1)


def scene(seed: int, **given: Any) -> Scene:
    """Film number `seed`; what is not given is drawn at random.

    `given` may hold frames, shape (h, w), look, motion, disc (bool), disturbances, quality (of JPEG; None for none),
    contrast (grey values of the body above its surroundings), slope (of its shading, grey values/px)
    and wall ("brick" or "plank").
    """
    rng = np.random.default_rng([49, seed])
    w, h, n = (int(rng.integers(low, high)) for low, high in ((320, 641), (96, 201), (60, 301)))
    some = [name for name in DISTURBANCES if rng.random() < 0.35] or [str(rng.choice(DISTURBANCES))]
    drawn = {
        "look": str(rng.choice(LOOKS)),
        "motion": str(rng.choice(MOTIONS)),
        "disc": bool(rng.random() < 0.35),
        "shape": (h, w),
        "frames": n,
        "disturbances": some,
    } | given
    look, motion, disc, (h, w), n, some = (
        drawn[name] for name in ("look", "motion", "disc", "shape", "frames", "disturbances")
    )
    level = float(rng.uniform(50, 190))
    half = np.full(2, h * rng.uniform(0.12, 0.22)) * (1 if disc else (rng.uniform(1.0, 1.8), 1))
    way, rest = _way(rng, motion, n, "hand" in some)
    room = w - 2 * half[0] - 16
    ends = np.sort(rng.uniform(0, 0.3, 2) * (1, -1) + (0, 1)) * room + half[0] + 8
    ends = ends if rng.random() < 0.5 else ends[::-1]
    row = float(rng.uniform(half[1] + 6, h - half[1] - 6)) if "second body" not in some else h - half[1] - 8
    tilt = np.radians(rng.uniform(-1, 1)) * 5 if abs(row - h / 2) < h / 6 and "second body" not in some else 0.0
    shake = _smooth(rng, n, 5) * rng.uniform(0.3, 2.5) if "shake" in some else np.zeros((n, 2))
    x = ends[0] + way * (ends[1] - ends[0])
    centre = np.stack([x, row + np.tan(tilt) * (x - w / 2)], axis=1) + shake
    turn = (x - x[0]) / half[0] if disc else np.full(n, tilt)
    contrast = rng.choice([-1, 1]) * rng.uniform(40, 90)
    grey = float(np.clip(level + given.get("contrast", contrast), 15, 240))
    body = Body(half, disc, centre, turn, _texture(rng, half, look, grey, given.get("slope", np.nan)))
    second = _second(rng, (h, w, n), body, shake) if "second body" in some else None
    still = _background(rng, (h, w), level, row + half[1] if abs(tilt) < 0.02 else None)
    if "wall" in given:
        still = _patterned(rng, (h, w), level, given["wall"])
    if "wall" in some:
        _draw_walls(rng, still, body, (ends, row))
    draw = _Drawer(rng, some, (h, w, n), (body, second), rest)
    blur, noise, quality = rng.uniform(0.5, 1.1), rng.uniform(0.8, 3.5), int(rng.integers(45, 96))
    flicker = rng.uniform(0.02, 0.12) * np.sin(rng.uniform(0.3, 2) * np.arange(n))
    light = 1 + flicker * ("flicker" in some)
    quality = given.get("quality", quality if quality < 85 else None)
    stack = np.empty((n, h, w), np.uint8)
    for i in range(n):
        matrix = np.array([[1, 0, shake[i, 0]], [0, 1, shake[i, 1]]])
        picture = cv2.warpAffine(still, matrix, (w, h), flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
        draw.all(picture, i)
        picture = cv2.GaussianBlur(picture, (0, 0), blur) * light[i] + noise * rng.standard_normal((h, w), np.float32)
        stack[i] = np.clip(np.rint(picture), 0, 255)
        if quality is not None:
            stack[i] = cv2.imdecode(cv2.imencode(".jpg", stack[i], [cv2.IMWRITE_JPEG_QUALITY, quality])[1], 0)
    return Scene(stack, body, second, (look, "disc" if disc else "block", motion, f"rests {rest:.0%}", *some))


def _draw_walls(rng: np.random.Generator, still: NDArray[np.float32], body: Body, way: tuple[Array, float]) -> None:
    """Draw a stop at either end of the way, whose ends (2,) and row are given."""
    ends, row = way
    for end, side in zip(ends, np.sign(ends - ends[::-1]), strict=True):
        x0 = end + side * (body.half[0] + 1)
        low, high = (x0, x0 + rng.integers(10, 26)) if side > 0 else (x0 - 20, x0)
        columns = slice(int(max(low, 0)), int(max(high, 0)))
        still[int(max(row - 2 * body.half[1], 0)) : int(row + body.half[1] + 3), columns] = rng.uniform(20, 235)


def _way(rng: np.random.Generator, motion: str, n: int, hand: bool) -> tuple[Array, float]:
    """Place along the way from 0 to 1 (n,), after a rest at the start, and the share of that rest."""
    rest = float(rng.uniform(0.2, 0.7)) if hand else float(rng.choice([0.0, rng.uniform(0, 0.75)]))
    t = np.clip((np.arange(n) - rest * n) / (n * (1 - rest)), 0, None)
    if motion == "slide":  # comes to rest in the end, sometimes early
        t = np.minimum(t / rng.uniform(0.4, 1.0), 1)
        return 2 * t - t**2, rest
    if motion == "accelerate":
        return t**2, rest
    if motion == "oscillate":
        cycles = rng.uniform(1, 4)
        return 0.5 - 0.5 * np.cos(2 * np.pi * cycles * t) * np.exp(-rng.uniform(0, 2) * t), rest
    x, v, out = 0.0, rng.uniform(2, 5) / (n * (1 - rest)), []
    bounce, drag = rng.uniform(0.5, 0.9), rng.uniform(0.0, 1.0) / (n * (1 - rest))
    for i in range(n):
        if i >= rest * n:
            x, v = x + v, v * (1 - drag)
            if not 0 <= x <= 1:
                x, v = (-x if x < 0 else 2 - x), -bounce * v
        out.append(x)
    return np.clip(out, 0, 1), rest


def _smooth(rng: np.random.Generator, n: int, width: float) -> Array:
    """Smooth series (n, 2) of unit deviation."""
    kernel = np.exp(-0.5 * (np.arange(-20, 21) / width) ** 2)
    series = np.stack([np.convolve(q, kernel, "valid") for q in rng.standard_normal((2, n + 40))], axis=1)
    return (series - series[0]) / np.sqrt(np.sum(kernel**2))


def _texture(
    rng: np.random.Generator, half: Array, look: str, grey: float, slope: float = np.nan
) -> NDArray[np.float32]:
    """Picture of a body with 4 px of margin; `slope` is its shading along x, grey values/px, at random by default."""
    w, h = (int(np.ceil(2 * q)) + 9 for q in half)
    shading = rng.uniform(-0.2, 0.2)
    picture = np.full((h, w), grey, np.float32) + np.arange(w, dtype=np.float32) * np.float32(
        shading if np.isnan(slope) else slope
    )
    if look == "textured":
        noise = cv2.GaussianBlur(rng.standard_normal((h, w)).astype(np.float32), (0, 0), rng.uniform(1.2, 3.0))
        picture += noise / noise.std() * rng.uniform(15, 40)
    if look == "marked":
        for _ in range(int(rng.integers(1, 5))):
            at = rng.uniform(0.25, 0.75, 2) * (w, h)
            cv2.circle(
                picture,
                tuple(int(16 * q) for q in at),
                int(16 * rng.uniform(2, 5)),
                float(rng.uniform(0, 255)),
                -1,
                cv2.LINE_8,
                4,
            )
    return spline_filter(np.clip(picture, 5, 250), output=np.float32)


def _second(rng: np.random.Generator, size: tuple[int, int, int], body: Body, shake: Array) -> Body:
    """A smaller block above the body, that moves on its own."""
    _, w, n = size
    free = body.centre[0, 1] - body.half[1]
    half = np.array([rng.uniform(0.6, 1.2) * body.half[0], max(min(0.8 * body.half[1], free / 2 - 4), 5)])
    way, _ = _way(rng, str(rng.choice(MOTIONS)), n, False)
    a, b = rng.uniform(half[0], w - half[0], 2)
    centre = np.stack([a + (b - a) * way, np.full(n, half[1] + 2)], axis=1) + shake
    return Body(half, False, centre, np.zeros(n), _texture(rng, half, str(rng.choice(LOOKS)), rng.uniform(20, 230)))


def _background(
    rng: np.random.Generator, shape: tuple[int, int], level: float, floor: float | None
) -> NDArray[np.float32]:
    """Wall, plain or textured or striped, with or without a floor below the body."""
    h, w = shape
    y, x = np.mgrid[:h, :w].astype(np.float32)
    picture = level + rng.uniform(-0.06, 0.06) * (x - w / 2) + rng.uniform(-0.1, 0.1) * (y - h / 2)
    kind = rng.integers(0, 4)
    if kind == 1:
        noise = cv2.GaussianBlur(rng.standard_normal(shape).astype(np.float32), (0, 0), rng.uniform(1, 4))
        picture += noise / noise.std() * rng.uniform(4, 20)
    elif kind == 2:
        picture += rng.uniform(5, 25) * np.sign(np.sin((x if rng.random() < 0.5 else y) * rng.uniform(0.1, 0.6)))
    if floor is not None and floor < h - 2 and rng.random() < 0.6:
        picture[int(floor) + 1 :] = rng.uniform(30, 220)
        if rng.random() < 0.5:
            picture[int(floor) + 1 : int(floor) + 6, :: int(rng.integers(6, 20))] = 20  # a ruler
    return picture.astype(np.float32)


def _patterned(rng: np.random.Generator, shape: tuple[int, int], level: float, kind: str) -> NDArray[np.float32]:
    """Bricks, or a plank with grain along it."""
    y, x = np.mgrid[: shape[0], : shape[1]]
    if kind == "brick":
        high, wide = rng.uniform(8, 16), rng.uniform(18, 34)
        joint = (y % high < 1.5) | ((x + (y // high % 2) * wide / 2) % wide < 1.5)
        return (level - rng.uniform(15, 45) * joint).astype(np.float32)
    grain = cv2.GaussianBlur(rng.standard_normal(shape).astype(np.float32), (0, 0), 30, sigmaY=1.5)
    return (level + 12 * grain / grain.std()).astype(np.float32)


class _Drawer:
    """Bodies, hand, cable and shadow of a film."""

    def __init__(
        self,
        rng: np.random.Generator,
        some: list[str],
        size: tuple[int, int, int],
        bodies: tuple[Body, Body | None],
        rest: float,
    ) -> None:
        body, self.second = bodies
        self.some, self.size, self.body = some, size, body
        h, w, n = size
        self.grey, self.width = rng.uniform(80, 220), rng.uniform(0.12, 0.25) * h
        self.skin = cv2.GaussianBlur(rng.standard_normal((h, w)).astype(np.float32), (0, 0), 4) * rng.uniform(20, 120)
        go = rest * n
        t = np.arange(n)
        away = np.clip((t - go) / max(0.1 * n, 4), 0, 1) ** 1.5 + np.clip((0.3 * go - t) / max(0.3 * go, 1), 0, 1)
        holds = np.array(
            [
                -np.sign(body.centre[-1, 0] - body.centre[0, 0] or 1) * body.half[0],
                -rng.uniform(0.2, 1.0) * body.half[1],
            ]
        )
        out = np.array([rng.uniform(-0.3, 0.3) * w, -h * 1.3 if rng.random() < 0.7 else h * 1.3])
        self.tip = body.centre[0] + holds + away[:, None] * out + _smooth(rng, n, 6)
        self.root = self.tip + out * 2
        self.foot, self.swing = (
            rng.uniform(0.1, 0.9) * w,
            rng.uniform(0.05, 0.2) * w * np.sin(rng.uniform(0.03, 0.2) * t + rng.uniform(0, 6)),
        )
        self.thick, self.cable_grey = int(rng.integers(2, 5)), float(rng.uniform(10, 240))
        self.dark, self.follows = rng.uniform(0.55, 0.85), rng.random() < 0.6
        self.at = np.stack(
            [np.linspace(-0.2, 1.2, n)[:: rng.choice([-1, 1])] * w, np.full(n, rng.uniform(0.3, 0.8) * h)], axis=1
        )
        self.offset = rng.uniform(-1.2, 1.2, 2) * body.half + (0, body.half[1])

    def all(self, picture: NDArray[np.float32], i: int) -> None:
        """Draw everything that moves in frame i."""
        self.shadow(picture, i)
        if self.second is not None:
            self.second.draw(picture, i)
        self.body.draw(picture, i)
        self.cable(picture, i)
        self.hand(picture, i)

    def shadow(self, picture: NDArray[np.float32], i: int) -> None:
        """A soft dark place, of the body or of something outside."""
        if "shadow" not in self.some:
            return
        x, y = self.body.centre[i] + self.offset if self.follows else self.at[i]
        yy, xx = np.mgrid[: self.size[0], : self.size[1]]
        rx, ry = (self.body.half * (1.1, 0.8)) if self.follows else (0.12 * self.size[1], 0.5 * self.size[0])
        inside = np.clip((1 - np.hypot((xx - x) / rx, (yy - y) / ry)) * 4, 0, 1)
        picture *= (1 - (1 - self.dark) * inside).astype(np.float32)

    def cable(self, picture: NDArray[np.float32], i: int) -> None:
        """A thin line from the upper edge that swings."""
        if "cable" not in self.some:
            return
        s = np.linspace(0, 1, 20)
        line = np.stack([self.foot + self.swing[i] * s**1.5, 0.8 * self.size[0] * s], axis=1)
        cv2.polylines(picture, [np.rint(line * 16).astype(np.int32)], False, self.cable_grey, self.thick, cv2.LINE_8, 4)

    def hand(self, picture: NDArray[np.float32], i: int) -> None:
        """An arm from beyond the edge that holds the body at rest, and is taken away."""
        if "hand" not in self.some:
            return
        mask = np.zeros(picture.shape, np.uint8)
        ends = [tuple(int(q) for q in np.rint(16 * p)) for p in (self.tip[i], self.root[i])]
        cv2.line(mask, *ends, 255, int(self.width), cv2.LINE_8, 4)
        cv2.circle(mask, ends[0], int(16 * 0.6 * self.width), 255, -1, cv2.LINE_8, 4)
        share = cv2.GaussianBlur(mask, (0, 0), 0.7).astype(np.float32) / 255
        skin = np.roll(self.skin, np.rint(self.tip[i]).astype(int)[::-1], axis=(0, 1))
        picture += share * (self.grey + skin - picture)
