"""Print what was measured: tracks, motion, friction, error budget."""

from __future__ import annotations

from math import hypot
from typing import Any

from rich.console import Console
from rich.markup import escape

from frictrack.base.number_format import format_plain
from frictrack.cli.tables import cell, filled_columns
from frictrack.cli.tables import table as _table

MIN_SIGMAS_LOCKING = 3.0  # standard deviations from which peak locking counts as found
NOT_IN_TABLE = (
    "reason",
    "smoothing",
    "guard_frames",
    "sigma_x_um",
    "noise_at_rest_um",
)  # written as text, or only in the JSON


def stages(out: Console, result: dict[str, Any]) -> None:
    """Print one row per run, then the notes.

    Parameters
    ----------
    out
        The terminal.
    result
        JSON of `frictrack motion` or `friction`.

    """
    first = result["runs"][0]
    keys = [k for k in first if k not in NOT_IN_TABLE and not isinstance(first[k], dict | list)]
    table = _table(*(k.replace("_", " ") for k in keys))
    for row in result["runs"]:
        table.add_row(*(cell(row.get(k)) for k in keys))
    out.print(table)
    for row in result["runs"]:
        for note in [*filter(None, [row.get("reason"), row.get("smoothing")]), *_happened(row), *row["notes"]]:
            out.print(f"{row['run']}: {escape(note)}", soft_wrap=True)
    for row in result["runs"]:
        if row.get("budget"):
            budget(out, row)


def _happened(row: dict[str, Any]) -> list[str]:
    """What happened in a run, and what a plain low-pass would have cost."""
    events = [f"{e['kind']} at {1e3 * e['from_s']:.1f} ms" for e in row.get("events", ())]
    lines = [", ".join(events)] if events else []
    cutoff = row.get("cutoff")
    if cutoff:
        plain = format_plain(hypot(cutoff["noise"], cutoff["lost"]), 2)
        lines.append(
            f"error of {format_plain(cutoff['followed_apart'], 2)} {cutoff['unit']}; a plain low-pass at "
            f"{format_plain(cutoff['chosen_Hz'])} Hz would have {plain}"
        )
        lines += cutoff["warnings"]
    return lines


def budget(out: Console, row: dict[str, Any]) -> None:
    """Print the error budget of one run's friction force, the total last, and what would make it smaller.

    Parameters
    ----------
    out
        The terminal.
    row
        A row of the JSON of `frictrack friction`.

    """
    table = _table(f"{row['run']}: error from", "size", "of the mean / N", "of a frame / N")
    for part in row["budget"]:
        unknown = part["source"] != "total" and part["size"] is None
        size = "not known" if unknown else f"{format_plain(part['size'], 2)} {part['unit']}" if part["unit"] else ""
        table.add_row(part["source"], size, *(format_plain(part[key], 2) for key in ("mean_N", "frame_N")))
    out.print(table)
    for says in row["budget_says"]:
        out.print(f"  {escape(says)}", soft_wrap=True)


def track(out: Console, result: dict[str, Any]) -> None:
    """Print how well each film was measured: a table in px, then details of each film.

    Parameters
    ----------
    out
        The terminal.
    result
        JSON of `frictrack track`.

    """
    if not result["runs"]:
        out.print("no films in this study: its runs are tables")
        return
    heads = ("run", "found", "σ / px", "σ / µm", "score", "locking / px", "back / px", "fixed / px", "shake / px",
             "blur / px")  # fmt: skip
    out.print(filled_columns(heads, [_measured(row) for row in result["runs"]]))
    out.print(
        "σ: standard deviation per frame; locking: peak locking; back: rms difference to tracking from the last frame; "
        "fixed: noise of the fixed reference",
        style="dim",
    )
    for row in result["runs"]:
        out.print(f"[bold]{escape(row['run'])}[/bold]  {escape(row['target'])}", soft_wrap=True)
        for line in _behind(row):
            out.print(f"  {escape(line)}", soft_wrap=True)


def _measured(row: dict[str, Any]) -> tuple[str, ...]:
    """Return the cells of one film."""
    shaking = "none" if row["shake_px"] == 0 else format_plain(row["shake_px"], 2)
    return (
        escape(row["run"]),
        f"{row['found']}/{row['frames']}",
        *(format_plain(row[key], 2) for key in ("sigma_px", "sigma_um")),
        format_plain(row["score"], 3),
        _locking(row["peak_locking_px"], row["peak_locking_std_px"]),
        format_plain(row["forward_backward_px"], 2),
        format_plain(row["noise_floor_px"], 2),
        shaking,
        format_plain(row["blur_px"], 2),
    )


def _locking(size: float | None, std: float) -> str:
    """Format the amplitude of peak locking; "none" if it is not significant."""
    if size is None:
        return "-"
    return f"{size:.1g} ± {std:.1g}" if size > MIN_SIGMAS_LOCKING * std else "none"


def _behind(row: dict[str, Any]) -> list[str]:
    """Return the details of one film: time base, lost frames, notes, pictures."""
    audit = "; ".join(f"{r['what']} {r['value']} ({r['verdict']})" for r in row["timebase"] if r["verdict"] != "none")
    lost = ", ".join(f"{count} x {reason}" for reason, count in row["lost"].items())
    pictures = ", ".join(filter(None, (row["contact_sheet"], row["overlay"])))
    look_at = [f"look at frames {span['first']} to {span['last']}: {span['words']}" for span in row.get("suspects", [])]
    lines = [f"time base: {audit}" if audit else "", f"lost: {lost}" if lost else "", *look_at, *row["notes"], pictures]
    return [line for line in lines if line]
