"""Bouc-Wen hysteresis: a spring in parallel that yields, and remembers the way that it was bent.

    F = alpha w,   dw/dt = v - gamma |v| w - delta v |w|

`gamma` opens the loop, `delta` makes it harder or softer while it is loaded than while it is unloaded; with
delta = 0 it is Dahl's contact of the level alpha/gamma. The published z is alpha w, and the published products
beta gamma and beta delta are `gamma` and `delta` here, with the exponent nu = 1.
"""

import math

import numpy as np

from frictrack.effects.definition import Array, Nonlinear, Parameter, Path, Phrase
from frictrack.effects.memory import direction_stretches, remembered, state_at_beginning
from frictrack.effects.ranges import ScanValues, Span, breakaway_lengths

MAX_GROWTH_EXPONENT = 40.0  # growth of an unstable loop in one stretch, as an exponent: beyond it there is no such law
MAX_BENDING_M = 1e3  # m, likewise
DELTA_RATIOS = (-1.5, -0.75, 0.0, 0.75)  # of delta to gamma worth trying


def columns(path: Path, nonlinear: Nonlinear) -> Array:
    """Bending w, shape (n, 1): N per N/m of alpha. `delta` is fitted as the ratio delta/gamma."""
    return remembered(path, state, nonlinear)


def state(path: Path, nonlinear: Nonlinear) -> Array:
    """Bending w of the spring, m, (n, 1)."""
    return bending(path, nonlinear["gamma"], nonlinear["delta"])[:, None]


def bending(path: Path, gamma: float | Array, ratio: float | Array) -> Array:
    """State w (n,), m, of dw/dt = v - gamma (|v| w + ratio v |w|).

    In the direction of motion, y = w sgn v obeys dy/dz = 1 - k y over the distance z, with k = gamma (1 - ratio) below
    zero and gamma (1 + ratio) above: exponentials, exact however long the steps are. A path begins as the motion before
    it has left the spring, unbent where nothing is known of it.
    """
    cut = direction_stretches(path)
    gammas, ratios = (np.broadcast_to(np.asarray(q, dtype=float), path.t.shape) for q in (gamma, ratio))
    below, above = gammas * (1 - ratios), gammas * (1 + ratios)
    whole, low, high = cut.whole.tolist(), below[cut.first].tolist(), above[cut.first].tolist()

    def leave(k: int, y: float) -> float:
        return _bent(y, whole[k], low[k], high[k])

    unknown = np.zeros((len(path.starts), 1))
    entered = cut.entered(state_at_beginning(path, unknown, bending, gamma, ratio)[:, 0], leave)
    return np.asarray(cut.way * _bent_arrays(entered[cut.which], cut.slid, below, above))


def _bent(y: float, slid: float, low: float, high: float) -> float:
    """State after sliding a distance from y, the rates below and above zero."""
    if y < 0.0:
        reach = _reach(y, low)
        if slid <= reach:
            return _grown(y, slid, low)
        y, slid = 0.0, slid - reach
    return _grown(y, slid, high)


def _reach(y: float, rate: float) -> float:
    """Distance from a negative state to zero; infinite where the loop grows away from it."""
    if abs(rate * y) < 1e-9:
        return -y
    return math.log1p(-rate * y) / rate if rate * y < 1.0 else math.inf


def _grown(y: float, slid: float, rate: float) -> float:
    """Solution of dy/dz = 1 - rate y after a distance."""
    steps = max(rate * slid, -MAX_GROWTH_EXPONENT)
    gained = slid if abs(steps) < 1e-12 else -math.expm1(-steps) / steps * slid
    return min(max(y * math.exp(-steps) + gained, -MAX_BENDING_M), MAX_BENDING_M)


def _bent_arrays(y: Array, slid: Array, low: Array, high: Array) -> Array:
    """`_bent` of arrays (n,)."""
    small = np.abs(low * y) < 1e-9
    with np.errstate(invalid="ignore", divide="ignore"):
        reach = np.where(small, -y, np.log1p(np.maximum(-low * y, -1.0)) / low)
    reach = np.where((y < 0) & (low * y < 1.0), reach, np.where(y < 0, np.inf, 0.0))
    crossed = slid > reach
    rate = np.where(crossed | (y >= 0), high, low)
    start, rest = np.where(crossed & (y < 0), 0.0, y), np.where(crossed, slid - reach, slid)
    steps = np.maximum(rate * rest, -MAX_GROWTH_EXPONENT)
    flat = np.abs(steps) < 1e-12
    gained = np.where(flat, 1.0, -np.expm1(-steps) / np.where(flat, 1.0, steps)) * rest
    return np.clip(start * np.exp(-steps) + gained, -MAX_BENDING_M, MAX_BENDING_M)


def rates(span: Span) -> Array:
    """Rates of yielding worth trying, 1/m: one over the breakaway lengths of a contact."""
    return np.asarray(1.0 / breakaway_lengths(span)[::2])


def quote(own: dict[str, float], model: dict[str, float]) -> dict[str, float]:
    """`delta` in 1/m, from its ratio to gamma."""
    return {"delta": own["delta"] * own.get("gamma", float("nan"))} if "delta" in own else {}


equation = "alpha w, dw/dt = v - gamma |v| w - delta v |w|"
parameters = (
    Parameter("alpha", "N/m", (0.0, np.inf), linear=True),
    Parameter("gamma", "1/m", (1e-6, np.inf), scan=rates),
    Parameter("delta", "1/m", (-5.0, 5.0), scan=ScanValues(DELTA_RATIOS), signed=True),
)
memory = True
turns = True
what = "A joint, rope or guide is bent and slips inside: it pulls back like a spring that remembers its way."
looks_like = "a loop against x that turns round with the direction and does not close between two amplitudes"
mistaken_for = "spring with viscous friction (at one amplitude); coulomb with presliding"
confirm = "Swing it at two amplitudes and two frequencies: the loop's area follows the amplitude, not the frequency."
describe = Phrase("{alpha} N/m for small swings, yielding within {1 / gamma:m}")
invariant = "a hysteretic spring remembers its way, whatever the speed"
may_pull = True
source = "Bouc 1967, 4th Conf. Nonlinear Oscillation, Prague; Wen 1976, J. Eng. Mech. Div. ASCE 102, 249"
