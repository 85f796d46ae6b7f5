"""Reproduce both papers: tables and figures from recordings simulated from their own tables, and which claims hold.

    from frictrack.validation.reproduce import reproduce
    result = reproduce(Path("reproduced"))         # page, figures, tables, JSON

Each function that returns a `Section` reproduces one part; notebooks call them one by one.
"""
# ruff: noqa: F401 - the imports are the interface

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from time import process_time
from typing import Any

from frictrack.base.errors import os_errors_as
from frictrack.base.workers import processors, run_parallel
from frictrack.flow import Progress, no_progress
from frictrack.validation.reproduce.identification import (
    equation_4,
    orders,
    sine_filter,
    time_units,
    tustin_groups,
    two_models,
)
from frictrack.validation.reproduce.search_trials import eq8_trials, genetic_searches
from frictrack.validation.reproduce.sections import (
    ANOTHER_FOLDER,
    FULL,
    QUICK,
    Claim,
    Effort,
    Reproduction,
    ResultTable,
    Section,
    tables_html,
    write_reproduction,
)

SECTIONS: dict[str, tuple[Callable[..., Section], tuple[str, ...], float]] = {
    "time_units": (time_units, (), 2),
    "tustin_groups": (tustin_groups, ("effort", "seed"), 6),
    "two_models": (two_models, ("effort", "seed"), 45),
    "orders": (orders, ("effort", "seed"), 50),
    "equation_4": (equation_4, ("effort", "seed"), 30),
    "test_function": (eq8_trials, ("effort",), 20),
    "friction_problem": (genetic_searches, ("effort", "seed"), 155),
    "sine_filter": (sine_filter, ("effort", "seed"), 3),
}  # function, its arguments, and processor time in full (s, on a machine of 2024)


def reproduce(folder: Path, *, quick: bool = False, seed: int = 0, progress: Progress = no_progress) -> dict[str, Any]:
    """Reproduce both papers and write page, figures, tables and JSON; of the sections done, where it is interrupted.

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
    with os_errors_as(f"cannot write into {folder}", ANOTHER_FOLDER):  # before minutes of work
        folder.mkdir(parents=True, exist_ok=True)
    known = {"effort": QUICK if quick else FULL, "seed": seed}
    longest_first = sorted(SECTIONS, key=lambda name: -SECTIONS[name][2])
    work = {name: partial(_timed, name, {key: known[key] for key in SECTIONS[name][1]}) for name in longest_first}
    done: dict[str, tuple[Section, float]] = {}
    progress(0, 0, describe_work(quick=quick))
    try:
        for name, found in run_parallel(work, 1 if quick else None):
            done[name] = found
            progress(len(done), len(SECTIONS), "reproduce")
    finally:  # where it is interrupted, what is done is kept
        found_in_order = {name: done[name] for name in SECTIONS if name in done}
        parts = tuple(part for part, _ in found_in_order.values())
        seconds = {name: spent for name, (_, spent) in found_in_order.items()}
        result = write_reproduction(Reproduction(parts, seed, quick, seconds, len(SECTIONS) - len(done)), folder)
    return result


def describe_work(*, quick: bool = False) -> str:
    """Say how many sections there are, and how long they take.

    Examples
    --------
    >>> describe_work(quick=True)
    'reproduce: 8 sections; they take about a minute'

    """
    seconds, n = sum(one[2] for one in SECTIONS.values()), processors()
    workers = "processor" if n == 1 else f"{n} processors in parallel"
    long = f"{max(seconds / 60, 1):.0f} min of processor time, on {workers}"
    return f"reproduce: {len(SECTIONS)} sections; they take about {'a minute' if quick else long}"


def _timed(name: str, arguments: dict[str, Any]) -> tuple[Section, float]:
    """Run one section; return it with its processor time, s."""
    begin = process_time()
    part = SECTIONS[name][0](**arguments)
    return part, process_time() - begin
