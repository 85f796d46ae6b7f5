"""Both papers again: every table and figure that recordings rendered from their own tables allow, and what holds.

from frictrack.reproduce import reproduce
result = reproduce(Path("reproduced"))         # page, figures, tables, JSON
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from frictrack.reproduce.augmented import orders, two_models
from frictrack.reproduce.beam import time_units, tustin_groups
from frictrack.reproduce.collision import sine_filter
from frictrack.reproduce.eq8 import eq8_trials
from frictrack.reproduce.friction_problem import genetic_searches
from frictrack.reproduce.page import Reproduction, shown, write
from frictrack.reproduce.parts import FULL, QUICK, Claim, Effort, Part, Progress, Table, silent
from frictrack.workers import run_parallel

__all__ = [
    "FULL",
    "QUICK",
    "Claim",
    "Effort",
    "Part",
    "Reproduction",
    "Table",
    "eq8_trials",
    "genetic_searches",
    "orders",
    "reproduce",
    "reproduced",
    "shown",
    "sine_filter",
    "time_units",
    "tustin_groups",
    "two_models",
]


def reproduce(folder: Path, *, quick: bool = False, seed: int = 0, progress: Progress = silent) -> dict[str, Any]:
    """Reproduce both papers into `folder`: the JSON of `frictrack reproduce`.

    `quick` takes few seeds, which shows that everything runs and proves nothing. `seed` is that of the rendered
    recordings; the searches take the seeds 0, 1, 2, ...
    """
    return write(reproduced(quick=quick, seed=seed, progress=progress), folder)


def reproduced(*, quick: bool = False, seed: int = 0, progress: Progress = silent) -> Reproduction:
    """Everything that `reproduce` writes, unwritten. In full the parts are run_parallel over the processors."""
    effort = QUICK if quick else FULL
    steps: tuple[Callable[[], Part], ...] = (
        time_units,
        partial(tustin_groups, effort, seed),
        partial(two_models, effort, seed),
        partial(orders, effort, seed),
        partial(eq8_trials, effort),
        partial(genetic_searches, effort, seed),
        partial(sine_filter, effort, seed),
    )
    parts = _one_by_one(steps, progress) if quick else _spread(steps, progress)
    return Reproduction(parts, seed, quick)


def _one_by_one(steps: Sequence[Callable[[], Part]], progress: Progress) -> tuple[Part, ...]:
    made = []
    for i, step in enumerate(steps):
        made.append(step())
        progress(i + 1, len(steps), "reproduce")
    return tuple(made)


def _spread(steps: Sequence[Callable[[], Part]], progress: Progress) -> tuple[Part, ...]:
    """The parts in their order, whichever is done first."""
    made: dict[str, Part] = {}
    for name, part in run_parallel({str(i): step for i, step in enumerate(steps)}):
        made[name] = part
        progress(len(made), len(steps), "reproduce")
    return tuple(made[str(i)] for i in range(len(steps)))
