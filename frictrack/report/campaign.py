"""The page of a batch: how the studies ended, what changes over the series, what failed and why."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from markupsafe import Markup

from frictrack import plots
from frictrack.files import replace_text
from frictrack.number_format import format_number, format_quantity
from frictrack.report.page import SvgEmbedder
from frictrack.report.tables import Cell, TextTable, code, table
from frictrack.report.templates import now, template

MAX_STUDIES_SHOWN = 1000  # studies in the page's table; the others stand in the files
PANELS = 12  # drawn; the clearest trends first
ORDER = ("complete", "undetermined", "missing", "ambiguous", "unexplained")


def write(result: Mapping[str, Any], trends: Sequence[Mapping[str, Any]], links: Mapping[str, str], path: Path) -> Path:
    """Write the page of a batch to `path`, whole or not at all, and return the path.

    `result` is the JSON of `batch`, `trends` what `plots.trends` draws, `links` tells where a study's report
    is. Raises `FrictrackError` when the folder cannot be written.
    """
    return replace_text(path, render(result, trends, links))


def render(result: Mapping[str, Any], trends: Sequence[Mapping[str, Any]], links: Mapping[str, str]) -> str:
    """The page as HTML."""
    page = template("campaign.html.j2")
    clearest = sorted(trends, key=lambda one: one["p"])[:PANELS]
    return page.render(
        result=result,
        headline=headline(result),
        kind=_kind(result),
        says=_sentences(result),
        trends=_trends(trends),
        changing=sum(bool(one["holds"]) for one in trends),
        series=SvgEmbedder()(plots.trends(clearest)) if clearest else Markup(""),
        left_out=len(trends) - len(clearest),
        verdicts=_verdicts(result),
        lacking=_lacking(result),
        failed=_failed(result, links),
        studies=_studies(result["studies"][:MAX_STUDIES_SHOWN], links),
        more=max(0, len(result["studies"]) - MAX_STUDIES_SHOWN),
        written=now(),
    )


def headline(result: Mapping[str, Any]) -> str:
    """The batch in one sentence."""
    studies = result["studies"]
    ended = [one for one in studies if not one["reason"]]
    whole = _count(result["verdicts"].get("complete", 0), "is", "are")
    text = f"{_count(len(ended), 'study', 'studies')} done; {whole} complete"
    failed = len(studies) - len(ended)
    runs = sum(bool(one["run"]) for one in result["failed"])
    text += f"; {_count(failed, 'study', 'studies')} failed" if failed else ""
    return f"{text}; {_count(runs, 'run', 'runs')} failed" if runs else text


def _count(n: int, one: str, many: str) -> str:
    return f"{n} {one if n == 1 else many}"


def _kind(result: Mapping[str, Any]) -> str:
    """How the headline is marked."""
    return "complete" if set(result["verdicts"]) <= {"complete"} and not result["failed"] else "missing"


def _sentences(result: Mapping[str, Any]) -> str:
    runs = sum(one["runs"] for one in result["studies"])
    text = f"{_count(runs, 'run', 'runs')} in {_count(len(result['studies']), 'study', 'studies')}"
    worked = len(result["studies"]) - result["kept"]
    if result["kept"]:
        text += f"; {result['kept']} had been finished before and had not changed"
    if worked and result["seconds"] > 1.0:
        pace = format_number(result["runs_per_minute"])
        text += f"; {worked} worked on in {_time(result['seconds'])}, {pace} runs a minute"
    return f"{text}."


def _time(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds < 120 else f"{seconds / 60:.0f} min"


def _trends(trends: Sequence[Mapping[str, Any]]) -> TextTable:
    rows = [
        (
            code(one["name"]) if "." in one["name"] else one["name"],
            str(len(one["at"])),
            format_quantity(one["change"], one["change_std"], one["unit"]),
            format_number(one["scatter"]) + f" {one['unit']}".removesuffix(" 1"),
            format_number(one["p"], 2) if one["p"] >= 1e-4 else "below 0.0001",
            "changes" if one["holds"] else "",
        )
        for one in sorted(trends, key=lambda one: one["p"])
    ]
    return table(("quantity", "values", "from first to last", "scatter beside it", "p", "verdict"), rows, (1,))


def _verdicts(result: Mapping[str, Any]) -> TextTable:
    names = [*ORDER, *(name for name in result["verdicts"] if name not in ORDER)]
    rows = [(name, str(result["verdicts"][name])) for name in names if name in result["verdicts"]]
    return table(("verdict", "studies"), rows, (1,))


def _lacking(result: Mapping[str, Any]) -> TextTable:
    """How often each effect was found missing."""
    counts = Counter(name for one in result["studies"] if not one["reason"] for name in one["missing"])
    return table(("missing effect", "studies"), [(code(name), str(n)) for name, n in counts.most_common()], (1,))


def _failed(result: Mapping[str, Any], links: Mapping[str, str]) -> TextTable:
    rows = [(_linked(one["study"], links), one["run"], one["reason"]) for one in result["failed"]]
    return table(("study", "run", "failed because"), rows)


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
    return table(("", "study", "runs", "verdict", "missing", "chi²"), rows, (0, 2, 5))


def _linked(study: str, links: Mapping[str, str]) -> Cell:
    """A study's name, which leads to its report."""
    if study not in links:
        return study
    return Markup('<a href="{}">{}</a>').format(links[study], study)
