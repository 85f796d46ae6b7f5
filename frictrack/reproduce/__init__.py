"""Reproduce both papers: tables and figures from recordings simulated from their own tables, and which claims hold.

    from frictrack.reproduce import reproduce
    result = reproduce(Path("reproduced"))         # page, figures, tables, JSON

Each function that returns a `Section` reproduces one part; notebooks call them one by one.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from frictrack.reproduce.augmented_models import orders, two_models
from frictrack.reproduce.eq8 import eq8_trials
from frictrack.reproduce.friction_search import genetic_searches
from frictrack.reproduce.page import Reproduction, tables_html, write_reproduction
from frictrack.reproduce.second_paper import sine_filter
from frictrack.reproduce.sections import FULL, QUICK, Claim, Effort, Progress, ResultTable, Section, silent
from frictrack.reproduce.tustin_model import time_units, tustin_groups
from frictrack.workers import run_parallel

__all__ = [
    "FULL",
    "QUICK",
    "Claim",
    "Effort",
    "Reproduction",
    "ResultTable",
    "Section",
    "eq8_trials",
    "genetic_searches",
    "orders",
    "reproduce",
    "run_sections",
    "sine_filter",
    "tables_html",
    "time_units",
    "tustin_groups",
    "two_models",
]


def reproduce(folder: Path, *, quick: bool = False, seed: int = 0, progress: Progress = silent) -> dict[str, Any]:
    """Reproduce both papers and write page, figures, tables and JSON.

    Parameters
    ----------
    folder
        Where to write.
    quick
        Use few seeds: shows that everything runs, but decides no claim.
    seed
        Seed of the simulated recordings; the searches use the seeds 0, 1, 2, ...
    progress
        Called with the number of sections done, the number of all and a text.

    Returns
    -------
    dict
        JSON of `frictrack reproduce`.

    Raises
    ------
    FrictrackError
        If the folder cannot be written.

    """
    return write_reproduction(run_sections(quick=quick, seed=seed, progress=progress), folder)


def run_sections(*, quick: bool = False, seed: int = 0, progress: Progress = silent) -> Reproduction:
    """Run all sections without writing them.

    Parameters
    ----------
    quick, seed, progress
        As in `reproduce`. Without `quick` the sections run in parallel.

    Returns
    -------
    Reproduction
        All sections.

    """
    effort = QUICK if quick else FULL
    steps: tuple[Callable[[], Section], ...] = (
        time_units,
        partial(tustin_groups, effort, seed),
        partial(two_models, effort, seed),
        partial(orders, effort, seed),
        partial(eq8_trials, effort),
        partial(genetic_searches, effort, seed),
        partial(sine_filter, effort, seed),
    )
    parts = _one_by_one(steps, progress) if quick else _in_parallel(steps, progress)
    return Reproduction(parts, seed, quick)


def _one_by_one(steps: Sequence[Callable[[], Section]], progress: Progress) -> tuple[Section, ...]:
    """Run sections one after the other."""
    finished = []
    for i, step in enumerate(steps):
        finished.append(step())
        progress(i + 1, len(steps), "reproduce")
    return tuple(finished)


def _in_parallel(steps: Sequence[Callable[[], Section]], progress: Progress) -> tuple[Section, ...]:
    """Run sections in several processes; return them in their order."""
    finished: dict[str, Section] = {}
    for name, part in run_parallel({str(i): step for i, step in enumerate(steps)}):
        finished[name] = part
        progress(len(finished), len(steps), "reproduce")
    return tuple(finished[str(i)] for i in range(len(steps)))
