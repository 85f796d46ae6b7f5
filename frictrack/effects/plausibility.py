"""Check whether fitted sizes and shapes of an effect are physically sensible.

Every effect declares its own check in its own file, built from the functions below. A check takes the values of the
effect's parameters in one run and how far that run reaches, and returns an objection in words, or "" where there is
none. An effect that fails imitates the misfit; it is never named as the cause. Checks are functions of a module with
given arguments (`functools.partial`), so that a fit can be pickled.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from functools import partial
from typing import Any

Check = Callable[[Mapping[str, float], Any], str]  # (values by parameter, Span) -> objection or ""

MIN_PERIODS = 1.5  # of an oscillation in a record: fewer cannot be told from a trend (Bretthorst 1988, section 2)
MIN_RINGING = 0.5  # periods within one decay time: a faster decay is a pulse
MAX_DEPTH = 1.0  # of a modulation: beyond it a contact would pull
MAX_PICTURE_SHARE = 0.03  # of the travelled span: lens, shake; barrel distortion of ordinary lenses is below 3 %
MAX_LOCKING_PX = 0.25  # published peak-locking amplitudes are below 0.25 px (Raffel et al. 2018, section 6.1)
MAX_CLOCK_DRIFT = 0.01  # of the time: crystal clocks are a hundred times better
MAX_CLOCK_FACTOR = 2.0  # of one run's times: frame rates are set in such steps, other units in larger ones
WHOLE_FRAME = 0.25  # frames by which a lost or doubled frame may miss a whole number


def all_of(*checks: Check) -> Check:
    """Return the check that raises the first objection of several."""
    return partial(_first_objection, checks)


def _first_objection(checks: Iterable[Check], values: Mapping[str, float], span: Any) -> str:
    return next(filter(None, (check(values, span) for check in checks)), "")


def oscillates(values: Mapping[str, float], span: Any) -> str:
    """Return an objection where the run holds fewer than `MIN_PERIODS` periods of `frequency` (Hz).

    Examples
    --------
    >>> from types import SimpleNamespace
    >>> oscillates({"frequency": 5.0}, SimpleNamespace(duration=0.1))
    'the record holds 0.5 periods of it, expected at least 1.5'

    """
    return _periods(values["frequency"] * span.duration)


def is_periodic_in(parameter: str) -> Check:
    """Return the check that the travelled span holds `MIN_PERIODS` of a period in space (m)."""
    return partial(_periodic, parameter)


def _periodic(parameter: str, values: Mapping[str, float], span: Any) -> str:
    return _periods((span.x_max - span.x_min) / abs(values[parameter] or 1e-300))


def _periods(count: float) -> str:
    if count >= MIN_PERIODS:
        return ""
    return f"the record holds {count:.1f} periods of it, expected at least {MIN_PERIODS:g}"


def rings(values: Mapping[str, float], span: Any) -> str:
    """Return an objection where an oscillation has died away before it has swung."""
    swings = values["frequency"] * values["tau"]
    if swings >= MIN_RINGING:
        return ""
    return f"it decays within {swings:.2f} periods, which is a pulse and no vibration"


def modulates(values: Mapping[str, float], span: Any) -> str:
    """Return an objection where a modulation exceeds what it modulates."""
    depth = abs(values["depth"])
    return "" if depth < MAX_DEPTH else f"depth {depth:.2g} would make the friction push"


def within_picture(shift: Callable[[Mapping[str, float], Any], float]) -> Check:
    """Return the check that a picture error `shift` (m) stays below `MAX_PICTURE_SHARE` of the travelled span."""
    return partial(_within_picture, shift)


def _within_picture(shift: Callable[..., float], values: Mapping[str, float], span: Any) -> str:
    share = abs(shift(values, span)) / max(span.x_max - span.x_min, 1e-300)
    if share <= MAX_PICTURE_SHARE:
        return ""
    return f"a picture error of {100 * share:.2g} % of the span, expected at most {100 * MAX_PICTURE_SHARE:g} %"


def shorter_than_record(parameter: str, share: float = 1.0) -> Check:
    """Return the check that a time (s) is shorter than a share of the record."""
    return partial(_shorter_than_record, parameter, share)


def _shorter_than_record(parameter: str, share: float, values: Mapping[str, float], span: Any) -> str:
    if values[parameter] <= share * span.duration:
        return ""
    return f"{parameter} {values[parameter]:.2g} s is longer than {share:g} of the record ({span.duration:.2g} s)"


def within_course(centre: str, width: str) -> Check:
    """Return the check that a local force (m) is narrower than the course and lies on it, or within its width of it."""
    return partial(_within_course, centre, width)


def _within_course(centre: str, width: str, values: Mapping[str, float], span: Any) -> str:
    travel = span.x_max - span.x_min
    if not span.x_min - values[width] <= values[centre] <= span.x_max + values[width]:
        return f"its centre {values[centre]:.3g} m lies off the course"
    if values[width] > travel / 2:
        return f"it is wider ({values[width]:.2g} m) than half of the course ({travel:.2g} m)"
    return ""
