"""Profile likelihood: the rise of the objective when one quantity is held and all other unknowns are fitted.

    rise(c) = min { objective(p) : g(p) = c } - min objective(p)

The interval holds all c with a rise below the quantile of chi-squared with one degree of freedom. Where the standard
deviation includes more than white noise (a scatter known from few runs, segments, coloured noise), the rise is
divided by the square of that ratio. A linear model then gives the interval of its standard deviation. An end that is
not reached is None, with the reason.

References
----------
Wilks, S. S. (1938). Annals of Mathematical Statistics 9, 60-62.
Venzon, D. J. & Moolgavkar, S. H. (1988). A method for computing profile-likelihood-based confidence intervals.
Applied Statistics 37, 87-94.

"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from frictrack.base.distributions import normal_ppf
from frictrack.base.errors import FrictrackError, UsageError
from frictrack.base.workers import one_thread
from frictrack.fit.least_squares import LeastSquaresProblem, PieceResponse, Solution, refine, white_noise_covariance
from frictrack.fit.least_squares.gauss_newton import MIN_CHI2_FALL
from frictrack.fit.routes import FittedRuns, require_one_fit
from frictrack.fit.uncertainty.reported import Quantity, parse_quantity
from frictrack.records import Array, Mask

QUANTILE_TOLERANCE = 5e-3  # share of the quantile: accuracy of an end
MAX_REFINEMENTS, MAX_PROBES = 14, 6  # fits per side: to locate an end; to test whether there is one
MAX_STEP_FACTOR = 3.0  # factor by which a step outward may grow
PROFILE_MARGIN = 1.25  # the plot of a profile extends this far, relative to its ends
MIN_BETTER_CHI2 = 0.1  # fall of chi-squared from which another optimum counts as better
PROBE_MIN_FALL = 0.05  # of chi-squared: fits that only test whether a profile has an end stop where a step gains less
PROBE_STD = 4.0  # standard deviations at which a bounded profile has passed the quantile
SAME_VALUE_STD = 1e-3  # standard deviations; closer values count as equal
NO_RESPONSE = "small changes of it change nothing in these runs; a force that jumps has no slope: take tanh for it"
UNLIMITED_RATIO = 1e6  # times the larger of value and standard deviation: unbounded
MAX_NEWTON_STEPS = 12  # for the pivot; one suffices where the quantity is linear in it
MIN_DERIVATIVE_SHARE = 1e-7  # share of the largest; smaller derivatives are rounding errors
MIN_DISTANCE_TO_BOUNDS_STD = 20.0  # a pivot should be at least this far from its bounds


@dataclass(frozen=True, eq=False)
class Profile:
    """The profile of one quantity, and its interval.

    Attributes
    ----------
    address, unit : str
        The quantity.
    value : float
        Its fitted value.
    level : float
        Confidence level.
    values, rise : array of shape (n,)
        Values in rising order, and the rise of chi-squared there.
    low, high : float or None
        Ends of the interval; None where the profile does not rise far enough, `why_low` and `why_high` state why.
    better : float
        How far the objective falls below that of the fit; 0 if the fit was the optimum.
    refinements : int
        Number of fits.

    """

    address: str
    unit: str
    value: float
    level: float
    values: Array
    rise: Array
    low: float | None
    high: float | None
    why_low: str = ""
    why_high: str = ""
    better: float = 0.0
    refinements: int = 0

    @property
    def bounded(self) -> bool:
        """Whether both ends were reached."""
        return self.low is not None and self.high is not None

    def excludes(self, value: float) -> bool:
        """Return whether the interval excludes a value."""
        return (self.low is not None and value < self.low) or (self.high is not None and value > self.high)

    def summary(self) -> dict[str, Any]:
        """Return JSON."""
        own = {key: getattr(self, key) for key in ("value", "unit", "level", "low", "high", "why_low", "why_high")}
        known = {key: value for key, value in own.items() if value != ""}
        return known | {"values": self.values.tolist(), "rise": self.rise.tolist()}


@one_thread()
def profile(result: FittedRuns, address: str, *, level: float = 0.95) -> Profile:
    """Compute the profile of one parameter of a fit, or of the difference of two.

    Parameters
    ----------
    result : Fit
        The fit.
    address : str
        A reported parameter, such as ``"coulomb.F_c"``, or ``"stribeck.F_s - coulomb.F_c"``.
    level : float
        Confidence level of the interval.

    Returns
    -------
    Profile
        The profile. All other parameters and the friction levels are fitted within their bounds.

    Raises
    ------
    FrictrackError
        (usage) If the address is no free parameter, or the level is not between 0 and 1.

    References
    ----------
    Venzon, D. J. & Moolgavkar, S. H. (1988). Applied Statistics 37, 87-94.

    Examples
    --------
    >>> import frictrack as ft
    >>> fit = ft.fit(["coulomb", "viscous", "patch"], ft.samples.runs()[:2])
    >>> found = ft.profile(fit, "patch.x_c")
    >>> found.low < 0.1 < found.high, found.unit
    (True, 'm')

    """
    if not 0 < level < 1:
        raise UsageError(f"expected a level between 0 and 1, such as 0.95, but got {level:g}")
    require_one_fit(result)
    solution = result.compared
    if not result.route.is_default:  # a global search may not have reached the optimum
        solution = refine(solution.problem, solution.p, solution.starts, tau=solution.tau)
    wanted = parse_quantity(solution.problem.layout, address)
    return ProfileSearch(solution, wanted, result.covariance, level).profile()


class FixedQuantityProblem(LeastSquaresProblem):
    """The same problem with one unknown (the pivot) chosen so that a reported quantity has a given value."""

    def __init__(self, inner: LeastSquaresProblem, quantity: Quantity, value: float, pivot: int) -> None:
        super().__init__(inner.model, inner.layout, inner.pieces)
        self.inner, self.quantity, self.value, self.pivot = inner, quantity, value, pivot

    @property
    def free(self) -> Mask:
        """Which unknowns may change, (P,)."""
        return np.arange(len(self.layout.slots)) != self.pivot

    def law(self, p: Array) -> Array:
        """Compute all unknowns (P,) with the pivot solved for; `FrictrackError` if it would leave its bounds."""
        p = np.array(p, dtype=float)
        tolerance = 1e-12 * max(abs(self.value), 1e-3)
        with np.errstate(divide="ignore", over="ignore", invalid="ignore"):  # a value out of reach is no number below
            for _ in range(MAX_NEWTON_STEPS):
                error = self.quantity.value(self.inner, p) - self.value
                if abs(error) <= tolerance:
                    break
                p[self.pivot] -= error / self.quantity.gradient(self.inner, p)[self.pivot]
        low, high = self.layout.slots[self.pivot].bounds
        if not (np.isfinite(p[self.pivot]) and low <= p[self.pivot] <= high):
            raise FrictrackError(f"no law within the bounds has {self.quantity.address} = {self.value:g}")
        return p

    def evaluate(self, p: Array, starts: Sequence[Array]) -> list[PieceResponse]:
        """Simulate and linearise every piece; the sensitivities include the response of the pivot."""
        law = self.law(p)
        gradient = self.quantity.gradient(self.inner, law)
        derivative = -gradient / gradient[self.pivot]  # of the pivot per unit of every other unknown
        derivative[self.pivot] = -1.0  # so that its own column vanishes
        return [self._with_pivot_derivative(r, derivative) for r in self.inner.evaluate(law, starts)]

    def _with_pivot_derivative(self, r: PieceResponse, derivative: Array) -> PieceResponse:
        """The response of a piece with the pivot following the other unknowns."""
        if self.pivot not in r.active:
            return r
        at, share = r.active.index(self.pivot), derivative[r.active]
        changed: dict[str, Any] = {
            name: getattr(r, name) + np.outer(getattr(r, name)[:, at], share) for name in ("jac", "on_start")
        }
        if (displacement := getattr(r, "displacement", None)) is not None:  # behind an acceleration chain
            changed["displacement"] = self._with_pivot_derivative(displacement, derivative)
        return replace(r, **changed)


def pivot_of(quantity: Quantity, solution: Solution, std: Array) -> int:
    """Choose the pivot: the reported unknown, unless it is close to a bound (in its `std`) and another one is not."""
    p, layout, own = solution.p, solution.problem.layout, quantity.slot
    low, high = layout.bounds
    matters = _depends_on(quantity, solution, std)
    matters[[q.slot for q in layout.priors if q.slot not in (None, own)]] = False  # a prior holds its unknown
    distance = np.where(matters, np.minimum(p - low, high - p) / np.maximum(std, 1e-300), -1.0)
    if quantity.is_unknown or distance[own] >= min(MIN_DISTANCE_TO_BOUNDS_STD, distance.max()):
        return own
    return int(np.argmax(distance))


def _depends_on(quantity: Quantity, solution: Solution, std: Array) -> Mask:
    """Unknowns that a quantity depends on, (P,)."""
    influence = np.abs(quantity.gradient(solution.problem, solution.p)) * np.maximum(std, 1e-12)
    return np.asarray(influence > MIN_DERIVATIVE_SHARE * influence.max())


def _is_unknown(quantity: Quantity, solution: Solution, std: Array) -> bool:
    """Whether a quantity is an unknown itself, as F_s - F_c is."""
    matters, value = _depends_on(quantity, solution, std), quantity.value(solution.problem, solution.p)
    is_same = np.isclose(value, solution.p[quantity.slot], rtol=1e-9, atol=1e-12)
    return bool(is_same and matters[quantity.slot] and np.count_nonzero(matters) == 1)


@dataclass(frozen=True, eq=False)
class ProfilePoint:
    """One fit with the quantity held at c: all unknowns p, starts, and the root z of the rise."""

    c: float
    z: float
    p: Array
    starts: list[Array]


@dataclass(eq=False)
class ProfileSearch:
    """The search along one quantity, outward from the best fit."""

    solution: Solution  # the best fit
    quantity: Quantity
    covariance: Array  # of the unknowns, (P, P)
    level: float = 0.95  # of confidence
    min_fall: float = MIN_CHI2_FALL  # predicted fall of the objective below which the fits of points end
    points: list[ProfilePoint] = field(default_factory=list)  # computed so far
    better: float = 0.0  # how far the objective fell below that of the best fit

    def __post_init__(self) -> None:
        s = self.solution
        white_noise, _ = white_noise_covariance(s)
        std = np.sqrt(np.diag(white_noise))
        self.quantity = quantity = replace(self.quantity, is_unknown=_is_unknown(self.quantity, s, std))
        g = quantity.gradient(s.problem, s.p)
        white_noise_variance, stated_variance = float(g @ white_noise @ g), float(g @ self.covariance @ g)
        seen = white_noise_variance > 0
        self.scale = stated_variance / white_noise_variance if seen and stated_variance > 0 else 1.0  # of the rise
        self.direction = white_noise @ g / white_noise_variance if seen else np.zeros(len(s.p))
        self.best = ProfilePoint(quantity.value(s.problem, s.p), 0.0, s.p, s.starts)
        self.std = float(np.sqrt(stated_variance)) if stated_variance > 0 else 0.1 * max(abs(self.best.c), 1e-3)
        self.target = float(normal_ppf(0.5 + self.level / 2))
        self.pivot = pivot_of(quantity, s, std)
        roles = {(e.name, p.name): p.role for e in s.problem.model.effects for p in e.parameters}
        slots = s.problem.layout.slots
        self.phases = np.array([roles.get((q.effect, q.parameter)) == "phase" for q in slots])
        self.bounds = slots[quantity.slot].bounds if quantity.is_unknown else (-np.inf, np.inf)
        if self.phases[quantity.slot]:
            self.bounds = self.best.c - np.pi, self.best.c + np.pi
        self.points.append(self.best)

    def profile(self) -> Profile:
        """Compute both sides, and a point beyond either end for the plot."""
        (low, why_low), (high, why_high) = self.end(-1), self.end(1)
        for end in (low, high):
            if end is not None:
                self._try(float(np.clip(self.best.c + PROFILE_MARGIN * (end - self.best.c), *self.bounds)))
        points = sorted(self.points, key=lambda q: q.c)
        return Profile(
            address=self.quantity.address,
            unit=self.quantity.unit,
            value=self.best.c,
            level=self.level,
            values=np.array([q.c for q in points]),
            rise=np.array([q.z**2 for q in points]),
            low=low,
            high=high,
            why_low=why_low,
            why_high=why_high,
            better=self.better,
            refinements=len(self.points) - 1,
        )

    def excluded(self, value: float) -> bool:
        """Return whether the interval excludes a value."""
        point = self._try(value)
        return point is not None and point.z >= self.target

    def bounded(self, side: int) -> tuple[bool, str]:
        """Return whether the profile passes the quantile on one side, without locating it; usually one fit suffices."""
        if self.excluded(float(np.clip(self.best.c + side * PROBE_STD * self.std, *self.bounds))):
            return True, ""
        end, why = self.end(side, MAX_PROBES)
        return end is not None, why

    def end(self, side: int, max_refinements: int = MAX_REFINEMENTS) -> tuple[float | None, str]:
        """Find where the profile passes the quantile on one side, -1 or 1: that end, or why there is none."""
        outer, failed_at, bound = None, side * np.inf, self.bounds[side > 0]
        known = sorted((q for q in self.points if side * (q.c - self.best.c) > 0), key=lambda q: abs(q.c - self.best.c))
        last, inner = [self.best, self.best, *(q for q in known if q.z < self.target)][-2:]
        for _ in range(max_refinements):
            c = self._next_outward(side, last, inner) if outer is None else self._between(inner, outer)
            c = side * min(side * c, side * bound, 0.5 * side * (inner.c + failed_at))
            if abs(c - inner.c) < SAME_VALUE_STD * min(self.std, abs((outer or inner).c - self.best.c) or self.std):
                break
            point = self._try(c)
            if point is None:
                failed_at = c
            elif point.z >= self.target:
                outer = point
            else:
                last, inner = inner, point
            distance = min(self.target - inner.z, np.inf if outer is None else outer.z - self.target)
            unlimited = UNLIMITED_RATIO * max(abs(self.best.c), self.std, 1e-12)
            if distance < QUANTILE_TOLERANCE * self.target or abs(inner.c - self.best.c) > unlimited:
                break
        if outer is not None or inner.z > (1 - QUANTILE_TOLERANCE) * self.target:
            outer = outer or inner
            share = (self.target - inner.z) / (outer.z - inner.z) if outer.z != inner.z else 1.0
            return inner.c + share * (outer.c - inner.c), ""
        return None, self._reason_open(inner, bound, failed_at)

    def at(self, c: float) -> ProfilePoint:
        """Fit all other unknowns with the quantity held at c, from the nearest points."""
        s = self.solution
        held = FixedQuantityProblem(s.problem, self.quantity, c, self.pivot)
        p, starts = self._predicted(c)
        p = held.law(np.clip(p, *s.problem.layout.bounds))
        found = refine(held, p, starts, tau=s.tau, free=held.free, min_fall=self.min_fall)
        rise = (found.objective - s.objective) / self.scale
        self.better = max(self.better, -rise if rise < -MIN_BETTER_CHI2 else 0.0)
        point = ProfilePoint(c, float(np.sqrt(max(rise, 0.0))), held.law(found.p), found.starts)
        self.points.append(point)
        return point

    def _try(self, c: float) -> ProfilePoint | None:
        """A point at c, or None if no fit exists there."""
        try:
            return self.at(c)
        except (FrictrackError, np.linalg.LinAlgError):
            return None

    def _predicted(self, c: float) -> tuple[Array, list[Array]]:
        """Unknowns and starts extrapolated from the two nearest points of this side, or along the covariance."""
        side = [q for q in self.points if (q.c - self.best.c) * (c - self.best.c) >= 0]
        near, *more = sorted(side, key=lambda q: abs(q.c - c))
        more = [q for q in more if q.c != near.c]
        if not more:
            return near.p + self.direction * (c - near.c), near.starts
        share = (c - near.c) / (near.c - more[0].c)
        change = near.p - more[0].p
        change[self.phases] = (change[self.phases] + np.pi) % (2 * np.pi) - np.pi
        return near.p + share * change, [a + share * (a - b) for a, b in zip(near.starts, more[0].starts, strict=True)]

    def _next_outward(self, side: int, last: ProfilePoint, current: ProfilePoint) -> float:
        """Where the quantile is expected, from the two outermost points; the first step is one standard deviation."""
        if current is self.best:
            return current.c + side * self.std
        slope = (current.z - last.z) / abs(current.c - last.c)
        step = (1.02 * self.target - current.z) / slope if slope > 0 else np.inf
        return current.c + side * min(step, (MAX_STEP_FACTOR - 1) * abs(current.c - self.best.c))

    def _between(self, inner: ProfilePoint, outer: ProfilePoint) -> float:
        """Where z is expected to pass the target between two points, kept away from both."""
        share = (self.target - inner.z) / max(outer.z - inner.z, 1e-300)
        return inner.c + min(max(share, 0.02), 0.95) * (outer.c - inner.c)

    def _reason_open(self, reached: ProfilePoint, bound: float, failed_at: float) -> str:
        """Why the profile has no end on this side."""
        if self.scale > UNLIMITED_RATIO**2:  # of a variance over that of white noise: the derivatives do not see it
            return NO_RESPONSE
        at_bound = abs(reached.c - bound) < SAME_VALUE_STD * self.std
        reach = f"{bound if at_bound else reached.c:.4g} {self.quantity.unit}".removesuffix(" 1")
        rise = f"the misfit rises by {reached.z**2:.2g} only"
        if self.phases[self.quantity.slot]:
            return f"at the opposite phase {rise}"
        if at_bound:
            return f"up to its bound {reach} {rise}"
        stopped = " and no law beyond can be integrated" if np.isfinite(failed_at) else ""
        return f"up to {reach} {rise}{stopped}"
