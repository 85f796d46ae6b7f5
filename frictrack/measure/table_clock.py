"""Bring the rows of a table to an even clock: stamps that jitter or are rounded, doubled, missing and lost rows."""

from __future__ import annotations

from dataclasses import fields, replace
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from frictrack import sampling
from frictrack.base.distributions import noise_of_differences, robust_std
from frictrack.base.errors import FrictrackError
from frictrack.measure.plausibility import CONTRADICTION, MAX_RELATIVE_DIFFERENCE, time_unit
from frictrack.records import Array, Mask
from frictrack.sampling import white_noise
from frictrack.study import TableData

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
BENT_ENDS = 4  # of smoothed positions, in independent rows
MAX_DOUBLED_SHARE = 0.1  # of rows that were written twice; more equal stamps are rounded
FPS_REMEDY = "the frame rate as fps in [camera], if no rows are missing, or "
MAX_DRIFT_INTERVALS, DRIFT_PARTS = 0.5, 8  # of stamps about counted rows, in means of so many parts
NEAR_SHARE = 0.5  # of the usual interval, below which a row is at nearly the time of the one before
MIN_ROWS = 16  # rows needed to find a fault of the clock
MIN_JITTER_SHARE = 0.1  # of the noise at rest; less adds half a percent to a standard deviation


def with_even_clock(data: TableData, fps: float | None = None) -> TableData:
    """Return the rows of a table, unwrapped, on an even clock; where time stamps contradict `fps` (Hz), it decides.

    A table that has the `numbers` of its rows already is on an even clock.
    """
    if len(data.numbers):
        return data
    n = len(data.t)
    data = replace(data, numbers=np.arange(n), valid=np.ones(n, dtype=bool))
    if data.x is None:
        return data
    while (unmeasured := _unmeasured(data, np.asarray(data.x))) is not None:
        lost, note = unmeasured
        data = _noted(select_rows(data, np.flatnonzero(~lost)), note)
    x, turned = sampling.unwrapped(np.asarray(data.x))
    data = _noted(replace(data, x=x), *turned)
    if len(data.t) < MIN_ROWS and not (fps and not sampling.is_even(data.t)):
        return data
    if (rounding := _rounding(data)) and (table := _with_rounded_clock(data, rounding, fps)) is not None:
        return table
    clocked = not sampling.is_even(data.t) or _stamps_add_noise(data)
    table = _with_clock_of_stamps(data) if clocked and len(data.t) >= MIN_ROWS else data
    moved = np.any((np.diff(x) != 0) & ~np.isin(data.numbers, table.numbers)[1:])  # rows that are left out for stamps
    if fps and (moved or not sampling.is_even(table.t)):
        words = f"the time stamps are uneven: each row has the nearest time that fps = {fps:.6g} has"
        table, clocked = _noted(_counted_at_rate(data, fps), words), False
    table = _without_near_rows(table)
    if repeated := int(np.sum(np.diff(table.t) <= 0)):
        raise FrictrackError(
            f"time: {repeated} stamps repeat the one before, which rounding of an even clock does not explain: "
            "the rate changes or rows are missing; give stamps with more digits"
        )
    table = _on_grid(_at_rate(table, fps))
    return _without_slips(table, clocked=clocked) if _can_find_slips(table) else table  # else the smoother reports


def _noted(data: TableData, *notes: str) -> TableData:
    """Return a table with further notes."""
    return replace(data, notes=(*data.notes, *notes))


def _unmeasured(data: TableData, x: Array) -> tuple[Mask, str] | None:
    """Return which rows (n,) hold no measured position, and what is said of them."""
    if np.any(lost := sampling.placeholders(x)):
        count = sampling.count_text(int(np.sum(lost)), "row holds", "rows hold")
        return lost, f"{count} {x[lost][0]:.6g} instead of a position: left out"
    even = sampling.is_even(data.t) and not np.any(sampling.unusual_steps(data.t))
    if not even or data.of_speeds or data.friction is not None:  # which is measured in every row
        return None
    if np.any(lost := sampling.interpolated(x)):
        every, words, done = round(len(x) / np.sum(~lost)), "lie on straight lines", "interpolated"
    elif (every := sampling.independent_step(x)) > 1:
        rows, words, done = np.arange(len(x)), "hold no noise", "smoothed or interpolated"
        lost = (rows % every > 0) | (np.minimum(rows, rows[::-1]) < BENT_ENDS * every)  # smoothing bends the ends
    else:
        return None
    return lost, (
        f"the positions {words} between every {every} rows: another program {done} them; the rows between are left "
        "out; give the positions as they were measured"
    )


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


