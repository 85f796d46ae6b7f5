"""Build the tables of the films: how each was tracked, and the quality of its measurement."""

from __future__ import annotations

from collections.abc import Sequence

from frictrack.number_format import format_number, format_quantity
from frictrack.report.tables.text_table import TextTable, code_cell, make_table
from frictrack.results import RunResults


def track_table(runs: Sequence[RunResults]) -> TextTable:
    """Table of the films: frame rate, frames with the target, pixel pitch and its error.

    Parameters
    ----------
    runs : sequence of RunResults
        All runs of the study; runs without a film are left out.

    """
    rows = []
    for run in runs:
        if run.film is None or run.track is None:
            continue
        t, found = run.track, run.track.found
        at = "" if t.target is None else "[" + ", ".join(f"{v:.0f}" for v in t.target) + "]"
        pitch, error = run.displacement.pixel_pitch, 100 * run.displacement.relative_scale_error
        rows.append(
            (run.name, run.source, f"{run.film.fps:g}", f"{int(found.sum())} of {len(t)}", code_cell(at),
             format_number(1e6 * pitch if pitch else None, 4), format_number(error, 2) if error else "")
        )  # fmt: skip
    heads = ("run", "film", "frames per s", "frames with target", "target", "µm/px", "scale error / %")
    return make_table(heads, rows, (2, 3, 5, 6))


def measurement_table(runs: Sequence[RunResults]) -> TextTable:
    """Table of the measurement self-checks of each film: noise, peak locking, shake, blur.

    Parameters
    ----------
    runs : sequence of RunResults
        All runs of the study; runs without a film are left out.

    """
    rows = []
    for run in runs:
        if not run.quality:
            continue
        q = run.quality
        locking = format_quantity(q["peak_locking_px"], q["peak_locking_std_px"], "") if q["peak_locking_px"] else ""
        shake = "none" if q["shake_px"] == 0 else format_number(q["shake_px"], 2)
        rows.append(
            (run.name, format_number(q["sigma_px"], 2), format_number(q["sigma_um"], 2), format_number(q["score"]),
             locking, format_number(q["forward_backward_px"], 2), format_number(q["noise_floor_px"], 2), shake,
             format_number(None if q["exposure_s"] is None else 1e6 * q["exposure_s"]), format_number(q["blur_px"], 2))
        )  # fmt: skip
    heads = ("run", "σ / px", "σ / µm", "match score", "peak locking / px", "backward / px", "reference / px",
             "shake / px", "exposure / µs", "blur / px")  # fmt: skip
    return make_table(heads, rows, range(1, len(heads)))
