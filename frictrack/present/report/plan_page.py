"""Write the page of a plan: which runs to film, and which effects each run distinguishes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from frictrack.base.files import replace_text
from frictrack.base.number_format import format_size
from frictrack.present import plots
from frictrack.present.report.markup import SvgEmbedder, mark_code, now, page_template
from frictrack.present.report.tables import TextTable, code_cell, make_table


def write_plan(plan: Mapping[str, Any], path: Path) -> Path:
    """Write the page of a plan as HTML, completely or not at all.

    Parameters
    ----------
    plan : mapping
        The JSON of `frictrack plan`.
    path : Path
        File to write.

    Returns
    -------
    Path
        The written file.

    Raises
    ------
    FrictrackError
        If the folder cannot be written.

    """
    return replace_text(path, _render(plan))


def _render(plan: Mapping[str, Any]) -> str:
    """The page as HTML."""
    page = page_template("plan.html.j2")
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
    """Describe the plan in one sentence."""
    runs = plan["runs"]
    if not runs:
        return (
            "No further run distinguishes more effects" if plan["done"] else "No run of the menu distinguishes effects"
        )
    after = runs[-1]["pairs_left"]
    more = " more" if plan["done"] else ""
    count = sum(run["speed"] is not None for run in runs)
    return (
        f"{count}{more} run{'s' if count > 1 else ''}: {plan['pairs'] - after} of {plan['pairs']} pairs distinguished"
    )


def _runs(runs: Sequence[Mapping[str, Any]]) -> TextTable:
    rows = [
        (
            str(k),
            mark_code(run["what"]),
            str(run["adds"]),
            str(run["pairs_left"]),
            _examples(run["separates"]),
            ", ".join(run["shows"]),
        )
        for k, run in enumerate(runs, 1)
    ]
    return make_table(("", "run", "pairs separated", "pairs left", "for example", "now detectable"), rows, (2, 3))


def _examples(pairs: Sequence[Sequence[str]], count: int = 3) -> str:
    """Some pairs, spread over the list."""
    step = max(1, len(pairs) // count)
    return "; ".join(" from ".join(pair) for pair in pairs[::step][:count])


def _left(left: Sequence[Mapping[str, Any]]) -> TextTable:
    rows = [(" and ".join(one["effects"]), one["why"], mark_code(one["settle"])) for one in left]
    return make_table(("pair", "why", "what settles it"), rows)


def _unseen(unseen: Sequence[Mapping[str, Any]]) -> TextTable:
    rows = [(code_cell(one["effect"]), one["why"], mark_code(one["settle"])) for one in unseen]
    return make_table(("effect", "why", "what makes it detectable"), rows)


def _limits(limits: Mapping[str, Mapping[str, Any]]) -> TextTable:
    rows = [
        (
            code_cell(name),
            format_size(limit["value"], limit["unit"]) if limit["value"] is not None else limit["reason"],
            limit["at_words"],
        )
        for name, limit in limits.items()
    ]
    return make_table(("effect", "smallest detectable size", "at"), rows, (1,))
