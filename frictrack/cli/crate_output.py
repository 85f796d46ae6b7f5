"""Print what is in a crate, and how the results of a crate compare with those computed again."""

from __future__ import annotations

from typing import Any

from rich.console import Console
from rich.markup import escape

from frictrack.cli.tables import table

MAX_DIFFERENCES = 5  # printed of one group
NOT_GIVEN = {"license": "a licence, without which nobody may use the data", "author": "an author"}


def crate(out: Console, result: dict[str, Any]) -> None:
    """Print size and content of a crate, and what is missing in it.

    Parameters
    ----------
    out
        The terminal.
    result
        JSON of `frictrack export --to crate`.

    """
    out.print(f"{result['files']} files, {result['bytes'] / 1e6:.1f} MB")
    if result["by_hash"]:
        rows = table("not included, only its hash", "MB", "SHA-256")
        for one in result["by_hash"]:
            rows.add_row(escape(one["file"]), f"{one['bytes'] / 1e6:.1f}", one["sha256"][:12])
        out.print(rows)
        out.print("to include them: --include-recordings; publish them elsewhere otherwise", markup=False)
    for name in result["not_given"]:
        out.print(f"not given: {NOT_GIVEN[name]}; give --{name}", markup=False)


def reproduced_crate(out: Console, result: dict[str, Any]) -> None:
    """Print the comparison group by group, and which versions differ.

    Parameters
    ----------
    out
        The terminal.
    result
        JSON of `frictrack reproduce CRATE`.

    """
    rows = table("group", "numbers", "largest difference", "equal")
    for group in result["groups"]:
        largest = group["largest_difference"]
        size = "infinite" if largest is None else f"{largest:.1e}" if largest else "0"
        equal = "yes" if group["equal"] else f"[bold]NO[/bold], {group['n_differences']}"
        rows.add_row(escape(f"{group['file']}:/{group['group']}"), str(group["numbers"]), size, equal)
    out.print(rows)
    for group in result["groups"]:
        for one in group["differences"][:MAX_DIFFERENCES]:
            where = f"{one['file']}:/{one['group']} {one['value']}".rstrip()
            out.print(f"{where}: {one['stored']} in the crate, {one['computed']} here", markup=False, soft_wrap=True)
    for place in result["altered"]:
        out.print(f"altered since the crate was written: {place}", markup=False, soft_wrap=True)
    for one in result["versions"]:
        out.print(f"{one['name']}: {one['stored']} in the crate, {one['computed']} here", markup=False, soft_wrap=True)
    if not result["equal"]:
        same = "are the same" if result["same_conclusions"] else "differ, too"
        out.print(f"models, verdicts, parameters and errors {same}")
    how = f"to a relative {result['tolerance']:g}, as versions differ" if result["versions"] else "bit for bit"
    out.print(f"{result['numbers']} numbers compared {how}, in {result['seconds']:.0f} s", markup=False)
