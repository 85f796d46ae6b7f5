"""Drive delay: the force that drives the mass comes later than it was measured, or earlier."""

from frictrack.effects.definition import Array, DirectCheck, EffectInStudy, Nonlinear, Parameter, Path, Phrase
from frictrack.effects.library.drive_error import delayed_drive, delays

SYNCHRONISED_STD_S = 1e-4  # of one flash or tap that both records show


def columns(path: Path, nonlinear: Nonlinear) -> Array:
    """D(t) - D(t - tau), shape (n, 1): N; tau > 0 means that the true drive comes later."""
    return (delayed_drive(path, 0.0) - delayed_drive(path, nonlinear["tau"]))[:, None]


def common_event_signal(effect: EffectInStudy) -> float:
    """Return chi-squared of the delay at an event that both records show."""
    return (effect.value("tau") / SYNCHRONISED_STD_S) ** 2


equation = "share (D(t) - D(t - tau))"
parameters = (
    Parameter("share", "1", linear=True, fixed=1.0),
    Parameter("tau", "s", scan=delays, signed=True),
)
scales_with = "drive"
what = "Clocks of the force sensor and of the camera differ, or the force passes a valve, a hose or a spring first."
looks_like = "a residual force where the drive rises and falls, up at one and down at the other, and none between"
mistaken_for = "collisions, dropped frames (both where the drive changes fast)"
confirm = "Show both records one event, a flash or a tap; or measure the force next to the mass."
describe = Phrase("the true drive would come {1e3 * tau} ms later")
invariant = "a late drive differs from what was measured only where it changes"
settled_by = "show both records one event, such as a tap"
direct_check = DirectCheck("common event", "Show both records one event, such as a tap", common_event_signal)
source = "a pure delay; Franklin, Powell & Emami-Naeini, Feedback Control of Dynamic Systems, section 5.6"
needs = ("drive",)
