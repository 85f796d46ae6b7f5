"""Describe over which axis a misfit repeats from run to run, how certain that is, and what it means."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from frictrack.axes import AXES

MIN_SHARE, ALPHA = 0.5, 0.01  # share of the misfit that the other runs must predict, and its significance level
MIN_EXPLAINED = 0.99  # of the gain of separate forces, above which a common one may be most of the misfit
MIN_EVIDENCE = 10.0  # twice the log likelihood ratio that decides

AXIS_TEXTS = {
    "x": ("at the same place", "it depends on the position along the course"),
    "t": ("at the same time since release", "it depends on the time since release, not on the place"),
    "v": ("at the same speed", "it depends on the speed, so the friction law itself is wrong"),
    "phase": ("with one frequency, at a different phase in every run", "something vibrates"),
}


@dataclass(frozen=True)
class AxisRepeatability:
    """How well the misfit repeats over one axis.

    Parameters
    ----------
    axis
        "x", "t", "v" or "phase".
    share
        Share of the misfit that the other runs predict.
    p
        p-value of that share.
    runs, of
        Number of runs in which it repeats, and of all runs.
    frequency
        Frequency, Hz, for "phase".
    evidence
        Twice the log likelihood ratio against a force of its own in every run.
    explained
        Gain in likelihood over that of a force of its own in every run.

    """

    axis: str
    share: float
    p: float
    runs: int
    of: int
    frequency: float | None = None  # Hz, of the phase
    evidence: float = 0.0
    explained: float = 0.0

    @property
    def holds(self) -> bool:
        """Whether the misfit repeats: a common force is decisively more likely, or the other runs predict most of it.

        A strong narrow force is followed more closely by a curve per run than by a common one, but what runs predict
        of each other is common to them.
        """
        return self.evidence > MIN_EVIDENCE or (self.share > MIN_SHARE and self.p < ALPHA)

    @property
    def mostly(self) -> bool:
        """Whether a common force explains nearly all that a force of its own in every run does."""
        return self.explained > MIN_EXPLAINED

    def summary(self) -> dict[str, Any]:
        """Return the JSON of one axis."""
        found = {"axis": self.axis, "share": round(self.share, 4), "p": self.p, "runs": self.runs, "of": self.of}
        found |= {"evidence": round(self.evidence, 1), "holds": self.holds, "mostly": self.mostly}
        return found | ({} if self.frequency is None else {"frequency": self.frequency})


def sort_axes(axes: Sequence[AxisRepeatability]) -> list[AxisRepeatability]:
    """Sort axes by likelihood; those between which the likelihood does not decide, by the share predicted."""
    undecided = _undecided(axes)
    return sorted(axes, key=lambda a: (not a.holds, a not in undecided, -a.share if a in undecided else -a.evidence))


def _undecided(axes: Sequence[AxisRepeatability]) -> list[AxisRepeatability]:
    """Axes between which and the most likely one the likelihood does not decide."""
    top = max(a.evidence for a in axes)
    return [a for a in axes if a.evidence > top - MIN_EVIDENCE]


def describe_axes(axes: Sequence[AxisRepeatability]) -> str:
    """Describe the result as sentences."""
    best = axes[0]
    if not best.holds:
        if best.mostly:
            share = f"{100 * best.explained:.1f} %" if best.explained < 0.9995 else "nearly all"
            return (
                f"A force that depends on {AXES[best.axis].name} alone explains {share} of what a force of its own in "
                "every run explains: most of the misfit repeats, or the runs overlap too little to tell."
            )
        if best.evidence < -MIN_EVIDENCE:
            return "The misfit does not repeat from run to run: no place, time, speed or frequency is common to it."
        return "These runs do not determine whether the misfit repeats from run to run: they show too little of it."
    where, why = AXIS_TEXTS[best.axis]
    if best.axis == "phase" and best.frequency is not None:
        where = f"{where} ({best.frequency:.3g} Hz)"
    how_often = f" in {best.runs} of {best.of} runs" if best.runs > 1 else ""
    words = f"The misfit repeats {where}{how_often}: {why}."
    others = [a.axis for a in _undecided(axes) if a is not best]
    if others:
        names = " or ".join(AXES[name].name for name in others)
        words += f" These runs hardly distinguish it from the same {names}; a run at another speed would."
    return words
