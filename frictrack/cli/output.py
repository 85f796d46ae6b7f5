"""Print the results of the commands as tables; the dictionaries are those that `--json` prints."""

from __future__ import annotations

from typing import Any

from rich import box
from rich.console import Console
from rich.markup import escape

from frictrack.cli.blind_output import blind  # noqa: F401 - `print_result` looks the function up here, as all below
from frictrack.cli.crate_output import crate, reproduced_crate  # noqa: F401
from frictrack.cli.diagnosis_output import diagnose, diagnosis_rest, verdict
from frictrack.cli.fit_output import compare, edit, fit, history  # noqa: F401
from frictrack.cli.measurement_output import stages, track  # noqa: F401
from frictrack.cli.plan_output import plan  # noqa: F401
from frictrack.cli.tables import cell
from frictrack.cli.tables import table as _table
from frictrack.number_format import format_plus_minus

MAX_STUDIES = 100  # in the table of a batch; the page shows all


def init(out: Console, result: dict[str, Any]) -> None:
    """Print what was found in a folder, what was left out, and what the user must give.

    Parameters
    ----------
    out
        The terminal.
    result
        JSON of `frictrack init`.

    """
    table = _table("found", "")
    for one in result["found"]:
        table.add_row(escape(one["file"]), escape(one["words"]))
    out.print(table)
    if result["skipped"]:
        table = _table("left out", "")
        for one in result["skipped"]:
            table.add_row(escape(one["file"]), escape(one["reason"]))
        out.print(table)
    path = result["study"]
    needed = (
        f"fill in {', '.join(result['fill_in'])} (marked FILL IN), then" if result["fill_in"] else "look it over, then"
    )
    out.print(f"next: open {path}, {needed} `frictrack run {path}`", markup=False)


def prior(out: Console, result: dict[str, Any]) -> None:
    """Print the parameters of a prior file, and what was left out.

    Parameters
    ----------
    out
        The terminal.
    result
        JSON of `frictrack export --to prior`.

    """
    table = _table("parameter", "value", "unit", "scales with")
    for name, one in result["parameters"].items():
        scales = "" if one["scales_with"] == "nothing" else one["scales_with"]
        table.add_row(escape(name), format_plus_minus(one["value"], one["std"]), one["unit"], scales)
    out.print(table)
    for name, reason in result["left_out"].items():
        out.print(f"left out: {escape(name)}, {escape(reason)}")


def export(out: Console, result: dict[str, Any]) -> None:
    """Print what the format could not hold.

    Parameters
    ----------
    out
        The terminal.
    result
        JSON of `frictrack export`.

    """
    for what in result["lost"]:
        out.print(f"not in these files: {what}", soft_wrap=True, markup=False)


def run(out: Console, result: dict[str, Any]) -> None:
    """Print the fit, then the diagnosis."""
    fit(out, result["fit"], motion=False)
    diagnose(out, result["diagnose"])


def run_verdict(out: Console, result: dict[str, Any]) -> None:
    """Print the fit, then the verdict, while the rest is being computed."""
    fit(out, result["fit"], motion=False)
    verdict(out, result["diagnose"])


def run_rest(out: Console, result: dict[str, Any]) -> None:
    """Print what follows from a verdict that was printed before."""
    diagnosis_rest(out, result["diagnose"])


def demo(out: Console, result: dict[str, Any]) -> None:
    """Print the steps of the demonstration."""
    out.print("A sliding mass was filmed. The diagnosis of the study's first model:")
    diagnose(out, result["diagnose"])
    if result["add"]:
        out.print(f"[bold]{result['add']['effect']}[/bold] was added and the model fitted again:")
        edit(out, result["add"])
    out.print("Every model tried:")
    history(out, result["history"])


def reproduce(out: Console, result: dict[str, Any]) -> None:
    """Print every claim of the papers with its verdict.

    Parameters
    ----------
    out
        The terminal.
    result
        JSON of `frictrack reproduce`.

    """
    for part in result["parts"]:
        out.print(f"[bold]{escape(part['title'])}[/bold]")
        for c in part["claims"]:
            out.print(f"  {c['where']}: {c['claim']}: [bold]{c['verdict']}[/bold]", soft_wrap=True)
            out.print(f"    printed: {escape(c['printed'])}; here: {escape(c['ours'])}", soft_wrap=True)
    n = result["counts"]
    out.print(f"{n['holds']} claims hold, {n['fails']} do not, {n['open']} cannot be decided")
    if result["quick"]:
        out.print("quick run with few seeds: no statistics")


def effects(out: Console, result: dict[str, Any]) -> None:
    """Print what each effect adds, looks like, and is confused with.

    Parameters
    ----------
    out
        The terminal.
    result
        JSON of `frictrack effects`.

    """
    table = _table("effect", "equation", "parameters", "looks like", "mistaken for", box=box.SQUARE, show_lines=True)
    for e in result["effects"]:
        units = "\n".join(f"{p['name']} {p['unit']}" + ", per run" * p["per_run"] for p in e["parameters"])
        units += "".join(f"\nneeds {what}" for what in e["needs"])
        cells = e["name"], e["equation"], units, e["looks_like"], e["mistaken_for"]
        table.add_row(*(escape(text) for text in cells))
    out.print(table)
    out.print("`frictrack add STUDY EFFECT` adds an effect to the model")


def batch(out: Console, result: dict[str, Any]) -> None:
    """Print one row per study, and trends over the series.

    Parameters
    ----------
    out
        The terminal.
    result
        JSON of `frictrack batch`.

    """
    table = _table("study", "runs", "verdict", "missing", "failed because")
    table.columns[0].no_wrap = False  # a path may be longer than the terminal
    for row in result["studies"][:MAX_STUDIES]:
        table.add_row(*(cell(row.get(k)) for k in ("study", "runs", "verdict", "missing", "reason")))
    out.print(table)
    if (more := len(result["studies"]) - MAX_STUDIES) > 0:
        out.print(f"and {more} more")
    for run in (one for one in result["failed"] if one["run"]):
        out.print(f"left out of {run['study']}: {run['reason']}", markup=False)
    for trend in (one for one in result["trends"] if one["holds"]):
        change = format_plus_minus(trend["change"], trend["change_std"])
        unit = f" {trend['unit']}".removesuffix(" 1")
        out.print(f"over the series, {trend['name']} changes by {change}{unit}", markup=False)
    for line in (line for one in result.get("conditions", ()) for line in one["words"]):
        out.print(line, markup=False)


def verify(out: Console, result: dict[str, Any]) -> None:
    """Print one line per fault, then what was verified.

    Parameters
    ----------
    out
        The terminal.
    result
        JSON of `frictrack verify`.

    """
    for fault in result["faults"]:
        out.print(f"{fault['kind']}: {fault['words']}", soft_wrap=True, markup=False)
    if old := result["without_checksums"]:
        out.print(f"{len(old)} files of an earlier schema have no checksums; they get them when they are next written")
    if old := result["partly_hashed"]:
        words = "identify their film by the hash of 3 MB of it; to have all of it hashed, delete them and run again"
        out.print(f"{len(old)} results of an earlier version {words}")
    for folder in result["at_work"]:
        out.print(f"another frictrack process is writing in {folder}", soft_wrap=True, markup=False)
    if result["sound"]:
        out.print(f"{result['files']} result files are sound")
