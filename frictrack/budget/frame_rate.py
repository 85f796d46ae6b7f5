"""How well the frame rate is known: as well as the rates that a recording is told by agree."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from frictrack.results import Film

RATE = "frame rate, "
SHOWING = "speed of showing"
STAMPS = "stamps"
DIGITS = 5e-7  # to which the audit writes rates
OF = {"given": "the rate given", "header": "that of the header", STAMPS: "that of the time stamps"}


def rate_error(film: Film | None) -> tuple[float | None, str]:
    """Relative error of the frame rate, None where nothing is known of it, and in words where it is known from.

    Of a table nothing is known. Of a film the rates given by the user, by the header and by the time stamps are held
    against the one that is used; the largest difference counts. A header and a user who agree without time stamps of
    the camera prove nothing: both tell what it was set to, and a container's stamps repeat its header.
    """
    if film is None:
        return None, "not known: the table's times are taken as they stand"
    rates = {
        name.removeprefix(RATE): float(value.split()[0])
        for name, value, verdict in film.audit
        if name.startswith(RATE) and verdict != SHOWING
    }
    error = max((abs(rate / film.fps - 1.0) for rate in rates.values()), default=0.0)
    if error < DIGITS and not (film.clocked and STAMPS in rates and len(rates) > 1):
        used = next((OF.get(name, name) for name in rates), "the frame rate")
        return None, f"not known: {used} is taken as it stands, without time stamps of the camera to check it by"
    return max(error, DIGITS), f"difference of the frame rates ({' and '.join(rates)})"
