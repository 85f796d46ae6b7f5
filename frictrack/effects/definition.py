"""One physical cause: its name, a function that returns columns, and named parameters with units and bounds.

`Path` is the motion of one run, along which the columns are evaluated. What an effect says of itself in the numbers of
a study, and what shows it directly, are phrases and checks of an `EffectInStudy`. A parameter carries over to another
set-up if it belongs to the sliding pair (`carries_over`).
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from string import Formatter
from typing import Any, Literal, Protocol

import numpy as np
from simpleeval import SimpleEval

from frictrack.base.number_format import format_length, format_number
from frictrack.effects.ranges import ACCELEROMETER_STD, Check, ScanWave, Span, Within
from frictrack.records import GRAVITY, EarlierRuns
from frictrack.records import Array as Array  # noqa: PLC0414 - the files of effects take both from here
from frictrack.records import Mask as Mask  # noqa: PLC0414

EVERY_FORCE = frozenset({"every force"})  # as `Effect.modifies`: of what shows the sum of all forces
OF_RUNS = ("mass_ratio", "gravity", "mass", "curvature", "lowest", "travelled", "begins")  # may differ in joined paths
CONSTANTS = {"g": GRAVITY, "pi": np.pi}  # of formulas and phrases
Columns = Callable[..., Array]  # (path, nonlinear) -> (n, k), or (path, nonlinear, inner) for a modifier
Nonlinear = Mapping[str, float]  # non-linear parameters of an effect by name, SI units
# What an effect may need to know of a run, in words: what it is, and how it is given.
NEEDS = {
    "pixel_pitch": ("the pixel pitch", "give scale in [camera]"),
    "drive": ("a measured drive", 'give drive = "drive.csv"'),
    "lift": ("the vertical motion", "give a film, or a table with a column y_m"),
    "angle": ("the angle of the target", "give a film: a table has no angle"),
    "clamp_x": ("the place of the clamp", 'give clamp_x = "20 mm"'),
    "upright": ("a circle that stands upright", 'give incline = "0 deg", and radius where x is the way along it'),
    "friction": ("a friction force that a load cell measured", 'give friction_N, or sensor = "cell.csv"'),
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
    friction: Array | None = None  # N, as a load cell shows it
    lift: Array | None = None  # vertical acceleration of the mass, m/s^2, up positive
    mass: float | Array | None = None  # kg, where it is known
    gravity: float | Array = GRAVITY  # normal load per mass of a mass at rest, m/s^2
    curvature: float | Array = 0.0  # 1/m, of a course that bends upward
    lowest: float | Array = np.nan  # m, where an upright circle is lowest; NaN on other courses
    pull: tuple[float | Array, float | Array] = (0.0, 0.0)  # down and forward at `lowest`, m/s^2, of which the load is
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
    remembered: Array | None = None  # what it remembers at every sample, (n, k), where it is known already
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

    @property
    def upright(self) -> bool | None:
        """Whether its runs lie on circles that stand upright; None if not."""
        return bool(np.all(np.isfinite(self.lowest))) or None

    def pressed(self, down: float | Array = GRAVITY, forward: float | Array = 0.0) -> Path:
        """Return the path with the load of its motion; it had that of a level straight course, or of another pull.

        On a circle that stands upright the load is the size of m (g cos(angle) + v^2/R), on a flat one the sum of
        weight and m v^2/R as vectors, as in a groove. `down`: of gravity at the lowest place, m/s^2; `forward`: what a
        slope adds there, so that the lowest place is elsewhere.
        """
        if not np.any(self.curvature) or all(map(np.array_equal, self.pull, (down, forward))):
            return self
        flat = np.isnan(self.lowest)
        angle = self.curvature * (self.x - np.where(flat, 0.0, self.lowest))

        def inward(down: float | Array, forward: float | Array) -> Array:
            weight = np.where(flat, 0.0, down * np.cos(angle) - forward * np.sin(angle))
            return np.hypot(weight + self.curvature * self.v**2, np.where(flat, GRAVITY, 0.0))

        before = inward(*self.pull) if np.any(self.pull[0]) else GRAVITY
        return replace(self, load=self.load * inward(down, forward) / before, pull=(down, forward))

    def each_earlier(self) -> list[EarlierRuns]:
        """The runs before each of `starts`."""
        assert self.earlier is not None
        return list(self.earlier) * (len(self.starts) // len(self.earlier))

    def apart(self) -> Iterator[tuple[slice, Path]]:
        """Rows and path of every run that is joined here."""
        begin = 0
        for run in self.runs:
            rows = slice(begin, begin + len(run.t))
            load = np.broadcast_to(self.load, self.t.shape)[rows]
            yield rows, replace(run, x=self.x[rows], v=self.v[rows], s=self.s[rows], load=load)
            begin = rows.stop

    def each(self, values: Array) -> Array:
        """One value per individual (P,), spread over the frames of each, (n,)."""
        return np.repeat(values, np.diff([*self.starts, len(self.t)]))


def joined_paths(paths: Sequence[Path]) -> Path:
    """Lay paths end to end: a series that one of them lacks is zero there, a number that of the first.

    Examples
    --------
    >>> one = Path(*np.zeros((4, 2)), load=1.0)
    >>> joined_paths([one, replace(one, load=1.5)]).load
    array([1. , 1. , 1.5, 1.5])

    """
    if len(paths) == 1:
        return paths[0]
    counts = [len(path.t) for path in paths]
    joined: dict[str, Any] = {name: np.concatenate([getattr(path, name) for path in paths]) for name in "txvs"}
    for name in ("drive", "lift", "angle"):
        series = [getattr(path, name) for path in paths]
        if any(own is not None for own in series):
            pairs = zip(series, counts, strict=True)
            joined[name] = np.concatenate([np.zeros(n) if own is None else own for own, n in pairs])
    for name in ("load", *OF_RUNS):
        if all(getattr(path, "begins" if name == "travelled" else name) is not None for path in paths):
            values = [getattr(path, name) for path in paths]
            parts = [np.broadcast_to(value, n) for value, n in zip(values, counts, strict=True)]
            are_equal = all(isinstance(value, float) and values[0] in (value,) for value in values)
            joined[name] = values[0] if are_equal else np.concatenate(parts)
    earlier = [path.earlier for path in paths if path.earlier is not None]
    begins = np.cumsum([0, *counts]).tolist()
    return replace(
        paths[0],
        **joined,
        before=None,
        earlier=tuple(own for each in earlier for own in each) if len(earlier) == len(paths) else None,
        starts=tuple(begin + start for begin, path in zip(begins, paths, strict=False) for start in path.starts),
    )


@dataclass(frozen=True)
class Parameter:
    """A named number of an effect, with unit and bounds.

    Attributes
    ----------
    name, unit : str
        Name and SI unit, as a study file and the results write them.
    bounds : tuple of float
        Lowest and highest value, in `unit`.
    linear : bool
        Whether it is a coefficient of a column of the effect. The linear parameters are in the order of the columns.
    per_run : bool
        Whether every run has its own value.
    role : {"", "phase", "depth", "amplitude"}
        A phase is never scanned: the two quadratures of the wave are fitted instead. A depth scales what a modifier
        changes; it is scanned as if it were a coefficient.
    scan : callable, optional
        Map a `Span` to the values on which the first search looks for a non-linear parameter.
    known : callable, optional
        Map a `Span` to the value, where the runs state it.
    fixed : float, optional
        A value that is not fitted.
    loaded : bool
        Whether its column carries the normal load and the friction level of the run.
    signed : bool
        Whether it is a place or a moment, which may lie on either side of zero; others are sizes above zero.
    prior : tuple of float, optional
        Mean and standard deviation, known from elsewhere than the runs.
    prior_correlation : tuple of (str, float)
        Correlations of that prior with the priors of other parameters, by address.
    passive : bool
        Whether a negative value would drive the motion.
    tie : str, optional
        What it equals: "vibration.frequency", or a multiple, "2*vibration.frequency".

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
    loaded: bool = False
    signed: bool = False
    prior: tuple[float, float] | None = None
    prior_correlation: tuple[tuple[str, float], ...] = ()
    passive: bool = False
    tie: str | None = None

    @property
    def is_size(self) -> bool:
        """Whether the force of its effect grows with it from nothing."""
        return self.linear or self.role in ("amplitude", "depth")

    @property
    def free(self) -> bool:
        """Whether it is fitted: neither fixed nor tied to another parameter."""
        return self.fixed is None and self.tie is None


