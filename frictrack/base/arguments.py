"""Check the arguments of public functions against their annotations, and convert texts with units to numbers."""

from __future__ import annotations

import inspect
import numbers
import re
import types
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import cache, wraps
from typing import Annotated, Any, Literal, ParamSpec, TypeVar, Union, get_args, get_origin, get_type_hints

import numpy as np

from frictrack.base.errors import UsageError, suggest
from frictrack.base.units import parse_quantity

P = ParamSpec("P")
T = TypeVar("T")
NUMBERS = (None, Any, float, int, Sequence[float])  # values of lists that need no words
MAX_SHOWN = 60  # characters of a wrong value in a message
WORDS = {  # of types: what is expected
    "bool": "True or False", "float": "a number", "int": "a whole number", "str": "a text", "Path": "a path",
    "Callable": "a function", "DataFrame": "a pandas DataFrame", "Generator": "a random generator",
    "Mapping": "values by name {...}", "Areas": "areas of the picture", "Track": "a track (from ft.track)",
    "Displacement": "a displacement (from ft.calibrate)", "Effect": "an effect (from ft.effects)",
    "Filtered": "a filtered displacement (from ft.low_pass)", "Fit": "a fit (from ft.fit)",
    "GroupFits": "a fit (from ft.fit)", "Model": "a model (from ft.models)",
    "Motion": "a motion (from ft.differentiate)", "Prior": "a prior (from ft.Prior.read or fit.to_prior)",
    "Recording": "a recording (from ft.open_recording)", "Run": "a run (from ft.Run.from_arrays)",
    "SearchMethod": "a search (from ft.search)",
}  # fmt: skip


def checked(function: Callable[P, T]) -> Callable[P, T]:
    """Check arguments by the annotations of a function: one `UsageError` says what was expected and what came.

    A text with a unit is converted where the annotation states one, ``Annotated[float, "Hz"]``. The older keyword
    `seed` is taken as `rng`, with a deprecation warning.

    References
    ----------
    SPEC 7, Seeding pseudo-random number generation, https://scientific-python.org/specs/spec-0007

    Examples
    --------
    >>> @checked
    ... def wait(duration: Annotated[float, "s"], *, rng: int = 0):
    ...     return duration
    >>> wait("20 ms")
    0.02
    >>> wait([20])
    Traceback (most recent call last):
    frictrack.base.errors.UsageError: wait: expected duration to be a number but got [20]

    """
    if "checked" in vars(function):
        return function
    if isinstance(function, type):
        setattr(function, "__init__", checked(vars(function)["__init__"]))  # noqa: B010 - mypy
        return function
    signature, own = inspect.signature(function), function.__qualname__.removesuffix(".__init__")

    @wraps(function)
    def with_checks(*args: Any, **keywords: Any) -> T:
        if "seed" in keywords and "rng" in signature.parameters:
            if "rng" in keywords:
                raise UsageError(f"{own}: expected rng or seed but got both")
            warnings.warn(f"seed is deprecated in {own}(); use rng", DeprecationWarning, stacklevel=2)
            keywords["rng"] = keywords.pop("seed")
        try:
            bound = signature.bind(*args, **keywords)
        except TypeError as error:
            raise UsageError(f"{own}: {_mismatch(str(error), signature)}") from None
        kinds = _kinds(function)
        for name, value in bound.arguments.items():
            shape, kind = signature.parameters[name].kind, kinds[name]
            if shape is inspect.Parameter.VAR_KEYWORD:
                bound.arguments[name] = {one: _taken(value[one], kind, own, one) for one in value}
            elif shape is inspect.Parameter.VAR_POSITIONAL:
                bound.arguments[name] = tuple(_taken(one, kind, own, name) for one in value)
            else:
                bound.arguments[name] = _taken(value, kind, own, name)
        return function(*bound.args, **bound.kwargs)

    vars(with_checks)["checked"] = True
    return with_checks


def _mismatch(said: str, signature: inspect.Signature) -> str:
    """Return what is wrong with a call whose arguments have other names, or another number, than expected."""
    shapes = {name: one.kind for name, one in signature.parameters.items() if name not in ("self", "cls")}
    known = [name for name in shapes if shapes[name] is not inspect.Parameter.VAR_KEYWORD]
    _, _, rest = said.partition("'")
    name = rest.partition("'")[0]
    if "missing" in said:
        return f'expected a value for "{name}" but got none'
    if not name:
        named = [n for n in known if shapes[n] is inspect.Parameter.KEYWORD_ONLY]
        hint = f"; give {', '.join(named)} by name" if named else ""
        count = len(known) - len(named)
        return f"expected {count or 'no'} value{'' if count == 1 else 's'} without a name but got more{hint}"
    return f'unknown name "{name}"; {suggest(name, known)}'


@cache
def _kinds(function: Callable[..., Any]) -> dict[str, Any]:
    """Return the type of every parameter; its name where that is imported for type checkers only."""
    function = inspect.unwrap(function)
    kinds: dict[str, Any] = {}
    for name in inspect.signature(function).parameters:
        one = types.SimpleNamespace(__annotations__={name: function.__annotations__.get(name, Any)})
        try:
            kinds |= get_type_hints(one, function.__globals__, include_extras=True)
        except NameError:
            kinds[name] = one.__annotations__[name]
    return kinds


