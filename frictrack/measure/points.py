"""Make runs of points (v, F): friction that a bench measured at constant speeds, without time and place."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from frictrack.base.errors import FrictrackError, raise_faults
from frictrack.measure.tables import check_settings, checked_column, select_rows
from frictrack.records import Array, Displacement, Motion, Run
from frictrack.study import POINT_COLUMNS, TableData

MIN_SAME_SIGN = 0.9  # share of forces that have the sign that all are taken to have
MIN_POINTS = 5  # of a table of speeds and forces, in one study
MAX_SPEED = 300.0  # m/s; faster ones are in another unit


def run_of_curve(given: Mapping[str, Any], settings: Mapping[str, Any]) -> Run:
    """Make a run of speeds and forces; see `Run.from_curve`. None where not given."""
    values: dict[str, Any] = {}
    faults: list[str] = []
    for name, column in given.items():
        if column is not None:
            values[name], found = checked_column(name, column, np.size(given["v"]), "v")
            faults += found
    raise_faults(faults, f'run "{settings.get("name", "run")}"')
    read = points_of_table(TableData(np.arange(np.size(values["v"]), dtype=float), **values))
    check_settings(settings)
    bare = Run(*motion_of_points(read), friction_N=read.friction, steady=True, **settings)
    return replace(bare, **forces_of_points(read, bare.load))


def points_of_table(data: TableData) -> TableData:
    """Order points (v, F) by speed, and bring their forces to the sign of the speed.

    Raises
    ------
    FrictrackError
        If there are too few points, neither a force nor a coefficient, or a value that cannot be right.

    """
    if (data.friction is None) == (data.mu is None):
        came = "none" if data.mu is None else "both"
        raise FrictrackError(f"expected a force (friction) or a coefficient (mu) for every speed but got {came}")
    v = np.asarray(data.v)
    given = [column for name in POINT_COLUMNS if (column := getattr(data, name)) is not None]
    known = np.all(np.isfinite(given), axis=0)
    moving, notes = known & (v != 0), list(data.notes)
    if unknown := int(np.sum(~known)):
        notes.append(f"{unknown} of {len(known)} rows lack a value; left out")
    if still := int(np.sum(known & ~moving)):
        notes.append(
            f"{still} of {len(known)} points are at rest, where any force below static friction holds; left out"
        )
    if data.mu is not None and data.load is None:
        notes.append("coefficients of friction: forces are those at the normal load of the run, or at 1 N without it")
    order = np.flatnonzero(moving)[np.argsort(v[moving], kind="stable")]
    data = select_rows(data, order)
    _check_points(data)
    force, words = _resisting(data)
    return replace(data, t=np.arange(len(order), dtype=float), friction=force, notes=(*notes, *words))


def _check_points(data: TableData) -> None:
    speeds = np.abs(np.asarray(data.v))
    if len(speeds) < MIN_POINTS:
        raise FrictrackError(f"expected at least {MIN_POINTS} points at speeds other than 0 but got {len(speeds)}")
    if (fastest := float(np.max(speeds))) > MAX_SPEED:
        raise FrictrackError(
            f'expected speeds in m/s but got {fastest:g} m/s; state their unit, as in v = "speed (mm/s)"'
        )
    sizes = {"sigma_friction": "standard deviations", "sigma_mu": "standard deviations", "load": "normal loads"}
    for name, words in sizes.items():
        if (column := getattr(data, name)) is not None and not np.all(column > 0):
            raise FrictrackError(f"expected {words} above 0 but got {np.min(column):g}")


def _resisting(data: TableData) -> tuple[Array, tuple[str, ...]]:
    """Return forces or coefficients (n,) that have the sign of the speed where they resist the motion, and a note."""
    force = np.asarray(data.friction if data.mu is None else data.mu)
    direction = np.sign(np.asarray(data.v))
    if np.ptp(direction) and abs(float(np.mean(np.sign(force)))) > MIN_SAME_SIGN:
        words = "the forces have one sign for both directions: taken as forces against the motion"
        return np.sign(np.mean(force)) * direction * force, (words,)
    if float(np.mean(force * direction > 0)) < 1 - MIN_SAME_SIGN:
        words = "the forces are opposite to the speed: taken as forces on the mass, of which friction is minus"
        return -force, (words,)
    return force, ()


def motion_of_points(data: TableData) -> tuple[Displacement, Motion]:
    """Make the records of points (v, F): t counts them, and nothing is known of the place."""
    v, n = np.asarray(data.v), len(data.t)
    nan, still, small = np.full(n, np.nan), np.zeros(n), np.full(n, 1e-9 * float(np.min(np.abs(v))))
    seen = Displacement(data.t, still, nan, nan, small, nan, np.ones(n, dtype=bool), notes=data.notes)
    return seen, Motion(data.t, still, v, still, nan, small, small, small, nan)


def forces_of_points(data: TableData, load: float | None) -> dict[str, Any]:
    """Return forces, deviations and loads of ordered points (v, F), N, as `Run` takes them.

    Coefficients are times the load of each point, else the `load` of the run, N, else 1 N.
    """
    loads = data.load
    if loads is None and data.mu is not None:
        loads = np.full(len(data.t), load or 1.0)
    factor = 1.0 if data.mu is None or loads is None else loads
    sigma = data.sigma_friction if data.sigma_mu is None or loads is None else data.sigma_mu * loads
    return {"friction_N": np.asarray(data.friction) * factor, "sigma_friction": sigma, "loads": loads}