@dataclass(frozen=True)
class TestDraw:
    """How an effect is drawn at random for a test study, where its parameters and scans do not say it.

    Attributes
    ----------
    positive : bool
        Whether its coefficients are drawn above zero; others have a random sign.
    impulse : bool
        Whether its coefficient is an impulse, N s: it takes the sign of the velocity of the run, and is at most a share
        of the momentum.
    only_with : frozenset of str
        Effects of which the base law must have one.
    own_size : bool
        Whether its size follows from its numbers (a lost frame); others are drawn relative to the detection limit.
    between_frames : str
        The parameter, a time in s, that is put midway between two frames; "" for none.
    coefficients : callable, optional
        Map a `Span` and two random numbers in [0, 1) to values of coefficients at unit size; others are 1.
    max_fps : float
        Highest frame rate of a camera that shows it, Hz.

    """

    __test__ = False  # no test class of pytest

    positive: bool = False
    impulse: bool = False
    only_with: frozenset[str] = frozenset()
    own_size: bool = False
    between_frames: str = ""
    coefficients: Callable[[Span, Array], Mapping[str, float]] | None = None
    max_fps: float = np.inf


PHRASE_FUNCTIONS = {"abs": abs, "exp": math.exp, "log": math.log}
LEVEL = "level"  # in an address such as "viscous.level": whether the friction levels of the runs multiply an effect
N_MARKS = 20  # of a rule, or flashes of a diode, that are evaluated


