"""Audit the time base of a recording before derivatives are taken.

Friction is proportional to the square of the frame rate. The rates of user, header and time stamps are compared, and
missing, repeated and corrupt stamps are found. Where the stamps allow it, times are whole frame intervals of one rate:
a missing frame becomes a gap, and a corrupt stamp is ignored.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from frictrack.base.errors import FrictrackError
from frictrack.sampling import count_intervals, count_text, describe_frames, rounded_clock, stamp_rounding


@dataclass(frozen=True)
class Header:
    """Facts about a recording before any frame is used.

    Attributes
    ----------
    n_frames : int
        Number of frames in the file.
    shape : tuple of int
        Height and width, px.
    bit_depth : int
        Bits of a grey value.
    fps : float or None
        Frame rate in the file, 1/s.
    ticks : array of int (n_frames,) or None
        Frame intervals since the first frame; gaps are kept. None for 0, 1, 2, ...
    notes : tuple of str
        Findings about the file.
    stamps : array (n_frames,) or None
        Time stamp of each frame, s; NaN where there is none.
    exposure : float or None
        Exposure time, s.
    trigger : int or None
        Number of the frame at the trigger, counted from the first of the film; it may lie outside.
    camera : bool
        Whether rate and stamps are those of the camera; those of a container may be for playback.

    """

    n_frames: int
    shape: tuple[int, int]
    bit_depth: int
    fps: float | None = None
    ticks: NDArray[np.int64] | None = None
    notes: tuple[str, ...] = ()
    stamps: NDArray[np.float64] | None = None
    exposure: float | None = None
    trigger: int | None = None
    camera: bool = False


PLAYBACK_FPS = 60.0  # a container that says no more than this gives the speed of showing, not of filming
MAX_RATE_DIFFERENCE = 1e-3  # relative difference of two frame rates that is said: 0.2 % of friction
MIN_ROUNDING, MAX_ROUNDING = 0.05, 0.8  # of a frame interval, between which the rounding of stamps decides their count
SHORT_INTERVAL, MIN_SHORT_SHARE = 0.6, 0.05  # of the median interval, and of all: more show that the rate changes
MAX_AVERAGE_DIFFERENCE = 0.05  # relative difference of a stated rate from the average of one that changes
MIN_CHANGING_SHARE = 0.1  # of intervals that are longer: the rate changes, and no frames are missing
MAX_UNEVENNESS = 0.1  # rms deviation of stamps from whole frames, in frames, above which they are the times themselves
_MAX_GAP_FRAMES = 10_000  # frames; nothing is believed to be missing for longer
_MIN_AGREEING_STAMPS = 3  # stamps in a row that agree with each other, not with those before: the clock was set

Array = NDArray[np.float64]
Ticks = NDArray[np.int64]


class AuditRow(NamedTuple):
    """One line of the audit: the quantity, its value, and the verdict."""

    name: str
    value: str
    verdict: str


@dataclass(frozen=True, eq=False)
class Timebase:
    """Frame rate and times that are used, with the audit.

    Attributes
    ----------
    fps : float
        Frame rate, 1/s.
    t : array (n_kept,)
        Times from the first frame, s.
    rows : tuple of AuditRow
        The audit as a table.
    notes : tuple of str
        The audit as sentences.
    kept : array of int or None
        Numbers of the frames of the file that are kept; None for all.
    uneven : bool
        Whether the times are the stamps themselves, not whole intervals.

    """

    fps: float
    t: Array
    rows: tuple[AuditRow, ...] = ()
    notes: tuple[str, ...] = ()
    kept: Ticks | None = None
    uneven: bool = False


@dataclass(frozen=True, eq=False)
class Stamps:
    """Time stamps as frame numbers.

    Attributes
    ----------
    ticks : array of int (n,)
        Frame intervals since the first frame; -1 where the stamp is corrupt.
    step : float
        Frame interval, s.
    corrupt, doubled, gaps : array of int
        Frames with a corrupt stamp, frames that repeat the stamp before, and frames before which others are missing.
    uneven : bool
        Whether the frames deviate from the even grid by more than rounding.

    """

    ticks: Ticks
    step: float  # s between frames
    corrupt: Ticks
    doubled: Ticks
    gaps: Ticks  # frames before which others are missing
    uneven: bool = False

    @property
    def changing(self) -> bool:
        """Whether many intervals are longer than others: the frame rate changes."""
        return len(self.gaps) > MIN_CHANGING_SHARE * len(self.ticks)


def audit(name: str, given: float | None, header: Header) -> Timebase:
    """Audit the time base of a recording."""
    stamps, n = header.stamps, header.n_frames
    parsed = read_stamps(stamps) if stamps is not None and header.ticks is None else None
    stamped = 1 / parsed.step if parsed is not None else None
    stated, fps = header, None
    if parsed is not None and (parsed.changing or parsed.uneven) and stamps is not None:
        average = (len(stamps) - 1) / float(np.nanmax(stamps) - np.nanmin(stamps))
        agree = [rate and abs(rate / average - 1) < MAX_AVERAGE_DIFFERENCE for rate in (given, header.fps)]
        given, fps = (None, stamped) if agree[0] else (given, None)
        stated = replace(header, fps=None) if agree[1] else header
    fps = fps or _true_rate(name, given, header, stamped)
    found = [*_rates(fps, given, stated, stamped), *_stamp_findings(parsed, stamps)]
    found += _exposure_findings(header.exposure, fps)
    rows, notes = tuple(row for row, _ in found), tuple(note for _, note in found if note)
    if parsed is None:
        return Timebase(fps, (np.arange(n) if header.ticks is None else header.ticks) / fps, rows, notes)
    kept = np.setdiff1d(np.arange(n), parsed.doubled)
    t = _times(parsed, stamps, fps)[kept]
    return Timebase(fps, t - t[0], rows, notes, kept if len(kept) < n else None, parsed.uneven)


def read_stamps(stamps: Array) -> Stamps | None:
    """Convert time stamps to frame numbers.

    Parameters
    ----------
    stamps : array (n,)
        Time stamps, s; NaN where there is none.

    Returns
    -------
    Stamps or None
        None where the stamps are too few or too coarse.

    Examples
    --------
    >>> read_stamps(np.array([0.0, 0.001, 0.002, 0.004, 0.005])).ticks.tolist()
    [0, 1, 2, 4, 5]

    """
    good = np.flatnonzero(np.isfinite(stamps))
    steps = np.diff(stamps[good])
    forward = steps[steps > 0]
    if len(good) < 3 or len(forward) < max(2, 0.8 * len(steps)):
        return None
    usual = step = _usual_interval(forward)
    complete = len(good) == len(stamps) and np.ptp(stamps) > 0
    ticks = _count_rounded(stamps, step) if complete and np.all(steps >= 0) else None
    is_rounded = ticks is not None
    if ticks is None:
        consecutive = np.all(np.abs(np.diff(stamps) / step - 1) < 0.5)  # as in nearly all films
        ticks = np.arange(len(stamps)) if consecutive else _count_ticks(stamps, step)
    written_twice = _written_twice(ticks)
    ticks[written_twice] += 1
    known = np.flatnonzero(ticks >= 0)
    if len(known) < max(3, len(stamps) // 2):
        return None
    reliable = np.setdiff1d(known, written_twice)
    step = _fit_interval(ticks[reliable], stamps[reliable], step)
    jumps = np.diff(ticks[known])
    found = Stamps(
        ticks,
        step,
        corrupt=np.union1d(np.flatnonzero(ticks < 0), written_twice),
        doubled=known[1:][jumps == 0],
        gaps=known[1:][jumps > np.diff(known)],
        uneven=_uneven(ticks[reliable], stamps[reliable], step),
    )
    if is_rounded or not complete or np.any(steps <= 0) or not (found.uneven or found.changing):
        return found
    none = np.zeros(0, np.int64)  # no even grid: stamps that rise are the times
    return replace(found, step=usual, corrupt=none, doubled=none, uneven=True)


def _usual_interval(forward: Array) -> float:
    """Median interval, s; of the short ones where the rate changes: long ones are then whole multiples, or uneven."""
    usual = float(np.sort(forward)[(len(forward) - 1) // 2])
    short = forward[forward < SHORT_INTERVAL * usual]
    return float(np.sort(short)[len(short) // 2]) if len(short) > MIN_SHORT_SHARE * len(forward) else usual


def _count_rounded(stamps: Array, step: float) -> Ticks | None:
    """Frame intervals of rounded stamps; None where rounding is small, is no less than an interval, or is not all."""
    rounding = stamp_rounding(stamps)
    if not MIN_ROUNDING * step < rounding < MAX_ROUNDING * float(np.ptp(stamps)) / len(stamps):
        return None
    ticks = count_intervals(stamps, rounding)
    twice = np.any((np.diff(ticks) == 0) & (np.diff(stamps) > 0))  # the same moment would have the same stamp
    return None if twice or rounded_clock(stamps, ticks, rounding) is None else ticks


def _written_twice(ticks: Ticks) -> Ticks:
    """Frames with the stamp of the one before while the next is two intervals on: only the stamp is wrong."""
    steps = np.diff(ticks)
    twice = (steps[:-1] == 0) & (steps[1:] == 2) & (ticks[:-2] >= 0)
    return np.flatnonzero(twice) + 1


def _uneven(ticks: Ticks, stamps: Array, step: float) -> bool:
    """Whether the frames deviate from the even grid by more than rounding; false for a clock that was reset."""
    steps = np.diff(stamps)
    if np.any((steps < -0.5 * step) | (steps > _MAX_GAP_FRAMES * step)):
        return False
    off = stamps - stamps[0] - (ticks - ticks[0]) * step
    return float(np.std(off)) > MAX_UNEVENNESS * step


def _count_ticks(stamps: Array, step: float) -> Ticks:
    """Frame intervals since the first good stamp; -1 where a stamp is corrupt; a clock that was reset is continued."""
    ticks = np.full(len(stamps), -1, np.int64)
    follows = np.abs(np.diff(stamps) / step - 1) < 0.5  # by one interval
    last = int(np.argmax(follows))  # the first stamp that the next one confirms
    ticks[last] = last
    disagreeing: list[int] = []
    for i in range(last + 1, len(stamps)):
        passed = (stamps[i] - stamps[last]) / step
        if _is_credible(passed, i, last, stamps, step):
            ticks[i] = ticks[last] + max(round(passed), 0)
            last, disagreeing = i, []
            continue
        goes_on = disagreeing and 0.5 < (stamps[i] - stamps[disagreeing[-1]]) / step < 1.5
        disagreeing = [*disagreeing, i] if goes_on else [i]
        if len(disagreeing) == _MIN_AGREEING_STAMPS:
            for place in disagreeing:
                ticks[place] = ticks[last] + place - last
            last, disagreeing = i, []
    return ticks - ticks[ticks >= 0].min(initial=0) * (ticks >= 0)


def _is_credible(passed: float, i: int, last: int, stamps: Array, step: float) -> bool:
    """Whether stamp `i` can be right, `passed` frame intervals after the last right one."""
    if not -0.5 < passed < _MAX_GAP_FRAMES:  # NaN too
        return False
    if passed < i - last + 0.5:
        return True
    # A gap: the next stamp must go on from it, or a single stamp is wrong.
    after = stamps[i + 1 : i + 2]
    return bool(np.all((after - stamps[i]) / step > -0.5)) and (len(after) > 0 or passed < i - last + 10)


def _fit_interval(ticks: Ticks, stamps: Array, step: float) -> float:
    """Seconds per frame by a line through the stamps, without outliers."""
    use = np.ones(len(ticks), dtype=bool)
    for _ in range(3):
        slope, start = np.polyfit(ticks[use] - ticks[0], stamps[use] - stamps[0], 1)
        off = np.abs(stamps - stamps[0] - start - slope * (ticks - ticks[0]))
        use = off <= max(0.5 * step, 5 * float(np.median(off)))
    return float(slope) if 0.5 * step < slope < 2 * step else step


def _times(parsed: Stamps, stamps: Array | None, fps: float) -> Array:
    """Times (n,) s: whole intervals, or the stamps themselves where they are uneven; corrupt ones are interpolated."""
    n = np.arange(len(parsed.ticks))
    known = parsed.ticks >= 0
    ticks = np.interp(n, n[known], parsed.ticks[known])
    ends = np.flatnonzero(known)[[0, -1]]
    ticks[: ends[0]] -= (ends[0] - n)[: ends[0]]  # before the first and after the last: one interval each
    ticks[ends[1] + 1 :] += (n - ends[1])[ends[1] + 1 :]
    if not parsed.uneven or stamps is None or len(parsed.corrupt):
        return ticks / fps
    return (stamps - stamps[0]) / parsed.step / fps


def _true_rate(name: str, given: float | None, header: Header, stamped: float | None) -> float:
    """Frame rate of the camera: from the user, else from its stamps, else from a credible header."""
    if given is not None:
        if not (np.isfinite(given) and given > 0):
            raise FrictrackError(f"{name}: expected a frame rate above 0 fps but got {given:g} fps")
        return float(given)
    min_rate = 0.0 if header.camera else PLAYBACK_FPS
    agree = header.fps and stamped and abs(header.fps / stamped - 1) <= MAX_RATE_DIFFERENCE
    for rate in (header.fps, stamped) if agree else (stamped, header.fps):
        if rate is not None and np.isfinite(rate) and rate > min_rate:
            return float(rate)
    description = (
        f"says {header.fps:.4g} fps, which is the speed of showing it" if header.fps else "names no frame rate"
    )
    raise FrictrackError(
        f"{name}: expected the camera's frame rate but the file {description}; give the true rate as fps "
        "(friction goes with its square)"
    )


def _rates(fps: float, given: float | None, header: Header, stamped: float | None) -> Iterator[tuple[AuditRow, str]]:
    """Yield rows on the frame rates, each with its note."""
    used = "given" if given is not None else "stamps" if stamped == fps else "header"
    for source, rate in (("given", given), ("header", header.fps), ("stamps", stamped)):
        if rate is None or not np.isfinite(rate):
            continue
        differs = abs(rate / fps - 1) > MAX_RATE_DIFFERENCE
        shown = not header.camera and differs and rate <= PLAYBACK_FPS
        verdict = "used" if source == used else "speed of showing" if shown else "disagrees" if differs else "agrees"
        note = (
            f"the frame rate of the {_SOURCE_NAMES[source]} is {rate:.6g} fps but that {_SOURCE_PHRASES[used]} is "
            f"{fps:.6g} fps; {fps:.6g} fps is used"
        )
        yield AuditRow(f"frame rate, {source}", f"{rate:.6g} fps", verdict), note * (verdict == "disagrees")


_SOURCE_NAMES = {"header": "file's header", "stamps": "time stamps", "given": "user"}
_SOURCE_PHRASES = {"header": "of the file's header", "stamps": "of the time stamps", "given": "given by the user"}


_FAULTS = {"missing": "missing before", "doubled": "the time of the one before:", "corrupt": "corrupt:"}


def _stamp_findings(parsed: Stamps | None, stamps: Array | None) -> Iterator[tuple[AuditRow, str]]:
    """Yield rows on the time stamps, each with its note."""
    if stamps is None:
        return
    if parsed is None:
        note = "the time stamps are too few or too coarse: not used, frames are taken as evenly spaced"
        yield AuditRow("time stamps", f"{len(stamps)}", "too few or too coarse: not used"), note
        return
    missing = max(int(parsed.ticks.max()) + 1 - len(stamps) + len(parsed.doubled), 1)
    missing *= len(parsed.gaps) > 0 and not parsed.changing
    for count, what, handled, frames, one, many in (
        (missing, "missing", "left as gaps in time", parsed.gaps, "frame is", "frames are"),
        (len(parsed.doubled), "doubled", "left out", parsed.doubled, "frame has", "frames have"),
        (len(parsed.corrupt), "corrupt", "passed over", parsed.corrupt, "time stamp is", "time stamps are"),
    ):
        note = f"{count_text(count, one, many)} {_FAULTS[what]} {describe_frames(frames)}; {handled}"
        yield AuditRow(f"time stamps, {what}", str(count), handled if count else "none"), note * (count > 0)
    if parsed.uneven or parsed.changing:
        what = "the frame rate changes" if parsed.changing else "the time stamps are not evenly spaced"
        row = AuditRow(
            "time stamps, spacing", "changing" if parsed.changing else "uneven", "each frame has its own time"
        )
        yield row, f"{what}; each frame has the time of its own stamp"


def _exposure_findings(exposure: float | None, fps: float) -> Iterator[tuple[AuditRow, str]]:
    """Yield a row on the exposure with its note."""
    if exposure is None:
        return
    share = exposure * fps
    fits = share <= 1 + MAX_RATE_DIFFERENCE
    verdict = f"{share:.1%} of the frame interval" if fits else "longer than the frame interval"
    note = (
        f"the exposure of {1e6 * exposure:.4g} us is longer than the frame interval of {1e6 / fps:.4g} us; "
        "one of the two is wrong"
    )
    yield AuditRow("exposure", f"{1e6 * exposure:.4g} us", verdict), note * (not fits)
