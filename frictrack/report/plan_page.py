"""The page of a plan: which runs to film, what each adds, what stays open and what settles it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from frictrack import plots
from frictrack.files import replace_text
from frictrack.number_format import format_size
from frictrack.report.markup import mark_code
from frictrack.report.page import SvgEmbedder
from frictrack.report.tables import TextTable, code, table
from frictrack.report.templates import now, template


def write(plan: Mapping[str, Any], path: Path) -> Path:
    """Write the page to `path`, whole or not at all, and return the path.

    Raises `FrictrackError` when the folder cannot be written.
    """
    return replace_text(path, render(plan))


def render(plan: Mapping[str, Any]) -> str:
    """The page as HTML."""
    page = template("plan.html.j2")
    draw = SvgEmbedder()
    return page.render(
        plan=plan,
        headline=headline(plan),
        written=now(),
        remaining=draw(plots.remaining_pairs(plan)),
        separation=draw(plots.pair_separation(plan)),
        runs=_runs(plan["runs"]),
        left=_left(plan["left"]),
        unseen=_unseen(plan["unseen"]),
        limits=_limits(plan["detection_limits"]),
        mark_code=mark_code,
    )


def headline(plan: Mapping[str, Any]) -> str:
    """The plan in one sentence."""
    runs = plan["runs"]
    if not runs:
        return "No further run tells more effects apart" if plan["done"] else "No run of the menu tells effects apart"
    after = runs[-1]["pairs_left"]
    more = " more" if plan["done"] else ""
    count = sum(run["speed"] is not None for run in runs)
    return f"{count}{more} run{'s' if count > 1 else ''}: {plan['pairs'] - after} of {plan['pairs']} pairs told apart"


def _runs(runs: Sequence[Mapping[str, Any]]) -> TextTable:
    rows = [
        (
            str(k),
            mark_code(run["what"]),
            str(run["adds"]),
            str(run["pairs_left"]),
            _some(run["separates"]),
            ", ".join(run["shows"]),
        )
        for k, run in enumerate(runs, 1)
    ]
    return table(("", "run", "pairs parted", "pairs left", "for example", "now seen"), rows, (2, 3))


def _some(pairs: Sequence[Sequence[str]], most: int = 3) -> str:
    """A few pairs, spread over the list."""
    step = max(1, len(pairs) // most)
    return "; ".join(" from ".join(pair) for pair in pairs[::step][:most])


def _left(left: Sequence[Mapping[str, Any]]) -> TextTable:
    rows = [(" and ".join(one["effects"]), one["why"], mark_code(one["settle"])) for one in left]
    return table(("pair", "why", "what settles it"), rows)


def _unseen(unseen: Sequence[Mapping[str, Any]]) -> TextTable:
    rows = [(code(one["effect"]), one["why"], mark_code(one["settle"])) for one in unseen]
    return table(("effect", "why", "what shows it"), rows)


def _limits(limits: Mapping[str, Mapping[str, Any]]) -> TextTable:
    rows = [
        (
            code(name),
            format_size(limit["value"], limit["unit"]) if limit["value"] is not None else limit["reason"],
            limit["at_words"],
        )
        for name, limit in limits.items()
    ]
    return table(("effect", "smallest size seen", "at"), rows, (1,))
