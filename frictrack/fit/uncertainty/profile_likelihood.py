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

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from frictrack.distributions import normal_ppf
from frictrack.errors import FrictrackError
from frictrack.fit.least_squares import MIN_CHI2_FALL, Solution, refine, white_noise_covariance
from frictrack.fit.uncertainty.fitted_model import FittedModel
from frictrack.fit.uncertainty.fixed_quantity import FixedQuantityProblem, pivot_of
from frictrack.fit.uncertainty.reported_values import Quantity, parse_quantity
from frictrack.records import Array
from frictrack.threads import one_thread

QUANTILE_TOLERANCE = 5e-3  # share of the quantile: accuracy of an end
MAX_REFINEMENTS, MAX_PROBES = 14, 6  # fits per side: to locate an end; to test whether there is one
MAX_STEP_FACTOR = 3.0  # factor by which a step outward may grow
PROFILE_MARGIN = 1.25  # the plot of a profile extends this far, relative to its ends
MIN_BETTER_CHI2 = 0.1  # fall of chi-squared from which another optimum counts as better
PROBE_MIN_FALL = 0.05  # of chi-squared: fits that only test whether a profile has an end stop where a step gains less
PROBE_STD = 4.0  # standard deviations at which a bounded profile has passed the quantile
SAME_VALUE_STD = 1e-3  # standard deviations; closer values count as equal
UNLIMITED_RATIO = 1e6  # times the larger of value and standard deviation: unbounded

Progress = Callable[[int, int, str], None]


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
        why = {k: v for k, v in (("why_low", self.why_low), ("why_high", self.why_high)) if v}
        return {
            "value": self.value,
            "unit": self.unit,
            "level": self.level,
            "low": self.low,
            "high": self.high,
            **why,
            "values": self.values.tolist(),
            "rise": self.rise.tolist(),
        }


