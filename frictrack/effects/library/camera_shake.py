"""Camera shake: the camera moves, the mass does not."""

from frictrack.effects.definition import (
    OSCILLATION,
    DirectCheck,
    EffectInStudy,
    Nonlinear,
    Parameter,
    Path,
    Phrase,
    picture_shift_signal,
)
from frictrack.effects.ranges import WAVE_IN_TIME, Span, all_of, frequencies, oscillates, wave, within_picture
from frictrack.records import Array


def columns(path: Path, nonlinear: Nonlinear) -> Array:
    """sin(2 pi f t + phase), shape (n, 1): m per m of amplitude."""
    return wave(nonlinear["frequency"] * path.t, nonlinear["phase"])


def amplitude(values: Nonlinear, span: Span) -> float:
    """Error of the picture, m."""
    return values["amplitude"]


def describe(effect: EffectInStudy) -> str:
    """Frequency and size in the picture."""
    in_px = " ({abs(amplitude) / study.pixel_pitch:2} px)" if effect.pixel_pitch else ""
    return Phrase(OSCILLATION + "; everything in the picture would move by ± {abs(amplitude):m}" + in_px)(effect)


acts_on = "measurement"
equation = "y: amplitude sin(2 pi frequency t + phase)"
parameters = (
    Parameter("amplitude", "m", linear=True, role="amplitude"),
    Parameter("frequency", "Hz", scan=frequencies),
    Parameter("phase", "rad", per_run=True, role="phase"),
)
scan_wave = WAVE_IN_TIME
what = "The camera or its stand vibrates."
looks_like = "a line in time of the same size in x whatever the mass; the background moves too"
mistaken_for = "vibration of the course (same shape in one run)"
confirm = "Track a fixed mark in the same film and give it as `reference`."
plausible = all_of(oscillates, within_picture(amplitude))
invariant = "a shaking camera moves the picture equally far whatever slides"
direct_check = DirectCheck(
    "reference",
    "Film a run with something in the picture that does not move, a mark on the frame, and give it as `reference`",
    picture_shift_signal,
)
moves_picture = True
film_fault = True
of_camera = True
noted_as = ("camera shake of",)
source = "textbook"
