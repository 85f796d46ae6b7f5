"""Find doubled and missing frames from the motion itself, where no time stamp shows them.

Three patterns are looked for, so that each is judged on a path that the ones before no longer disturb:

- Repeated frames, in any pattern: a few in a row, scattered, or every second one. While the mass moves by much more
  than the noise from frame to frame, a frame without a step repeats the one before. The step that follows says whether
  the frame was put in (one step) or took the place of lost ones (as many steps more).
- Many missing frames, no two of which leave an undisturbed curve between. A step that is a whole multiple of what its
  neighbours say it should be, to within the noise, passes over so many intervals less one of lost frames.
- Scattered ones: the positions before and after must lie on one smooth curve, read at times that are off by a whole
  number of frames. A collision bends the curve and a stop ends it; neither shifts it. Every candidate is therefore
  compared, on the frames around it, with the undisturbed curve, with a kink, and with a jump and kink of any size.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from frictrack.base.distributions import noise_of_differences, robust_std
from frictrack.records import Array, Mask
from frictrack.sampling.clock import MIN_KNOWN_STEPS, REACH_STEPS, usual_steps

MAX_STILL_STEP = 0.15  # of the usual step; a smaller one is none
MIN_NEIGHBOUR_STEP = 0.6  # of the usual step, before and after: nothing stops and goes on in between
USUAL_QUANTILE = 0.75  # of the sizes of nearby steps, taken as the usual step: many repeats do not count
MIN_STEP_SIGMAS = 8.0  # standard deviations that the usual step must have
MAX_STEP_ERROR = 0.25  # of a step, by which the step after a repeat may miss a whole number of steps
FREQUENT_SHARE = 0.2  # share of repeats from which the first and the last frame may be one too
MAX_REPEATS = 4  # in a row: a mass may stick for longer
SINGLE_STEP_TOLERANCE = 0.25  # of the usual step, within which a step passes over one interval
MAX_MULTIPLE_SIGMAS = 4.0  # standard deviations within which a step is a whole multiple
MAX_MULTIPLE_ERROR = 0.06  # intervals: a multiple that is known no better cannot be counted
MAX_MULTIPLE = 200  # intervals in one step
WINDOWS = ((8, 3), (4, 2))  # frames on either side and degree of the curve; short ones where faults crowd
MAX_JUMP_ERROR = 0.12  # frames: a jump whose standard deviation is larger cannot be counted in whole frames
MAX_MISSING_FRAMES = 200
MAX_SLIPS = 100
FRAMES_AT_ONCE = 4096  # that are compared with the curve around them
# Differences of chi^2 in units of the noise. 49 is seven standard deviations: no false alarm in 10^5 frames.
MIN_GAIN, MIN_GAIN_OVER_KINK, MAX_LOSS_TO_FREE_JUMP, MAX_REDUCED_CHI2 = 49.0, 36.0, 16.0, 3.0

Ticks = NDArray[np.int64]


@dataclass(frozen=True)
class Slip:
    """A fault of the time base: at `frame` so many `frames` are missing before it (> 0), or it is a doubled one.

    A doubled frame was put in (-1, all later ones are one too late) or stands in place of a lost one (0).
    """

    frame: int
    frames: int
    significance: float = np.inf  # standard deviations

    @property
    def doubled(self) -> bool:
        """Whether the frame repeats the one before it."""
        return self.frames <= 0


@dataclass(frozen=True, eq=False)
class SampledPath:
    """Position along the course at whole ticks.

    Attributes
    ----------
    p, sigma : array (n,)
        Position and its standard deviation.
    ticks : array of int (n,)
        Frame intervals since the first frame.
    good : array of bool (n,)
        Frames that count.
    smallest : float
        Smallest jump that counts; tracking errors may be as large.
    exact : bool
        Whether a repeated frame is equal to the last digit.
    window, degree : int
        Frames on either side and degree of the curve.

    """

    p: Array
    sigma: Array
    ticks: Ticks
    good: Mask
    smallest: float
    exact: bool = False
    window: int = WINDOWS[0][0]
    degree: int = WINDOWS[0][1]

    @property
    def enough(self) -> int:
        """Frames that must be known on either side."""
        return self.window - self.window // 3 - 1

    def corrected(self, found: Sequence[Slip]) -> SampledPath:
        """The path at corrected ticks, on which doubled frames do not count."""
        ticks, keep = correct_ticks(self.ticks, found)
        return replace(self, ticks=ticks, good=self.good & keep)

    def rows(self, rows: Ticks) -> SampledPath:
        """Some frames of the path."""
        return replace(self, p=self.p[rows], sigma=self.sigma[rows], ticks=self.ticks[rows], good=self.good[rows])


def find_slips(path: SampledPath, *, held: bool = False) -> tuple[Slip, ...]:
    """Find doubled and missing frames, in any pattern.

    `held`: whether, where every frame comes several times, the time stamps are right and the position was held; else
    the frames were put in, and time counts pictures.

    Examples
    --------
    >>> k = np.repeat(np.arange(40.0), 1 + (np.arange(40) == 20))
    >>> path = SampledPath(k, np.full(41, 1e-3), np.arange(41), np.ones(41, bool), 0.1)
    >>> find_slips(path)
    (Slip(frame=21, frames=-1, significance=inf),)

    """
    repeated = repeated_frames(path, held=held)
    stay = np.setdiff1d(np.arange(len(path.p)), [s.frame for s in repeated if s.frames < 0])
    rest = path.corrected(repeated).rows(stay)
    lost = missing_frames(rest)
    others = [*lost, *_scattered_slips(rest.corrected(lost))]
    moved = (replace(s, frame=int(stay[s.frame])) for s in others)
    return tuple(sorted([*repeated, *moved], key=lambda s: s.frame))


def correct_ticks(ticks: Ticks, found: Sequence[Slip]) -> tuple[Ticks, Mask]:
    """Correct ticks for doubled and missing frames.

    `ticks` (n,): frame intervals since the first frame. Returns `ticks` (n,), with gaps where frames are missing;
    `keep` (n,), false for doubled frames.

    Examples
    --------
    >>> ticks, keep = correct_ticks(np.arange(4), [Slip(2, 3, 9.0)])
    >>> ticks.tolist(), keep.tolist()
    ([0, 1, 5, 6], [True, True, True, True])

    """
    out, keep = np.array(ticks, dtype=np.int64), np.ones(len(ticks), np.bool_)
    for slip in found:
        out[slip.frame :] += slip.frames
        keep[slip.frame] &= not slip.doubled
    return out, keep


# --- repeated frames


def repeated_frames(path: SampledPath, *, held: bool) -> list[Slip]:
    """Frames that repeat the one before, in order; where `exact`, many come at even distances, or the mass sticks."""
    good = path.good & np.concatenate(([True], np.diff(path.ticks) == 1))
    steps = np.where(good[1:] & good[:-1], np.diff(path.p), np.nan)
    usual = usual_steps(np.abs(steps), USUAL_QUANTILE)
    still = (steps == 0.0) if path.exact else np.abs(steps) < MAX_STILL_STEP * usual
    often = bool(np.sum(still) > FREQUENT_SHARE * len(still))
    edges = np.flatnonzero(np.diff(np.concatenate(([False], still, [False]))))
    runs = [slice(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True) if b - a <= MAX_REPEATS]
    found = [run for run in runs if _moves_on_both_sides(steps, run, usual, ends=often)]
    if not found:
        return []
    noise = _step_noise(path, good, found)
    found = [run for run in found if usual[run.start] > MIN_STEP_SIGMAS * noise]
    if path.exact and often and len({run.stop - run.start for run in found[1:-1]}) > 1:
        return []
    disturbed = still | np.append(False, still[:-1]) | np.append(still[1:], False)
    clean = np.where(disturbed, np.nan, steps)
    return [slip for run in found for slip in _slips_of_repeats(steps, run, clean, held=held)]


def _moves_on_both_sides(steps: Array, run: slice, usual: Array, *, ends: bool) -> bool:
    """Whether the mass moves at full speed in one direction before and after; at the `ends` on one side."""
    near = [steps[i] for i in (run.start - 1, run.stop) if 0 <= i < len(steps)]
    if len(near) < (1 if ends else 2) or not np.all(np.isfinite(near)):
        return False
    return bool(min(np.abs(near)) > MIN_NEIGHBOUR_STEP * usual[run.start] and near[0] * near[-1] > 0)


def _step_noise(path: SampledPath, good: Mask, repeats: list[slice]) -> float:
    """Noise of a step without the repeats; at least the stated one."""
    keep = np.array(good)
    for run in repeats:
        keep[run.start + 1 : run.stop + 1] = False
    measured = noise_of_differences(np.diff(path.p[keep], 3), 3)
    return float(np.sqrt(2.0)) * max(float(np.median(path.sigma[keep])), measured)


def _slips_of_repeats(steps: Array, run: slice, clean: Array, *, held: bool) -> Iterator[Slip]:
    """Repeated frames as slips: as many as time allows in place of lost ones, the first of them put in.

    None where the step after them is no whole number of intervals.
    """
    count = run.stop - run.start
    near = clean[max(run.start - REACH_STEPS, 0) : run.stop + REACH_STEPS]
    known = near[np.isfinite(near)]
    ticks = count + 1 if held or run.stop == len(steps) else 1  # from the original to the frame after the last repeat
    if run.stop < len(steps) and len(known) >= MIN_KNOWN_STEPS:
        ratio = float(steps[run.stop] / np.median(known))
        ticks = max(round(ratio), 1)
        if abs(ratio - ticks) >= MAX_STEP_ERROR * ticks:
            return
    put_in = max(count + 1 - ticks, 0)
    for i in range(count):
        yield Slip(run.start + 1 + i, -1 if i < put_in else 0)
    if ticks > count + 1:
        yield Slip(run.stop + 1, ticks - count - 1)


# --- many missing frames


def missing_frames(path: SampledPath) -> list[Slip]:
    """Missing frames that the steps show, in order.

    Examples
    --------
    >>> k = np.delete(np.arange(60.0), [20, 24, 25])
    >>> p = k + 0.01 * np.random.default_rng(0).standard_normal(57)
    >>> path = SampledPath(p, np.full(57, 0.01), np.arange(57), np.ones(57, bool), 0.0)
    >>> [(slip.frame, slip.frames) for slip in missing_frames(path)]
    [(20, 1), (23, 2)]

    """
    rows = np.flatnonzero(path.good)
    if len(rows) < 2 * MIN_KNOWN_STEPS + 2:
        return []
    intervals = np.diff(path.ticks[rows])
    steps = np.diff(path.p[rows]) / intervals
    usual = usual_steps(steps)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = steps / usual
    is_long = (ratio > 1.5) & (ratio < MAX_MULTIPLE) & (np.abs(steps - usual) > path.smallest)
    found = [(i, _missing_in_step(steps, ratio, i)) for i in np.flatnonzero((intervals == 1) & is_long).tolist()]
    return [Slip(int(rows[i + 1]), missing, z) for i, (missing, z) in found if missing]


def _missing_in_step(steps: Array, ratio: Array, i: int) -> tuple[int, float]:
    """Number of frames missing in a step and its significance; 0 where it is no whole multiple of its neighbours."""
    near = np.arange(max(i - REACH_STEPS, 0), min(i + REACH_STEPS + 1, len(steps)))
    used = near[(np.abs(ratio[near] - 1) < SINGLE_STEP_TOLERANCE) & (near != i)]
    # both neighbouring steps are at least one interval: an outlier makes one long and one short step
    enough = min(np.sum(used < i), np.sum(used > i)) >= MIN_KNOWN_STEPS
    if not (enough and np.all(ratio[[i - 1, i + 1]] > 1 - SINGLE_STEP_TOLERANCE)):
        return 0, 0.0
    design = np.stack([np.ones(len(used)), used - i], axis=1)
    best, *_ = np.linalg.lstsq(design, steps[used], rcond=None)
    left = steps[used] - design @ best
    spread = max(float(robust_std(left)), float(np.std(left)))
    error = spread * float(np.sqrt(1.0 + np.linalg.inv(design.T @ design)[0, 0]))
    usual = float(best[0])
    multiple = round(steps[i] / usual)
    whole = abs(steps[i] - multiple * usual) < MAX_MULTIPLE_SIGMAS * error and error < MAX_MULTIPLE_ERROR * abs(usual)
    return (multiple - 1, abs(steps[i] - usual) / error) if whole else (0, 0.0)


# --- scattered doubled and missing frames


def _scattered_slips(path: SampledPath) -> tuple[Slip, ...]:
    """Doubled and missing frames that are scattered, in order; none where the target is too slow."""
    noise = _excess_variance(path)
    found: list[Slip] = []
    for window, degree in WINDOWS:
        if np.count_nonzero(path.good) < 2 * window + 2:
            break
        path = replace(path, window=window, degree=degree)
        refused: set[int] = set()
        while len(found) < MAX_SLIPS:
            slip = _strongest_slip(path, noise, refused)
            if slip is None:
                break
            found.append(slip)
            path = path.corrected([slip])
    return tuple(sorted(found, key=lambda s: s.frame))


def _excess_variance(path: SampledPath) -> float:
    """Variance of the positions over the stated one, at least 1, robust against faults everywhere.

    From the tenth percentile of the squared third differences (chi^2 with one degree of freedom: 0.0158).
    """
    binomial = np.array([1.0, -3.0, 3.0, -1.0])
    good = (np.convolve(path.good, np.ones(4), mode="valid") > 3.5) & (path.ticks[3:] - path.ticks[:-3] == 3)
    if good.sum() < 10:
        return 1.0
    variance = np.convolve(path.sigma**2, binomial**2, mode="valid")[good]
    ratio = np.diff(path.p, 3)[good] ** 2 / variance
    return max(1.5 * float(np.quantile(ratio, 0.1)) / 0.0158, 1.0)


def _scan_jumps(path: SampledPath) -> tuple[Array, Array, Array]:
    """Jump before every frame in frames, its standard deviation, and its significance; 0 where it is undetermined."""
    n = len(path.p)
    jump, error, z = np.zeros(n + 1), np.full(n + 1, np.inf), np.zeros(n + 1)
    for first in range(path.window, n - path.window + 1, FRAMES_AT_ONCE):
        at = np.arange(first, min(first + FRAMES_AT_ONCE, n - path.window + 1))
        jump[at], error[at], z[at] = _jumps_before(path, at)
    return jump, error, z


def _jumps_before(path: SampledPath, at: Ticks) -> tuple[Array, Array, Array]:
    """What `_scan_jumps` returns, before the frames `at`."""
    half = path.window
    index = at[:, None] + np.arange(-half, half)
    weight = np.where(path.good[index], 1 / path.sigma[index], 0.0)
    middle = 0.5 * (path.ticks[at] + path.ticks[at - 1])
    tau = (path.ticks[index] - middle[:, None]) / half
    after = np.broadcast_to(np.arange(-half, half) >= 0, tau.shape)
    design = np.stack([tau**k for k in range(path.degree + 1)] + [after], axis=2) * weight[:, :, None]
    value = np.nan_to_num(path.p[index] - path.p[at - 1][:, None]) * weight
    known = weight > 0
    enough = np.minimum(known[:, :half].sum(axis=1), known[:, half:].sum(axis=1)) >= path.enough
    normal = np.einsum("nij,nik->njk", design, design) + 1e-9 * np.eye(path.degree + 2)
    inverse = np.linalg.inv(normal)
    best = np.einsum("njk,nik,ni->nj", inverse, design, value)
    speed, spread = best[:, 1] / half, np.sqrt(inverse[:, -1, -1])
    usable = enough & (np.abs(speed) > 1e-6)
    with np.errstate(divide="ignore", invalid="ignore"):
        jump, error, z = best[:, -1] / speed, spread / np.abs(speed), np.abs(best[:, -1]) / spread
    return np.where(usable, jump, 0.0), np.where(usable, error, np.inf), np.where(usable, z, 0.0)


def _strongest_slip(path: SampledPath, noise: float, refused: set[int]) -> Slip | None:
    """The most significant slip that passes the comparison; frames that failed are added to `refused`."""
    jump, error, z = _scan_jumps(path)
    for i in np.argsort(-z)[: 4 * MAX_SLIPS].tolist():
        if z[i] < 5 * np.sqrt(noise):
            break
        if i in refused or error[i] > 3 * MAX_JUMP_ERROR:
            continue
        options = [s for s in _possible_slips(path, i, float(jump[i]), noise) if s]
        if options:
            return max(options, key=lambda s: s.significance)
        refused.add(i)
    return None


def _possible_slips(path: SampledPath, i: int, jump: float, noise: float) -> list[Slip | None]:
    """Possible slips near frame i; None where one fails the test."""
    lengths = {k for k in (int(np.floor(jump)), int(np.ceil(jump))) if 1 <= k <= MAX_MISSING_FRAMES}
    near = range(max(i - 1, path.window), min(i + 2, len(path.p) - path.window))
    return [_tested_slip(path, k, frames, noise) for k in near for frames in (*sorted(lengths), -1, 0)]


def _tested_slip(path: SampledPath, i: int, frames: int, noise: float) -> Slip | None:
    """The slip, if the shifted curve fits the frames around it better than every alternative."""
    part = np.arange(i - path.window, i + path.window + (frames <= 0))
    part = part[(part >= 0) & (part < len(path.p))]
    part = part[path.good[part]]
    left = part[part != i] if frames <= 0 else part
    if i not in part or min(np.sum(left < i), np.sum(left >= i)) < path.enough:
        return None
    if frames <= 0 and not _repeats_previous(path, i, noise):
        return None
    shifted = path.ticks + frames * (np.arange(len(path.p)) >= i)
    chi2, speed, error = _fit_curve(path, left, shifted, i)
    fits = chi2 < MAX_REDUCED_CHI2 * noise * max(len(left) - path.degree - 1, 1)
    moves = abs((frames or -1) * speed) > path.smallest and error * np.sqrt(noise) < MAX_JUMP_ERROR * abs(speed)
    if not (fits and moves):
        return None
    smooth = _fit_curve(path, part, path.ticks, i)[0]
    kink = min(_fit_curve(path, part, path.ticks, i, (at,))[0] for at in (-1.0, -0.5, 0.0, 0.5))
    free = _fit_curve(path, left, shifted, i, (0.0,), jump=True)[0]
    is_better = (
        smooth - chi2 > MIN_GAIN * noise
        and kink - chi2 > MIN_GAIN_OVER_KINK * noise
        and chi2 - free < MAX_LOSS_TO_FREE_JUMP * noise
    )
    return Slip(i, frames, float(np.sqrt((smooth - chi2) / noise))) if is_better else None


def _repeats_previous(path: SampledPath, i: int, noise: float) -> bool:
    """Whether frame i shows the target at the position of the frame before."""
    if not path.good[i - 1]:
        return False
    if path.exact:
        return bool(path.p[i] == path.p[i - 1])
    spread = np.hypot(path.sigma[i], path.sigma[i - 1]) * np.sqrt(noise)
    return bool(abs(path.p[i] - path.p[i - 1]) < 4 * spread)


def _fit_curve(
    path: SampledPath, part: Ticks, ticks: Ticks, i: int, kinks: tuple[float, ...] = (), jump: bool = False
) -> tuple[float, float, float]:
    """Chi^2 of a smooth curve through the frames `part`, with kinks (frames from i) or a jump at i.

    Also its speed there, px per tick, and the standard deviation of a possible jump.
    """
    tau = (ticks[part] - ticks[i]).astype(np.float64)
    columns = [(tau / path.window) ** k for k in range(path.degree + 1)]
    columns += [np.maximum(tau - at, 0.0) / path.window for at in kinks]
    step = (part >= i).astype(np.float64)
    columns += [step] if jump else []
    design = np.stack(columns, axis=1) / path.sigma[part, None]
    value = (path.p[part] - path.p[part[0]]) / path.sigma[part]
    best, *_ = np.linalg.lstsq(design, value, rcond=None)
    scaled = step / path.sigma[part]
    perpendicular = scaled - design @ np.linalg.lstsq(design, scaled, rcond=None)[0]
    error = 1 / np.sqrt(max(float(perpendicular @ perpendicular), 1e-12))
    return float(np.sum((value - design @ best) ** 2)), float(best[1] / path.window), error
