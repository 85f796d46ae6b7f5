"""The one exception that a user is meant to read."""

from __future__ import annotations


class FrictrackError(ValueError):
    """Bad input or an answer that cannot be given: what was expected, what came, what to do.

    The message is one clear sentence (several faults are joined by ``"; "``). The command line prints
    it and exits 1, or exits 2 when ``usage`` is true (the command or the study file was written wrongly).
    """

    def __init__(self, message: str, *, usage: bool = False) -> None:
        super().__init__(message)
        self.usage = usage


def gather(faults: list[str], what: str) -> None:
    """Raise one `FrictrackError` that lists every fault found in `what`; do nothing when there is none."""
    if faults:
        raise FrictrackError(f"{what}: " + "; ".join(faults))
