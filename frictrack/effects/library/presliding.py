"""Presliding: before it slides, a contact bends like a spring; dry friction takes a distance to turn round."""

import math

import numpy as np

from frictrack.effects.definition import Array, Nonlinear, Parameter, Path
from frictrack.effects.memory import direction_stretches, remembered, state_at_beginning
from frictrack.effects.ranges import breakaway_lengths

MAX_EXPONENT_DIFFERENCE_DAHL = 1e-9  # from one, within which the contact straightens exponentially


def columns(path: Path, nonlinear: Nonlinear, inner: Array) -> Array:
    """Dry-friction columns times how far the contact is bent in the direction of motion, same shape as `inner`.

    `stiffness` is fitted as the length level/stiffness, m.
    """
    return inner * path.s[:, None] * remembered(path, state, nonlinear, inner)


def bending(path: Path, length: float | Array, exponent: float | Array) -> Array:
    """Dahl's state w (n,), from -1 to 1: dw/dt = (v/length) (1 - w sgn v)^exponent.

    Between reversals this has a closed form in the distance slid, so no step is too long. A path begins as the motion
    before it has left the contact, fully bent where nothing is known of it, and unbent where it begins at rest (s = 0).
    """
    cut = direction_stretches(path)
    power = np.broadcast_to(np.asarray(exponent, dtype=float), path.t.shape)
    unit = np.broadcast_to(np.asarray(length, dtype=float), path.t.shape)
    whole, powers = cut.whole / unit[cut.first], power[cut.first]

    def leave(k: int, w: float) -> float:
        return 1.0 - _left(1.0 - w, whole[k], powers[k])

    unknown = path.s[list(path.starts), None]
    begin = state_at_beginning(path, unknown, bending, length, exponent)[:, 0]
    entered = cut.entered(begin, leave)
    return np.asarray(cut.way * (1.0 - _left_arrays(1.0 - entered[cut.which], cut.slid / unit, power)))


def state(path: Path, nonlinear: Nonlinear, inner: Array) -> Array:
    """How far the contact is bent, (n, 1)."""
    return bending(path, nonlinear["stiffness"], nonlinear["exponent"])[:, None]


def _left(free: float, slid: float, exponent: float) -> float:
    """What is left of the way to full bending, `free` at first, after sliding so many lengths."""
    if free <= 0.0:
        return 0.0
    rest = 1.0 - exponent
    if abs(rest) < MAX_EXPONENT_DIFFERENCE_DAHL:
        return free * math.exp(-slid)
    used = rest * slid * free**-rest
    return free * math.exp(math.log1p(-used) / rest) if used < 1.0 else 0.0


def _left_arrays(free: Array, slid: Array, exponent: Array) -> Array:
    """The same for arrays (n,)."""
    rest = 1.0 - exponent
    dahl = np.abs(rest) < MAX_EXPONENT_DIFFERENCE_DAHL
    if dahl.all():
        return np.asarray(free * np.exp(-slid))
    rest = np.where(dahl, 1.0, rest)
    some = np.maximum(free, 1e-300)
    with np.errstate(over="ignore", divide="ignore"):
        used = np.minimum(rest * slid * some**-rest, 1.0)
        curved = np.exp(np.log1p(-used) / rest)
    return np.asarray(free * np.where(dahl, np.exp(-slid), curved))


def quote(own: dict[str, float], model: dict[str, float]) -> dict[str, float]:
    """The stiffness of the unbent contact, sigma_0: the level of dry friction at rest over the length."""
    level = model.get("coulomb.F_c", 0.0) + model.get("stribeck.F_s", 0.0)
    return {"stiffness": level / own["stiffness"]} if "stiffness" in own else {}


equation = "coulomb + stribeck times w sgn v, dw/dt = (v stiffness/F_s) (1 - w sgn v)^exponent"
parameters = (
    Parameter("stiffness", "N/m", (1e-9, np.inf), scan=breakaway_lengths),
    Parameter("exponent", "1", (0.0, 2.0), fixed=1.0),
)
modifies = frozenset({"coulomb", "stribeck"})
scales_with = "load"
memory = True
turns = True
rank = 1
what = "Asperities bend before they slip: friction builds up over a distance, like a spring that yields."
looks_like = "a loop against x after every reversal; nothing in a run that only slides one way"
mistaken_for = "stribeck or a soft mounting of the sensor, near reversals; maxwell slip, of which small loops close"
confirm = "Reverse the drive more slowly: the loop against x keeps its width, a lag in time shrinks."
invariant = "presliding needs a reversal"
source = (
    "Dahl 1968, A solid friction model, Aerospace Corp. TOR-0158(3107-18)-1; exponent 1 yields "
    "exponentially, 0 is elastic up to slip"
)
