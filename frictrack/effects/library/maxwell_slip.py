"""Maxwell slip: many springs side by side, each of which slips at a load of its own."""

import numpy as np

from frictrack.effects.definition import Array, Nonlinear, Parameter, Path, Phrase
from frictrack.effects.library import presliding
from frictrack.effects.memory import DirectionStretches, direction_stretches, remembered, state_at_beginning
from frictrack.effects.ranges import ScanValues, breakaway_lengths

N_ELEMENTS = 8  # springs, each with the same share of the level
SPREADS = (3.0, 30.0)


def columns(path: Path, nonlinear: Nonlinear, inner: Array) -> Array:
    """Dry-friction columns times how far the springs are bent in the direction of motion, same shape as `inner`.

    `stiffness` is fitted as the length level/stiffness, m.
    """
    return inner * (path.s * np.mean(remembered(path, state, nonlinear, inner), axis=1))[:, None]


def state(path: Path, nonlinear: Nonlinear, inner: Array) -> Array:
    """How far every spring is bent, (n, N_ELEMENTS), 1 where it slips forward."""
    return element_bendings(path, nonlinear["stiffness"], nonlinear["spread"])


def element_bendings(path: Path, length: float | Array, spread: float | Array) -> Array:
    """Bending w (n, N_ELEMENTS), from -1 to 1: dw/dt = v/length of the element until it slips, where w stays +1 or -1.

    Between reversals this has a closed form in the distance slid. A path begins as the motion before it has left the
    springs, fully bent where nothing is known of it, and unbent where it begins at rest (s = 0).
    """
    cut, lengths = direction_stretches(path), slip_lengths(length, spread)
    unknown = np.repeat(path.s[list(path.starts), None], N_ELEMENTS, axis=1)
    begins = state_at_beginning(path, unknown, element_bendings, length, spread).T
    return np.column_stack([_bending(cut, own, begin) for own, begin in zip(lengths, begins, strict=True)])


def slip_lengths(length: float | Array, spread: float | Array) -> Array:
    """Length at which every element slips, (N_ELEMENTS,) or (N_ELEMENTS, n): in constant ratios, `spread` in all.

    Their harmonic mean is `length`, so that the unbent springs have the stiffness level/length together.
    """
    powers = np.power.outer(np.asarray(spread, dtype=float), np.linspace(0.0, 1.0, N_ELEMENTS))
    return np.moveaxis(np.asarray(length)[..., None] * powers * np.mean(1 / powers, axis=-1, keepdims=True), -1, 0)


def _bending(cut: DirectionStretches, length: Array, begin: Array) -> Array:
    """Bending (n,) of one element; its length is a number or (n,), `begin` (P,)."""
    lengths = np.broadcast_to(length, cut.slid.shape)
    whole = (cut.whole / lengths[cut.first]).tolist()
    entered = cut.entered(begin, lambda k, y: min(y + whole[k], 1.0))
    return cut.way * np.minimum(entered[cut.which] + cut.slid / lengths, 1.0)


equation = (
    "coulomb + stribeck times the mean of w_i sgn v, dw_i/dt = v/length_i until w_i sgn v = 1, lengths in "
    "constant ratios from the first to the last, which is spread times it, together of the stiffness given"
)
parameters = (
    Parameter("stiffness", "N/m", (1e-9, np.inf), scan=breakaway_lengths),
    Parameter("spread", "1", (1.0, 1e4), scan=ScanValues(SPREADS)),
)
modifies = frozenset({"coulomb", "stribeck"})
replaces = frozenset({"presliding"})
scales_with = "load"
memory = True
turns = True
rank = 1
what = "Asperities slip one after the other, each at a load of its own: a loop inside a loop closes."
looks_like = "a loop against x in which a small loop returns to the point at which it left the large one"
mistaken_for = "presliding, of which small loops drift instead of closing; bouc_wen"
confirm = "Reverse twice within a loop and return: the force comes back to where it was, and goes on as before."
describe = Phrase("the last spring slips {spread} times as late as the first")
invariant = "a small loop inside a large one closes, whatever the speed"
source = (
    "Iwan 1966, J. Appl. Mech. 33, 893; Al-Bender, Lampaert & Swevers 2005, IEEE Trans. Automatic Control 50, "
    "1883 (generalised Maxwell slip), with elements of equal level that slip at the level of the moment"
)
quote = presliding.quote
