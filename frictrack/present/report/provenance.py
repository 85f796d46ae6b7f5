"""Build the tables of a study's provenance: settings, findings, hashes and software versions."""

from __future__ import annotations

from collections.abc import Sequence
from importlib.metadata import PackageNotFoundError, version
from platform import python_version
from typing import Any

import numpy as np
from markupsafe import Markup

from frictrack.base.number_format import format_quantity
from frictrack.present.report.tables import Cell, TextTable, make_table
from frictrack.results import Results

LIBRARIES = ("numpy", "scipy", "pandas", "matplotlib", "h5py", "opencv-python-headless")
KEYS_WITH_COLUMN = ("name", "video", "table", "mass", "fps", "scale", "role", "x_offset")


def settings_table(results: Results) -> TextTable:
    """Table of the settings of each run.

    Parameters
    ----------
    results : Results
        The study.

    """
    rows = []
    for run in results.runs:
        s = run.settings
        mass = s.get("mass")
        rows.append(
            (
                run.name,
                run.source,
                format_quantity(mass[0], mass[1], "kg") if isinstance(mass, tuple | list) else str(mass or ""),
                f"{s['fps']:g} Hz" if "fps" in s else "",
                _scale(s.get("scale", "")),
                f"{run.motion.cutoff:.0f} Hz" if np.isfinite(run.motion.cutoff) else "",
                "; ".join(
                    f"{k} = {v}" for k, v in s.items() if k not in KEYS_WITH_COLUMN and (k, v) != ("reference", "auto")
                ),
            )
        )
    return make_table(("run", "source", "mass", "frame rate", "scale", "cut-off", "further keys"), rows)


def _scale(written: Any) -> str:
    """Describe a scale as the study file gives it."""
    if isinstance(written, list):
        return ", checked against ".join(_scale(one) for one in written)
    if not isinstance(written, dict):
        return str(written)
    if "board" in written:
        names = written["board"] if isinstance(written["board"], list) else [written["board"]]
        columns, rows = written["squares"]
        return f"board in {', '.join(map(str, names))}: {columns} x {rows} squares of {written['square']}"
    if "target" in written:
        return f"the target's size, {written['target']}"
    if "plane" in written:
        return f"{len(written['points'])} points at known positions"
    return f"ruler of {written['length']}"


def findings_table(results: Results) -> TextTable:
    """Table of the findings and automatic decisions, run by run.

    Parameters
    ----------
    results : Results
        The study.

    """
    rows: list[Sequence[Cell]] = []
    for run in results.runs:
        rows.append((run.name, f"low-pass: {run.filtered.reason}"))
        if run.friction is not None:
            rows.append(("", f"free section: {run.friction.reason}"))
        rows += [("", note) for note in run.notes]
    rows += [("study", note) for note in results.notes]
    rows += [("diagnosis", note) for note in (results.diagnosis or {}).get("remarks", [])]
    return make_table(("", "finding"), rows)


def hash_table(results: Results) -> TextTable:
    """Table of the first digits of the hash of each film and stage.

    The full hash is shown when the pointer rests on a cell.

    Parameters
    ----------
    results : Results
        The study.

    """
    stages = list(dict.fromkeys(stage for run in results.runs for stage in run.hashes))
    rows = [
        (
            run.name,
            _hash(run.film.hash if run.film else ""),
            *(_hash(run.hashes.get(stage, "")) for stage in stages),
        )
        for run in results.runs
    ]
    return make_table(("run", "film (sha256)", *stages), rows)


def _hash(full: str) -> Cell:
    return Markup('<code title="{}">{}</code>').format(full, full[:10]) if full else ""


def software_versions(results: Results) -> str:
    """List the versions of frictrack, Python and the main libraries.

    Parameters
    ----------
    results : Results
        The study; its version of frictrack is listed.

    """
    found = [f"frictrack {results.version}", f"Python {python_version()}"]
    for name in LIBRARIES:
        try:
            found.append(f"{name} {version(name)}")
        except PackageNotFoundError:
            continue
    return ", ".join(found)
