"""Declare a user's effect as a Python function.

    @ft.effect(F="N", x_c="m", w=("m", 1e-3, 0.1))
    def magnet(path, x_c, w):
        '''A magnet under the course pulls the mass in.'''
        return path.s * np.exp(-(((path.x - x_c) / w) ** 2))

Parameters that the function takes are non-linear. The others (F) are the coefficients of the columns that it returns.
"""

from __future__ import annotations

import inspect
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace
from typing import Any, Literal

import numpy as np

from frictrack.base.errors import FrictrackError
from frictrack.effects.definition import Effect, Parameter
from frictrack.effects.formula import OPEN, Places
from frictrack.effects.path import Nonlinear, Path
from frictrack.effects.registry import DECLARED, is_library
from frictrack.records import Array

Declared = str | tuple[str, float, float] | Parameter  # unit; unit and bounds; or everything
N_SCAN_VALUES = 41


@dataclass(frozen=True)
class Columns:
    """The function of a user, its result checked and brought to shape (n, k)."""

    function: Callable[..., Array]
    taken: tuple[str, ...]
    count: int

    def __reduce_ex__(self, protocol: Any) -> Any:
        """Pickle the function by the place where it is found: in its module the effect has taken its name."""
        function = self.function
        if isinstance(getattr(sys.modules.get(function.__module__), function.__qualname__, None), Effect):
            function.__qualname__ += ".columns.function"
        return super().__reduce_ex__(protocol)

    def __call__(self, path: Path, nonlinear: Nonlinear) -> Array:
        """One column per coefficient."""
        made = np.asarray(self.function(path, **{name: nonlinear[name] for name in self.taken}), dtype=float)
        made = made[:, None] if made.ndim == 1 else made
        if made.shape != (len(path.t), self.count):
            name = getattr(self.function, "__name__", "the function")
            raise FrictrackError(
                f"{name}: expected columns of shape ({len(path.t)}, {self.count}), one for each coefficient, "
                f"but got {made.shape}"
            )
        return made


def effect(
    *,
    acts_on: Literal["force", "measurement"] = "force",
    scales_with: Literal["nothing", "load", "mass"] = "nothing",
    about: Mapping[str, Any] | None = None,
    **parameters: Declared,
) -> Callable[[Callable[..., Array]], Effect]:
    """Declare a function as an effect, which its name stands for from then on in models, studies and commands.

    Parameters
    ----------
    acts_on : {"force", "measurement"}
        Whether the columns are forces, N, or errors of the measured position, m.
    scales_with : {"nothing", "load", "mass"}
        What carries its size from one run to another. With "load" the function multiplies by ``path.load``.
    about : mapping, optional
        Further fields of `Effect`, which the effects of the library have too: `looks_like`, `confirm`, `invariant`,
        `plausible`, `describe` and so on.
    **parameters
        Every parameter by its unit, by (unit, lowest, highest), or as a `Parameter`. Those that the function takes are
        non-linear; each of the others is the coefficient of one column (n, k) that the function returns.

    Returns
    -------
    callable
        A decorator that returns the `Effect`. Its `what` is the docstring of the function.

    Raises
    ------
    FrictrackError
        For a name of the library, a parameter without a unit, no coefficient, or an unknown field in `about`.

    Examples
    --------
    >>> import numpy as np
    >>> @effect(F="N", x_c="m", w=("m", 1e-3, 0.1), about={"invariant": "a magnet keeps its place"})
    ... def magnet(path, x_c, w):
    ...     '''A magnet under the course pulls the mass in.'''
    ...     return path.s * np.exp(-(((path.x - x_c) / w) ** 2))
    >>> magnet.equation, magnet.invariant
    ('F magnet(x_c, w)', 'a magnet keeps its place')
    >>> del DECLARED["magnet"]

    """

    def declare(function: Callable[..., Array]) -> Effect:
        name = function.__name__
        taken = tuple(inspect.signature(function).parameters)[1:]
        linear = [p for p in parameters if p not in taken]
        _check(name, taken, linear, parameters)
        loaded = scales_with == "load"
        made = tuple(_parameter(name, p, parameters[p], p in linear, loaded) for p in (*linear, *taken))
        found = Effect(
            name=name,
            acts_on=acts_on,
            equation=("y: " * (acts_on == "measurement"))
            + " + ".join(f"{p} {name}({', '.join(taken)})" for p in linear),
            parameters=made,
            columns=Columns(function, taken, len(linear)),
            scales_with=scales_with,
            may_pull=True,
            what=inspect.getdoc(function) or "An effect of your own.",
            source="declared in Python",
        )
        DECLARED[name] = replace(found, **_checked_fields(name, about or {}))
        return DECLARED[name]

    return declare


def _checked_fields(name: str, about: Mapping[str, Any]) -> Mapping[str, Any]:
    allowed = {f.name for f in fields(Effect)} - {"name", "acts_on", "parameters", "columns", "scales_with", "formula"}
    unknown = [key for key in about if key not in allowed]
    if unknown:
        raise FrictrackError(
            f'{name}: about: unknown field "{unknown[0]}"; known are {", ".join(sorted(allowed))}', usage=True
        )
    return about


def _check(name: str, taken: tuple[str, ...], linear: list[str], parameters: dict[str, Declared]) -> None:
    if is_library(name):
        raise FrictrackError(
            f'expected a name of its own for your effect but "{name}" is one of the library', usage=True
        )
    lost = [p for p in taken if p not in parameters]
    if lost:
        raise FrictrackError(f'{name}: expected every parameter with its unit, as in {lost[0]}="m"', usage=True)
    if not linear:
        raise FrictrackError(
            f'{name}: expected a coefficient of what it returns, such as F="N", which is no argument of the function',
            usage=True,
        )


def _parameter(name: str, p: str, declared: Declared, linear: bool, loaded: bool) -> Parameter:
    if isinstance(declared, Parameter):
        return Parameter(**vars(declared) | {"name": p, "linear": linear})
    unit, bounds = (
        (declared, OPEN) if isinstance(declared, str) else (declared[0], (float(declared[1]), float(declared[2])))
    )
    if linear:
        return Parameter(p, unit, bounds, linear=True, loaded=loaded)
    scan = Places(unit, bounds, N_SCAN_VALUES)
    if not scan.known:
        raise FrictrackError(f'{name}: expected bounds of {p}, as in {p}=("{unit}", 0.0, 1.0)', usage=True)
    return Parameter(p, unit, bounds, scan=scan, signed=unit == "m")