@dataclass(frozen=True)
class EffectRecord:
    """One effect along one run, at its n frames.

    Attributes
    ----------
    t : ndarray, shape (n,)
        Time since release, s.
    x, v : ndarray, shape (n,)
        Simulated displacement (m) and velocity (m/s).
    contribution : ndarray, shape (n,)
        What the effect adds: N, or m in the picture.
    noise : ndarray, shape (n,)
        Standard deviation of a measured position, m.
    whiten : callable
        Map a picture shift (n,) to residuals of unit variance, less what a change of the initial state
        would explain.
    mass : float
        Moving mass, kg.
    gravity : float
        Normal load per mass of a mass at rest, m/s^2.

    """

    t: Array
    x: Array
    v: Array
    contribution: Array
    noise: Array
    whiten: Callable[[Array], Array]
    mass: float
    gravity: float

    @property
    def frame_interval(self) -> float:
        """Median time between two frames, s."""
        return float(np.median(np.diff(self.t)))

    @property
    def marks(self) -> Array:
        """Rows of `N_MARKS` frames, evenly over the run."""
        return np.linspace(0, len(self.t) - 1, N_MARKS).astype(int)


class EffectInStudy(Protocol):
    """A fitted effect in the numbers of a study. `Effect.describe` and `DirectCheck.signal` take one.

    The "main run" is the run in which the effect is largest.
    """

    @property
    def run(self) -> str:
        """Name of the main run."""

    @property
    def mass(self) -> float:
        """Moving mass of the main run, kg."""

    @property
    def pixel_pitch(self) -> float | None:
        """Length of a pixel in the main run, m; None for a table."""

    @property
    def typical_speed(self) -> float:
        """Median speed of the main run, m/s."""

    @property
    def reference_weight(self) -> float:
        """Weight of the reference mass, N."""

    @property
    def stated_incline(self) -> float:
        """Incline of the main run as the study states it, rad; 0 where it states none."""

    @property
    def last_run(self) -> tuple[str, float]:
        """Name and duration (s since release) of the run that lasts longest."""

    @property
    def longest(self) -> EffectRecord:
        """The effect along the run with most frames."""

    @property
    def course(self) -> tuple[float, float]:
        """Smallest and largest place that any run reaches, m."""

    def value(self, parameter: str) -> float:
        """Fitted value of a parameter in the main run."""

    def rms(self, parameter: str) -> float:
        """Root mean square over the runs of the fitted values of a parameter."""

    def passes(self, place: float) -> str:
        """The first runs that pass a place (m), each with frame and speed, as text."""


