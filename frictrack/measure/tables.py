"""Make displacements and runs of tables and arrays: even clock, jitter, doubled and missing samples, noise."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields, replace
from itertools import product
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from frictrack import sampling
from frictrack.base.distributions import noise_of_differences, robust_std
from frictrack.base.errors import FrictrackError, UsageError, raise_faults, suggest
from frictrack.base.units import parse_quantity
from frictrack.measure.calibration import on_circle, parse_scale
from frictrack.measure.motion import differentiate, low_pass
from frictrack.measure.plausibility import (
    ACCEPTED,
    CONTRADICTION,
    MAX_RELATIVE_DIFFERENCE,
    EnteredValues,
    implausible_entries,
    implausible_slide,
    time_unit,
    wrong_incline,
)
from frictrack.records import Array, Displacement, Mask, Motion, Run
from frictrack.sampling import noise_level, white_noise
from frictrack.study import COLUMNS, POINT_COLUMNS, TableData, read_frame, unrolled_clock

if TYPE_CHECKING:
    import pandas as pd

Rows = NDArray[np.int64]
MIN_RATE_DIFFERENCE = 1e-3  # relative difference of two frame rates that is reported
DOUBLE_RESOLUTION = 8 * np.finfo(float).eps  # relative error of what a double holds
MIN_JUMP_SIGMAS = 10.0  # a smaller jump of a position, in its noise, is no missing sample
MAX_GAP_FRAMES = 1000
MIN_TRAVEL_M = 1e-15  # m: what moves by less does not move
MEASURED_COLUMNS = ("x", "y", "drive", "friction", "a", "pressure")
MIN_ROUNDING = 0.01  # of the interval; stamps rounded to less are even
FAST_QUANTILE, MIN_STAMP_NOISE_SHARE = 0.9, 0.2  # of speeds; of the noise of positions, that stamps may add
MIN_STAMP_ERROR = 1e-6  # of the interval; below are the digits of the numbers themselves
MAX_COUNTED_ROUNDING = 0.8  # of the interval; stamps rounded to more do not show where a row is missing
MAX_DOUBLED_SHARE = 0.1  # of rows that were written twice; more equal stamps are rounded
FPS_REMEDY = "the frame rate as fps in [camera], if no rows are missing, or "
MAX_DRIFT_INTERVALS, DRIFT_PARTS = 0.5, 8  # of stamps about counted rows, in means of so many parts
NEAR_SHARE = 0.5  # of the usual interval, below which a row is at nearly the time of the one before
MIN_ROWS = 16  # rows needed to find a fault of the clock
MIN_JITTER_SHARE = 0.1  # of the noise at rest; less adds half a percent to a standard deviation


@dataclass(frozen=True, eq=False)
class EvenTable:
    """A table whose rows lie on an even clock."""

    data: TableData
    valid: Mask  # whether a row holds a sample of its own
    numbers: Rows  # of each row in the file, counted from 0
    notes: tuple[str, ...] = ()  # what was corrected

    @classmethod
    def of(cls, data: TableData, numbers: Rows | None = None, notes: tuple[str, ...] = ()) -> EvenTable:
        """Make a table of which every row holds a sample, by default all rows of the file."""
        n = len(data.t)
        return cls(data, np.ones(n, dtype=bool), np.arange(n) if numbers is None else numbers, notes)

    def changed(self, data: TableData, *notes: str) -> EvenTable:
        """The same rows with other values, and further notes."""
        return replace(self, data=data, notes=(*self.notes, *notes))


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
    return displacement_of_even_table(with_even_clock(data, fps), scale=scale, x_offset=x_offset)


def displacement_of_even_table(table: EvenTable, *, scale: str | None = None, x_offset: float = 0.0) -> Displacement:
    """Compute the displacement of a table whose clock is even; see `displacement_of_table`."""
    data = table.data
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
            valid=table.valid,
            pixel_pitch=pitch,
            relative_scale_error=relative,
            notes=(*data.notes, *table.notes),
            stamped_rate=data.stamped_rate,
            clock_error=data.clock_error,
        ),
        table.numbers,
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
    jitter, at_rest_noise = sampling.unevenness(t, x, _max_resolved_speed(displacement))
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


def _max_resolved_speed(displacement: Displacement) -> float:
    """Return the speed of half a pixel or half a step per sample, m/s; rounding errors grow with the speed below it."""
    step = max(displacement.pixel_pitch or 0.0, displacement.resolution)
    return 0.5 * step / float(np.median(np.diff(displacement.t)))


def _table_sigma(displacement: Displacement) -> Array:
    """Return the white noise (n,) of a table without standard deviations; at least that of rounding."""
    x = displacement.x
    steps, nothing = np.abs(np.diff(x)), 1e-12 * float(np.max(np.abs(x)))  # as the digits of a double add up
    rounding = float(np.min(steps[steps > nothing], initial=np.inf)) / np.sqrt(12.0)
    level, _ = noise_level(x, displacement.valid, t=displacement.t)
    sigma = max(level, sampling.rounding_noise(displacement.resolution))
    return np.full(len(x), sigma if sigma > nothing else rounding)


def with_even_clock(data: TableData, fps: float | None = None) -> EvenTable:
    """Return the rows of a table, unwrapped, on an even clock; where time stamps contradict `fps` (Hz), it decides."""
    if data.x is not None and np.any(lost := sampling.placeholders(data.x)):
        rows, value = np.flatnonzero(~lost), float(data.x[lost][0])
        count = sampling.count_text(int(np.sum(lost)), "row holds", "rows hold")
        note = f"{count} {value:.6g} instead of a position: left out"
        seen = with_even_clock(replace(select_rows(data, rows), notes=(*data.notes, note)), fps)
        return replace(seen, numbers=rows[seen.numbers])
    n = len(data.t)
    if data.x is not None:
        x, turned = sampling.unwrapped(data.x)
        data = replace(data, x=x, notes=(*data.notes, *turned)) if turned else data
    if data.x is None or (n < MIN_ROWS and not (fps and not sampling.is_even(data.t))):
        return EvenTable.of(data)
    if (rounding := _rounding(data)) and (table := _with_rounded_clock(data, rounding, fps)) is not None:
        return table
    clocked = not sampling.is_even(data.t) or _stamps_add_noise(data)
    table = _with_clock_of_stamps(data) if clocked and n >= MIN_ROWS else EvenTable.of(data)
    if fps and (not sampling.is_even(table.data.t) or _lost_moving_rows(data, table.numbers)):
        words = f"the time stamps are uneven: each row has the nearest time that fps = {fps:.6g} has"
        table, clocked = EvenTable.of(_counted_at_rate(data, fps), notes=(words,)), False
    table = _without_near_rows(table)
    if repeated := int(np.sum(np.diff(table.data.t) <= 0)):
        raise FrictrackError(
            f"time: {repeated} stamps repeat the one before, which rounding of an even clock does not explain: "
            "the rate changes or rows are missing; give stamps with more digits"
        )
    table = _on_grid(_at_rate(table, fps))
    return _without_slips(table, clocked=clocked) if _can_find_slips(table.data) else table  # else the smoother reports


def _rounding(data: TableData) -> float:
    """Return to what the time stamps are rounded, s; 0 where that leaves them even, or the motion confirms all gaps."""
    steps, moved = np.diff(data.t), np.diff(np.asarray(data.x))
    twice = (steps == 0) & (moved == 0)  # rows that were written twice
    own = data.t[np.flatnonzero(np.r_[True, ~twice])] if np.mean(twice) < MAX_DOUBLED_SHARE else data.t
    rounding = sampling.stamp_rounding(own) if np.all(steps >= 0) and data.t[-1] > data.t[0] else 0.0
    if not rounding:
        return 0.0
    if not sampling.is_even(data.t):
        return rounding if rounding > MIN_ROUNDING * float(np.mean(steps)) else 0.0
    intervals = np.diff(sampling.frame_numbers(data.t))
    as_rows, as_gaps = np.abs(np.diff(moved, 2)), intervals[1:-1] * np.abs(np.diff(moved / intervals, 2))
    wide = (intervals[1:-1] == 2) & (np.maximum(as_rows, as_gaps) > MIN_JUMP_SIGMAS * np.median(as_rows))
    return rounding if np.any(as_rows[wide] < 0.5 * as_gaps[wide]) else 0.0


def _stamps_add_noise(data: TableData) -> bool:
    """Whether even stamps are off their clock by so much that a fast mass moves by the noise of its positions."""
    frames = sampling.frame_numbers(data.t)
    off = float(np.std(data.t - np.polyval(np.polyfit(frames, data.t, 1), frames)))
    assert data.x is not None
    if off < MIN_STAMP_ERROR * float(np.median(np.diff(data.t))):
        return False  # rounding of the numbers themselves
    fast = float(np.quantile(np.abs(np.diff(data.x) / np.maximum(np.diff(data.t), off)), FAST_QUANTILE))
    return fast * off > MIN_STAMP_NOISE_SHARE * noise_of_differences(np.diff(data.x, 3), 3)


def _with_rounded_clock(data: TableData, rounding: float, fps: float | None) -> EvenTable | None:
    """Return a table with rounded stamps on an even clock; None where the stamps are not rounded even times."""
    given = 1 / fps if fps else None
    every = np.arange(len(data.t))
    counts = [every]  # the motion shows missing rows, also where stamps are rounded to an interval or more
    if rounding < MAX_COUNTED_ROUNDING * float(np.ptp(data.t)) / len(data.t):
        counts = [sampling.count_intervals(data.t, rounding, given), every]
    for interval, ticks in product((None, given) if given else (None,), counts):
        rows = every[np.diff(ticks, prepend=-1) > 0]
        if len(rows) < (1 - MAX_DOUBLED_SHARE) * len(every):
            continue
        moving = replace(select_rows(data, rows), t=ticks[rows].astype(float))
        table = EvenTable.of(moving, rows, _doubled_note(np.setdiff1d(every, rows)))
        table = _without_slips(table, clocked=False) if _can_find_slips(moving) else table
        stamps, counted = data.t[table.numbers], np.rint(table.data.t).astype(np.int64)
        if _is_miscounted(stamps, counted, rounding):
            continue
        clock = sampling.rounded_clock(stamps, counted, rounding, interval)
        clock = clock or sampling.jittered_clock(stamps, counted, np.asarray(data.x)[table.numbers], rounding)
        if clock is not None:
            clocked = replace(table, data=_at_clock(select_rows(data, table.numbers), clock))
            return _at_rate(replace(clocked, notes=(*clock.notes, *table.notes)), fps, rounding)
    if sampling.is_even(data.t):
        raise FrictrackError(
            f"time: expected stamps of an even clock but they are rounded to {rounding:.4g} s and the motion "
            f"contradicts the gaps they leave; give {'' if fps else FPS_REMEDY}stamps with more digits"
        )
    return None


def _can_find_slips(data: TableData) -> bool:
    """Return whether the rows lie on an even clock without long gaps, and the target moves."""
    steps, travel = np.diff(data.t), float(np.ptp(np.asarray(data.x)))
    longest = float(np.max(steps) / np.median(steps))
    return sampling.is_even(data.t) and longest < MAX_GAP_FRAMES and travel > MIN_TRAVEL_M


def _with_clock_of_stamps(data: TableData) -> EvenTable:
    """Return a table with uneven time stamps on an even clock, where these show one."""
    from frictrack.recording import read_stamps  # noqa: PLC0415 - loads OpenCV; even tables do without

    read = read_stamps(data.t)
    if read is None:
        return EvenTable.of(data)
    if np.any(data.t[read.doubled] - data.t[read.doubled - 1] > MIN_JITTER_SHARE * read.step):
        return EvenTable.of(data)  # rows of their own, at uneven times
    rows = np.setdiff1d(np.arange(len(data.t)), read.doubled)
    ticks = _fill_corrupt_ticks(read.ticks)[rows]
    right = data.t[0] + (ticks - ticks[0]) * read.step
    stamps = np.where(np.isin(rows, read.corrupt), right, data.t[rows])
    taken = replace(select_rows(data, rows), t=stamps)
    if np.any(np.diff(ticks) <= 0) or np.any(np.diff(stamps) <= 0):
        return EvenTable.of(data)
    notes = _doubled_note(read.doubled)
    if len(read.corrupt):
        notes += (f"the time stamp is wrong in {sampling.describe_frames(read.corrupt)}; the row stays in its place",)
    good = sampling.is_even(taken.t) and not _stamps_add_noise(taken)
    clock = None if good else sampling.jittered_clock(taken.t, ticks, np.asarray(taken.x))
    table = EvenTable.of(taken, rows, notes)
    return table if clock is None else table.changed(_at_clock(taken, clock), *clock.notes)


def _doubled_note(rows: Rows) -> tuple[str, ...]:
    count = sampling.count_text(len(rows), "row has", "rows have")
    note = f"{count} the time stamp of the row before: {sampling.describe_frames(rows)}; left out"
    return (note,) if len(rows) else ()


def _fill_corrupt_ticks(ticks: Rows) -> Rows:
    """Return frame numbers, with those of corrupt stamps (-1) interpolated."""
    known = ticks >= 0
    return np.rint(np.interp(np.arange(len(ticks)), np.flatnonzero(known), ticks[known])).astype(np.int64)


def _at_clock(data: TableData, clock: sampling.EvenClock) -> TableData:
    """Return a table at the times of a clock; positions are shifted by the delay of their samples."""
    moved: dict[str, Any] = {
        name: column - sampling.robust_speed(data.t, column) * clock.late if np.any(clock.late) else column
        for name, column in (("x", data.x), ("y", data.y))
        if column is not None
    }
    return replace(data, t=clock.t, clock_error=clock.error, **moved)


def _without_near_rows(table: EvenTable) -> EvenTable:
    """Return the rows of an uneven clock that are not at nearly the time of the one before."""
    data, rows = table.data, table.numbers
    steps, usual = np.diff(data.t), float(np.median(np.diff(data.t)))
    even = sampling.is_even(data.t) or np.min(steps) > sampling.MIN_SHORTEST * usual
    if even or np.mean(steps <= 0) > MAX_DOUBLED_SHARE:
        return table
    stay = [0]
    for i, one in enumerate(data.t.tolist()):
        if one - data.t[stay[-1]] > NEAR_SHARE * usual:
            stay.append(i)
    note = f"{len(rows) - len(stay)} of {len(rows)} rows come at nearly the time of the row before: left out"
    return EvenTable.of(select_rows(data, np.array(stay)), rows[stay], (*table.notes, note))


def _on_grid(table: EvenTable) -> EvenTable:
    """Return a table with uneven times at the nearest times of an even grid."""
    data = table.data
    columns = {name: column for name in MEASURED_COLUMNS if (column := getattr(data, name)) is not None}
    moved = None if sampling.is_even(data.t) else sampling.moved_to_grid(data.t, list(columns.values()))
    if moved is None:
        return table
    found: dict[str, Any] = dict(zip(columns, moved[1], strict=True))
    note = "the times are uneven; the columns are moved along their course to the nearest times of an even grid"
    return table.changed(replace(data, t=moved[0], **found), note)


def select_rows(data: TableData, rows: Rows) -> TableData:
    """Return some rows of a table."""
    columns = {f.name: getattr(data, f.name) for f in fields(data)}
    taken: dict[str, Any] = {n: column[rows] for n, column in columns.items() if isinstance(column, np.ndarray)}
    return replace(data, **taken)


def _at_rate(table: EvenTable, fps: float | None, rounding: float = 0.0) -> EvenTable:
    """Return a table with the given frame rate, and a note if its stamps contradict it."""
    data = table.data
    if fps is None:
        return table
    span = float(data.t[-1] - data.t[0])
    frames = (data.t - data.t[0]) / float(np.median(np.diff(data.t)))
    frames = sampling.frame_numbers(data.t) if sampling.is_even(data.t) else frames
    rate = float(frames[-1]) / span
    note = f"the time stamps say {rate:.6g} Hz but fps = {fps:.6g} is given; fps is used"
    differs = abs(rate / fps - 1) - rounding / span
    if time_unit(fps / rate):  # the times are in another unit; the check of the clocks says which
        return table
    if differs > MAX_RELATIVE_DIFFERENCE:
        note, data = f"{note}; {CONTRADICTION}", replace(data, stamped_rate=rate)
    notes = [note] if differs > MIN_RATE_DIFFERENCE else []
    return table.changed(replace(data, t=data.t[0] + frames / fps, clock_error=0.0), *notes)


def _lost_moving_rows(data: TableData, rows: Rows) -> bool:
    """Whether rows that are left out for their stamps have positions of their own."""
    x, lost = np.asarray(data.x), np.setdiff1d(np.arange(1, len(data.t)), rows)
    return bool(np.any(x[lost] != x[lost - 1]))


def _counted_at_rate(data: TableData, fps: float) -> TableData:
    """Return a table at whole intervals of a given frame rate, Hz: those that its uneven stamps are nearest to."""
    ticks = np.rint((data.t - data.t[0]) * fps).astype(np.int64)
    if np.any(np.diff(ticks) <= 0):  # no row comes at the time of another one; the motion shows where one is missing
        ticks = np.arange(len(ticks))
    if _is_miscounted(data.t, ticks, sampling.stamp_rounding(data.t)):
        raise FrictrackError(
            "time: expected rows that the stamps or the motion can count but some are missing where neither shows it; "
            "give stamps with more digits"
        )
    return replace(data, t=data.t[0] + ticks / fps, clock_error=0.0)


def _is_miscounted(stamps: Array, ticks: Rows, rounding: float) -> bool:
    """Whether stamps (n,) drift from a line through counted intervals: a row that is not counted shifts later ones."""
    slope, start = np.polyfit(ticks, stamps, 1)
    off = stamps - start - slope * ticks
    drift = float(np.ptp([np.mean(part) for part in np.array_split(off, DRIFT_PARTS)]))
    # a part ends within a step of rounding, an eighth of it off; the range of eight means is four deviations at most
    of_rounding = 0.25 * DRIFT_PARTS * rounding**2 / float(np.ptp(stamps)) if rounding else 0.0
    of_jitter = 4.0 * float(robust_std(np.diff(off))) * np.sqrt(0.5 * DRIFT_PARTS / len(off))
    return bool(drift > MAX_DRIFT_INTERVALS * slope + of_rounding + of_jitter)


def _without_slips(table: EvenTable, *, clocked: bool) -> EvenTable:
    """Return the table without samples that repeat the one before, and with gaps in time where samples are missing.

    Uneven time stamps were written by a clock; they are used as they are, and only repeated samples are left out.
    """
    found = sampling.find_slips(_sampled_path(table.data), held=True)
    if not found:
        return table
    data = table.data
    t0, interval = data.t[0], float(np.median(np.diff(data.t)))
    ticks = sampling.frame_numbers(data.t).astype(np.int64)
    if clocked:
        found = tuple(replace(s, frames=0) for s in found if s.doubled)
    right, keep = sampling.correct_ticks(ticks, found)
    stay = np.setdiff1d(np.arange(len(ticks)), [s.frame for s in found if s.frames < 0])
    t = np.where(right == ticks, data.t, t0 + right * interval)
    taken = select_rows(replace(data, t=t), stay)
    return EvenTable(taken, keep[stay], table.numbers[stay], (*table.notes, *_slip_notes(found, table.numbers)))


def _sampled_path(data: TableData) -> sampling.SampledPath:
    """Return the positions of a table as a path; only identical positions can repeat each other."""
    x = np.asarray(data.x)
    own = x[np.concatenate(([True], np.diff(x) != 0))]
    digits = DOUBLE_RESOLUTION * float(np.max(np.abs(x)))
    noise = max(white_noise(own), sampling.rounding_noise(sampling.quantum(x)), digits)
    ticks = sampling.frame_numbers(data.t).astype(np.int64)
    every = np.ones(len(x), dtype=bool)
    return sampling.SampledPath(x, np.full(len(x), noise), ticks, every, MIN_JUMP_SIGMAS * noise, exact=True)


def _slip_notes(found: tuple[sampling.Slip, ...], numbers: Rows) -> tuple[str, ...]:
    """Return notes on repeated and missing samples."""
    again = [int(numbers[s.frame]) for s in found if s.doubled]
    lost = {int(numbers[s.frame]): s.frames for s in found if not s.doubled}
    notes = []
    if again:
        count = sampling.count_text(len(again), "sample repeats", "samples repeat")
        notes.append(f"{count} the one before: {sampling.describe_frames(again)}; left out")
    if lost:
        count = sampling.count_text(sum(lost.values()), "sample is", "samples are")
        places = sampling.describe_frames([*lost])
        notes.append(f"{count} missing, found from the motion: before {places}; left as gaps in time")
    return tuple(notes)


SMALLEST_STEP_S = np.finfo(float).tiny  # between time stamps that rise


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
    """Make a run of a table in SI units, and warn of values that are likely in another unit."""
    table = with_even_clock(data)
    displacement, forces = displacement_of_even_table(table), table.data
    check_settings(settings)
    given = {"drive": forces.drive, "friction_N": forces.friction, "has_incline": "incline" in settings, **settings}
    given["mass"] = mass
    run = Run(displacement, differentiate(low_pass(displacement)), **given)
    bare = frozenset() if isinstance(mass, str) else frozenset({"mass"})  # written without a unit
    entries = implausible_entries(EnteredValues(run.name, mass=run.mass, bare=bare))
    for finding in filter(None, (*entries, *implausible_slide(run, film=False), wrong_incline(run))):
        words = str(replace(finding, run=run.name)).replace(ACCEPTED, "ignore this warning")  # there is no study file
        warnings.warn(words, stacklevel=5)  # the caller of `Run.from_arrays`
    return run


MIN_SAME_SIGN = 0.9  # share of forces that have the sign that all are taken to have
MIN_POINTS = 5  # of a table of speeds and forces, in one study
MAX_SPEED = 300.0  # m/s; faster ones are in another unit


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
