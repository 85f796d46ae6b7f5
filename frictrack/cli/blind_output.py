"""Print the score of a blind benchmark: shares with intervals, detection limits, confusions."""

from __future__ import annotations

from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from frictrack.cli.tables import table
from frictrack.number_format import format_plain

SHARES = (  # words, and where they stand
    ("one hidden: named first", ("one", "named_first")),
    ("one hidden: first, or in its group", ("one", "in_group")),
    ("one hidden: first where nothing is like it", ("one", "first_where_alone")),
    ("one hidden: missed", ("one", "missed")),
    ("one hidden: more than one named", ("one", "more_than_hidden")),
    ("nothing hidden: false alarms", ("none", "false_alarms")),
    ("two hidden: both found", ("two", "both")),
    ("not in the library: unexplained, or reproduced", ("foreign", "unexplained_or_reproduced")),
    ("fault of the measurement: called one", ("fault", "called")),
    ("after: reduced chi-squared within 0.9-1.1", ("after", "reduced_chi2")),
    ("after: held out within 5 % of the noise", ("after", "heldout")),
    ("after: truth within the 99 % intervals", ("after", "parameters")),
)


def blind(out: Console, result: dict[str, Any]) -> None:
    """Print the shares of hits with intervals, detection limits and confusions.

    Parameters
    ----------
    out
        The terminal.
    result
        JSON of `frictrack blind score`.

    """
    out.print(_shares(result))
    one, where, time = result["one"], result["where"], result["seconds"]
    out.print(
        f"median group {format_plain(one['median_group'])}, "
        f"of indistinguishable effects {format_plain(one['median_set'])}"
    )
    out.print(f"where it fails: mean F1 {format_plain(where['mean_f1'], 3)} over {where['of']} studies")
    out.print(f"a diagnosis takes {format_plain(time['median'], 3)} s, at most {format_plain(time['largest'], 3)} s")
    if result["limits"]:
        out.print(_limits(result["limits"]))
    if result["confusion"]:
        out.print(_confusion(result["confusion"]))
    for one in result["failed"]:
        out.print(f"{one['study']} failed: {escape(one['reason'])}")


def _shares(result: dict[str, Any]) -> Table:
    rows = table(f"{result['studies']} studies", "hits", "of", "share / %", "95 % interval / %")
    for words, (group, key) in SHARES:
        one = result[group][key]
        if one["of"]:
            low, high = (100 * q for q in one["interval"])
            rows.add_row(
                words, str(one["hits"]), str(one["of"]), format_plain(100 * one["share"], 3), f"{low:.1f}-{high:.1f}"
            )
    return rows


def _limits(limits: dict[str, dict[str, float]]) -> Table:
    rows = table("detection limit over the ideal detector's", "median", "largest", "studies")
    for name, one in limits.items():
        rows.add_row(name, format_plain(one["median"], 3), format_plain(one["largest"], 3), str(one["of"]))
    return rows


def _confusion(confusion: dict[str, dict[str, int]]) -> Table:
    rows = table("hidden", "named first")
    for name, counts in confusion.items():
        ordered = sorted(counts.items(), key=lambda pair: -pair[1])
        rows.add_row(name, ", ".join(f"{what} {count}" for what, count in ordered))
    return rows
