"""Print what was measured and fitted: tracks, motion, friction, parameters, errors of models."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Sequence
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table
from rich.text import Text

from frictrack.base.glossary import symbols_in
from frictrack.base.number_format import DASH, format_plain
from frictrack.results.names import numbered_name
from frictrack.results.rows import (
    FAILING_HEADS,
    MEASUREMENT_HEADS,
    error_rows,
    failing_rows,
    measurement_cells,
    parameter_row,
)
from frictrack.results.verdicts import describe_lost, describe_predictions, describe_tests

BRIEF_ERRORS = ("F", "held out", "force", "chi²")  # `short` in the rows of errors
MAX_NAME_WIDTH = 20  # characters of a model's name in one line of a table
NOT_IN_TABLE = ("reason", "smoothing", "guard_frames", "sigma_x_um", "noise_at_rest_um")  # as text, or only in JSON


UNBROKEN = re.compile(r"\u202f| (?=[±×] )|(?<=[±×]) |(?<=[\d)]) (?=[%°†]|(?:[kmnµ]?[gmNs]|Hz|px)\b)|(?<=N) (?=s\b)")
LETTERS = {" ": "\ue000", "\u202f": "\ue001"}  # that no text has


class Terminal(Console):
    """Console that ends no line within a number or before its unit, except in tables.

    Rich ends lines also at spaces that do not break, so they are printed as letters first.
    """

    lines = 0  # that were printed

    def print(self, *objects: Any, **how: Any) -> None:
        """Print texts and tables."""
        with self.capture() as printed:
            marked = (UNBROKEN.sub(lambda m: LETTERS[m[0]], one) if isinstance(one, str) else one for one in objects)
            super().print(*marked, **how)
        text = printed.get().translate({ord(letter): space for space, letter in LETTERS.items()})
        self.lines += text.count("\n")
        self.file.write(text)


def table(*headers: str, rows: Iterable[Sequence[str]] = ()) -> Table:
    """Return a table without a box; names in the first column and words that are not long stay whole."""
    new, rows = Table(box=None, pad_edge=False, header_style="dim"), list(rows)
    for i, header in enumerate(headers):
        words = " ".join([header, *(row[i] for row in rows)]).split()
        longest = max((len(word) for word in words if len(word) <= MAX_NAME_WIDTH), default=None)
        new.add_column(header, overflow="fold", no_wrap=i == 0, min_width=longest)
    for row in rows:
        new.add_row(*row)
    return new


def filled_table(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> Table:
    """Return a table without its empty columns."""
    filled = [k for k in range(len(heads)) if any(row[k] not in ("", DASH) for row in rows)]
    return table(*(heads[k] for k in filled), rows=([row[k] for k in filled] for row in rows))


def cell(value: Any) -> str:
    """Format a value of a dictionary for a table."""
    if isinstance(value, float):
        return format_plain(value)
    if isinstance(value, list):
        return escape(", ".join(map(str, value)))
    return "" if value is None else escape(str(value))


def lines(out: Console, texts: Iterable[str], indent: str = "") -> None:
    """Print texts, one a line; long ones are broken by the terminal alone, so that they can be copied."""
    for text in texts:
        out.print(f"{indent}{escape(text)}", soft_wrap=True)


# --- measurements


def stages(out: Console, result: dict[str, Any]) -> None:
    """Print one row per run, then the notes and the error budgets."""
    runs = result["runs"]
    keys = [k for k, value in runs[0].items() if k not in NOT_IN_TABLE and not isinstance(value, dict | list)]
    heads = (k.replace("_", " ") for k in keys)
    out.print(table(*heads, rows=([cell(row.get(k)) for k in keys] for row in runs)))
    for row in runs:
        notes = [*filter(None, [row.get("reason"), row.get("smoothing")]), *_happened(row), *row["notes"]]
        lines(out, notes, f"{row['run']}: ")
    for row in runs:
        if row.get("budget"):
            _budget(out, row)


def _happened(row: dict[str, Any]) -> list[str]:
    """What happened in a run, and what a plain low-pass would have cost."""
    events = [f"{e['kind']} at {1e3 * e['from_s']:.1f} ms" for e in row.get("events", ())]
    found = [", ".join(events)] if events else []
    if cutoff := row.get("cutoff"):
        plain = format_plain(math.hypot(cutoff["noise"], cutoff["lost"]), 2)
        error = f"error of {format_plain(cutoff['followed_apart'], 2)} {cutoff['unit']}"
        found.append(f"{error}; a plain low-pass at {format_plain(cutoff['chosen_Hz'])} Hz would have {plain}")
        found += cutoff["warnings"]
    return found


def _budget(out: Console, row: dict[str, Any]) -> None:
    """Print the error budget of one run's friction force, the total last, and what would make it smaller."""
    rows = table(f"{row['run']}: error from", "size", "of the mean / N", "of a frame / N")
    for part in row["budget"]:
        unknown = part["source"] != "total" and part["size"] is None
        size = "not known" if unknown else f"{format_plain(part['size'], 2)} {part['unit']}" if part["unit"] else ""
        rows.add_row(part["source"], size, *(format_plain(part[key], 2) for key in ("mean_N", "frame_N")))
    out.print(rows)
    lines(out, row["budget_says"], "  ")


