"""One search setting over many seeds: what the papers count, counted.

"Iterations" has no definition in the first paper. The only one that meets its figures is the generation of the *last*
improvement; others stand beside it. Where the paper prints seconds, we print the ratio of processor times: seconds
belong to a machine.
"""

from __future__ import annotations

from dataclasses import dataclass
from time import process_time
from typing import Any

import numpy as np

from frictrack.records import Array
from frictrack.reproduce import printed
from frictrack.reproduce.parts import OPEN
from frictrack.search import SearchResult, minimise


@dataclass(frozen=True, eq=False)
class Trials:
    """One setting over many seeds; every field (seeds,)."""

    last: Array  # generation of the last improvement
    first: Array  # first generation within reach of the optimum, NaN where never
    cost: Array  # the best cost
    seconds: Array  # processor time
    settled: Array  # first generation within 1 % of the run's own end


def trials(cost: Any, box: Any, seeds: int, reach: float, budget: int, **how: Any) -> Trials:
    """Run one setting over many seeds; `reach` is the cost that counts as found."""
    rows = []
    for seed in range(seeds):
        begin = process_time()
        found = minimise(cost, box, rng=np.random.default_rng(seed), max_evaluations=budget, **how)
        rows.append((*_counts(found, reach), process_time() - begin))
    last, first, value, settled, seconds = np.array(rows).T
    return Trials(last, first, value, seconds, settled)


def _counts(found: SearchResult, reach: float) -> tuple[float, float, float, float]:
    history = found.history
    first = float(np.argmax(history <= reach)) if history[-1] <= reach else np.nan
    settled = float(np.argmax(history <= history[-1] + 0.01 * abs(history[-1])))
    return float(found.generation_of_last_improvement), first, found.cost, settled


def judged(verdict: str, seeds: int) -> str:
    """No verdict on a few seeds."""
    return verdict if seeds >= printed.RUNS else OPEN
