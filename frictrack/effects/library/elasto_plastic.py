"""Elasto-plastic friction: a contact that is purely elastic up to a share of its level, and yields only beyond it."""

from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

from frictrack.effects.definition import Array, Nonlinear, Parameter, Path, Phrase
from frictrack.effects.library import presliding
from frictrack.effects.memory import direction_stretches, remembered, state_at_beginning
from frictrack.effects.ranges import ScanValues, breakaway_lengths

if TYPE_CHECKING:
    from scipy.interpolate import CubicSpline

MAX_YIELDED = 40.0  # logarithm of the way to full bending that is left, beyond which the contact slides
N_TABLE = 2001  # values of the way that belongs to a bending
SHARES = (0.3, 0.6, 0.9)


def columns(path: Path, nonlinear: Nonlinear, inner: Array) -> Array:
    """Dry-friction columns times how far the contact is bent in the direction of motion, same shape as `inner`.

    `stiffness` is fitted as the length level/stiffness, m.
    """
    return inner * path.s[:, None] * remembered(path, state, nonlinear, inner)


def state(path: Path, nonlinear: Nonlinear, inner: Array) -> Array:
    """How far the contact is bent, (n, 1)."""
    return elastoplastic_bending(path, nonlinear["stiffness"], nonlinear["share"])[:, None]


def elastoplastic_bending(path: Path, length: float | Array, share: float | Array) -> Array:
    """State w (n,), from -1 to 1: dw/dt = (v/length) (1 - alpha(w sgn v) w sgn v), alpha = 0 up to the share.

    In the direction of motion the bending is one function of the distance slid, which is tabulated once. A path begins
    as the motion before it has left the contact, fully bent where nothing is known of it, unbent where it rests.
    """
    cut = direction_stretches(path)
    lengths, shares = (np.broadcast_to(np.asarray(q, dtype=float), path.t.shape) for q in (length, share))
    whole, at = (cut.whole / lengths[cut.first]).tolist(), shares[cut.first].tolist()

    def leave(k: int, w: float) -> float:
        return float(_bent(np.array([w]), np.array([whole[k]]), at[k])[0])

    unknown = path.s[list(path.starts), None]
    begin = state_at_beginning(path, unknown, elastoplastic_bending, length, share)[:, 0]
    entered = cut.entered(begin, leave)[cut.which]
    slid, out = cut.slid / lengths, np.empty(len(path.t))
    for value in np.unique(shares):
        own = shares == value
        out[own] = _bent(entered[own], slid[own], float(value))
    return np.asarray(cut.way * out)


def _bent(w: Array, slid: Array, share: float) -> Array:
    """Bending (n,) after sliding so many lengths from a bending w (n,)."""
    way_of, bending_of, reach = _table(share)
    yielded = w > share
    left = -np.log(np.maximum((1.0 - w) / (1.0 - share), np.exp(-MAX_YIELDED)))
    begin = np.where(yielded, share + way_of(np.clip(left, 0.0, MAX_YIELDED)), w)
    way = begin + slid  # in which a bending up to the share is its own way
    beyond = np.clip(way - share, 0.0, reach)
    return np.where(way <= share, way, 1.0 - (1.0 - share) * np.exp(-bending_of(beyond)))


@lru_cache(maxsize=256)
def _table(share: float) -> "tuple[CubicSpline, CubicSpline, float]":
    """Way beyond the share against u = -ln((1 - w)/(1 - share)), its inverse, and its longest value.

    dw/dz = 1 - alpha w gives dz/du = (1 - w)/(1 - alpha w), which is smooth and tends to one.
    """
    from scipy.interpolate import CubicSpline  # noqa: PLC0415 - takes longer to import than all effects

    u = np.sinh(np.linspace(0.0, np.arcsinh(MAX_YIELDED), N_TABLE))
    left = (1.0 - share) * np.exp(-u)
    elastic = np.sin(np.pi / 2 * np.exp(-u)) ** 2  # 1 - alpha
    way = CubicSpline(u, left / (left + elastic * (1.0 - left))).antiderivative()
    return way, CubicSpline(way(u), u), float(way(MAX_YIELDED))


equation = (
    "coulomb + stribeck times w sgn v, dw/dt = (v stiffness/F_s) (1 - alpha w sgn v), alpha 0 up to w sgn v = "
    "share, then rising to 1 as (1 + cos(pi (1 - w sgn v)/(1 - share)))/2"
)
parameters = (
    Parameter("stiffness", "N/m", (1e-9, np.inf), scan=breakaway_lengths),
    Parameter("share", "1", (0.0, 0.99), scan=ScanValues(SHARES)),
)
modifies = frozenset({"coulomb", "stribeck"})
replaces = frozenset({"presliding"})
scales_with = "load"
memory = True
turns = True
rank = 1
what = "The contact is a spring up to a share of its level: a small load to and fro leaves it where it was."
looks_like = "a loop against x after every reversal with straight flanks; no loop and no drift below the share"
mistaken_for = "presliding (share 0 is close to it), unless the load stays below the share for many cycles"
confirm = "Load it by a force that swings below the share: it does not drift, as Dahl's contact does."
describe = Phrase("purely elastic up to {100 * share} % of the level of dry friction")
invariant = "a load below the share of the level moves nothing for good"
source = (
    "Dupont, Hayward, Armstrong & Altpeter 2002, IEEE Trans. Automatic Control 47, 787, without the damping of "
    "the bristles"
)
quote = presliding.quote