def track(out: Console, result: dict[str, Any]) -> None:
    """Print how well each film was measured: a table in px, then details of each film."""
    if not result["runs"]:
        out.print("no films in this study: its runs are tables")
        return
    rows = [(escape(r["run"]), f"{r['found']}/{r['frames']}", *measurement_cells(r)) for r in result["runs"]]
    out.print(filled_table(("run", "found", *MEASUREMENT_HEADS), rows))
    out.print(
        "σ: standard deviation per frame; locking: peak locking; back: rms difference to tracking from the last frame; "
        "fixed: noise of the fixed reference",
        style="dim",
    )
    for row in result["runs"]:
        out.print(f"[bold]{escape(row['run'])}[/bold]  {escape(row['target'])}", soft_wrap=True)
        lines(out, _details(row), "  ")


def _details(row: dict[str, Any]) -> list[str]:
    """Return the details of one film: time base, lost frames, notes, pictures."""
    audit = "; ".join(f"{r['what']} {r['value']} ({r['verdict']})" for r in row["timebase"] if r["verdict"] != "none")
    reasons = ", ".join(f"{count} x {reason}" for reason, count in row["lost"].items())
    lost = f"{describe_lost(sum(row['lost'].values()), row['frames'])}: {reasons}" if reasons else ""
    pictures = ", ".join(filter(None, (row["contact_sheet"], row["overlay"])))
    look_at = [f"look at frames {span['first']} to {span['last']}: {span['words']}" for span in row.get("suspects", [])]
    found = [f"time base: {audit}" if audit else "", lost, *look_at, *row["notes"], pictures]
    return [line for line in found if line]


# --- fits


def fit(out: Console, result: dict[str, Any]) -> None:
    """Print the parameters with standard deviations and units, then the errors."""
    out.print(f"[bold]{' + '.join(result['model'])}[/bold]  ({result['domain']} domain, {result['search']})")
    if "equation" in result:
        out.print(escape(result["equation"]))
        out.print(f"{symbols_in(result['equation'])}.", style="dim")
    out.print(parameters(result["parameters"]))
    if prior := result.get("prior"):
        _prior(out, prior)
    if result.get("misfit"):
        out.print(f"[bold]† {escape(result['misfit']['words'])}[/bold]")
    sentences(out, {"words": result.get("remarks", [])})
    if result.get("scale_error"):
        out.print(
            f"the scale has a standard deviation of {format_plain(100 * result['scale_error'], 2)} %, common to all "
            "runs of a camera and included in every ±"
        )
    out.print(errors([("", result["errors"])]))


def _prior(out: Console, prior: dict[str, Any]) -> None:
    """Print how well the data agree with the prior; of several groups, group by group."""
    for group, one in prior.items() if "chi2" not in prior else [("", prior)]:
        said = "no direction determined by the runs" if one["p"] is None else f"p = {one['p']:.2g}"
        of = f"{escape(group)}: " if group else ""
        out.print(f"{of}disagreement of runs and prior: chi² {one['chi2']:.3g} in {one['dof']} directions, {said}")


def parameters(values: dict[str, Any], *, brief: bool = False, more: str = "") -> Table:
    """Return a table with one row per parameter: value ± standard deviation, remark.

    A dagger column with wider deviations, intervals and the weight of a prior are shown where any parameter has them;
    a brief table has one ± that includes the misfit, and the remark as far as it fits into a line; `more` says what it
    leaves out.
    """
    found = {escape(name): parameter_row(p) for name, p in values.items()}
    if brief:
        new = table("parameter", "value ± std", more)
        new.columns[1].no_wrap = True
        for name, row in found.items():
            new.add_row(name, row.short, Text(row.short_remark, no_wrap=True, overflow="ellipsis"))
        return new
    heads = ("parameter", "value ± std", "† ± with misfit", "95 % interval", "from the prior", "")
    cells = [(n, r.value, r.misfit, r.interval, r.from_prior, escape(r.remark)) for n, r in found.items()]
    return filled_table(heads, cells)


def errors(columns: Iterable[tuple[str, dict[str, Any]]], *, brief: bool = False) -> Table:
    """Return a table with one row per error and one column per model; a brief one has only `BRIEF_ERRORS`."""
    titles, models = zip(*columns, strict=True)
    found = (row for row in error_rows(models) if (row.short in BRIEF_ERRORS if brief else row.short))
    return table("error", *titles, "unit", rows=([r.name, *map(format_plain, r.values), r.unit] for r in found))


def compare(out: Console, result: dict[str, Any]) -> None:
    """Print the errors of every model, and where the current one fails."""
    history(out, result)
    fails_at(out, result["fails_at"])


def sentences(out: Console, result: dict[str, Any]) -> None:
    """Print the "words" of a result, one sentence a line."""
    for sentence in result["words"]:
        out.print(escape(sentence))


def history(out: Console, result: dict[str, Any]) -> None:
    """Print every model tried, in order, one row each."""
    models = result["models"]
    found = [row for row in error_rows(model["errors"] for model in models) if row.short]
    heads = (f"{row.short} / {row.unit}" if row.unit else row.short for row in found)
    rows = table("model", *heads)
    for k, model in enumerate(models):
        name = numbered_name(model["name"])
        name = name if len(name) <= MAX_NAME_WIDTH else name.replace(" + ", "\n  + ")
        words = escape("\n  ".join([name, *model.get("settings", [])]))
        rows.add_row(words, *(format_plain(row.values[k]) for row in found))
    out.print(rows)
    sentences(out, {"words": (*describe_tests(result), *describe_predictions(result))})


def fails_at(out: Console, spans: list[dict[str, Any]]) -> None:
    """Print spans of time, position and velocity with their share of the misfit."""
    if spans:
        out.print(table("fails in", *FAILING_HEADS, rows=failing_rows(spans)))
