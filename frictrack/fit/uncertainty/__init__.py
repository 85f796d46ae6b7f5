"""Compute the uncertainty of fitted parameters: estimates, profile likelihood, and the parametric bootstrap.

Every draw is the simulated motion with new noise and, where friction levels scatter between runs, new levels. It is
refined from the fit, and the scatter is estimated again. Where a residual is correlated (the model misses something,
or a run is cut into segments), its blocks keep their shape and get random signs (wild cluster bootstrap). Intervals
are studentised: quantiles of (drawn - fitted)/(standard deviation in the draw).

References
----------
Efron, B. & Tibshirani, R. J. (1993). An Introduction to the Bootstrap, ch. 12. Chapman & Hall.
Cameron, A. C., Gelbach, J. B. & Miller, D. L. (2008). Bootstrap-based improvements for inference with clustered
errors. Review of Economics and Statistics 90, 414-427.

"""

# ruff: noqa: F401 - the imports are the interface

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from frictrack.base.arguments import checked
from frictrack.base.distributions import RNG
from frictrack.base.errors import FrictrackError, UsageError
from frictrack.base.workers import one_thread
from frictrack.fit.least_squares import (
    LeastSquaresProblem,
    PieceResponse,
    Solution,
    fit_with_scatter,
    white_noise_covariance,
)
from frictrack.fit.least_squares.solution import batch_count
from frictrack.fit.parameters import MIN_RUNS_FOR_SCATTER
from frictrack.fit.routes import FittedRuns, require_one_fit
from frictrack.fit.uncertainty.estimates import Estimate, dispersion, linear_estimates
from frictrack.fit.uncertainty.profile_likelihood import Profile, profile
from frictrack.fit.uncertainty.reported import (
    MIN_RATIO,
    describe_level_outliers,
    negative_force_remark,
    reported_by_address,
    reported_names,
    reported_values_and_jacobian,
    standard_deviations,
)
from frictrack.records import Array

MIN_DRAWS = 20  # fewer give no standard deviation
WHITE_LIMIT = 4.0  # times 1/sqrt(frames): a smaller autocorrelation counts as white
MAX_LAG_FRAMES = 40  # largest lag at which correlation is computed
MIN_BLOCKS = 8  # least number of blocks of a correlated residual

Progress = Callable[[int, int, str], None]
Interval = tuple[float | None, float | None]


@dataclass(frozen=True, eq=False)
class Bootstrap:
    """Drawn parameters and their intervals.

    Attributes
    ----------
    names : list of str
        Addresses of the A parameters.
    fitted, std_fitted : array of shape (A,)
        Fitted values and standard deviations.
    values, stds : array of shape (D, A)
        Values and standard deviations in the D draws.
    scatter : array of shape (D,)
        Standard deviation of the friction level in every draw.
    level : float
        Confidence level of the intervals.
    failed : int
        Draws without a result; `reasons` states why.
    correlated : list of str
        Runs whose residual was drawn in blocks.

    """

    names: list[str]
    fitted: Array
    std_fitted: Array
    values: Array
    stds: Array
    scatter: Array
    level: float = 0.95
    failed: int = 0
    reasons: list[str] = field(default_factory=list)
    correlated: list[str] = field(default_factory=list)

    @property
    def std(self) -> dict[str, float]:
        """Standard deviation of the draws."""
        return self._by_name(np.std(self.values, axis=0, ddof=1))

    @property
    def bias(self) -> dict[str, float]:
        """Mean of the draws minus the fitted value."""
        return self._by_name(np.mean(self.values, axis=0) - self.fitted)

    @property
    def percentiles(self) -> dict[str, tuple[float, float]]:
        """Central interval of the draws."""
        return self._by_name(self._central(self.values).T)

    @property
    def intervals(self) -> dict[str, tuple[float, float]]:
        """Studentised intervals."""
        with np.errstate(divide="ignore", invalid="ignore"):
            low, high = self._central(np.nan_to_num((self.values - self.fitted) / self.stds))
        return self._by_name((self.fitted - np.array([high, low]) * self.std_fitted).T)

    def _central(self, drawn: Array) -> Array:
        """Both ends (2, A) between which the draws (D, A) lie with the stated probability."""
        return np.quantile(drawn, [0.5 - self.level / 2, 0.5 + self.level / 2], axis=0, method="weibull")

    def _by_name(self, numbers: Array) -> dict[str, Any]:
        """One number, or a tuple of several, by address."""
        each = (tuple(one) if isinstance(one, list) else one for one in numbers.tolist())
        return dict(zip(self.names, each, strict=True))

    def summary(self) -> dict[str, Any]:
        """Return JSON."""
        found: dict[str, dict[str, Any]] = {
            "std": self.std,
            "bias": self.bias,
            "percentiles": self.percentiles,
            "interval": self.intervals,
        }
        parameters = {name: {key: each[name] for key, each in found.items()} for name in self.names}
        own = {key: getattr(self, key) for key in ("failed", "reasons", "level", "correlated")}
        return {"draws": len(self.values)} | own | {"parameters": parameters}


