"""Define the exception that users are meant to read."""

from __future__ import annotations

import errno
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, TypeVar

T = TypeVar("T")
MAX_MESSAGE_LENGTH = 8000  # characters
FULL_DISK = (errno.ENOSPC, getattr(errno, "EDQUOT", errno.ENOSPC), errno.EFBIG)  # no space, quota, limit of a file


class FrictrackError(ValueError):
    """Wrong input, or an answer that cannot be given: what was expected, what came, what to do.

    The message is one sentence; several faults are joined by ``"; "``. Characters that a terminal would execute are
    escaped, because texts from files may occur in a message. The middle of a very long message is cut out.

    Parameters
    ----------
    message
        The sentence.
    usage
        Whether the command or the study file is wrong. The command line then exits with 2, otherwise with 1.

    Examples
    --------
    >>> raise FrictrackError("expected a mass but got none; give mass = 0.35")
    Traceback (most recent call last):
    frictrack.base.errors.FrictrackError: expected a mass but got none; give mass = 0.35

    """

    def __init__(self, message: str, *, usage: bool = False) -> None:
        super().__init__(_printable(message))
        self.usage = usage


class UsageError(FrictrackError):
    """The command or the study file is wrong; the command line exits with 2."""

    def __init__(self, message: str) -> None:
        super().__init__(message, usage=True)


class DiskFullError(FrictrackError):
    """A file cannot be written because the disk is full: another machine may have space."""

    worker: str = ""  # address of the worker of a cluster on which it happened; empty elsewhere


def is_disk_full(e: BaseException | None) -> bool:
    """Return whether an error, or one that caused it, says that the disk, a quota or a limit of file size is full.

    Examples
    --------
    >>> is_disk_full(OSError(errno.ENOSPC, "No space left on device")), is_disk_full(ValueError("no"))
    (True, False)

    """
    while e is not None:
        if isinstance(e, DiskFullError) or (isinstance(e, OSError) and e.errno in FULL_DISK):
            return True
        e = e.__cause__ or e.__context__
    return False


def _printable(message: str) -> str:
    """Return a message on one line, without control characters, of limited length."""
    if len(message) > MAX_MESSAGE_LENGTH:
        message = f"{message[: MAX_MESSAGE_LENGTH // 2]} ... {message[-MAX_MESSAGE_LENGTH // 4 :]}"
    if message.isprintable():
        return message
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in message)


def raise_faults(faults: list[str], what: str) -> None:
    """Raise one `FrictrackError` with every fault; do nothing if there are none.

    Parameters
    ----------
    faults
        The faults, one sentence each.
    what
        What was checked, for the beginning of the message.

    Raises
    ------
    FrictrackError
        If there are faults.

    """
    if faults:
        raise FrictrackError(f"{what}: " + "; ".join(faults))


def result_or_none(function: Callable[..., T], *arguments: Any, **keywords: Any) -> T | None:
    """Return the result of a call; None where it raises `FrictrackError`: others do without it, or report the fault."""
    try:
        return function(*arguments, **keywords)
    except FrictrackError:
        return None


@contextmanager
def os_errors_as(what: str, advice: str = "") -> Iterator[None]:
    """Raise an error of the operating system as a `FrictrackError`: what could not be done, why, and what to do."""
    try:
        yield
    except OSError as e:
        raise FrictrackError("; ".join(filter(None, (f"{what}: {e.strerror or e}", advice)))) from e
