"""Simulate what a camera records of a mass of 0.35 kg at 4000 frames/s, with its true velocity and acceleration.

Closed forms, or scipy's DOP853 at tolerances far below a picometre; nothing of frictrack is used.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

Array = NDArray[np.float64]
Parameters = Mapping[str, float]
Path = tuple[Array, Array, Array]  # x m, v m/s, a m/s^2
Acceleration = Callable[[Array, Array], Array]  # of t and v

RATE, MASS, GRAVITY = 4000.0, 0.35, 9.81
MIN_SPEED = 0.06  # m/s at which a slide is cut off
MAX_FRAMES = 1000  # frames

# Friction f_c + (f_s - f_c) exp(-v/v_s) + f_v v in N; 5.75 m/s is left after 0.17 s.
SLIDE = {"x": 0.0, "v": 5.75, "fc": 8.0, "fs": 14.0, "fv": 1.2, "vs": 0.4}
LINE = {"F0": 2.0, "f0": 60.0, "phase0": 4.0}  # 5.7 m/s^2, 40 um
PULSE = {"at": 0.06, "J": 0.02, "width": 1.5e-3}  # half a sine, 60 m/s^2 at its peak


class Signal(NamedTuple):
    """True motion along the course at the frames of a film."""

    name: str
    t: Array
    x: Array
    v: Array
    a: Array
    events: tuple[float, ...] = ()  # s, where acceleration jumps or kinks
    parameters: Parameters = MappingProxyType({})  # what the parametric model has to find, if it is known
    model: Callable[[Parameters, Array], Path] | None = None  # the motion at times t for given parameters


def friction(v: Array, p: Parameters) -> Array:
    """Friction force (N) of forward motion; past its end a slide is cut off."""
    return p["fc"] + (p["fs"] - p["fc"]) * np.exp(-np.abs(v) / p["vs"]) + p["fv"] * v


def vibration(t: Array, p: Parameters) -> Array:
    """Sum of the lines F sin(2 pi f t + phase), each exp(-t/tau) if it has a tau, N."""
    total = np.zeros_like(t)
    for k in range(sum(name[0] == "F" for name in p)):
        decay = np.exp(-t / p[f"tau{k}"]) if f"tau{k}" in p else 1.0
        total = total + p[f"F{k}"] * decay * np.sin(2 * np.pi * p[f"f{k}"] * t + p[f"phase{k}"])
    return total


def pulse(t: Array, p: Parameters) -> Array:
    """Force (N) of a collision of impulse J (N s), half a sine of `width` s from `at` on."""
    phase = np.clip((t - p["at"]) / p["width"], 0.0, 1.0)
    return np.pi / 2 * p["J"] / p["width"] * np.sin(np.pi * phase)


def integrate(t: Array, start: tuple[float, float], acceleration: Acceleration, cuts: Sequence[float]) -> Path:
    """Path from `start` = (x, v) at cuts[0] on, at rest before; the integration restarts at every cut."""
    x, v, state = np.full_like(t, start[0]), np.zeros_like(t), np.array(start)
    for begin, end in zip(cuts, [*cuts[1:], max(t[-1], cuts[-1]) + 1 / RATE], strict=True):
        inside = (t >= begin) & (t < end)
        path = solve_ivp(
            lambda time, s: [s[1], acceleration(time, s[1])],
            (begin, end),
            state,
            method="DOP853",
            rtol=1e-12,
            atol=1e-14,
            max_step=2e-3,
            dense_output=True,
        )
        x[inside], v[inside] = path.sol(t[inside])
        state = path.y[:, -1]
    return x, v, np.where(t >= cuts[0], acceleration(t, v), 0.0)


def slide(p: Parameters, t: Array) -> Path:
    """Free slide with vibration and, if it has a J, a collision that brakes it."""

    def acceleration(t: Array, v: Array) -> Array:
        hit = pulse(t, p) if "J" in p else 0.0
        return (vibration(np.asarray(t), p) - friction(v, p) - hit) / MASS

    cuts = [0.0, *((p["at"], p["at"] + p["width"]) if "J" in p else ())]
    return integrate(t, (p["x"], p["v"]), acceleration, cuts)


def frames(n: int = MAX_FRAMES) -> Array:
    return np.arange(n) / RATE


def until_slow(path: Path, t: Array) -> tuple[Array, Array, Array, Array]:
    """Frames up to the first that is slower than 0.06 m/s after the fastest."""
    top = int(np.argmax(path[1]))
    n = top + int(np.argmax(path[1][top:] < MIN_SPEED)) + 1
    x, v, a = path
    return t[:n], x[:n], v[:n], a[:n]


def sliding(name: str, **more: float) -> Signal:
    """Slide from 5.75 m/s down to 0.06 m/s."""
    p = SLIDE | more
    t = frames(720)
    cut = until_slow(slide(p, t), t)
    events = (p["at"], p["at"] + p["width"]) if "J" in p else ()
    return Signal(name, *cut, events, p, slide)


def texture(name: str, amplitude: float = 1.5, period: float = 0.031) -> Signal:
    """Slide on a course with a texture: a force that is periodic in place, from 190 Hz downward."""
    t = frames(600)

    def acceleration(x: Array, v: Array) -> Array:
        return -(friction(v, SLIDE) + amplitude * np.sin(2 * np.pi * x / period)) / MASS

    found = solve_ivp(
        lambda _, s: [s[1], acceleration(*s)], (0.0, t[-1]), [0.0, SLIDE["v"]], t_eval=t, method="DOP853",
        rtol=1e-12, atol=1e-14, max_step=5e-4,
    )  # fmt: skip
    x, v = found.y
    return Signal(name, t, x, v, acceleration(x, v))


def stop(name: str) -> Signal:
    """Slide from 4 m/s that comes to rest and stays: acceleration jumps by 40 m/s^2 (analytic time of rest)."""
    p, t = SLIDE | {"v": 4.0}, frames(640)
    fall = solve_ivp(
        lambda _, s: [s[1], -friction(s[1], p) / MASS],
        (0.0, t[-1]),
        [0.0, p["v"]],
        method="DOP853",
        rtol=1e-12,
        atol=1e-14,
        max_step=2e-3,
        dense_output=True,
        events=_rest,
    )
    (end,), last = fall.t_events[0], fall.y[0, -1]
    moves = t < end
    x, v = np.where(moves, fall.sol(np.minimum(t, end)), [[last], [0.0]])
    return Signal(name, t, x, v, np.where(moves, -friction(v, p) / MASS, 0.0), (float(end),))


def _rest(_: float, state: Array) -> float:
    return float(state[1])


setattr(_rest, "terminal", True)  # noqa: B010 - how solve_ivp is told


def reversal(name: str, frequency: float = 4.97, amplitude: float = 0.06, dry: float = 3.0) -> Signal:
    """Mass on a spring with Coulomb friction `dry` (m/s^2), closed form: cosines about +-dry/omega^2 in turn."""
    t, omega = frames(), 2 * np.pi * frequency
    half = np.floor(2 * frequency * t).astype(int)  # number of the half swing
    sign, offset = np.where(half % 2, -1.0, 1.0), dry / omega**2
    # Half swing k starts at (-1)^k (amplitude - 2 k offset) and turns about (-1)^k offset.
    reach = amplitude - (2 * half + 1) * offset
    swing = omega * t - np.pi * half
    x = sign * (offset + reach * np.cos(swing))
    v, a = -sign * omega * reach * np.sin(swing), -sign * omega**2 * reach * np.cos(swing)
    turns = tuple((k + 1) / (2 * frequency) for k in range(half[-1]))
    return Signal(name, t, x, v, a, turns)


def push(name: str, at: float = 0.01, width: float = 0.02, peak: float = 155.9) -> Signal:
    """Rest, a half-sine push of 20 ms up to 5 m/s, free slide; it breaks away when the push exceeds f_s."""
    t, away = frames(), at + width / np.pi * np.arcsin(SLIDE["fs"] / peak)

    def acceleration(t: Array, v: Array) -> Array:
        drive = peak * np.sin(np.pi * np.clip((t - at) / width, 0.0, 1.0))
        return (drive - friction(v, SLIDE)) / MASS

    path = integrate(t, (0.0, 0.0), acceleration, [away, at + width])
    return Signal(name, *until_slow(path, t), (away, at + width))


def incline(name: str, release: float = 0.0101, slope: float = 35.0) -> Signal:
    """Held on an incline of 35 degrees and let go: from rest, acceleration jumps by 2.3 m/s^2."""
    p, t = {"fc": 0.8, "fs": 1.16, "fv": 0.25, "vs": 0.15}, frames()
    pull = MASS * GRAVITY * np.sin(np.deg2rad(slope))
    path = integrate(t, (0.0, 0.0), lambda _, v: (pull - friction(v, p)) / MASS, [release])
    return Signal(name, t, *path, (release,))


SIGNALS: dict[str, Callable[[str], Signal]] = {
    "vib": partial(sliding, **LINE),
    "coll": partial(sliding, **LINE, **PULSE),
    "plain": sliding,
    "two": partial(sliding, **LINE, F1=1.2, f1=134.0, phase1=1.0),
    "high": partial(sliding, F0=2.0, f0=300.0, phase0=4.0),
    "decay": partial(sliding, F0=6.0, f0=90.0, phase0=4.0, tau0=0.03),
    "texture": texture,
    "stop": stop,
    "reversal": reversal,
    "push": push,
    "incline": incline,
}


def signal(name: str) -> Signal:
    """A signal by its name."""
    return SIGNALS[name](name)
