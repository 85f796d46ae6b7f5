"""The camera of the simulated film: from light on a pixel to a number, with shot noise, read noise and bits."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import make_interp_spline

from frictrack.errors import gather
from frictrack.records import Array

WHITE = 0.8  # part of the full well that a white surface fills
MANY = 1000  # e-: from here on shot noise is drawn from a Gaussian (skewness below 0.03), eight times faster


@dataclass(frozen=True)
class Oscillation:
    """amplitude * sin(2 pi frequency t + phase): a nuisance of known truth."""

    amplitude: float
    frequency: float  # Hz
    phase: float = 0.0  # rad

    def __call__(self, t: Array) -> Array:
        """Value at the times t (any shape), s."""
        return self.amplitude * np.sin(2 * np.pi * self.frequency * t + self.phase)


@dataclass(frozen=True)
class Camera:
    """A high-speed camera. Frame i is exposed symmetrically round t = i / fps.

    Flicker is relative to the light, which besides changes by `drift` per second; shake moves the whole picture
    and is not part of the target's position. Every pixel has a sensitivity of its own, of relative standard
    deviation `prnu` (photo response non-uniformity, drawn from `prnu_seed`): a pattern fixed in the picture.
    """

    fps: float = 4000.0
    width: int = 640
    height: int = 96
    scale: float = 0.5e-3  # m/px
    exposure: float = 0.1  # part of the frame interval
    bit_depth: int = 8
    full_well: float = 15_000.0  # e-
    read_noise: float = 20.0  # e-
    black: float = 4.0  # digital number of no light
    prnu: float = 0.0  # relative
    prnu_seed: int = 0
    flicker: Oscillation | None = None
    drift: float = 0.0  # 1/s
    shake_x: Oscillation | None = None  # px
    shake_y: Oscillation | None = None  # px

    def __post_init__(self) -> None:
        faults = [
            f"expected {name} above 0 but got {getattr(self, name):g}"
            for name in ("fps", "width", "height", "scale", "full_well")
            if not getattr(self, name) > 0
        ]
        if not 0 <= self.exposure <= 1:
            faults.append(
                f"expected an exposure between 0 and 1 frame interval but got {self.exposure:g}; "
                "divide the shutter time by the frame interval"
            )
        if self.bit_depth not in (8, 12, 16):
            faults.append(f"expected a bit depth of 8, 12 or 16 but got {self.bit_depth}")
        if not 0 <= self.prnu < 0.2:
            faults.append(f"expected a flat-field noise between 0 and 0.2 but got {self.prnu:g}; 0.01 is 1 %")
        if not self.read_noise >= 0:
            faults.append(f"expected a read noise of at least 0 e- but got {self.read_noise:g} e-")
        if not 0 <= self.black < self.full_scale:
            faults.append(f"expected a black level within 0 to {self.full_scale} but got {self.black:g}")
        gather(faults, "camera")

    @property
    def full_scale(self) -> int:
        """Largest digital number."""
        return int(2**self.bit_depth - 1)

    @property
    def gain(self) -> float:
        """Digital numbers per electron: a full well is full scale."""
        return (self.full_scale - self.black) / self.full_well

    def shake(self, t: Array) -> tuple[Array, Array]:
        """Displacement of the whole picture at the times t (s), px."""
        still = np.zeros_like(t)
        return (self.shake_x(t) if self.shake_x else still, self.shake_y(t) if self.shake_y else still)

    def light(self, t: Array) -> Array:
        """Illumination at the times t (s), 1 without flicker and drift; never below 0."""
        flicker = self.flicker(t) if self.flicker else 0.0
        return np.maximum((1 + flicker) * (1 + self.drift * np.asarray(t)), 0.0)

    @cached_property
    def sensitivity(self) -> Array:
        """Relative sensitivity of every pixel (height, width)."""
        pattern = np.random.default_rng(self.prnu_seed).standard_normal((self.height, self.width))
        return np.maximum(1 + self.prnu * pattern, 0.0)

    def electrons(self, clean: Array) -> Array:
        """Mean number of electrons for light `clean` (1 = white)."""
        return np.clip(clean, 0, None) * (WHITE * self.full_well)

    def mean(self, clean: Array) -> Array:
        """Digital number without noise and rounding for light `clean` (1 = white)."""
        return self.black + self.gain * self.electrons(clean)

    def noise(self, clean: Array) -> Array:
        """Standard deviation, digital numbers: shot and read noise and rounding (photon transfer).

        Source: Janesick, Photon Transfer (2007): variance = gain (signal + gain read^2) + 1/12.
        """
        return np.sqrt(self.gain**2 * (self.electrons(clean) + self.read_noise**2) + 1 / 12)

    def record(self, clean: Array, rng: np.random.Generator) -> NDArray[Any]:
        """One frame (uint8, else uint16) of light `clean` (height, width); any shape where prnu is 0."""
        electrons = self.electrons(clean)
        if self.prnu:
            electrons = electrons * self.sensitivity
        if electrons.min() >= MANY:
            spread = np.sqrt(electrons + self.read_noise**2).astype(np.float32)
            electrons = electrons + spread * rng.standard_normal(clean.shape, dtype=np.float32)
        else:
            electrons = rng.poisson(electrons) + self.read_noise * rng.standard_normal(clean.shape)
        number = np.clip(np.rint(self.black + self.gain * electrons), 0, self.full_scale)
        return number.astype(np.uint8 if self.bit_depth == 8 else np.uint16)


def speckle_bound(clean_patch: Array, noise: Array | float) -> float:
    """Least standard deviation of the shift along x of a known picture in noise, px (Cramer-Rao bound).

    1 / sqrt(sum (g_x / noise)^2), g_x the slope along x of `clean_patch` (ny, nx), from a quintic spline;
    `noise` in the units of the patch. For the bound along y give both transposed.
    """
    x = np.arange(clean_patch.shape[1])
    slope = make_interp_spline(x, clean_patch, k=5, axis=1).derivative()(x)
    return float(1 / np.sqrt(np.sum((slope / noise) ** 2)))
