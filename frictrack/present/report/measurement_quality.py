"""Describe how a study was measured: quality of films, smoothing, settings, findings, hashes and versions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from importlib.metadata import PackageNotFoundError, version
from platform import python_version
from typing import Any

import numpy as np
from markupsafe import Markup

from frictrack.base.number_format import format_number, format_quantity, format_range
from frictrack.present.report.tables import Cell, TextTable, make_table
from frictrack.results import Results, RunResults

MIN_LOCKING_SIGMAS = 0.2  # peak locking over the noise of a frame; less is not reported
MIN_BACKWARD_SIGMAS = 0.5  # difference of backward tracking over the noise of a frame; less is not reported
MIN_BLUR_PX = 1.0  # less is not reported
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
    failed = [
        Markup("<b>{}</b>: {}.").format(run.name, "; ".join(found)) for run in filmed if (found := failed_checks(run))
    ]
    passed = Markup("All measurement self-checks passed.")
    return [_precision([run.quality for run in filmed]), *(failed or [passed])]


def _precision(found: Sequence[Mapping[str, Any]]) -> Markup:
    """Describe the noise of the target and of a fixed reference, over all films."""
    px, um, floor = ([q[k] for q in found if q[k] is not None] for k in ("sigma_px", "sigma_um", "noise_floor_px"))
    sentence = (
        Markup("Position standard deviation per frame: {} px").format(format_range(px))
        if px
        else Markup("The position standard deviation is not known")
    )
    sentence += Markup(" ({} µm)").format(format_range(um)) if um else Markup("")
    sentence += (
        Markup("; standard deviation of a fixed reference: {} px").format(format_range(floor))
        if floor
        else Markup("; no fixed reference was found in the pictures")
    )
    return sentence + Markup(".")


def failed_checks(run: RunResults) -> list[str]:
    """Describe the self-checks that one film fails."""
    q = run.quality
    lost, locking, sigma = q["frames"] - q["found"], q["peak_locking_px"], q["sigma_px"]
    checks = (
        (lost, f"the target was lost in {lost} of {q['frames']} frames"),
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
    sentences = [Markup("{}: {}.").format(run.name, run.filtered.reason) for run in results.runs]
    for run in results.runs:
        warnings = run.cutoff.warnings if run.cutoff else ()
        if warnings:
            sentences.append(Markup("{}: {}; {}.").format(run.name, "; ".join(warnings), _consequence(run)))
        if run.events.noise_at_rest > 0:
            rest, moving = 1e6 * run.events.noise_at_rest, 1e6 * _noise(run)
            sentence = "{}: noise of the displacement {} µm at rest, {} µm over the whole record."
            sentences.append(Markup(sentence).format(run.name, format_number(rest, 2), format_number(moving, 2)))
    return sentences


def _consequence(run: RunResults) -> str:
    if run.filtered.asked:
        return "remove the cut-off from the study file to keep this signal"
    return "the displacement domain keeps this signal, the force domain does not"


def _noise(run: RunResults) -> float:
    sigma = run.filtered.sigma_x
    return float(np.median(sigma[np.isfinite(sigma)]))


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
