"""Measure the global searches beside SciPy's differential evolution."""

from __future__ import annotations

import statistics
from collections.abc import Callable
from typing import Any

from identification.optima import ours, peers
from identification.optima.problems import MAX_SSE_RATIO, case
from identification.optima.run import BUDGET, SECONDS

PROBLEMS = ("TM", "ATM1 n=2", "ATM1 n=3", "ATM2 n=2")
REFERENCE, REFERENCE_PROBLEM, REFERENCE_RUNS = "scipy DE best1bin", "ATM1 n=2", 15


def measure(say: Callable[[str], None], restarts: int = 100) -> dict[str, Any]:
    """Successes and median CPU seconds of every problem, and the reference over them."""
    peers.run(REFERENCE_PROBLEM, 0, 500, 1.0, REFERENCE)  # imports and first calls do not count
    budget = BUDGET.get(REFERENCE_PROBLEM, 40_000)
    runs = [peers.run(REFERENCE_PROBLEM, seed, budget, SECONDS, REFERENCE) for seed in range(REFERENCE_RUNS)]
    reference = statistics.median(run["seconds"] for run in runs)
    say(f"{REFERENCE} on {REFERENCE_PROBLEM}: {1e3 * reference:.0f} ms")
    out: dict[str, Any] = {"reference_s": reference}
    for name in PROBLEMS:
        found = [_search(name, seed) for seed in range(restarts)]
        hits = sum(ratio <= MAX_SSE_RATIO for ratio, _ in found)
        seconds = statistics.median(seconds for _, seconds in found)
        out[name] = {"found": hits, "of": len(found), "cpu_s": seconds, "reference_over_it": reference / seconds}
        say(f"{name:10s} {hits} of {len(found)}, {1e3 * seconds:.2f} ms, 1/{reference / seconds:.0f} of the reference")
    return out


def _search(name: str, seed: int) -> tuple[float, float]:
    """Misfit over that of least squares started at the truth, and CPU seconds, of one search."""
    problem = case(name, seed)
    found = ours.varpro(name, problem)
    return found["sse"] / problem.reference, found["seconds"]
