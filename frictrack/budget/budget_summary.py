"""The budget in words: what counts most, and what would halve it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from frictrack.budget.error_budget import Budget, Contribution

MOSTLY = 0.5  # share of a variance
HARDLY = 0.95  # of the total is left: not worth doing
RATE = 2.0**0.5  # noise less by this is as good as twice the frames
SMOOTHED = ("pixel noise", "filter")
PICTURED = ("peak locking", "camera shake")  # known in pixels: they go with the size of one


def sentences(found: Budget) -> Iterator[str]:
    """What the mean and a frame are worth, mostly because of what, what would halve it, and what is not known."""
    if not found.mean_N or not found.frame_N:
        yield "nothing is known of the errors of this run"
        return
    share = f", {100 * found.mean_N / abs(found.force_N):.2g} %," if found.force_N else ""
    mean = _newtons(found.force_N, found.mean_N)
    yield (
        f"the mean friction force of {mean} N is known to {_few(found.mean_N)} N{share} "
        f"{_mostly(found, 'mean_N')}; a single frame to {_few(found.frame_N)} N, {_mostly(found, 'frame_N')}"
    )
    if found.finer:
        yield _halved(found)
        yield _faster(found)
    unknown = [row.source for row in found.rows if row.frame_N is None]
    if unknown:
        yield f"not counted, because nothing is known of {'it' if len(unknown) == 1 else 'them'}: {', '.join(unknown)}"


def _newtons(force: float, sigma: float) -> str:
    """A force to the second digit of its deviation."""
    return f"{force:.{max(0, 1 - int(np.floor(np.log10(sigma))))}f}"


def _few(value: float) -> str:
    """Two digits, without an exponent where that reads."""
    return f"{value:.2g}" if value < 10.0 else f"{value:.0f}"


def _mostly(found: Budget, key: str) -> str:
    """The largest contribution to the mean or to a frame."""
    row = max(found.rows, key=lambda r: getattr(r, key) or 0.0)
    share = (getattr(row, key) / getattr(found, key)) ** 2
    return f"{'mostly' if share > MOSTLY else 'first of all'} because of {_the(row.source)} ({100 * share:.0f} %)"


def _the(source: str) -> str:
    """A source as part of a sentence."""
    plain = {"filter": "signal lost in the filter", "pixel noise": "pixel noise", "peak locking": "peak locking"}
    return plain.get(source, f"the {source}")


def _halved(found: Budget) -> str:
    """What would halve the error of the mean."""
    ways = list(_ways(found))
    if ways:
        return f"half the error of the mean would take {' or '.join(ways)}"
    first, second, *_ = sorted(found.rows, key=lambda row: -(row.mean_N or 0.0))
    if not second.mean_N:
        return f"even {max(found.finer):.0f} times the pixels per mm would not halve the error of the mean"
    return (
        f"no single step would halve the error of the mean: {_the(first.source)} and {_the(second.source)} both count"
    )


def _ways(found: Budget) -> Iterator[str]:
    """Single steps that would do."""
    half = found.mean_N / 2.0
    for row in sorted(found.rows, key=lambda row: -(row.mean_N or 0.0)):
        rest = _rest(found, "mean_N", row.source)
        if row.mean_N and row.source in HOW and rest < half:
            yield HOW[row.source](row, row.mean_N / float(np.sqrt(half**2 - rest**2)))
    enough = [times for times in sorted(found.finer) if times > RATE and _with(found, times)[1] <= half]
    if enough:
        yield f"{enough[0]:.0f} times the pixels per mm"


def _faster(found: Budget) -> str:
    """What twice the frame rate would do, and twice the pixels."""
    steps = (("twice the frame rate (at the same noise of a frame)", RATE), ("twice the pixels per mm", 2.0))
    after = {what: _with(found, times) for what, times in steps}
    if all(_hardly(found, left) for left in after.values()):
        return "neither a higher frame rate nor more pixels per mm would help"
    return "; ".join(
        f"{what} would not help"
        if _hardly(found, (frame, mean))
        else f"{what} would leave {_few(mean)} N in the mean and {_few(frame)} N in a frame"
        for what, (frame, mean) in after.items()
    )


def _hardly(found: Budget, left: tuple[float, float]) -> bool:
    return left[0] > HARDLY * found.frame_N and left[1] > HARDLY * found.mean_N


def _with(found: Budget, times: float) -> tuple[float, float]:
    """Errors of a frame and of the mean, N, with so many times the pixels per mm; `RATE`: twice the frames."""
    frame, mean = found.finer[times]
    factors = {"frame_N": frame, "mean_N": mean}
    fewer = 1.0 if times == RATE else 1.0 / times
    left = [
        np.sqrt(
            (factor * _part(found, key, SMOOTHED)) ** 2
            + (fewer * _part(found, key, PICTURED)) ** 2
            + _rest(found, key, *SMOOTHED, *PICTURED) ** 2
        )
        for key, factor in factors.items()
    ]
    return float(left[0]), float(left[1])


def _part(found: Budget, key: str, sources: tuple[str, ...]) -> float:
    """Some sources together."""
    return _rest(found, key, *(row.source for row in found.rows if row.source not in sources))


def _rest(found: Budget, key: str, *without: str) -> float:
    """All but some sources together."""
    return float(np.sqrt(sum((getattr(r, key) or 0.0) ** 2 for r in found.rows if r.source not in without)))


def _times(factor: float) -> str:
    return f"{factor:.2g} times"


HOW: dict[str, Callable[[Contribution, float], str]] = {
    "scale": lambda row, f: f"a ruler {_times(f)} as long (the scale known to {(row.size or 0.0) / f:.2g} %)",
    "mass": lambda row, f: f"weighing to {(row.size or 0.0) / f:.2g} g",
    "time base": lambda row, f: f"a frame rate known to {(row.size or 0.0) / f:.2g} %",
    "drive sensor": lambda row, f: f"a drive sensor {_times(f)} quieter",
    "drive clock": lambda row, f: f"the drive's clock known to {(row.size or 0.0) / f:.2g} ms",
    "camera shake": lambda row, f: f"a steadier camera, or a fixed reference that is seen {_times(f)} better",
    "peak locking": lambda row, f: f"peak locking {_times(f)} smaller (a coarser pattern on the target)",
}
