"""Motion, mass and drive -> friction force, on the section in which nothing else acts on the slider.

    F = D - m a,   D = drive - m g sin(incline)

F > 0 resists motion toward +x; the incline is positive when the course rises toward +x.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from frictrack.errors import FrictrackError
from frictrack.motion import noise_level
from frictrack.records import GRAVITY, Array, Friction, Mask, Run, stretches

MOVING = 3.0  # |v| over sigma_v above which a frame moves
MAX_PAUSE = 0.1  # of the shorter neighbouring stretch: what may lie between two at the reversal of a swing
SWING = 3.0  # times the usual acceleration up to which a mass swings back: a blow turns it harder
CERTAIN = 5.0  # |v| over sigma_v that a stretch of moving frames must reach to be a motion at all
PUSHED = 0.8  # of the highest speed: a record that begins slower shows the push
IMPACT_TIME = 4e-3  # s, within which an impact takes half of the speed
IMPACT_FACTOR = 5.0  # deceleration of an impact over the usual one
EVENT_REACH = 3  # frames beyond an event that a difference may still see it
EVENT_NEAR = 8  # frames that an event may lie from what it is
MIN_FREE = 8  # frames, fewer cannot be judged


@dataclass(frozen=True)
class _Section:
    """First and last free frame, the frame of release, and why they are these."""

    first: int
    last: int
    release: int
    begins: str
    ends: str


def free_section(run: Run) -> tuple[Mask, str]:
    """Frames (n,) in which friction alone slows the slider, and in words why they are these.

    `run.free` overrides. With a measured drive or measured friction: every moving frame. With `has_incline`:
    from the beginning of motion to the first of impact, last valid frame and stop. Otherwise the slider was
    struck or pushed: from the highest speed, to the same ends. Invalid frames are never free.
    Raises FrictrackError when fewer than 8 frames are left.
    """
    valid, moving = run.displacement.valid, is_moving(run)
    if run.free is not None:
        t = run.motion.t
        mask = valid & (t >= run.free[0]) & (t <= run.free[1])
        reason = f"{run.free[0]:g} s to {run.free[1]:g} s as given"
    elif _measured(run):
        mask = valid & moving
        what = "drive" if run.friction_N is None else "friction"
        stuck = int(np.sum(valid & ~moving))
        reason = f"whole record ({what} is measured), {stuck} of {len(valid)} frames left out as stuck"
    else:
        section = _section(run)
        mask = valid & moving & ~_at_ends(run)
        mask[: section.first] = mask[section.last + 1 :] = False
        reason = f"from {section.begins} to {section.ends}"
    if np.sum(mask) < MIN_FREE:
        raise FrictrackError(
            f'run "{run.name}": expected at least {MIN_FREE} free frames but got {np.sum(mask)} ({reason}); '
            "give the free section as free = [t0, t1]"
        )
    return mask, reason


def release_time(run: Run) -> float:
    """Recording time of the release, s: where the free motion begins, before the guard of the filter.

    It is the highest speed of a pushed run, the beginning of motion on an incline, else the first free frame.
    """
    if run.free is None and not _measured(run):
        return float(run.motion.t[_section(run).release])
    return float(run.motion.t[np.argmax(free_section(run)[0])])


def moving_sections(run: Run) -> list[slice]:
    """Stretches of free frames in one direction of motion, as slices of the record.

    An invalid frame between free ones does not cut a stretch (so a slice may hold a few), a stuck one does.
    """
    mask, _ = free_section(run)
    free = np.flatnonzero(mask)
    direction = np.sign(run.motion.v[free])
    halted = np.cumsum(run.displacement.valid & ~mask)[free]
    cuts = np.flatnonzero((np.diff(direction) != 0) | (np.diff(halted) > 0)) + 1
    return [slice(int(part[0]), int(part[-1]) + 1) for part in np.split(free, cuts)]


def reverses_freely(run: Run, before: slice, after: slice) -> float | None:
    """Acceleration, m/s^2, with which a mass without a drive swings back between two stretches of its motion.

    None where it rests in between, or where a blow turns it at once.
    """
    if _measured(run):
        return None
    v, a = run.motion.v, np.abs(run.motion.a)
    shorter = min(before.stop - before.start, after.stop - after.start)
    here = slice(before.stop - 1, after.start + 1)
    if v[here.start] * v[after.start] >= 0 or after.start - before.stop > max(MAX_PAUSE * shorter, 2):
        return None
    near = slice(max(before.stop - shorter, before.start), after.start + shorter)
    pull, usual = float(np.max(a[here])), float(np.median(a[near]))
    certain = float(np.min(a[here])) > MOVING * float(np.max(run.motion.sigma_a[here]))
    return pull if certain and np.all(run.displacement.valid[here]) and pull < SWING * usual else None


def impact(run: Run) -> str:
    """What first stops or turns the moving mass of a run without a drive at once, in words; "" where nothing does.

    Examples
    --------
    >>> from frictrack import records
    >>> t = np.arange(0, 1, 0.01)
    >>> v = np.where(t < 0.6, 1.0 + 0.5 * t, -0.8 + 0.5 * (t - 0.6))
    >>> nan, one = np.full(100, np.nan), np.ones(100)
    >>> motion = records.Motion(t, 0 * t, v, 0 * t, nan, one, 1e-3 * one, one, nan, 0)
    >>> seen = records.Displacement(t, 0 * t, nan, nan, nan, nan, one == 1)
    >>> impact(records.Run(seen, motion, mass=1.0, has_incline=True, incline=-0.05))
    'the mass hits something at 0.59 s, which turns its velocity from 1.29 to -0.8 m/s; friction is judged before that'

    """
    if run.free is not None or _measured(run):
        return ""
    start, stop = _main_motion(run)
    hit, turned = _impact(run, start, stop), _bounce(run, start, stop)
    rows = [row for row in (hit, turned and turned[0]) if row is not None]
    if not rows:
        return ""
    t, v = run.motion.t, run.motion.v
    does = "takes at least half of its velocity"
    if turned and turned[0] == min(rows):
        does = f"turns its velocity from {v[turned[0]]:.3g} to {v[turned[1]]:.3g} m/s"
    return f"the mass hits something at {t[min(rows)]:.4g} s, which {does}; friction is judged before that"


def friction(run: Run) -> Friction:
    """Friction force F = D - m a of a run with its standard deviation, and its free section.

    sigma_F is the root of the sum of squares of m sigma_a, of sigma_mass |a + g sin(incline)| and of m |a| times the
    relative error of the scale (both common to all frames, not independent from one to the next), and of the white
    noise of the measured drive. Where
    friction itself was measured, F is that series, its gaps bridged linearly, and sigma_F its white noise.
    """
    mask, reason = free_section(run)
    if run.friction_N is not None:
        F, sigma = _measured_friction(run.friction_N)
        return Friction(run.motion.t, F, sigma, mask & np.isfinite(run.friction_N), reason)
    assert run.mass is not None  # Run checks this
    pull = run.motion.a + GRAVITY * np.sin(run.incline)
    drive = np.zeros(len(pull)) if run.drive is None else np.asarray(run.drive, dtype=float)
    sigma_drive = 0.0 if run.drive is None else _white(drive)
    sigma_scale = run.displacement.relative_scale_error * run.mass * run.motion.a
    variance = (run.mass * run.motion.sigma_a) ** 2 + (run.sigma_mass * pull) ** 2 + sigma_scale**2 + sigma_drive**2
    return Friction(run.motion.t, drive - run.mass * pull, np.sqrt(variance), mask, reason)


def _measured_friction(series: Array) -> tuple[Array, Array]:
    known = np.isfinite(series)
    rows = np.arange(len(series))
    return np.interp(rows, rows[known], series[known]), np.full(len(series), _white(series))


def _white(series: Array) -> float:
    """White noise of a measured force, 0 where it cannot be told."""
    return float(np.nan_to_num(noise_level(series, np.isfinite(series))[0]))


def _measured(run: Run) -> bool:
    return run.drive is not None or run.friction_N is not None


def is_moving(run: Run) -> Mask:
    """Frames (n,) whose velocity exceeds three standard deviations."""
    return np.asarray(np.abs(run.motion.v) > MOVING * run.motion.sigma_v)


def split_by_direction(run: Run, frames: Mask) -> list[slice]:
    """Return the stretches of some frames (n,), cut where the direction of motion changes between two frames."""
    out = []
    for s in stretches(frames):
        reversals = s.start + 1 + np.flatnonzero(np.diff(np.sign(run.motion.v[s])) != 0)
        out += [slice(int(i), int(j)) for i, j in pairwise([s.start, *reversals, s.stop])]
    return out


def _section(run: Run) -> _Section:
    """The free section of a run that coasts or slides down an incline."""
    start, stop = _main_motion(run)
    first, release, begins = _begin(run, start, stop)
    last, ends = _end(run, first, stop)
    return _Section(first, last, release, begins, ends)


def _main_motion(run: Run) -> tuple[int, int]:
    """First and last valid frame of the motion that counts: past a reversal on an incline, else up to it."""
    valid, speed = run.displacement.valid, np.abs(run.motion.v)
    motions = [s for s in stretches(is_moving(run) | ~valid) if is_motion(run, s)]
    if not motions:
        raise FrictrackError(
            f'run "{run.name}": expected a sliding target but its speed never exceeds {CERTAIN:g} standard '
            "deviations; check the target, or give the free section as free = [t0, t1]"
        )
    motions = _swung(run, motions)
    fastest = max(motions, key=lambda s: float(np.max(np.where(valid[s], speed[s], 0.0))))
    chosen = (motions[0].start, motions[-1].stop) if run.has_incline else (fastest.start, fastest.stop)
    inside = np.flatnonzero(valid[slice(*chosen)]) + chosen[0]
    return int(inside[0]), int(inside[-1])


def _swung(run: Run, motions: Sequence[slice]) -> list[slice]:
    """Motions joined where the mass swings back from one into the next."""
    out = list(motions[:1])
    for after in motions[1:]:
        if reverses_freely(run, out[-1], after) is None:
            out.append(after)
        else:
            out[-1] = slice(out[-1].start, after.stop)
    return out


def is_motion(run: Run, s: slice) -> bool:
    """Whether a stretch is a motion at all: its velocity is somewhere far beyond its standard deviation."""
    sure = np.abs(run.motion.v[s]) > CERTAIN * run.motion.sigma_v[s]
    return bool(np.any(sure & run.displacement.valid[s]))


def _begin(run: Run, start: int, stop: int) -> tuple[int, int, str]:
    """First free frame, frame of release, and why."""
    t, smear = run.motion.t, _smear(run)
    there = run.displacement.valid & ~_leaps(run, start, stop) & ~_at_ends(run)
    speed = np.where(there, np.abs(run.motion.v), 0.0)[start : stop + 1]
    fastest = int(np.argmax(speed))
    before = speed[: fastest + 1]
    if run.has_incline:
        release, event = start, f"the beginning of motion at {t[start]:.4g} s"
        rested = bool(np.any(run.displacement.valid[:start]))
    else:
        rested = bool(np.min(before[before > 0.0]) < PUSHED * before[-1])
        release, event = start + fastest, f"the highest speed at {t[start + fastest]:.4g} s"
    if not rested:
        return start, start, f"the first frame at {t[start]:.4g} s, which moves freely already"
    push = _event(run, release)
    if push:  # it was followed as an event: nothing of it is smeared into what follows
        first = min(push[1] + EVENT_REACH, release + smear, stop)
        return first, release, f"{event}, after the push at {t[first]:.4g} s,"
    return min(release + smear, stop), release, f"{event} and {smear} frames for the filter"


def _end(run: Run, first: int, stop: int) -> tuple[int, str]:
    """Last free frame, and why."""
    t, smear = run.motion.t, _smear(run)
    turned = _bounce(run, first, stop)
    blows = [row for row in (_impact(run, first, stop), turned and turned[0]) if row is not None]
    hit = min(blows, default=None)
    violent = None if hit is None else _event(run, hit)
    if hit is not None and violent and violent[0] - EVENT_REACH > first:  # nothing of it is smeared into the slide
        return min(violent[0] - EVENT_REACH, stop), f"an impact at {t[hit]:.4g} s"
    if hit is not None:
        return max(hit - smear, first), f"an impact at {t[hit]:.4g} s less {smear} frames for the filter"
    if stop == np.flatnonzero(run.displacement.valid)[-1]:
        return stop, f"the last valid frame at {t[stop]:.4g} s"
    return stop, f"the last moving frame at {t[stop]:.4g} s"


def _smear(run: Run) -> int:
    """Frames over which a low-pass would smear something abrupt: half a period of its cut-off, where that is known."""
    if not np.isfinite(run.motion.cutoff):
        return run.motion.guard
    period = 1.0 / (run.motion.cutoff * _interval(run))
    return int(min(np.ceil(period / 2.0), len(run.motion) // 8))


def _event(run: Run, row: int) -> tuple[int, int] | None:
    """First and last row of the event at a row, if the smoother has seen one there."""
    near = [e for e in run.motion.events if e[0] - EVENT_NEAR <= row <= e[1] + EVENT_NEAR]
    return min(near, key=lambda e: max(e[0] - row, row - e[1])) if near else None


def _at_ends(run: Run) -> Mask:
    """Frames (n,) of events at an end of the record: nothing shows whether the mass was pushed or a sample is off."""
    n = len(run.motion)
    rows = np.arange(n)
    out = np.zeros(n, dtype=bool)
    for first, last in run.motion.events:
        if first <= EVENT_REACH or last >= n - 1 - EVENT_REACH:
            out |= (rows >= first - EVENT_REACH) & (rows <= last + EVENT_REACH)
    return out


def _leaps(run: Run, start: int, stop: int) -> Mask:
    """Frames (n,) whose speed was not there just before and is lost at once: no push but a frame that was lost."""
    speed, window = np.abs(run.motion.v), _window(run)
    i = np.arange(len(speed))
    beside = np.maximum(speed[np.maximum(i - window, start)], speed[np.minimum(i + window, stop)])
    return np.asarray((beside < PUSHED * speed) & (speed - beside > _sudden(run, start, stop)))


def _interval(run: Run) -> float:
    return float(np.median(np.diff(run.motion.t)))


def _window(run: Run) -> int:
    """Frames within which an impact takes half of the speed, as far as a low-pass shows it."""
    return max(round(IMPACT_TIME / _interval(run)), 2 * _smear(run))


def _hard(run: Run, first: int, stop: int) -> float:
    """Acceleration far beyond the usual one of a stretch, m/s^2."""
    return IMPACT_FACTOR * float(np.median(np.abs(run.motion.a[first : stop + 1])))


def _sudden(run: Run, first: int, stop: int) -> float:
    """Loss of speed within the window, m/s, that no slide of a stretch brings about."""
    return _hard(run, first, stop) * _window(run) * _interval(run) / 2.0


def _impact(run: Run, first: int, stop: int) -> int | None:
    """Frame in which the first impact begins: half of the speed lost at once, far faster than in the slide.

    Speed that is there again soon after was never lost: a frame was.
    """
    v, a = run.motion.v, np.abs(run.motion.a)
    window = _window(run)
    i = np.arange(first, min(stop + 1, len(v) - 1))
    j = np.minimum(i + window, len(v) - 1)
    beside = [k * round(IMPACT_TIME / _interval(run)) for k in range(3)]
    way = np.sign(v[i])
    had = np.min([np.abs(v[np.maximum(i - k, 0)]) for k in beside], axis=0)
    left = np.max([way * v[np.minimum(j + k, len(v) - 1)] for k in beside], axis=0)
    loss = had - left
    hits = i[(loss > 0.5 * had) & (loss > _sudden(run, first, stop)) & ~_at_ends(run)[i]]
    if len(hits) == 0:
        return None
    hardest = hits[0] + int(np.argmax(a[hits[0] : hits[0] + 2 * window]))
    quiet = np.flatnonzero(a[first:hardest] <= _hard(run, first, stop))
    return int(first + quiet[-1]) if len(quiet) else first


def _bounce(run: Run, first: int, stop: int) -> tuple[int, int] | None:
    """Frames of the highest speeds before and after the first bounce: the mass turns far faster than it came and went.

    Told by highest speeds and the times between them, it is seen in records too rough for an acceleration.
    """
    t, v = run.motion.t, run.motion.v
    moves = [s for s in stretches(is_moving(run)) if s.start <= stop and s.stop > first]
    ways = [part for s in moves for part in _ways(v, slice(max(s.start, first), min(s.stop, stop + 1)))]
    ways = [way for way in ways if is_motion(run, way)]
    for before, after in pairwise(ways):
        fastest = [way.start + int(np.argmax(np.abs(v[way]))) for way in (before, after)]
        here, there = fastest
        came, went = t[here] - t[before.start], t[after.stop - 1] - t[there]
        if v[here] * v[there] < 0 and came > 0 and went > 0:
            usual = max(abs(v[here]) / came, abs(v[there]) / went)
            if abs(v[there] - v[here]) > IMPACT_FACTOR * usual * (t[there] - t[here]):
                return here, there
    return None


def _ways(v: Array, s: slice) -> list[slice]:
    """The parts of a stretch in which the velocity keeps its sign."""
    cuts = np.flatnonzero(np.diff(np.sign(v[s]))) + 1
    edges = [0, *cuts.tolist(), s.stop - s.start]
    return [slice(s.start + a, s.start + b) for a, b in pairwise(edges)]
