"""Run global optimisers of SciPy and pycma behind the interface of `SearchMethod`.

They bring their own loop. The evaluator ends it when the budget of evaluations is used up.
"""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from typing import Annotated, Any, ClassVar

import numpy as np
from pydantic import Field

from frictrack.base.errors import needs_package
from frictrack.records import Array
from frictrack.search.method import CostEvaluator, SearchMethod, setting

Weight = Annotated[float, Field(ge=0, le=2)]
UNLIMITED_ITERATIONS = 10**9  # iterations: the evaluator's budget decides
DIFFERENCE_STEP = 1e-8  # of the box, the step of a forward difference
MAX_FINITE_COST = 1e100  # stands for an infinite cost where differences are taken


@dataclass(frozen=True)
class DE(SearchMethod):
    """Differential evolution by SciPy: strategy best1bin, the whole population in one call of the cost.

    References
    ----------
    Storn, R. & Price, K. (1997). Differential evolution. Journal of Global Optimization 11, 341-359.

    """

    name: ClassVar[str] = "de"
    population: int = setting(15, ge=1, le=10**6)  # individuals per parameter, but never fewer than 40 in all
    mutation: tuple[Weight, Weight] = setting((0.5, 1.0))  # differential weight, drawn each generation
    recombination: float = setting(0.7, ge=0, le=1)
    # converged when the population's costs scatter by less than this share of their mean
    tolerance: float = setting(1e-8, ge=0)

    def __call__(self, evaluator: CostEvaluator, rng: np.random.Generator) -> None:
        """Search until converged or until the evaluator stops it."""
        from scipy.optimize import differential_evolution  # noqa: PLC0415 - settings are read without it

        def generation(unit: Array) -> Any:  # SciPy's stubs know only the scalar form
            evaluator.end_generation()
            return evaluator(unit.T)

        differential_evolution(
            generation,
            _unit_box(evaluator),
            strategy="best1bin",
            popsize=max(self.population, -(-40 // evaluator.dimension)),
            mutation=self.mutation,
            recombination=self.recombination,
            tol=self.tolerance,
            maxiter=UNLIMITED_ITERATIONS,
            polish=False,
            updating="deferred",
            vectorized=True,
            rng=rng,
        )


@dataclass(frozen=True)
class DA(SearchMethod):
    """Dual annealing by SciPy, with local searches by L-BFGS-B.

    SciPy asks for single points. Only the finite differences of the local searches are evaluated in one vectorised
    call. One generation is about 2 d evaluations, the length of one of its Markov chains.

    References
    ----------
    Tsallis, C. & Stariolo, D. A. (1996). Generalized simulated annealing. Physica A 233, 395-406.
    Xiang, Y. et al. (1997). Generalized simulated annealing algorithm. Physics Letters A 233, 216-220.

    """

    name: ClassVar[str] = "da"
    temperature: float = setting(5230.0, gt=0.01, le=5e4)
    visit: float = setting(2.62, gt=1, le=3)

    def __call__(self, evaluator: CostEvaluator, rng: np.random.Generator) -> None:
        """Search until the evaluator stops it."""
        from scipy.optimize import dual_annealing  # noqa: PLC0415

        box = _unit_box(evaluator)
        chain, closed = 2 * evaluator.dimension, 0

        def cost(unit: Array) -> float:
            nonlocal closed
            if evaluator.evaluations >= closed + chain:
                closed = evaluator.evaluations
                evaluator.end_generation()
            return float(min(evaluator(np.clip(unit, 0.0, 1.0)[None])[0], MAX_FINITE_COST))

        def gradient(unit: Array) -> Array:
            step = np.where(unit < 0.5, DIFFERENCE_STEP, -DIFFERENCE_STEP)
            costs = np.minimum(evaluator(np.vstack([unit, unit + np.diag(step)])), MAX_FINITE_COST)
            return (costs[1:] - costs[0]) / step

        local: Any = {
            "method": "L-BFGS-B",
            "jac": gradient,
            "bounds": box,
            "options": {"maxiter": max(100, 6 * evaluator.dimension)},  # SciPy's own limit
        }
        dual_annealing(
            cost,
            box,
            minimizer_kwargs=local,
            initial_temp=self.temperature,
            visit=self.visit,
            maxiter=UNLIMITED_ITERATIONS,
            maxfun=UNLIMITED_ITERATIONS,
            rng=rng,
        )


@dataclass(frozen=True)
class CMAES(SearchMethod):
    """Covariance matrix adaptation (CMA-ES) by the optional package cma; every restart doubles the population (IPOP).

    The package cannot search along a single parameter. There a second parameter without effect is added.

    References
    ----------
    Hansen, N. & Ostermeier, A. (2001). Completely derandomized self-adaptation in evolution strategies. Evolutionary
    Computation 9, 159-195.
    Auger, A. & Hansen, N. (2005). A restart CMA evolution strategy with increasing population size. IEEE CEC,
    1769-1776.

    """

    name: ClassVar[str] = "cmaes"
    sigma: float = setting(0.3, gt=0, le=10)  # first step length, share of the box
    population: int | None = setting(None, ge=4, le=10**6)  # None: 4 + 3 ln d

    def __call__(self, evaluator: CostEvaluator, rng: np.random.Generator) -> None:
        """Search, restarting from random points, until the evaluator stops it."""
        cma = _cma()
        d = max(2, evaluator.dimension)
        population = self.population or 4 + int(3 * np.log(d))
        while True:
            strategy = cma.CMAEvolutionStrategy(
                rng.random(d),
                self.sigma,
                {
                    "popsize": population,
                    "bounds": [0.0, 1.0],
                    "seed": float("nan"),  # leave numpy's global state alone
                    "randn": lambda *shape: rng.standard_normal(shape),
                    "verbose": -9,
                },
            )
            while not strategy.stop():
                evaluator.end_generation()
                unit = np.array(strategy.ask())
                strategy.tell(list(unit), evaluator(unit[:, : evaluator.dimension]).tolist())
            population *= 2


def _unit_box(evaluator: CostEvaluator) -> Any:
    from scipy.optimize import Bounds  # noqa: PLC0415

    return Bounds(np.zeros(evaluator.dimension), np.ones(evaluator.dimension))


def _cma() -> Any:
    """Import the package cma on first use: it is optional and slow to import."""
    with needs_package("search cmaes", "cma"):
        return import_module("cma")
