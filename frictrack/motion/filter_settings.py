"""Write, read and describe what low-passed a coordinate."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from frictrack.filters import STRUCTURAL
from frictrack.motion.filter_methods import METHODS, FilterMethod
from frictrack.motion.smoother import TREND_ORDER, ChangeGroup, Event, NoiseColour, PlaceForce, Structure, cutoff_of

MIN_CUTOFF_RATIO = 0.7  # over the likeliest cut-off; below it signal is lost


@dataclass(frozen=True, eq=False)
class Smoother:
    """What low-passed a coordinate; `str` writes it as JSON.

    Attributes
    ----------
    structure
        Structure of the structural smoother.
    method
        Another filter method.
    alternatives
        Changes of the structure over which the signal was averaged.
    colour
        Colour of the noise.
    forces
        Forces that are periodic in place.

    """

    structure: Structure | None = None
    method: FilterMethod | None = None
    alternatives: tuple[ChangeGroup, ...] = ()
    colour: NoiseColour | None = None
    forces: tuple[PlaceForce, ...] = ()

    def __str__(self) -> str:
        if self.method:
            return json.dumps({"method": self.method.name, **vars(self.method)})
        if self.structure is None:
            return ""
        more: dict[str, Any] = {}
        if self.alternatives:
            more["alternatives"] = [asdict(g) for g in self.alternatives]
        if self.colour:
            more["noise"] = asdict(self.colour)
        if self.forces:
            more["forces"] = self.forces
        return json.dumps({"method": STRUCTURAL, **asdict(self.structure), **more})

    @classmethod
    def read(cls, text: str) -> Smoother:
        """Read a smoother from its JSON."""
        settings = json.loads(text)
        name = settings.pop("method")
        if name != STRUCTURAL:
            return cls(method=METHODS[name](**settings))
        events = tuple(Event(**e) for e in settings["events"])
        lines = tuple((float(f), float(m)) for f, m in settings["lines"])
        groups = tuple(ChangeGroup.read(g) for g in settings.get("alternatives", ()))
        colour = NoiseColour(**settings["noise"]) if "noise" in settings else None
        forces = tuple(PlaceForce(*f) for f in settings.get("forces", ()))
        return cls(Structure(tuple(settings["stiffness"]), lines, events), None, groups, colour, forces)


def describe_structure(smoother: Smoother, interval: float) -> str:
    """Describe the components of a record in words.

    Parameters
    ----------
    smoother
        Trend, lines, events, forces and noise.
    interval
        Frame interval, s.

    Returns
    -------
    str
        Cut-offs of the trend, lines, forces, events and correlated noise.

    """
    structure, colour = smoother.structure, smoother.colour
    assert structure is not None
    cutoffs = [cutoff_of(float(np.exp(s)), interval) for s in structure.stiffness]
    low, high = (f"{f:.3g}" if f < 1000 else f"{f:.0f}" for f in (min(cutoffs), max(cutoffs)))
    span = f"{low} Hz" if max(cutoffs) < 1.1 * min(cutoffs) else f"{low} to {high} Hz"
    parts = [f"a trend cut off at {span}"]
    parts += [f"one sinusoid at {omega / 2 / np.pi / interval:.4g} Hz" for omega, _ in structure.lines]
    parts += [f"a force periodic in place, every {1e3 * f.period:.4g} mm" for f in smoother.forces]
    centres = [1e3 * interval * 0.5 * (e.first + e.last + TREND_ORDER) for e in structure.events]
    if centres:
        parts.append("abrupt changes at " + ", ".join(f"{c:.1f} ms" for c in sorted(centres)))
    if colour:
        parts.append(
            f"noise of which {100 * colour.share:.0f} % of the variance is correlated "
            f"({colour.correlation:.2g} from frame to frame)"
        )
    return ", ".join(parts) + ", by maximum likelihood"


def describe_given_cutoff(used: float, best: float) -> str:
    """Describe a given cut-off; say if it is too low."""
    reason = f"cut-off {used:.3g} Hz as given"
    if used < MIN_CUTOFF_RATIO * best:
        reason += f", maximum likelihood would take {best:.3g} Hz: the deviations count the signal lost"
    return reason
