"""Make displacements and runs of tables and arrays, also of points (v, F); `table_clock` has made their clock even."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Mapping
from dataclasses import fields, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from frictrack import sampling
from frictrack.base.errors import FrictrackError, UsageError, raise_faults, suggest
from frictrack.base.units import parse_quantity
from frictrack.measure.calibration import on_circle, parse_scale
from frictrack.measure.motion import differentiate, low_pass
from frictrack.measure.plausibility import (
    ACCEPTED,
    EnteredValues,
    implausible_entries,
    implausible_slide,
    wrong_incline,
)
from frictrack.measure.table_clock import MIN_JITTER_SHARE, MIN_ROWS, MIN_TRAVEL_M, select_rows, with_even_clock
from frictrack.records import Array, Displacement, Motion, Run
from frictrack.sampling import noise_level, white_noise
from frictrack.study import COLUMNS, POINT_COLUMNS, TableData, read_frame, unrolled_clock

if TYPE_CHECKING:
    import pandas as pd

SMALLEST_STEP_S = np.finfo(float).tiny  # between time stamps that rise
MAX_LEFT_OUT = 0.1  # of the rows of arrays, without a warning
MIN_SAME_SIGN = 0.9  # share of forces that have the sign that all are taken to have
MIN_POINTS = 5  # of a table of speeds and forces, in one study
MAX_SPEED = 300.0  # m/s; faster ones are in another unit


def displacement_of_table(
    data: TableData, *, fps: float | None = None, scale: str | None = None, x_offset: float = 0.0
) -> Displacement:
    """Compute the displacement of a table of positions.

    Missing columns are NaN, outliers are marked as invalid, and standard deviations that are not given are estimated.

    Examples
    --------
    >>> t = np.arange(100) / 1000
    >>> displacement_of_table(TableData(t, 2.0 * t)).x[-1]
    np.float64(0.198)

    """
    data = with_even_clock(data, fps)
    nan = np.full(len(data.t), np.nan)
    nan.setflags(write=False)  # so that the records share it
    pitch, relative = parse_scale(scale) if scale is not None else (None, 0.0)
    displacement = sampling.screened(
        Displacement(
            t=data.t,
            x=np.asarray(data.x) + x_offset,
            y=nan if data.y is None or not np.any(data.y) else data.y,  # a column of zeros was not measured
            angle=nan,
            sigma_x=nan if data.sigma is None else data.sigma,
            sigma_y=nan,
            valid=data.valid,
            pixel_pitch=pitch,
            relative_scale_error=relative,
            notes=data.notes,
            stamped_rate=data.stamped_rate,
            clock_error=data.clock_error,
        ),
        data.numbers,
    )
    if data.of_speeds:
        interval = float(np.median(np.diff(displacement.t)))
        sigma_v = max(white_noise(np.diff(displacement.x) / interval), MIN_TRAVEL_M)
        return replace(displacement, sigma_x=np.full(len(data.t), interval * sigma_v), sigma_v=sigma_v)
    displacement = _with_jitter_noise(on_circle(displacement, x_offset))
    is_known = not np.all(np.isnan(displacement.sigma_x))
    return displacement if is_known else replace(displacement, sigma_x=_table_sigma(displacement))


def _with_jitter_noise(displacement: Displacement) -> Displacement:
    """Return a displacement with larger standard deviations if its samples jitter although the time stamps are even."""
    if len(displacement) < MIN_ROWS or not sampling.is_even(displacement.t):
        return displacement
    interval, seen = float(np.median(np.diff(displacement.t))), displacement.valid  # others hold an earlier position
    t, x = displacement.t[seen], displacement.x[seen]
    step = max(displacement.pixel_pitch or 0.0, displacement.resolution)
    jitter, at_rest_noise = sampling.unevenness(t, x, 0.5 * step / interval)  # above it, rounding is white
    if not jitter:
        return displacement
    stated = np.isfinite(displacement.sigma_x)
    level = max(at_rest_noise, sampling.rounding_noise(displacement.resolution))
    at_rest = np.where(stated, displacement.sigma_x, level)
    moved = jitter * np.abs(np.interp(displacement.t, t, sampling.robust_speed(t, x)))
    if np.max(moved) < MIN_JITTER_SHARE * np.median(at_rest):
        return displacement
    note = (
        f"the noise grows with the speed, up to {sampling.describe_length(float(np.max(moved)))}, as if samples "
        f"jittered by {100 * jitter / interval:.2g} % of the interval of {interval:.6g} s (rms) although their time "
        "stamps are even; deviations grow with it"
    )
    return replace(displacement, sigma_x=np.hypot(at_rest, moved), notes=(*displacement.notes, note))


def _table_sigma(displacement: Displacement) -> Array:
    """Return the white noise (n,) of a table without standard deviations; at least that of rounding."""
    x = displacement.x
    steps, nothing = np.abs(np.diff(x)), 1e-12 * float(np.max(np.abs(x)))  # as the digits of a double add up
    rounding = float(np.min(steps[steps > nothing], initial=np.inf)) / np.sqrt(12.0)
    level, _ = noise_level(x, displacement.valid, t=displacement.t)
    sigma = max(level, sampling.rounding_noise(displacement.resolution))
    return np.full(len(x), sigma if sigma > nothing else rounding)


def run_of_arrays(
    t: ArrayLike, x: ArrayLike, *, mass: float | str | None, optional: Mapping[str, Any], settings: Mapping[str, Any]
) -> Run:
    """Make a run of arrays; see `Run.from_arrays`. `optional` holds further columns, None where not measured."""
    notes: tuple[str, ...] = ()
    both = [np.asarray(series) for series in (t, x)]
    if all(s.ndim == 1 and s.dtype.kind in "fiu" and s.shape == both[0].shape and np.isfinite(s).all() for s in both):
        t, notes = unrolled_clock(both[0].astype(np.float64), both[1].astype(np.float64))
    none = [] if np.size(t) else ["expected positions at several times but got none"]
    columns = _checked_columns({"t": t, "x": x, **optional}, "t", settings, none)
    return _run_of(TableData(**columns, notes=notes), mass, settings)


def run_of_dataframe(
    frame: pd.DataFrame, columns: Mapping[str, str], mass: float | str | None, settings: Mapping[str, Any]
) -> Run:
    """Make a run of a DataFrame; see `Run.from_dataframe`."""
    data = read_frame(frame, columns, str(settings.get("name", "run")))
    return _run_of(data, mass, settings)


def _checked_columns(
    given: Mapping[str, Any], first: str, settings: Mapping[str, Any], faults: Iterable[str] = ()
) -> dict[str, Any]:
    """Convert the columns that are given, each as long as the first one; raise all faults, also those found before."""
    n = np.size(given[first])
    checked = {name: checked_column(name, values, n, first) for name, values in given.items() if values is not None}
    raise_faults(
        [*(fault for _, found in checked.values() for fault in found), *faults], f'run "{settings.get("name", "run")}"'
    )
    return {name: column for name, (column, _) in checked.items()}


def checked_column(name: str, values: ArrayLike, n: int, first: str = "t") -> tuple[Array, list[str]]:
    """Convert to an array (n,) of floats, and list what is wrong with it."""
    try:
        unit = (COLUMNS | POINT_COLUMNS)[name][1]
        moments = np.asarray(values)
        if moments.dtype.kind in "mM" and moments.size:  # their type knows their unit
            values = (moments - (moments.flat[0] if moments.dtype.kind == "M" else 0)) / np.timedelta64(1, "s")
        values = parse_quantity(values, unit, name)[0] if isinstance(values, str) else values
        array = np.asarray(values).astype(np.float64, casting="same_kind" if moments.dtype.kind == "c" else "unsafe")
    except (TypeError, ValueError):
        return np.full(n, np.nan), [f"expected numbers in {name} but got {type(values).__name__}"]
    if "sigma" in name and np.any(array <= 0):
        return array, [f"expected {name} above 0 but got {np.min(array):g}"]
    if array.ndim == 0 and name not in ("t", "x", "v"):
        array = np.full(n, float(array))
    if array.shape != (n,):
        return np.full(n, np.nan), [
            f"expected {name} of shape ({n},), as {first} has {n} values, but got {array.shape}"
        ]
    bad = np.flatnonzero(~np.isfinite(array))
    if len(bad):
        hint = "; leave the row out where nothing was measured" if name == "x" else ""
        return array, [f"expected finite {name} but got {array[bad[0]]} in row {bad[0]}{hint}"]
    if name == "t" and np.any(back := np.diff(array) < (0 if n >= MIN_ROWS and np.ptp(array) > 0 else SMALLEST_STEP_S)):
        i = int(np.argmax(back))
        words = f"expected rising time but got t[{i + 1}] = {array[i + 1]:g} s after t[{i}] = {array[i]:g} s"
        return array, [f"{words}; sort the rows, or give t = np.arange(n) / rate where they are evenly spaced"]
    return array, []


def check_settings(settings: Mapping[str, Any]) -> None:
    """Raise an error for a setting that a run does not have."""
    known = [one.name for one in fields(Run) if one.name not in ("displacement", "motion")]
    if unknown := next((name for name in settings if name not in known), None):
        raise UsageError(f'unknown setting "{unknown}" of a run; {suggest(unknown, known)}')


def _run_of(data: TableData, mass: float | str | None, settings: Mapping[str, Any]) -> Run:
    """Make a run of a table in SI units, and warn of values likely in another unit, and of rows that are left out."""
    forces = with_even_clock(data)
    displacement = displacement_of_table(forces)
    check_settings(settings)
    given = {"drive": forces.drive, "friction_N": forces.friction, "has_incline": "incline" in settings, **settings}
    given["mass"] = mass
    run = Run(displacement, differentiate(low_pass(displacement)), **given)
    bare = frozenset() if isinstance(mass, str) else frozenset({"mass"})  # written without a unit
    entries = implausible_entries(EnteredValues(run.name, mass=run.mass, bare=bare))
    findings = filter(None, (*entries, *implausible_slide(run, film=False), wrong_incline(run)))
    words = [str(replace(finding, run=run.name)).replace(ACCEPTED, "ignore this warning") for finding in findings]
    if len(forces.t) < (1 - MAX_LEFT_OUT) * len(data.t):  # there is no report that says it
        words += [f'run "{run.name}": {note}' for note in forces.notes]
    for one in words:
        warnings.warn(one, stacklevel=5)  # the caller of `Run.from_arrays`
    return run


def run_of_curve(given: Mapping[str, Any], settings: Mapping[str, Any]) -> Run:
    """Make a run of speeds and forces; see `Run.from_curve`. None where not given."""
    values = _checked_columns(given, "v", settings)
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
