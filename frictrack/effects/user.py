"""A user's effect as a function in Python.

    @ft.effect(F="N", x_c="m", w=("m", 1e-3, 0.1))
    def magnet(path, x_c, w):
        '''A magnet under the course pulls the mass in.'''
        return path.s * np.exp(-(((path.x - x_c) / w) ** 2))

What the function takes beside the path is non-linear, what else is declared (F) is the coefficient of a column that
it returns, in order. Once declared, the name stands wherever an effect's does.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from frictrack.effects.base import Effect, Nonlinear, Parameter, Path
from frictrack.effects.formula import OPEN, Places
from frictrack.errors import FrictrackError
from frictrack.records import Array

Declared = str | tuple[str, float, float] | Parameter  # unit; unit and bounds; or everything
COUNT = 41  # places of a scan
DECLARED: dict[str, Effect] = {}  # by name, in the order in which they were declared


@dataclass(frozen=True)
class Columns:
    """The function of a user, its result checked and brought to shape (n, k)."""

    function: Callable[..., Array]
    taken: tuple[str, ...]
    count: int

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
    **parameters: Declared,
) -> Callable[[Callable[..., Array]], Effect]:
    """Declare a function as an effect; its parameters by unit, (unit, low, high) or `Parameter`.

    A parameter that the function takes is non-linear, every other one the coefficient of a column (n, k) that it
    returns: N per unit of it, m for one that acts on the measurement. With `scales_with` "load" the columns carry
    ``path.load``. Raises FrictrackError (usage) when names do not go together.
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
            what=inspect.getdoc(function) or "An effect of your own.",
            source="declared in Python",
        )
        DECLARED[name] = found
        return found

    return declare


def _check(name: str, taken: tuple[str, ...], linear: list[str], parameters: dict[str, Declared]) -> None:
    from frictrack.effects import is_library  # noqa: PLC0415 - the table knows this file

    if is_library(name):
        raise FrictrackError(
            f'expected a name of its own for your effect but "{name}" is one of the library', usage=True
        )
    lost = [p for p in taken if p not in parameters]
    if lost:
        raise FrictrackError(f'{name}: expected every parameter with its unit, as in {lost[0]}="m"', usage=True)
    if not linear:
        raise FrictrackError(
            f'{name}: expected a coefficient that multiplies what it returns, such as F="N", which it does not take',
            usage=True,
        )


def _parameter(name: str, p: str, told: Declared, linear: bool, loaded: bool) -> Parameter:
    if isinstance(told, Parameter):
        return Parameter(**vars(told) | {"name": p, "linear": linear})
    unit, bounds = (told, OPEN) if isinstance(told, str) else (told[0], (float(told[1]), float(told[2])))
    if linear:
        return Parameter(p, unit, bounds, linear=True, loaded=loaded)
    scan = Places(unit, bounds, COUNT)
    if not scan.known:
        raise FrictrackError(f'{name}: expected bounds of {p}, as in {p}=("{unit}", 0.0, 1.0)', usage=True)
    return Parameter(p, unit, bounds, scan=scan, signed=unit == "m")
