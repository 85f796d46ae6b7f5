"""Describe how a study was measured: quality of films, smoothing, settings, findings, hashes and versions."""

from __future__ import annotations

from collections.abc import Sequence
from importlib.metadata import PackageNotFoundError, version
from platform import python_version
from typing import Any

import numpy as np
from markupsafe import Markup

from frictrack.base.number_format import format_number, format_quantity
from frictrack.present.report.markup import sentences
from frictrack.present.report.tables import Cell, TextTable, make_table
from frictrack.results import Results, RunResults
from frictrack.results.verdicts import describe_lost

MIN_LOCKING_SIGMAS = 0.2  # peak locking over the noise of a frame; less is not reported
MIN_BACKWARD_SIGMAS = 0.5  # difference of backward tracking over the noise of a frame; less is not reported
MIN_BLUR_PX = 1.0  # less is not reported
PRECISIONS = ("sigma_px", "sigma_um", "noise_floor_px")  # of the target, px and um, and of a fixed reference, px
GOOD_VERDICTS = ("used", "agrees", "none", "speed of showing")


def measurement(runs: Sequence[RunResults]) -> list[Markup]:
    """Describe the noise of the films and the failed self-checks of their measurement.

    Parameters
    ----------
    runs : sequence of RunResults
        All runs of the study.

    Returns
    -------
    list of Markup
        Sentences; none if no run has a film.

    """
    filmed = [run for run in runs if run.quality]
    if not filmed:
        return []
    values = ([run.quality[k] for run in filmed if run.quality[k] is not None] for k in PRECISIONS)
    failed = [(run.name, found) for run in filmed if (found := failed_checks(run))]
    return sentences("measurement", *values, failed)


def failed_checks(run: RunResults) -> list[str]:
    """Describe the self-checks that one film fails."""
    q = run.quality
    lost, locking, sigma = q["frames"] - q["found"], q["peak_locking_px"], q["sigma_px"]
    checks = (
        (lost, describe_lost(lost, q["frames"])),
        (q["shake_px"], f"camera shake of {_px(q['shake_px'])} at {format_number(q['shake_Hz'])} Hz was subtracted"),
        (
            locking and sigma and locking > 3 * q["peak_locking_std_px"] and locking > MIN_LOCKING_SIGMAS * sigma,
            f"peak locking shifts positions by {_px(locking)}",
        ),
        (
            q["forward_backward_sigmas"] and q["forward_backward_sigmas"] > MIN_BACKWARD_SIGMAS,
            f"positions tracked backward differ by {_px(q['forward_backward_px'])}",
        ),
        (
            q["blur_px"] and q["blur_px"] > MIN_BLUR_PX,
            f"the target moves {_px(q['blur_px'])} during the exposure of a frame",
        ),
    )
    timing = [f"{r['what']}: {r['value']}, {r['verdict']}" for r in q["timebase"] if not is_good(r["verdict"])]
    scale = [note for note in run.displacement.notes if "by the motion" in note or "from the motion" in note]
    return [text for failed, text in checks if failed] + timing + scale


def is_good(verdict: str) -> bool:
    """Return whether the verdict of a check of the time base is nothing to worry about."""
    return verdict in GOOD_VERDICTS or "of the frame interval" in verdict


def _px(value: float | None) -> str:
    return f"{format_number(value, 2)} px"


def smoothing(results: Results) -> list[Markup]:
    """Describe how each displacement was smoothed, signals above the cut-off, and the noise at rest.

    Parameters
    ----------
    results : Results
        The study.

    Returns
    -------
    list of Markup
        Sentences.

    """

    def noise_um(run: RunResults) -> float:
        sigma = run.filtered.sigma_x
        return 1e6 * float(np.median(sigma[np.isfinite(sigma)]))

    return sentences("smoothing", results.runs, noise_um)


LIBRARIES = ("numpy", "scipy", "pandas", "matplotlib", "h5py", "opencv-python-headless")
KEYS_WITH_COLUMN = ("name", "video", "table", "mass", "fps", "scale", "role", "x_offset")


def settings_table(results: Results) -> TextTable:
    """Table of the settings of each run."""
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
    """Table of the findings and automatic decisions, run by run."""
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
    """List the versions of frictrack, Python and the main libraries."""
    found = [f"frictrack {results.version}", f"Python {python_version()}"]
    for name in LIBRARIES:
        try:
            found.append(f"{name} {version(name)}")
        except PackageNotFoundError:
            continue
    return ", ".join(found)
