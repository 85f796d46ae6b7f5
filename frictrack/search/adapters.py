"""Peers from SciPy and pycma behind the same interface. They bring their own loop; the ledger ends it."""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from typing import Any

import numpy as np
from scipy.optimize import Bounds, differential_evolution, dual_annealing

from frictrack.errors import FrictrackError
from frictrack.records import Array
from frictrack.search.ledger import Ledger

ENDLESS = 10**9  # iterations: the ledger's budget decides
DIFFERENCE = 1e-8  # of the box, the step of a forward difference
HUGE = 1e100  # stands for an infinite cost where differences are taken


@dataclass(frozen=True)
class DE:
    """Differential evolution (Storn & Price 1997) by SciPy: best1bin, the whole population in one call."""

    population: int = 15  # individuals per parameter, but never fewer than 40 in all
    mutation: tuple[float, float] = (0.5, 1.0)  # differential weight, drawn anew each generation
    recombination: float = 0.7
    tolerance: float = 1e-8  # converged when the population's costs scatter by less than this share of their mean

    def __call__(self, ledger: Ledger, rng: np.random.Generator) -> None:
        """Search until converged or until the ledger stops it."""

        def generation(unit: Array) -> Any:  # SciPy's stubs know only the scalar form
            ledger.close()
            return ledger(unit.T)

        differential_evolution(
            generation,
            _unit_box(ledger),
            strategy="best1bin",
            popsize=max(self.population, -(-40 // ledger.dimension)),
            mutation=self.mutation,
            recombination=self.recombination,
            tol=self.tolerance,
            maxiter=ENDLESS,
            polish=False,
            updating="deferred",
            vectorized=True,
            rng=rng,
        )


@dataclass(frozen=True)
class DA:
    """Dual annealing (Tsallis & Stariolo 1996; Xiang et al. 1997) by SciPy, with its local searches (L-BFGS-B).

    It asks for single points, except that the local searches take their differences from one vectorised call. A
    generation is about 2 d evaluations, the length of one of its Markov chains.
    """

    temperature: float = 5230.0
    visit: float = 2.62

    def __call__(self, ledger: Ledger, rng: np.random.Generator) -> None:
        """Search until the ledger stops it."""
        box = _unit_box(ledger)
        chain, closed = 2 * ledger.dimension, 0

        def cost(unit: Array) -> float:
            nonlocal closed
            if ledger.evaluations >= closed + chain:
                closed = ledger.evaluations
                ledger.close()
            return float(min(ledger(np.clip(unit, 0.0, 1.0)[None])[0], HUGE))

        def gradient(unit: Array) -> Array:
            step = np.where(unit < 0.5, DIFFERENCE, -DIFFERENCE)
            costs = np.minimum(ledger(np.vstack([unit, unit + np.diag(step)])), HUGE)
            return (costs[1:] - costs[0]) / step

        local: Any = {
            "method": "L-BFGS-B",
            "jac": gradient,
            "bounds": box,
            "options": {"maxiter": max(100, 6 * ledger.dimension)},  # SciPy's own limit
        }
        dual_annealing(
            cost,
            box,
            minimizer_kwargs=local,
            initial_temp=self.temperature,
            visit=self.visit,
            maxiter=ENDLESS,
            maxfun=ENDLESS,
            rng=rng,
        )


@dataclass(frozen=True)
class CMAES:
    """CMA-ES (Hansen & Ostermeier 2001) by the optional package cma; each restart doubles the population (IPOP).

    The package cannot search along one parameter, so a second one without effect is added there.
    """

    sigma: float = 0.3  # first step length, share of the box
    population: int | None = None  # None: 4 + 3 ln d

    def __call__(self, ledger: Ledger, rng: np.random.Generator) -> None:
        """Search, restarting from random points, until the ledger stops it."""
        cma = _cma()
        d = max(2, ledger.dimension)
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
                ledger.close()
                unit = np.array(strategy.ask())
                strategy.tell(list(unit), ledger(unit[:, : ledger.dimension]).tolist())
            population *= 2


def _unit_box(ledger: Ledger) -> Bounds:
    return Bounds(np.zeros(ledger.dimension), np.ones(ledger.dimension))


def _cma() -> Any:
    """The package cma, imported only when asked for (it is slow to import, and optional)."""
    try:
        return import_module("cma")
    except ImportError:
        raise FrictrackError(
            "search cmaes: expected the package cma but it is not installed; run: pip install cma"
        ) from None
