"""Compute the displacement of sampled positions: even clock, jitter, doubled and missing samples."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from frictrack.calibration import parse_scale
from frictrack.motion import noise_level
from frictrack.records import Array, Displacement, Mask
from frictrack.sampling import (
    EvenClock,
    SampledPath,
    Slip,
    common_unevenness,
    correct_ticks,
    describe_frames,
    describe_length,
    find_slips,
    frame_numbers,
    is_even,
    jittered_clock,
    quantum,
    robust_speed,
    rounded_clock,
    rounding_noise,
    screened,
    unevenness,
)
from frictrack.study import TableData

if TYPE_CHECKING:
    from frictrack.recording import Stamps

Rows = NDArray[np.int64]
MIN_RATE_DIFFERENCE = 1e-3  # relative difference of two frame rates that is reported
DOUBLE_RESOLUTION = 8 * np.finfo(float).eps  # relative error of what a double holds
MIN_JUMP_SIGMAS = 10.0  # a smaller jump of a position, in its noise, is no missing sample
MAX_GAP_FRAMES = 1000
MIN_TRAVEL_M = 1e-15  # m: what moves by less does not move
MIN_ROWS = 16  # rows needed to find a fault of the clock
MIN_JITTER_SHARE = 0.1  # of the noise at rest; less adds half a percent to a standard deviation


@dataclass(frozen=True, eq=False)
class EvenTable:
    """A table whose rows lie on an even clock.

    Attributes
    ----------
    data
        The columns.
    valid
        Whether a row holds a sample of its own, (n,).
    numbers
        Number of each row in the file, from 0, (n,).
    notes
        What was corrected.

    """

    data: TableData
    valid: Mask
    numbers: Rows  # of each row in the file, counted from 0
    notes: tuple[str, ...] = ()


def displacement_of_table(
    data: TableData, *, fps: float | None = None, scale: str | None = None, x_offset: float = 0.0
) -> Displacement:
    """Compute the displacement of a table of positions.

    Missing columns are NaN, outliers are marked as invalid, and standard deviations that are not given are estimated.

    Parameters
    ----------
    data
        Columns in SI units, with `x`.
    fps
        Frame rate to be compared with the time stamps, Hz.
    scale
        Size of a pixel, if the positions come from a film, such as ``"0.5 mm/px"``.
    x_offset
        Shift of the positions, m.

    Returns
    -------
    Displacement
        Its `notes` say what was corrected.

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
    assert data.x is not None
    nan = np.full(len(data.t), np.nan)
    nan.setflags(write=False)  # so that the records share it
    pitch, relative = parse_scale(scale) if scale is not None else (None, 0.0)
    displacement = screened(
        Displacement(
            t=data.t,
            x=data.x + x_offset,
            y=nan if data.y is None or not np.any(data.y) else data.y,  # a column of zeros was not measured
            angle=nan,
            sigma_x=nan if data.sigma is None else data.sigma,
            sigma_y=nan,
            valid=table.valid,
            pixel_pitch=pitch,
            relative_scale_error=relative,
            notes=(*data.notes, *table.notes),
        ),
        table.numbers,
    )
    displacement = _with_jitter_noise(displacement)
    return (
        replace(displacement, sigma_x=_table_sigma(displacement))
        if np.all(np.isnan(displacement.sigma_x))
        else displacement
    )


def _with_jitter_noise(displacement: Displacement) -> Displacement:
    """Return a displacement with larger standard deviations if its samples jitter although the time stamps are even."""
    if len(displacement) < MIN_ROWS or not is_even(displacement.t):
        return displacement
    interval = float(np.median(np.diff(displacement.t)))
    jitter, at_rest_noise = unevenness(displacement.t, displacement.x, _max_resolved_speed(displacement))
    if not jitter:
        return displacement
    stated = np.isfinite(displacement.sigma_x)
    at_rest = np.where(stated, displacement.sigma_x, max(at_rest_noise, rounding_noise(displacement.resolution)))
    moved = jitter * np.abs(robust_speed(displacement.t, displacement.x))
    if np.max(moved) < MIN_JITTER_SHARE * np.median(at_rest):
        return displacement
    note = (
        f"the noise grows with the speed, up to {describe_length(float(np.max(moved)))}, as if samples jittered by "
        f"{100 * jitter / interval:.2g} % of the interval of {interval:.6g} s (rms) although their time stamps are "
        "even; deviations grow with it"
    )
    return replace(displacement, sigma_x=np.hypot(at_rest, moved), notes=(*displacement.notes, note))