@dataclass(frozen=True)
class DirectCheck:
    """A measurement other than a film of a run, which shows an effect itself.

    Attributes
    ----------
    key : str
        Short name of the measurement, such as "level".
    instruction : str
        What to do, as a sentence without a full stop.
    signal : callable
        Chi-squared that the effect would leave in the measurement if it is as large as fitted.

    """

    key: str
    instruction: str
    signal: Callable[[EffectInStudy], float]


@dataclass(frozen=True)
class Phrase:
    """A description in the numbers of a study, written like an f-string.

    Its names are the parameters of the effect, `study` (an `EffectInStudy`), `g` and `pi`: `{F}` is a value to three
    digits, `{2 * F:2}` twice it to two digits, `{period:m}` a length, `{x:.3f}` a number of another format.
    """

    text: str

    def __call__(self, effect: EffectInStudy) -> str:
        """Fill in the values of a fitted effect."""

        def named(name: str) -> Any:
            return effect if name == "study" else CONSTANTS[name] if name in CONSTANTS else effect.value(name)

        evaluator = SimpleEval(functions=PHRASE_FUNCTIONS, names=lambda node: named(node.id))
        parts = Formatter().parse(self.text)
        return "".join(
            text + (_formatted(evaluator.eval(value), spec or "") if value else "") for text, value, spec, _ in parts
        )


def _formatted(value: Any, spec: str) -> str:
    if isinstance(value, str):
        return value
    if spec == "m":
        return format_length(value)
    return format(value, spec) if "." in spec else format_number(value, int(spec or 3))


def picture_shift_signal(effect: EffectInStudy) -> float:
    """Return chi-squared of the picture shift along one run, seen on a mark that does not follow the mass."""
    record = effect.longest
    return float(np.sum(record.whiten(record.contribution) ** 2))


def acceleration_signal(effect: EffectInStudy) -> float:
    """Return chi-squared of the force at an accelerometer on the mass; an error of the picture has no signal there."""
    record = effect.longest
    return float(np.sum((record.contribution / record.mass / ACCELEROMETER_STD) ** 2))


ACCELEROMETER_CHECK = DirectCheck(
    "accelerometer", "Fix an accelerometer to the mass and give it as `sensor`", acceleration_signal
)


# Of a frequency that all runs share.
OSCILLATION = "{frequency} Hz, one swing every {1e3 / frequency} ms in every run"


