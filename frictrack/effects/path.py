"""The motion of one run, along which the columns of an effect are evaluated, and sinusoids along it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from frictrack.records import GRAVITY, Array, EarlierRuns, Mask

# What the files of effects are written with, types of arrays included.
__all__ = ["Array", "Mask", "Nonlinear", "Path", "ScanWave", "over_position", "over_time", "wave"]

Nonlinear = Mapping[str, float]  # non-linear parameters of an effect by name, SI units
# What an effect may need to know of a run, in words: what it is, and how it is given.
NEEDS = {
    "pixel_pitch": ("the pixel pitch", "give scale in [camera]"),
    "drive": ("a measured drive", 'give drive = "drive.csv"'),
    "lift": ("the vertical motion", "give a film, or a table with a column y_m"),
    "angle": ("the angle of the target", "give a film: a table has no angle"),
    "clamp_x": ("the place of the clamp", 'give clamp_x = "20 mm"'),
    "earlier": ("the pause", 'give pause = "60 s", the time since the end of the run before, from the second run on'),
}


@dataclass(frozen=True)
class Path:
    """The motion of one run along which columns are evaluated, and what is known of that run.

    All arrays have shape (n,). `s` is the direction of motion (+1 or -1), held fixed within a moving phase so
    that a law stays smooth through v = 0. `load` is the normal load over its reference, times the run's own
    friction level; `mass_ratio` the mass over its reference. Searches lay many individuals end to end on one path;
    what integrates along the path begins anew at each of `starts`. Several `runs` may be laid end to end too; what
    differs between them is then an array with one value per sample. `before` (3, k) holds t, x, v of the run's motion
    from release up to where the path begins, for what depends on the way so far; `earlier` holds for every stretch the
    runs that were made before on the same surfaces, where they are known.
    """

    t: Array  # s since release
    x: Array  # m
    v: Array  # m/s
    s: Array
    load: float | Array = 1.0
    mass_ratio: float | Array = 1.0
    pixel_pitch: float | None = None  # m
    drive: Array | None = None  # N
    drive_at: Callable[[Array], Array] | None = None  # N at any times since release
    lift: Array | None = None  # vertical acceleration of the mass, m/s^2, up positive
    mass: float | Array | None = None  # kg, where it is known
    gravity: float | Array = GRAVITY  # normal load per mass of a mass at rest, m/s^2
    angle: Array | None = None  # rad, by which the target has turned counter-clockwise
    clamp_x: float | None = None  # m, where the beam is clamped
    beam_length: float | None = None  # m
    travelled: float | Array = 0.0  # m slid from release to `begins`
    begins: float | Array | None = None  # m, a place of this path; default its first
    before: Array | None = None
    earlier: tuple[EarlierRuns, ...] | None = None  # of each of `starts`; of many, they repeat
    starts: tuple[int, ...] = (0,)  # where each individual of a population laid end to end begins
    states: Mapping[str, Array] = field(default_factory=dict)  # by effect: the memory it begins with, where known
    begin: Array | None = None  # that of the effect at hand, (P, k)
    steady: bool = False  # whether every sample is a measurement of its own, without time, place or a motion before
    runs: tuple[Path, ...] = ()  # the path of each run, if it joins several; their motion is not that of this path

    @cached_property
    def speed(self) -> Array:
        """Size of v along the direction of motion, m/s, never below zero."""
        return np.maximum(self.s * self.v, 0.0)

    @property
    def distance(self) -> Array:
        """Distance slid since release, m."""
        first = self.each(self.x[list(self.starts)]) if self.begins is None else self.begins
        return np.asarray(self.travelled + np.abs(self.x - first))

    def each_earlier(self) -> list[EarlierRuns]:
        """The runs before each of `starts`."""
        assert self.earlier is not None
        return list(self.earlier) * (len(self.starts) // len(self.earlier))

    def apart(self) -> Iterator[tuple[slice, Path]]:
        """Rows and path of every run that is joined here."""
        for begin, end, run in zip(self.starts, [*self.starts[1:], len(self.t)], self.runs, strict=True):
            rows = slice(begin, end)
            load = np.broadcast_to(self.load, self.t.shape)[begin]
            yield rows, replace(run, x=self.x[rows], v=self.v[rows], s=self.s[rows], load=float(load))

    def each(self, values: Array) -> Array:
        """One value per individual (P,), spread over the frames of each, (n,)."""
        return np.repeat(values, np.diff([*self.starts, len(self.t)]))


def joined_earlier(paths: Sequence[Path]) -> tuple[EarlierRuns, ...] | None:
    """The runs before each stretch of paths that are laid end to end; None where those of one are not known."""
    each = [path.earlier for path in paths if path.earlier is not None]
    return tuple(own for earlier in each for own in earlier) if len(each) == len(paths) else None


@dataclass(frozen=True)
class ScanWave:
    """That columns depend on one scanned parameter only as sin(2 pi q u + phase): a scan may interpolate in q.

    Attributes
    ----------
    parameter : str
        The frequency q, or the period 1/q.
    coordinate : callable
        Map a path and the other non-linear parameters to u (n,), whose unit is that of 1/q.
    is_period : bool
        Whether the parameter is a period.

    """

    parameter: str
    coordinate: Callable[[Path, Any], Array]
    is_period: bool = False

    def frequency(self, values: Array) -> Array:
        """Convert values of the parameter to q, or q to values of the parameter."""
        return 1.0 / values if self.is_period else values


def over_time(path: Path, nonlinear: Any) -> Array:
    """Return the coordinate u of a wave in time, s."""
    return path.t


def over_position(path: Path, nonlinear: Any) -> Array:
    """Return the coordinate u of a wave in space, m."""
    return path.x


def wave(cycles: Array, phase: float) -> Array:
    """One column sin(2 pi cycles + phase), shape (n, 1); a sin + b cos is one amplitude and one phase."""
    # sin z = 2 u/(1 + u^2) with u = tan(z/2): numpy's tangent takes many numbers at once, its sine one by one
    u = np.pi * cycles
    u += phase / 2
    np.tan(u, out=u)
    below = u * u
    below += 1.0
    u += u
    u /= below
    return u[:, None]
