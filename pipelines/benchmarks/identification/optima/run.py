"""Run all optimisers on all problems and write the tables.

python -m pipelines.benchmarks.identification ... --only optima
"""

from __future__ import annotations

import json
import os
import subprocess
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from . import ours
from .peers import PEERS
from .problems import MAX_SSE_RATIO, PROBLEMS, case

BUDGET = {"ATM1 n=3": 60_000, "ATM2 n=2": 30_000}  # evaluations; 40 000 else
SECONDS = 2.5  # CPU, of a peer's run
REDUCED = 4000  # evaluations over the non-linear parameters alone
GENETIC = ("ga", "mga", "sga")
ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
Say = Callable[[str], None]
Row = dict[str, Any]


@dataclass(frozen=True)
class Plan:
    """What is run: problems, seeds of the default search, of the others, and the Python that has the peers."""

    problems: Sequence[str] = tuple(PROBLEMS)
    seeds: int = 1000
    other_draws: int = 30
    python: str | None = None


def compare(plan: Plan, say: Say) -> dict[str, Any]:
    """Run everything; figures by problem and optimiser."""
    say(f"\nsuccess: SSE at most {MAX_SSE_RATIO:g} times that of least squares started at the truth; CPU of one thread")
    out: dict[str, Any] = {}
    for name in plan.problems:
        rows: dict[str, Row] = {"frictrack varpro": _summary([_ours(name, seed) for seed in range(plan.seeds)])}
        rows["frictrack varpro"]["cold_ms"] = 1e3 * ours.varpro(name, case(name, 0), cold=True)["seconds"]
        say(table(name, rows, head=True))
        for label, search in _genetic(name).items():
            rows[label] = _summary([_judged(name, seed, search) for seed in range(plan.other_draws)])
            say(table(name, {label: rows[label]}))
        for peer in PEERS if plan.python else ():
            found = _peer(name, peer, plan)
            if found is not None:
                rows[peer] = found
                say(table(name, {peer: found}))
        out[name] = {"rows": rows, "us_per_evaluation": ours.per_evaluation(name)}
        say("us per evaluation: " + ", ".join(f"{k} {v:.1f}" for k, v in out[name]["us_per_evaluation"].items()))
    return out


def _genetic(name: str) -> dict[str, Callable[[Any], Row]]:
    budget = BUDGET.get(name, 40_000)
    out: dict[str, Callable[[Any], Row]] = {}
    for method in GENETIC:
        for over, most in (("all", budget), ("nonlinear", REDUCED)):
            out[f"frictrack {method}, {over}"] = lambda c, m=method, o=over, b=most: ours.papers(name, c, m, o, b)  # type: ignore[misc]
    return out


def _ours(name: str, seed: int) -> Row:
    return _judged(name, seed, lambda c: ours.varpro(name, c))


def _judged(name: str, seed: int, search: Callable[[Any], Row]) -> Row:
    problem = case(name, seed)
    found = search(problem)
    return found | {"ratio": found["sse"] / problem.reference}


def _peer(name: str, peer: str, plan: Plan) -> Row | None:
    script = Path(__file__).with_name("peers.py")
    call = [
        str(plan.python),
        str(script),
        name,
        str(plan.other_draws),
        str(BUDGET.get(name, 40_000)),
        str(SECONDS),
        peer,
    ]
    done = subprocess.run(call, capture_output=True, text=True, check=False, env=os.environ | ONE_THREAD)
    rows = json.loads(done.stdout.splitlines()[-1]) if done.returncode == 0 and done.stdout else None
    return None if rows is None else _summary(rows)


def _summary(rows: list[Row]) -> Row:
    """Success, and of successful runs the median CPU and evaluations; ERT: all CPU over the number of successes."""
    hit = np.array([r["ratio"] <= MAX_SSE_RATIO for r in rows])
    seconds, evaluations = (np.array([r[key] for r in rows], dtype=float) for key in ("seconds", "evaluations"))
    return {
        "success": int(hit.sum()),
        "runs": len(rows),
        "ms": float(1e3 * np.median(seconds[hit])) if hit.any() else float("nan"),
        "worst_ms": float(1e3 * seconds[hit].max()) if hit.any() else float("nan"),
        "evaluations": float(np.median(evaluations[hit])) if hit.any() else float("nan"),
        "ert_ms": float(1e3 * seconds.sum() / hit.sum()) if hit.any() else float("inf"),
        "ratio": float(np.median([r["ratio"] for r in rows])),
        "missed": [int(i) for i in np.flatnonzero(~hit)],
    }


def table(name: str, rows: dict[str, Row], head: bool = False) -> str:
    """Lines of the table of one problem."""
    lines = []
    if head:
        lines = ["", f"{name:28} {'success':>11} {'ms':>9} {'worst':>9} {'ERT ms':>10} {'evals':>8} {'SSE/best':>9}"]
    for label, r in rows.items():
        lines.append(
            f"{label:28} {r['success']:>5}/{r['runs']:<5} {r['ms']:>9.1f} {r['worst_ms']:>9.1f} {r['ert_ms']:>10.1f} "
            f"{r['evaluations']:>8.0f} {r['ratio']:>9.4f}"
        )
    return "\n".join(lines)