@dataclass(frozen=True)
class Effect:
    """One physical cause: what it adds to the friction force (N) or to the picture of the motion (m).

    Everything that frictrack knows of an effect stands in its file and reaches the rest of the program by these fields.
    Only the first four are needed.

    Attributes
    ----------
    name : str
        Name in study files, commands and results.
    equation : str
        Formula in plain text.
    parameters : tuple of Parameter
        Linear parameters first, in the order of the columns.
    columns : callable
        Map a `Path` and the non-linear parameters to columns (n, k): N or m per unit of each linear parameter. A
        modifier takes the columns that it modifies as third argument.
    acts_on : {"force", "measurement"}
        Whether it is a force on the mass, or an error of the measured position.
    varies_with : {"", "x", "v", "xv"}, optional
        Which of position and velocity its columns at a sample depend on (not counting the direction of motion), if
        they depend on that sample alone. Runs that are laid end to end on one path are then evaluated at once.
        Without it they are evaluated run by run.
    modifies, replaces : frozenset of str
        Effects whose columns it changes (`EVERY_FORCE`: all); effects that cannot stand beside it in a model.
    special_cases : mapping, optional
        Simpler effects that it equals at certain values of its non-linear parameters: values by name of the effect. It
        is no rival of one of them, because it can only repeat with more parameters what that one explains.
    scales_with : {"nothing", "load", "mass", "drive"}
        What carries its size from one run to another.
    what, looks_like, mistaken_for, confirm, source : str
        What it is physically, how it shows, what it is confused with, how to confirm it, where the formula is from.
    invariant : str
        What it keeps when a run is made differently, as a sentence without a full stop.
    settled_by : str
        What to do where no film separates it from another effect, as a phrase.
    direct_check : DirectCheck, optional
        A measurement other than a film that shows it directly.
    describe : callable, optional
        Map an `EffectInStudy` to a phrase with the numbers of the study; a `Phrase` if it only fills in values. Without
        it the parameters are listed.
    plausible : callable, optional
        Map values of one run and its `Span` to an objection, or "" where they are physically sensible.
    needs : tuple of str
        What a run must tell, keys of `NEEDS`.
    fine : int
        Integration panels per frame that its columns need.
    memory : bool
        Whether its columns depend on the whole motion so far and not on the moment alone.
    counts_from_release : bool
        Whether its columns also depend on the motion from release to the first sample of a path, `Path.before`.
    state : callable, optional
        What it remembers at every sample, (n, k), of the same arguments as `columns`.
    turns : bool
        Whether its force passes a stop or a reversal without a jump.
    rank : int
        Order among modifiers: one of higher rank changes what those of lower rank have left.
    relaxed : tuple of RelaxedPart
        The same effect with an amplitude of its own for every wave.
    formula : str, optional
        Text of a user's formula.
    in_base_law : bool
        Whether it may belong to the law that a plan of experiments starts from.
    basic : bool
        Whether a verdict "complete" needs runs that would show it.
    may_pull : bool
        Whether it can pull the mass along, so that motion without a drive needs no incline.
    of_camera : bool
        Whether only a camera makes it, so that it is less likely where only tables are known.
    moves_picture : bool
        Whether it moves everything in the picture, so that a fixed reference in the film shows it.
    film_fault : bool
        Whether it is a fault that a film of the run itself can show.
    noted_as : tuple of str
        Phrases by which remarks of the tracking name the fault.
    same_cause_as : str
        Key of the study file ("fps", "incline") that would be wrong if this effect is there; "" for none.
    acts_within : callable, optional
        Map t (s), x (m), the values of a run, and a half width in time (s) to the frames in which a local effect acts.
    planned_size : callable, optional
        Map the momentum of the mass (N s) to the size for which a plan is made; others get a share of the friction.
    test_draw : TestDraw
        How it is drawn for a test study.
    clock : callable, optional
        True over recorded time of a run, for an effect of the clock.
    quote : callable, optional
        Map own fitted values, and all values of the model, to values as they are quoted, where these differ.
    frees : str
        The parameter that this version of an effect frees, or gives every run a value of its own; "" for others.
    level_is_chosen : bool
        Whether this version follows the friction levels where the library's does not, or the other way round.
    scan_wave : ScanWave, optional
        The parameter on which the columns depend only as the frequency or period of a sinusoid.

    """

    name: str
    equation: str
    parameters: tuple[Parameter, ...]
    columns: Columns
    acts_on: Literal["force", "measurement"] = "force"
    varies_with: str | None = None
    modifies: frozenset[str] = frozenset()
    replaces: frozenset[str] = frozenset()
    special_cases: Mapping[str, Mapping[str, float]] = field(default_factory=dict, compare=False)
    scales_with: str = "nothing"
    what: str = ""
    looks_like: str = ""
    mistaken_for: str = ""
    confirm: str = ""
    source: str = ""
    invariant: str = ""
    settled_by: str = ""
    direct_check: DirectCheck | None = field(default=None, compare=False)
    describe: Callable[[EffectInStudy], str] | None = field(default=None, compare=False)
    plausible: Check | None = field(default=None, compare=False)
    needs: tuple[str, ...] = ()
    fine: int = 1
    memory: bool = False
    counts_from_release: bool = False
    state: Columns | None = None
    turns: bool = False
    rank: int = 0
    relaxed: tuple[RelaxedPart, ...] = ()
    formula: str | None = None
    in_base_law: bool = False
    basic: bool = False
    may_pull: bool = False
    of_camera: bool = False
    moves_picture: bool = False
    film_fault: bool = False
    noted_as: tuple[str, ...] = ()
    same_cause_as: str = ""
    acts_within: Callable[[Array, Array, Mapping[str, float], float], Mask] | None = field(default=None, compare=False)
    planned_size: Callable[[float], float] | None = field(default=None, compare=False)
    test_draw: TestDraw = field(default_factory=TestDraw, compare=False)
    clock: Callable[[Nonlinear], float] | None = field(default=None, compare=False)
    quote: Callable[[dict[str, float], dict[str, float]], dict[str, float]] | None = field(default=None, compare=False)
    scan_wave: ScanWave | None = field(default=None, compare=False)
    frees: str = ""
    level_is_chosen: bool = False

    @property
    def title(self) -> str:
        """The name in a list of candidates: "texture", or "stribeck.delta" where that would be freed."""
        return f"{self.name}.{self.frees}" if self.frees else self.name

    def changed(self, effects: Iterable[Effect]) -> list[Effect]:
        """Those of some effects whose columns it changes."""
        forces = (e for e in effects if e.acts_on == "force" and not e.modifies)
        return [e for e in forces if e.kind in self.modifies or self.modifies == EVERY_FORCE]

    @property
    def of_record(self) -> bool:
        """Whether it is a setting of the record (its incline, its origin, scatter of its friction), and no cause."""
        own = [p for p in self.parameters if p.name == self.frees and p.per_run]
        return bool(own) or self.same_cause_as == "incline" or self.frees == LEVEL

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
    def is_of_velocity(self) -> bool:
        """Whether its force at a sample depends on velocity, direction and load there alone."""
        if self.formula is not None:
            return self.acts_on == "force" and not re.search(r"\b[xt]\b", self.formula)
        if self.acts_on == "measurement" or self.memory or self.counts_from_release or self.needs or self.single:
            return False
        v, order = np.array([0.3, -0.3, 1.7]), np.array([2, 0, 1])
        values = {p.name: float(np.clip(1.0, *p.bounds)) if p.fixed is None else p.fixed for p in self.nonlinear}
        inner = [np.abs(v)[:, None]] if self.modifies else []
        here = Path(np.zeros(3), np.zeros(3), v, np.sign(v))
        there = Path(np.array([1.0, 2.0, 4.0]), np.array([1.0, 0.5, 3.0]), v[order], np.sign(v[order]))
        now, later = (
            self.columns(path, values, *(c[rows] for c in inner)) for path, rows in ((here, [0, 1, 2]), (there, order))
        )
        return np.array_equal(now[order], later)

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
        """Parameters that are reported in another form than they are fitted, such as F_s for F_s - F_c."""
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

    def freed(self, name: str) -> Effect:
        """The version, in place of this one, that fits a fixed parameter or one that a stated setting holds.

        Any other gets a value of its own in every run; "level" is no parameter, but what the friction levels multiply.
        """
        if name == LEVEL:
            return replace(self.with_other_level(), replaces=self.replaces | {self.kind}, frees=name)
        p, own = self.parameter(name), self
        if p.fixed is not None:
            change: dict[str, Any] = {"fixed": None}
            what = f"{name} of {self.name} is held at {p.fixed:g} {p.unit}".removesuffix(" 1")
            what += "; it is fitted"
        elif self.same_cause_as and p.prior is not None:
            own = self.adjusted(**{name: {"prior": None, "per_run": True}})
            return replace(own, replaces=self.replaces | {self.kind}, frees=name)
        else:
            own = self.with_other_level() if p.loaded else self  # no level multiplies a size that a run has of its own
            change = {"per_run": True}
            as_ = ", as the origins of two records do" if p.unit == "m" else ""
            what = f"{name} of {self.name} differs from run to run{as_}; each has its own"
        changed = replace(own.adjusted(**{name: change}), replaces=self.replaces | {self.kind}, frees=name)
        return replace(changed, what=f"{what}.", looks_like="", confirm="", describe=None)

    @property
    def may_follow_level(self) -> bool:
        """Whether it is friction of which nobody knows whether it scatters from run to run as the rest does."""
        of_load = {p.loaded for p in self.linear}
        own = self.acts_on == "force" and not (self.modifies or self.memory or any(p.per_run for p in self.linear))
        of_speed = of_load == {False} and self.varies_with == "v"
        return own and (of_load == {True} or of_speed or self.level_is_chosen)

    def with_other_level(self) -> Effect:
        """The version that follows the friction level of each run, or does not follow it, if this one does."""
        follows = not self.linear[0].loaded

        def columns(path: Path, nonlinear: Nonlinear) -> Array:
            level = np.broadcast_to(path.load / path.mass_ratio, path.t.shape)[:, None]
            return self.columns(path, nonlinear) * (level if follows else 1 / level)

        changed = self.adjusted(**{p.name: {"loaded": follows} for p in self.linear})
        scales_with, chosen = "load" if follows else "nothing", not self.level_is_chosen
        return replace(changed, columns=columns, scales_with=scales_with, level_is_chosen=chosen)

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
class RelaxedPart:
    """A part of a relaxed effect; `names` are what the whole calls its parameters, in order."""

    effect: Effect
    names: tuple[str, ...]


