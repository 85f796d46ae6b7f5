"""The papers' way to a law: all parameters at once by a global search along the measured motion.

The searched misfit is the papers' sum of squared acceleration residuals (force domain), or the displacement's
chi-squared. What the search found is reported as it is, without a hidden polish: parameters, and their deviations by
linearisation there.
"""

from __future__ import annotations

from collections.abc import Sequence
from difflib import get_close_matches

import numpy as np

from frictrack.effects import Effect, Parameter
from frictrack.errors import FrictrackError
from frictrack.fit.crowd import Balance, Misfit, displacement_balance, force_balance
from frictrack.fit.force import Chain, noise_of
from frictrack.fit.layout import Layout, Slot, balanced, settle
from frictrack.fit.problem import Piece, Problem, spans_of
from frictrack.fit.scatter import MIN_RUNS
from frictrack.models import Model
from frictrack.records import Array
from frictrack.search import METHODS, minimise

DOMAINS = ("displacement", "force")
SEARCHES = ("varpro", *METHODS)
BUDGET = 36_000  # evaluations: the first paper's 1000 generations of 40 with the common gap of 0.9
ROOM = 1.5  # times the largest friction measured: how far a force is searched
SHIFT = 0.01  # of the travelled span: how far the picture may be shifted


def check_how(domain: str, search: str, per: str | None = None) -> None:
    """Raise FrictrackError (usage) for an unknown domain, search or division of runs, with the nearest right one."""
    for what, asked, known in (("domain", domain, DOMAINS), ("search", search, SEARCHES), ("per", per, ("group",))):
        if asked is None:
            continue
        if asked not in known:
            near = get_close_matches(asked.lower(), known, 1, 0.0)[0]
            raise FrictrackError(
                f'expected a {what} among {", ".join(known)} but got "{asked}"; did you mean {near}?', usage=True
            )


def scaffold(model: Model, pieces: Sequence[Piece], names: tuple[str, ...], fps: float) -> Problem:
    """The problem of a model that nobody has started yet."""
    layout = Layout(model, names, spans_of(pieces, len(names), fps))
    fine = max(e.fine for e in model.effects)
    return Problem(model, layout, [p if p.per_frame >= fine else p.refined(fine) for p in pieces])


def searched(misfit: Misfit, method: str, rng: np.random.Generator, known: Array) -> tuple[Array, Array]:
    """The "group of feasible solutions" of a search: all unknowns (k, P), best first, and their misfits (k,).

    Unknowns of runs that the misfit does not hold stay as in `known` (P,). The friction levels of several runs are
    not searched: least squares gives each run's to every individual, held about one to within 3 %.
    """
    result = minimise(misfit, bounds_of(misfit), method=method, rng=rng, max_evaluations=BUDGET)
    layout = misfit.layout
    _, levels = misfit.evaluate(result.optima)
    points = np.tile(known, (len(levels), 1))
    points[:, misfit.searched] = result.optima
    for run, i in enumerate(layout.levels):
        points[:, i] = levels[:, run]
    return np.array([balanced(layout, settle(layout, p)) for p in points]), result.optima_costs


def spread_of(layout: Layout, p: Array) -> float:
    """Spread of the friction levels of a law that was searched, as far as there are enough of them."""
    levels = p[layout.levels]
    return max(float(np.std(levels, ddof=1)), 1e-4) if len(levels) >= MIN_RUNS else 0.03


def misfit_of(problem: Problem, chains: Sequence[Chain] | None) -> Misfit:
    """Squared acceleration residuals, m^2/s^4, through the chains; without chains chi-squared of the displacement."""
    if chains is None:
        return Misfit(problem.layout, [displacement_balance(p) for p in problem.pieces])
    noise = noise_of(chains)
    balances = [force_balance(p, c, noise) for p, c in zip(problem.pieces, chains, strict=True)]
    return Misfit(problem.layout, balances, unit=noise**2)


def bounds_of(misfit: Misfit) -> Array:
    """The box (d, 2) of a search: the parameters' own bounds, and where these are open, what the data allow.

    A force reaches 1.5 times the largest friction measured, the amplitude of a wave its whole swing, other coefficients
    what makes such a force along the measured motion; phases from -pi to pi; frequencies as far as they are scanned, in
    the force domain up to twice the cut-off.
    """
    reach = _Reach(misfit)
    layout = misfit.layout
    effects = {e.name: e for e in layout.model.effects}
    return np.array([reach.interval(effects[s.effect], s) for s in (layout.slots[i] for i in misfit.searched)])


class _Reach:
    """How far the data let each parameter go."""

    def __init__(self, misfit: Misfit) -> None:
        self.balances = misfit.balances
        self.span = misfit.layout.span
        self.highest = max(b.highest for b in misfit.balances)
        force = np.concatenate([self._measured(b) for b in self.balances])
        low, high = np.percentile(force, [1, 99])
        self.top = ROOM * max(abs(low), abs(high))
        self.swing = float(high - low)

    @staticmethod
    def _measured(b: Balance) -> Array:
        """Friction along a piece at the reference load, N, its ragged ends left out."""
        force = b.piece.mass * (b.piece.known - b.piece.a_hat) / b.piece.path.load
        out: Array = force[len(force) // 8 : -(len(force) // 8)]
        return out

    def interval(self, effect: Effect, slot: Slot) -> tuple[float, float]:
        """Bounds of one unknown."""
        parameter = effect.parameter(slot.parameter)
        low, high = slot.bounds
        if parameter.role == "phase":
            return -np.pi, np.pi
        if parameter.unit == "Hz":
            return low, max(min(high, self.highest), 2 * low)
        size = self._size(effect, parameter)
        if _is_wave(effect, parameter):
            low = 0.0
        return (low if np.isfinite(low) else -size), (high if np.isfinite(high) else size)

    def _size(self, effect: Effect, parameter: Parameter) -> float:
        if not parameter.linear:
            return np.pi
        if effect.acts_on == "force" and parameter.unit == "N":
            return self.swing if _is_wave(effect, parameter) else self.top
        usual = {q.name: q.fixed or (float(np.median(q.scan(self.span))) if q.scan else 0.5) for q in effect.nonlinear}
        place = effect.linear.index(parameter)
        column = np.concatenate([effect.columns(b.path, usual)[:, place] for b in self.balances])
        travel = max(float(np.ptp(b.path.x)) for b in self.balances)
        aim = self.top if effect.acts_on == "force" else SHIFT * travel
        return aim / max(float(np.sqrt(np.mean(column**2))), 1e-12)


def _is_wave(effect: Effect, parameter: Parameter) -> bool:
    return parameter.role == "amplitude" and any(p.role == "phase" for p in effect.parameters)