@checked
@one_thread()
def bootstrap(
    result: FittedRuns,
    draws: int = 200,
    *,
    rng: RNG = 0,
    level: float = 0.95,
    progress: Progress | None = None,
) -> Bootstrap:
    """Draw new data from a fit and fit them again.

    Parameters
    ----------
    result : Fit
        The fit.
    draws : int
        Number of draws, at least 20.
    rng : numpy.random.Generator or int or None
        Random numbers: a generator, a seed, or None for other numbers in every call.
    level : float
        Confidence level of the intervals.
    progress : callable, optional
        Called with the number done, the total, and "draws".

    Returns
    -------
    Bootstrap
        The draws.

    Raises
    ------
    FrictrackError
        (usage) For fewer than 20 draws, or if too few draws give a result.

    References
    ----------
    Efron, B. & Tibshirani, R. J. (1993). An Introduction to the Bootstrap, ch. 12. Chapman & Hall.

    Examples
    --------
    >>> import frictrack as ft
    >>> fit = ft.fit(["coulomb", "viscous", "patch"], ft.samples.runs()[:2])
    >>> draws = ft.bootstrap(fit, 20, rng=1)
    >>> draws.names[:2], draws.values.shape
    (['coulomb.F_c', 'viscous.F_v'], (20, 5))

    """
    if draws < MIN_DRAWS:
        raise UsageError(f"expected at least {MIN_DRAWS} draws for a deviation but got {draws}")
    require_one_fit(result)
    generator = np.random.default_rng(rng)
    solution, law, layout = result.solution, result.compared, result.solution.problem.layout
    blocks = [_block_length(r) for r in solution.responses]
    found: list[tuple[Array, Array, float]] = []
    reasons: list[str] = []
    for k in range(draws):
        try:
            drawn = _drawn_problem(solution, blocks, generator)
            found.append(_reported_with_std(fit_with_scatter(drawn, law.p, law.starts, law.tau or 0.03)))
        except (FrictrackError, np.linalg.LinAlgError) as e:
            reasons.append(str(e))
        if progress is not None:
            progress(k + 1, draws, "draws")
    if len(found) < MIN_DRAWS:
        raise FrictrackError(f"only {len(found)} of {draws} draws gave a law; the first failed because {reasons[0]}")
    values, stds, scatter = (np.array(column) for column in zip(*found, strict=True))
    fitted, std, _ = _reported_with_std(result.compared)
    in_blocks = [layout.run_names[r.piece.run] for r, b in zip(solution.responses, blocks, strict=True) if b]
    failed, correlated = sorted(set(reasons)), list(dict.fromkeys(in_blocks))
    names = reported_names(layout)
    return Bootstrap(names, fitted, std, values, stds, scatter, level, len(reasons), failed, correlated)


def _reported_with_std(solution: Solution) -> tuple[Array, Array, float]:
    """Reported parameters (A,), their standard deviations (A,), and the scatter of the levels."""
    values, jacobian = reported_values_and_jacobian(solution.problem, solution.p)
    covariance, _ = white_noise_covariance(solution)
    return values, standard_deviations(jacobian, covariance), solution.tau


def _drawn_problem(solution: Solution, blocks: Sequence[int], rng: np.random.Generator) -> LeastSquaresProblem:
    """The problem with new data from the fitted model."""
    layout, responses = solution.problem.layout, solution.responses
    if len(layout.levels) >= MIN_RUNS_FOR_SCATTER:
        p = solution.p.copy()
        p[layout.levels] = 1 + solution.tau * rng.standard_normal(len(layout.levels))
        responses = solution.problem.evaluate(np.clip(p, *layout.bounds), solution.starts)
    noise = _noise(solution, blocks, rng)
    pieces = [replace(r.piece, y=r.model_y + r.piece.coloured(e)) for r, e in zip(responses, noise, strict=True)]
    return solution.problem.rebuild(layout, pieces)


def _noise(solution: Solution, blocks: Sequence[int], rng: np.random.Generator) -> list[Array]:
    """Noise of every piece in units of sigma: white, or its own residual with random signs of its blocks."""
    if any(r.piece.cut for r in solution.responses):  # unmodelled forces are correlated between neighbouring segments
        count = batch_count(solution)
        sizes = [len(part) for part in np.array_split(np.arange(len(blocks)), count)]
        signs = np.repeat(rng.choice([-1.0, 1.0], count), sizes)
        inflation = np.sqrt(count / (count - 1))
        return [inflation * sign * r.r_full for sign, r in zip(signs, solution.responses, strict=True)]
    return [_wild_residual(r, block, rng) for r, block in zip(solution.responses, blocks, strict=True)]


