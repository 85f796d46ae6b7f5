"""The one exception that a user is meant to read."""

from __future__ import annotations

MAX_MESSAGE_LENGTH = 8000  # characters of a message


class FrictrackError(ValueError):
    """Bad input or an answer that cannot be given: what was expected, what came, what to do.

    The message is one clear sentence (several faults are joined by ``"; "``). The command line prints
    it and exits 1, or exits 2 when ``usage`` is true (the command or the study file was written wrongly).
    What a file says may stand in it: signs that a terminal would obey are spelled out, its middle is left out where
    it is very long.
    """

    def __init__(self, message: str, *, usage: bool = False) -> None:
        super().__init__(_printable(message))
        self.usage = usage


def _printable(message: str) -> str:
    if len(message) > MAX_MESSAGE_LENGTH:
        message = f"{message[: MAX_MESSAGE_LENGTH // 2]} ... {message[-MAX_MESSAGE_LENGTH // 4 :]}"
    if message.isprintable():
        return message
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in message)


def raise_faults(faults: list[str], what: str) -> None:
    """Raise one `FrictrackError` that lists every fault found in `what`; do nothing when there is none."""
    if faults:
        raise FrictrackError(f"{what}: " + "; ".join(faults))
