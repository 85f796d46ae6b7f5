"""Run other optimisers on the same problems as their manuals show; run by a Python that has them:

    python peers.py PROBLEM SEEDS BUDGET SECONDS PEER        (JSON on stdout, one object per seed)

    python -m venv peers && peers/bin/pip install scipy cma lmfit iminuit pymoo pygad deap

All search the same box with the same cost, the whole population at once where the interface allows. A run stops at
success, at its budget of evaluations, or when its CPU seconds are spent; one guess means the middle of the box.
"""

from __future__ import annotations

import contextlib
import importlib.util
import json
import sys
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

if __package__:
    from .problems import PROBLEMS, Array, Case, case
else:
    sys.path.insert(0, str(Path(__file__).resolve().parent))
    from problems import PROBLEMS, Array, Case, case  # type: ignore[import-not-found,no-redef]


class Done(Exception):
    """Success, or budget or time spent."""


class Cost:
    """The counted cost in the unit box; raises `Done` when the run is over."""

    def __init__(self, problem: Case, budget: int, seconds: float) -> None:
        self.case, self.budget = problem, budget
        self.low, high = problem.law.box.T
        self.width = high - self.low
        self.best, self.evaluations = np.inf, 0
        self.until = time.process_time() + seconds

    @property
    def d(self) -> int:
        """Number of parameters."""
        return len(self.low)

    def many(self, unit: Array) -> Array:
        """Costs (P,) of points (P, d)."""
        points = self.low + self.width * np.clip(np.atleast_2d(unit), 0.0, 1.0)
        costs = self.case.sse(points)
        self.evaluations += len(costs)
        self.best = min(self.best, float(costs.min()))
        if self.best <= self.case.target or self.evaluations >= self.budget or time.process_time() > self.until:
            raise Done
        return costs

    def one(self, unit: Array) -> float:
        """Cost of one point (d,)."""
        return float(self.many(np.asarray(unit, dtype=float)[None])[0])

    def residual(self, unit: Array) -> Array:
        """Residuals (n,) of one point."""
        self.one(unit)
        return self.case.data - self.case.law.force((self.low + self.width * np.clip(unit, 0, 1))[None])[0]


def scipy_de(cost: Cost, seed: int) -> None:
    from scipy.optimize import differential_evolution  # noqa: PLC0415

    differential_evolution(
        lambda x: cost.many(x.T), [(0, 1)] * cost.d, strategy="best1bin", vectorized=True, updating="deferred",
        maxiter=10**6, polish=False, tol=0, rng=seed,
    )  # fmt: skip


def scipy_dual_annealing(cost: Cost, seed: int) -> None:
    from scipy.optimize import dual_annealing  # noqa: PLC0415

    dual_annealing(cost.one, [(0, 1)] * cost.d, maxiter=10**6, maxfun=10**9, rng=seed)


def multistart_least_squares(cost: Cost, seed: int) -> None:
    from scipy.optimize import least_squares  # noqa: PLC0415

    rng = np.random.default_rng(seed)
    while True:
        least_squares(cost.residual, rng.random(cost.d), bounds=(0, 1))


def cma_bipop(cost: Cost, seed: int) -> None:
    import cma  # noqa: PLC0415

    rng = np.random.default_rng(seed)
    options = {"bounds": [0, 1], "seed": seed + 1, "verbose": -9}
    while True:
        cma.fmin2(
            None,
            lambda: rng.random(cost.d),
            0.3,
            parallel_objective=lambda xs: list(cost.many(np.array(xs))),
            bipop=True,
            restarts=9,
            options=options,
        )


def pymoo_de(cost: Cost, seed: int) -> None:
    from pymoo.algorithms.soo.nonconvex.de import DE  # noqa: PLC0415

    _pymoo(cost, DE(), seed)


def pymoo_ga(cost: Cost, seed: int) -> None:
    from pymoo.algorithms.soo.nonconvex.ga import GA  # noqa: PLC0415

    _pymoo(cost, GA(pop_size=100), seed)