def _taken(value: Any, kind: Any, where: str, name: str) -> Any:
    """Return a value as its parameter takes it: a text with a unit as a number, all that seeds as a generator."""
    if name == "rng" and isinstance(value, np.random.SeedSequence | np.random.BitGenerator | list | np.ndarray):
        value = np.random.default_rng(value)
    if isinstance(value, np.ndarray) and value.ndim == 0:
        value = value.item()
    if isinstance(value, Iterator) and any(_values(one) is not None for one in _parts(kind)):
        value = list(value)
    value = _in_si_units(value, kind, name)
    if _fits(value, kind):
        return value
    records = [_values(one) for one in _parts(kind) if _values(one) not in NUMBERS]
    hint = f"; write [{name}]" if any(_fits(value, one) for one in records) else ""
    raise UsageError(f"{where}: expected {name} to be {_described(kind)} but got {_came(value)}{hint}")


def _in_si_units(value: Any, kind: Any, name: str) -> Any:
    """Return a text with a unit, or a list of them, as numbers, where the annotation states the unit."""
    for one in _parts(kind):
        if get_origin(one) is Annotated and isinstance(value, str) and isinstance(one.__metadata__[0], str):
            return parse_quantity(value, one.__metadata__[0], name)[0]
        if (inner := _values(one)) is not None and isinstance(value, list | tuple):
            parts = [_in_si_units(part, inner, name) for part in value]
            return value if all(a is b for a, b in zip(parts, value, strict=True)) else type(value)(parts)
    return value


def _parts(kind: Any) -> tuple[Any, ...]:
    """Return the types of a union, else the type alone."""
    return get_args(kind) if get_origin(kind) in (Union, types.UnionType) else (kind,)


def _values(kind: Any) -> Any:
    """Return the type of the values of a list or an array; None for other types."""
    origin = get_origin(kind)
    if not (isinstance(origin, type) and issubclass(origin, Iterable)) or issubclass(origin, Mapping):
        return None
    inner = {one for one in get_args(kind) if one is not ...}
    return Any if origin is np.ndarray or len(inner) > 1 else inner.pop()


def _fits(value: Any, kind: Any) -> bool:  # noqa: PLR0911 - one case per kind of type
    """Return whether a value is of a type; NumPy's scalars count as numbers, and every list as a sequence."""
    origin, inner = get_origin(kind), _values(kind)
    if isinstance(kind, str):  # the name of a class, or more than that, which is not checked
        name = kind.rpartition(".")[2]
        return not name.isidentifier() or any(one.__name__ == name for one in type(value).__mro__)
    if origin in (Union, types.UnionType):
        return any(_fits(value, one) for one in get_args(kind))
    if origin in (Annotated, Literal):
        return value in get_args(kind) if origin is Literal else _fits(value, get_args(kind)[0])
    if origin is not None and isinstance(origin, type) and issubclass(origin, Mapping):
        return isinstance(value, Mapping) and all(_fits(one, get_args(kind)[1]) for one in value.values())
    if inner is not None:
        other = str | bytes if origin is Iterable else str | bytes | Mapping
        listed = isinstance(value, Iterable) and not isinstance(value, other)
        return listed and (not isinstance(value, list | tuple) or all(_fits(part, inner) for part in value))
    wanted = {int: numbers.Integral, float: numbers.Real, bool: bool | np.bool_}.get(kind, origin or kind)
    if kind is Any or not isinstance(wanted, type | types.UnionType) or getattr(kind, "_is_protocol", False):
        return True
    return isinstance(value, wanted) and not (kind in (int, float) and isinstance(value, bool | np.bool_))


def _described(kind: Any) -> str:
    """Return a type in words."""
    origin, inner = get_origin(kind), _values(kind)
    if origin in (Union, types.UnionType):
        return " or ".join(dict.fromkeys(_described(one) for one in get_args(kind) if one is not type(None)))
    if origin is Annotated:
        return _described(get_args(kind)[0])
    if origin is Literal:
        return " or ".join(f'"{one}"' for one in get_args(kind))
    if inner is not None:
        several = re.sub(r"^an? ([\w ]+?)(?= \(|$)", r"\1s", _described(inner))  # "a run (from ...)": runs (from ...)
        return "a list [...]" if inner in NUMBERS else f"a list of {several}"
    name = kind.rpartition(".")[2] if isinstance(kind, str) else getattr(origin or kind, "__name__", "")
    return WORDS.get(name, name)


def _came(value: Any) -> str:
    """Return a value in few words."""
    if isinstance(value, np.ndarray):
        return f"an array {value.shape}"
    if isinstance(value, list | tuple) and not all(isinstance(part, str | numbers.Number) for part in value):
        return f"a list of {', '.join(sorted({type(part).__name__.removeprefix('nd') for part in value}))}"
    if value is None or isinstance(value, str | numbers.Number | list | tuple):
        text = f'"{value}"' if isinstance(value, str) else str(value)
        return text if len(text) <= MAX_SHOWN else f"{text[:MAX_SHOWN]} ..."
    return f"a {type(value).__name__}"
