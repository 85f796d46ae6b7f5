"""Define the plausible ranges of quantities in friction measurements with sliding masses, each with its source."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Range:
    """Plausible range of a quantity, ends included, with its source and the value that it cannot exceed.

    Examples
    --------
    >>> 0.35 in MASS, 0.0 in MASS
    (True, False)

    """

    low: float
    high: float
    unit: str
    source: str
    limit: float = float("inf")

    def __contains__(self, value: float) -> bool:
        return self.low <= value <= self.high


MASS = Range(1e-4, 1e3, "kg", "from a pin of a tribometer (ASTM G99: grams) to a block of a large direct-shear machine")
BARE_MASS = Range(
    *(1e-3, 20.0, "kg"),
    "a number without a unit counts as kg; above 20 kg no slider is moved by hand, below 1 g nobody writes kg",
)
PITCH = Range(1e-8, 0.02, "m/px", "from half a wavelength of light to a field of view of 20 m in 1000 px")
BARE_PITCH = Range(
    1e-8, 1e-2, "m/px", "a number without a unit counts as m/px; above 1 cm/px a slider of 0.1 m fills 10 px"
)
FPS = Range(5.0, 1e7, "1/s", "from a slow time lapse to in-situ storage sensors (10 million frames a second)")
SPEED = Range(0.0, 100.0, "m/s", "gas guns aside; the fastest rocket sled ran 2885 m/s (Holloman, 2003)", limit=2885.0)
TRAVEL = Range(0.0, 100.0, "m", "a free slide; a curling stone goes 30 to 45 m (World Curling)")
FRICTION = Range(1e-4, 10.0, "1", "from an air bearing to ten times the weight; dry solids in air reach about 1.5")
ROLLING = Range(1e-3, 0.02, "1", "from a ball bearing (0.0010 to 0.0015, SKF catalogue) to a wheel on a hard floor")
DRY_FRICTION = Range(0.02, 2.0, "1", "from ice or PTFE on steel to rubber; most dry pairs lie between 0.1 and 1")
USUAL_FRICTION = 0.3  # most pairs of solids, dry or with boundary lubrication, lie within a decade of it
USUAL_SPEED = 1.0  # m/s
USUAL_TRAVEL = Range(1e-4, 20.0, "m", "courses in a laboratory")
BLOW_ENERGY = Range(0.0, 300.0, "J", "energy of a blow: the largest pendulum hammers in common use (ISO 148-1)")
INCLINE = Range(0.0, 0.8, "rad", "a number without a unit counts as rad: 0.8 rad are 46 degrees")
