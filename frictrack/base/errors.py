"""Define the exception that users are meant to read."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from difflib import get_close_matches
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


def suggest(word: str, known: Iterable[str]) -> str:
    """Return a hint for an unknown name: the nearest known name, or all of them.

    Examples
    --------
    >>> suggest("cutof", ["cutoff", "free"])
    'did you mean "cutoff"?'

    """
    known = list(known)
    near = get_close_matches(word, known, 1)
    return f'did you mean "{near[0]}"?' if near else f"known are {', '.join(known)}"


EXPECTED = {  # kind of a fault of pydantic, or its first word -> what was expected, with what it names
    "string": "a text in quotes",
    "float": "a number",
    "int": "a whole number",
    "bool": "true or false",
    "finite": "a finite number",
    "tuple": "a list [...]",
    "list": "a list [...]",
    "dict": "a table {{name = value}}",
    "model": "a table {{name = value}}",
    "dataclass": "a table {{name = value}}",
    "literal_error": "{expected}",
    "string_pattern_mismatch": "a name of letters and digits",
    "string_too_short": "a text of {min_length} or more characters",
    "string_too_long": "a text of at most {max_length} characters",
    "greater_than": "a number above {gt:g}",
    "greater_than_equal": "a number of at least {ge:g}",
    "less_than": "a number below {lt:g}",
    "less_than_equal": "a number of at most {le:g}",
    "too_short": "a list of {min_length} or more values",
    "too_long": "a list of at most {max_length} values",
}
MAX_VALUE_LENGTH = 120  # characters


_KIND = re.compile(r"(str|int|float|bool)$|[\w-]*\[")  # which of several types a fault is of: no part of its place


def describe_fault(fault: Mapping[str, Any], place: Sequence[str | int]) -> str:
    """Describe one fault of `pydantic.ValidationError.errors` in the value at a place, which the sentence names."""
    place = [part for part in place if isinstance(part, int) or not _KIND.match(part)]
    kind, names = fault["type"], [part for part in place if isinstance(part, str)]
    if kind == "value_error":
        message = str(fault["ctx"]["error"])
        return message if not names or names[-1] in message else f"{_name(place)}: {message}"
    if kind in ("extra_forbidden", "unexpected_keyword_argument"):
        return f'unknown key "{names[-1]}"' + (f" in {_name(place[:-1])}" if place[:-1] else "")
    if kind == "missing" and isinstance(place[-1], str):
        return f"expected the key {_name(place)} but it is missing"
    if kind == "missing":
        *place, last = place
        kind, fault = "too_short", {**fault, "ctx": {"min_length": int(last) + 1}}
    words = EXPECTED.get(kind) or EXPECTED.get(kind.partition("_")[0], fault["msg"])
    wanted = words.format(**fault.get("ctx", {})).replace("'", '"')
    return f"expected {_name(place)}{' as ' if place else ''}{wanted} but got {_as_typed(fault['input'])}"


def _name(place: Sequence[str | int]) -> str:
    """Name a place in tables, as in "std of number 2 of parameter"."""
    return " of ".join(f"number {part + 1}" if isinstance(part, int) else part for part in reversed(place))


def _as_typed(value: Any) -> str:
    """Return a value about as it is typed in a study file."""
    text = json.dumps(value, ensure_ascii=False, default=str)
    return text if len(text) <= MAX_VALUE_LENGTH else f"{text[:MAX_VALUE_LENGTH]} ..."


def describe_invalid(error: Any) -> str:
    """Describe the first fault of a `pydantic.ValidationError`, with its place in the tables."""
    fault = error.errors(include_url=False)[0]
    return describe_fault(fault, fault["loc"])


def result_or_none(function: Callable[..., T], *arguments: Any, **keywords: Any) -> T | None:
    """Return the result of a call; None where it raises `FrictrackError`: others do without it, or report the fault."""
    try:
        return function(*arguments, **keywords)
    except FrictrackError:
        return None


@contextmanager
def needs_package(what: str, package: str) -> Iterator[None]:
    """Raise a failed import as a `FrictrackError`: what needs the module, and which package to install."""
    try:
        yield
    except ImportError as e:
        raise FrictrackError(f'{what} needs {e.name}; pip install "{package}"') from e


@contextmanager
def os_errors_as(what: str, advice: str = "") -> Iterator[None]:
    """Raise an error of the operating system as a `FrictrackError`: what could not be done, why, and what to do."""
    try:
        yield
    except OSError as e:
        raise FrictrackError("; ".join(filter(None, (f"{what}: {e.strerror or e}", advice)))) from e
