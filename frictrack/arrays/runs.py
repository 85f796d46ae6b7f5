"""Make a run of arrays or of a DataFrame: check it, smooth and differentiate the positions, warn of other units."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import fields, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from frictrack.arrays.even_table import MIN_ROWS, displacement_of_even_table, with_even_clock
from frictrack.errors import raise_faults
from frictrack.motion import differentiate, low_pass
from frictrack.plausibility import EnteredValues, implausible_entries, implausible_slide
from frictrack.records import Array, Run
from frictrack.study import COLUMNS, TableData, read_frame
from frictrack.units import parse_quantity

if TYPE_CHECKING:
    import pandas as pd

SMALLEST_STEP_S = np.finfo(float).tiny  # between time stamps that rise


def run_of_arrays(
    t: ArrayLike, x: ArrayLike, *, mass: float | str | None, optional: Mapping[str, Any], settings: Mapping[str, Any]
) -> Run:
    """Make a run of arrays; see `Run.from_arrays`.

    Parameters
    ----------
    t, x
        Time, s, and position along the course, m, (n,).
    mass
        Sliding mass, kg, or a text with unit.
    optional
        Further columns by name: "sigma", "y", "drive" or "friction"; None where not measured, a number if constant.
    settings
        For `Run`.

    """
    columns: dict[str, Any] = {}
    faults: list[str] = []
    for name, values in {"t": t, "x": x, **optional}.items():
        if values is not None:
            columns[name], found = _column(name, values, np.size(t))
            faults += found
    raise_faults(faults, f'run "{settings.get("name", "run")}"')
    return _run_of(TableData(**columns), mass, settings)


def run_of_dataframe(
    frame: pd.DataFrame, columns: Mapping[str, str], mass: float | str | None, settings: Mapping[str, Any]
) -> Run:
    """Make a run of a DataFrame; see `Run.from_dataframe`.

    Parameters
    ----------
    frame
        One row per sample.
    columns
        Headers by short name.
    mass
        Sliding mass, kg, or a text with unit.
    settings
        For `Run`.

    """
    data = read_frame(frame, columns, str(settings.get("name", "run")))
    return _run_of(data, mass, settings)


def _column(name: str, values: ArrayLike, n: int) -> tuple[Array, list[str]]:
    """Convert to an array (n,) of floats, and list what is wrong with it."""
    try:
        number = parse_quantity(values, COLUMNS[name][1], name)[0] if isinstance(values, str) else values
        array = np.asarray(number, dtype=np.float64)
    except (TypeError, ValueError):
        return np.full(n, np.nan), [f"expected numbers in {name} but got {type(values).__name__}"]
    if array.ndim == 0 and name not in ("t", "x"):
        array = np.full(n, float(array))
    if array.shape != (n,):
        return np.full(n, np.nan), [f"expected {name} of shape ({n},), as t has {n} values, but got {array.shape}"]
    bad = np.flatnonzero(~np.isfinite(array))
    if len(bad):
        hint = "; leave the row out where nothing was measured" if name == "x" else ""
        return array, [f"expected finite {name} but got {array[bad[0]]} in row {bad[0]}{hint}"]
    if name == "t" and np.any(back := np.diff(array) < (0 if n >= MIN_ROWS and np.ptp(array) > 0 else SMALLEST_STEP_S)):
        i = int(np.argmax(back))
        return array, [f"expected rising time but got t[{i + 1}] = {array[i + 1]:g} s after t[{i}] = {array[i]:g} s"]
    return array, []


def _run_of(data: TableData, mass: float | str | None, settings: Mapping[str, Any]) -> Run:
    """Make a run of a table in SI units, and warn of values that are likely in another unit."""
    weighed, sigma_mass = (None, 0.0) if mass is None else parse_quantity(mass, "kg", "mass")
    table = with_even_clock(data)
    displacement, forces = displacement_of_even_table(table), table.data
    given: dict[str, Any] = {"sigma_mass": sigma_mass, "drive": forces.drive, "friction_N": forces.friction}
    given |= {name: _in_si(name, value) for name, value in settings.items()}
    run = Run(displacement, differentiate(low_pass(displacement)), mass=weighed, **given)
    _warn_of_other_units(run, has_unit=isinstance(mass, str))
    return run


def _in_si(name: str, value: Any) -> Any:
    """Convert a setting of a run that is a text with a unit, such as ``"9.8 N"`` or ``("10 ms", "0.2 s")``."""
    if isinstance(value, tuple | list):
        return tuple(_in_si(name, part) for part in value)
    units = {one.name: one.metadata.get("unit", "") for one in fields(Run)} | {"free": "s"}
    unit = units.get(name, "")
    return parse_quantity(value, unit, name)[0] if isinstance(value, str) and unit else value


def _warn_of_other_units(run: Run, *, has_unit: bool) -> None:
    """Warn, once a sentence, of mass, clock and positions that no laboratory has."""
    bare = frozenset() if has_unit else frozenset({"mass"})
    findings = implausible_entries(EnteredValues(run.name, mass=run.mass, bare=bare))
    findings += implausible_slide(run, film=False)
    for finding in findings:
        warnings.warn(str(replace(finding, run=run.name)), stacklevel=4)
