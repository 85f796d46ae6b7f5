"""Estimate the error of the frame rate from the differences between independent statements of it."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from frictrack.results import RecordingInfo

RATE_PREFIX = "frame rate, "
PLAYBACK = "speed of showing"
STAMPS = "stamps"
MIN_RELATIVE_ERROR = 5e-7  # rounding of the rates in the audit
RATE_TEXTS = {"given": "the rate given", "header": "that of the header", STAMPS: "that of the time stamps"}


def frame_rate_error(film: RecordingInfo | None) -> tuple[float | None, str]:
    """Relative error of the frame rate.

    The rates given by the user, by the header and by the time stamps are compared with the one that is used; the
    largest difference counts. Agreement of user and header without camera time stamps proves nothing: both state the
    setting, and a container's stamps repeat its header.

    Parameters
    ----------
    film
        The film; None for a table.

    Returns
    -------
    error : float or None
        Relative error; None if not known.
    known_from : str
        How it is known, or why not.

    Examples
    --------
    >>> frame_rate_error(None)
    (None, "not known: the table's times are used as given")

    """
    if film is None:
        return None, "not known: the table's times are used as given"
    rates = {
        name.removeprefix(RATE_PREFIX): float(value.split()[0])
        for name, value, verdict in film.audit
        if name.startswith(RATE_PREFIX) and verdict != PLAYBACK
    }
    error = max((abs(rate / film.fps - 1.0) for rate in rates.values()), default=0.0)
    if error < MIN_RELATIVE_ERROR and not (film.clocked and STAMPS in rates and len(rates) > 1):
        used = next((RATE_TEXTS.get(name, name) for name in rates), "the frame rate")
        return None, f"not known: {used} is used as given; there are no camera time stamps to check it"
    return max(error, MIN_RELATIVE_ERROR), f"difference of the frame rates ({' and '.join(rates)})"
