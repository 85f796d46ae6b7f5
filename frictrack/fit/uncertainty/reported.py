"""Compute parameters as they are reported, and state what a reader must know of them.

F_s is reported for F_s - F_c, x_0 as a length, newtons where the mass was fitted. Remarks name confused parameters,
wrong signs, correlated noise, one odd run, and a body that may roll.

Each run has its own friction level, because surfaces scatter. A wrong frame rate or scale of one run changes its
accelerations by a factor, which the level absorbs exactly: the misfit does not show it, but the level does. A body with
I = k m r^2 that rolls down without friction has a = g sin(incline) / (1 + k). Taken for one that slides, it seems to be
held back by k / (1 + k) of the pull of gravity: a third for a disc.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from frictrack.base.distributions import student_sf
from frictrack.base.errors import UsageError
from frictrack.base.number_format import format_length, format_number, join_words, lower_first
from frictrack.effects import Effect
from frictrack.effects.models import Model
from frictrack.fit.least_squares import LeastSquaresProblem, Solution, inverse_normal_matrix
from frictrack.fit.parameters import LEVEL, MASS, ParameterLayout, mass_ratio
from frictrack.fit.routes import FittedRuns
from frictrack.records import GRAVITY, ROLLING, Array, Run

DIFFERENCE_SEPARATOR = " - "  # separates two addresses whose difference is meant
MAX_INFLATION = 300.0  # ratio of standard deviations from which a model is called nearly unidentifiable
MAX_NAMES_LISTED = 6  # parameters listed of one group
NEGATIVE_STD = 3.0  # standard deviations below zero: significantly negative
MIN_OTHER_RUNS = 2  # that agree with each other
MIN_RATIO = 1.3  # of friction levels; smaller differences are usual between repeats of a run
ALPHA_GROUPS = 0.01  # significance level of a difference between groups of runs
MIN_SPREADS = 5.0  # of the other runs, and standard deviations of the difference
MAX_ROLLING_DEVIATION = 0.03  # relative, of the apparent friction below that of a shape
MAX_ROLLING_RESISTANCE = 0.005  # of a hard wheel
MIN_ROLLING_FRAMES, MIN_ROLLING_TURN = 16, 0.5  # frames, and rad, from which a turn is judged
MIN_ROLLING_R2 = 0.98  # of the angle against the way


def reported_slots(layout: ParameterLayout) -> list[int]:
    """Return the positions of the A unknowns that are reported: all but the friction levels."""
    return [i for i, s in enumerate(layout.slots) if s.effect != LEVEL]


def reported_names(layout: ParameterLayout) -> list[str]:
    """Return the addresses of the A unknowns that are reported."""
    return [layout.names[i] for i in reported_slots(layout)]


def reported_values(problem: LeastSquaresProblem, p: Array, addresses: Sequence[str]) -> Array:
    """Compute the reported values (A,) of some parameters, fitted or tied, for unknowns p (P,)."""
    layout = problem.layout
    known = layout.reported_values(p) | {f"{MASS}.m": problem.pieces[0].mass / mass_ratio(layout, p)}
    return np.array([known[address] for address in addresses])


def reported_by_address(solution: Solution, p: Array) -> dict[str, float]:
    """Return the reported parameters of unknowns p (P,) by address, without friction levels."""
    names = reported_names(solution.problem.layout)
    return dict(zip(names, map(float, reported_values(solution.problem, p, names)), strict=True))


def reported_values_and_jacobian(
    problem: LeastSquaresProblem, p: Array, addresses: Sequence[str] | None = None
) -> tuple[Array, Array]:
    """Compute reported parameters (A,), by default those of `reported_slots`, and their derivatives (A, P)."""
    if addresses is None:
        addresses = reported_names(problem.layout)
    base = reported_values(problem, p, addresses)
    jacobian = np.zeros((len(base), len(p)))
    for j in range(len(p)):  # forward differences
        moved = p.copy()
        moved[j] += (step := 1e-6 * max(abs(p[j]), 1e-3))
        jacobian[:, j] = (reported_values(problem, moved, addresses) - base) / step
    return base, jacobian


def standard_deviations(jacobian: Array, covariance: Array) -> Array:
    """Propagate a covariance (P, P) of the unknowns to quantities with derivatives J (A, P): sqrt(diag(J C J'))."""
    return np.sqrt(np.maximum(np.einsum("ai,ij,aj->a", jacobian, covariance, jacobian), 0.0))


@dataclass(frozen=True)
class Quantity:
    """One reported parameter, or the difference of two (`parts`); the first is the unknown `slot`."""

    address: str
    unit: str
    slot: int
    parts: tuple[str, ...]
    is_unknown: bool = False  # whether it is known to be the unknown itself, reported as it was fitted

    def value(self, problem: LeastSquaresProblem, p: Array) -> float:
        """Compute its value for unknowns p (P,)."""
        return float(p[self.slot] if self.is_unknown else self._signs @ reported_values(problem, p, self.parts))

    def gradient(self, problem: LeastSquaresProblem, p: Array) -> Array:
        """Compute its derivative with respect to the unknowns, (P,)."""
        if self.is_unknown:
            return np.asarray(np.arange(len(p)) == self.slot, dtype=float)
        return np.asarray(self._signs @ reported_values_and_jacobian(problem, p, self.parts)[1])

    @property
    def _signs(self) -> Array:
        return np.array([1.0, -1.0])[: len(self.parts)]


def parse_quantity(layout: ParameterLayout, address: str) -> Quantity:
    """Parse an address: ``"coulomb.F_c"``, ``"vibration.phase[v3]"`` or ``"stribeck.F_s - coulomb.F_c"``."""
    names = reported_names(layout)
    parts = tuple(part.strip() for part in address.split(DIFFERENCE_SEPARATOR))
    unknown = [part for part in parts if part not in names]
    if unknown or len(parts) > 2:
        fixed = [f"{e}.{p}" for e, p in layout.fixed]
        why = "which is fixed" if unknown and unknown[0] in fixed else f"but got {unknown[0] if unknown else address}"
        raise UsageError(f"expected a free parameter of the law ({', '.join(names)}) {why}")
    slot = layout.names.index(parts[0])
    return Quantity(address, layout.slots[slot].unit, slot, parts)


def identifiability_remarks(
    solution: Solution, correlations: Sequence[tuple[str, str, float]], undetermined: Sequence[str]
) -> list[str]:
    """State which parameters are confused with each other, and what would separate them.

    `correlations` are strongly correlated pairs of addresses; `undetermined` addresses have no value.
    """
    groups = _correlated_groups(correlations)
    remarks = [_trade_remark(solution.problem.model, group, correlations) for group in groups]
    return remarks + list(_near_degeneracy_remarks(inflation(solution), groups, undetermined))


def _near_degeneracy_remarks(
    inflation_factor: float, groups: Sequence[Sequence[str]], undetermined: Sequence[str]
) -> Iterator[str]:
    """Whether the model as a whole is nearly unidentifiable, and how that shows."""
    lost = [name for name in undetermined if any(name in group for group in groups)]
    linked = [n for g in groups if set(g) & set(lost) for n in g if n not in undetermined]
    if lost:
        with_it = f", and {_listed_few(linked)} {'goes' if len(linked) == 1 else 'go'} with it" if linked else ""
        why = f"{_listed_few(lost)} {'is' if len(lost) == 1 else 'are'} not determined{with_it}"
    elif inflation_factor > MAX_INFLATION:
        why = f"some of its parameters are known {inflation_factor:.0f} times worse together than each would be alone"
    else:
        return
    yield (
        f"This law is nearly unidentifiable from these runs: {why}. Other values predict the same motion: read none "
        "of them by itself; film more kinds of runs, or take a law with fewer parameters."
    )


def _listed_few(names: Sequence[str]) -> str:
    """Addresses as a list in a sentence, without runs; only the first few of many."""
    own = list(dict.fromkeys(name.split("[")[0] for name in names))
    more = [f"{len(own) - MAX_NAMES_LISTED} more"] if len(own) > MAX_NAMES_LISTED else []
    return join_words([*own[:MAX_NAMES_LISTED], *more])


def inflation(solution: Solution) -> float:
    """Compute how many times the standard deviation of the worst unknown exceeds its value with all others known.

    It is the root of the largest variance inflation factor, friction levels left out (Belsley, Kuh & Welsch 1980,
    Regression Diagnostics, sec. 3.2).
    """
    jac = solution.few_rows[:, reported_slots(solution.problem.layout)]
    covariance, _ = inverse_normal_matrix(jac)
    return float(np.max(np.sqrt(np.diag(covariance)) * np.linalg.norm(jac, axis=0), initial=0.0))


def _correlated_groups(correlations: Sequence[tuple[str, str, float]]) -> list[list[str]]:
    """Parameters that correlations link, directly or through others."""
    groups: list[list[str]] = []
    for a, b, _ in correlations:
        linked = [g for g in groups if a in g or b in g]
        merged = list(dict.fromkeys([*(n for g in linked for n in g), a, b]))
        groups = [g for g in groups if g not in linked] + [merged]
    return groups


def _trade_remark(model: Model, group: Sequence[str], correlations: Sequence[tuple[str, str, float]]) -> str:
    """Sentences about one group of confused parameters."""
    strongest = max((r for a, _, r in correlations if a in group), key=abs)
    own = list(dict.fromkeys(name.split("[")[0] for name in group))
    kinds = list(dict.fromkeys(name.split(".")[0] for name in own))
    named = _listed_few(group)
    how = f"(correlation up to {strongest:+.3f})".replace("-", "\N{MINUS SIGN}")
    if len(own) == 1:
        return f"{named} of different runs are correlated {how}."
    phases = {f"{e.name}.{p.name}" for e in model.effects for p in e.parameters if p.role == "phase"}
    if len(kinds) == 1 and len(own) == 2 and phases & set(own):
        return f"{named} are correlated {how}, because the phase is defined at release."
    confused, advice = next(_confused(model, kinds), None), deciding_experiment(model, kinds)
    text = f"{named} are hard to distinguish {how}: these runs determine a combination of them better than "
    text += "either" if len(own) == 2 else "each"
    if confused:
        text += f"; {confused[0].kind.replace('_', ' ')} is mistaken for {lower_first(confused[0].mistaken_for)}"
    return f"{text}.{f' To separate them, {lower_first(advice)}.' if advice else ''}"


def deciding_experiment(model: Model, names: Sequence[str]) -> str:
    """Return the run that would separate these effects.

    It comes from a pair that is known to be confused, or else from the last effect of the model that names one.
    """
    confused = list(_confused(model, names))
    confirming = [a.confirm for a, b in confused if b.kind.replace("_", " ") in a.confirm.lower()]
    text = [e.confirm for e in model.effects if e.name in names and e.confirm]
    return next(iter((*confirming, *(a.confirm for a, _ in confused), *reversed(text))), "")


def _confused(model: Model, names: Sequence[str]) -> Iterator[tuple[Effect, Effect]]:
    """Yield pairs of effects of which the first states that it is mistaken for the second; the last effect first."""
    mine = [e for e in model.effects if e.name in names]
    for first in reversed(mine):
        for second in mine:
            if first is not second and second.kind.replace("_", " ") in first.mistaken_for.lower():
                yield first, second


def negative_force_remark(solution: Solution, found: Mapping[str, tuple[float | None, float | None]]) -> Iterator[str]:
    """State which coefficients of passive forces are significantly negative; `found` is value and std by address."""
    for effect in solution.problem.model.effects:
        for p in (p for p in effect.parameters if p.passive):
            value, std = found.get(f"{effect.name}.{p.name}", (None, None))
            if value is not None and std is not None and value < -NEGATIVE_STD * std:
                yield (
                    f"{effect.name}.{p.name} = {value:.3g} {p.unit} is negative: this force would drive the mass. "
                    "Dry friction that falls with the speed looks so, and so do an incline of the wrong sign and a "
                    "drive that was not given"
                )


def correlated_noise_remark(solution: Solution) -> Iterator[str]:
    """State that the noise of neighbouring frames is correlated, how strongly, and over how many frames."""
    pieces = [p for p in solution.problem.pieces if p.correlated]
    if pieces:
        rms, time = pieces[0].correlated
        frames = time / float(np.median(np.diff(pieces[0].t)))
        share = rms**2 / float(np.mean(pieces[0].noise ** 2))
        yield (
            f"the noise is not white: {100 * share:.0f} % of its variance is correlated over {frames:.2g} frames "
            f"({1e3 * time:.2g} ms), as a filter in a sensor, mains or air leave it; deviations and tests take it into "
            "account"
        )


def drive_noise_remark(solution: Solution) -> Iterator[str]:
    """State which drives scatter without moving the mass, so that this scatter counts as noise."""
    pieces = [p for p in solution.problem.pieces if p.push]
    noisy = {p.run: p.mass * float(np.sqrt(p.push / np.median(np.diff(p.t)))) for p in pieces}
    if noisy:
        names = solution.problem.layout.run_names
        runs = ", ".join(f"{names[run]} ({sigma:.2g} N)" for run, sigma in noisy.items())
        yield (
            f"errors of the measured drive count as noise of the positions: {runs}; state them with sigma_drive, or "
            "sigma_drive = 0 for a drive that is exact"
        )


def level_remarks(solution: Solution, covariance: Array, reduced_chi2: float, groups: Sequence[str]) -> Iterator[str]:
    """State which run, or group of runs, has another level of dry friction than others, and what may cause that.

    The covariance (P, P) is for noise alone; a misfit widens the standard deviations by the root of `reduced_chi2`.
    """
    layout = solution.problem.layout
    at = np.asarray(layout.levels, dtype=int)
    levels = solution.p[at]
    within = covariance[np.ix_(at, at)] * max(1.0, reduced_chi2) / np.outer(levels, levels)
    yield from describe_level_outliers(layout.run_names, levels, within)
    yield from _differing_groups(np.array(groups), np.log(levels), within)


def _differing_groups(groups: NDArray[np.str_], logs: Array, covariance: Array) -> Iterator[str]:
    """Say which two groups of runs differ most in the level of dry friction, if that is no chance (Student's t)."""
    members = {str(g): groups == g for g in np.unique(groups) if g and len(groups) == len(logs)}
    if len(members) < 2 or (free := sum(int(np.sum(own)) - 1 for own in members.values())) < 1:
        return
    low, *_, high = sorted(members, key=lambda g: float(np.mean(logs[members[g]])))
    spread = sum(float(np.sum((logs[own] - np.mean(logs[own])) ** 2)) for own in members.values()) / free
    contrast = members[high] / np.sum(members[high]) - members[low] / np.sum(members[low])
    departure = float(contrast @ logs) / float(np.sqrt(contrast @ (covariance + spread * np.eye(len(logs))) @ contrast))
    if len(members) * (len(members) - 1) * student_sf(departure, free) < ALPHA_GROUPS:
        yield (
            f"dry friction in the group {high} is {np.exp(contrast @ logs):.3g} times that in the group {low}, so that "
            "one value for all runs holds for neither: frictrack fit --per group fits each"
        )


def describe_level_outliers(names: Sequence[str], levels: Array, covariance: Array) -> Iterator[str]:
    """Describe every run whose level (R,) differs from all others, which agree; the covariance is of log levels.

    Examples
    --------
    >>> import numpy as np
    >>> names = ["v3", "v5", "v7", "v9"]
    >>> found = describe_level_outliers(names, np.array([1.0, 1.02, 4.0, 0.99]), 1e-4 * np.eye(4))
    >>> next(found).split(":")[0]
    'dry friction in v7 is 3.99 times that in the other runs, which agree within 1.5 %'
    >>> list(describe_level_outliers(names, np.array([1.0, 1.1, 0.9, 1.2]), 1e-4 * np.eye(4)))
    []

    """
    logs = np.log(levels)
    for k, name in enumerate(names) if len(levels) > MIN_OTHER_RUNS else ():  # none without dry friction
        contrast = np.where(np.arange(len(names)) == k, 1.0, -1.0 / (len(names) - 1))
        departure, sigma = float(contrast @ logs), float(np.sqrt(contrast @ covariance @ contrast))
        spread = float(np.std(np.delete(logs, k), ddof=1))
        if abs(departure) < max(np.log(MIN_RATIO), MIN_SPREADS * spread, MIN_SPREADS * sigma):
            continue
        ratio = float(np.exp(departure))
        agreement = f"the other runs, which agree within {100 * spread:.2g} %"
        yield (
            f"dry friction in {name} is {ratio:.3g} times that in {agreement}: check its frame rate "
            f"(one that is {ratio**0.5:.3g} times too high does this), its scale ({ratio:.3g} times), its normal load "
            "and its surface"
        )


def rolling_remarks(fitted: FittedRuns) -> Iterator[str]:
    """Yield where friction may be the inertia of a body that rolls, which takes k/(1 + k) of the pull of gravity.

    Its rolling resistance c takes c/((1 + k) tan(incline)) more.
    """
    level = fitted.solution.problem.layout.reported_values(fitted.solution.p).get("coulomb.F_c")
    for run in fitted.runs:
        if run.drive is not None or run.rolling or not run.mass:
            continue
        if turned := _turns_with_its_way(run):
            yield f"{run.name}: {turned}"
        share = (level or 0.0) / (run.mass * abs(GRAVITY * np.sin(run.incline)) or np.inf)
        steepness = max(abs(np.tan(run.incline)), 1e-12)
        for shape, k in sorted(ROLLING.items(), key=lambda one: -one[1]):
            left = share * (1 + k) - k  # of the resistance, over tan(incline)
            if not turned and -MAX_ROLLING_DEVIATION * k < left < MAX_ROLLING_RESISTANCE / steepness:
                yield (
                    f"{run.name}: dry friction takes {format_number(share)} of the pull of gravity, as the inertia of "
                    f'a {shape} that rolls down nearly without friction; if it rolls, give rolling = "{shape}"'
                )
                break


def _turns_with_its_way(run: Run) -> str:
    """Say that the target turns in proportion to its way, as a body that rolls; "" if it does not."""
    x, angle = run.displacement.x, np.asarray(run.displacement.angle, dtype=float)
    known = np.isfinite(x) & np.isfinite(angle)
    if known.sum() < MIN_ROLLING_FRAMES or np.ptp(angle[known]) < MIN_ROLLING_TURN:
        return ""
    turn, correlation = np.polyfit(x[known], angle[known], 1)[0], np.corrcoef(x[known], angle[known])[0, 1]
    if correlation**2 < MIN_ROLLING_R2:
        return ""
    return (
        f"the target turns by one radian in {format_length(abs(1 / turn))}, as a body of that radius that rolls; if it "
        f"rolls, give rolling = {' or '.join(ROLLING)}, since its inertia is no friction"
    )
