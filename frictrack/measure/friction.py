"""Compute the friction force where nothing else acts on the slider, and find the events of a run.

    F = D - m a,   D = drive - m g sin(incline)     (m + I/r^2 in place of m in m a, of a body that rolls)

F > 0 resists motion toward +x; the incline is positive when the course rises toward +x.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from frictrack.base.errors import FrictrackError, result_or_none
from frictrack.measure.motion import CorrelatedNoise, NoiseStretch, correlated_noise
from frictrack.records import Array, EarlierRuns, Friction, Mask, Run, RunEvents, mask_of_spans, stretches
from frictrack.sampling import noise_of_smooth, white_noise

MIN_MOVING_SIGMAS = 3.0  # |v| over sigma_v from which a frame counts as moving
MIN_SHARE_OF_NEIGHBOURS = 0.5  # of the speed around them, with which frames of uncertain velocity move too
MAX_PAUSE_SHARE = 0.1  # of the shorter neighbouring span: longest pause at the reversal of a swing
MAX_SWING_RATIO = 3.0  # acceleration at a reversal over the median; an impact exceeds it
MIN_MOTION_SIGMAS = 5.0  # |v| over sigma_v that a span of moving frames must reach to be a motion
PUSH_SPEED_SHARE = 0.8  # of the highest speed; a record that begins slower contains the push
MAX_PUSHED_SHARE = 0.02  # of the highest speed of a swing that was let go, which its later motion does not explain
IMPACT_TIME_S = 4e-3  # within which an impact takes half of the speed
IMPACT_RATIO = 5.0  # deceleration of an impact over the median
EVENT_REACH_FRAMES = 3  # beyond an event that differences still contain it
MAX_EVENT_DISTANCE = 8  # frames between an event of the smoother and its cause
MIN_FREE_FRAMES = 8  # of a free section
MIN_BOUNCE_SIGMAS = 5.0  # standard deviations by which a bounce changes the velocity
MIN_DISTANCE_SIGMAS = 5.0  # standard deviations of the position that a motion must cover
MIN_NOISE_SHARE = 1e-9  # smallest noise of a force sensor over its largest force
LAGS_OF_SLOPE = 2.0  # before and after a moment, between which the slope of a force is taken
USUAL_SHARE = 0.9  # of the intervals between samples of a load cell; where one is longer, it was not running
MIN_REST_FRAMES = 12  # frames needed to estimate the noise
EDGE_FRAMES = 3  # frames at either end of a rest that may still move


def free_section(run: Run) -> tuple[Mask, str]:
    """Select the frames in which only friction slows the slider.

    A given `run.free` overrides. With a measured drive or measured friction these are all moving frames. With
    `has_incline` they last from the beginning of motion to the first of impact, last valid frame and stop. Otherwise
    the slider was struck or pushed, and they start at the highest speed. A mass that bounces flies freely again, up to
    its next impact. Invalid frames are never free.

    Parameters
    ----------
    run
        Run of n frames.

    Returns
    -------
    mask : array of bool
        Free frames, (n,).
    reason : str
        Why these frames, in words.

    Raises
    ------
    FrictrackError
        If fewer than 8 frames are left.

    Examples
    --------
    >>> import frictrack as ft
    >>> mask, reason = ft.free_section(ft.samples.runs()[2])
    >>> int(mask.sum())
    503
    >>> reason
    'from the highest speed at 0.004 s and 18 frames for the filter to the last moving frame at 0.134 s'

    """
    valid, moving = run.displacement.valid, is_moving(run)
    if run.steady:
        return valid, "every row is a measurement at a constant speed"
    if run.free is not None:
        t = run.motion.t
        mask = valid & (t >= run.free[0]) & (t <= run.free[1])
        reason = f"{run.free[0]:g} s to {run.free[1]:g} s as given"
    elif (section := _section(run)) is None:
        mask = valid & moving
        measured = "drive" if run.friction_N is None else "friction"
        stuck = int(np.sum(valid & ~moving))
        reason = f"whole record ({measured} is measured), {stuck} of {len(valid)} frames left out as stuck"
    else:
        mask = valid & moving & ~_events_at_ends(run) & mask_of_spans(section.flights, len(valid))
        reason = section.reason
    if np.sum(mask) < MIN_FREE_FRAMES:
        raise FrictrackError(
            f'run "{run.name}": expected at least {MIN_FREE_FRAMES} free frames but got {np.sum(mask)} ({reason}); '
            "give the free section as free = [t0, t1]"
        )
    return mask, reason


def release_time(run: Run) -> float:
    """Time of the highest speed of a pushed run, of the first motion on an incline, or else of the first free frame."""
    section = _section(run)
    return float(run.motion.t[np.argmax(free_section(run)[0]) if section is None else section.release])


def moving_sections(run: Run) -> list[slice]:
    """Split the free frames at reversals and stops; a span may contain invalid frames, but no stuck ones."""
    mask, _ = free_section(run)
    free = np.flatnonzero(mask)
    direction = np.sign(run.motion.v[free])
    stuck_before = np.cumsum(run.displacement.valid & ~mask)[free]
    cuts = np.flatnonzero((np.diff(direction) != 0) | (np.diff(stuck_before) > 0)) + 1
    return [slice(int(part[0]), int(part[-1]) + 1) for part in np.split(free, cuts)]


def _swing_acceleration(run: Run, before: slice, after: slice) -> float | None:
    """Acceleration, m/s^2, with which a mass without a drive reverses smoothly between two spans of its motion.

    None if the mass rests in between, an impact reverses it, or one of the spans is too short to be distinguished from
    the end of the smoothed motion at a stop.
    """
    if has_measured_force(run):
        return None
    v, a = run.motion.v, np.abs(run.motion.a)
    shorter = min(before.stop - before.start, after.stop - after.start)
    if shorter < _filter_frames(run):  # where a mass comes to rest, the smoothed motion swings on within these
        return None
    turn = slice(before.stop - 1, after.start + 1)
    if v[turn.start] * v[after.start] >= 0 or after.start - before.stop > max(MAX_PAUSE_SHARE * shorter, 2):
        return None
    around = slice(max(before.stop - shorter, before.start), after.start + shorter)
    acceleration, typical = float(np.max(a[turn])), float(np.median(a[around]))
    # the velocity passes its uncertain range as fast as it changes around, but for one frame that is in it anyway
    uncertain = 2 * MIN_MOVING_SIGMAS * float(np.max(run.motion.sigma_v[turn]))
    passes = (turn.stop - turn.start - 3) * typical * _interval(run) < MAX_SWING_RATIO * uncertain
    is_swing = passes and run.displacement.valid[turn].all() and acceleration < MAX_SWING_RATIO * typical
    return acceleration if is_swing else None


def join_swings(run: Run, spans: Sequence[slice]) -> list[tuple[slice, float]]:
    """Join neighbouring spans of motion across the reversals of a swing.

    Dry friction changes its sign at a reversal. Where gravity or a spring pulls the mass back, it does not rest there,
    and one model must describe the loss from swing to swing. A blow also reverses a mass, but at once: there the spans
    stay separate, as they do where the drive is measured. Every span comes with the speed (m/s) that the mass
    gains in one frame at its reversals, 0 for a span of one direction.
    """
    out: list[tuple[slice, float]] = []
    for span in spans:
        if out and (pull := _swing_acceleration(run, out[-1][0], span)) is not None:
            before, gain = out.pop()
            out.append((slice(before.start, span.stop), max(gain, pull * _interval(run))))
        else:
            out.append((span, 0.0))
    return out


def impact(run: Run) -> str:
    """Describe the first impact of a run without a drive.

    Parameters
    ----------
    run
        Run of n frames.

    Returns
    -------
    str
        One sentence; empty if there is no impact.

    Examples
    --------
    >>> from frictrack import records
    >>> t = np.arange(0, 1, 0.01)
    >>> v = np.where(t < 0.6, 1.0 + 0.5 * t, -0.8 + 0.5 * (t - 0.6))
    >>> nan, one, x = np.full(100, np.nan), np.ones(100), np.cumsum(v) * 0.01
    >>> motion = records.Motion(t, x, v, 0 * t, nan, one, 1e-3 * one, one, nan, 0)
    >>> seen = records.Displacement(t, x, nan, nan, nan, nan, one == 1)
    >>> impact(records.Run(seen, motion, mass=1.0, has_incline=True, incline=-0.05)).partition("; friction")[0]
    'the mass hits something at 0.59 s, which turns its velocity from 1.3 to -0.802 m/s'

    """
    section = _section(run)
    if section is None or section.impact is None:
        return ""
    consequence, judged, flights = "takes at least half of its velocity", "before that", len(section.flights)
    if section.bounces and section.bounces[0].before <= section.impact + _filter_frames(run):
        consequence = "turns its velocity from {:.3g} to {:.3g} m/s".format(*section.bounces[0].v)
    if flights > 1:
        restitution = np.median([abs(one.v[1] / one.v[0]) for one in section.bounces])
        judged = (
            f"in the {flights} flights between its bounces, which have a restitution coefficient of {restitution:.2g}"
        )
    at = run.motion.t[section.impact]
    return f"the mass hits something at {at:.4g} s, which {consequence}; friction is judged {judged}"


def friction(run: Run) -> Friction:
    """Compute the friction force F = D - m a and its standard deviation, and select the free section.

    The variance of F is the sum of those of m a, of the mass (`sigma_mass abs(a + g sin(incline))`), of the scale
    (`m abs(a)` times its relative error) and of the measured drive. Errors of mass and scale are common to all frames.
    Where friction itself was measured, F is that series with gaps interpolated, and sigma_F its noise. How late the
    amplifier of a load cell answers is in sigma_F only where noise that passed it shows that.

    Parameters
    ----------
    run
        Run of n frames with motion and either mass or measured friction.

    Returns
    -------
    Friction
        Force (N) with its standard deviation, each (n,), and the free frames.

    Raises
    ------
    FrictrackError
        If fewer than 8 frames are free.

    Examples
    --------
    >>> from frictrack import records
    >>> t = np.arange(100) / 100.0
    >>> nan, one = np.full(100, np.nan), np.ones(100)
    >>> motion = records.Motion(t, 0 * t, 3.0 - 2.0 * t, -2.0 * one, nan, one, 1e-3 * one, 0.1 * one, nan, 0)
    >>> positions = records.Displacement(t, 0 * t, nan, nan, nan, nan, one == 1)
    >>> force = friction(records.Run(positions, motion, mass=0.5))
    >>> float(force.F[50]), round(float(force.sigma_F[50]), 3)
    (1.0, 0.05)

    """
    mask, reason = free_section(run)
    if run.friction_N is not None:
        known, rows = np.isfinite(run.friction_N), np.arange(len(run.friction_N))
        force = np.interp(rows, rows[known], run.friction_N[known])
        t, (noise, lag) = run.motion.t, _cell_noise_and_lag(run)
        noise = noise if run.noise is None else run.noise
        sigma = np.full(len(force), noise) if run.sigma_friction is None else run.sigma_friction
        around = np.clip(t[:, None] + LAGS_OF_SLOPE * lag * np.array([-1.0, 1.0]), t[0], t[-1])
        if lag:
            sigma = np.hypot(sigma, lag * np.diff(np.interp(around, t, force))[:, 0] / np.diff(around)[:, 0])
        return Friction(t, force, sigma, mask & _between_samples(known), reason, run.motion.repaired)
    assert run.inertia is not None  # Run checks this
    acceleration = run.motion.a - run.pull
    drive = np.zeros(len(acceleration)) if run.drive is None else np.asarray(run.drive, dtype=float)
    # the acceleration goes with the scale, and with the square of the clock's rate
    relative = np.hypot(run.displacement.relative_scale_error, 2.0 * run.displacement.clock_error)
    sigma_scale = relative * run.inertia * run.motion.a
    sigma_weight = run.sigma_mass * (1.0 + float(run.rolling)) * acceleration
    variance = (run.inertia * run.motion.sigma_a) ** 2 + sigma_weight**2 + sigma_scale**2 + drive_noise(run) ** 2
    force = drive - run.inertia * acceleration
    return Friction(run.motion.t, force, np.sqrt(variance), mask, reason, run.motion.repaired)


def _between_samples(known: Mask) -> Mask:
    """Frames (n,) of a measured force, and those between two samples that follow one another."""
    at, between = np.flatnonzero(known), known.copy()
    if len(at) > 1:
        steps = np.diff(at)
        between[at[0] : at[-1]] |= np.repeat(steps <= np.quantile(steps, USUAL_SHARE), steps)
    return between


def drive_noise(run: Run) -> float:
    """White noise of the drive of a run, N, as stated, else what it scatters about any smooth course."""
    if run.drive is None or run.sigma_drive is not None:
        return run.sigma_drive or 0.0
    if run.drive_scatter is not None:
        return run.drive_scatter
    drive = np.asarray(run.drive, dtype=float)
    level = float(np.nan_to_num(noise_of_smooth(drive)[0]))
    return level if level > MIN_NOISE_SHARE * float(np.nanmax(np.abs(drive))) else 0.0


def cell_noise(run: Run) -> float:
    """Noise of the load cell of a run, N: as stated, or what it scatters at the frames at which it was read."""
    return _cell_noise_and_lag(run)[0] if run.noise is None else run.noise


def _cell_noise_and_lag(run: Run) -> tuple[float, float]:
    """Noise of the load cell, N, and the lag of its amplifier, s; 0 where no noise that passed it shows one."""
    force = np.asarray(run.friction_N, dtype=float)
    at = np.flatnonzero(np.isfinite(force))
    force = force[at]
    if (found := correlated_cell_noise([force], [at])) is not None:
        return float(found.rms[0]), -float(np.median(np.diff(run.motion.t[at])) / np.log(found.correlation))
    return max(white_noise(force), MIN_NOISE_SHARE * float(np.max(np.abs(force), initial=0.0)), 1e-12), 0.0


def correlated_cell_noise(forces: Sequence[Array], frames: Sequence[NDArray[np.intp]]) -> CorrelatedNoise | None:
    """Noise that passed the filter of an amplifier, of load cells read at some frames; None where it is white.

    Its correlation between neighbouring frames is seen at frequencies above those of any friction.
    """
    both = zip(forces, frames, strict=True)
    even = [max(np.split(force, np.flatnonzero(np.diff(at) > 1) + 1), key=len) for force, at in both]
    scatters = all(white_noise(part) > MIN_NOISE_SHARE * np.max(np.abs(part), initial=0.0) for part in even)
    return correlated_noise([NoiseStretch(part) for part in even]) if scatters else None


def has_measured_force(run: Run) -> bool:
    """Whether drive or friction was measured."""
    return run.drive is not None or run.friction_N is not None


def is_moving(run: Run) -> Mask:
    """Frames (n,) whose velocity exceeds three standard deviations, or is uncertain between two that are as fast."""
    v = run.motion.v
    moves = np.abs(v) > MIN_MOVING_SIGMAS * run.motion.sigma_v
    for gap in stretches(~moves):  # a frame is lost there: the mass does not rest
        if gap.start > 0 and gap.stop < len(v) and gap.stop - gap.start < MIN_REST_FRAMES:
            onward = v[gap.start - 1 : gap.stop + 1] * np.sign(v[gap.start - 1])
            moves[gap] = np.min(onward[1:-1]) > MIN_SHARE_OF_NEIGHBOURS * max(onward[0], onward[-1])
    return np.asarray(moves)


def split_by_direction(run: Run, spans: Sequence[slice]) -> list[slice]:
    """Return the spans of a run, cut where the direction of motion changes between two frames."""
    out = []
    for s in spans:
        reversals = s.start + 1 + np.flatnonzero(np.diff(np.sign(run.motion.v[s])) != 0)
        out += [slice(int(i), int(j)) for i, j in pairwise([s.start, *reversals, s.stop])]
    return out


def count_flights(run: Run) -> int:
    """Number of free flights of a run: one more with every bounce that is followed; 1 with a measured force."""
    section = _section(run)
    return 1 if section is None else len(section.flights)


@dataclass(frozen=True)
class _Section:
    """First and last frame of every free flight, frames of release and first impact, why these, and the bounces."""

    flights: tuple[tuple[int, int], ...]
    release: int
    impact: int | None
    reason: str
    bounces: list[_Bounce]


def _section(run: Run) -> _Section | None:
    """Free flights of a run that coasts or slides down an incline; None where a force was measured or `free` given."""
    if run.free is not None or has_measured_force(run):
        return None
    bounces, (start, stop) = _bounces(run), _main_motion(run)
    first, release, begins = _find_begin(run, start, stop)
    last, ends, hits = _find_end(run, first, stop, bounces)
    more = tuple(_flights_after_bounces(run, stop, bounces))
    if more:
        ends += f", and {len(more)} flights after bounces, to {run.motion.t[more[-1][1]]:.4g} s"
    bounces = [one for one in bounces if start < one.before]
    impact = min([*hits, *(one.before for one in bounces[:1])], default=None)
    return _Section(((first, last), *more), release, impact, f"from {begins} to {ends}", bounces)


def _flights_after_bounces(run: Run, stop: int, bounces: Sequence[_Bounce]) -> Iterator[tuple[int, int]]:
    """Yield first and last frame of every flight that a bounce begins; on an incline they end with the main motion.

    The last one ends where a further bounce would be that the noise hides.
    """
    motions = _motions(run, joined=True) if bounces else []
    for bounce, following in zip(bounces, [*bounces[1:], None], strict=False):  # of no bounces, no pair
        event = _event(run, bounce.after)
        first = event[1] + EVENT_REACH_FRAMES if event else bounce.after + _filter_frames(run)
        moves = next((motion.stop - 1 for motion in motions if motion.stop > first), first)
        end = min(stop if run.has_incline else moves, bounce.following) if following is None else following.after
        last = _find_end(run, first, end, bounces)[0] if end - first >= MIN_FREE_FRAMES else first
        if last - first >= MIN_FREE_FRAMES:
            yield first, last


def _main_motion(run: Run) -> tuple[int, int]:
    """First and last valid frame of the motion to use: across reversals on an incline, else the fastest part."""
    valid, motions = run.displacement.valid, _motions(run, joined=True)
    if not motions:
        raise FrictrackError(
            f'run "{run.name}": expected a sliding target but its speed never exceeds {MIN_MOTION_SIGMAS:g} standard '
            "deviations; check the target, or give the free section as free = [t0, t1]"
        )
    # a wrong sample at an end of the record looks like the fastest motion of all
    compared = np.where(valid & ~_events_at_ends(run), np.abs(run.motion.v), 0.0)
    fastest = max(motions, key=lambda s: float(np.max(compared[s])))
    chosen = (motions[0].start, motions[-1].stop) if run.has_incline else (fastest.start, fastest.stop)
    inside = np.flatnonzero(valid[slice(*chosen)]) + chosen[0]
    return int(inside[0]), int(inside[-1])


def _motions(run: Run, *, joined: bool) -> list[slice]:
    """Spans with a velocity that significantly differs from zero: joined across swings, or each of one direction."""
    spans = stretches(is_moving(run) | ~run.displacement.valid)
    significant = run.displacement.valid & (np.abs(run.motion.v) > MIN_MOTION_SIGMAS * run.motion.sigma_v)
    found = [s for s in (spans if joined else split_by_direction(run, spans)) if np.any(significant[s])]
    return [span for span, _ in join_swings(run, found)] if joined else found


def _find_begin(run: Run, start: int, stop: int) -> tuple[int, int, str]:
    """First free frame, frame of release, and the reason."""
    t, filter_frames = run.motion.t, _filter_frames(run)
    usable = run.displacement.valid & ~_lost_frame_spikes(run, start, stop) & ~_events_at_ends(run)
    speed = np.where(usable, np.abs(run.motion.v), 0.0)[start : stop + 1]
    fastest = int(np.argmax(speed))
    before = speed[: fastest + 1]
    if run.has_incline or _is_let_go(run, start, start + fastest, stop):
        release, event = start, f"the beginning of motion at {t[start]:.4g} s"
        was_at_rest = bool(np.any(run.displacement.valid[:start]))
    else:
        was_at_rest = bool(np.min(before[before > 0.0]) < PUSH_SPEED_SHARE * before[-1])
        release, event = start + fastest, f"the highest speed at {t[start + fastest]:.4g} s"
    if not was_at_rest:
        return start, start, f"the first frame at {t[start]:.4g} s, which moves freely already"
    push = _event(run, release)
    if push:  # the smoother modelled the push as an event, so it does not smear it
        first = min(push[1] + EVENT_REACH_FRAMES, release + filter_frames, stop)
        return first, release, f"{event}, after the push at {t[first]:.4g} s,"
    return min(release + filter_frames, stop), release, f"{event} and {filter_frames} frames for the filter"


def _is_let_go(run: Run, start: int, fastest: int, stop: int) -> bool:
    """Whether a swing was let go: what then brings it back explains the highest speed, without a push."""
    x, v, a = run.motion.x[start : stop + 1], run.motion.v[start : stop + 1], run.motion.a[start : stop + 1]
    before = np.arange(len(x)) < fastest - start
    if np.sum(before) < MIN_FREE_FRAMES or np.all(v * v[fastest - start] >= 0):
        return False  # it never comes back
    shape = (x - np.mean(x)) / np.ptp(x)
    terms = np.column_stack([np.ones_like(x), shape, shape**3, np.sign(v), v, v * np.abs(v)])
    known = run.displacement.valid[start : stop + 1] & ~before
    law = np.linalg.lstsq(terms[known], a[known], rcond=None)[0]
    pushed = np.sum((a - terms @ law)[before]) * _interval(run)
    return bool(abs(pushed) < MAX_PUSHED_SHARE * abs(v[fastest - start]))


def _find_end(run: Run, first: int, stop: int, bounces: Sequence[_Bounce]) -> tuple[int, str, list[int]]:
    """Last free frame, the reason, and the first frames of impacts."""
    t, filter_frames = run.motion.t, _filter_frames(run)
    rows = [bounce.before for bounce in bounces if first < bounce.before <= stop]
    rows += (_impact(run, first, stop) or ())[:1]
    if not rows:
        kind = "valid" if stop == np.flatnonzero(run.displacement.valid)[-1] else "moving"
        return stop, f"the last {kind} frame at {t[stop]:.4g} s", rows
    why, event = f"an impact at {t[min(rows)]:.4g} s", _event(run, min(rows))
    if event and event[0] - EVENT_REACH_FRAMES > first:  # an event is not smeared into the slide
        return min(event[0] - EVENT_REACH_FRAMES, stop), why, rows
    return max(min(rows) - filter_frames, first), f"{why} less {filter_frames} frames for the filter", rows


def _filter_frames(run: Run) -> int:
    """Frames over which the low-pass smears an abrupt change: half a period of its cut-off, where known."""
    if not np.isfinite(run.motion.cutoff):
        return run.motion.guard
    period = 1.0 / (run.motion.cutoff * _interval(run))
    return int(min(np.ceil(period / 2.0), len(run.motion) // 8))


def _event(run: Run, row: int) -> tuple[int, int] | None:
    """First and last row of the event of the smoother nearest to a row; None if there is none."""
    around = [e for e in run.motion.events if e[0] - MAX_EVENT_DISTANCE <= row <= e[1] + MAX_EVENT_DISTANCE]
    return min(around, key=lambda e: max(e[0] - row, row - e[1])) if around else None


def _events_at_ends(run: Run) -> Mask:
    """Frames (n,) of events at the ends of the record, where a push cannot be distinguished from a wrong sample."""
    reach, n = EVENT_REACH_FRAMES, len(run.motion)
    at_ends = [(first, last) for first, last in run.motion.events if first <= reach or last >= n - 1 - reach]
    return mask_of_spans([(max(first - reach, 0), last + reach) for first, last in at_ends], n)


def _lost_frame_spikes(run: Run, start: int, stop: int) -> Mask:
    """Frames (n,) whose speed appears and disappears at once: lost frames, not pushes."""
    speed, (window, _, sudden) = np.abs(run.motion.v), _impact_scales(run, start, stop)
    i = np.arange(len(speed))
    neighbour_speed = np.maximum(speed[np.maximum(i - window, start)], speed[np.minimum(i + window, stop)])
    return np.asarray((neighbour_speed < PUSH_SPEED_SHARE * speed) & (speed - neighbour_speed > sudden))


def _interval(run: Run) -> float:
    """Frame interval, s."""
    return float(np.median(np.diff(run.motion.t)))


def _impact_scales(run: Run, first: int, stop: int) -> tuple[int, float, float]:
    """Frames in which an impact takes half of the speed of low-passed data, and what sliding in a span cannot cause.

    That is an acceleration, m/s^2, and the speed (m/s) that it takes within these frames.
    """
    frames = max(round(IMPACT_TIME_S / _interval(run)), 2 * _filter_frames(run))
    acceleration = IMPACT_RATIO * float(np.median(np.abs(run.motion.a[first : stop + 1])))
    return frames, acceleration, acceleration * frames * _interval(run) / 2.0


def _impact(run: Run, first: int, stop: int) -> tuple[int, int] | None:
    """First and last frame of the first impact: half of the speed is lost far faster than in the slide and nearby.

    Speed that returns soon after was not lost; a frame was. A swing that decays turns faster than it does on average.
    """
    t, v, a = run.motion.t, run.motion.v, np.abs(run.motion.a)
    (window, impact_acceleration, sudden), interval = _impact_scales(run, first, stop), _interval(run)
    i = np.arange(first, min(stop + 1, len(v) - 1))

    def speeds(frames: int) -> Array:  # of the frame so many usual intervals later: the rate may change
        rows = np.searchsorted(t, t[i] + (frames - 0.5) * interval)
        return np.asarray(np.sign(v[i]) * v[np.minimum(rows, len(v) - 1)])

    offsets = [k * round(IMPACT_TIME_S / interval) for k in range(3)]
    speed_before = np.min([np.abs(speeds(-k)) for k in offsets], axis=0)
    speed_after = np.max([speeds(window + k) for k in offsets], axis=0)
    loss = speed_before - speed_after
    hits = i[(loss > 0.5 * speed_before) & (loss > sudden) & ~_events_at_ends(run)[i]]
    around = ((k, max(k - 2 * window, first), min(k + 3 * window, stop)) for k in hits)
    hit = next((k for k, *span in around if loss[k - first] > _impact_scales(run, *span)[2]), None)
    if hit is None:
        return None
    hardest, quiet = hit + int(np.argmax(a[hit : hit + 2 * window])), a <= impact_acceleration
    before, after = np.flatnonzero(quiet[first:hardest]), np.flatnonzero(quiet[hardest:])
    begins = first + before[-1] if len(before) else first
    return int(begins), int(hardest + after[0]) if len(after) else len(a) - 1


@dataclass(frozen=True)
class _Bounce:
    """A reversal at which something hits the mass: velocities before and after, m/s, and the frames around it.

    `before` and `after` are the last and the first frame of free flight, `following` the next reversal of its sense.
    """

    v: tuple[float, float]
    before: int
    after: int
    following: int


def _parabola(t: Array, x: Array, usable: Mask, resolution: float) -> tuple[np.poly1d, float, float]:
    """Parabola through positions (n,), m, from a reversal at 0 s, but the nearest eighth; variance of its slope, noise.

    Infinite where there are too few positions.
    """
    use = usable & (np.abs(t) > np.max(np.abs(t)) / 8)
    if np.sum(use) < MIN_FREE_FRAMES:
        return np.poly1d(0.0), np.inf, np.inf
    c, covariance = np.polyfit(t[use], x[use], 2, cov="unscaled")
    variance = np.sum((x[use] - np.polyval(c, t[use])) ** 2) / (np.sum(use) - 3)
    variance = max(float(variance), resolution**2 / 12)
    return np.poly1d(c), float(covariance[1, 1]) * variance, float(np.sqrt(variance))


def _bounces(run: Run) -> list[_Bounce]:
    """Find the bounces of a run: reversals at which its way has a kink."""
    v = run.motion.v
    moves, turns = _motions(run, joined=False), []
    for before, after in pairwise(moves):
        sign = np.sign(v[before.stop - 1])
        if sign != np.sign(v[after.start]):
            between = slice(before.stop - 1, after.start + 1)
            turns.append(between.start + int(np.argmax(sign * run.motion.x[between])))
    edges = [moves[0].start, *turns, moves[-1].stop - 1] if moves else []
    ends = [edge - _filter_frames(run) for edge in [*edges[3:], *edges[-1:]]]
    found = [_bounce(run, *around) for around in zip(edges, edges[1:], edges[2:], ends, strict=False)]
    return [bounce for bounce in found if bounce is not None]


def _bounce(run: Run, low: int, turn: int, high: int, following: int) -> _Bounce | None:
    """The bounce at a reversal `turn` between two others, if there is one.

    A parabola is fitted to the positions of either side, over half of the way to the neighbouring reversals; where they
    cross, their slopes differ by the blow. No smooth curve of as many parameters describes the way as well, as it does
    that of a swing. Smoothed velocities do not tell it in coarse records.
    """
    x, t, usable = run.displacement.x, run.motion.t - run.motion.t[turn], run.displacement.known
    rows = [np.arange((low + turn) // 2, turn + 1), np.arange(turn, (turn + high) // 2 + 1)]
    found = [_parabola(t[r], x[r], usable[r], run.displacement.resolution) for r in rows]
    sides, variances, noises = zip(*found, strict=True)
    roots = (sides[1] - sides[0]).roots if np.isfinite(noises).all() else np.zeros(0)
    roots = roots[np.isreal(roots)].real
    if not len(roots):
        return None
    crossing = roots[np.argmin(np.abs(roots))]
    before, after = (float(side.deriv()(crossing)) for side in sides)
    is_blow = before * after < 0 and abs(after - before) > MIN_BOUNCE_SIGMAS * np.sqrt(sum(variances))
    is_near = abs(crossing) < min(-t[rows[0][0]], t[rows[1][-1]]) / 4
    both = np.concatenate([rows[0][:-1], rows[1]])
    both = both[usable[both]]
    with warnings.catch_warnings(action="ignore", category=np.exceptions.RankWarning):
        smooth = np.polyval(np.polyfit(t[both], x[both], 5), t[both])
    parabolas = np.where(t[both] < 0, *(side(t[both]) for side in sides))
    gain = np.sum((x[both] - smooth) ** 2 - (x[both] - parabolas) ** 2)
    if not (is_blow and is_near and gain > (MIN_BOUNCE_SIGMAS * max(noises)) ** 2):
        return None
    last, first = (
        r[np.abs(x[r] - side(t[r])) < MIN_MOVING_SIGMAS * noise]
        for r, side, noise in zip(rows, sides, noises, strict=True)
    )
    return _Bounce((before, after), int(last[-1]), int(first[0]), following)


def find_events(run: Run) -> RunEvents:
    """Find the events and the rests of a run.

    A reversal is where the velocity crosses zero between two motions of opposite direction. A stop and a start are
    where the mass rests between motions. An impact changes the velocity by far more than friction does in that time.
    The noise at rest is that of the unfiltered displacement about the mean of each rest, without rests that creep.

    Parameters
    ----------
    run
        A run with displacement and motion.

    Returns
    -------
    RunEvents
        Events in order as (kind, begin s, end s), rests as (begin s, end s), and the noise at rest, m.

    Examples
    --------
    >>> import frictrack as ft
    >>> [kind for kind, _, _ in ft.find_events(ft.samples.runs()[2]).events]
    ['release', 'stop']

    """
    t, v = run.motion.t, run.motion.v
    least = MIN_DISTANCE_SIGMAS * float(np.nanmedian(run.displacement.sigma_x))  # more than the noise of the position
    motions = [s for s in _motions(run, joined=False) if np.ptp(run.motion.x[s]) > least]
    section = result_or_none(_section, run)
    release = section.release if section else 0
    found = [("release", release, release)] if release else []  # kind, first and last frame
    if motions and motions[0].start > MIN_REST_FRAMES:
        found.append(("start", motions[0].start - 1, motions[0].start))
    for before, after in pairwise(motions):
        ends = before.stop - 1
        if np.sign(v[ends]) != np.sign(v[after.start]) and after.start - ends <= MIN_REST_FRAMES:
            found.append(("reversal", ends, after.start))
        else:
            found += [("stop", ends, ends + 1), ("start", after.start - 1, after.start)]
    if motions and motions[-1].stop < len(t) - 1:
        found.append(("stop", motions[-1].stop - 1, motions[-1].stop))
    hits = [(one.before, one.after) for one in _bounces(run)]
    for s in motions:  # the first sudden loss of speed that does not stop it
        hit = _impact(run, max(s.start, release), s.stop - 1) if release < s.stop else None
        hits += [hit] if hit and hit[1] + EDGE_FRAMES < s.stop else []
    found += [("impact", *hit) for hit in hits if hit[1] > release]
    events = [(kind, float(t[i]), float(t[j])) for kind, i, j in found]
    still = ~mask_of_spans([(s.start, s.stop - 1) for s in motions], len(t))
    rests = [slice(s.start + EDGE_FRAMES, s.stop - EDGE_FRAMES) for s in stretches(still) if s.stop > 2 * EDGE_FRAMES]
    rests = [s for s in rests if np.sum(run.displacement.valid[s]) >= MIN_REST_FRAMES]
    at_rest = [run.displacement.x[s][run.displacement.valid[s]] for s in rests]
    count = sum(len(x) - 1 for x in at_rest)
    noise = float(np.sqrt(sum(np.sum((x - np.mean(x)) ** 2) for x in at_rest) / count)) if count else float("nan")
    spans = tuple((float(t[s.start]), float(t[s.stop - 1])) for s in rests)
    return RunEvents(tuple(sorted(events, key=lambda e: e[1])), spans, noise)


def with_earlier_runs(runs: Sequence[Run], pauses: Sequence[Annotated[float, "s"] | None]) -> list[Run]:
    """Return the runs, each with the runs that were made before it.

    Parameters
    ----------
    runs : sequence of Run
        All runs on the same surfaces, in the order in which they were made.
    pauses : sequence of float or None
        Time between the end of the run before and the beginning of each, s; that of the first does not count. None
        where it is not known: what happened before then is not known either, for this run and those after it.

    Returns
    -------
    list of Run
        The runs with `earlier`.

    Raises
    ------
    FrictrackError
        If there is not one pause per run.

    Examples
    --------
    >>> import frictrack as ft
    >>> runs = ft.with_earlier_runs(ft.samples.runs()[:2], [None, 60.0])
    >>> runs[0].earlier, [(rest, round(slid, 2)) for rest, slid in runs[1].earlier]
    ((), [(60.0, 0.21)])

    """
    if len(pauses) != len(runs):
        raise FrictrackError(f"expected one pause for each of the {len(runs)} runs but got {len(pauses)}")
    if all(pause is None for pause in pauses[1:]):
        return list(runs)
    out = [replace(runs[0], earlier=())]
    for run, pause in zip(runs[1:], pauses[1:], strict=True):
        before, earlier = out[-1], None
        if before.earlier is not None and pause is not None:
            # the distance is without the noise at rest
            slid = float(np.sum(np.abs(np.diff(before.motion.x)) * is_moving(before)[1:]))
            earlier = after_run(before.earlier, float(np.ptp(before.motion.t)), slid, pause)
        out.append(replace(run, earlier=earlier))
    return out


def after_run(earlier: EarlierRuns, duration: float, distance: float, pause: float) -> EarlierRuns:
    """Return what was slid before a run that begins a pause (s) after another one.

    The other one has its own `earlier`, lasted for a duration (s) and slid a distance (m).
    """
    return *((rest + duration + pause, slid) for rest, slid in earlier), (pause, distance)
