"""Run one search setting with many seeds and record what the papers count.

The first paper does not define "iterations". Only the generation of the *last* improvement agrees with its figures;
other counts are given too. The paper prints seconds; we print ratios of processor times, because seconds depend on the
machine.
"""

from __future__ import annotations

from dataclasses import dataclass
from time import process_time
from typing import Any

import numpy as np

from frictrack.records import Array
from frictrack.reproduce import printed
from frictrack.reproduce.sections import OPEN
from frictrack.search import SearchResult, minimise


@dataclass(frozen=True, eq=False)
class SearchTrials:
    """Results of one setting with many seeds, each (seeds,).

    Attributes
    ----------
    last
        Generation of the last improvement.
    first
        First generation whose cost counts as found; NaN if there is none.
    cost
        Best cost.
    seconds
        Processor time, s.
    converged
        First generation within 1 % of the final cost.

    """

    last: Array
    first: Array
    cost: Array
    seconds: Array
    converged: Array


def run_trials(cost: Any, box: Any, seeds: int, reach: float, budget: int, **options: Any) -> SearchTrials:
    """Run one setting with the seeds 0, 1, 2, ...

    Parameters
    ----------
    cost
        Function of parameter sets (P, d) that returns costs (P,).
    box
        Bounds (d, 2).
    seeds
        Number of seeds.
    reach
        Cost at or below which the optimum counts as found.
    budget
        Evaluations of each search.
    **options
        Settings of `frictrack.search.minimise`.

    Returns
    -------
    SearchTrials
        Counts of all seeds.

    """
    rows = []
    for seed in range(seeds):
        begin = process_time()
        found = minimise(cost, box, rng=np.random.default_rng(seed), max_evaluations=budget, **options)
        rows.append((*_counts(found, reach), process_time() - begin))
    last, first, value, converged, seconds = np.array(rows).T
    return SearchTrials(last, first, value, seconds, converged)


def _counts(found: SearchResult, reach: float) -> tuple[float, float, float, float]:
    """Generations of last improvement and of first success, cost, and generation of convergence."""
    history = found.history
    first = float(np.argmax(history <= reach)) if history[-1] <= reach else np.nan
    converged = float(np.argmax(history <= history[-1] + 0.01 * abs(history[-1])))
    return float(found.generation_of_last_improvement), first, found.cost, converged


def verdict_for(verdict: str, seeds: int) -> str:
    """The verdict, or `OPEN` with fewer seeds than the papers' runs."""
    return verdict if seeds >= printed.RUNS else OPEN