def _wild_residual(response: PieceResponse, block: int, rng: np.random.Generator) -> Array:
    """The residual of one piece with random signs of its blocks; white noise if it is uncorrelated."""
    n = len(response.r_full)
    if not block:
        return rng.standard_normal(n)
    first = rng.integers(block)  # random block boundaries in every draw
    block_of_frame = (np.arange(n) + first) // block
    inflation = np.sqrt(n / max(n - len(response.active) - 2, 1))
    return np.asarray(inflation * rng.choice([-1.0, 1.0], block_of_frame[-1] + 1)[block_of_frame] * response.r_full)


def _block_length(response: PieceResponse) -> int:
    """Frames per block of a correlated residual: three times the range of its correlation; 0 where it is white."""
    r = response.r_full
    n = len(r)
    max_lag = min(MAX_LAG_FRAMES, n // 4)
    autocorrelation = np.array([r[k:] @ r[: n - k] for k in range(max_lag + 1)]) / max(float(r @ r), 1e-300)
    if np.all(np.abs(autocorrelation[1:4]) < WHITE_LIMIT / np.sqrt(n)):
        return 0
    uncorrelated = np.flatnonzero(autocorrelation < WHITE_LIMIT / np.sqrt(n) / 2)
    reach = int(uncorrelated[0]) if len(uncorrelated) else max_lag
    return int(min(max(3 * reach, 3), max(n // MIN_BLOCKS, 1)))


@dataclass(frozen=True)
class UncertaintyAnalysis:
    """Profiles and a bootstrap of one fit, where they were computed."""

    profiles: tuple[Profile, ...] = ()
    bootstrap: Bootstrap | None = None

    @property
    def intervals(self) -> dict[str, Interval]:
        """Intervals by address: from a profile, or else from the bootstrap."""
        from_bootstrap: dict[str, Interval] = {} if self.bootstrap is None else dict(self.bootstrap.intervals)
        return from_bootstrap | {p.address: (p.low, p.high) for p in self.profiles}

    def summary(self) -> dict[str, Any]:
        """Return JSON with `profiles` and `bootstrap`, where they were computed."""
        out: dict[str, Any] = {}
        if self.profiles:
            out["profiles"] = {p.address: p.summary() for p in self.profiles}
        if self.bootstrap is not None:
            out["bootstrap"] = self.bootstrap.summary()
        return out


@one_thread()
def analyse_uncertainty(
    result: FittedRuns,
    *,
    profiles: bool = True,
    draws: int = 0,
    rng: RNG = 0,
    progress: Progress | None = None,
) -> UncertaintyAnalysis:
    """Compute the profiles of all shared parameters of a fit, and a bootstrap.

    Parameters
    ----------
    result : Fit
        The fit.
    profiles : bool
        Whether to compute profiles.
    draws : int
        Number of bootstrap draws; 0 for none.
    rng : numpy.random.Generator or int or None
        Seed of the bootstrap.
    progress : callable, optional
        Called with the number done, the total, and what is computed.

    Returns
    -------
    UncertaintyAnalysis
        Profiles and bootstrap.

    Raises
    ------
    FrictrackError
        (usage) For fits of groups.

    """
    require_one_fit(result)
    slots = result.solution.problem.layout.slots if profiles else ()
    addresses = [f"{s.effect}.{s.parameter}" for s in slots if s.run is None]
    profile_list = []
    for k, address in enumerate(addresses):
        profile_list.append(profile(result, address))
        if progress is not None:
            progress(k + 1, len(addresses), "profiles")
    from_bootstrap = bootstrap(result, draws, rng=rng, progress=progress) if draws else None
    return UncertaintyAnalysis(tuple(profile_list), from_bootstrap)


def merge_uncertainty(summary: Mapping[str, Any], found: Mapping[str, Any]) -> dict[str, Any]:
    """Merge the JSON of a fit with that of its `UncertaintyAnalysis`: parameters get their intervals."""
    from_bootstrap = {name: b["interval"] for name, b in found.get("bootstrap", {}).get("parameters", {}).items()}
    intervals = from_bootstrap | {name: [p["low"], p["high"]] for name, p in found.get("profiles", {}).items()}
    parameters = {
        k: p | ({"interval": intervals[k]} if k in intervals else {}) for k, p in summary["parameters"].items()
    }
    return {**summary, "parameters": parameters, **found}
