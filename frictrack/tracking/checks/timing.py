"""Doubled and missing frames that no time stamp tells of, found from the motion itself.

The position before and after must be one smooth curve, read at times that are off by a whole number of frames. A
collision bends the curve and a stop ends it; neither shifts it. Every candidate is therefore judged, on the frames
around it, against the undisturbed curve, a kink, and a jump and a kink of any size.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from frictrack.records import Array, Mask, Track

WINDOWS = ((8, 3), (4, 2))  # frames on either side and degree of the curve; short ones where faults crowd
LEAST_JUMP = 0.1  # px; tracking faults may be as large
PRECISE = 0.12  # frames: standard deviation of a jump from which whole frames can be told
MOST_MISSING = 200
MOST_SLIPS = 100
# Differences of chi^2 in units of the noise. 49 is seven standard deviations: no false alarm in 10^5 frames.
BETTER, THAN_KINK, THAN_FREE, FIT = 49.0, 36.0, 16.0, 3.0

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
class _Path:
    """Position along the course (n,) px with its standard deviation, at whole ticks, and the frames that count."""

    p: Array
    sigma: Array
    ticks: Ticks
    good: Mask
    window: int
    degree: int

    @property
    def enough(self) -> int:
        """Frames that must be known on either side."""
        return self.window - self.window // 3 - 1


def slips(track: Track) -> tuple[Slip, ...]:
    """Doubled and missing frames of a track, in order; none are found where the target is too slow to tell."""
    path = _path(track)
    noise = _noise(path)
    found: list[Slip] = []
    for window, degree in WINDOWS:
        if np.count_nonzero(path.good) < 2 * window + 2:
            break
        path = replace(path, window=window, degree=degree)
        refused: set[int] = set()
        while len(found) < MOST_SLIPS:
            slip = _strongest(path, noise, refused)
            if slip is None:
                break
            found.append(slip)
            path = _applied(path, slip)
    return tuple(sorted(found, key=lambda s: s.frame))


def corrected(ticks: Ticks, found: Sequence[Slip]) -> tuple[Ticks, Mask]:
    """Ticks (n,) with gaps where frames are missing, and which frames to keep: doubled ones are left out."""
    out, keep = np.array(ticks, dtype=np.int64), np.ones(len(ticks), np.bool_)
    for slip in found:
        out[slip.frame :] += slip.frames
        keep[slip.frame] &= not slip.doubled
    return out, keep


def timing_note(found: Sequence[Slip]) -> tuple[str, ...]:
    """The slips in words."""
    doubled = [s.frame for s in found if s.doubled]
    missing = [s for s in found if not s.doubled]
    notes = []
    if doubled:
        notes.append(f"{_count(len(doubled), 'frame')} doubled, told by the motion: {_listed(doubled)}")
    if missing:
        total = sum(s.frames for s in missing)
        notes.append(
            f"{_count(total, 'frame')} missing, told by the motion: before {_listed([s.frame for s in missing])}"
        )
    return tuple(notes)


def _count(n: int, what: str) -> str:
    return f"{n} {what} is" if n == 1 else f"{n} {what}s are"


def _listed(numbers: list[int]) -> str:
    more = f" and {len(numbers) - 8} more" if len(numbers) > 8 else ""
    return ("frame " if len(numbers) == 1 else "frames ") + ", ".join(str(n) for n in numbers[:8]) + more


def _path(track: Track) -> _Path:
    """The track along the line on which it moves most."""
    found = track.found & np.isfinite(track.y_px) & np.isfinite(track.sigma_px)
    at = np.stack([track.x_px, track.y_px], axis=1)
    if not found.any():
        return _Path(at[:, 0], at[:, 0], np.arange(len(at)), found, *WINDOWS[0])
    _, _, axes = np.linalg.svd(at[found] - at[found].mean(axis=0), full_matrices=False)
    sigma = np.hypot(axes[0, 0] * track.sigma_px, axes[0, 1] * track.sigma_y_px)
    ticks = np.rint((track.t - track.t[0]) / np.median(np.diff(track.t))).astype(np.int64)
    return _Path(at @ axes[0], np.maximum(sigma, 1e-4), ticks, found, *WINDOWS[0])


def _applied(path: _Path, slip: Slip) -> _Path:
    ticks, keep = corrected(path.ticks, [slip])
    return replace(path, ticks=ticks, good=path.good & keep)


def _noise(path: _Path) -> float:
    """Variance of the positions over what the tracker says, at least 1, although faults may be everywhere.

    From the tenth smallest of the squared third differences (chi^2 with one degree of freedom: 0.0158).
    """
    four = np.arange(len(path.p) - 3)[:, None] + np.arange(4)
    binomial = np.array([1.0, -3.0, 3.0, -1.0])
    good = np.all(path.good[four], axis=1) & (np.ptp(path.ticks[four], axis=1) == 3)
    if good.sum() < 10:
        return 1.0
    ratio = (path.p[four] @ binomial)[good] ** 2 / (path.sigma[four] ** 2 @ binomial**2)[good]
    return max(1.5 * float(np.quantile(ratio, 0.1)) / 0.0158, 1.0)


def _scan(path: _Path) -> tuple[Array, Array, Array]:
    """For the gap before every frame: jump there in frames, its standard deviation, its significance.

    Where nothing can be said, the jump is 0.
    """
    n, half = len(path.p), path.window
    at = np.arange(half, n - half + 1)
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
    sure = enough & (np.abs(speed) > 1e-6)
    jump, error, z = np.zeros(n + 1), np.full(n + 1, np.inf), np.zeros(n + 1)
    jump[at[sure]] = best[sure, -1] / speed[sure]
    error[at[sure]] = spread[sure] / np.abs(speed[sure])
    z[at[sure]] = np.abs(best[sure, -1]) / spread[sure]
    return jump, error, z


def _strongest(path: _Path, noise: float, refused: set[int]) -> Slip | None:
    """The most significant slip that stands the comparison; frames that did not are added to `refused`."""
    jump, error, z = _scan(path)
    for i in np.argsort(-z)[: 4 * MOST_SLIPS].tolist():
        if z[i] < 5 * np.sqrt(noise):
            break
        if i in refused or error[i] > 3 * PRECISE:
            continue
        options = [s for s in _judged(path, i, float(jump[i]), noise) if s]
        if options:
            return max(options, key=lambda s: s.significance)
        refused.add(i)
    return None


def _judged(path: _Path, i: int, jump: float, noise: float) -> list[Slip | None]:
    """What may have happened near frame i, each a slip or None where it does not stand."""
    lengths = {k for k in (int(np.floor(jump)), int(np.ceil(jump))) if 1 <= k <= MOST_MISSING}
    near = range(max(i - 1, path.window), min(i + 2, len(path.p) - path.window))
    return [_judge(path, k, frames, noise) for k in near for frames in (*sorted(lengths), -1, 0)]


def _judge(path: _Path, i: int, frames: int, noise: float) -> Slip | None:
    """The slip, if on the frames around it the shifted curve is better than all that it may be mistaken for."""
    part = np.arange(i - path.window, i + path.window + (frames <= 0))
    part = part[(part >= 0) & (part < len(path.p))]
    part = part[path.good[part]]
    left = part[part != i] if frames <= 0 else part
    if i not in part or min(np.sum(left < i), np.sum(left >= i)) < path.enough:
        return None
    if frames <= 0 and not _repeats(path, i, noise):
        return None
    shifted = path.ticks + frames * (np.arange(len(path.p)) >= i)
    chi2, speed, error = _curve(path, left, shifted, i)
    fits = chi2 < FIT * noise * max(len(left) - path.degree - 1, 1)
    moves = abs((frames or -1) * speed) > LEAST_JUMP and error * np.sqrt(noise) < PRECISE * abs(speed)
    if not (fits and moves):
        return None
    plain = _curve(path, part, path.ticks, i)[0]
    kink = min(_curve(path, part, path.ticks, i, (at,))[0] for at in (-1.0, -0.5, 0.0, 0.5))
    free = _curve(path, left, shifted, i, (0.0,), jump=True)[0]
    stands = plain - chi2 > BETTER * noise and kink - chi2 > THAN_KINK * noise and chi2 - free < THAN_FREE * noise
    return Slip(i, frames, float(np.sqrt((plain - chi2) / noise))) if stands else None


def _repeats(path: _Path, i: int, noise: float) -> bool:
    """Whether frame i shows the target where the frame before it does."""
    if not path.good[i - 1]:
        return False
    spread = np.hypot(path.sigma[i], path.sigma[i - 1]) * np.sqrt(noise)
    return bool(abs(path.p[i] - path.p[i - 1]) < 4 * spread)


def _curve(
    path: _Path, part: Ticks, ticks: Ticks, i: int, kinks: tuple[float, ...] = (), jump: bool = False
) -> tuple[float, float, float]:
    """Chi^2 of a smooth curve through the frames `part`, with kinks (frames from i) or a jump at i.

    Also its speed there, px per tick, and the standard deviation of a jump that might be there.
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
    alone = scaled - design @ np.linalg.lstsq(design, scaled, rcond=None)[0]
    error = 1 / np.sqrt(max(float(alone @ alone), 1e-12))
    return float(np.sum((value - design @ best) ** 2)), float(best[1] / path.window), error
