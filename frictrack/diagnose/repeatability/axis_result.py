"""An axis along which a failure may repeat, how sure that is, and what it means for a person."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from frictrack.axes import AXES

MIN_SHARE, ALPHA = 0.5, 0.01  # share of the misfit that the other runs predict, and its chance, for a failure to repeat
MIN_EVIDENCE = 10.0  # of evidence, twice the log of a likelihood ratio: a lesser one decides nothing

AXIS_TEXTS = {
    "x": ("at the same place", "it belongs to the course"),
    "t": ("at the same time since release", "it belongs to what happens since release, not to the place"),
    "v": ("at the same speed", "it belongs to the law of friction itself"),
    "phase": ("with one frequency, each run at a phase of its own", "something vibrates"),
}


@dataclass(frozen=True)
class AxisRepeatability:
    """How well the failure repeats along one axis: share of the misfit foretold, p, and in how many of the runs.

    `evidence` is that against a force that every run has for itself, twice the log of the likelihood ratio.
    """

    axis: str
    share: float
    p: float
    runs: int
    of: int
    frequency: float | None = None  # Hz, of the phase
    evidence: float = 0.0

    @property
    def holds(self) -> bool:
        """Whether the failure repeats: a common force is decisively likelier, or the other runs predict most of it.

        A strong and narrow force is followed closer by a curve of every run than by a common one, but what runs predict
        of each other is common to them.
        """
        return self.evidence > MIN_EVIDENCE or (self.share > MIN_SHARE and self.p < ALPHA)

    def summary(self) -> dict[str, Any]:
        """JSON of one axis."""
        found = {"axis": self.axis, "share": round(self.share, 4), "p": self.p, "runs": self.runs, "of": self.of}
        found |= {"evidence": round(self.evidence, 1), "holds": self.holds}
        return found | ({} if self.frequency is None else {"frequency": self.frequency})


def sort_axes(axes: Sequence[AxisRepeatability]) -> list[AxisRepeatability]:
    """The likeliest first; of those between which the likelihood does not decide, the one that foretells most."""
    near = _near(axes)
    return sorted(axes, key=lambda a: (not a.holds, a not in near, -a.share if a in near else -a.evidence))


def _near(axes: Sequence[AxisRepeatability]) -> list[AxisRepeatability]:
    """Those between which and the likeliest one the likelihood does not decide, itself among them."""
    top = max(a.evidence for a in axes)
    return [a for a in axes if a.evidence > top - MIN_EVIDENCE]


def describe_axes(axes: Sequence[AxisRepeatability]) -> str:
    """What it means, for a person."""
    best = axes[0]
    if not best.holds:
        if best.evidence < -MIN_EVIDENCE:
            return "The failure does not repeat from run to run: no place, time, speed or frequency is common to it."
        return "Whether the failure repeats from run to run cannot be told: these runs show too little of it."
    where, why = AXIS_TEXTS[best.axis]
    if best.axis == "phase" and best.frequency is not None:
        where = f"{where} ({best.frequency:.3g} Hz)"
    how_often = f" in {best.runs} of {best.of} runs" if best.runs > 1 else ""
    words = f"The failure repeats {where}{how_often}: {why}."
    like = [a.axis for a in _near(axes) if a is not best]
    if like:
        names = " or ".join(AXES[name].name for name in like)
        words += f" These runs hardly tell this from the same {names}; another speed would."
    return words
