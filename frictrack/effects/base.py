"""What an effect is: one physical cause with a name, a function that returns columns, and named parameters."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np

from frictrack.effects.plausibility import Check
from frictrack.records import GRAVITY, Array

Nonlinear = Mapping[str, float]
Columns = Callable[..., Array]  # (path, nonlinear) -> (n, k), or (path, nonlinear, inner) for a modifier


@dataclass(frozen=True)
class Path:
    """The motion of one run along which columns are evaluated, and what is known of that run.

    All arrays have shape (n,). `s` is the direction of motion (+1 or -1), held fixed within a moving phase so
    that a law stays smooth through v = 0. `load` is the normal load over its reference, times the run's own
    friction level; `mass_ratio` the mass over its reference. Searches lay many individuals end to end on one path;
    what integrates along the path begins anew at each of `starts`. `before` (3, k) holds t, x, v of the run's motion
    from release up to where the path begins, for what depends on the way so far.
    """

    t: Array  # s since release
    x: Array  # m
    v: Array  # m/s
    s: Array
    load: float = 1.0
    mass_ratio: float = 1.0
    pixel_pitch: float | None = None  # m
    drive: Array | None = None  # N
    drive_at: Callable[[Array], Array] | None = None  # N at any times since release
    lift: Array | None = None  # vertical acceleration of the mass, m/s^2, up positive
    mass: float | None = None  # kg, where it is known
    gravity: float = GRAVITY  # normal load per mass of a mass at rest, m/s^2
    angle: Array | None = None  # rad, by which the target has turned counter-clockwise
    clamp_x: float | None = None  # m, where the beam is clamped
    beam_length: float | None = None  # m
    travelled: float | Array = 0.0  # m slid from release to `begins`
    begins: float | Array | None = None  # m, a place of this path; default its first
    before: Array | None = None
    starts: tuple[int, ...] = (0,)  # where each individual of a population laid end to end begins
    states: Mapping[str, Array] = field(default_factory=dict)  # by effect: the memory it begins with, where known
    begin: Array | None = None  # that of the effect at hand, (P, k)

    @property
    def speed(self) -> Array:
        """|v| along the direction of motion, never below zero."""
        return np.maximum(self.s * self.v, 0.0)

    @property
    def distance(self) -> Array:
        """Distance slid since release, m."""
        first = self.each(self.x[list(self.starts)]) if self.begins is None else self.begins
        return np.asarray(self.travelled + np.abs(self.x - first))

    def each(self, values: Array) -> Array:
        """One value per individual (P,), spread over the frames of each, (n,)."""
        return np.repeat(values, np.diff([*self.starts, len(self.t)]))


# What an effect may need to know of a run, in words: what it is, and how it is given.
NEEDS = {
    "pixel_pitch": ("the pixel pitch", "give scale in [camera]"),
    "drive": ("a measured drive", 'give drive = "drive.csv"'),
    "lift": ("the vertical motion", "give a film, or a table with a column y_m"),
    "angle": ("the angle of the target", "give a film: a table has no angle"),
    "clamp_x": ("the place of the clamp", 'give clamp_x = "20 mm"'),
}


@dataclass(frozen=True)
class Span:
    """How far the recorded runs reach: what a scan can hope to see."""

    duration: float  # s, of the longest run
    x_min: float  # m
    x_max: float
    v_min: float  # m/s, slowest speed seen
    v_max: float
    fps: float  # Hz
    clamp_x: float | None = None  # m
    beam_length: float | None = None  # m, where it is known


@dataclass(frozen=True)
class Parameter:
    """A named number of an effect, with unit and bounds.

    `linear` ones are the coefficients of the effect's columns, in order. The others are non-linear: `scan`
    gives the grid on which they are first looked for, `known` the value where the runs tell it. A `phase` is never
    scanned: its two quadratures are.
    A `depth` scales what a modifier changes; it is scanned as if it were a coefficient.
    `per_run` parameters have one value in every run.
    """

    name: str
    unit: str
    bounds: tuple[float, float] = (-np.inf, np.inf)
    linear: bool = False
    per_run: bool = False
    role: Literal["", "phase", "depth", "amplitude"] = ""
    scan: Callable[[Span], Array] | None = None
    known: Callable[[Span], float | None] | None = None
    fixed: float | None = None
    loaded: bool = False  # a coefficient whose column carries the load and the run's friction level
    signed: bool = False  # a place, which may lie on either side of zero; others are positive sizes
    prior: tuple[float, float] | None = None  # what is known beside the runs: mean and standard deviation
    passive: bool = False  # below zero it would drive the motion
    tie: str | None = None  # what it equals: "vibration.frequency", or a multiple, "2*vibration.frequency"

    @property
    def free(self) -> bool:
        """Whether it is sought: neither fixed nor tied to another one."""
        return self.fixed is None and self.tie is None


@dataclass(frozen=True)
class Effect:
    """One physical cause: what it adds to the friction force (N) or to the picture of it (m)."""

    name: str
    acts_on: Literal["force", "measurement"]
    equation: str
    parameters: tuple[Parameter, ...]
    columns: Columns
    modifies: frozenset[str] = frozenset()
    replaces: frozenset[str] = frozenset()
    scales_with: str = "nothing"  # what carries its size from one run to another: load, mass, drive, nothing
    what: str = ""  # what it is physically
    looks_like: str = ""
    mistaken_for: str = ""
    confirm: str = ""
    source: str = ""
    needs: tuple[str, ...] = ()  # what a run must know, keys of `NEEDS`
    fine: int = 1  # integration panels per frame that its columns need
    memory: bool = False  # its columns depend on the whole motion so far, not on the moment alone
    state: Columns | None = None  # what it remembers at every sample, (n, k), of the same arguments as its columns
    turns: bool = False  # its force passes a stop or a reversal without a jump
    rank: int = 0  # order among modifiers: one of higher rank reshapes what those of lower rank have left
    relaxed: tuple[Part, ...] = ()  # what it is where every one of its waves has an amplitude of its own
    formula: str | None = None  # of a user's effect that a study file writes as a formula
    clock: Callable[[Nonlinear], float] | None = field(default=None, compare=False)  # true over recorded times of a run
    plausible: Check | None = field(default=None, compare=False)  # objection to fitted values in one run; default none
    quote: Callable[[dict[str, float], dict[str, float]], dict[str, float]] | None = field(default=None, compare=False)

    @property
    def kind(self) -> str:
        """The library name: `vibration` of the instance `vibration:2`."""
        return self.name if self.name.startswith("atm2") else self.name.split(":")[0]

    def lacks(self, paths: Sequence[Path]) -> str:
        """What the runs of these paths do not tell although the effect needs it, in words; "" where nothing."""
        gone = [NEEDS[need] for need in self.needs if any(getattr(path, need) is None for path in paths)]
        if not gone:
            return ""
        return f"{self.name} needs {' and '.join(what for what, _ in gone)} of every run; " + ", ".join(
            how for _, how in gone
        )

    @property
    def linear(self) -> tuple[Parameter, ...]:
        """Coefficients of the columns, in order."""
        return tuple(p for p in self.parameters if p.linear)

    @property
    def nonlinear(self) -> tuple[Parameter, ...]:
        """What the columns themselves depend on."""
        return tuple(p for p in self.parameters if not p.linear)

    @property
    def quoted(self) -> frozenset[str]:
        """Parameters that are quoted otherwise than they are sought, such as F_s for F_s - F_c."""
        return frozenset() if self.quote is None else frozenset(self.quote({p.name: 1.0 for p in self.parameters}, {}))

    @property
    def sized(self) -> bool:
        """Whether it has a size: coefficients, or a depth."""
        return any(p.linear or p.role == "depth" for p in self.parameters)

    @property
    def single(self) -> bool:
        """Whether it is an event of single runs: each is scanned by itself, and those that do not show it lack it."""
        own = any(p.scan is not None and p.per_run and p.free for p in self.nonlinear)
        return own or self.clock is not None

    def parameter(self, name: str) -> Parameter:
        """The parameter of that name."""
        return next(p for p in self.parameters if p.name == name)

    def called(self, name: str) -> Effect:
        """The same cause as another instance."""
        return replace(self, name=name)

    def adjusted(self, **changes: dict[str, Any]) -> Effect:
        """A copy whose named parameters have the given fields changed: ``adjusted(phase={"per_run": False})``."""
        known = {p.name for p in self.parameters}
        if not changes.keys() <= known:
            raise KeyError(f"{self.name} has {', '.join(sorted(known))} but not {', '.join(changes.keys() - known)}")
        parameters = tuple(_adjusted(p, changes.get(p.name, {})) for p in self.parameters)
        return replace(self, parameters=parameters)


@dataclass(frozen=True)
class Part:
    """A part of a relaxed effect; `names` are what the whole calls its parameters, in order."""

    effect: Effect
    names: tuple[str, ...]


FEWEST = 9  # places in a scan between bounds


@dataclass(frozen=True)
class Within:
    """A scan that keeps to bounds; without a grid of its own it runs evenly from one to the other."""

    bounds: tuple[float, float]
    scan: Callable[[Span], Array] | None = None

    def __call__(self, span: Span) -> Array:
        """Values worth trying, at least `FEWEST` where the scan has as many and the bounds leave room."""
        low, high = self.bounds
        if self.scan is None:
            return np.linspace(low, high, FEWEST)
        grid = self.scan(span)
        inside = grid[(grid >= low) & (grid <= high)]
        if len(inside) >= min(FEWEST, len(grid)):
            return inside
        if np.all(np.isfinite(self.bounds)):
            return np.linspace(low, high, FEWEST)
        return np.unique(np.clip(grid, low, high))


def _adjusted(p: Parameter, change: Mapping[str, Any]) -> Parameter:
    """A changed parameter; the scan of one with new bounds keeps to them, one that is freed gets a scan."""
    made = replace(p, **change)
    inner = made.scan.scan if isinstance(made.scan, Within) else made.scan
    scanned = not (made.linear or made.role in ("phase", "depth"))
    freed = inner is None and made.free and bool(np.all(np.isfinite(made.bounds)))
    if scanned and (freed or ("bounds" in change and inner is not None)):
        return replace(made, scan=Within(made.bounds, inner))
    return made


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


def frequencies(span: Span) -> Array:
    """Scan of a line in time, Hz: a quarter of a Rayleigh cell apart, at least one period in the longest run."""
    lowest = max(1.0 / span.duration, 2.0)
    highest = max(min(0.2 * span.fps, 600.0), 2 * lowest)
    return np.arange(lowest, highest, 0.25 / span.duration)


def log_grid(low: float, high: float, per_decade: int) -> Array:
    """Logarithmic scan from low to high with about so many points per decade."""
    return np.geomspace(low, high, max(2, round(per_decade * np.log10(high / low)) + 1))