def _pymoo(cost: Cost, algorithm: Any, seed: int) -> None:
    from pymoo.core.problem import Problem  # noqa: PLC0415
    from pymoo.optimize import minimize  # noqa: PLC0415

    class Box(Problem):  # type: ignore[misc]
        def __init__(self) -> None:
            super().__init__(n_var=cost.d, n_obj=1, xl=0.0, xu=1.0)

        def _evaluate(self, x: Array, out: dict[str, Any], *_: Any, **__: Any) -> None:
            out["F"] = cost.many(x)

    minimize(Box(), algorithm, ("n_gen", 10**6), seed=seed)


def pygad_ga(cost: Cost, seed: int) -> None:
    import pygad  # noqa: PLC0415

    pygad.GA(
        num_generations=10**5, num_parents_mating=20, sol_per_pop=50, num_genes=cost.d,
        gene_space={"low": 0, "high": 1},
        fitness_func=lambda _, x, __: list(1 / cost.many(np.array(x))), fitness_batch_size=50, random_seed=seed,
        suppress_warnings=True,
    ).run()  # fmt: skip


def deap_ga(cost: Cost, seed: int) -> None:
    import random  # noqa: PLC0415

    from deap import algorithms, base, creator, tools  # noqa: PLC0415

    random.seed(seed)
    if not hasattr(creator, "Least"):
        creator.create("Least", base.Fitness, weights=(-1.0,))
        creator.create("Point", list, fitness=creator.Least)
    box = base.Toolbox()
    box.register("gene", random.random)
    box.register("individual", tools.initRepeat, creator.Point, box.gene, cost.d)
    box.register("population", tools.initRepeat, list, box.individual)
    box.register("mate", tools.cxBlend, alpha=0.5)
    box.register("mutate", tools.mutGaussian, mu=0, sigma=0.1, indpb=0.2)
    box.register("select", tools.selTournament, tournsize=3)
    box.register("evaluate", lambda x: x)
    box.register("map", lambda _, xs: [(c,) for c in cost.many(np.array(list(xs)))])
    algorithms.eaSimple(box.population(n=100), box, 0.5, 0.2, 10**6, verbose=False)


def lmfit_one_guess(cost: Cost, seed: int) -> None:
    import lmfit  # noqa: PLC0415

    p = lmfit.Parameters()
    for i, value in enumerate(np.random.default_rng(seed).uniform(0.3, 0.7, cost.d)):
        p.add(f"p{i}", value=value, min=0, max=1)
    lmfit.minimize(lambda q: cost.residual(np.array([q[k].value for k in q])), p)


def iminuit_one_guess(cost: Cost, seed: int) -> None:
    from iminuit import Minuit  # noqa: PLC0415

    m = Minuit(cost.one, np.random.default_rng(seed).uniform(0.3, 0.7, cost.d))
    m.limits = [(0, 1)] * cost.d
    m.migrad()


PEERS: dict[str, tuple[str, Callable[[Cost, int], None]]] = {
    "scipy DE best1bin": ("scipy", scipy_de),
    "scipy dual annealing": ("scipy", scipy_dual_annealing),
    "multistart least squares": ("scipy", multistart_least_squares),
    "cma BIPOP": ("cma", cma_bipop),
    "pymoo DE": ("pymoo", pymoo_de),
    "pymoo GA": ("pymoo", pymoo_ga),
    "PyGAD": ("pygad", pygad_ga),
    "DEAP eaSimple": ("deap", deap_ga),
    "lmfit, one guess": ("lmfit", lmfit_one_guess),
    "iminuit, one guess": ("iminuit", iminuit_one_guess),
}


def run(name: str, seed: int, budget: int, seconds: float, peer: str) -> dict[str, Any]:
    """One peer on one problem: best SSE over the reference, CPU seconds, evaluations."""
    problem = case(name, seed)
    cost = Cost(problem, budget, seconds)
    start = time.process_time()
    with contextlib.suppress(Done):
        PEERS[peer][1](cost, seed)
    return {
        "ratio": cost.best / problem.reference,
        "seconds": time.process_time() - start,
        "evaluations": cost.evaluations,
    }


def main() -> None:
    name, seeds, budget, seconds, peer = sys.argv[1:]
    assert name in PROBLEMS
    warnings.simplefilter("ignore")
    if importlib.util.find_spec(PEERS[peer][0]) is None:
        print("null")
        return
    run(name, 0, 500, 1.0, peer)  # imports and first calls do not count
    print(json.dumps([run(name, seed, int(budget), float(seconds), peer) for seed in range(int(seeds))]))


if __name__ == "__main__":
    main()