def _adjusted(p: Parameter, change: Mapping[str, Any]) -> Parameter:
    """A changed parameter; the scan of one with new bounds keeps to them, one that is freed gets a scan."""
    made = replace(p, **change)
    inner = made.scan.scan if isinstance(made.scan, Within) else made.scan
    scanned = not (made.linear or made.role in ("phase", "depth"))
    freed = inner is None and made.free and bool(np.all(np.isfinite(made.bounds)))
    if scanned and (freed or ("bounds" in change and inner is not None)):
        return replace(made, scan=Within(made.bounds, inner))
    return made


SETUP_UNITS = ("Hz", "rad")  # frequencies and phases belong to the set-up


def carries_over(effect: Effect, parameter: Parameter) -> bool:
    """Return whether a parameter describes the sliding pair and not the set-up, the course or a single run.

    Its effect is a force that depends on the speed or on the normal load, not on the place, the mass or the drive; all
    runs share its value; and it is no phase, amplitude of a wave, depth, frequency, place or moment.

    Parameters
    ----------
    effect, parameter
        The effect, and one of its parameters.

    Examples
    --------
    >>> from frictrack.effects import get
    >>> [carries_over(get(name), get(name).parameters[0]) for name in ("coulomb", "viscous", "patch", "vibration")]
    [True, True, False, False]

    """
    own = not (parameter.per_run or parameter.role or parameter.signed or parameter.unit in SETUP_UNITS)
    return own and _is_of_pair(effect)


def _is_of_pair(effect: Effect) -> bool:
    """Return whether a force depends on the speed or the load alone."""
    if effect.acts_on != "force" or effect.scales_with not in ("load", "nothing"):
        return False
    depends_on = effect.varies_with
    if depends_on is None:
        return effect.scales_with == "load"  # friction with memory
    return "x" not in depends_on and (depends_on == "v" or effect.in_base_law)


def scales_with_load(effect: Effect, parameter: Parameter) -> bool:
    """Return whether the reported value of a parameter is proportional to the normal load.

    Parameters
    ----------
    effect, parameter
        The effect, and one of its parameters.

    Examples
    --------
    >>> from frictrack.effects import get
    >>> [scales_with_load(get("stribeck"), p) for p in get("stribeck").parameters]
    [True, False, False]

    """
    return parameter.loaded or (effect.scales_with == "load" and parameter.name in effect.quoted)
