"""The model of a camera, from light on a pixel to a digital number; what lies before it, and the film it writes."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import chain
from pathlib import Path
from typing import Annotated, Any, ClassVar

import cv2
import numpy as np
import tifffile
from numpy.typing import NDArray
from pydantic import ConfigDict, Field
from scipy.special import erf

from frictrack.base.errors import FrictrackError, raise_faults
from frictrack.base.files import atomic_write
from frictrack.records import Array

NO_OTHER_KEYS = ConfigDict(extra="forbid")  # in the tables of a scene file
Side = Annotated[int, Field(ge=8, le=16_384)]  # of a picture of a scene, px
WHITE_LEVEL = 0.8  # share of the full well that a white surface fills
MIN_GAUSSIAN_ELECTRONS = 1000  # from here on shot noise is drawn from a Gaussian: skewness below 0.03, 8 times faster


@dataclass(frozen=True)
class Oscillation:
    """Sinusoid amplitude * sin(2 pi frequency t + phase).

    Attributes
    ----------
    amplitude
        In the unit of what oscillates.
    frequency
        Hz.
    phase
        At t = 0, rad.

    Examples
    --------
    >>> round(float(Oscillation(2.0, frequency=50.0)(np.array(0.005))), 12)
    2.0

    """

    __pydantic_config__: ClassVar = NO_OTHER_KEYS
    amplitude: float
    frequency: float  # Hz
    phase: float = 0.0  # rad

    def __call__(self, t: Array) -> Array:
        """Value at the times t (any shape), s, in the unit of the amplitude."""
        return self.amplitude * np.sin(2 * np.pi * self.frequency * t + self.phase)

    def second_derivative(self) -> Oscillation:
        """Second derivative with respect to time, in the unit of the amplitude per s^2."""
        return replace(self, amplitude=-self.amplitude * (2 * np.pi * self.frequency) ** 2)


@dataclass(frozen=True)
class Camera:
    """A high-speed camera whose frame i is exposed symmetrically about t = i / fps.

    Attributes
    ----------
    fps
        Frames per second.
    width, height
        Size of the picture, px.
    scale
        Object size of one pixel, m/px.
    exposure
        Exposure time over the frame interval, 0 to 1.
    bit_depth
        8, 12 or 16.
    full_well, read_noise
        Electrons at full scale; standard deviation of the read noise in electrons.
    black
        Digital number without light.
    prnu, prnu_seed
        Photo response non-uniformity: relative standard deviation of the pixels' sensitivity, and the seed of the
        pattern, which is fixed in the picture.
    flicker
        Relative change of the light.
    drift
        Relative change of the light per second.
    shake_x, shake_y
        Displacement of the whole picture, px. It is not part of the target's position.

    """

    __pydantic_config__: ClassVar = NO_OTHER_KEYS
    fps: float = 4000.0
    width: Side = 640
    height: Side = 96
    scale: float = 0.5e-3  # m/px
    exposure: float = 0.1
    bit_depth: int = 8
    full_well: float = 15_000.0  # e-
    read_noise: float = 20.0  # e-
    black: float = 4.0
    prnu: float = 0.0
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
        raise_faults(faults, "camera")

    @property
    def full_scale(self) -> int:
        """Largest digital number."""
        return int(2**self.bit_depth - 1)

    @property
    def gain(self) -> float:
        """Digital numbers per electron; a full well gives full scale."""
        return (self.full_scale - self.black) / self.full_well

    def shake(self, t: Array) -> tuple[Array, Array]:
        """Displacement of the whole picture at the times t (s), px."""
        zero = np.zeros_like(t)
        return (self.shake_x(t) if self.shake_x else zero, self.shake_y(t) if self.shake_y else zero)

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
        return np.maximum(clean, 0) * (WHITE_LEVEL * self.full_well)

    def mean(self, clean: Array) -> Array:
        """Digital number without noise and rounding for light `clean` (1 = white)."""
        return self._digital_number(self.electrons(clean))

    def noise(self, clean: Array) -> Array:
        """Standard deviation of shot noise, read noise and rounding, for light `clean` (1 = white).

        Parameters
        ----------
        clean
            Light, any shape; 1 is white.

        Returns
        -------
        Array
            Standard deviation, digital numbers, same shape.

        References
        ----------
        Janesick 2007, Photon Transfer: variance = gain (signal + gain read^2) + 1/12.

        """
        return np.sqrt(self.gain**2 * (self.electrons(clean) + self.read_noise**2) + 1 / 12)

    def record(self, clean: Array, rng: np.random.Generator) -> NDArray[Any]:
        """Record one frame.

        Parameters
        ----------
        clean
            Light, 1 = white, shape (height, width); any shape where prnu is 0.
        rng
            Source of shot and read noise.

        Returns
        -------
        NDArray
            Digital numbers of the same shape: uint8 at 8 bit, else uint16.

        """
        electrons = self.electrons(clean)
        if self.prnu:
            electrons *= self.sensitivity
        if electrons.min() >= MIN_GAUSSIAN_ELECTRONS:
            noise = rng.standard_normal(clean.shape, dtype=np.float32)
            noise *= np.sqrt(electrons + self.read_noise**2).astype(np.float32)
            electrons += noise
        else:
            electrons = rng.poisson(electrons) + self.read_noise * rng.standard_normal(clean.shape)
        number = self._digital_number(electrons)
        np.rint(number, out=number)
        np.clip(number, 0, self.full_scale, out=number)
        return number.astype(np.uint8 if self.bit_depth == 8 else np.uint16)

    def _digital_number(self, electrons: Array) -> Array:
        """Digital number, not rounded, of a number of electrons."""
        number = self.gain * electrons
        number += self.black
        return number


@dataclass(frozen=True)
class Rod:
    """Upright rod in front of the course, with sub-pixel edges; it shakes with the scene.

    In the two columns that its edges cut, the free part of a pixel shows the mean light of that pixel.

    Attributes
    ----------
    x, width
        Place of the axis and width, px.
    reflectance
        Light of the rod; 1 is white.

    """

    __pydantic_config__: ClassVar = NO_OTHER_KEYS
    x: float
    width: float = 14.0
    reflectance: float = 0.06

    def __post_init__(self) -> None:
        faults = [] if self.width > 0 else [f"expected a width above 0 px but got {self.width:g} px"]
        if not self.reflectance >= 0:
            faults.append(f"expected a reflectance of at least 0 but got {self.reflectance:g}")
        raise_faults(faults, "rod")

    def cover(self, x_edges: Array) -> Array:
        """Share of each pixel that the rod hides, (..., n), for pixel borders x_edges (..., n + 1)."""
        return np.diff(np.clip(x_edges - self.x, -self.width / 2, self.width / 2))


@dataclass(frozen=True)
class Highlight:
    """Reflection of the lamp in a window, added to the picture and fixed in it: a Gaussian.

    Attributes
    ----------
    x, y
        Centre, px.
    radius
        Standard deviation, px.
    amplitude
        Light at the centre; 1 is white.

    """

    __pydantic_config__: ClassVar = NO_OTHER_KEYS
    x: float
    y: float
    radius: float = 14.0
    amplitude: float = 0.25

    def __post_init__(self) -> None:
        faults = [] if self.radius > 0 else [f"expected a radius above 0 px but got {self.radius:g} px"]
        if not self.amplitude >= 0:
            faults.append(f"expected an amplitude of at least 0 but got {self.amplitude:g}")
        raise_faults(faults, "highlight")

    def light(self, x_edges: Array, y_edges: Array) -> Array:
        """Added light (ny, nx), averaged over each pixel, for pixel borders x_edges (nx + 1,) and y_edges (ny + 1,)."""
        profile_x, profile_y = (self._profile(x_edges - self.x), self._profile(y_edges - self.y))
        return self.amplitude * np.outer(profile_y, profile_x)

    def _profile(self, edges: Array) -> Array:
        """Integral of exp(-z^2 / (2 radius^2)) from one border to the next."""
        return np.sqrt(np.pi / 2) * self.radius * np.diff(erf(edges / (np.sqrt(2) * self.radius)))


Frame = NDArray[Any]
WriteFrame = Callable[[Frame], object]


def write_film(frames: Iterable[Frame], path: str | os.PathLike[str], fps: float, quality: int = 95) -> int:
    """Write frames to a film; the suffix of the path chooses the format.

    .avi is MJPEG with 8 bit, .mov has lossless PNG frames with 8 bit, .tif and .tiff are uncompressed ImageJ stacks
    with 8 or 16 bit. A path without suffix becomes a folder of PNG files with 8 or 16 bit and no frame rate. A file
    is replaced only when all frames are written.

    Parameters
    ----------
    frames
        Pictures, each (height, width), uint8 or uint16.
    path
        File or folder to write.
    fps
        Frames per second.
    quality
        JPEG quality of .avi, 1 to 100.

    Returns
    -------
    int
        Number of frames written.

    Raises
    ------
    FrictrackError
        For an unknown suffix, no frames, frames that the format cannot hold, or a file that cannot be written.

    """
    path = Path(path)
    if path.suffix.lower() not in _WRITERS:
        known = ", ".join(suffix for suffix in _WRITERS if suffix)
        raise FrictrackError(f'{path.name}: expected a film ending in {known}, or a folder, but got "{path.suffix}"')
    frames = iter(frames)
    first = next(frames, None)
    if first is None:
        raise FrictrackError(f"{path.name}: expected at least one frame to write but got none")
    _check_frame(first, path)
    path.parent.mkdir(parents=True, exist_ok=True)
    with _atomic_file(path) as part, _WRITERS[path.suffix.lower()](part, first, fps, quality) as write_frame:
        n = 0
        for n, frame in enumerate(chain([first], frames), start=1):  # noqa: B007 - the count is the answer
            write_frame(np.ascontiguousarray(frame))
    return n


def _check_frame(frame: Frame, path: Path) -> None:
    """Raise FrictrackError for a frame that the format of the path cannot hold."""
    if frame.ndim != 2 or frame.dtype not in (np.uint8, np.uint16):
        raise FrictrackError(
            f"{path.name}: expected grey frames of 8 or 16 bit but got shape {frame.shape} of {frame.dtype}"
        )
    if path.suffix.lower() in (".avi", ".mov") and frame.dtype != np.uint8:
        raise FrictrackError(
            f"{path.name}: expected 8-bit frames for {path.suffix} but got {frame.dtype}; write .tif or a folder of PNG"
        )


@contextmanager
def _atomic_file(path: Path) -> Iterator[Path]:
    """Temporary file that replaces `path` when all frames are written; folders are filled in place."""
    if not path.suffix:
        path.mkdir(exist_ok=True)
        yield path
        return
    with atomic_write(path) as part:
        yield part


@contextmanager
def _opencv(codec: str, path: Path, frame: Frame, fps: float, quality: int) -> Iterator[WriteFrame]:
    """OpenCV writer of a codec; raise FrictrackError if this OpenCV cannot open it."""
    # OpenCV's own MJPEG writer, because FFmpeg's AVI muxer drops frames above 1000 fps and has no quality setting.
    mjpeg = codec == "MJPG"
    api = cv2.CAP_OPENCV_MJPEG if mjpeg else cv2.CAP_FFMPEG
    size = (frame.shape[1], frame.shape[0])
    writer = cv2.VideoWriter(str(path), api, cv2.VideoWriter.fourcc(*codec), fps, size, mjpeg)
    if not writer.isOpened():
        raise FrictrackError(f"{path.name}: expected OpenCV to write {codec} films but it cannot here; write .tif")
    writer.set(cv2.VIDEOWRITER_PROP_QUALITY, quality)  # of MJPEG; lossless codecs have none
    try:
        # Three equal channels, because the writer of MJPEG scrambles grey frames.
        yield lambda f: writer.write(cv2.cvtColor(f, cv2.COLOR_GRAY2BGR) if mjpeg else f)
    finally:
        writer.release()


@contextmanager
def _tiff(path: Path, frame: Frame, fps: float, quality: int) -> Iterator[WriteFrame]:
    about = {"finterval": 1 / fps}
    with tifffile.TiffWriter(path, imagej=True) as writer:
        yield lambda f: writer.write(f, contiguous=True, metadata=about)


@contextmanager
def _folder(path: Path, frame: Frame, fps: float, quality: int) -> Iterator[WriteFrame]:
    numbers = iter(range(10**9))

    def write_frame(f: Frame) -> None:
        name = path / f"frame_{next(numbers):06d}.png"
        if not cv2.imwrite(str(name), f):
            raise FrictrackError(f"{name}: expected to write this file but could not; check the folder and the disk")

    yield write_frame


# QuickTime keeps any frame rate; AVI does not (above), Matroska rounds time stamps to 1 ms.
_WRITERS: dict[str, Callable[[Path, Frame, float, int], AbstractContextManager[WriteFrame]]] = {
    ".avi": partial(_opencv, "MJPG"),
    ".mov": partial(_opencv, "png "),
    ".tif": _tiff,
    ".tiff": _tiff,
    "": _folder,
}
