"""Write the page of a batch: verdicts of the studies, trends over the series, failed runs."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from markupsafe import Markup

from frictrack.base.files import replace_text
from frictrack.base.number_format import format_number, format_quantity
from frictrack.present import plots
from frictrack.present.report.markup import SvgEmbedder, now, page_template
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
    return replace_text(path, _render(result, trends, links))


def _render(result: Mapping[str, Any], trends: Sequence[Mapping[str, Any]], links: Mapping[str, str]) -> str:
    """The page as HTML."""
    page = page_template("campaign.html.j2")
    clearest = sorted(trends, key=lambda one: one["p"])[:MAX_PANELS]
    return page.render(
        result=result,
        headline=headline(result),
        kind=_kind(result),
        summary=_summary(result),
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


def headline(result: Mapping[str, Any]) -> str:
    """Describe the batch in one sentence."""
    studies = result["studies"]
    finished = [one for one in studies if not one["reason"]]
    complete = _count(result["verdicts"].get("complete", 0), "is", "are")
    text = f"{_count(len(finished), 'study', 'studies')} done; {complete} complete"
    failed = len(studies) - len(finished)
    runs = sum(bool(one["run"]) for one in result["failed"])
    text += f"; {_count(failed, 'study', 'studies')} failed" if failed else ""
    return f"{text}; {_count(runs, 'run', 'runs')} failed" if runs else text


def _count(n: int, one: str, many: str) -> str:
    return f"{n} {one if n == 1 else many}"


def _kind(result: Mapping[str, Any]) -> str:
    """CSS class of the headline."""
    return "complete" if set(result["verdicts"]) <= {"complete"} and not result["failed"] else "missing"


def _summary(result: Mapping[str, Any]) -> str:
    runs = sum(one["runs"] for one in result["studies"])
    text = f"{_count(runs, 'run', 'runs')} in {_count(len(result['studies']), 'study', 'studies')}"
    processed = len(result["studies"]) - result["kept"]
    if result["kept"]:
        text += f"; {result['kept']} unchanged since the last batch"
    if processed and result["seconds"] > 1.0:
        pace = format_number(result["runs_per_minute"])
        text += f"; {processed} processed in {_time(result['seconds'])}, {pace} runs a minute"
    return f"{text}."


def _time(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds < 120 else f"{seconds / 60:.0f} min"


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