def jitter_notes(displacements: Sequence[Displacement]) -> tuple[str, ...]:
    """Return a note if all tables together show jitter of the samples; a run at nearly one speed cannot show it."""
    even = [d for d in displacements if len(d) >= MIN_ROWS and is_even(d.t)]
    jitter = common_unevenness([(d.t, d.x, _max_resolved_speed(d)) for d in even])
    if not jitter:
        return ()
    share = 100 * jitter / float(np.median([np.median(np.diff(d.t)) for d in even]))
    return (
        f"the noise of the runs grows with their speed, as if samples jittered by {share:.2g} % of the interval (rms) "
        "although their time stamps are even, or the picture were blurred",
    )


def _max_resolved_speed(displacement: Displacement) -> float:
    """Return the speed of half a pixel or half a step per sample, m/s; rounding errors grow with the speed below it."""
    return (
        0.5 * max(displacement.pixel_pitch or 0.0, displacement.resolution) / float(np.median(np.diff(displacement.t)))
    )


def _table_sigma(displacement: Displacement) -> Array:
    """Return the white noise (n,) of a table without standard deviations; at least that of rounding."""
    x = displacement.x
    steps, nothing = np.abs(np.diff(x)), 1e-12 * float(np.max(np.abs(x)))  # as the digits of a double add up
    rounding = float(np.min(steps[steps > nothing], initial=np.inf)) / np.sqrt(12.0)
    sigma = max(float(noise_level(x, displacement.valid)[0]), rounding_noise(displacement.resolution))
    return np.full(len(x), sigma if sigma > nothing else rounding)


def with_even_clock(data: TableData, fps: float | None = None) -> EvenTable:
    """Return the rows of a table on an even clock; a table without faults is not changed.

    Parameters
    ----------
    data
        The table, as read.
    fps
        Frame rate of the study file, Hz, to be compared with the time stamps.

    """
    n = len(data.t)
    rows = np.arange(n)
    if data.x is None or n < MIN_ROWS:
        return EvenTable(data, np.ones(n, dtype=bool), rows)
    clocked = not is_even(data.t)
    data, rows, notes = _with_clock_of_stamps(data) if clocked else (data, rows, ())
    notes += _rate_note(data.t, fps)
    if not _can_find_slips(data):  # the smoother reports what is wrong
        return EvenTable(data, np.ones(len(rows), dtype=bool), rows, notes)
    return _without_slips(EvenTable(data, np.ones(len(rows), dtype=bool), rows, notes), clocked=clocked)


def _can_find_slips(data: TableData) -> bool:
    """Return whether the rows lie on an even clock without long gaps, and the target moves."""
    assert data.x is not None
    gaps = np.diff(data.t) / float(np.median(np.diff(data.t)))
    return is_even(data.t) and float(np.max(gaps)) < MAX_GAP_FRAMES and float(np.ptp(data.x)) > MIN_TRAVEL_M


def _with_clock_of_stamps(data: TableData) -> tuple[TableData, Rows, tuple[str, ...]]:
    """Return a table with uneven time stamps on an even clock, its row numbers, and notes."""
    from frictrack.recording import read_stamps  # noqa: PLC0415 - loads OpenCV; even tables do without

    rows = np.arange(len(data.t))
    rounded = rounded_clock(data.t)
    if rounded is not None:
        return _at_clock(data, rounded), rows, rounded.notes
    read = read_stamps(data.t)
    if read is None:
        return data, rows, ()
    rows = np.setdiff1d(rows, read.doubled)
    ticks = _fill_corrupt_ticks(read.ticks)[rows]
    right = data.t[0] + (ticks - ticks[0]) * read.step
    stamps = np.where(np.isin(rows, read.corrupt), right, data.t[rows])
    taken = replace(_select_rows(data, rows), t=stamps)
    if np.any(np.diff(ticks) <= 0) or np.any(np.diff(stamps) <= 0):
        return data, np.arange(len(data.t)), ()
    moved, notes = _without_jitter(taken, ticks)
    return moved, rows, (*_stamp_notes(read), *notes)


def _without_jitter(data: TableData, ticks: Rows) -> tuple[TableData, tuple[str, ...]]:
    """Return a table whose rows are `ticks` intervals after the first one on an even clock, and notes."""
    assert data.x is not None
    if is_even(data.t):
        return data, ()
    clock = jittered_clock(data.t, ticks, data.x)
    return (data, ()) if clock is None else (_at_clock(data, clock), clock.notes)


