"""Find doubled and missing frames from the motion itself, where no time stamp shows them.

The positions before and after must lie on one smooth curve, read at times that are off by a whole number of frames. A
collision bends the curve and a stop ends it; neither shifts it. Every candidate is therefore compared, on the frames
around it, with the undisturbed curve, with a kink, and with a jump and kink of any size.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from frictrack.records import Array, Mask
from frictrack.sampling.missing_frames import missing_frames
from frictrack.sampling.repeated_frames import RepeatedFrames, repeats

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
    significance: float  # standard deviations

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
    exact: bool = False  # a frame that repeats another is the same to the last digit
    window: int = WINDOWS[0][0]
    degree: int = WINDOWS[0][1]

    @property
    def enough(self) -> int:
        """Frames that must be known on either side."""
        return self.window - self.window // 3 - 1


def find_slips(path: SampledPath, *, held: bool = False) -> tuple[Slip, ...]:
    """Find doubled and missing frames, in any pattern.

    Repeated frames are found first, so that the others are judged on an undisturbed path.

    Parameters
    ----------
    path : SampledPath
        Positions of all frames.
    held : bool
        As in `repeats`.

    Returns
    -------
    tuple of Slip
        In order.

    """
    consecutive = np.concatenate(([True], np.diff(path.ticks) == 1))
    repeated = [
        slip
        for one in repeats(path.p, path.good & consecutive, path.sigma, held=held, exact=path.exact)
        for slip in _slips_of(one)
    ]
    ticks, keep = correct_ticks(path.ticks, repeated)
    stay = np.setdiff1d(np.arange(len(path.p)), [s.frame for s in repeated if s.frames < 0])
    rest = SampledPath(path.p[stay], path.sigma[stay], ticks[stay], (path.good & keep)[stay], path.smallest, path.exact)
    lost = [
        Slip(one.at, one.missing, one.significance)
        for one in missing_frames(rest.p, rest.ticks, rest.good, rest.smallest)
    ]
    rest = replace(rest, ticks=correct_ticks(rest.ticks, lost)[0])
    others = [replace(s, frame=int(stay[s.frame])) for s in (*lost, *_scattered_slips(rest))]
    return tuple(sorted([*repeated, *others], key=lambda s: s.frame))


def _slips_of(repeat: RepeatedFrames) -> Iterator[Slip]:
    """Repeated frames as slips: as many as time allows in place of lost ones, the first of them put in."""
    frames = range(repeat.first, repeat.last + 1)
    put_in = max(len(frames) + 1 - repeat.ticks, 0)
    for i, frame in enumerate(frames):
        yield Slip(frame, -1 if i < put_in else 0, np.inf)
    if repeat.ticks > len(frames) + 1:
        yield Slip(repeat.last + 1, repeat.ticks - len(frames) - 1, np.inf)


def _scattered_slips(path: SampledPath) -> tuple[Slip, ...]:
    """Doubled and missing frames that are scattered, in order; none where the target is too slow."""
    noise = _noise(path)
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
            path = _applied(path, slip)
    return tuple(sorted(found, key=lambda s: s.frame))


def correct_ticks(ticks: Ticks, found: Sequence[Slip]) -> tuple[Ticks, Mask]:
    """Correct ticks for doubled and missing frames.

    Parameters
    ----------
    ticks : array of int (n,)
        Frame intervals since the first frame.
    found : sequence of Slip
        Faults of the time base.

    Returns
    -------
    ticks : array of int (n,)
        With gaps where frames are missing.
    keep : array of bool (n,)
        False for doubled frames.

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


def _applied(path: SampledPath, slip: Slip) -> SampledPath:
    ticks, keep = correct_ticks(path.ticks, [slip])
    return replace(path, ticks=ticks, good=path.good & keep)


def _noise(path: SampledPath) -> float:
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
