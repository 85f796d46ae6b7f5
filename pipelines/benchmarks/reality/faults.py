"""Define the faults that a study can have: how they are drawn, and phrases by which a finding names each.

The ranges are those that the field meets (a mistyped exponent, a tracker that jumps to the wrong place, an encoder's
step, a computer that writes time stamps when it finds the time). They know nothing of what frictrack looks for.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

NONE = "none"
FILMED = ("rotation", "occlusion")


@dataclass(frozen=True)
class Kind:
    """How often a fault is drawn in 20 studies, its range and variants, and how it is recognised.

    `words` is a regular expression on one finding, `effects` are effects of the library that are this very fault.
    `stand_ins` do the same to the motion without naming it: a force of gravity that is not accounted for is a slope.
    """

    often: int
    low: float
    high: float
    unit: str
    words: str
    variants: tuple[str, ...] = ("",)
    in_all: float = 0.0  # share of the studies in which all runs have it
    effects: tuple[str, ...] = ()
    stand_ins: tuple[str, ...] = ()


KINDS = {
    NONE: Kind(2, 1.0, 1.0, "", r"(?!)"),
    "outliers": Kind(2, 5.0, 1000.0, "noise", r"off (its|their) course", ("single", "bursts"), in_all=0.5),
    "doubled": Kind(
        2,
        0.01,
        0.1,
        "of the frames",
        r"repeats? the one before|doubled|shown twice|time stamp of the row before",
        ("one", "three", "scattered", "one in place", "three in place", "scattered in place"),
        effects=("dropped_frame",),
    ),
    "missing": Kind(
        1,
        0.01,
        0.1,
        "of the frames",
        r"(sample|frame)s? (is|are) missing",
        ("one", "three", "scattered"),
        effects=("dropped_frame",),
    ),
    "quantised": Kind(2, 1.0, 30.0, "noise", r"whole multiples of|quantis|rounding adds", in_all=1.0),
    "jitter": Kind(1, 0.01, 0.2, "frame", r"jitter", ("stamps", "samples", "samples on even stamps"), in_all=1.0),
    "clock": Kind(
        2,
        0.01,
        0.3,
        "relative",
        r"time stamps say|frame rate|\bfps\b|clock|unit of time",
        ("stamps", "stamps and fps"),
        effects=("timebase", "clock_rate"),
    ),
    "coloured": Kind(1, 0.3, 0.95, "AR(1)", r"colou?red|correlated|not white", in_all=1.0),
    "mass": Kind(2, 1.0, 1.0, "factor", r"\bmass (= |of )", ("10", "0.1", "1000", "0.001"), in_all=0.4),
    "unit": Kind(
        1, 1000.0, 1000.0, "factor", r"x_m holds|t_s holds|\bscale\b|unit of (length|time)", ("x", "t", "scale"), 0.5
    ),
    "incline": Kind(
        1, 5.0, 35.0, "deg", r"\bincline\b", ("sign", "not stated"), in_all=1.0, stand_ins=("slope", "asymmetry")
    ),
    "copy": Kind(1, 0.1, 0.3, "cut", r"the same recording as", ("whole", "cut", "shifted", "fewer digits")),
    "rotation": Kind(
        1, 0.1, 10.0, "deg a frame", r"rotat|\bturn(s|ed|ing)?\b", in_all=1.0, effects=("target_rotation",)
    ),
    "occlusion": Kind(1, 8.0, 60.0, "px", r"match score low|occlu|obstacle|hidden|not found in", in_all=1.0),
}


@dataclass(frozen=True)
class Fault:
    """One fault of a study: what, how, how large, in which runs, and by run which frames.

    `louder` is the noise with the fault over the noise without: what is seen above it is so much larger. What leaves
    no trace in the data is not `visible`.
    """

    kind: str = NONE
    variant: str = ""
    size: float = 1.0
    runs: tuple[str, ...] = ()
    in_all: bool = False
    frames: dict[str, tuple[int, ...]] = field(default_factory=dict)
    louder: float = 1.0
    visible: bool = True

    @property
    def allowed(self) -> tuple[str, ...]:
        """Effects of the library that may be named for this fault."""
        return KINDS[self.kind].effects + KINDS[self.kind].stand_ins

    @property
    def shows(self) -> bool:
        """Whether there is a fault that data can show."""
        return self.kind != NONE and self.visible

    def is_named(self, findings: Sequence[str], missing: Sequence[str] = ()) -> bool:
        """Whether one finding has the words of the fault, and the run where it lies in one; or its effect is named."""
        if set(missing) & set(KINDS[self.kind].effects):
            return True
        return any(self._named_by(line) for line in findings)

    def _named_by(self, line: str) -> bool:
        matches = re.search(KINDS[self.kind].words, line, re.IGNORECASE) is not None
        concerns_run = self.in_all or not self.runs or any(f'run "{name}"' in line for name in self.runs)
        return matches and (concerns_run or 'run "' not in line)

    def to_dict(self) -> dict[str, Any]:
        """Entry of the JSON, with the unit of the size."""
        return asdict(self) | {"unit": KINDS[self.kind].unit}


def read_fault(raw: dict[str, Any]) -> Fault:
    """A fault from its JSON."""
    frames = {run: tuple(rows) for run, rows in raw["frames"].items()}
    kept = {key: value for key, value in raw.items() if key != "unit"}
    return Fault(**kept | {"runs": tuple(raw["runs"]), "frames": frames})


def draw_fault(kind: str, names: Sequence[str], rng: np.random.Generator) -> Fault:
    """One fault of a kind in a study of such runs: its size logarithmic over the range, runs and variant by chance."""
    about = KINDS[kind]
    if kind == NONE:
        return Fault()
    size = float(np.exp(rng.uniform(np.log(about.low), np.log(about.high))))
    in_all = bool(rng.random() < about.in_all)
    runs = tuple(names) if in_all else (str(rng.choice(names)),)
    return Fault(kind, str(rng.choice(about.variants)), size, runs, in_all)


def noted(findings: Sequence[str]) -> list[str]:
    """Kinds of fault that findings speak of, right or wrong."""
    found = [k for k, about in KINDS.items() if any(re.search(about.words, f, re.IGNORECASE) for f in findings)]
    return sorted(found)
