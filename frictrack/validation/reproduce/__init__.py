"""Reproduce both papers: tables and figures from recordings simulated from their own tables, and which claims hold.

    from frictrack.validation.reproduce import reproduce
    result = reproduce(Path("reproduced"))         # page, figures, tables, JSON

Each function that returns a `Section` reproduces one part; notebooks call them one by one.
"""
# ruff: noqa: F401 - the imports are the interface

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from time import process_time
from typing import Any

from frictrack.base import __version__
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
    SectionStore,
    tables_html,
    write_reproduction,
)

SECTIONS: dict[str, tuple[Callable[..., Section], tuple[str, ...], float]] = {
    "time_units": (time_units, (), 2),
    "tustin_groups": (tustin_groups, ("effort", "seed"), 6),
    "two_models": (two_models, ("effort", "seed"), 55),
    "orders": (orders, ("effort", "seed"), 110),
    "equation_4": (equation_4, ("effort", "seed"), 45),
    "test_function": (eq8_trials, ("effort",), 20),
    "friction_problem": (genetic_searches, ("effort", "seed"), 155),
    "sine_filter": (sine_filter, ("effort", "seed"), 3),
}  # function, its arguments, and processor time in full (s, on a machine of 2024)


def reproduce(folder: Path, *, quick: bool = False, seed: int = 0, progress: Progress = no_progress) -> dict[str, Any]:
    """Reproduce both papers and write page, figures, tables and JSON.

    Sections that are in the folder already are kept, so that a call that was interrupted goes on.

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
    return write_reproduction(run_sections(folder, quick=quick, seed=seed, progress=progress), folder)


def run_sections(folder: Path, *, quick: bool = False, seed: int = 0, progress: Progress = no_progress) -> Reproduction:
    """Run all sections that are not done, and keep each in the folder as soon as it is; see `reproduce`."""
    known = {"effort": QUICK if quick else FULL, "seed": seed}
    store = SectionStore(folder, f"{__version__} {known}")
    done = {name: kept for name in SECTIONS if (kept := store.read(name)) is not None}
    left = sorted(SECTIONS.keys() - done.keys(), key=lambda name: -SECTIONS[name][2])  # the longest first
    progress(0, 0, describe_work(len(done), left, quick=quick))
    work = {name: partial(_timed, name, {key: known[key] for key in SECTIONS[name][1]}) for name in left}
    with os_errors_as(f"cannot write into {folder}", ANOTHER_FOLDER):
        for name, (part, seconds) in run_parallel(work, 1 if quick else None):
            store.write(part, seconds)
            done[name] = part, seconds
            progress(len(done), len(SECTIONS), "reproduce")
    parts = tuple(done[name][0] for name in SECTIONS)
    return Reproduction(parts, seed, quick, {name: done[name][1] for name in SECTIONS})


def describe_work(kept: int, left: Sequence[str], *, quick: bool = False) -> str:
    """Say how many sections are done, and how long the others take.

    Examples
    --------
    >>> describe_work(7, ["orders"], quick=True)
    'reproduce: 7 of 8 sections are done and kept; the others take less than a minute'

    """
    seconds, n = sum(SECTIONS[name][2] for name in left), processors()
    workers = "processor" if n == 1 else f"{n} processors in parallel"
    long = f"about {max(seconds / 60, 1):.0f} min of processor time, on {workers}"
    head = f"{kept} of {len(SECTIONS)} sections are done and kept" if kept else f"{len(SECTIONS)} sections"
    if not left:
        return f"reproduce: {head}"
    return f"reproduce: {head}; {'the others take' if kept else 'they take'} {'less than a minute' if quick else long}"


def _timed(name: str, arguments: dict[str, Any]) -> tuple[Section, float]:
    """Run one section; return it with its processor time, s."""
    begin = process_time()
    part = SECTIONS[name][0](**arguments)
    return part, process_time() - begin
