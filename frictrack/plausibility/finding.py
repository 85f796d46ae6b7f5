"""Describe a finding: what was read, why it is implausible, and what to enter instead."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

WARNING, ERROR = "warning", "error"


@dataclass(frozen=True)
class Finding:
    """One sentence on one number of a study.

    Parameters
    ----------
    kind
        What is implausible: "mass", "scale", "fps", "speed", "friction", "incline", "sensor".
    words
        The sentence, the likely correction in it.
    correction
        What to type instead, as the study file has it; empty where nothing is likely.
    run
        Name of the run; empty where the whole study is meant.
    grade
        "error" where the number cannot be right, else "warning".
    contradicts
        Whether the measured data contradict what was typed. No verdict holds before one of the two is put right.
    check
        Keys of the study file to check, the likeliest first; by default the kind.

    """

    kind: str
    words: str
    correction: str = ""
    run: str = ""
    grade: str = WARNING
    contradicts: bool = False
    check: tuple[str, ...] = ()

    def __str__(self) -> str:
        return f'run "{self.run}": {self.words}' if self.run else self.words

    def to_dict(self) -> dict[str, Any]:
        """Return the JSON of the finding."""
        return {**asdict(self), "words": str(self), "check": self.check or (self.kind,)}