@one_thread()
def profile(result: FittedModel, address: str, *, level: float = 0.95) -> Profile:
    """Compute the profile of one parameter of a fit, or of the difference of two.

    Parameters
    ----------
    result : FittedModel
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
        raise FrictrackError(f"expected a level between 0 and 1, such as 0.95, but got {level:g}", usage=True)
    if not hasattr(result, "solution"):
        raise FrictrackError("expected the fit of one group but got several; take one of fits[name]", usage=True)
    solution = result.compared
    if not result.is_default_route:  # a global search may not have reached the optimum
        solution = refine(solution.problem, solution.p, solution.starts, tau=solution.tau)
    wanted = parse_quantity(solution.problem.layout, address)
    return ProfileSearch(solution, wanted, result.covariance, level).profile()


@dataclass(frozen=True, eq=False)
class ProfilePoint:
    """One fit with the quantity held at c: all unknowns p, starts, and the root z of the rise."""

    c: float
    z: float
    p: Array
    starts: list[Array]


@dataclass(eq=False)
class ProfileSearch:
    """The search along one quantity, outward from the best fit.

    Attributes
    ----------
    solution : Solution
        The best fit.
    quantity : Quantity
        The quantity.
    covariance : array of shape (P, P)
        Covariance of the unknowns.
    level : float
        Confidence level.
    points : list of ProfilePoint
        Points computed so far.
    better : float
        How far the objective fell below that of the best fit.
    min_fall : float
        Predicted fall of the objective below which the fits of points end.

    """

    solution: Solution
    quantity: Quantity
    covariance: Array
    level: float = 0.95
    points: list[ProfilePoint] = field(default_factory=list)
    better: float = 0.0
    min_fall: float = MIN_CHI2_FALL

    def __post_init__(self) -> None:
        s = self.solution
        white_noise, _ = white_noise_covariance(s)
        g = self.quantity.gradient(s.problem, s.p)
        white_noise_variance, stated_variance = float(g @ white_noise @ g), float(g @ self.covariance @ g)
        self.scale = (
            stated_variance / white_noise_variance if white_noise_variance > 0 and stated_variance > 0 else 1.0
        )  # of the rise
        self.direction = white_noise @ g / white_noise_variance if white_noise_variance > 0 else np.zeros(len(s.p))
        self.best = ProfilePoint(self.quantity.value(s.problem, s.p), 0.0, s.p, s.starts)
        self.std = float(np.sqrt(stated_variance)) if stated_variance > 0 else 0.1 * max(abs(self.best.c), 1e-3)
        self.target = float(normal_ppf(0.5 + self.level / 2))
        self.pivot = pivot_of(self.quantity, s, np.sqrt(np.diag(white_noise)))
        self.phases = np.array([_is_phase(s, i) for i in range(len(s.p))])
        self.points.append(self.best)

    @property
    def bounds(self) -> tuple[float, float]:
        """Bounds of the quantity if it is an unknown itself; otherwise infinite."""
        slot = self.solution.problem.layout.slots[self.quantity.slot]
        if self.phases[self.quantity.slot]:
            return self.best.c - np.pi, self.best.c + np.pi
        return slot.bounds if self.pivot is None else (-np.inf, np.inf)

    def at(self, c: float) -> ProfilePoint:
        """Fit all other unknowns with the quantity held at c, from the nearest points.

        Raises
        ------
        FrictrackError
            If no such fit exists.

        """
        s = self.solution
        held = FixedQuantityProblem(s.problem, self.quantity, c, self.pivot)
        p, starts = self._predicted(c)
        low, high = s.problem.layout.bounds
        p = held.law(np.clip(p, low, high))
        found = refine(held, p, starts, tau=s.tau, free=held.free, min_fall=self.min_fall)
        rise = (found.objective - s.objective) / self.scale
        self.better = max(self.better, -rise if rise < -MIN_BETTER_CHI2 else 0.0)
        point = ProfilePoint(c, float(np.sqrt(max(rise, 0.0))), held.law(found.p), found.starts)
        self.points.append(point)
        return point

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

    def end(self, side: int, max_refinements: int = MAX_REFINEMENTS) -> tuple[float | None, str]:
        """Find where the profile passes the quantile on one side.

        Parameters
        ----------
        side : int
            -1 or 1.
        max_refinements : int
            Largest number of fits.

        Returns
        -------
        end : float or None
            The end of the interval.
        reason : str
            Why there is no end; empty if there is one.

        """
        last = inner = self.best
        outer, failed_at, bound = None, side * np.inf, self.bounds[side > 0]
        for _ in range(max_refinements):
            c = self._next_outward(side, last, inner) if outer is None else _between(inner, outer, self.target)
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
            if self._has_converged(inner, outer) or self._is_unlimited(inner.c):
                break
        if outer is not None or inner.z > (1 - QUANTILE_TOLERANCE) * self.target:
            return self._interpolated_end(inner, outer or inner), ""
        return None, self._reason_open(inner, bound, failed_at)

    def excluded(self, value: float) -> bool:
        """Return whether the interval excludes a value."""
        point = self._try(value)
        return point is not None and point.z >= self.target

    def bounded(self, side: int) -> tuple[bool, str]:
        """Return whether the profile passes the quantile on one side, without locating it; usually one fit suffices."""
        probe, bound = self.best.c + side * PROBE_STD * self.std, self.bounds[side > 0]
        point = self._try(side * min(side * probe, side * bound))
        if point is not None and point.z >= self.target:
            return True, ""
        if point is not None and point.c == bound:
            return False, self._reason_open(point, bound, side * np.inf)
        end, why = self.end(side, MAX_PROBES)
        return end is not None, why

    def _try(self, c: float) -> ProfilePoint | None:
        """A point at c, or None if no fit exists there."""
        try:
            return self.at(c)
        except (FrictrackError, np.linalg.LinAlgError):
            return None

    def _has_converged(self, inner: ProfilePoint, outer: ProfilePoint | None) -> bool:
        near = QUANTILE_TOLERANCE * self.target
        return self.target - inner.z < near or (outer is not None and outer.z - self.target < near)

    def _next_outward(self, side: int, last: ProfilePoint, current: ProfilePoint) -> float:
        """Where the quantile is expected, from the two outermost points; the first step is one standard deviation."""
        if current is self.best:
            return current.c + side * self.std
        slope = (current.z - last.z) / abs(current.c - last.c)
        distance = abs(current.c - self.best.c)
        step = (1.02 * self.target - current.z) / slope if slope > 0 else np.inf
        return current.c + side * min(step, (MAX_STEP_FACTOR - 1) * distance)

    def _interpolated_end(self, inner: ProfilePoint, outer: ProfilePoint) -> float:
        share = (self.target - inner.z) / (outer.z - inner.z) if outer.z != inner.z else 1.0
        return inner.c + share * (outer.c - inner.c)

    def _is_unlimited(self, c: float) -> bool:
        return abs(c - self.best.c) > UNLIMITED_RATIO * max(abs(self.best.c), self.std, 1e-12)

    def _reason_open(self, reached: ProfilePoint, bound: float, failed_at: float) -> str:
        """Why the profile has no end on this side."""
        unit = self.quantity.unit
        at_bound = abs(reached.c - bound) < SAME_VALUE_STD * self.std
        points = f"{bound if at_bound else reached.c:.4g} {unit}".removesuffix(" 1")
        rise = f"the misfit rises by {reached.z**2:.2g} only"
        if self.phases[self.quantity.slot]:
            return f"at the opposite phase {rise}"
        if at_bound:
            return f"up to its bound {points} {rise}"
        stopped = " and no law beyond can be integrated" if np.isfinite(failed_at) else ""
        return f"up to {points} {rise}{stopped}"


def _between(inner: ProfilePoint, outer: ProfilePoint, target: float) -> float:
    """Where z is expected to pass the target between two points, kept away from both."""
    share = (target - inner.z) / max(outer.z - inner.z, 1e-300)
    return inner.c + min(max(share, 0.02), 0.95) * (outer.c - inner.c)


def _is_phase(solution: Solution, i: int) -> bool:
    slot = solution.problem.layout.slots[i]
    effect = next((e for e in solution.problem.model.effects if e.name == slot.effect), None)
    return effect is not None and effect.parameter(slot.parameter).role == "phase"
