"""Search a formula by genetic programming: read a table of forces, write the best expression along it and its text.

    python gplearn_worker.py IN.npz OUT.json

It needs gplearn only, so that it can run in an environment of its own.
"""

from __future__ import annotations

import json
import sys
import time

import numpy as np
from gplearn.fitness import make_fitness
from gplearn.functions import make_function
from gplearn.genetic import SymbolicRegressor

MAX_EXPONENT = 50.0
PARSIMONY = 1e-3  # per node, on a fitness of at most 1
POPULATION = 500


def main() -> None:
    table = np.load(sys.argv[1])
    features, force, law, seconds = table["features"], table["force"], table["law"], float(table["seconds"])
    basis = np.linalg.qr(law)[0]

    def explained(y: np.ndarray, predicted: np.ndarray, _weights: np.ndarray) -> float:
        """Share of the variance beside the law that the expression explains, with the best coefficient."""
        if len(y) != len(force) or not np.all(np.isfinite(predicted)):
            return 0.0
        left, made = (q - basis @ (basis.T @ q) for q in (y, predicted))
        norm = float(made @ made) * float(left @ left)
        return float(left @ made) ** 2 / norm if norm > 1e-12 * float(predicted @ predicted) else 0.0

    exponential = make_function(function=lambda z: np.exp(np.clip(z, -MAX_EXPONENT, MAX_EXPONENT)), name="exp", arity=1)
    tanh = make_function(function=np.tanh, name="tanh", arity=1)
    search = SymbolicRegressor(
        population_size=POPULATION,
        generations=1,
        function_set=("add", "sub", "mul", "div", "sqrt", "log", exponential, tanh),
        metric=make_fitness(function=explained, greater_is_better=True, wrap=False),
        parsimony_coefficient=PARSIMONY,
        const_range=(-10.0, 10.0),
        init_depth=(2, 4),
        warm_start=True,
        feature_names=[str(name) for name in table["names"]],
        random_state=int(table["seed"]),
    )
    begin = time.process_time()
    while time.process_time() - begin < seconds:
        search.fit(features, force)
        search.generations += 1
    found = {
        "formula": str(search._program),
        "force": search._program.execute(features).tolist(),
        "generations": search.generations - 1,
        "cpu_s": time.process_time() - begin,
    }
    with open(sys.argv[2], "w", encoding="utf-8") as out:
        json.dump(found, out)


if __name__ == "__main__":
    main()
