"""Reproduce both papers: tables and figures from recordings simulated from their own tables, and which claims hold.

    from frictrack.validation.reproduce import reproduce
    result = reproduce(Path("reproduced"))         # page, figures, tables, JSON

Each function that returns a `Section` reproduces one part; notebooks call them one by one.
"""
# ruff: noqa: F401 - the imports are the interface

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import replace
from functools import partial
from pathlib import Path
from time import process_time
from typing import Any

from frictrack.base import __version__
from frictrack.base.workers import processors, run_parallel
from frictrack.flow import Progress, digest, no_progress
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
    FULL,
    QUICK,
    Claim,
    Effort,
    Reproduction,
    ResultTable,
    Section,
    read_sections,
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
    """Reproduce both papers and write page, figures, tables and JSON after every section.

    Sections that an interrupted call with the same settings and version wrote into the folder are not computed again.

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
    known = {"effort": QUICK if quick else FULL, "seed": seed}
    arguments = {name: {key: known[key] for key in one[1]} for name, one in SECTIONS.items()}
    keys = {name: digest([name, __version__, arguments[name]]) for name in SECTIONS}
    done = read_sections(folder, keys)

    def write() -> dict[str, Any]:
        parts = tuple(done[name] for name in SECTIONS if name in done)
        return write_reproduction(Reproduction(parts, seed, quick, len(SECTIONS) - len(parts)), folder)

    result = write()  # before minutes of work
    missing = sorted(SECTIONS.keys() - done, key=lambda name: -SECTIONS[name][2])  # the longest first
    progress(0, 0, describe_work(quick=quick, done=done))
    work = {name: partial(_made, keys, arguments, name) for name in missing}
    for name, found in run_parallel(work, 1 if quick else None):
        done[name] = found
        result = write()
        progress(len(done), len(SECTIONS), "reproduce")
    return result


def describe_work(*, quick: bool = False, done: Collection[str] = ()) -> str:
    """Say how many sections there are, how many of them are done, and how long the others take.

    Examples
    --------
    >>> describe_work(quick=True)
    'reproduce: 8 sections; they take about a minute'

    """
    seconds, n = sum(one[2] for name, one in SECTIONS.items() if name not in done), processors()
    workers = "processor" if n == 1 else f"{n} processors in parallel"
    long = f"{max(seconds / 60, 1):.0f} min of processor time, on {workers}"
    sections = f"{len(SECTIONS)} sections; " + (f"{len(done)} are there, the others" if done else "they")
    return f"reproduce: {sections} take about {'a minute' if quick else long}"


def _made(keys: dict[str, str], arguments: dict[str, dict[str, Any]], name: str) -> Section:
    """Compute one section, with its key and its processor time."""
    begin = process_time()
    part = SECTIONS[name][0](**arguments[name])
    return replace(part.with_drawn_figures(), key=keys[name], seconds=process_time() - begin)