def _with_rounded_clock(data: TableData, rounding: float, fps: float | None) -> TableData | None:
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
        table = replace(_without_doubled(data, rows), t=ticks[rows].astype(float))
        table = _without_slips(table, clocked=False) if _can_find_slips(table) else table
        stayed, counted = np.flatnonzero(np.isin(data.numbers, table.numbers)), np.rint(table.t).astype(np.int64)
        stamps = data.t[stayed]
        if _is_miscounted(stamps, counted, rounding):
            continue
        clock = sampling.rounded_clock(stamps, counted, rounding, interval)
        clock = clock or sampling.jittered_clock(stamps, counted, np.asarray(data.x)[stayed], rounding)
        if clock is not None:
            clocked = replace(_at_clock(select_rows(data, stayed), clock), valid=table.valid)
            return _at_rate(_noted(clocked, *table.notes[len(data.notes) :]), fps, rounding)
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


def _with_clock_of_stamps(data: TableData) -> TableData:
    """Return a table with uneven time stamps on an even clock, where these show one."""
    from frictrack.recording import read_stamps  # noqa: PLC0415 - loads OpenCV; even tables do without

    read = read_stamps(data.t)
    if read is None or np.any(data.t[read.doubled] - data.t[read.doubled - 1] > MIN_JITTER_SHARE * read.step):
        return data  # rows of their own, at uneven times
    rows, known = np.setdiff1d(np.arange(len(data.t)), read.doubled), read.ticks >= 0
    counted = np.interp(rows, np.flatnonzero(known), read.ticks[known])  # also of corrupt stamps
    ticks = np.rint(counted).astype(np.int64)
    right = data.t[0] + (ticks - ticks[0]) * read.step
    stamps = np.where(np.isin(rows, read.corrupt), right, data.t[rows])
    if np.any(np.diff(ticks) <= 0) or np.any(np.diff(stamps) <= 0):
        return data
    table = replace(_without_doubled(data, rows), t=stamps)
    if len(read.corrupt):
        frames = sampling.describe_frames(read.corrupt)
        table = _noted(table, f"the time stamp is wrong in {frames}; the row stays in its place")
    good = sampling.is_even(stamps) and not _stamps_add_noise(table)
    clock = None if good else sampling.jittered_clock(stamps, ticks, np.asarray(table.x))
    return table if clock is None else _at_clock(table, clock)


def _without_doubled(data: TableData, rows: Rows) -> TableData:
    """Return some rows of a table, with a note on the others, which have the time stamp of the row before."""
    lost = np.setdiff1d(np.arange(len(data.t)), rows)
    count, table = sampling.count_text(len(lost), "row has", "rows have"), select_rows(data, rows)
    note = f"{count} the time stamp of the row before: {sampling.describe_frames(lost)}; left out"
    return _noted(table, note) if len(lost) else table


def _at_clock(data: TableData, clock: sampling.EvenClock) -> TableData:
    """Return a table at the times of a clock; positions are shifted by the delay of their samples."""
    moved: dict[str, Any] = {
        name: column - sampling.robust_speed(data.t, column) * clock.late if np.any(clock.late) else column
        for name, column in (("x", data.x), ("y", data.y))
        if column is not None
    }
    return _noted(replace(data, t=clock.t, clock_error=clock.error, **moved), *clock.notes)


def _without_near_rows(data: TableData) -> TableData:
    """Return the rows of an uneven clock that are not at nearly the time of the one before."""
    steps, usual = np.diff(data.t), float(np.median(np.diff(data.t)))
    even = sampling.is_even(data.t) or np.min(steps) > sampling.MIN_SHORTEST * usual
    if even or np.mean(steps <= 0) > MAX_DOUBLED_SHARE:
        return data
    stay = [0]
    for i, one in enumerate(data.t.tolist()):
        if one - data.t[stay[-1]] > NEAR_SHARE * usual:
            stay.append(i)
    note = f"{len(data.t) - len(stay)} of {len(data.t)} rows come at nearly the time of the row before: left out"
    return _noted(select_rows(data, np.array(stay)), note)


