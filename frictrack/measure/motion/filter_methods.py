"""Filters that a user may choose: Butterworth, Savitzky-Golay, Gaussian process, and the chain of the papers.

Each is a linear map of the frames, with settings as given or from the data. Missing frames are bridged by
straight lines. A `Smoother` holds one of them, or the structure that low-passed a coordinate, and writes it as JSON.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from typing import Any, ClassVar, Protocol

import numpy as np
import scipy
from numpy.polynomial import polynomial
from numpy.typing import NDArray

from frictrack.base.errors import FrictrackError
from frictrack.measure.motion.banded_equations import TREND_ORDER, NoiseColour, cutoff_of
from frictrack.measure.motion.grid import stencil_derivative
from frictrack.measure.motion.place_forces import PlaceForce
from frictrack.measure.motion.smoother import Event, Structure
from frictrack.measure.motion.structure_search import ChangeGroup
from frictrack.records import Array, Mask
from frictrack.settings.filters import DEFAULT_ORDER, PAPERS, PAPERS_CUTOFF, STRUCTURAL, FilterChoice

CUTOFFS = np.geomspace(0.002, 0.4, 60)  # tried for Butterworth, cycles per frame
MAX_RESIDUAL_SIGMAS = 2.0  # standard deviations by which the residual's mean square may exceed the noise
WINDOW_FRAMES = np.unique(np.round(np.geomspace(5, 401, 40)).astype(int) | 1)  # tried for Savitzky-Golay
DEGREES = (3, 4, 5)
COLUMNS_AT_ONCE = 256  # unit responses computed in one call
MAX_FRAMES = 3000  # of a Gaussian process, whose cost grows with their cube
MAX_LOG_PARAMETER = 20.0  # log of a length or an amplitude
HALF_AMPLITUDE_CUTOFF = 0.1874  # f l at which exp(-(2 pi f l)^2 / 2) is one half


class FilterMethod(Protocol):
    """A linear filter of evenly spaced frames."""

    name: ClassVar[str]

    @property
    def cutoff(self) -> float:
        """Frequency at which half of the amplitude passes, cycles per frame."""

    def derived(self, y: Array, order: int) -> Array:
        """Derivative of order 0 to 2 of the filtered columns (n, ...), per frame."""


def butterworth(y: Array, low: float, order: int, *, causal: bool) -> Array:
    """Filter columns (n, ...) so that half of the amplitude passes at `low`, cycles per frame.

    One pass has the gain 1/sqrt(1 + (f/f_c)^(2 order)) of prewarped frequencies: two passes keep half at f_c, a single
    one at f_c 3^(1/(2 order)).
    """
    lower = 3.0 ** (-0.5 / order) if causal else 1.0
    sos = scipy.signal.butter(order, 2 / np.pi * np.arctan(lower * np.tan(np.pi * low)), output="sos")
    if causal:
        start = scipy.signal.sosfilt_zi(sos).reshape(*sos.shape[:1], 2, *[1] * (y.ndim - 1)) * y[:1]
        return np.asarray(scipy.signal.sosfilt(sos, y, axis=0, zi=start)[0])
    reach = min(len(y) - 1, int(np.ceil(1 / low)))
    return np.asarray(scipy.signal.sosfiltfilt(sos, y, axis=0, padtype="odd", padlen=reach))


@dataclass(frozen=True)
class Butterworth:
    """Butterworth filter without a cubic, which would ring at the ends.

    Attributes
    ----------
    cutoff
        Frequency at which half of the amplitude passes, cycles per frame.
    order
        Order of one pass.
    causal
        Forward only, else forward and backward.

    """

    cutoff: float
    order: int = DEFAULT_ORDER
    causal: bool = False
    name: ClassVar[str] = "butterworth"

    def derived(self, y: Array, order: int) -> Array:
        """Derivative of the filtered columns (n, ...) by central differences, per frame."""
        return stencil_derivative(self._smooth(y), order)

    def _smooth(self, y: Array) -> Array:
        trend = _cubic(y)
        return trend + butterworth(y - trend, self.cutoff, self.order, causal=self.causal)

    @classmethod
    def fit(cls, y: Array, noise: float, choice: FilterChoice, interval: float) -> Butterworth:
        """Take the cut-off given, else the lowest that removes no more than the noise.

        This is the residual analysis of Winter 2009, Biomechanics and Motor Control of Human Movement, ch. 3.
        """
        given = [] if choice.cutoff is None else [choice.cutoff * interval]
        for low in given or CUTOFFS.tolist():
            made = cls(low, choice.order or DEFAULT_ORDER, choice.causal)
            rest = y - made._smooth(y)
            if np.mean(rest**2) <= noise**2 * (1 - 2 * low) * (1 + MAX_RESIDUAL_SIGMAS * np.sqrt(2 / len(y))):
                break
        return made


@dataclass(frozen=True)
class Papers(Butterworth):
    """The chain of the two papers: a low-pass of the displacement as it is, then central differences, once and twice.

    They name neither cut-off nor order nor direction: by default 100 Hz, a Butterworth filter of order 4, forward and
    backward. The first and the last period are distorted, because no trend is removed before.
    """

    name: ClassVar[str] = PAPERS

    def derived(self, y: Array, order: int) -> Array:
        """Derivative of the filtered columns (n, ...) by repeated central differences, per frame."""
        smooth = butterworth(y, self.cutoff, self.order, causal=self.causal)
        for _ in range(order):
            smooth = np.gradient(smooth, axis=0)
        return smooth

    @classmethod
    def fit(cls, y: Array, noise: float, choice: FilterChoice, interval: float) -> Papers:
        """Take the settings given; nothing is chosen from the data."""
        del y, noise
        return cls((choice.cutoff or PAPERS_CUTOFF) * interval, choice.order or DEFAULT_ORDER, choice.causal)


@dataclass(frozen=True)
class SavitzkyGolay:
    """Polynomial of a degree through a window of frames (Savitzky & Golay 1964), full windows at the ends."""

    window: int
    degree: int
    name: ClassVar[str] = "savitzky-golay"

    @property
    def cutoff(self) -> float:
        """Frequency at which half of the amplitude passes, cycles per frame."""
        response = np.abs(np.fft.rfft(scipy.signal.savgol_coeffs(self.window, self.degree), 8192))
        return float(np.argmax(response < 0.5) / 8192)

    def derived(self, y: Array, order: int) -> Array:
        """Derivative of the polynomials through the columns (n, ...), per frame."""
        return np.asarray(scipy.signal.savgol_filter(y, self.window, self.degree, deriv=order, axis=0, mode="interp"))

    @classmethod
    def fit(cls, y: Array, noise: float, choice: FilterChoice, interval: float) -> SavitzkyGolay:
        """Choose window and degree, where not given, by generalised cross-validation.

        See Craven & Wahba 1979, Numer. Math. 31, 377-403.
        """
        del noise, interval
        windows = [choice.window] if choice.window else [int(w) for w in WINDOW_FRAMES]
        degrees = [choice.order] if choice.order else DEGREES
        tried = [cls(w, d) for d in degrees for w in windows if d + 1 < w <= len(y)]
        if not tried:
            raise FrictrackError(f"expected window of at most the record's {len(y)} frames but got {choice.window}")
        return min(tried, key=lambda m: m._cross_validation_score(y))

    def _cross_validation_score(self, y: Array) -> float:
        """Generalised cross-validation score."""
        middle = float(scipy.signal.savgol_coeffs(self.window, self.degree)[self.window // 2])
        return float(np.mean((y - self.derived(y, 0)) ** 2)) / (1.0 - middle) ** 2


@dataclass(frozen=True)
class GaussianProcess:
    """Gaussian process with squared-exponential covariance plus a cubic (Rasmussen & Williams 2006, ch. 2).

    Attributes
    ----------
    length
        Length of the covariance, frames.
    size
        Standard deviation over that of the noise, which is known.

    """

    length: float
    size: float
    name: ClassVar[str] = "gaussian-process"

    @property
    def cutoff(self) -> float:
        """Frequency at which half of the amplitude of the prior remains, cycles per frame."""
        return HALF_AMPLITUDE_CUTOFF / self.length

    def derived(self, y: Array, order: int) -> Array:
        """Derivative of the posterior mean of the columns (n, ...) by central differences, per frame."""
        trend = _cubic(y)
        covariance = self._covariance(len(y))
        known = scipy.linalg.cho_factor(covariance + np.eye(len(y)), overwrite_a=True)
        return stencil_derivative(trend + covariance @ scipy.linalg.cho_solve(known, y - trend), order)

    def _covariance(self, n: int) -> Array:
        """Covariance of n frames."""
        apart = (np.arange(n)[:, None] - np.arange(n)) / self.length
        return np.asarray(self.size**2 * np.exp(-0.5 * apart**2))

    @classmethod
    def fit(cls, y: Array, noise: float, choice: FilterChoice, interval: float) -> GaussianProcess:
        """Choose length and size by marginal likelihood, on every k-th frame; at most `MAX_FRAMES` frames.

        See Rasmussen & Williams 2006, Gaussian Processes for Machine Learning, ch. 5.
        """
        del choice, interval
        if len(y) > MAX_FRAMES:
            raise FrictrackError(
                f"low_pass: expected at most {MAX_FRAMES} frames for a Gaussian process but got {len(y)}; "
                'use the default or method = "kalman"'
            )
        rest = (y - _cubic(y)) / noise
        step = max(1, len(y) // 400)

        def loss(p: Array) -> float:
            if not 0 < p[0] < MAX_LOG_PARAMETER or abs(p[1]) > MAX_LOG_PARAMETER:
                return np.inf
            made = cls(float(np.exp(p[0])) / step, float(np.exp(p[1])))
            try:
                known = np.linalg.cholesky(made._covariance(len(rest[::step])) + np.eye(len(rest[::step])))
            except np.linalg.LinAlgError:
                return np.inf
            return float(np.sum(np.linalg.solve(known, rest[::step]) ** 2) + 2 * np.sum(np.log(np.diag(known))))

        size = float(np.log(max(float(np.std(rest)), 1.0)))
        starts = [np.array([np.log(k), size]) for k in np.geomspace(2 * step, len(y) / 4, 6)]
        best = starts[int(np.argmin([loss(p) for p in starts]))]
        found = scipy.optimize.minimize(loss, best, method="Nelder-Mead", options={"xatol": 0.02, "fatol": 0.02}).x
        return cls(float(np.exp(found[0])), float(np.exp(found[1])))


METHODS: Mapping[str, Any] = {m.name: m for m in (Butterworth, SavitzkyGolay, GaussianProcess, Papers)}


def unit_responses(method: FilterMethod, known: Mask, order: int) -> Iterator[tuple[NDArray[np.int64], Array]]:
    """Yield some known frames (k,) of N, and the derivatives (N, k), per frame, of a unit displacement of each."""
    frames = np.flatnonzero(known)
    for part in np.array_split(frames, -(-len(frames) // COLUMNS_AT_ONCE)):
        unit = np.zeros((len(known), len(part)))
        unit[part, np.arange(len(part))] = 1.0
        yield part, method.derived(interpolate_missing(unit, known), order)


def interpolate_missing(y: Array, known: Mask) -> Array:
    """Interpolate missing frames linearly.

    Parameters
    ----------
    y
        Columns, (n, ...).
    known
        Measured frames, (n,).

    Returns
    -------
    Array
        The columns without gaps, (n, ...).

    Examples
    --------
    >>> interpolate_missing(np.array([0.0, 9.0, 4.0]), np.array([True, False, True])).tolist()
    [0.0, 2.0, 4.0]

    """
    if known.all():
        return y
    n = np.arange(len(y))
    flat = y.reshape(len(y), -1)
    return np.stack([np.interp(n, n[known], column[known]) for column in flat.T], axis=1).reshape(y.shape)


def _cubic(y: Array) -> Array:
    """Least-squares cubic (n, ...) through columns."""
    u = np.linspace(-1.0, 1.0, len(y))
    flat = y.reshape(len(y), -1)
    return np.asarray(polynomial.polyval(u, polynomial.polyfit(u, flat, 3)).T.reshape(y.shape))


MIN_CUTOFF_RATIO = 0.7  # over the likeliest cut-off; below it signal is lost


@dataclass(frozen=True, eq=False)
class Smoother:
    """What low-passed a coordinate; `str` writes it as JSON.

    Attributes
    ----------
    structure
        Structure of the structural smoother.
    method
        Another filter method.
    alternatives
        Changes of the structure over which the signal was averaged.
    colour
        Colour of the noise.
    forces
        Forces that are periodic in place.

    """

    structure: Structure | None = None
    method: FilterMethod | None = None
    alternatives: tuple[ChangeGroup, ...] = ()
    colour: NoiseColour | None = None
    forces: tuple[PlaceForce, ...] = ()

    def __str__(self) -> str:
        if self.method:
            return json.dumps({"method": self.method.name, **vars(self.method)})
        if self.structure is None:
            return ""
        more: dict[str, Any] = {}
        if self.alternatives:
            more["alternatives"] = [asdict(g) for g in self.alternatives]
        if self.colour:
            more["noise"] = asdict(self.colour)
        if self.forces:
            more["forces"] = self.forces
        return json.dumps({"method": STRUCTURAL, **asdict(self.structure), **more})

    @classmethod
    def read(cls, text: str) -> Smoother:
        """Read a smoother from its JSON."""
        settings = json.loads(text)
        name = settings.pop("method")
        if name != STRUCTURAL:
            return cls(method=METHODS[name](**settings))
        events = tuple(Event(**e) for e in settings["events"])
        lines = tuple((float(f), float(m)) for f, m in settings["lines"])
        groups = tuple(ChangeGroup.read(g) for g in settings.get("alternatives", ()))
        colour = NoiseColour(**settings["noise"]) if "noise" in settings else None
        forces = tuple(PlaceForce(*f) for f in settings.get("forces", ()))
        return cls(Structure(tuple(settings["stiffness"]), lines, events), None, groups, colour, forces)


def describe_structure(smoother: Smoother, interval: float) -> str:
    """Describe the components of a record in words."""
    structure, colour = smoother.structure, smoother.colour
    assert structure is not None
    cutoffs = [cutoff_of(float(np.exp(s)), interval) for s in structure.stiffness]
    low, high = (f"{f:.3g}" if f < 1000 else f"{f:.0f}" for f in (min(cutoffs), max(cutoffs)))
    span = f"{low} Hz" if max(cutoffs) < 1.1 * min(cutoffs) else f"{low} to {high} Hz"
    parts = [f"a trend cut off at {span}"]
    parts += [f"one sinusoid at {omega / 2 / np.pi / interval:.4g} Hz" for omega, _ in structure.lines]
    parts += [f"a force periodic in place, every {1e3 * f.period:.4g} mm" for f in smoother.forces]
    centres = [1e3 * interval * 0.5 * (e.first + e.last + TREND_ORDER) for e in structure.events]
    if centres:
        parts.append("abrupt changes at " + ", ".join(f"{c:.1f} ms" for c in sorted(centres)))
    if colour:
        parts.append(
            f"noise of which {100 * colour.share:.0f} % of the variance is correlated "
            f"({colour.correlation:.2g} from frame to frame)"
        )
    return ", ".join(parts) + ", by maximum likelihood"


def describe_given_cutoff(used: float, best: float) -> str:
    """Describe a given cut-off; say if it is too low."""
    reason = f"cut-off {used:.3g} Hz as given"
    if used < MIN_CUTOFF_RATIO * best:
        reason += f", maximum likelihood would take {best:.3g} Hz: the deviations count the signal lost"
    return reason
