"""Drive error: the force that drives the mass is not the one that was measured."""

import numpy as np

from frictrack.effects.definition import Array, DirectCheck, EffectInStudy, Nonlinear, Parameter, Path, Phrase
from frictrack.effects.ranges import WEIGHT_RELATIVE_STD, Span

MAX_DELAY_S = 0.02  # s by which an amplifier, a valve or a wrong clock may be late
MAX_ERROR = 0.5  # of the drive: more is another drive


def columns(path: Path, nonlinear: Nonlinear) -> Array:
    """-D(t - tau), shape (n, 1): N per unit of e; e > 0 means that the true drive is larger."""
    return -delayed_drive(path, nonlinear["tau"])[:, None]


def delayed_drive(path: Path, tau: float | Array) -> Array:
    """D(t - tau), shape (n,), N.

    Examples
    --------
    >>> t = np.arange(3.0)
    >>> delayed_drive(Path(t, t, t, t, drive=2 * t), 0.5)
    array([0., 1., 3.])

    """
    if path.drive_at is not None:
        return path.drive_at(path.t - tau)
    assert path.drive is not None
    return np.interp(path.t - tau, path.t, path.drive)


def delays(span: Span) -> Array:
    """Delays worth trying, s, early as well as late."""
    longest = min(MAX_DELAY_S, span.duration / 8)
    return np.linspace(-longest, longest, 17)


def plausible(values: Nonlinear, span: Span) -> str:
    """Return an objection to a drive that would be wrong by half."""
    error = abs(values["e"])
    return "" if error <= MAX_ERROR else f"the drive would be {100 * error:.0f} % wrong"


def known_weight_signal(effect: EffectInStudy) -> float:
    """Return chi-squared of the error at a weight that is known to `WEIGHT_RELATIVE_STD`."""
    return (effect.rms("e") / WEIGHT_RELATIVE_STD) ** 2


equation = "-e D(t - tau)"
parameters = (
    Parameter("e", "1", linear=True),
    Parameter("tau", "s", scan=delays, signed=True),
)
scales_with = "drive"
what = "Gain of the force sensor, area of the piston or constant of the motor are off; or a part of the force is late."
looks_like = "a residual force of the shape of the drive, in every run, whatever the speed"
mistaken_for = "a wrong mass (at tau = 0; exactly so where the mass is fitted); Coulomb friction (steady drive)"
confirm = "Hang a known weight on the drive; drive with another shape: this residual follows it, friction does not."
describe = Phrase("the true drive would be {100 * e} % larger, by a part that comes {1e3 * tau} ms later")
invariant = "an error of the drive follows the drive"
settled_by = "hang a known weight on the drive"
direct_check = DirectCheck("known weight", "Hang a known weight on the drive", known_weight_signal)
source = "Janot, Gautier & Brunot 2019 (EMPS: gain and offset of the drive)"
needs = ("drive",)
