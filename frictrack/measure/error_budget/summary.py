"""The error budget of one run: sources, and its summary in sentences, such as what would halve the error."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from frictrack.base.number_format import format_number, format_plus_minus

NOISE, FILTER, SCALE, MASS, TIME = "pixel noise", "filter", "scale", "mass", "time base"
LOCKING, SHAKE, DRIVE, DRIVE_CLOCK, SENSOR = "peak locking", "camera shake", "drive sensor", "drive clock", "load cell"
EACH_FRAME, ALL_FRAMES, ALL_RUNS = "each frame", "all frames", "all runs"  # what shares one and the same error


@dataclass(frozen=True)
class Contribution:
    """One source of error of the friction force.

    Parameters
    ----------
    source
        Its name.
    size, unit
        Its standard deviation and unit; None if not known.
    known_from
        How the size is known.
    frame_N
        Effect on the force of one frame, rms over the free section, N; None if the size is not known.
    mean_N
        Effect on the mean force over the free section, N; None if the size is not known.
    common
        What shares one and the same error: each frame, all frames of a run, or all runs.

    """

    source: str
    size: float | None
    unit: str
    known_from: str
    frame_N: float | None
    mean_N: float | None
    common: str = EACH_FRAME

    def summary(self) -> dict[str, Any]:
        """Return the JSON of the row, without its shares."""
        return {"told" if key == "known_from" else key: value for key, value in vars(self).items()}


MIN_REMAINING_SHARE = 0.95  # of an error: a step that leaves more is not worth taking
NOISE_FACTOR_TWICE_FRAMES = 2.0**0.5  # twice the frames average the noise as much as noise lower by this factor
FILTERED_SOURCES = (NOISE, FILTER)  # what the smoother trades against each other
PIXEL_SOURCES = (LOCKING, SHAKE)  # known in pixels, so they scale with the pixel pitch


@dataclass(frozen=True)
class Budget:
    """Error budget of the friction force of one run.

    Parameters
    ----------
    run
        Name of the run.
    force_N
        Mean of the resisting force over the free section, N.
    rows
        All sources of error.
    noise_reduction
        By factor of noise reduction: the factors on the frame and the mean error from noise and filter.
    filmed
        Whether the positions come from a film; those of a table have no pixels.

    """

    run: str
    force_N: float
    rows: tuple[Contribution, ...]
    noise_reduction: dict[float, tuple[float, float]] = field(default_factory=dict)
    filmed: bool = True

    @property
    def frame_N(self) -> float:
        """Standard deviation of the friction force of one frame, rms over the free section, N."""
        return _root_sum_square(row.frame_N for row in self.rows)

    @property
    def mean_N(self) -> float:
        """Standard deviation of the mean friction force, N."""
        return _root_sum_square(row.mean_N for row in self.rows)

    def row(self, source: str) -> Contribution | None:
        """Find the row of a source, such as "scale"; None if the budget has none."""
        return next((row for row in self.rows if row.source == source), None)

    def summary(self) -> dict[str, Any]:
        """Return the JSON: rows with their shares of both variances, the total last, and sentences."""
        total = Contribution("total", None, "", "", self.frame_N, self.mean_N, "")
        return {
            "force_N": self.force_N,
            "rows": [row.summary() | self._shares(row) for row in (*self.rows, total)],
            "says": list(_sentences(self)),
        }

    def _shares(self, row: Contribution) -> dict[str, float | None]:
        parts = (("frame", row.frame_N, self.frame_N), ("mean", row.mean_N, self.mean_N))
        return {f"share_{k}": None if part is None or not total else (part / total) ** 2 for k, part, total in parts}


def _root_sum_square(parts: Iterable[float | None]) -> float:
    """Root of the sum of squares of the parts that are known."""
    return float(np.sqrt(sum(p**2 for p in parts if p is not None)))


def _sentences(budget: Budget) -> Iterator[str]:
    """Errors of mean and frame with their largest source, what would halve them, and what is not known."""
    if not budget.mean_N or not budget.frame_N:
        yield "no error of this run is known"
        return
    share = f" ({100 * budget.mean_N / abs(budget.force_N):.2g} %)" if budget.force_N else ""
    yield (
        f"mean friction force: {format_plus_minus(budget.force_N, budget.mean_N)} N{share}, "
        f"{_largest_source(budget, 'mean_N')}; standard deviation of a single frame: "
        f"{format_number(budget.frame_N, 2)} N, {_largest_source(budget, 'frame_N')}"
    )
    if budget.noise_reduction:
        yield _how_to_halve(budget)
        yield _effect_of_better_camera(budget)
    unknown = [row.source for row in budget.rows if row.frame_N is None]
    if unknown:
        yield f"not counted because unknown: {', '.join(unknown)}"


def _largest_source(budget: Budget, key: str) -> str:
    """Name the largest contribution to the mean or to a frame, with its share of the variance."""
    row = max(budget.rows, key=lambda r: getattr(r, key) or 0.0)
    share = (getattr(row, key) / getattr(budget, key)) ** 2
    return f"largest source {_source_text(row.source)} ({100 * share:.0f} %)"


def _source_text(source: str) -> str:
    """A source as part of a sentence."""
    without_article = {FILTER: "signal lost in the filter", NOISE: NOISE, LOCKING: LOCKING}
    return without_article.get(source, f"the {source}")


def _how_to_halve(budget: Budget) -> str:
    """Say which single step would halve the error of the mean."""
    steps = list(_halving_steps(budget))
    if steps:
        return f"to halve the error of the mean: {' or '.join(steps)}"
    first, second, *_ = sorted(budget.rows, key=lambda row: -(row.mean_N or 0.0))
    if not second.mean_N:
        return f"even {_finer(budget, max(budget.noise_reduction))} would not halve the error of the mean"
    return (
        "no single step would halve the error of the mean: "
        f"{_source_text(first.source)} and {_source_text(second.source)} both count"
    )


def _halving_steps(budget: Budget) -> Iterator[str]:
    """Single steps that would halve the error of the mean, largest source first."""
    half = budget.mean_N / 2.0
    for row in sorted(budget.rows, key=lambda row: -(row.mean_N or 0.0)):
        others = _root_sum_square(other.mean_N for other in budget.rows if other is not row)
        if row.mean_N and row.source in IMPROVEMENTS and others < half:
            yield IMPROVEMENTS[row.source](row, row.mean_N / float(np.sqrt(half**2 - others**2)))
    for times in sorted(budget.noise_reduction):
        if times > NOISE_FACTOR_TWICE_FRAMES and _errors_after(budget, times)[1] <= half:
            yield _finer(budget, times)
            return


def _finer(budget: Budget, times: float) -> str:
    """Name the step that lowers the noise by a factor: more pixels in a film, more precise positions in a table."""
    if budget.filmed:
        return f"{times:.0f} times the pixels per mm" if times != 2.0 else "twice the pixels per mm"
    return f"positions {times:.0f} times as precise" if times != 2.0 else "positions twice as precise"


def _effect_of_better_camera(budget: Budget) -> str:
    """Say what twice the frame rate, and noise of half the size, would do."""
    rate = "frame rate (at the same noise per frame)" if budget.filmed else "sampling rate (at the same noise per row)"
    steps = ((f"twice the {rate}", NOISE_FACTOR_TWICE_FRAMES), (_finer(budget, 2.0), 2.0))
    after = {what: _errors_after(budget, times) for what, times in steps}
    if all(_is_no_help(budget, errors) for errors in after.values()):
        rate, finer = ("frame rate", "more pixels per mm") if budget.filmed else ("sampling rate", "less noise")
        return f"neither a higher {rate} nor {finer} would help"
    return "; ".join(
        f"{what} would not help"
        if _is_no_help(budget, (frame, mean))
        else f"{what} would leave {format_number(mean, 2)} N in the mean and {format_number(frame, 2)} N in a frame"
        for what, (frame, mean) in after.items()
    )


def _is_no_help(budget: Budget, errors: tuple[float, float]) -> bool:
    return errors[0] > MIN_REMAINING_SHARE * budget.frame_N and errors[1] > MIN_REMAINING_SHARE * budget.mean_N


def _errors_after(budget: Budget, times: float) -> tuple[float, float]:
    """Errors of a frame and of the mean, N, with `times` the pixels per mm, or with twice the frame rate."""
    frame, mean = budget.noise_reduction[times]
    pixel_factor = 1.0 if times == NOISE_FACTOR_TWICE_FRAMES else 1.0 / times

    def remaining(key: str, noise_factor: float) -> float:
        factors = dict.fromkeys(FILTERED_SOURCES, noise_factor) | dict.fromkeys(PIXEL_SOURCES, pixel_factor)
        return _root_sum_square(factors.get(row.source, 1.0) * (getattr(row, key) or 0.0) for row in budget.rows)

    return remaining("frame_N", frame), remaining("mean_N", mean)


def _times(factor: float) -> str:
    return f"{factor:.2g} times"


IMPROVEMENTS: dict[str, Callable[[Contribution, float], str]] = {
    SCALE: lambda row, f: f"a ruler {_times(f)} as long (the scale known to {(row.size or 0.0) / f:.2g} %)",
    MASS: lambda row, f: f"weighing to {(row.size or 0.0) / f:.2g} g",
    TIME: lambda row, f: f"a frame rate known to {(row.size or 0.0) / f:.2g} %",
    DRIVE: lambda row, f: f"a drive sensor {_times(f)} quieter",
    DRIVE_CLOCK: lambda row, f: f"the drive's clock known to {(row.size or 0.0) / f:.2g} ms",
    SHAKE: lambda row, f: f"a steadier camera, or a fixed reference that is seen {_times(f)} better",
    LOCKING: lambda row, f: f"peak locking {_times(f)} smaller (a coarser pattern on the target)",
}  # by source: the improvement by a factor f