def _on_grid(data: TableData) -> TableData:
    """Return a table with uneven times at the nearest times of an even grid."""
    columns = {name: column for name in MEASURED_COLUMNS if (column := getattr(data, name)) is not None}
    moved = None if sampling.is_even(data.t) else sampling.moved_to_grid(data.t, list(columns.values()))
    if moved is None:
        return data
    found: dict[str, Any] = dict(zip(columns, moved[1], strict=True))
    note = "the times are uneven; the columns are moved along their course to the nearest times of an even grid"
    return _noted(replace(data, t=moved[0], **found), note)


def select_rows(data: TableData, rows: Rows) -> TableData:
    """Return some rows of a table."""
    columns = {f.name: getattr(data, f.name) for f in fields(data)}
    taken: dict[str, Any] = {n: q[rows] for n, q in columns.items() if isinstance(q, np.ndarray) and len(q)}
    return replace(data, **taken)


def _at_rate(data: TableData, fps: float | None, rounding: float = 0.0) -> TableData:
    """Return a table with the given frame rate, and a note if its stamps contradict it."""
    if fps is None:
        return data
    span = float(data.t[-1] - data.t[0])
    frames = (data.t - data.t[0]) / float(np.median(np.diff(data.t)))
    frames = sampling.frame_numbers(data.t) if sampling.is_even(data.t) else frames
    rate = float(frames[-1]) / span
    note = f"the time stamps say {rate:.6g} Hz but fps = {fps:.6g} is given; fps is used"
    differs = abs(rate / fps - 1) - rounding / span
    if time_unit(fps / rate):  # the times are in another unit; the check of the clocks says which
        return data
    if differs > MAX_RELATIVE_DIFFERENCE:
        note, data = f"{note}; {CONTRADICTION}", replace(data, stamped_rate=rate)
    notes = [note] if differs > MIN_RATE_DIFFERENCE else []
    return _noted(replace(data, t=data.t[0] + frames / fps, clock_error=0.0), *notes)


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


def _without_slips(data: TableData, *, clocked: bool) -> TableData:
    """Return the table without samples that repeat the one before, and with gaps in time where samples are missing.

    Uneven time stamps were written by a clock; they are used as they are, and only repeated samples are left out.
    """
    x, ticks = np.asarray(data.x), sampling.frame_numbers(data.t).astype(np.int64)
    own = x[np.concatenate(([True], np.diff(x) != 0))]  # only identical positions can repeat each other
    digits = DOUBLE_RESOLUTION * float(np.max(np.abs(x)))
    noise = max(white_noise(own), sampling.rounding_noise(sampling.quantum(x)), digits)
    sigma, every = np.full(len(x), noise), np.ones(len(x), dtype=bool)
    found = sampling.find_slips(
        sampling.SampledPath(x, sigma, ticks, every, MIN_JUMP_SIGMAS * noise, exact=True), held=True
    )
    if not found:
        return data
    again = [int(data.numbers[s.frame]) for s in found if s.doubled]
    lost = {int(data.numbers[s.frame]): s.frames for s in found if not s.doubled and not clocked}
    if again:
        count = sampling.count_text(len(again), "sample repeats", "samples repeat")
        data = _noted(data, f"{count} the one before: {sampling.describe_frames(again)}; left out")
    if lost:
        count, places = sampling.count_text(sum(lost.values()), "sample is", "samples are"), [*lost]
        words = f"missing, found from the motion: before {sampling.describe_frames(places)}; left as gaps in time"
        data = _noted(data, f"{count} {words}")
    if clocked:
        found = tuple(replace(s, frames=0) for s in found if s.doubled)
    right, keep = sampling.correct_ticks(ticks, found)
    stay = np.setdiff1d(np.arange(len(ticks)), [s.frame for s in found if s.frames < 0])
    t = np.where(right == ticks, data.t, data.t[0] + right * float(np.median(np.diff(data.t))))
    return select_rows(replace(data, t=t, valid=data.valid & keep), stay)
