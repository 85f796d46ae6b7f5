"""Define the exception that users are meant to read."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any, TypeVar

T = TypeVar("T")
MAX_MESSAGE_LENGTH = 8000  # characters


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


def describe_fault(fault: Mapping[str, Any], key: str) -> str:
    """Describe one fault of `pydantic.ValidationError.errors` in the value of a key, which the sentence names."""
    if fault["type"] == "value_error":
        message = str(fault["ctx"]["error"])
        return message if key in message else f"{key}: {message}"
    if fault["type"] in ("extra_forbidden", "unexpected_keyword_argument"):
        return f'unknown key "{key}"'
    message = fault["msg"].replace("Input should be", "expected").replace("Field required", "this key is required")
    return f"{key}: {message[0].lower()}{message[1:]} but got {fault['input']!r}"


def describe_invalid(error: Any) -> str:
    """Describe the first fault of a `pydantic.ValidationError`, with its place in the tables."""
    fault = error.errors(include_url=False)[0]
    return describe_fault(fault, ".".join(map(str, fault["loc"])))


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