def _stamp_notes(read: Stamps) -> tuple[str, ...]:
    """Return notes on repeated and wrong time stamps."""
    notes: tuple[str, ...] = ()
    if len(read.doubled):
        notes += (
            f"{_count(len(read.doubled))} the time stamp of the row before: {describe_frames(read.doubled)}; left out",
        )
    if len(read.corrupt):
        notes += (f"the time stamp is wrong in {describe_frames(read.corrupt)}; the row stays in its place",)
    return notes


def _count(n: int) -> str:
    return "1 row has" if n == 1 else f"{n} rows have"


def _fill_corrupt_ticks(ticks: Rows) -> Rows:
    """Return frame numbers, with those of corrupt stamps (-1) interpolated."""
    known = ticks >= 0
    return np.rint(np.interp(np.arange(len(ticks)), np.flatnonzero(known), ticks[known])).astype(np.int64)


def _at_clock(data: TableData, clock: EvenClock) -> TableData:
    """Return a table at the times of a clock; positions are shifted by the delay of their samples."""
    moved: dict[str, Any] = {
        name: column - robust_speed(data.t, column) * clock.late if np.any(clock.late) else column
        for name, column in (("x", data.x), ("y", data.y))
        if column is not None
    }
    return replace(data, t=clock.t, **moved)


def _select_rows(data: TableData, rows: Rows) -> TableData:
    """Return some rows of a table."""
    columns = {f.name: getattr(data, f.name) for f in fields(data)}
    taken: dict[str, Any] = {n: column[rows] for n, column in columns.items() if isinstance(column, np.ndarray)}
    return replace(data, **taken)


def _rate_note(t: Array, fps: float | None) -> tuple[str, ...]:
    """Return a note if the given frame rate and that of the time stamps differ."""
    rate = 1.0 / float(np.median(np.diff(t)))
    if fps is None or abs(rate / fps - 1) <= MIN_RATE_DIFFERENCE:
        return ()
    return (f"the time stamps say {rate:.6g} Hz but fps = {fps:.6g} is given; the time stamps are used",)


def _without_slips(table: EvenTable, *, clocked: bool) -> EvenTable:
    """Return the table without samples that repeat the one before, and with gaps in time where samples are missing.

    Uneven time stamps were written by a clock; they are used as they are, and only repeated samples are left out.
    """
    found = find_slips(_sampled_path(table.data), held=True)
    if not found:
        return table
    data = table.data
    t0, interval = data.t[0], float(np.median(np.diff(data.t)))
    ticks = frame_numbers(data.t).astype(np.int64)
    if clocked:
        found = tuple(replace(s, frames=0) for s in found if s.doubled)
    right, keep = correct_ticks(ticks, found)
    stay = np.setdiff1d(np.arange(len(ticks)), [s.frame for s in found if s.frames < 0])
    t = np.where(right == ticks, data.t, t0 + right * interval)
    taken = _select_rows(replace(data, t=t), stay)
    return EvenTable(taken, keep[stay], table.numbers[stay], (*table.notes, *_slip_notes(found, table.numbers)))


def _sampled_path(data: TableData) -> SampledPath:
    """Return the positions of a table as a path; only identical positions can repeat each other."""
    assert data.x is not None
    x = data.x
    own = x[np.concatenate(([True], np.diff(x) != 0))]
    noise = float(np.nan_to_num(noise_level(own, np.ones(len(own), dtype=bool))[0]))
    noise = max(noise, rounding_noise(quantum(x)), DOUBLE_RESOLUTION * float(np.max(np.abs(x))))
    ticks = frame_numbers(data.t).astype(np.int64)
    return SampledPath(
        x, np.full(len(x), noise), ticks, np.ones(len(x), dtype=bool), MIN_JUMP_SIGMAS * noise, exact=True
    )


def _slip_notes(found: tuple[Slip, ...], numbers: Rows) -> tuple[str, ...]:
    """Return notes on repeated and missing samples."""
    again = [int(numbers[s.frame]) for s in found if s.doubled]
    lost = [s for s in found if not s.doubled]
    notes = []
    if again:
        count = "1 sample repeats" if len(again) == 1 else f"{len(again)} samples repeat"
        notes.append(f"{count} the one before: {describe_frames(again)}; left out")
    if lost:
        total = sum(s.frames for s in lost)
        count = "1 sample is" if total == 1 else f"{total} samples are"
        places = describe_frames([int(numbers[s.frame]) for s in lost])
        notes.append(f"{count} missing, found from the motion: before {places}; left as gaps in time")
    return tuple(notes)
