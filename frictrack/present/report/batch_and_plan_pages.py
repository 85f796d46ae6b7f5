"""Write the pages of a batch of studies and of a plan of runs."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from markupsafe import Markup

from frictrack.base.files import replace_text
from frictrack.base.number_format import format_number, format_quantity, format_size
from frictrack.present import plots
from frictrack.present.report.markup import SvgEmbedder, mark_code, now, page_template
from frictrack.present.report.tables import Cell, TextTable, code_cell, make_table

MAX_STUDIES_SHOWN = 1000  # in the table of the page; the files hold all
MAX_PANELS = 12  # trends drawn, the most significant first
MIN_P_SHOWN = 1e-4
ORDER = ("complete", "undetermined", "missing", "ambiguous", "unexplained")


def write_campaign(
    result: Mapping[str, Any], trends: Sequence[Mapping[str, Any]], links: Mapping[str, str], path: Path
) -> Path:
    """Write the page of a batch as HTML, completely or not at all.

    Parameters
    ----------
    result : mapping
        The JSON of `frictrack batch`.
    trends : sequence of mappings
        Quantities over the series, as `plots.trends` draws them.
    links : mapping
        Address of the report of each study, relative to the page.
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
    clearest = sorted(trends, key=lambda one: one["p"])[:MAX_PANELS]
    html = page_template("campaign.html.j2").render(
        result=result,
        finished=sum(not one["reason"] for one in result["studies"]),
        trends=_trends(trends),
        n_significant=sum(bool(one["holds"]) for one in trends),
        series=SvgEmbedder()(plots.trends(clearest)) if clearest else Markup(""),
        left_out=len(trends) - len(clearest),
        verdicts=_verdicts(result),
        missing=_missing(result),
        failed=_failed(result, links),
        studies=_studies(result["studies"][:MAX_STUDIES_SHOWN], links),
        more=max(0, len(result["studies"]) - MAX_STUDIES_SHOWN),
        written=now(),
    )
    return replace_text(path, html)


def _trends(trends: Sequence[Mapping[str, Any]]) -> TextTable:
    rows = [
        (
            code_cell(one["name"]) if "." in one["name"] else one["name"],
            str(len(one["at"])),
            format_quantity(one["change"], one["change_std"], one["unit"]),
            format_number(one["scatter"]) + f" {one['unit']}".removesuffix(" 1"),
            format_number(one["p"], 2) if one["p"] >= MIN_P_SHOWN else f"below {MIN_P_SHOWN:.4f}",
            "changes" if one["holds"] else "",
        )
        for one in sorted(trends, key=lambda one: one["p"])
    ]
    return make_table(
        ("quantity", "values", "from first to last", "scatter between studies", "p", "verdict"), rows, (1,)
    )


def _verdicts(result: Mapping[str, Any]) -> TextTable:
    names = [*ORDER, *(name for name in result["verdicts"] if name not in ORDER)]
    rows = [(name, str(result["verdicts"][name])) for name in names if name in result["verdicts"]]
    return make_table(("verdict", "studies"), rows, (1,))


def _missing(result: Mapping[str, Any]) -> TextTable:
    """How often each effect was found missing."""
    counts = Counter(name for one in result["studies"] if not one["reason"] for name in one["missing"])
    return make_table(
        ("missing effect", "studies"), [(code_cell(name), str(n)) for name, n in counts.most_common()], (1,)
    )


def _failed(result: Mapping[str, Any], links: Mapping[str, str]) -> TextTable:
    rows = [(_linked(one["study"], links), one["run"], one["reason"]) for one in result["failed"]]
    return make_table(("study", "run", "reason"), rows)


def _studies(studies: Sequence[Mapping[str, Any]], links: Mapping[str, str]) -> TextTable:
    rows = [
        (
            str(k),
            _linked(one["study"], links),
            str(one["runs"]),
            "failed" if one["reason"] else one["verdict"],
            ", ".join(one.get("missing", ())),
            format_number(one.get("reduced_chi2")),
        )
        for k, one in enumerate(studies, 1)
    ]
    return make_table(("", "study", "runs", "verdict", "missing", "chi²"), rows, (0, 2, 5))


def _linked(study: str, links: Mapping[str, str]) -> Cell:
    """Name of a study, linked to its report if there is one."""
    if study not in links:
        return study
    return Markup('<a href="{}">{}</a>').format(links[study], study)


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
    draw = SvgEmbedder()
    html = page_template("plan.html.j2").render(
        plan=plan,
        written=now(),
        remaining=draw(plots.remaining_pairs(plan)),
        separation=draw(plots.pair_separation(plan)),
        runs=_runs(plan["runs"]),
        left=_left(plan["left"]),
        unseen=_unseen(plan["unseen"]),
        limits=_limits(plan["detection_limits"]),
        mark_code=mark_code,
    )
    return replace_text(path, html)


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
