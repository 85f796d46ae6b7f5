"""Beam vibration: the beam under the course rings, and its frequency falls as the mass moves away from the clamp."""

from operator import attrgetter

import numpy as np

from frictrack.effects.definition import Array, Nonlinear, Parameter, Path, Phrase
from frictrack.effects.ranges import ScanWave, Span, frequencies, oscillates, wave

MAX_FREQUENCY_HZ = 200.0  # Hz: the first mode of a beam that carries a sliding mass lies below
MAX_FORMS = 6000  # tried in one scan: frequencies times mass ratios times lengths, a bound on its time
MIN_RATIOS = 4  # that are tried in any case


def columns(path: Path, nonlinear: Nonlinear) -> Array:
    """sin(integral of omega(x(t)) dt since release + phase), shape (n, 1): N per N of amplitude."""
    return wave(_cycles(path, nonlinear), nonlinear["phase"])


def cycles_at_1_hz(path: Path, nonlinear: Nonlinear) -> Array:
    """Cycles (n,) since release of a beam of 1 Hz."""
    return _cycles(path, {**nonlinear, "frequency": 1.0})


def shape(x: Array, length: Array) -> tuple[Array, Array]:
    """Static shape of a cantilever, (3 l x^2 - x^3)/(2 l^3), 1 at its free end, and its slope; x (m) from the clamp."""
    u = x / length
    return (3 * u**2 - u**3) / 2, (6 * u - 3 * u**2) / (2 * length)


def _cycles(path: Path, nonlinear: Nonlinear) -> Array:
    """Cycles (n,) since release, the way before the path included, by trapezoids with their end correction, order 4."""
    assert path.clamp_x is not None
    own, first = _form(path, nonlinear), list(path.starts)
    rate, change = _rate(path, path.x, path.v, own)
    since = _running(path.t, rate, change, first)
    return np.asarray(since + path.each(_lead(path, [q[first] for q in own]) - since[first]))


def _form(path: Path, nonlinear: Nonlinear) -> list[Array]:
    """Frequency of the bare beam (Hz), mass over modal mass, and length of the beam (m) at every sample, (n,) each."""
    length = path.beam_length or nonlinear["beam_length"]
    each = (nonlinear["frequency"], nonlinear["r"] * path.mass_ratio, length)
    return [np.broadcast_to(q, path.t.shape) for q in each]


def _lead(path: Path, own: list[Array]) -> Array:
    """Cycles from release to the first frame of every individual, (P,)."""
    way = np.stack([path.t, path.x, path.v])[:, None, list(path.starts)]
    if path.before is not None:
        same_motion = np.broadcast_to(path.before[:, :, None], (*path.before.shape, way.shape[2]))
        way = np.concatenate([same_motion, way], axis=1)
    t, x, v = way
    rate, change = _rate(path, x, v, own)
    return np.asarray(t[0] * rate[0] + np.sum(_steps(np.diff(t, axis=0), rate, change), axis=0))


def _rate(path: Path, x: Array, v: Array, own: list[Array]) -> tuple[Array, Array]:
    """Frequency at places x, Hz, and its change in time, Hz/s."""
    frequency, heavy, length = own
    away = x - float(path.clamp_x or 0.0)
    phi, slope = shape(np.abs(away), length)
    rate = frequency / np.sqrt(1 + heavy * phi**2)
    return rate, -rate * heavy * phi * slope * np.sign(away) * v / (1 + heavy * phi**2)


def _steps(h: Array, rate: Array, change: Array) -> Array:
    return np.asarray(h / 2 * (rate[1:] + rate[:-1]) + h**2 / 12 * (change[:-1] - change[1:]))


def _running(t: Array, rate: Array, change: Array, first: list[int]) -> Array:
    return np.concatenate([[0.0], np.cumsum(_steps(np.diff(t), rate, change))])


def tones(span: Span) -> Array:
    """Frequencies of the bare beam worth trying, Hz: half a Rayleigh cell apart."""
    return frequencies(span, cells=0.5, limit=MAX_FREQUENCY_HZ)


def ratios(span: Span) -> Array:
    """Mass ratios worth trying: fewer where a long run asks for very many frequencies."""
    count = MAX_FORMS // (len(tones(span)) * len(lengths(span)))
    return np.geomspace(0.05, 5.0, int(np.clip(count, MIN_RATIOS, 13)))


def lengths(span: Span) -> Array:
    """The length of the beam where it is known, else lengths worth trying, m, from the farthest place on."""
    if span.beam_length is not None:
        return np.array([span.beam_length])
    clamp = span.x_min if span.clamp_x is None else span.clamp_x
    farthest = max(abs(span.x_min - clamp), abs(span.x_max - clamp))
    # a longer beam is nearly a lighter mass: where time is short one length stands for all, and is refined from there
    few = len(tones(span)) * 3 * 13 > MAX_FORMS
    return farthest * np.array([1.0, 1.4] if few else [1.0, 1.4, 2.0])


equation = (
    "amplitude sin(2 pi integral of frequency/sqrt(1 + r phi^2) dt + phase), "
    "phi = (3 l x^2 - x^3)/(2 l^3) from the clamp, l = beam_length"
)
parameters = (
    Parameter("amplitude", "N", linear=True, role="amplitude"),
    Parameter("frequency", "Hz", scan=tones),
    Parameter("r", "1", scan=ratios),
    Parameter("beam_length", "m", scan=lengths, known=attrgetter("beam_length")),
    Parameter("phase", "rad", per_run=True, role="phase"),
)
scan_wave = ScanWave("frequency", cycles_at_1_hz)
counts_from_release = True
what = "The cantilever that carries the course rings; the mass on it (r = mass over modal mass) lowers its tone."
looks_like = "a line whose frequency falls as the mass moves toward the free end, and rises on the way back"
mistaken_for = "vibration (near the clamp, or with a light mass), texture (a chirp that follows the speed)"
confirm = "Tap the beam with the mass resting near the clamp, then at the free end: the note is lower there."
plausible = oscillates
describe = Phrase("{frequency} Hz near the clamp, lower with the mass farther out")
invariant = "the frequency of the beam falls toward its free end, and with a heavier mass"
source = "Rayleigh's quotient with the static shape of an end-loaded cantilever"
needs = ("clamp_x",)
